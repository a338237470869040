"""
Reports of runs, as pages and figures.

`evaluation` computes the results of a run, `page` and `picture` show them. No module needs ROS.
"""
