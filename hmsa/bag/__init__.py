"""
MCAP bags in the layout of rosbag2 (Jazzy).

Reading and writing do not need ROS and do not import rclpy.
"""
