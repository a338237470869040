"""
The live view in the terminal.

`listener` gathers from ROS what goes on, into the records of `scene`; `chart` and `screen` show
them as text and know no ROS.
"""
