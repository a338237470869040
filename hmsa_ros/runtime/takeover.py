"""The state in force, waited for before the first command."""

from collections.abc import Collection
from dataclasses import dataclass
import math


@dataclass(frozen=True)
class Sample:
    """Stretch, rate in 1/s and flux density in force in T at a stamp in ns."""

    stamp: int
    stretch: float
    rate: float
    flux_density: float

    @property
    def complete(self) -> bool:
        """Whether everything was measured."""
        return math.isfinite(self.stretch + self.rate + self.flux_density)


class Observations:
    """
    The newest sample of each joint.

    Parameters
    ----------
    joints : collection of str
        Those that count.

    """

    def __init__(self, joints: Collection[str]) -> None:
        """Begin with none."""
        self._joints = frozenset(joints)
        self._newest: dict[str, Sample] = {}

    def add(self, joint: str, sample: Sample) -> None:
        """Take in a sample; one of another joint, or with a gap, does not count."""
        if joint in self._joints and sample.complete:
            self._newest[joint] = sample

    def clear(self) -> None:
        """Forget them, as after a jump of the clock."""
        self._newest.clear()

    def fresh(self, now: int, max_age: int) -> dict[str, Sample]:
        """Return by joint the samples that are not older than an age; times in ns."""
        return {
            joint: x for joint, x in self._newest.items() if abs(now - x.stamp) <= max_age}
