"""
The actuator: parameters, hyperelastic model, equations and motion; does not depend on ROS.

All quantities are dimensionless as in the paper (Eq. 11) unless a name says otherwise.
"""
