"""A coil and its sensor on the bench: levels handed over, and what comes of them."""

from collections.abc import Callable, Sequence
import math
from time import monotonic, sleep, time_ns
from typing import NamedTuple

import numpy as np

from hmsa_ros.device.hardware import Hardware
from hmsa_ros.device.protocol import Change, Sample
from hmsa_ros.device.worker import lone_worker
from hmsa_ros.model.equations import Array
from hmsa_ros.model.units import NANOSECONDS

# In s: how far ahead levels are handed over, between signs of life, silence after which the coil
# is cut off, and how often events are looked at.
LEAD, _BEAT, SILENCE, _LOOK = 0.1, 0.05, 0.5, 2e-3


class Seen(NamedTuple):
    """What came of a phase."""

    changes: list[Change]
    samples: list[Sample]
    asked: list[tuple[int, float]]

    def joined(self, more: 'Seen') -> 'Seen':
        """Return this phase and a later one as one."""
        return Seen(
            self.changes + more.changes, self.samples + more.samples, self.asked + more.asked)

    @property
    def stretch(self) -> Array:
        """Stretch of the samples that have one."""
        found = np.array([x.stretch[0] for x in self.samples])
        finite: Array = found[np.isfinite(found)]
        return finite


class Bench:
    """A worker with one joint, and a commander that repeats the last level as a planner does."""

    def __init__(self, make: Callable[[], Hardware], limit: float, rate: float) -> None:
        self._rate = rate
        #: How late in s the host wakes whoever sleeps.
        self.slept: list[float] = []
        self.worker = lone_worker(make, limit, rate, SILENCE)
        # The newest command, which is repeated as a sign of life, and when next.
        self._newest, self._beat = (0, 0.0), 0.0

    def run(self, seconds: float, levels: Sequence[float] = (), *, beat: bool = True) -> Seen:
        """Let time pass; hand over levels in T, spread over it, and repeat the last in between."""
        begin, seen = time_ns() + round(LEAD * NANOSECONDS), Seen([], [], [])
        apart = seconds / max(len(levels), 1)
        for i, level in enumerate(levels):
            stamp = begin + round(i * apart * NANOSECONDS)
            self.worker.receive(0, stamp, level)
            seen.asked.append((stamp, level))
            self._newest = stamp, level
        until = monotonic() + seconds + (LEAD if levels else 0.0)
        while monotonic() < until and self.worker.failure is None:
            if beat and monotonic() > self._beat:
                self._beat = monotonic() + _BEAT
                self.worker.receive(0, *self._newest)
            begun = monotonic()
            sleep(_LOOK)
            self.slept.append(monotonic() - begun - _LOOK)
            self.worker.look_after()
            self._collect(seen)
        self._collect(seen)
        return seen

    def hold(self, seconds: float, levels: Sequence[float]) -> Seen:
        """Run; raise `HmsaError` where the hardware fails."""
        seen = self.run(seconds, levels)
        if self.worker.failure is not None:
            raise self.worker.failure
        return seen

    def _collect(self, seen: Seen) -> None:
        seen.changes.extend(self.worker.changes())
        seen.samples.extend(self.worker.samples())


def matched(seen: Seen) -> list[tuple[Change, tuple[int, float]]]:
    """Return which change belongs to which level asked for: the first one in its time."""
    found, changes = [], list(seen.changes)
    for i, (stamp, level) in enumerate(seen.asked):
        until = seen.asked[i + 1][0] if i + 1 < len(seen.asked) else math.inf
        near = [x for x in changes if stamp - 5e6 <= x.stamp < until]
        if near:
            found.append((near[0], (stamp, level)))
            changes.remove(near[0])
    return found
