"""
Places in the parameters that `hmsa_ros.motion.respond` takes, and differentiates by.

After `FIRST_BRANCH` come gamma and tau of each Maxwell branch in turn. Beyond all places, constant
i of the law is `CONSTANT` plus i, and the time at which piece m of the levels begins `SWITCH` plus
m. `FRICTION` and `SQUARE` are forces that no motion has, to differentiate by alone: one against
the motion whatever its rate, and one with the square of the rate.
"""

STIFFNESS, DAMPING, DRIVE, FORCE, LAG, STRETCH, RATE, FIRST_BRANCH = range(8)
FRICTION, SQUARE, CONSTANT, SWITCH = 400, 401, 500, 1000
