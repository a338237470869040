"""
Bounds of steady-state error and vibration from samples, by profile likelihood.

An offset with a drift or creep, and a decaying sinusoid, are fitted for each frequency and decay
of a grid. Every fit that is nearly as good as the best one is possible, and the bounds include all
of these: ambiguity widens them.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmsa.model.equations import Array

#: Fewer samples, or fewer periods, do not determine the vibration.
FEWEST, SHORTEST = 8, 1.4
# Probability that the true value is beyond a bound.
_BEYOND = 0.005
# Sampling interval, in periods, below which the vibration is resolved; otherwise it is aliased,
# and the search stays near the frequency of the model.
_DENSE = 0.4
_NEAR, _MIDDLE, _WIDE = (0.75, 1.3), (0.6, 1.6), (0.3, 2.5)
# Periods above which a frequency far from the model's, and a drift at all, can be identified.
_FAR, _DRIFTS = 3.0, 3.0
# Frequencies to try per 1/span of the range, and around the best one, and number of refinements.
_TRIED, _REFINED, _ROUNDS = 3, 7, 3
# Decays to try, relative to the largest one, which is a multiple of the model's, within limits
# given as a ratio to the frequency.
_DECAYS = np.array([0.0, 0.07, 0.15, 0.27, 0.4, 0.6, 1.0])
_FASTER, _LEAST, _MOST = 2.0, 0.1, 0.7
# Maximum decay of a vibration before the first sample, in time constants.
_LONGEST = 20.0
# Time constants of exponential creep, in spans. Creep is tried below this fraction of independent
# samples, and accepted if it leaves less than this fraction of the squares.
_CREEPS, _INDEPENDENT, _EXPLAINED = np.geomspace(0.07, 3.0, 8), 0.4, 0.5
# Number of fitted values: offset, drift, two of the sinusoid, frequency and decay.
_FITTED = 6
# Phases at which a vibration is evaluated, and maximum number of possible fits.
_PHASES = np.linspace(0.0, 2.0 * math.pi, 32)
_MOST_POSSIBLE = 200
# Ratio of standard deviation to median absolute deviation of normal noise.
_NORMAL = 1.4826
# Maximum correlation of neighbouring samples.
_MOST_ALIKE = 0.98


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
    vibration: BoundedValue  #: peak to peak in the period after time 0
    frequency: float  #: in rad/s
    noise: float  #: standard deviation of a sample
    usual: float  #: robust standard deviation, insensitive to single events
    independent: float  #: effective fraction of independent samples; below 1 for coloured noise


def fit(
        time: Array, rest: Array, frequency: float, decay: float,
        settles: Callable[[VibrationFit], bool] = lambda _: False) -> VibrationFit | None:
    """
    Fit samples: times in s, from 0 on and increasing, and deviations from the target.

    Frequency (rad/s) and decay (1/s) are those of the model. If ``settles`` accepts the fit
    without creep, fits with creep, which take several times as long, are skipped. Return None if
    there are too few samples.
    """
    count, span = len(time), float(time[-1] - time[0]) if len(time) else 0.0
    periods = span * frequency / (2.0 * math.pi)
    if count < FEWEST or not periods >= SHORTEST:
        return None
    interval = float(np.median(np.diff(time)))
    dense = interval * frequency < 2.0 * math.pi * _DENSE
    low, high = (x * frequency for x in (
        (_WIDE if periods >= _FAR else _MIDDLE) if dense else _NEAR))
    # Other frequencies are indistinguishable in the samples.
    high = min(high, 0.9 * math.pi / interval if dense else low + 2.0 * math.pi / interval)
    omegas: Array = np.linspace(
        low, high, max(int((high - low) * span * _TRIED / (2.0 * math.pi)), _REFINED)
    ).astype(np.float64)
    decays = _DECAYS * min(
        max(_FASTER * decay, _LEAST * frequency), _MOST * frequency,
        _LONGEST / max(float(time[0]), interval))
    searched = 2.0 * math.log(max((high - low) * span / (2.0 * math.pi), 1.0))

    coarse = _Sinusoids(time, omegas, decays)
    problem = _Problems(time, rest, time[None] if periods >= _DRIFTS else None)
    solved = _refined(problem, problem.solve(coarse), coarse)
    plain = _bounds(problem, 0, solved.flat(), searched)
    if plain.independent > _INDEPENDENT or settles(plain):
        return plain
    # The fit residual is not pure noise: try creep.
    drifts = np.exp(-time / (_CREEPS[:, None] * span))
    fits = _Problems(time, rest, drifts).solve(coarse)
    place = int(np.argmin(np.min(fits.squares, axis=-1)))
    near = slice(max(place - 1, 0), place + 2)
    nearest = _Problems(time, rest, drifts[near])
    refined = _refined(nearest, _Solved(*(x[..., near, :] for x in fits)), coarse)
    least = np.min(refined.squares, axis=-1)
    if np.min(least) > _EXPLAINED * np.min(solved.squares):
        return plain
    more = refined.taken(slice(fits.squares.shape[-1], None))
    return _bounds(nearest, int(np.argmin(least)), fits.flat().joined(more.flat()), searched)


# -- fits on a grid -----------------------------------------------------------------------------

class _Solved(NamedTuple):
    """Fits: residuals, sinusoids, offsets and covariances for unit noise, shape (..., n)."""

    omega: Array
    decay: Array
    squares: Array  # sum of squared residuals
    pair: Array  # coefficients of cosine and sine, shape (2, ..., n)
    offset: Array
    offset_variance: Array
    pair_variance: Array  # the larger of the two

    def taken(self, places: NDArray[np.intp] | slice) -> '_Solved':
        return _Solved(*(x[..., places] for x in self))

    def flat(self) -> '_Solved':
        """Return the fits of all problems in one row."""
        return _Solved(*(x.reshape(*x.shape[:-2], -1) for x in self))

    def joined(self, other: '_Solved') -> '_Solved':
        return _Solved(*(np.concatenate(x, axis=-1) for x in zip(self, other, strict=True)))


class _Sinusoids:
    """Sinusoids for combinations of frequencies and decays, shapes (..., m) and (..., d)."""

    def __init__(self, time: Array, omegas: Array, decays: Array) -> None:
        self.omegas, self.decays = omegas, decays
        phase = omegas[..., None] * time
        self.cosine, self.sine = np.cos(phase), np.sin(phase)  # shape (..., m, n)
        self.fading = np.exp(-decays[..., None] * time)  # shape (..., d, n)
        squared = (self.fading**2).swapaxes(-1, -2)
        self.plain = np.sum(squared, axis=-2)[..., None, :]
        # Cosine and sine of twice the phase.
        self.twice = (
            (self.cosine**2 - self.sine**2) @ squared,
            (2.0 * self.cosine * self.sine) @ squared)


class _Problems:
    """Samples, after projection onto the complement of an offset and each drift, shape (k, n)."""

    def __init__(self, time: Array, rest: Array, drifts: Array | None) -> None:
        self.time, self._rest = time, rest
        level = np.full(len(time), 1.0 / math.sqrt(len(time)))
        self._straight: Array = level[None, None]  # orthonormal, shape (k, 1 or 2, n)
        # The offset in the middle as a function of the coordinates of the straight line.
        self._middle: Array = np.full((1, 1), level[0])
        if drifts is not None:
            # Remove the offset from the drifts: their means over time are 0.
            share = np.diff(time) / (time[-1] - time[0])
            drifts = drifts - 0.5 * ((drifts[:, 1:] + drifts[:, :-1]) @ share)[:, None]
            along = drifts @ level
            drifts = drifts - along[:, None] * level
            size = np.sqrt(np.sum(drifts**2, axis=1))
            self._straight = np.stack(
                (np.broadcast_to(level, drifts.shape), drifts / size[:, None]), axis=1)
            self._middle = np.stack(
                (np.full(len(size), level[0]), -level[0] * along / size), axis=1)
        self._explained = self._straight @ rest
        self._left = rest - (self._explained[:, None] @ self._straight)[:, 0]

    def solve(self, tried: _Sinusoids) -> _Solved:
        """Fit sinusoids to each problem; shapes (k, m d)."""
        plain, (real, imaginary) = tried.plain, tried.twice
        columns = np.concatenate((self._straight, self._left[:, None]), axis=1)
        faded = (tried.fading[..., None, :, :] * columns[..., None, :]).swapaxes(-1, -2)
        # Shapes (k, 2 or 3, m, d).
        cosines, sines = (x[..., None, :, :] @ faded for x in (tried.cosine, tried.sine))
        by_cosines, by_sines = cosines[:, :-1], sines[:, :-1]
        rights = cosines[:, -1], sines[:, -1]
        one = 0.5 * (plain + real) - np.sum(by_cosines**2, axis=1)
        two = 0.5 * (plain - real) - np.sum(by_sines**2, axis=1)
        cross = 0.5 * imaginary - np.sum(by_cosines * by_sines, axis=1)
        determinant = np.maximum(one * two - cross**2, 1e-12 * plain**2)
        cosine = (two * rights[0] - cross * rights[1]) / determinant
        sine = (one * rights[1] - cross * rights[0]) / determinant
        squares = np.sum(self._left**2, axis=1)[:, None, None] - (
            cosine * rights[0] + sine * rights[1])
        # Shift of the offset by the two coefficients of the sinusoid.
        middle = self._middle[..., None, None]
        by_cosine, by_sine = (np.sum(middle * x, axis=1) for x in (by_cosines, by_sines))
        offset = np.sum(self._middle * self._explained, axis=1)[:, None, None] - (
            by_cosine * cosine + by_sine * sine)
        variance = np.sum(middle**2, axis=1) + (
            two * by_cosine**2 - 2.0 * cross * by_cosine * by_sine + one * by_sine**2
        ) / determinant
        larger = (0.5 * (one + two) + np.sqrt(
            0.25 * (one - two)**2 + cross**2)) / determinant
        shape = len(determinant), -1
        return _Solved(*(x.reshape(*x.shape[:-3], *shape) for x in (
            np.broadcast_to(tried.omegas[..., None], determinant.shape),
            np.broadcast_to(tried.decays[..., None, :], determinant.shape),
            np.maximum(squares, 0.0), np.stack((cosine, sine)), offset, variance, larger)))

    def residuals(self, place: int, omega: float, decay: float, pair: Array) -> Array:
        """Return the residuals of a sinusoid with the best offset and drift."""
        fading = np.exp(-decay * self.time)
        wave = fading * (pair[0] * np.cos(omega * self.time)
                         + pair[1] * np.sin(omega * self.time))
        left, straight = self._rest - wave, self._straight[place]
        return np.asarray(left - straight.T @ (straight @ left))


def _refined(problems: _Problems, solved: _Solved, coarse: _Sinusoids) -> _Solved:
    """Add fits around the best one of a grid to those of each problem."""
    omegas, decays = coarse.omegas, coarse.decays
    width, spread = float(omegas[1] - omegas[0]), float(decays[1])
    for _ in range(_ROUNDS):
        best = np.argmin(solved.squares, axis=-1)[:, None]
        omega, decay = (np.take_along_axis(x, best, -1) for x in (solved.omega, solved.decay))
        more = problems.solve(_Sinusoids(
            problems.time,
            np.clip(omega + width * np.linspace(-1.0, 1.0, _REFINED), omegas[0], omegas[-1]),
            np.clip(decay + spread * np.linspace(-2.0, 2.0, 5), 0.0, decays[-1])))
        solved = solved.joined(more)
        width, spread = 2.0 * width / (_REFINED - 1), 0.5 * spread
    return solved


def _bounds(problems: _Problems, number: int, tried: _Solved, searched: float) -> VibrationFit:
    """Return the values of the best fit of a problem, with bounds over all possible fits."""
    count = len(problems.time)
    place = int(np.argmin(tried.squares))
    least = float(tried.squares[place])
    left = problems.residuals(
        number, float(tried.omega[place]), float(tried.decay[place]), tried.pair[:, place])
    together = _together(left)
    freedom = max(count - _FITTED, 1)
    variance = least / freedom
    # Correlated samples count as fewer.
    of_few = max(freedom / together, 1.0)
    sure = student_quantile(of_few, 1.0 - _BEYOND)
    scale = variance * together
    slack = sure**2 + searched - (tried.squares - least) / max(scale, 1e-300)
    possible = np.flatnonzero(slack >= 0.0)
    if len(possible) > _MOST_POSSIBLE:
        # Without noise many fits equal the best one, which has to stay.
        likely = possible[np.argsort(-slack[possible])[:_MOST_POSSIBLE]]
        possible = np.union1d(likely, [place])
    within = tried.taken(possible)
    # A vibration found only by the search is not significant, but possible.
    reach = np.sqrt(np.maximum(slack[possible], 0.0) * scale)
    near = np.sqrt(np.maximum(slack[possible] - searched, 0.0) * scale)
    fading = np.exp(-np.outer(within.decay / within.omega, _PHASES))
    waves = fading * (np.outer(within.pair[0], np.cos(_PHASES))
                      + np.outer(within.pair[1], np.sin(_PHASES)))
    swing = np.ptp(waves, axis=1)
    # Maximum over all phases.
    factor = 1.0 + np.exp(-math.pi * within.decay / within.omega)
    deviation = np.sqrt(within.pair_variance) * factor
    shift = np.sqrt(within.offset_variance)
    mine = int(np.flatnonzero(possible == place)[0])
    unit = math.sqrt(scale)
    usual = slack[possible] >= searched
    return VibrationFit(
        BoundedValue(
            float(within.offset[mine]), unit * float(shift[mine]),
            float(np.min((within.offset - near * shift)[usual])),
            float(np.max((within.offset + near * shift)[usual]))),
        BoundedValue(
            float(swing[mine]), unit * float(deviation[mine]),
            float(max(np.min(swing - reach * deviation), 0.0)),
            float(np.max((swing + near * deviation)[usual]))),
        float(within.omega[mine]), math.sqrt(variance),
        _NORMAL * float(np.median(np.abs(left))) * math.sqrt(count / freedom), 1.0 / together)


def student_quantile(freedom: float, probability: float) -> float:
    """
    Return the quantile of Student's t at a probability above 0.5.

    Degrees of freedom, at least 1, are rounded down below 3. The expansion is 26.7.5 of Abramowitz
    and Stegun. SciPy provides the quantile, but takes as long to import as a planner to start.
    """
    share = 2.0 * probability - 1.0
    if freedom < 2.0:
        return math.tan(0.5 * math.pi * share)
    if freedom < 3.0:
        return share * math.sqrt(2.0 / (1.0 - share * share))
    z = NormalDist().inv_cdf(probability)
    terms = (
        (z**3 + z) / 4.0, (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0,
        (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0,
        (79.0 * z**9 + 776.0 * z**7 + 1482.0 * z**5 - 1920.0 * z**3 - 945.0 * z) / 92160.0)
    return z + sum(x / freedom**i for i, x in enumerate(terms, 1))


def _together(left: Array) -> float:
    """Return the number of samples per independent one: 1 for white noise."""
    size = float(left @ left)
    if size <= 0.0:
        return 1.0
    total, count = 1.0, len(left)
    next_one = float(left[1:] @ left[:-1]) / size
    if next_one > 2.0 / math.sqrt(count):
        # Compensate for the part that the fit has removed.
        next_one = min(next_one + (1.0 + _FITTED * next_one) / count, _MOST_ALIKE)
        total = (1.0 + next_one) / (1.0 - next_one)
    summed = 1.0
    for lag in range(1, len(left) // 4 + 1):
        share = float(left[lag:] @ left[:-lag]) / size
        if share <= 0.0:
            break
        summed += 2.0 * share
    return max(total, summed)
