"""
The running nodes, as text or JSON, and on a web page that operates them.

`listener` collects their state. `server` serves the page to holders of its address, without ROS.
`desk` carries out the commands of the page in the thread of the nodes; it also records and
reports.
"""
