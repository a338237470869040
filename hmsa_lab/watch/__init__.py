"""
Showing running nodes.

`listener` collects data from ROS into the records of `scene`, which does not depend on ROS.
"""
