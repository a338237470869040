"""
Physics and planning of the actuator, free of ROS.

Imports the standard library, NumPy, SciPy and `hmsa_ros.motion` only.
"""
