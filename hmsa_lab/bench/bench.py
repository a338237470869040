"""A coil and its sensor on the bench, also simulated ones: levels to apply, and their results."""

from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
import math
from threading import Event, Lock, Thread
from time import monotonic, sleep, time_ns
from typing import Any, NamedTuple

import numpy as np

from hmsa.errors import BadInputError, HmsaError
from hmsa.model.actuators import Setup
from hmsa.model.equations import Array
from hmsa.model.parameters import paper_actuator
from hmsa.model.sensor import Sample, SensorErrors
from hmsa.model.units import NANOSECONDS
from hmsa_ros.device.coil import Coil, HardwareJoint
from hmsa_ros.device.hardware import Calls, load
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.device.watchdog import Change, Fallback
from hmsa_ros.device.worker import HardwareDevice, HardwareWorker

# In s: lead time of levels, interval of heartbeats, silence after which the coil is cut off, limit
# for the start, and sleeping time of a waiting loop.
LEAD, _BEAT, SILENCE, _START, _LOOK = 0.1, 0.05, 1.0, 10.0, 2e-3
# Number of further waits for a level that has not been set.
_PATIENCE = 10
# Sampling period in ns, and number of samples stored for a probe.
_PERIOD, _KEPT = 1_000_000, 100_000
# Fields for `SimulatedProbe`, with their times in ns.
_FIELDS: deque[tuple[float, float, int]] = deque(maxlen=_KEPT)


class PhaseResults(NamedTuple):
    """Results of a phase."""

    changes: list[Change]
    samples: list[Sample]
    asked: list[tuple[int, float]]

    def joined(self, more: 'PhaseResults') -> 'PhaseResults':
        """Return the results of this phase and a later one together."""
        return PhaseResults(
            self.changes + more.changes, self.samples + more.samples, self.asked + more.asked)

    @property
    def stretch(self) -> Array:
        """Stretch of the samples, without NaN."""
        found = np.array([x.stretch[0] for x in self.samples])
        finite: Array = found[np.isfinite(found)]
        return finite


class Bench:
    """
    Hardware of one joint, with a commander that repeats the last level as a planner does.

    A context manager: the coil is off at the end in any case.

    Parameters
    ----------
    name : str
        ``MODULE:NAME``, or a class shipped with the package.
    settings : mapping
        Keyword arguments of the class.
    limit : float
        Largest flux density in T.
    rate : float
        Sampling rate in Hz; 0 for no samples.
    joint : str
        Joint name passed to the class.
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
        #: Oversleeping of the host in s, for each wait.
        self.slept: list[float] = []
        #: Whether heartbeats are sent.
        self.beats = True
        self.worker = HardwareWorker(lambda: HardwareDevice(
            [HardwareJoint(load(name, joint, settings), limit, Fallback(SILENCE, 'zero'))],
            time=time_ns(), period=round(NANOSECONDS / rate) if rate else 0, calls=calls), time_ns)
        if not self.worker.started(_START):
            raise HmsaError(
                f'the hardware has not started within {_START:g} s, or its first write has not '
                'returned: expected hardware that does')
        # The newest command, which is repeated as a heartbeat.
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
        """The coil of the joint."""
        return self.worker.device.coils[0]

    def _beat(self) -> None:
        while not self._over.wait(_BEAT):
            # Failed hardware refuses all commands.
            with self._turn, suppress(BadInputError):
                if self.beats:
                    self.worker.receive(0, *self._newest)
            self.worker.look_after()

    def run(self, seconds: float, levels: Sequence[float] = ()) -> PhaseResults:
        """Wait, with levels in T spread over the time; the last one stays."""
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
        return PhaseResults(self.worker.device.changes(), self.worker.device.samples(), asked)

    def hold(self, seconds: float, levels: Sequence[float]) -> PhaseResults:
        """Run until the last level is set; raise `HmsaError` if that fails."""
        seen = self.run(seconds, levels)
        for _ in range(_PATIENCE):
            if failure := self.worker.failure or self.worker.trouble:
                raise HmsaError(str(failure))
            if not levels or self.coil.asked == levels[-1]:
                return seen
            if self.coil.is_cut_off:
                # The host stood still for longer than the watchdog waits: begin again.
                with self._turn:
                    self._newest = (0, 0.0)
                    self.worker.receive(0, *self._newest)
                seen = self.run(seconds, levels)
            else:
                seen = seen.joined(self.run(max(seconds, LEAD)))
        raise HmsaError(
            f'{self.name} has not set {levels[-1]:g} T: expected that within a second; see hmsa '
            'check-driver')


def matched(seen: PhaseResults) -> list[tuple[Change, tuple[int, float]]]:
    """Return pairs of change and requested level: the first change in the level's time."""
    found, changes = [], list(seen.changes)
    for i, (stamp, level) in enumerate(seen.asked):
        until = seen.asked[i + 1][0] if i + 1 < len(seen.asked) else math.inf
        near = [x for x in changes if stamp - 5e6 <= x.stamp < until]
        if near:
            found.append((near[0], (stamp, level)))
            changes.remove(near[0])
    return found


class SimulatedBench:
    """
    Hardware that applies scheduled levels; times in s.

    Parameters
    ----------
    joint : str
        Joint name.
    transport, lag, latency : float
        Delay and first-order lag of the field, and lateness of the timestamps of samples.
    noise : float
        Standard deviation of a stretch sample.

    """

    def __init__(
            self, joint: str, transport: float = 5e-4, lag: float = 5e-4, latency: float = 2e-3,
            noise: float = 1e-3) -> None:
        self.description = 'simulated'
        self._transport, self._latency = (
            round(x * NANOSECONDS) for x in (transport, latency))
        self._device = SimulatedDevice(
            [SimulatedJoint(
                Setup(paper_actuator(), coil_time_constant=lag),
                errors=SensorErrors(stretch_noise=noise))],
            period=_PERIOD, time=time_ns(), measurement_delay=self._latency)
        _FIELDS.clear()

    def schedule(self, levels: list[tuple[int, float]]) -> None:
        """Schedule levels."""
        for stamp, level in levels:
            self._device.receive(0, stamp + self._transport, level)

    def write(self, level: float, now: int) -> int:
        """Set a level now."""
        self._device.receive(0, now + self._transport, level)
        return now

    def read(self, now: int) -> list[tuple[float, float, int]]:
        """Return the samples that have arrived."""
        self._device.advance(now)
        samples = self._device.samples()
        _FIELDS.extend((float(x.flux_density[0]), math.nan, x.time) for x in samples)
        return [(float(x.stretch[0]), math.nan, x.time + self._latency) for x in samples]


class SimulatedProbe:
    """A probe in the coil of the simulated bench."""

    def read(self) -> list[tuple[float, float, int]]:
        """Return field in T, NaN, and time in ns of each sample since the last call."""
        return [_FIELDS.popleft() for _ in range(len(_FIELDS))]
