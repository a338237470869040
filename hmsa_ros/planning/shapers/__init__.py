"""
Shapers: ways to command one move, in a registry by name.

A shaper takes a `Request` and answers with a `Move`, or refuses with a reason. Everything is
nondimensional; `Units` only words the messages.
"""

import math

from hmsa_ros.errors import BadInputError
from hmsa_ros.planning.shapers.advice import advised
from hmsa_ros.planning.shapers.linear import ei, step, zv, zvd
from hmsa_ros.planning.shapers.minimax import minimax
from hmsa_ros.planning.shapers.minimum_time import minimum_time
from hmsa_ros.planning.shapers.request import Shaper
from hmsa_ros.planning.shapers.robust import robust
from hmsa_ros.planning.shapers.smooth import smooth
from hmsa_ros.planning.shapers.two_step import two_step
from hmsa_ros.planning.shapers.umzv import umzv

#: Shapers by name.
SHAPERS: dict[str, Shaper] = {
    'two_step': advised(two_step),
    # They plan wherever two_step does.
    **{x.__name__: advised(x, sooner=two_step) for x in (robust, minimax)},
    'minimum_time': advised(minimum_time),
    # Whose search for a path that is not there takes long: what to ease, but not how much.
    'smooth': advised(smooth, (math.inf,)),
    **{x.__name__: x for x in (step, zv, zvd, ei, umzv)},
}


def get_shaper(name: str) -> Shaper:
    """Return the shaper of a name in `SHAPERS`, a `BadInputError` for another."""
    try:
        return SHAPERS[name]
    except KeyError:
        raise BadInputError(
            f'shaper {name!r} is unknown: expected one of {", ".join(SHAPERS)}') from None
