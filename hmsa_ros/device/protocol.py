"""Records returned by a device, and an exception for hardware."""

from enum import Enum
from typing import NamedTuple


class StateLostError(Exception):
    """
    Raised by ``write`` or ``read`` of hardware that has lost its state, such as a rebooted board.

    Its coil is off then, and all earlier commands are discarded.
    """


class Change(NamedTuple):
    """A level in T that took effect on a joint at a time in ns; NaN if unknown."""

    joint: int
    stamp: int
    level: float


class Kind(Enum):
    """Subject of a notice."""

    LATE = 'late'
    SILENT = 'silent'
    HEARD = 'heard'
    REFUSED = 'refused'
    FAILED = 'failed'
    SATURATED = 'saturated'
    LOST = 'lost'
    CLOCK = 'clock'


class Notice(NamedTuple):
    """A message to log; ``late`` is a lateness in ns."""

    kind: Kind
    joint: int
    text: str
    late: int = 0
