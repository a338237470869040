"""
What happened in a run: read from a bag, evaluated, and shown as a page or a picture.

`reading` turns a bag into arrays, `evaluation` measures them, `page` and `picture` show them.
None of it needs ROS.
"""
