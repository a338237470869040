"""
Shapers, which command one move, in a registry by name.

A shaper takes a `MoveRequest` and returns a `Move`, whose first level is at time 0, or raises
`RefusedError` with a reason. All quantities are dimensionless: a time in s is divided by
``request.units.time``, and else `Units` only format the messages.
"""

import math

from hmsa.errors import check_choice
from hmsa.planning.shapers.linear import ei, step, umzv, zv, zvd
from hmsa.planning.shapers.minimax import minimax
from hmsa.planning.shapers.minimum_time import minimum_time
from hmsa.planning.shapers.modal import modal
from hmsa.planning.shapers.request import advised, Shaper
from hmsa.planning.shapers.robust import robust
from hmsa.planning.shapers.smooth import smooth
from hmsa.planning.shapers.two_step import two_step

#: Shapers by name.
SHAPERS: dict[str, Shaper] = {
    'two_step': advised(two_step),
    # These find a plan whenever two_step does.
    **{x.__name__: advised(x, sooner=two_step) for x in (robust, minimax)},
    'minimum_time': advised(minimum_time),
    'modal': advised(modal),
    # A failed search for a path takes long: advise which limits to relax, but not by how much.
    'smooth': advised(smooth, (math.inf,)),
    **{x.__name__: x for x in (step, zv, zvd, ei, umzv)},
}


def get_shaper(name: str) -> Shaper:
    """Return a shaper by its name in `SHAPERS`; raise `BadInputError` for another name."""
    check_choice('shaper', name, SHAPERS)
    return SHAPERS[name]
