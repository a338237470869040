"""
Pictures: the paper's figures from this package's own computation, and the picture of a run.

No ROS here. matplotlib is imported by this package alone.
"""
