"""
A page in the browser to drive the running nodes.

`server` gives the page to whoever knows its address, without ROS; `desk` carries out what the
page asks for, in the thread that holds the nodes; `recording` records and reports.
"""
