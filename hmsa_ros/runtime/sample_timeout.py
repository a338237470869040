"""Detect that samples have stopped."""

from dataclasses import dataclass

from hmsa.model.units import NANOSECONDS
from hmsa_ros.runtime.records import Environment

# Longest gap between samples: in ns by the steady clock, and in sampling intervals.
_PATIENCE, _INTERVALS = 2 * NANOSECONDS, 3


@dataclass
class _LastSample:
    """The newest sample of a joint; times in ns."""

    stamp: int
    came: int  # time of arrival by the steady clock
    time: int  # time of arrival by the clock of the timestamps, which may be paused
    interval: int  # from the previous sample
    silent: bool = False


class SampleTimeout:
    """
    Detect that samples stop while their publisher still exists.

    A publisher that ends normally disappears at once.
    """

    def __init__(self, environment: Environment) -> None:
        self._around = environment
        self._joints: dict[str, _LastSample] = {}

    def restart(self) -> None:
        """Discard all samples."""
        self._joints.clear()

    def record(self, joint: str, stamp: int) -> None:
        """Record the timestamp of the newest sample of a joint."""
        before = self._joints.get(joint)
        self._joints[joint] = _LastSample(
            stamp, self._around.steady(), self._around.clock(),
            0 if before is None else stamp - before.stamp)

    @property
    def words(self) -> str:
        """The joint whose samples have stopped, in a sentence; empty for none."""
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
