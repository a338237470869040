"""
A web page to operate the running nodes.

`server` serves the page to holders of its address, without ROS. `desk` carries out the commands of
the page in the thread of the nodes; it also records and reports.
"""
