"""
Studies: what the plans are worth away from their assumptions, and plans over whole ranges.

Everything here is nondimensional and imports no ROS. ``python -m hmsa_studies`` makes the
tables and pictures of the documentation.
"""
