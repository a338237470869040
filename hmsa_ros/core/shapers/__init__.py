"""
Shapers: ways to command one move, in a registry by name.

A shaper takes a `Request` and answers with a `Move`, or refuses with a reason. Everything is
nondimensional; `Units` only words the messages.
"""

from collections.abc import Callable

from hmsa_ros.core.moves import Move
from hmsa_ros.core.shapers.linear import ei, step, zv, zvd
from hmsa_ros.core.shapers.minimax import minimax
from hmsa_ros.core.shapers.minimum_time import minimum_time
from hmsa_ros.core.shapers.request import Request
from hmsa_ros.core.shapers.robust import robust
from hmsa_ros.core.shapers.smooth import smooth
from hmsa_ros.core.shapers.two_step import two_step
from hmsa_ros.errors import BadInputError

Shaper = Callable[[Request], Move]

#: Shapers by name.
SHAPERS: dict[str, Shaper] = {
    'two_step': two_step,
    'robust': robust,
    'minimax': minimax,
    'minimum_time': minimum_time,
    'smooth': smooth,
    'step': step,
    'zv': zv,
    'zvd': zvd,
    'ei': ei,
}


def get_shaper(name: str) -> Shaper:
    """Return the shaper of a name in `SHAPERS`, a `BadInputError` for another."""
    try:
        return SHAPERS[name]
    except KeyError:
        raise BadInputError(
            f'shaper {name!r} is unknown: expected one of {", ".join(SHAPERS)}') from None
