"""
MCAP bags in the layout of rosbag2 (Jazzy).

Reading, writing and playing do not need ROS and do not import rclpy.
"""
