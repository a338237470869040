"""
Bounds of steady-state error and vibration from samples, by profile likelihood.

An offset with a drift or creep, and a decaying sinusoid, are fitted for each frequency and decay
of a grid. Every fit that is nearly as good as the best one is possible, and the bounds include all
of these: ambiguity widens them. Further sinusoids are added while what remains shows one, up to
three; the vibration is that of their sum. `_ringing.cpp` does all of this, since a planner of many
joints judges several hundred times a second.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmsa.judge import _ringing
from hmsa.model.equations import Array
from hmsa.model.units import NANOSECONDS

#: Fewer samples do not determine the vibration.
FEWEST = 8
# Probability that the true value is beyond a bound, and the quantile of normal noise for it.
_BEYOND, _NORMAL = 0.005, 2.5758293035489
#: Fraction of independent samples below which what remains is no noise, and creep is tried.
INDEPENDENT = 0.4
#: Highest mode that may ring, relative to the frequency of the model.
MODES = 7.0


class BoundedValue(NamedTuple):
    """A value, its standard deviation and its bounds."""

    value: float
    std: float
    low: float
    high: float


@dataclass(frozen=True)
class VibrationFit:
    """Result of a fit of samples."""

    offset: BoundedValue
    vibration: BoundedValue  #: largest peak to peak after time 0, of all modes
    modes: tuple[tuple[float, float], ...]  #: frequency in rad/s and peak to peak, largest first
    noise: float  #: standard deviation of a sample
    usual: float  #: robust standard deviation, insensitive to single events
    independent: float  #: effective fraction of independent samples; below 1 for coloured noise
    resolved: float  #: highest frequency at which vibration shows, in rad/s

    @property
    def frequency(self) -> float:
        """Frequency of the largest mode in rad/s."""
        return self.modes[0][0]


def fit(
        time: Array, rest: Array, frequency: float, decay: float,
        settles: Callable[[VibrationFit], bool] = lambda _: False, *,
        nothing: float = 0.0) -> VibrationFit | None:
    """
    Fit samples: times in s, from 0 on and increasing, and deviations from the target.

    Frequency (rad/s) and decay (1/s) are those of the model. If ``settles`` accepts the fit
    without creep, fits with creep, which take several times as long, are skipped. Below an RMS
    residual of ``nothing``, further modes are not looked for. Return None if there are too few
    samples.
    """
    plain = _fit(time, rest, frequency, decay, nothing, creep=False)
    if plain is None or plain.independent > INDEPENDENT or settles(plain):
        return plain
    # The fit residual is not pure noise: try creep.
    return _fit(time, rest, frequency, decay, nothing, creep=True)


def _fit(
        time: Array, rest: Array, frequency: float, decay: float, nothing: float, *,
        creep: bool) -> VibrationFit | None:
    found = _ringing.fit(time, rest, frequency, decay, _BEYOND, _NORMAL, nothing, creep)
    if found is None:
        return None
    return VibrationFit(BoundedValue(*found[0]), BoundedValue(*found[1]), *found[2:])


# Number of stored samples, and fraction of them that is new at each evaluation.
_STORED, _NEW = 300, 0.25
# Largest gap between successive samples in ns.
_GAP = 300_000_000
# Largest vibration of a joint at rest that the samples may conceal, peak to peak in stretch: a
# fiftieth of a usual step.
_REST = 5e-3


class Stillness:
    """Find rest in the samples of a joint since `clear`."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float]] = deque(maxlen=_STORED)
        self.clear()

    def add(self, stamp: int, stretch: float) -> None:
        """Add a sample with a timestamp in ns, unless a newer one is known; a gap clears all."""
        step = stamp - self._samples[-1][0] if self._samples else 1
        if abs(step) > _GAP:
            self.clear()
        elif step <= 0:
            return
        self._samples.append((stamp, stretch))
        self._new += 1

    def clear(self) -> None:
        """Forget all samples."""
        self._samples.clear()
        self._new = 0  # number of samples since the last evaluation
        self._rest: float | None = None
        self._until = 0  # timestamp of the newest sample evaluated

    def rest(self, frequency: Callable[[float], float], since: int) -> float | None:
        """
        Return the stretch at which a joint rests by samples after a time in ns, else None.

        ``frequency`` returns the natural frequency in rad/s about a stretch.
        """
        if self._samples and self._samples[-1][0] <= since:
            self.clear()
        while self._samples and self._samples[0][0] <= since:
            self._samples.popleft()
        if self._rest is not None and self._until <= since and self._samples and (
                abs(self._samples[-1][1] - self._rest) > _REST):
            # It rested there before the time, and is elsewhere now.
            self._rest = None
        if len(self._samples) >= FEWEST and self._new >= _NEW * len(self._samples):
            self._new, self._until = 0, self._samples[-1][0]
            self._rest = self._evaluated(frequency)
        return self._rest

    def _evaluated(self, frequency: Callable[[float], float]) -> float | None:
        time, stretch = np.array(self._samples, dtype=np.float64).T
        middle = float(np.mean(stretch))
        found = fit(
            (time - time[0]) / NANOSECONDS, stretch - middle,
            frequency(middle), 0.0, lambda _: True)
        if found is None or not found.vibration.high <= _REST:
            return None
        return middle + found.offset.value
