"""
Learning from repeats in recorded runs: levels of a sequence, corrected by measured residuals.

Effects outside the model, such as hysteresis or further modes, are the same in each repeat. Mass,
damping and a secondary mode of the model are fitted to the repeats, and linear modes about each
target to what this leaves. The next levels follow from the residual of the best repeat and the
derivatives of both, as in norm-optimal iterative learning control (N. Amann, D. H. Owens,
E. Rogers, IEE Proc. D 143, 217 (1996)). Of all that leave as little, they are the smoothest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from hmsa.errors import BadInputError
from hmsa.interfaces.diagnostics import LEVELS
from hmsa.model.equations import Array, natural_frequency
from hmsa.model.modes import Modes
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.simulation import simulate
from hmsa.model.units import NANOSECONDS
from hmsa.runs.record import ROUNDED, Run, setpoints_of

# Parts per duration of a move between which the level may change, and their end in durations:
# without further modes, and beyond it and the half periods of all modes that have at least this
# share, up to the latest. Until 2.25, a cube with a damping ratio of 0.03 keeps 1.4 % even if all
# derivatives are exact.
_PARTS, _END, _BEYOND, _COUNTS, _LATEST = 4, 1.5, 0.25, 0.03, 2.5
# Vibration that the model does not explain (RMS, in units of the step) from which moves end at the
# latest: where shares differ between targets, no mode is found that fits all of them. Otherwise a
# block of H/L 0.9 keeps 5 % (test_learning).
_UNEXPLAINED = 0.01
# Maximum change of a level, its expected standard deviation, and increment for derivatives, all
# relative to the range of the levels.
_LARGEST, _EXPECTED, _CHANGE = 0.3, 0.05, 1e-4
# Weight of the bends of the levels against that of their change. Levels that zigzag excite fast
# modes: a block of H/L 0.3 with a damping ratio of 0.02 needs a repeat more.
_SMOOTH = 0.5
# Frequencies of the first mode to try relative to the model's, of a further mode relative to the
# first and its share and damping ratio, and the minimum improvement of the squares in variances of
# the noise and as a fraction.
_FIRSTS = np.geomspace(0.45, 1.3, 16)
_FREQUENCIES, _SHARE, _DAMPING = np.geomspace(1.1, 12.0, 80), 0.05, 0.02
_CERTAIN, _IMPROVED = 40.0, 0.15
# Minimum ratio of a mode: what is nearer is the first one, whose frequency changes with the swing.
_NEAREST = 1.08
# Linear modes about a target: frequencies relative to the first one and damping ratios to try, the
# number, the expected gain relative to the static one and its weight, the minimum improvement as a
# fraction, and samples in each window.
_TRIED = np.geomspace(0.6, 14.0, 350)
_DAMPED, _LINEAR, _GAIN, _GAIN_WEIGHT, _BETTER, _SAMPLES = (
    (0.01, 0.03, 0.06, 0.1, 0.2, 0.4), 5, 0.1, 0.01, 0.1, 200)
# Maximum share of a mode, exponent of the stretch in its ratio, and number of samples to fit.
_MOST_SHARE, _EXPONENT, _FITTED = 0.45, 5.0, 800
# Frequencies of weak modes that count as vibration, relative to the first one.
_SHOWN = (2.0, 3.0, 4.0)
# Repeats after the best one, all of which left more, from which the best one is repeated.
_FAILED = 2
# Periods after a move that count: later ones mainly show errors of the model's frequency.
_PERIODS = 4.0
# Periods of rest that a longer move leaves to be seen.
_SEEN = 2.0
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
    rests: tuple[float, ...]  #: times in s from which the actuator rests, by target
    repeated: bool  #: whether the levels are those of the best repeat


class _Sequence:
    """Knots of a sequence, and its windows of rest."""

    def __init__(
            self, first: SequenceRepeat, targets: Sequence[TargetWindow],
            actuator: ActuatorParameters, ends: float = _END) -> None:
        self.targets, self.actuator = targets, actuator
        unit = actuator.time_unit
        self.period = 2.0 * math.pi * unit / np.array([
            float(natural_frequency(x.stretch, actuator.nondimensional)) for x in targets])
        knots: list[float] = []
        self.rests: list[float] = []
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
            # As late as the rest can still be seen.
            room = max((target.end - own[0] - _SEEN * float(period)) / length, _END)
            end = min(round(ends * _PARTS), math.floor(room * _PARTS)) / _PARTS
            parts = own[0] + length / _PARTS * np.arange(round(end * _PARTS) + 1)
            # Prefer knots of the sequence to those nearby, unless it is smooth.
            own = own if len(own) <= _MANY else own[:1]
            knots += [*own, *(x for x in parts if np.min(np.abs(own - x)) > 0.05 * length)]
            self.rests.append(float(own[0]) + end * length)
            if target.end - self.rests[-1] < period:
                raise BadInputError(
                    f'setpoint {target.stretch:g} is held for {target.end - self.rests[-1]:.3g} s '
                    f'after its move: expected at least a period, {period:.3g} s, to measure the '
                    'remaining error')
        self.knots = np.array(sorted(knots))
        self.bends = _bends(self.knots, [x.begin for x in targets])
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
            raise BadInputError('a setpoint equals the previous one: expected different stretches')

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

    def left(self, trial: SequenceRepeat, modes: Sequence[float]) -> tuple[RemainingError, ...]:
        """Return the residual of a repeat, at some frequencies in rad/s."""
        found = []
        for x, target, step, period in zip(
                self.windows(trial.time), self.targets, self.steps, self.period, strict=True):
            time, off = trial.time[x], (trial.stretch[x] - target.stretch) / step
            first = off[time < time[0] + period]
            # Use the amplitude of a fit, so that noise does not count as vibration.
            fitted = _ringing(time[:len(first)], modes)
            curve = fitted @ np.linalg.lstsq(fitted, first, rcond=1e-6)[0]
            found.append(RemainingError(float(np.ptp(curve)), float(np.mean(off))))
        return tuple(found)

    def simulated(
            self, levels: Array, time: Array, actuator: ActuatorParameters | None = None
    ) -> Array:
        """Return the stretch of the model."""
        model = self.actuator if actuator is None else actuator
        unit, loads = model.time_unit, model.units.of_level(levels)
        found: Array = simulate(
            np.append(self.times[0] - 1.0, self.times) / unit, np.append(0.0, loads),
            np.maximum(time, self.times[0] - 1.0) / unit, model.nondimensional)[0]
        return found

    def delay(self, trial: SequenceRepeat) -> float:
        """
        Return the delay of the samples after the model in s, due to lag and latency.

        A slower first mode looks like a delay, so that its frequency is varied, too.
        """
        seen, levels, actuator = trial.stretch, self.levels(trial), self.actuator
        delays = float(np.min(self.period)) * _DELAYS
        found = []
        for x in (1.0, *_FIRSTS):
            shown = self.simulated(levels, trial.time, replace(
                actuator, mass_factor=actuator.mass_factor / x**2))
            found += [(float(np.sum((seen - np.interp(trial.time - y, trial.time, shown))**2)), y)
                      for y in delays.tolist()]
        delay: float = min(found)[1]
        return delay

    def changes(self, index: int) -> tuple[Array, Array]:
        """Return times of levels of a move, and their changes by all levels, shape (n, m)."""
        own = (self.times >= self.targets[index].begin - _OFF * self.period[index]) & (
            self.times <= self.rests[index])
        return self.times[own], np.diff(np.eye(len(self.times)), axis=0, prepend=0.0)[own]

    def derivatives(self, levels: Array, time: Array, actuator: ActuatorParameters) -> Array:
        """Return the derivatives of the residual by levels at the knots in T, shape (r, k)."""
        change = _CHANGE * float(np.max(np.abs(levels)))
        base = self.residual(time, self.simulated(levels, time, actuator))
        changed = (self.simulated(levels + change * x, time, actuator) for x in self.held.T)
        return np.column_stack([(self.residual(time, x) - base) / change for x in changed])


def _ringing(time: Array, frequencies: Sequence[float]) -> Array:
    """Return a constant, and cosine and sine of frequencies in rad/s, shape (n, 1 + 2 f)."""
    since = time - time[0]
    return np.column_stack([np.ones(len(time)), *(
        f(x * since) for x in frequencies for f in (np.cos, np.sin))])


def _bends(knots: Array, begins: Sequence[float]) -> Array:
    """
    Return the second differences of levels at knots, shape (b, k).

    Each setpoint starts from a steady level, 0 before the first, and ends with one.
    """
    first = np.searchsorted(knots, np.array(begins) - 1e-3 * knots[-1])
    own = np.eye(len(knots))
    rows: list[Array] = []
    before: Array = np.zeros(len(knots))
    for start, end in zip(first, (*first[1:], len(knots)), strict=True):
        values = np.vstack([before, before, own[start:end], own[end - 1]])
        rows.append(np.diff(values, 2, axis=0))
        before = own[end - 1]
    return np.concatenate(rows)


class _ModelUpdate:
    """The model with mass, damping and secondary modes as the repeats show them."""

    def __init__(
            self, sequence: _Sequence, trials: Sequence[SequenceRepeat], noise: float,
            start: ActuatorParameters | None = None) -> None:
        self._sequence, self._noise = sequence, noise
        self._levels = [sequence.levels(x) for x in trials]
        self._times: list[Array] = []
        self._seen: list[Array] = []
        self._parts: list[list[Places]] = []
        for x in trials:
            # At rest: hysteresis spoils what a move shows of shares.
            parts = sequence.windows(x.time)
            every = max(sum(map(len, parts)) // _FITTED, 1)
            parts = [y[::every] for y in parts]
            places = np.concatenate(parts)
            self._times.append(x.time[places])
            self._seen.append(x.stretch[places])
            self._parts.append(np.split(
                np.arange(len(places)), np.cumsum([len(y) for y in parts])[:-1]))
        spacing = float(np.median(np.diff(self._times[0])))
        first = 2.0 * math.pi / float(np.min(sequence.period))
        self._most = 2.0 * math.pi / (_FEWEST * spacing) / first
        self.found = self._first_mode() if start is None else self._refined(start)
        if not self.found.modes.ratios:
            self._add_mode()

    @property
    def unexplained(self) -> float:
        """RMS of the vibration that the model does not explain, in units of the smallest step."""
        left = self._left(self.found)
        return math.sqrt(float(left @ left) / len(left)) / min(map(abs, self._sequence.steps))

    @property
    def frequencies(self) -> list[float]:
        """Frequencies of all modes about rest in rad/s."""
        found = self.found
        first = float(natural_frequency(found.rest, found.nondimensional)) / found.time_unit
        return [first, *(first * x for x in found.modes.ratios)]

    def _without_offsets(self, values: Sequence[Array]) -> Array:
        """Return values without their mean in each setpoint: hysteresis shifts what is held."""
        return np.concatenate([
            x[y] - np.mean(x[y]) for x, parts in zip(values, self._parts, strict=True)
            for y in parts])

    def _shown(self, actuator: ActuatorParameters) -> Array:
        return self._without_offsets([
            self._sequence.simulated(x, y, actuator)
            for x, y in zip(self._levels, self._times, strict=True)])

    def _left(self, actuator: ActuatorParameters) -> Array:
        left: Array = self._shown(actuator) - self._without_offsets(self._seen)
        return left

    def _refined(self, actuator: ActuatorParameters) -> ActuatorParameters:
        """Return an actuator with mass, damping and modes fitted."""
        modes = actuator.modes
        count = len(modes.ratios)
        # The deflection of a beam at rest is 0, which has no powers.
        power = float(actuator.rest != 0.0)

        def changed(x: Array) -> ActuatorParameters:
            return replace(
                actuator, mass_factor=actuator.mass_factor * math.exp(x[0]),
                damping_coefficient=actuator.damping_coefficient * math.exp(x[1]),
                modes=replace(
                    modes,
                    ratios=tuple((np.array(modes.ratios) * np.exp(x[2:2 + count])).tolist()),
                    shares=tuple(x[2 + count:2 + 2 * count].tolist()),
                    dampings=tuple(x[2 + 2 * count:2 + 3 * count].tolist()),
                    exponents=tuple((power * x[2 + 3 * count:]).tolist())))

        nearest = [math.log(_NEAREST / x) for x in modes.ratios]
        most = _MOST_SHARE / max(count, 1)
        low = [-0.5, -2.0, *(max(-0.1, x) for x in nearest), *[-most] * count, *[0.0] * count,
               *[-_EXPONENT] * count]
        high = [0.5, 2.0, *[0.1] * count, *[most] * count, *[0.5] * count,
                *[_EXPONENT] * count]
        start = np.clip([
            0.0, 0.0, *[0.0] * count, *modes.shares, *modes.dampings, *modes.exponents], low, high)
        found = least_squares(
            lambda x: self._left(changed(x)), start, bounds=(low, high), max_nfev=15,
            x_scale=[0.05, 0.3, *[0.02] * count, *[0.05] * count, *[0.02] * count,
                     *[1.0] * count])
        return changed(found.x)

    def _first_mode(self) -> ActuatorParameters:
        """Return the actuator with the mass and damping that fit best."""
        actuator = self._sequence.actuator
        modes = actuator.modes
        none = (0.0,) * len(modes.ratios)
        actuator = replace(actuator, modes=replace(
            modes, exponents=modes.exponents or none,
            share_exponents=modes.share_exponents or none))
        tried = [replace(actuator, mass_factor=actuator.mass_factor / x**2)
                 for x in (*_FIRSTS, 1.0)]
        return self._refined(min(tried, key=lambda x: float(np.sum(self._left(x)**2))))

    def _add_mode(self) -> None:
        """Add the mode that explains most of what remains, if it explains enough."""
        base, left = self._shown(self.found), self._left(self.found)
        before, tried = float(left @ left), []
        for ratio in _FREQUENCIES[self._most > _FREQUENCIES]:
            mode = Modes((float(ratio),), (_SHARE,), (_DAMPING,), (0.0,), (0.0,))
            change = self._shown(replace(self.found, modes=mode)) - base
            size = -float(change @ left) / max(float(change @ change), 1e-300)
            share = min(max(size * _SHARE, -0.5 * _MOST_SHARE), 0.5 * _MOST_SHARE)
            tried.append((size**2 * float(change @ change), replace(mode, shares=(share,))))
        if not tried:
            return
        found = self._refined(replace(self.found, modes=max(tried, key=lambda x: x[0])[1]))
        after = float(np.sum(self._left(found)**2))
        if before - after >= max(_CERTAIN * self._noise**2, _IMPROVED * before):
            self.found = found


def _further_derivatives(
        sequence: _Sequence, trials: Sequence[SequenceRepeat], best: int,
        found: ActuatorParameters) -> Array:
    """
    Return what linear modes add to the derivatives at the best repeat, shape (r, k).

    A mode of a pole p rings about its target with a complex gain times the sum of
    exp(p (t - t_k)) over the changes of the level at t_k. Poles and gains are those that explain
    most of what the model does not. Repeats that ring less count more: in others, errors of the
    model hide weak modes.
    """
    levels = [sequence.levels(x) for x in trials]
    windows = [sequence.windows(x.time) for x in trials]
    missed = [x.stretch - sequence.simulated(y, x.time, found)
              for x, y in zip(trials, levels, strict=True)]
    spacing = float(np.median(np.diff(trials[0].time)))
    added = []
    for i, (rest, target, step) in enumerate(zip(
            sequence.rests, sequence.targets, sequence.steps, strict=True)):
        first = float(natural_frequency(target.stretch, found.nondimensional)) / found.time_unit
        tried = first * _TRIED
        tried = tried[tried * _FEWEST * spacing < 2.0 * math.pi]
        poles = np.concatenate([complex(-x, math.sqrt(1.0 - x**2)) * tried for x in _DAMPED])
        times, changes = sequence.changes(i)
        # Of each pole at rest, by all levels, in units of the expected gain.
        gain = _GAIN * abs(step / float(np.sum(changes @ levels[0])))
        phasors = gain * np.exp(poles[:, None] * (rest - times)) @ changes

        def ringing(of: NDArray[np.complex128], time: Array, rest: float = rest) -> Array:
            rings = np.exp(of[:, None] * (time - rest))
            about: Array = rings - rings.mean(axis=1, keepdims=True)
            return about

        parts, seen = [], []
        for trial, level, window, off in zip(trials, levels, windows, missed, strict=True):
            places = window[i][::max(len(window[i]) // _SAMPLES, 1)]
            weight = 1.0 / max(float(np.std(trial.stretch[places])), 1e-12)
            parts.append(weight * (phasors @ level)[:, None] * ringing(poles, trial.time[places]))
            seen.append(weight * (off[places] - np.mean(off[places])))
        shown = np.concatenate(seen)
        size = max(float(np.linalg.norm(shown)), 1e-300)
        shown, rings = shown / size, np.concatenate(parts, axis=1) / size
        powers = _GAIN_WEIGHT + 0.5 * np.sum(np.abs(rings)**2, axis=1)
        chosen: list[int] = []
        gains, left, squares = np.zeros(0), shown, 1.0
        while len(chosen) < _LINEAR and len(poles):
            more = [*chosen, int(np.argmax(np.abs(rings @ left)**2 / powers))]
            basis = np.concatenate([rings[more].real, -rings[more].imag]).T
            now = np.linalg.solve(
                basis.T @ basis + _GAIN_WEIGHT * np.eye(2 * len(more)), basis.T @ shown)
            left = shown - basis @ now
            after = float(left @ left + _GAIN_WEIGHT * now @ now)
            if after > (1.0 - _BETTER) * squares:
                break
            chosen, gains, squares = more, now, after
        time = trials[best].time[windows[best][i]]
        turned = (gains[:len(chosen)] + 1j * gains[len(chosen):])[:, None] * phasors[chosen]
        added.append((ringing(poles[chosen], time).T @ turned @ sequence.held).real / (
            step * math.sqrt(len(time))))
    return np.concatenate(added)


def _ends(actuator: ActuatorParameters, update: _ModelUpdate) -> float:
    """Return the end of moves in durations of those planned, with modes as they are found."""
    modes = update.found.modes
    halves = [1.0 / x for x, share in zip(modes.ratios, modes.shares, strict=True)
              if abs(share) >= _COUNTS]
    end = _LATEST if update.unexplained > _UNEXPLAINED else (
        min(_END + _BEYOND + sum(halves), _LATEST) if halves else _END)
    return end * max(update.found.period / actuator.period, 1.0)


def _noise(trial: SequenceRepeat) -> float:
    """Return the standard deviation of a sample."""
    return float(np.median(np.abs(np.diff(trial.stretch, 2)))) / 0.6745 / math.sqrt(6.0)


def learn(
        trials: Sequence[SequenceRepeat], targets: Sequence[TargetWindow],
        actuator: ActuatorParameters,
        limits: tuple[float, float] = (-math.inf, math.inf)) -> Learnt:
    """
    Return the levels to send next.

    Parameters
    ----------
    trials : sequence of SequenceRepeat
        Repeats in order: the first with the planned levels, each further one with the levels that
        this function returned for the previous ones.
    targets : sequence of TargetWindow
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
    for x in trials:
        sequence.windows(x.time)
    update = _ModelUpdate(sequence, trials[:1], _noise(trials[0]))
    sequence = _Sequence(trials[0], targets, actuator, _ends(actuator, update))
    residuals = [sequence.residual(x.time, x.stretch) for x in trials]
    best = int(np.argmin([float(x @ x) for x in residuals]))
    trial, residual = trials[best], residuals[best]
    levels = sequence.levels(trial)
    noise = _noise(trial)
    if best:
        update = _ModelUpdate(sequence, [trials[0], trial], noise, update.found)
    slopes = sequence.derivatives(levels, trial.time, update.found) + _further_derivatives(
        sequence, trials, best, update.found)
    size = float(np.ptp(np.append(levels, 0.0)))
    # Regularisation by the ratio of the noise to the expected change, which falls with the
    # residual: near the targets, hysteresis turns large changes into steady-state errors.
    weight = max(noise, 1e-7) / min(map(abs, sequence.steps)) / math.sqrt(
        len(residual) / len(targets)) / (_EXPECTED * size)
    first, last = (max(float(np.linalg.norm(x)), 1e-300) for x in (residuals[0], residual))
    nearer = math.sqrt(first / last)
    # The plan is made smooth, and what left less than it is changed smoothly.
    bends = np.zeros(len(sequence.bends)) if best else sequence.bends @ np.linalg.lstsq(
        sequence.held, levels, rcond=None)[0]
    change = np.linalg.lstsq(
        np.vstack([slopes, nearer * weight * np.eye(slopes.shape[1]),
                   _SMOOTH * weight * sequence.bends]),
        np.concatenate([-residual, np.zeros(slopes.shape[1]), -_SMOOTH * weight * bends]),
        rcond=None)[0]
    failed = len(trials) - 1 - best
    change *= 0.5 ** failed * min(
        1.0, _LARGEST * size / max(float(np.max(np.abs(change))), 1e-300))
    if failed >= _FAILED:
        change *= 0.0
    frequencies = update.frequencies
    weaker = [x * frequencies[0] for x in _SHOWN]
    return Learnt(
        sequence.times, np.clip(levels + sequence.held @ change, *limits),
        tuple(sequence.left(x, [*frequencies, *weaker]) for x in trials), best,
        frequencies[1] / (2.0 * math.pi) if len(frequencies) > 1 else math.nan,
        tuple(sequence.rests), failed >= _FAILED)


def learn_from(runs: Sequence[Run]) -> tuple[Learnt, list[TargetWindow]]:
    """
    Learn from runs of one sequence.

    Parameters
    ----------
    runs : sequence of Run
        Runs in order: the first one with setpoints, each further one with the levels learnt from
        the previous ones.

    Returns
    -------
    (Learnt, list of TargetWindow)
        The next levels, and the setpoints, in s from the first level.

    Raises
    ------
    BadInputError
        If there are no setpoints, or a run does not begin without a field.

    """
    first = runs[0]
    begins = [_begin(x) for x in runs]
    given = first.outcomes and all(x.asked == LEVELS for x in first.outcomes)
    requested = [] if given else [x.setpoint for x in setpoints_of(first)]
    if not requested:
        raise BadInputError(
            f'{first.path} has no setpoints: expected the run of a sequence as it was planned '
            'first, such as of hmsa run 1.10:0.5 1.00:0.5')
    last = min(int(x.time[-1]) - y for x, y in zip(runs, begins, strict=True))
    ends = [x.begins for x in requested[1:]] + [
        requested[-1].end if requested[-1].end is not None else begins[0] + last]
    targets = [
        TargetWindow(x.target, max((x.begins - begins[0]) / NANOSECONDS, 0.0),
               (end - begins[0]) / NANOSECONDS,
               None if x.arrival is None else (x.arrival - begins[0]) / NANOSECONDS)
        for x, end in zip(requested, ends, strict=True)]
    low, high = (first.number('planner.flux_density_max') or 0.5) * np.array((-1.0, 1.0))
    return learn(
        [_trial(x, begin) for x, begin in zip(runs, begins, strict=True)], targets,
        first.planner, (float(low), float(high))), targets


def _begin(run: Run) -> int:
    """Return the time in ns at which the first level of a run took effect."""
    largest = max((abs(x.flux_density) for x in run.levels), default=0.0)
    asked = min((x.setpoint.begins for x in run.outcomes), default=int(run.time[0]))
    for x in run.levels:
        # Smaller levels are due to rounding, or compensate the remanence of a core.
        if abs(x.flux_density) > ROUNDED * largest:
            if x.stamp < asked:
                break
            return x.stamp
    raise BadInputError(
        f'{run.path} does not begin at rest without a field: expected a sequence that does, and '
        'levels that took effect')


def _trial(run: Run, begin: int) -> SequenceRepeat:
    """Return a repeat, with times from its first level."""
    since = (run.time - begin) / NANOSECONDS
    levels = [x for x in run.levels if x.stamp >= begin]
    times = np.array([(x.stamp - begin) / NANOSECONDS for x in levels])
    # Of levels at the same time the last one applies.
    keep = np.append(np.diff(times) > 0.0, True)
    seen = (since >= 0.0) & np.isfinite(run.stretch)
    return SequenceRepeat(
        since[seen], run.stretch[seen], times[keep],
        np.array([x.flux_density for x in levels])[keep])


def sequence_text(found: Learnt, targets: Sequence[TargetWindow], runs: Sequence[Path]) -> str:
    """Return a learnt sequence as YAML for ``hmsa run --levels``."""
    end = targets[-1].end
    rows = [*zip(found.level_times.tolist(), found.levels.tolist(), strict=True),
            (end, float(found.levels[-1]))]
    return '\n'.join([
        f'# by hmsa learn, from {", ".join(map(str, runs))}',
        'setpoints:  # stretch, from and until, in s',
        *(f'  - [{x.stretch:.9g}, {x.begin:.9f}, {x.end:.9f}]' for x in targets),
        'levels:  # time in s, and flux density in T from then on',
        *(f'  - [{x:.9f}, {y:.9g}]' for x, y in rows)]) + '\n'


def levels_in(path: Path) -> list[tuple[float, float]]:
    """
    Return times in s and levels in T of a learnt sequence.

    Raises
    ------
    BadInputError
        If the file cannot be read, or is no learnt sequence.

    """
    import yaml

    try:
        found = yaml.safe_load(path.read_text(encoding='utf-8'))
        rows = [(float(x), float(y)) for x, y in found['levels']]
        if not rows or not np.all(np.isfinite(rows)) or np.any(
                np.diff([x for x, _ in rows]) <= 0.0):
            raise ValueError
    except OSError as error:
        raise BadInputError(f'cannot read {path}: {error.strerror}') from error
    except (yaml.YAMLError, KeyError, TypeError, ValueError, UnicodeDecodeError) as error:
        raise BadInputError(
            f'{path} is no learnt sequence: expected levels, a list of [time in s, flux density '
            'in T] at rising times, as hmsa learn writes it') from error
    return rows
