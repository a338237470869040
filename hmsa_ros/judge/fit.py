"""
Bounds of an offset and of a vibration that samples allow, by profile likelihood.

An offset with a drift, or with a creep, and a decaying sinusoid are fitted for each frequency and
decay of a grid.
Each fit that leaves little more than the best is possible, and the bounds hold for all of these:
what samples do not tell apart widens them.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.model.equations import Array

#: Fewer samples, or fewer periods of the vibration, say nothing about it.
FEWEST, SHORTEST = 8, 1.4
# How often the truth may be beyond a bound.
_BEYOND = 0.005
# Samples nearer together than this share of a period show the vibration as it is; with others it
# is looked for near the frequency of the model, of which they show an alias.
_DENSE = 0.4
_NEAR, _MIDDLE, _WIDE = (0.75, 1.3), (0.6, 1.6), (0.3, 2.5)
# Periods from which on a frequency far from the model's is told from a drift, and a drift at all.
_FAR, _DRIFTS = 3.0, 3.0
# Frequencies tried in the time of one period over the span, and around the best one.
_TRIED, _REFINED, _ROUNDS = 3, 7, 3
# Decays tried, as shares of the largest, which is this many times the model's, as a ratio to the
# frequency between these.
_DECAYS = np.array([0.0, 0.07, 0.15, 0.27, 0.4, 0.6, 1.0])
_FASTER, _LEAST, _MOST = 2.0, 0.1, 0.7
# Time constants by which a vibration may have faded at the first sample.
_LONGEST = 20.0
# Time constants of an exponential creep in spans. It is looked for below this share of independent
# samples, and shown where it leaves less than this share of the squares.
_CREEPS, _INDEPENDENT, _EXPLAINED = np.geomspace(0.07, 3.0, 8), 0.4, 0.5
# Figures that are fitted: offset, drift, two of the sinusoid, frequency and decay.
_FITTED = 6
# Phases at which a vibration is looked at, and how many possible ones.
_PHASES = np.linspace(0.0, 2.0 * math.pi, 32)
_MOST_POSSIBLE = 200
# Standard deviations of noise in its median from zero.
_NORMAL = 1.4826
# Largest correlation of neighbours that counts.
_MOST_ALIKE = 0.98


class Figure(NamedTuple):
    """A figure, its standard deviation and its bounds."""

    value: float
    std: float
    low: float
    high: float


@dataclass(frozen=True)
class Fit:
    """What samples show."""

    offset: Figure
    vibration: Figure  #: peak to peak in the period after time 0
    frequency: float  #: in rad/s
    noise: float  #: standard deviation of a sample
    usual: float  #: the same of most samples: what happens once does not count
    independent: float  #: share of the samples that noise which is not white leaves


def fit(
        time: Array, rest: Array, frequency: float, decay: float,
        settles: Callable[[Fit], bool] = lambda _: False) -> Fit | None:
    """
    Fit samples: times in s, from 0 on and increasing, and how far from the target.

    Frequency (rad/s) and decay (1/s) are the model's. A fit without creep that ``settles`` what is
    asked is not compared with those with creep, which take several times as long. None where
    samples are too few.
    """
    count, span = len(time), float(time[-1] - time[0]) if len(time) else 0.0
    periods = span * frequency / (2.0 * math.pi)
    if count < FEWEST or not periods >= SHORTEST:
        return None
    interval = float(np.median(np.diff(time)))
    dense = interval * frequency < 2.0 * math.pi * _DENSE
    low, high = (x * frequency for x in (
        (_WIDE if periods >= _FAR else _MIDDLE) if dense else _NEAR))
    # Beyond these the samples show no other vibration.
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
    # What is left is not chance alone: it may creep.
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


# -- fits of a grid -----------------------------------------------------------------------------

class _Solved(NamedTuple):
    """Fits: their residuals, sinusoids, offsets and covariances of unit noise, shape (..., n)."""

    omega: Array
    decay: Array
    squares: Array  # sum of the squares of what is left
    pair: Array  # factors of cosine and sine, shape (2, ..., n)
    offset: Array
    offset_variance: Array
    pair_variance: Array  # the larger of the two

    def taken(self, places: NDArray[np.intp] | slice) -> '_Solved':
        return _Solved(*(x[..., places] for x in self))

    def flat(self) -> '_Solved':
        """Return those of all problems together."""
        return _Solved(*(x.reshape(*x.shape[:-2], -1) for x in self))

    def joined(self, other: '_Solved') -> '_Solved':
        return _Solved(*(np.concatenate(x, axis=-1) for x in zip(self, other, strict=True)))


class _Sinusoids:
    """Sinusoids of each of some frequencies and decays, shapes (..., m) and (..., d)."""

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
    """Samples, with what an offset and each of some drifts, shape (k, n), explain taken out."""

    def __init__(self, time: Array, rest: Array, drifts: Array | None) -> None:
        self.time, self._rest = time, rest
        level = np.full(len(time), 1.0 / math.sqrt(len(time)))
        self._straight: Array = level[None, None]  # orthonormal, shape (k, 1 or 2, n)
        # What an offset in the middle is of the coordinates of the straight line.
        self._middle: Array = np.full((1, 1), level[0])
        if drifts is not None:
            # Of an offset they have no part: their means over the time are 0.
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
        # How far the sinusoid moves the offset, by its two factors.
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
        """Return what a sinusoid leaves with the best offset and a drift."""
        fading = np.exp(-decay * self.time)
        wave = fading * (pair[0] * np.cos(omega * self.time)
                         + pair[1] * np.sin(omega * self.time))
        left, straight = self._rest - wave, self._straight[place]
        return np.asarray(left - straight.T @ (straight @ left))


def _refined(problems: _Problems, solved: _Solved, coarse: _Sinusoids) -> _Solved:
    """Add fits about the best one of a grid to those of each problem."""
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


def _bounds(problems: _Problems, number: int, tried: _Solved, searched: float) -> Fit:
    """Return the figures of the best fit, of a problem, and their bounds by all possible ones."""
    count = len(problems.time)
    place = int(np.argmin(tried.squares))
    least = float(tried.squares[place])
    left = problems.residuals(
        number, float(tried.omega[place]), float(tried.decay[place]), tried.pair[:, place])
    together = _together(left)
    freedom = max(count - _FITTED, 1)
    variance = least / freedom
    # Of samples that are not independent there are fewer.
    of_few = max(freedom / together, 1.0)
    sure = student_quantile(of_few, 1.0 - _BEYOND)
    scale = variance * together
    slack = sure**2 + searched - (tried.squares - least) / max(scale, 1e-300)
    possible = np.flatnonzero(slack >= 0.0)
    if len(possible) > _MOST_POSSIBLE:
        # Where samples have no noise many fits are as good as the best, which has to stay.
        likely = possible[np.argsort(-slack[possible])[:_MOST_POSSIBLE]]
        possible = np.union1d(likely, [place])
    within = tried.taken(possible)
    # One that was only found by searching is not shown, but it may be.
    reach = np.sqrt(np.maximum(slack[possible], 0.0) * scale)
    near = np.sqrt(np.maximum(slack[possible] - searched, 0.0) * scale)
    fading = np.exp(-np.outer(within.decay / within.omega, _PHASES))
    waves = fading * (np.outer(within.pair[0], np.cos(_PHASES))
                      + np.outer(within.pair[1], np.sin(_PHASES)))
    swing = np.ptp(waves, axis=1)
    # The largest that any phase has.
    factor = 1.0 + np.exp(-math.pi * within.decay / within.omega)
    deviation = np.sqrt(within.pair_variance) * factor
    shift = np.sqrt(within.offset_variance)
    mine = int(np.flatnonzero(possible == place)[0])
    unit = math.sqrt(scale)
    usual = slack[possible] >= searched
    return Fit(
        Figure(
            float(within.offset[mine]), unit * float(shift[mine]),
            float(np.min((within.offset - near * shift)[usual])),
            float(np.max((within.offset + near * shift)[usual]))),
        Figure(
            float(swing[mine]), unit * float(deviation[mine]),
            float(max(np.min(swing - reach * deviation), 0.0)),
            float(np.max((swing + near * deviation)[usual]))),
        float(within.omega[mine]), math.sqrt(variance),
        _NORMAL * float(np.median(np.abs(left))) * math.sqrt(count / freedom), 1.0 / together)


def student_quantile(freedom: float, probability: float) -> float:
    """
    Return what Student's t exceeds with the rest of a probability above 0.5.

    Degrees of freedom, at least 1, are rounded down below 3. The expansion is Abramowitz and
    Stegun's 26.7.5; SciPy has the quantile, but loading it takes as long as a planner's start.
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
    """Return of how many samples one is independent: 1 of white noise."""
    size = float(left @ left)
    if size <= 0.0:
        return 1.0
    total, count = 1.0, len(left)
    next_one = float(left[1:] @ left[:-1]) / size
    if next_one > 2.0 / math.sqrt(count):
        # What was fitted has taken part of it away.
        next_one = min(next_one + (1.0 + _FITTED * next_one) / count, _MOST_ALIKE)
        total = (1.0 + next_one) / (1.0 - next_one)
    summed = 1.0
    for lag in range(1, len(left) // 4 + 1):
        share = float(left[lag:] @ left[:-lag]) / size
        if share <= 0.0:
            break
        summed += 2.0 * share
    return max(total, summed)
