"""
Learning from repeats: levels of a sequence, corrected by the measured residuals.

Effects outside the model, such as hysteresis or a second mode, are the same in each repeat. The
next levels follow from the last residual and the derivatives of the model, as in norm-optimal
iterative learning control (N. Amann, D. H. Owens, E. Rogers, IEE Proc. D 143, 217 (1996)).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from hmsa.errors import BadInputError
from hmsa.model.equations import Array, natural_frequency
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.simulation import simulate

# Parts per duration of a move between which the level may change, and their end in durations.
_PARTS, _END = 4, 1.5
# Maximum change of a level, its expected standard deviation, and increment for derivatives, all
# relative to the range of the levels.
_LARGEST, _EXPECTED, _CHANGE = 0.2, 0.05, 1e-4
# Frequencies and damping ratios to try for a second mode, and the minimum improvement of the
# residual, in variances of the noise.
_FREQUENCIES, _DAMPINGS, _CERTAIN = (np.geomspace(1.5, 12.0, 120), (0.003, 0.02, 0.06), 40.0)
# Periods after a move that count: later ones mainly show errors of the model's frequency.
_PERIODS = 4.0
# Minimum number of samples per period of the second mode.
_FEWEST = 4.0
# Delays of the samples to try, in periods.
_DELAYS = np.linspace(0.0, 0.5, 101)
# Error of the times of levels, in periods, and number of levels above which a move is smooth.
_OFF, _MANY = 0.01, 16


Places = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class SequenceRepeat:
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
        """Return the levels at some times, 0 before the first."""
        place = np.searchsorted(self.level_times, times, 'right')
        found: Array = np.append(0.0, self.levels)[place]
        return found


@dataclass(frozen=True)
class TargetWindow:
    """A stretch, and the start and end in s of its setpoint, including the move."""

    stretch: float
    begin: float
    end: float
    #: planned arrival in s; later levels follow creep; None: the last level
    arrival: float | None = None


@dataclass(frozen=True)
class RemainingError:
    """Errors that a repeat leaves at a target, as fractions of the step."""

    vibration: float  #: peak to peak in the first period
    offset: float  #: steady-state error


@dataclass(frozen=True, eq=False)
class Learnt:
    """The next levels, and the residuals of the previous repeats."""

    level_times: Array  #: shape (m,), in s
    levels: Array  #: shape (m,), in T
    left: tuple[tuple[RemainingError, ...], ...]  #: by repeat and target
    best: int  #: index of the repeat with the smallest residual
    frequency: float  #: of the second mode in Hz; NaN if none is found


class _Sequence:
    """Knots of a sequence, and its windows of rest."""

    def __init__(
            self, first: SequenceRepeat, targets: Sequence[TargetWindow],
            actuator: ActuatorParameters) -> None:
        self.targets, self.actuator = targets, actuator
        unit = actuator.time_unit
        self.period = 2.0 * math.pi * unit / np.array([
            float(natural_frequency(x.stretch, actuator.nondimensional)) for x in targets])
        knots: list[float] = []
        self.rests = []
        for target, period in zip(targets, self.period, strict=True):
            # Reported times have errors due to the clock of the device.
            off = _OFF * float(period)
            until = target.end - 2.0 * off if target.arrival is None else target.arrival
            own = first.level_times[
                (first.level_times >= target.begin - off) & (first.level_times < until + off)]
            if not len(own):
                raise BadInputError(
                    f'no level belongs to the setpoint {target.stretch:g}: expected one or more')
            length = float(own[-1] - own[0]) or 0.5 * float(period)
            parts = own[0] + length / _PARTS * np.arange(round(_END * _PARTS) + 1)
            # Prefer knots of the sequence to those nearby, unless it is smooth.
            own = own if len(own) <= _MANY else own[:1]
            knots += [*own, *(x for x in parts if np.min(np.abs(own - x)) > 0.05 * length)]
            self.rests.append(float(own[0]) + _END * length)
            if target.end - self.rests[-1] < period:
                raise BadInputError(
                    f'setpoint {target.stretch:g} is held for {target.end - self.rests[-1]:.3g} s '
                    f'after its move: expected at least a period, {period:.3g} s, to see what is '
                    'left')
        self.knots = np.array(sorted(knots))
        # All levels; those that follow creep change with the last knot before them.
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

    def levels(self, trial: SequenceRepeat) -> Array:
        """Return the levels of a repeat, read in the middle between times."""
        gaps = np.diff(self.times, append=self.times[-1] + 2e-3)
        return trial.at(self.times + 0.5 * np.minimum(gaps, 0.05))

    def windows(self, time: Array) -> list[Places]:
        """Return the indices of samples at rest by target; raise `BadInputError` if too few."""
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
        """Return the residual, with equal weights of the targets."""
        return np.concatenate([
            (stretch[x] - target.stretch) / step / math.sqrt(len(x))
            for x, target, step in zip(
                self.windows(time), self.targets, self.steps, strict=True)])

    def left(self, trial: SequenceRepeat, mode: '_Mode | None') -> tuple[RemainingError, ...]:
        """Return the residual of a repeat, at the frequencies of the model and a second mode."""
        found = []
        for x, target, step, period in zip(
                self.windows(trial.time), self.targets, self.steps, self.period, strict=True):
            time, off = trial.time[x], (trial.stretch[x] - target.stretch) / step
            first = off[time < time[0] + period]
            # Use the amplitude of a fit, so that noise does not count as vibration.
            fitted = _ringing(time[:len(first)], [
                2.0 * math.pi / float(period), *([] if mode is None else [mode.frequency])])
            curve = fitted @ np.linalg.lstsq(fitted, first, rcond=1e-6)[0]
            found.append(RemainingError(float(np.ptp(curve)), float(np.mean(off))))
        return tuple(found)

    def simulated(self, levels: Array, time: Array) -> Array:
        """Return the stretch of the model."""
        unit, loads = self.actuator.time_unit, self.actuator.units.of_level(levels)
        found: Array = simulate(
            np.append(self.times[0] - 1.0, self.times) / unit, np.append(0.0, loads),
            np.maximum(time, self.times[0] - 1.0) / unit, self.actuator.nondimensional)[0]
        return found

    def delay(self, trial: SequenceRepeat) -> float:
        """Return the delay of the samples after the model in s, due to lag and latency."""
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
    """Return a constant, and cosine and sine of frequencies in rad/s, shape (n, 1 + 2 f)."""
    since = time - time[0]
    return np.column_stack([np.ones(len(time)), *(
        f(x * since) for x in frequencies for f in (np.cos, np.sin))])


@dataclass(frozen=True)
class _Mode:
    """A second mode: frequency in rad/s, damping ratio, and static stretch per T."""

    frequency: float
    damping: float
    gain: float = 1.0

    def driven(self, times: Array, levels: Array, time: Array) -> Array:
        """Return its response at ``time``, from ``times[0]`` on, to levels set at ``times``."""
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


def _second_mode(sequence: _Sequence, trial: SequenceRepeat, noise: float) -> _Mode | None:
    """Find a mode that the levels excite, other than the first one and its second harmonic."""
    levels = sequence.levels(trial)
    places = sequence.windows(trial.time)
    # Use only samples at rest.
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
        """Return the reduction of the sum of squares, and the gain."""
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
        trials: Sequence[SequenceRepeat], targets: Sequence[TargetWindow],
        actuator: ActuatorParameters,
        limits: tuple[float, float] = (-math.inf, math.inf)) -> Learnt:
    """
    Return the levels to send next.

    Parameters
    ----------
    trials : sequence of Trial
        Repeats in order: the first with the planned levels, each further one with the levels that
        this function returned for the previous ones.
    targets : sequence of Target
        At least one target.
    actuator : ActuatorParameters
        The actuator used for planning.
    limits : (float, float)
        Minimum and maximum level in T.

    Returns
    -------
    Learnt
        With the same targets and times.

    Raises
    ------
    BadInputError
        If there are no repeats or targets, or the repeats do not fit the targets.

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
    # Regularisation by the ratio of the noise to the expected change.
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
