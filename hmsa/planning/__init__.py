"""
Plans without residual vibration: the two-step command, shapers, sequences and their timeline.

Like the model, it is dimensionless unless a name says otherwise, and does not depend on ROS.
"""
