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
    follow,
    mass,
    natural_frequency,
    respond,
    rest,
    sample,
    solve,
    staircase,
    turning_point,
    two_step,
    two_step_batch,
    two_step_late,
)

__all__ = [
    'accelerations', 'critical_zeta', 'damping', 'elastic_energy', 'elastic_force',
    'elastic_stiffness', 'equilibrium_stretch', 'evaluate', 'follow', 'mass',
    'natural_frequency', 'respond', 'rest', 'sample', 'solve', 'staircase', 'turning_point',
    'two_step', 'two_step_batch', 'two_step_late']

#: Statuses of a turning point: found; into an equilibrium instead; out of steps; against a
#: limiting stretch too hard to be resolved. Those of `follow` are the first and the third.
DONE, NO_TURN, STUCK, TOO_CLOSE = range(4)
#: Columns of a branch: gamma, 1/tau and, where it goes on with the state, what it follows.
RATIO, SPEED, FOLLOWER = range(3)
#: Rows that `sample` writes before what the branches follow.
STRETCH, RATE, FIELD, FOLLOWED = range(4)
