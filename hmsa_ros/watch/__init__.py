"""
The live view in the terminal.

`listener` collects data from ROS into the records of `scene`. `screen` formats them as text and
does not depend on ROS.
"""
