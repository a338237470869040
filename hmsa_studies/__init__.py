"""
Studies of the plans outside their assumptions, and plans over whole parameter ranges.

All quantities are dimensionless, and the package does not depend on ROS. ``python -m
hmsa_studies`` prints the tables of the documentation and draws its figures.
"""
