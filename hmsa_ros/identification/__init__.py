"""
The parameters of an actuator out of a recording of its motion.

`identify.identify` takes a `recording.Recording` and returns a frozen `result.Identification`.
Nothing here needs ROS.
"""
