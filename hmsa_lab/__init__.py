"""
Work at a bench: boards and supplies, calibration, tuning, and what shows running nodes.

It builds on ``hmsa`` and ``hmsa_ros``, and neither needs it.
"""
