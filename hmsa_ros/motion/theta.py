"""
Places in the parameters that `hmsa_ros.motion.respond` takes, and differentiates by.

After `FIRST_BRANCH` come, `BRANCH` a branch, gamma, tau, the number of its flow and the constants
of that. Beyond all places, constant
i of the law is `CONSTANT` plus i, and the time at which piece m of the levels begins `SWITCH` plus
m. `FRICTION` and `SQUARE` are forces that no motion has, to differentiate by alone: one against
the motion whatever its rate, and one with the square of the rate.
"""

STIFFNESS, DAMPING, DRIVE, FORCE, LAG, STRETCH, RATE, FIRST_BRANCH = range(8)
BRANCH, FLOW, FLOW_CONSTANT = 5, 2, 3
FRICTION, SQUARE, CONSTANT, SWITCH = 400, 401, 500, 1000
