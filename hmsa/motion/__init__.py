"""
The equation of motion, compiled when the package is built: C++ templates over any scalar type.

``hmsa/*.hpp`` do not use Python and allocate no memory; ``motion.cpp`` and ``derivatives.cpp``
bind them. All quantities are dimensionless except in `hmsa.motion.derivatives`, and values are
not checked: callers do that.
"""

from hmsa.motion._motion import (
    accelerations,
    critical_zeta,
    damping,
    elastic_energy,
    elastic_force,
    elastic_stiffness,
    equilibrium_stretch,
    evaluate,
    flow_rates,
    follow,
    mass,
    natural_frequency,
    sample,
    smooth,
    solve,
    staircase,
    subset_inverses,
    subsets,
    trail,
    turning_point,
    two_step,
    two_step_batch,
    two_step_late,
)

__all__ = [
    'accelerations', 'critical_zeta', 'damping', 'elastic_energy', 'elastic_force',
    'elastic_stiffness', 'equilibrium_stretch', 'evaluate', 'flow_rates', 'follow',
    'mass', 'natural_frequency', 'sample', 'smooth', 'solve', 'staircase',
    'subset_inverses', 'subsets', 'trail', 'turning_point', 'two_step', 'two_step_batch',
    'two_step_late']

#: Statuses of a turning point: found; approach to an equilibrium instead; out of steps; too close
#: to a limiting stretch to be resolved. Those of `follow` are the first and the third.
DONE, NO_TURN, STUCK, TOO_CLOSE = range(4)
#: Columns of a branch: gamma, 1/tau, number and constants of its flow rule, and the force that it
#: has followed, from which it continues; last, the number of columns.
RATIO, SPEED, FLOW, FLOW_CONSTANT, FOLLOWER, BRANCH = 0, 1, 2, 3, 5, 6
#: Maximum number of rows of branches and secondary modes of an actuator.
ROWS = 9
#: Rows that `sample` writes before those of the branch states.
STRETCH, RATE, FIELD, FOLLOWED = range(4)
