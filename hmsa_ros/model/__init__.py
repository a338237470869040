"""
The actuator: its parameters and law, its equations and its motion, free of ROS.

All quantities are dimensionless as in the paper (Eq. 11) unless a name says otherwise.
"""
