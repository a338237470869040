"""
Learning from repeats: levels of a sequence, corrected by the residuals that were measured.

What a model lacks, such as hysteresis or a second mode, is the same in each repeat. The next
levels follow from the last residual and the derivatives of the model, as in norm-optimal iterative
learning control (N. Amann, D. H. Owens, E. Rogers, IEE Proc. D 143, 217 (1996)).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from hmsa_ros.errors import BadInputError
from hmsa_ros.model.equations import Array, natural_frequency
from hmsa_ros.model.parameters import ActuatorParameters
from hmsa_ros.model.simulation import simulate

# Parts of a move in which the level may differ, and the end of them, in durations of the move.
_PARTS, _END = 4, 1.5
# Largest change of a level at once and standard deviation of what is expected of it, as shares of
# the range of the levels; and a change for derivatives.
_LARGEST, _EXPECTED, _CHANGE = 0.2, 0.05, 1e-4
# Frequencies and dampings at which a second mode is sought, and by how many variances of the noise
# it must explain the residual better.
_FREQUENCIES, _DAMPINGS, _CERTAIN = (np.geomspace(1.5, 12.0, 120), (0.003, 0.02, 0.06), 40.0)
# Periods after a move that count: later ones show where the frequency of the model is wrong.
_PERIODS = 4.0
# Samples a period, of the second mode, that are needed to see it.
_FEWEST = 4.0
# Delays of the samples that are tried, in periods.
_DELAYS = np.linspace(0.0, 0.5, 101)
# Error of the times of levels, in periods, and from how many levels on a move is smooth.
_OFF, _MANY = 0.01, 16


Places = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Trial:
    """
    A repeat of a sequence; times in s from its first level.

    Raises
    ------
    BadInputError
        If there are no samples or levels, or they are not finite.

    """

    time: Array  #: shape (n,), increasing
    stretch: Array  #: shape (n,)
    level_times: Array  #: shape (m,), increasing from 0
    levels: Array  #: shape (m,), in T

    def __post_init__(self) -> None:
        for name, times, values in (
                ('samples', self.time, self.stretch), ('levels', self.level_times, self.levels)):
            if len(times) != len(values) or not len(times) or not np.all(
                    np.isfinite(times) & np.isfinite(values)) or np.any(np.diff(times) <= 0.0):
                raise BadInputError(
                    f'{len(times)} {name} of a repeat: expected finite ones, at rising times')

    def at(self, times: Array) -> Array:
        """Return the levels in force at some times, 0 before the first."""
        place = np.searchsorted(self.level_times, times, 'right')
        found: Array = np.append(0.0, self.levels)[place]
        return found


@dataclass(frozen=True)
class Target:
    """A stretch, and from when to when in s a sequence is to hold it, its move included."""

    stretch: float
    begin: float
    end: float
    #: when it rests by its plan, in s; levels after that follow creep; None: with its last level
    arrival: float | None = None


@dataclass(frozen=True)
class Left:
    """What a repeat left at a target, as shares of the step."""

    vibration: float  #: peak to peak in the first period
    offset: float


@dataclass(frozen=True, eq=False)
class Learnt:
    """The next levels, and what the repeats before have left."""

    level_times: Array  #: shape (m,), in s
    levels: Array  #: shape (m,), in T
    left: tuple[tuple[Left, ...], ...]  #: by repeat and target
    best: int  #: place of the repeat that left least
    frequency: float  #: of the second mode in Hz; NaN where none shows


class _Sequence:
    """Knots of a sequence, and windows in which it is to rest."""

    def __init__(
            self, first: Trial, targets: Sequence[Target], actuator: ActuatorParameters) -> None:
        self.targets, self.actuator = targets, actuator
        unit = actuator.time_unit
        self.period = 2.0 * math.pi * unit / np.array([
            float(natural_frequency(x.stretch, actuator.nondimensional)) for x in targets])
        knots: list[float] = []
        self.rests = []
        for target, period in zip(targets, self.period, strict=True):
            # What a device says of its times is off by the error of its clock.
            off = _OFF * float(period)
            until = target.end - 2.0 * off if target.arrival is None else target.arrival
            own = first.level_times[
                (first.level_times >= target.begin - off) & (first.level_times < until + off)]
            if not len(own):
                raise BadInputError(
                    f'no level belongs to the setpoint {target.stretch:g}: expected one or more')
            length = float(own[-1] - own[0]) or 0.5 * float(period)
            parts = own[0] + length / _PARTS * np.arange(round(_END * _PARTS) + 1)
            # Of both that are about the same those of the sequence count, if it is not smooth.
            own = own if len(own) <= _MANY else own[:1]
            knots += [*own, *(x for x in parts if np.min(np.abs(own - x)) > 0.05 * length)]
            self.rests.append(float(own[0]) + _END * length)
            if target.end - self.rests[-1] < period:
                raise BadInputError(
                    f'setpoint {target.stretch:g} is held for {target.end - self.rests[-1]:.3g} s '
                    f'after its move: expected at least a period, {period:.3g} s, to see what is '
                    'left')
        self.knots = np.array(sorted(knots))
        # Of all levels; those that follow creep change as the last knot before them does.
        others = first.level_times[first.level_times > self.knots[0]]
        near = np.min(np.abs(others[:, None] - self.knots), axis=1)
        self.times = np.sort(np.append(
            self.knots, others[near > _OFF * float(np.min(self.period))]))
        self.held = np.eye(len(self.knots))[
            np.searchsorted(self.knots, self.times, 'right') - 1]
        starts = [actuator.rest, *(x.stretch for x in targets[:-1])]
        self.steps = [x.stretch - y for x, y in zip(targets, starts, strict=True)]
        if min(map(abs, self.steps)) < 1e-6:
            raise BadInputError('a setpoint repeats the one before: expected steps')

    def levels(self, trial: Trial) -> Array:
        """Return the level of a repeat from each time on, read in the middle until the next."""
        gaps = np.diff(self.times, append=self.times[-1] + 2e-3)
        return trial.at(self.times + 0.5 * np.minimum(gaps, 0.05))

    def windows(self, time: Array) -> list[Places]:
        """Return the places of samples at rest at each target; too few are a `BadInputError`."""
        found = [np.flatnonzero(
            (time >= begin) & (time < min(x.end, begin + _PERIODS * float(period))))
            for begin, x, period in zip(self.rests, self.targets, self.period, strict=True)]
        for x, target, period in zip(found, self.targets, self.period, strict=True):
            if len(x) < 10 or time[x[-1]] - time[x[0]] < 0.8 * period:
                raise BadInputError(
                    f'{len(x)} samples show the rest at {target.stretch:g}: expected ten or more '
                    'over a period')
        return found

    def residual(self, time: Array, stretch: Array) -> Array:
        """Return what is left, so that each target counts as much as another."""
        return np.concatenate([
            (stretch[x] - target.stretch) / step / math.sqrt(len(x))
            for x, target, step in zip(
                self.windows(time), self.targets, self.steps, strict=True)])

    def left(self, trial: Trial, mode: '_Mode | None') -> tuple[Left, ...]:
        """Return what a repeat left, at the frequencies of a model and a second mode."""
        found = []
        for x, target, step, period in zip(
                self.windows(trial.time), self.targets, self.steps, self.period, strict=True):
            time, off = trial.time[x], (trial.stretch[x] - target.stretch) / step
            first = off[time < time[0] + period]
            # Noise is not vibration: the amplitude of a fit counts.
            fitted = _ringing(time[:len(first)], [
                2.0 * math.pi / float(period), *([] if mode is None else [mode.frequency])])
            curve = fitted @ np.linalg.lstsq(fitted, first, rcond=1e-6)[0]
            found.append(Left(float(np.ptp(curve)), float(np.mean(off))))
        return tuple(found)

    def simulated(self, levels: Array, time: Array) -> Array:
        """Return the stretch of the model."""
        unit, loads = self.actuator.time_unit, self.actuator.units.of_level(levels)
        found: Array = simulate(
            np.append(self.times[0] - 1.0, self.times) / unit, np.append(0.0, loads),
            np.maximum(time, self.times[0] - 1.0) / unit, self.actuator.nondimensional)[0]
        return found

    def delay(self, trial: Trial) -> float:
        """Return by how much in s the samples are later than the model, by lag and latency."""
        seen, shown = trial.stretch, self.simulated(self.levels(trial), trial.time)
        delays = float(np.min(self.period)) * _DELAYS
        off = [float(np.sum((seen - np.interp(trial.time - x, trial.time, shown))**2))
               for x in delays]
        return float(delays[np.argmin(off)])

    def derivatives(self, levels: Array, time: Array) -> Array:
        """Return the derivatives of the residual by levels at the knots in T, shape (r, k)."""
        change = _CHANGE * float(np.max(np.abs(levels)))
        base = self.residual(time, self.simulated(levels, time))
        return np.column_stack([
            (self.residual(time, self.simulated(levels + change * x, time)) - base) / change
            for x in self.held.T])


def _ringing(time: Array, frequencies: Sequence[float]) -> Array:
    """Return a constant, and cosine and sine of some frequencies in rad/s, shape (n, 1 + 2 f)."""
    since = time - time[0]
    return np.column_stack([np.ones(len(time)), *(
        f(x * since) for x in frequencies for f in (np.cos, np.sin))])


@dataclass(frozen=True)
class _Mode:
    """A second mode: rad/s, share of critical damping, and stretch per T at rest."""

    frequency: float
    damping: float
    gain: float = 1.0

    def driven(self, times: Array, levels: Array, time: Array) -> Array:
        """Return its response at some times, from the first on, to levels from others on."""
        power = self.frequency * complex(-self.damping, math.sqrt(1.0 - self.damping**2))
        states, state = [], 0j
        for change, fade in zip(
                np.diff(levels, prepend=0.0).tolist(),
                np.exp(power * np.diff(times, append=times[-1])).tolist(), strict=True):
            states.append(state + change)
            state = states[-1] * fade
        place = np.searchsorted(times, time, 'right') - 1
        ring = np.array(states)[place] * np.exp(power * (time - times[place]))
        found: Array = self.gain * (
            levels[place] - ring.real + power.real / power.imag * ring.imag)
        return found


def _second_mode(sequence: _Sequence, trial: Trial, noise: float) -> _Mode | None:
    """Find a mode that the levels excite, beside the first one and twice its frequency."""
    levels = sequence.levels(trial)
    places = sequence.windows(trial.time)
    # Only these samples count.
    time, stretch = (x[np.concatenate(places)] for x in (trial.time, trial.stretch))
    windows = np.split(np.arange(len(time)), np.cumsum([len(x) for x in places])[:-1])
    first = 2.0 * math.pi / float(np.min(sequence.period))
    spacing = float(np.median(np.diff(time)))
    own = [_ringing(time[x], [2.0 * math.pi / p * y for y in (0.9, 1.0, 1.1, 2.0)])
           for x, p in zip(windows, sequence.period, strict=True)]
    bases = [np.linalg.qr(x)[0] for x in own]

    def without(values: Array) -> Array:
        return np.concatenate([
            values[x] - q @ (q.T @ values[x]) for x, q in zip(windows, bases, strict=True)])

    seen = without(stretch)

    def explained(frequency: float, damping: float) -> tuple[float, float]:
        """Return by how much the sum of squares falls, and the gain."""
        shape = without(_Mode(frequency, damping).driven(sequence.times, levels, time))
        power = float(shape @ shape)
        gain = float(shape @ seen) / power if power > 0.0 else 0.0
        return gain**2 * power, gain

    most = 2.0 * math.pi / (_FEWEST * spacing)
    tried = [(explained(first * x, y)[0], first * x, y)
             for x in _FREQUENCIES if first * x < most for y in _DAMPINGS]
    if not tried or max(tried)[0] < _CERTAIN * noise**2:
        return None
    best = max(tried)
    found = least_squares(
        lambda x: math.sqrt(max(float(seen @ seen) - explained(
            best[1] * math.exp(x[0]), min(best[2] * math.exp(x[1]), 0.5))[0], 0.0)),
        [0.0, 0.0], bounds=([-0.1, -3.0], [0.1, 3.0]), x_scale=[1e-2, 1.0])
    mode = best[1] * math.exp(found.x[0]), min(best[2] * math.exp(found.x[1]), 0.5)
    return _Mode(*mode, explained(*mode)[1])


def learn(
        trials: Sequence[Trial], targets: Sequence[Target], actuator: ActuatorParameters,
        limits: tuple[float, float] = (-math.inf, math.inf)) -> Learnt:
    """
    Return the levels to send next.

    Parameters
    ----------
    trials : sequence of Trial
        Repeats in their order, the first as it was planned, each of the others with the levels
        that this function returned for those before it.
    targets : sequence of Target
        At least one.
    actuator : ActuatorParameters
        As it was planned with.
    limits : (float, float)
        Least and largest level in T.

    Returns
    -------
    Learnt
        With the same targets, in the same time.

    Raises
    ------
    BadInputError
        If there is nothing to learn from.

    """
    if not trials or not targets:
        raise BadInputError(f'{len(trials)} repeats and {len(targets)} setpoints: expected some')
    sequence = _Sequence(trials[0], targets, actuator)
    delay = sequence.delay(trials[0])
    trials = [replace(x, time=x.time - delay) for x in trials]
    residuals = [sequence.residual(x.time, x.stretch) for x in trials]
    best = int(np.argmin([float(x @ x) for x in residuals]))
    trial, residual = trials[best], residuals[best]
    levels = sequence.levels(trial)
    noise = float(np.median(np.abs(np.diff(trial.stretch, 2)))) / 0.6745 / math.sqrt(6.0)
    mode = _second_mode(sequence, trials[0], noise)
    slopes = sequence.derivatives(levels, trial.time)
    if mode is not None:
        slopes = slopes + np.concatenate([
            np.column_stack([mode.driven(sequence.knots, one, trial.time[x])
                             for one in np.eye(len(sequence.knots))]) / step / math.sqrt(len(x))
            for x, step in zip(sequence.windows(trial.time), sequence.steps, strict=True)])
    size = float(np.ptp(np.append(levels, 0.0)))
    # As the noise, and what is expected of the changes, have it.
    weight = max(noise, 1e-7) / min(map(abs, sequence.steps)) / math.sqrt(
        len(residual) / len(targets)) / (_EXPECTED * size)
    change = np.linalg.lstsq(
        np.vstack([slopes, weight * np.eye(slopes.shape[1])]),
        np.append(-residual, np.zeros(slopes.shape[1])), rcond=None)[0]
    radius = _LARGEST * size * 0.5 ** (len(trials) - 1 - best)
    change *= min(1.0, radius / max(float(np.max(np.abs(change))), 1e-300))
    return Learnt(
        sequence.times, np.clip(levels + sequence.held @ change, *limits),
        tuple(sequence.left(x, mode) for x in trials), best,
        math.nan if mode is None else mode.frequency / (2.0 * math.pi))
