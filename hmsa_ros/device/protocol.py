"""What a device answers, and what hardware may raise."""

from enum import Enum
from typing import NamedTuple

from hmsa_ros.model.equations import Array


class StateLostError(Exception):
    """
    Raised by ``write`` or ``read`` of hardware that has lost its state, as a rebooted board has.

    Its coil is off then, and whatever was commanded is forgotten.
    """


class Change(NamedTuple):
    """A level in T that took effect on a joint, at a time in ns; NaN where it is not known."""

    joint: int
    stamp: int
    level: float


class Sample(NamedTuple):
    """Measurement of all joints: time in ns, stretch, rate in 1/s and flux density in T."""

    time: int
    stretch: Array
    rate: Array
    flux_density: Array


class Kind(Enum):
    """What a notice is about."""

    LATE = 'late'
    SILENT = 'silent'
    HEARD = 'heard'
    REFUSED = 'refused'
    FAILED = 'failed'
    SATURATED = 'saturated'
    LOST = 'lost'
    CLOCK = 'clock'


class Notice(NamedTuple):
    """Something to log, as a sentence; ``late`` is a lateness in ns."""

    kind: Kind
    joint: int
    text: str
    late: int = 0
