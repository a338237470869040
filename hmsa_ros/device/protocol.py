"""What is asked of a device, and what it answers."""

from enum import Enum
from typing import NamedTuple, Protocol

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
    FAILED = 'failed'


class Notice(NamedTuple):
    """Something to log, as a sentence; ``late`` is a lateness in ns."""

    kind: Kind
    joint: int
    text: str
    late: int = 0


class Device(Protocol):
    """
    Actuators with their amplifiers and sensors.

    Whoever drives it says what time it is, and collects what came of it. `changes`, `samples` and
    `notices` return what is new since they were last called, in the order in which it happened.
    """

    @property
    def time(self) -> int:
        """Time in ns that it has been advanced to."""

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """
        Take a level, which supersedes all that are stamped at or after it.

        Parameters
        ----------
        joint : int
            Its place.
        stamp : int
            Time in ns from which it applies, 0 for at once.
        level : float
            In T; one that cannot be obeyed is refused with `BadInputError`.

        """

    def advance(self, time: int) -> None:
        """Do what is due up to a time in ns."""

    def changes(self) -> list[Change]:
        """Return which levels took effect."""

    def samples(self) -> list[Sample]:
        """Return what was measured."""

    def notices(self) -> list[Notice]:
        """Return what there is to log."""


class Outbox:
    """Keeps what came of a device until it is collected."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._changes: list[Change] = []
        self._samples: list[Sample] = []
        self._notices: list[Notice] = []

    def changes(self) -> list[Change]:
        """Return which levels took effect since the last call."""
        found, self._changes = self._changes, []
        return found

    def samples(self) -> list[Sample]:
        """Return what was measured since the last call."""
        found, self._samples = self._samples, []
        return found

    def notices(self) -> list[Notice]:
        """Return what there is to log since the last call."""
        found, self._notices = self._notices, []
        return found
