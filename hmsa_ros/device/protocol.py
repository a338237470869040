"""What a device answers."""

from enum import Enum
from typing import NamedTuple

from hmsa_ros.core.model import Array


class Change(NamedTuple):
    """A level in T that took effect on a joint, at a time in ns."""

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


class Notice(NamedTuple):
    """Something to log, as a sentence; ``late`` is a lateness in ns."""

    kind: Kind
    joint: int
    text: str
    late: int = 0
