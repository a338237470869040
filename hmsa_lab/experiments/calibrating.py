"""Guided runs on a bench: delays of field and samples, and a slow staircase of levels."""

from collections.abc import Callable, Sequence
import math
from threading import Event, Thread
from time import time_ns
from typing import Any

import numpy as np

from hmsa.errors import HmsaError
from hmsa.identification.delays import Delays, delays, field_delays
from hmsa.identification.measurement import Measurement
from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import NANOSECONDS
from hmsa_lab.bench.bench import Bench, LEAD, matched, PhaseResults
from hmsa_lab.bench.calibration import loop
from hmsa_ros.device.hardware import described, readings

CalibrationProgress = Callable[[str, float], None]
# Duration of levels in periods of the actuator, and minimum in s.
_PERIODS, _SHORTEST = (0.8, 1.6), 0.12
# Ranges of levels as fractions of the limit, used alternately.
_HIGH, _LOW = (0.6, 1.0), (-0.4, 0.2)
# Time in s between readings of a non-blocking probe.
_PAUSE = 2e-4
# Number of further waits for samples at a level.
_PATIENCE = 10


class _Reader:
    """Read a probe continuously in a thread; times in ns, field in T."""

    def __init__(self, probe: Any) -> None:
        self._probe, self._over = probe, Event()
        self.seen: list[tuple[int, float]] = []
        self.failure = ''
        self._thread = Thread(target=self._work, name='probe', daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while not self._over.wait(_PAUSE):
            begun = time_ns()
            try:
                answer = self._probe.read()
                middle = (begun + time_ns()) // 2
                self.seen += [(middle if x.stamp is None else x.stamp, x.stretch)
                              for x in readings(answer)]
            except BaseException as error:  # any error of the laboratory's class
                self.failure = f'{type(self._probe).__name__}.read raised {described(error)}'
                return

    def close(self) -> Array:
        """Stop; return the readings, shape (n, 2); raise `HmsaError` if the probe failed."""
        self._over.set()
        self._thread.join()
        if self.failure:
            raise HmsaError(self.failure)
        found: Array = np.array(self.seen, dtype=np.float64).reshape(-1, 2)
        return found


def steps_of(actuator: ActuatorParameters, limit: float, count: int) -> list[tuple[float, float]]:
    """Return levels in T with durations in s that cover all phases of the samples."""
    random, period = np.random.default_rng(0), actuator.period
    return [(limit * random.uniform(*(_LOW if i % 2 else _HIGH)),
             max(period * random.uniform(*_PERIODS), _SHORTEST * random.uniform(1.0, 1.5)))
            for i in range(count)]


def measure_delays(
        bench: Bench, steps: Sequence[tuple[float, float]], probe: Any,
        actuator: ActuatorParameters, lag: float | None, progress: CalibrationProgress) -> Delays:
    """
    Step through levels, and determine transport delay, lag and latency.

    Parameters
    ----------
    bench : Bench
        Bench with the hardware.
    steps : sequence of (float, float)
        Levels in T, and their durations in s.
    probe : object or None
        Has ``read``, which returns a field in T, or a list of (field in T, NaN, time in ns).
    actuator : ActuatorParameters
        Approximate parameters.
    lag : float or None
        Known lag of the field in s.
    progress : callable
        Called with the current activity and the completed fraction.

    Returns
    -------
    Delays
        The delays, as far as they can be separated.

    Raises
    ------
    HmsaError
        If hardware or probe fail, or the recording is insufficient.

    """
    seen = PhaseResults([], [], [])
    reader = None if probe is None else _Reader(probe)
    try:
        for i, (level, seconds) in enumerate(steps):
            progress(f'{level:.3g} T', i / len(steps))
            seen = seen.joined(bench.hold(seconds, [level]))
    finally:
        field_seen = np.zeros((0, 2)) if reader is None else reader.close()
    progress('evaluating', 1.0)
    pairs = matched(seen)
    samples = {x.time: float(x.stretch[0]) for x in seen.samples if math.isfinite(x.stretch[0])}
    if not samples or len(pairs) < len(steps):
        raise HmsaError(
            f'{bench.name} gave {len(samples)} samples and set {len(pairs)} of {len(steps)} '
            'levels: expected a sensor, and all levels; see hmsa check-driver')
    zero = min(*samples, *(x.stamp for x, _ in pairs)) - NANOSECONDS

    def seconds_of(times: Any) -> Array:
        found: Array = (np.asarray(times, dtype=np.int64) - zero) / NANOSECONDS
        return found

    begins, levels = seconds_of([x.stamp for x, _ in pairs]), np.array([x.level for x, _ in pairs])
    times = sorted(samples)
    return delays(
        Measurement(
            seconds_of(times), np.array([samples[x] for x in times]), np.append(0.0, begins),
            np.append(0.0, levels), label=bench.name),
        np.append(math.nan, seconds_of([stamp for _, (stamp, _) in pairs])),
        None if reader is None else field_delays(
            seconds_of(field_seen[:, 0]), field_seen[:, 1], begins, levels),
        actuator, lag=lag)


def hold_staircase(
        bench: Bench, limit: float, steps: int, settle: float,
        gauge: Callable[[float], float] | None, progress: CalibrationProgress
) -> tuple[Array, Array, Array, float]:
    """
    Apply a slow staircase of levels up, down and back.

    Parameters
    ----------
    bench : Bench
        Bench with the hardware.
    limit : float
        Largest level in T.
    steps : int
        Number of levels in each quarter.
    settle : float
        Duration in s of each level, of which the second half is evaluated.
    gauge : callable or None
        Called with a level in T; returns the length of the actuator.
    progress : callable
        Called with the current activity and the completed fraction.

    Returns
    -------
    (ndarray, ndarray, ndarray, float)
        Levels in T, stretches, lengths (NaN without a gauge), and the largest remaining drift of
        the stretch at the end of a level, as a fraction of the range.

    Raises
    ------
    HmsaError
        If the hardware fails or has no sensor.

    """
    levels, rows = loop(limit, steps), []
    for i, level in enumerate(levels):
        progress(f'{level:.3g} T', i / len(levels))
        seen = bench.hold(settle, [level])
        parts: list[list[float]] = [[], []]
        for _ in range(_PATIENCE):
            parts = [[float(x.stretch[0]) for x in seen.samples if math.isfinite(x.stretch[0])
                      and seen.asked[0][0] + y * settle * NANOSECONDS <= x.time]
                     for y in (0.5, 0.75)]
            if parts[1]:
                break
            # Samples are late on a busy machine.
            seen = seen.joined(bench.hold(LEAD, []))
        if not parts[1]:
            raise HmsaError(
                f'{bench.name} gave no sample at {level:.3g} T: expected a sensor, and a settle '
                f'time well above {LEAD:g} s')
        second, late = (float(np.mean(x)) for x in parts)
        rows.append((
            level, second, math.nan if gauge is None else gauge(level), late - second))
    found = np.array(rows)
    return found[:, 0], found[:, 1], found[:, 2], float(
        2.0 * np.max(np.abs(found[:, 3])) / max(float(np.ptp(found[:, 1])), 1e-300))
