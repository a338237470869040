"""
Identification of the parameters of an actuator from a recording of its motion.

`identify.identify` takes a `recording.Recording` and returns a frozen `result.Identification`.
The package does not depend on ROS.
"""
