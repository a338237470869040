"""
Places in the parameters that `hmsa_ros.motion.respond` takes, and differentiates by.

After `FIRST_BRANCH` come gamma and tau of each Maxwell branch in turn. Beyond all places, constant
i of the law is `CONSTANT` plus i, and the time at which piece m of the levels begins `SWITCH` plus
m.
"""

STIFFNESS, DAMPING, DRIVE, FORCE, LAG, STRETCH, RATE, FIRST_BRANCH = range(8)
CONSTANT, SWITCH = 500, 1000
