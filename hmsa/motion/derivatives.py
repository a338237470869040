"""
Motion with derivatives by its parameters, and the indices of these parameters.

From `FIRST_BRANCH` on, each branch has `BRANCH` values: gamma, tau, number of its flow rule and
its constants. Then each secondary mode has `MODE` values: its frequency ratio, share, damping
ratio, and the exponents of the stretch with which ratio and share grow. `EXPONENT` is that with
which the damping of a block grows. Beyond all indices, constant i of the hyperelastic model is
`CONSTANT` plus i, and the start time of piece m of the levels is `SWITCH` plus m. `FRICTION` and
`SQUARE` are forces that are zero in every motion and only serve differentiation: one against the
motion at any rate, and one with the square of the rate.
"""

from hmsa.motion._derivatives import respond, rest

__all__ = ['respond', 'rest']

STIFFNESS, DAMPING, DRIVE, FORCE, LAG, STRETCH, RATE, EXPONENT, FIRST_BRANCH = range(9)
BRANCH, FLOW, FLOW_CONSTANT, MODE = 5, 2, 3, 5
FRICTION, SQUARE, CONSTANT, SWITCH = 400, 401, 500, 1000
