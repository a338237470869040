"""
Recordings: MCAP bags as rosbag2 (Jazzy) lays them out.

Reading and writing need no running ROS graph and do not import rclpy.
"""
