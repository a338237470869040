"""Samples that came before and do not come any more."""

from dataclasses import dataclass

from hmsa_ros.control.surroundings import Surroundings
from hmsa_ros.model.units import NANOSECONDS

# How long samples may stay away: in ns by the steady clock, and in intervals between them.
_PATIENCE, _INTERVALS = 2 * NANOSECONDS, 3


@dataclass
class _Joint:
    """The newest sample of a joint; times in ns."""

    stamp: int
    came: int  # by the steady clock
    time: int  # the same by the clock of the timestamps, which may stand still
    interval: int  # to the sample looked at before
    silent: bool = False


class Silence:
    """
    Notices that samples cease while somebody is still there who publishes them.

    A publisher that ends in order is gone at once.
    """

    def __init__(self, surroundings: Surroundings) -> None:
        self._around = surroundings
        self._joints: dict[str, _Joint] = {}

    def restart(self) -> None:
        """Forget all samples."""
        self._joints.clear()

    def heard(self, joint: str, stamp: int) -> None:
        """Take in that a sample has come that is the newest of a joint."""
        before = self._joints.get(joint)
        self._joints[joint] = _Joint(
            stamp, self._around.steady(), self._around.clock(),
            0 if before is None else stamp - before.stamp)

    @property
    def words(self) -> str:
        """Of which joint no samples come any more, in a sentence; empty for none."""
        steady, now = self._around.steady(), self._around.clock()
        for name, joint in self._joints.items():
            if not joint.silent and steady - joint.came > _PATIENCE and (
                    now - joint.time > _INTERVALS * joint.interval):
                joint.silent = self._around.observable()
            if joint.silent:
                return (
                    f'no sample of joint {name} for more than {_PATIENCE / NANOSECONDS:g} s, '
                    'though samples came before: its sensor has failed, or cannot be reached')
        return ''
