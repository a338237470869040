"""
Bounds of steady-state error and vibration from samples, by profile likelihood.

An offset with a drift or creep, and a decaying sinusoid, are fitted for each frequency and decay
of a grid. Every fit that is nearly as good as the best one is possible, and the bounds include all
of these: ambiguity widens them. Further sinusoids are added while what remains shows one, up to
three; the vibration is that of their sum. `_ringing.cpp` does all of this, since a planner of many
joints judges several hundred times a second.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from hmsa.judge import _ringing
from hmsa.model.equations import Array

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
