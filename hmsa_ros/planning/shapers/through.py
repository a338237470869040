"""A move that takes a given time: levels of equal duration, solved for rest at the target."""

import numpy as np

from hmsa_ros.model.moves import Level, Move
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.planning.shapers.request import Request
from hmsa_ros.planning.shooting import solve, Template


def through(request: Request, duration: float) -> Move:
    """
    Plan levels, each as long as the others, from any state to rest after a duration.

    There are two levels and the holding one, and three before it where the field lags. Where the
    limits have no such move: `RefusedError`.
    """
    holding = request.holding_load()
    count = 3 if request.delivery.lag > 0.0 else 2
    edges = duration / count * np.arange(count + 1)
    period = request.delivery.period
    if period > 0.0:
        edges = period * np.round(edges / period)
    found = None
    if np.all(np.diff(edges) > 0.0):
        found = solve(Template.of(
            [Level(float(x), holding) for x in edges], [('load', i) for i in range(count)]),
            request)
    if found is None or not request.keeps(found[0]):
        raise RefusedError(
            Code.NOT_CONVERGED,
            f'no {count} levels of equal duration lead to {request.named_target} in '
            f'{request.units.time_text(duration)}: expected more time')
    return Move(Code.MINIMUM_TIME, found[0], found[1])
