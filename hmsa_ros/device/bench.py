"""A coil and its sensor on the bench: levels handed over, and what comes of them."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
import math
from threading import Event, Lock, Thread
from time import monotonic, sleep, time_ns
from typing import Any, NamedTuple

import numpy as np

from hmsa_ros.device.coil import Coil, HardwareJoint
from hmsa_ros.device.driven import HardwareDevice
from hmsa_ros.device.hardware import Calls, load
from hmsa_ros.device.protocol import Change, Sample
from hmsa_ros.device.watchdog import Fallback
from hmsa_ros.device.worker import HardwareWorker
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.model.equations import Array
from hmsa_ros.model.units import NANOSECONDS

# In s: how far ahead levels are handed over, between signs of life, silence after which the coil
# is cut off, the longest start, and how long whoever waits sleeps.
LEAD, _BEAT, SILENCE, _START, _LOOK = 0.1, 0.05, 1.0, 10.0, 2e-3
# How often a level that has not been set is waited for.
_PATIENCE = 10


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
    """
    Hardware of one joint, and a commander that repeats the last level as a planner does.

    A context manager: the coil is off at the end, however that comes.

    Parameters
    ----------
    name : str
        ``MODULE:NAME``, or one that is shipped.
    settings : mapping
        Its keyword arguments.
    limit : float
        Largest flux density in T.
    rate : float
        Rate in Hz at which it is read; 0 for never.
    joint : str
        Name it is called with.
    calls : Calls, optional
        Limits and times the calls of hardware.

    Raises
    ------
    HmsaError
        If it does not start.

    """

    def __init__(
            self, name: str, settings: Mapping[str, Any], limit: float, rate: float,
            joint: str = 'actuator', calls: Calls | None = None) -> None:
        self.name = name
        #: How late in s the host wakes whoever sleeps.
        self.slept: list[float] = []
        #: Whether signs of life are given.
        self.beats = True
        self.worker = HardwareWorker(lambda: HardwareDevice(
            [HardwareJoint(load(name, joint, settings), limit, Fallback(SILENCE, 'zero'))],
            time=time_ns(), period=round(NANOSECONDS / rate) if rate else 0, calls=calls), time_ns)
        if not self.worker.started(_START):
            raise HmsaError(
                f'the hardware has not started within {_START:g} s, or its first write not '
                'returned: expected one that does')
        # The newest command, which is repeated as a sign of life.
        self._newest, self._turn = (0, 0.0), Lock()
        self._over = Event()
        self._beating = Thread(target=self._beat, name='beat', daemon=True)
        self._beating.start()

    def __enter__(self) -> 'Bench':
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._beating.join()
        self.worker.close()

    @property
    def coil(self) -> Coil:
        """What is known of the coil."""
        return self.worker.device.coils[0]

    def _beat(self) -> None:
        while not self._over.wait(_BEAT):
            # What has failed refuses all.
            with self._turn, suppress(BadInputError):
                if self.beats:
                    self.worker.receive(0, *self._newest)
            self.worker.look_after()

    def run(self, seconds: float, levels: Sequence[float] = ()) -> Seen:
        """Let time pass, with levels in T spread over it; the last one stays."""
        begin, apart = time_ns() + round(LEAD * NANOSECONDS), seconds / max(len(levels), 1)
        asked = [(begin + round(i * apart * NANOSECONDS), x) for i, x in enumerate(levels)]
        with self._turn:
            for self._newest in asked:
                self.worker.receive(0, *self._newest)
        until = monotonic() + seconds + (LEAD if levels else 0.0)
        while monotonic() < until and self.worker.failure is None:
            begun = monotonic()
            sleep(_LOOK)
            self.slept.append(monotonic() - begun - _LOOK)
        return Seen(self.worker.device.changes(), self.worker.device.samples(), asked)

    def hold(self, seconds: float, levels: Sequence[float]) -> Seen:
        """Run, longer where the last level comes late; raise `HmsaError` if it fails."""
        seen = self.run(seconds, levels)
        for _ in range(_PATIENCE):
            if failure := self.worker.failure or self.worker.trouble:
                raise HmsaError(str(failure))
            if not levels or self.coil.asked == levels[-1]:
                return seen
            seen = seen.joined(self.run(max(seconds, LEAD)))
        raise HmsaError(
            f'{self.name} has not set {levels[-1]:g} T: expected that within a second; see hmsa '
            'check-driver')


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
