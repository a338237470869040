"""
The equation of motion, compiled when the package is built: C++ templates over any scalar.

``hmsa/*.hpp`` do not use Python and allocate nothing; ``module.cpp`` binds them. Everything is
nondimensional but `respond`, and nothing checks values: whoever calls these functions does.
"""

from hmsa_ros.motion._motion import (
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
    respond,
    rest,
    sample,
    solve,
    staircase,
    trail,
    turning_point,
    two_step,
    two_step_batch,
    two_step_late,
)

__all__ = [
    'accelerations', 'critical_zeta', 'damping', 'elastic_energy', 'elastic_force',
    'elastic_stiffness', 'equilibrium_stretch', 'evaluate', 'flow_rates', 'follow',
    'mass', 'natural_frequency', 'respond', 'rest', 'sample', 'solve', 'staircase', 'trail',
    'turning_point',
    'two_step', 'two_step_batch', 'two_step_late']

#: Statuses of a turning point: found; into an equilibrium instead; out of steps; against a
#: limiting stretch too hard to be resolved. Those of `follow` are the first and the third.
DONE, NO_TURN, STUCK, TOO_CLOSE = range(4)
#: Columns of a branch: gamma, 1/tau, the number of its flow and the constants of that, and where
#: it goes on with the state, what it follows; and how many there are.
RATIO, SPEED, FLOW, FLOW_CONSTANT, FOLLOWER, BRANCH = 0, 1, 2, 3, 5, 6
#: Rows that `sample` writes before what the branches follow.
STRETCH, RATE, FIELD, FOLLOWED = range(4)
