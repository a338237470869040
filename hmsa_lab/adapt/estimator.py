"""Estimator of an actuator: samples in, state and parameters out."""

from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import itertools
import math
from typing import Any

import numpy as np

from hmsa.errors import check_number
from hmsa.identification.fit import robust_scale
from hmsa.identification.quantities import (
    actuator_of,
    BRANCHES,
    complete,
    coordinates,
    derivative,
    quantity_of,
    TEMPERATURE,
    values_at,
    WARMED,
    WARMING,
)
from hmsa.model.creep import Creep
from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import NANOSECONDS
from hmsa.planning.timeline import ESTIMATED, JointModel
from hmsa.planning.timeline import Options as PlannerOptions
from hmsa_lab.adapt.hypotheses import hypotheses
from hmsa_lab.adapt.motion import follow, Levels, ModelMotion, rest
from hmsa_lab.adapt.prior import Prior
from hmsa_lab.adapt.screening import Screening
from hmsa_lab.adapt.window import (
    BiasCase,
    Jump,
    PART,
    Rest,
    Simulation,
    Solution,
    Window,
)

# Initial noise, before it is estimated, and minimum noise.
_FIRST_NOISE, _LEAST_NOISE = 1e-3, 2e-6
_FEWEST_FOR_NOISE = 10
# Gain of the filter that tracks the noise of the residuals.
_NOISE_GAIN = 0.05
# Maximum deviation of an estimate from the prior, and drift of a parameter in a second, relative
# to the spread of the prior. With 0.003, moves 3 to 6 of `benchmarks harm` leave more, and with
# 3e-4, gain, remanence and force become too certain.
_BOUND, _DRIFT = 4.0, 1e-3
# The same of a sensor: one that has drifted is then found as before (test_feedback_trust.py).
_DRIFT_OF_SENSOR, _BIAS_AND_GAIN = 3e-3, ('stretch_bias', 'stretch_gain')
# The same where the temperature is estimated.
_SLOWER = 3e-4
# Drift of the temperature in K in a second unless it is measured, and in a kelvin of measured
# change; and duration in s at rest in which it counts as constant (benchmarks/warming.py).
_WARMS, _BY_KELVIN, _CONSTANT = 0.2, 0.3, 1.0
# Fraction of this maximum above which an estimate is not trusted, except for uncertain parameters.
_STRANGE, _FREELY = 0.98, ('damping_coefficient', 'viscoelastic_time')
# Factor on a variance that keeps a parameter fixed.
_FIXED = 1e-12
# Standard deviations of stretch and rate (in natural frequencies) of a block at rest, and in an
# unknown state; and time scales after a change of level until rest.
_AT_REST, _ANYWHERE, _SETTLED = 2e-6, 0.3, 25.0
# Time scales between changes of level above which the later one starts a new move.
_CALM = 12.0
# Change of level, relative to the largest one, up to which it is a correction of a move.
_CORRECTS = 0.1
# Log odds from which the actuator, or the sensor before the first motion, has jumped, and maximum
# number of samples in a row that do not fit and may show this.
_JUMPED, _REFUSED = 6.0, 100
# Acceleration by a jump of the modulus, with time in time scales.
_PUSHED = 0.15
# Maximum number of windows of samples that wait for an update.
_WAITING = 10
#: Standard deviations above which a suspected viscoelastic branch is used.
CREEPS = 2.0
# Parameters that plans compensate for by other levels, however small they are.
_AS_IS = ('coil_time_constant', *BRANCHES[0])
# Fraction of the window that stays when it moves on, its maximum duration in time scales, and the
# number of samples above which that applies.
_KEPT, _LONGEST, _FEWEST = 0.5, 200.0, 20


@dataclass(frozen=True)
class EstimatorOptions:
    """Options of the estimator."""

    window: int = 600  # maximum number of samples in the horizon
    noise: float = 0.0  # standard deviation of a sample of stretch; 0 to estimate it
    learn: bool = True  # estimate parameters from the first sample on; else only the state
    gate: float = 6.0  # standard deviations of the innovation above which a sample is rejected
    slew_limit: float = math.inf  # of the amplifier in T/s; infinite for steps

    def __post_init__(self) -> None:
        for name, least in (('window', 10), ('noise', 0.0), ('gate', 1.0)):
            check_number(name, getattr(self, name), least=least)


@dataclass(frozen=True, eq=False)
class StateEstimate:
    """Estimated state and parameters at a time."""

    time: int  # in ns
    stretch: float
    rate: float  # of the block in 1/s
    # Of all quantities; see `hmsa_lab.adapt.motion.follow` for branches.
    values: dict[str, Any]
    free: tuple[str, ...]  # tracked quantities
    deviations: dict[str, float]  # standard deviations of these, in SI units
    covariance: Array  # of their coordinates, of stretch and of rate, about the values
    off: Array  # expected minus most probable values
    # As `off` for plans, where other parameters represent an apparent gain of the sensor.
    instead: Array
    doubt: BiasCase
    gain: int  # index of a suspected gain of the sensor about rest; -1 for none
    noise: float  # standard deviation of a sample
    trusted: bool  # whether it may be used for plans
    trouble: str  # reason if not; else empty
    jumped: float  # log odds that the sensor has changed since the last move began
    jump: int  # time in ns from which it has
    changed: float  # relative log odds that the sensor is not as before; see `Solution`
    poor: bool  # whether the newest samples fit worse than their noise

    @property
    def actuator(self) -> ActuatorParameters:
        """The block; with viscoelasticity if it is significant."""
        return self.block(CREEPS)

    def block(self, sure: float) -> ActuatorParameters:
        """Return the block; with viscoelasticity if its ratio exceeds some standard deviations."""
        found, (ratio, time) = actuator_of(self.values), BRANCHES[0]
        value = self.values[ratio]
        if ratio in self.free and value > sure * self.deviations[ratio]:
            return replace(found, creep=Creep((value,), (self.values[time],)))
        return found

    @property
    def doubted(self) -> 'StateEstimate':
        """The estimate with possible errors of a constant force and the gain of the sensor."""
        return replace(self, off=self.doubt.off, covariance=self.doubt.covariance)

    def sure_of(self, first: int) -> 'StateEstimate':
        """Return the estimate as if all quantities from index ``first`` on were known."""
        covariance, known = self.covariance, slice(first, -2)
        cross = covariance[:, known]
        left = covariance - cross @ np.linalg.pinv(
            covariance[known, known], hermitian=True) @ cross.T
        left[known], left[:, known] = 0.0, 0.0
        return replace(
            self, covariance=left, off=np.zeros_like(self.off),
            instead=np.zeros_like(self.off))

    def model(self, options: PlannerOptions, sure: float = CREEPS) -> JointModel:
        """
        Return the model to plan with; estimates replace options.

        The coil is the most probable one, and creep is that of `block`. Other parameters are those
        expected under these conditions, over all uncertainty.
        """
        block, z = self.block(sure), coordinates(self.values, self.free)
        known = [i for i, x in enumerate(self.free) if x in _AS_IS]
        off, instead = self.off[:-2], self.instead[:-2]
        left = -instead
        if BRANCHES[0][0] in self.free and not block.creep:
            i = self.free.index(BRANCHES[0][0])
            left[i] -= z[i]
        spread = self.covariance[:-2, :-2] - np.outer(off, off)
        # A lag of zero is exact: otherwise plans would compensate for one.
        kept = (z + (instead + left))[known]
        z += instead + spread[:, known] @ np.linalg.pinv(
            spread[np.ix_(known, known)], hermitian=True) @ left[known]
        z[known] = kept
        found = replace(self, values=complete(values_at(self.values, self.free, z), self.free))
        return JointModel(
            replace(found.block(sure), creep=block.creep),
            replace(options, **{x: found.values[x] for x in ESTIMATED}))


class Estimator:
    """Estimator of one actuator."""

    def __init__(self, prior: Prior, options: EstimatorOptions | None = None) -> None:
        self.options = options or EstimatorOptions()
        self.screening = Screening(self.options.gate, prior.coordinate)
        # If False, parameters stay fixed from the next update on.
        self.learning = self.options.learn
        # Whether the actuator may jump: until a whole move has fitted, a missing mode looks like
        # that.
        self.actuator_may_jump = False
        self.unmeasured = True  # whether the temperature may change without a measurement
        self._levels: list[tuple[int, float]] = []
        self._origin = 0
        self.restart(prior)

    def restart(
            self, prior: Prior, samples: Sequence[tuple[int, float]] = (), *, settled: bool = True
    ) -> None:
        """
        Discard all estimates, and begin with a prior, and samples; counts and levels stay.

        Unless ``settled``, a block that has rested need not be at the equilibrium of its level.
        """
        self.prior, self._settled = prior, settled
        # That of a sensor which repeats a value would be none.
        self.noise = self.options.noise or _FIRST_NOISE
        self.screening.restart()
        self._pending = list(samples)
        self._window: Window | None = None
        self._solution: Solution | None = None
        # Covariance of the parameters while they are fixed.
        self._fixed: Array | None = None
        self._warmed = 0.0  # change of the measured temperature in K since the window began
        self._refused: list[tuple[int, float]] = []  # samples that do not fit since others did
        self.actuator_jump = 0  # time in ns of the last jump of the actuator

    @property
    def since(self) -> int:
        """Time in ns from which levels count."""
        return self._origin

    @property
    def newest(self) -> int:
        """Timestamp in ns of the newest sample in use; 0 for none."""
        window = self._window
        return 0 if window is None or not len(window.time) else (
            self._origin + round(float(window.time[-1]) * NANOSECONDS))

    def count_since(self, stamp: int) -> int:
        """Return the number of samples in use from a timestamp in ns on."""
        window = self._window
        return 0 if window is None else int(np.sum(window.time >= self._seconds(stamp)))

    def set_levels(
            self, levels: Sequence[tuple[int, float]], void: tuple[int, int] = (0, 0)) -> None:
        """
        Set all levels from a time on (timestamp in ns, T).

        Earlier ones stay, but for those between the times ``void``, which never took effect.
        """
        first, (begin, end) = levels[0][0], void
        self._levels = [
            x for x in self._levels if x[0] < first and not begin < x[0] < end] + list(levels)

    def sample(self, stamp: int, stretch: float) -> bool:
        """Add a stretch measured at a timestamp in ns; return whether it can be used."""
        if not self.screening.readable(stretch):
            return False
        if self._window is not None and stamp < self._origin + round(
                self._window.begin * NANOSECONDS):
            self.screening.late += 1
            return False
        pending = self._pending
        # Almost always the newest one.
        place = len(pending) if not pending or pending[-1][0] < stamp else (
            bisect_left(pending, stamp, key=lambda x: x[0]))
        if place < len(pending) and pending[place][0] == stamp or self._taken(stamp):
            self.screening.repeated += 1
            return False
        pending.insert(place, (stamp, stretch))
        # Without updates, as before the first move, only the newest samples are kept.
        limit = self.options.window * (1 if self._window is None else _WAITING)
        self.screening.late += len(self._pending[:-limit])
        del self._pending[:-limit]
        return True

    def update(self, time: int) -> StateEstimate | None:
        """
        Process samples, and predict the state at a time in ns.

        Levels until then must have been set. Return None before the first sample.
        """
        self._leave_behind(time)
        if self._window is None and not self._pending:
            return None
        window = self._window or self._new_window(*self._pending[0])
        self._window = window
        levels = self._as_levels()
        until = max([self._seconds(x) for x, _ in self._pending[-1:]] + window.time[-1:].tolist()
                    + [self._seconds(time), window.begin])
        z = window.mean if self._solution is None else self._solution.z
        window.settle(z, _AT_REST)
        here = self._take(window, levels, until)
        found = window.solve(z, levels, window.scatter(self.noise), until, here)
        jumped = found is not None and window.first and found.sensor.odds > _JUMPED
        if found is not None and jumped and self._unchanged(
                self._origin, self._origin + round(until * NANOSECONDS), 0.0):
            # What a sensor showed until it jumped does not count.
            self.restart(self.prior.with_any_bias, [
                (self._origin + round(x * NANOSECONDS), y) for x, y in zip(
                    window.time.tolist(), window.stretch.tolist(), strict=True)
                if x >= found.sensor.time], settled=self._settled)
            return self.update(time)
        if found is not None and window.first:
            found = replace(found, sensor=Jump())
        elif found is not None:
            found, until = self._with_jump(window, found, levels, until)
            window = self._window
        if found is None or np.any(np.diag(found.covariance) < 0.0):
            self.screening.trouble = 'no motion leads through the samples'
            return None
        self._solution = found
        self._follow_noise(found)
        estimate = self._estimate(time, found, window)
        self._go_along(window, found, until)
        self._solution = self._solution.without_samples
        return estimate

    def _with_jump(
            self, window: Window, found: Solution, levels: Levels, until: float
    ) -> tuple[Solution | None, float]:
        """Return the solution after a jump of the actuator, if any, and its time in s."""
        trouble = self.screening.trouble
        if not self.actuator_may_jump or self._fixed is not None or (
                'repeats' in trouble or not len(window.time)):
            return replace(found, actuator=Jump()), until
        refused = self._refused if trouble else []
        if refused:
            wider = window.wider([(self._seconds(x), y) for x, y in refused])
            found = replace(found, actuator=wider.jump_of_actuator(
                found.z, levels, wider.scatter(self.noise), until))
        if found.actuator.odds <= _JUMPED:
            return found, until
        stamp = self._origin + round(until * NANOSECONDS)
        self._solution, self._refused = found, []
        self.actuator_jump = self._origin + round(found.actuator.time * NANOSECONDS)
        self.screening.restart()
        self._go_along(window, found, until)
        window = (self._window or window).wider([(self._seconds(x), y) for x, y in refused])
        # Another jump during the same move is improbable.
        window.first = True
        window.settle(self._solution.z, _AT_REST)
        # Times of samples are rounded.
        self._window, until = window, max([self._seconds(stamp), *window.time[-1:].tolist()])
        return window.solve(
            self._solution.z, self._as_levels(), window.scatter(self.noise), until), until

    def predict(self, time: int) -> StateEstimate | None:
        """
        Return the estimate for a future time in ns, without processing samples.

        The time is not before that of the last `update`, and levels until then must have been set.
        Before the first update, the prior at rest is used. Return None if the motion cannot be
        simulated.
        """
        window, found = self._window, self._solution
        if window is None:
            window = self._new_window(time, self.prior.coordinate.rest)
            found = window.solve(window.mean, self._as_levels(), self.noise, window.begin)
        if found is None:
            return None
        motion = self._follow(
            found, window, max(self._seconds(time), window.begin), self.prior.free)
        if motion is None:
            return None
        return self._estimate(
            time, replace(found, here=found.here._replace(motion=motion)), window)

    def _follow(
            self, found: Solution, window: Window, time: float, free: Sequence[str] = ()
    ) -> ModelMotion | None:
        """Return the motion of a solution at a time in s."""
        return follow(
            found.here.values, free, (float(found.z[-2]), float(found.z[-1])), self._as_levels(),
            window.begin, np.array([time]))

    def _leave_behind(self, time: int) -> None:
        """Drop samples from long before a time in ns, and a window without later samples."""
        oldest = time - round(_LONGEST * self.prior.values['time_unit'] * NANOSECONDS)
        place = bisect_left(self._pending, oldest, key=lambda x: x[0])
        self.screening.late += place
        del self._pending[:place]
        window = self._window
        if window is None or self._origin + round(NANOSECONDS * (
                float(window.time[-1]) if len(window.time) else window.begin)) >= oldest:
            return
        prior = self._so_far(time)
        self._solution = None
        self._window = self._new_window(
            *(self._pending or [(time, prior.coordinate.rest)])[0], prior)

    def _so_far(self, time: int) -> Prior:
        """Return the present knowledge of the parameters at a time in ns, as a prior."""
        found = self._solution
        if found is None:
            return self.prior
        known, prior = self._fixed, self.prior
        if known is None:
            known = found.covariance[:-2, :-2] + np.diag(self._drift(self._seconds(time)))
        warming = self._warming(np.eye(len(found.z)))
        values = {x: y for x, y in found.here.values.items() if x != 'behind'}
        if TEMPERATURE in prior.free:
            values |= values_at(values, prior.free, (warming @ found.z)[:-2])
            values[WARMED] += self._warmed
            self._warmed = 0.0
        warming = warming[:-2, :-2]
        return replace(prior, values=values, covariance=warming @ known @ warming.T)

    def _drift(self, duration: float) -> Array:
        """Return the variance that parameters gain in some seconds, at most their spread's."""
        spread, free = self.prior.spread, self.prior.free
        # A change within minutes is one of the temperature, if that changes parameters.
        rate = np.array([_DRIFT_OF_SENSOR if x in _BIAS_AND_GAIN else _DRIFT for x in free])
        gained = (spread * (_SLOWER if TEMPERATURE in free else rate)) ** 2 * max(duration, 0.0)
        if TEMPERATURE in free:
            gained[free.index(TEMPERATURE)] = _BY_KELVIN ** 2 * abs(self._warmed) + (
                _WARMS ** 2 * max(duration, 0.0) * self.unmeasured)
        return np.asarray(np.minimum(gained, spread ** 2))

    def warmed(self, by: float) -> None:
        """Take a change of the measured temperature of the block in K into account."""
        if TEMPERATURE in self.prior.free:
            self._warmed += by

    def _warming(self, follows: Array) -> Array:
        """
        Return how coordinates have changed with the measured temperature since the window began.

        ``follows`` is the derivative of all coordinates by each one.
        """
        change, free = np.eye(len(follows)), self.prior.free
        if self._warmed:
            change[:, free.index(WARMING)] += self._warmed * follows[:, free.index(TEMPERATURE)]
        return change

    def _new_window(self, stamp: int, shown: float, prior: Prior | None = None) -> Window:
        """Return a window at the equilibrium of the present level, else at the reading."""
        if not self._levels or self._levels[0][0] > stamp:
            self._levels.insert(0, (stamp, 0.0))
        self._origin = stamp
        prior = prior or self.prior
        mean = coordinates(prior.values, prior.free)
        self._fixed = None if self.learning else prior.covariance
        known = prior.covariance * (1.0 if self.learning else _FIXED)
        level = self._level(stamp)
        at = rest(prior.values, prior.free, level)
        stretch, frequency = at[:2] if at else (shown, 1.0 / prior.values['time_unit'])
        rests = at is not None and self._settled and self._unchanged(stamp, stamp, _SETTLED)
        off = _AT_REST if rests else _ANYWHERE
        covariance = np.zeros((len(mean) + 2, len(mean) + 2))
        covariance[:-2, :-2] = known
        covariance[-2:, -2:] = np.diag(np.square([off, off * frequency]))
        window = Window(
            dict(prior.values), prior.free, np.append(mean, [stretch, 0.0]), covariance,
            _bounds(self.prior), PART * self.prior.spread, 0.0, np.zeros(0), np.zeros(0),
            hypotheses(
                prior.free, prior.suspects, prior.named,
                tuple(coordinates(self.prior.values, self.prior.free).tolist()),
                tuple((1.0 / np.diag(self.prior.covariance)).tolist())),
            self._window.suspected if self._window else (),
            rest=Rest(level, mean, known) if rests else None, before=prior.before)
        window.settle(window.mean, _AT_REST)
        return window

    def _take(self, window: Window, levels: Levels, until: float) -> Simulation | None:
        """
        Move waiting samples that fit the estimated motion into the window.

        Return the simulation of that motion for all samples, until a time in s, if known.
        """
        waiting, self._pending = self._pending, []
        times = np.array([self._seconds(x) for x, _ in waiting])
        stretch = np.array([x for _, x in waiting])
        found, count = self._solution, len(window.time)
        if found is None and not self.options.noise and len(stretch) >= _FEWEST_FOR_NOISE:
            self.noise = max(robust_scale(np.diff(stretch, 2)) / math.sqrt(6.0), _LEAST_NOISE)
        both = np.append(window.time, times)
        order = np.argsort(both, kind='stable')
        window.time, window.stretch = both[order], np.append(window.stretch, stretch)[order]
        noise = window.scatter(self.noise)
        here = None if found is None else window.simulate(found.z, levels, noise, until)
        if found is None or here is None:
            return None
        new = np.flatnonzero(order >= count)
        fits = self.screening.fitting(
            window.stretch[new], here.residual[new], here.by[new], found.covariance, noise)
        if np.all(fits):
            self._refused = self._refused if self.screening.trouble else []
            return here
        self._refused = [*self._refused, *(
            (self._origin + round(float(window.time[i]) * NANOSECONDS), float(window.stretch[i]))
            for i in new[~fits])][-_REFUSED:]
        window.time, window.stretch = (
            np.delete(x, new[~fits]) for x in (window.time, window.stretch))
        return None

    def _follow_noise(self, found: Solution) -> None:
        residual = found.here.residual
        if self.options.noise or len(residual) < _FEWEST_FOR_NOISE:
            return
        seen = max(robust_scale(residual), _LEAST_NOISE)
        gain = _NOISE_GAIN if self.noise < 3.0 * seen else 0.5
        self.noise = math.exp(
            (1.0 - gain) * math.log(self.noise) + gain * math.log(seen))

    def _estimate(self, time: int, found: Solution, window: Window) -> StateEstimate:
        state, covariance, off, doubt = found.at_end()
        values = found.here.values
        if found.here.motion.behind:
            values = {**values, 'behind': found.here.motion.behind}
        # A bias may be a force instead, or differ from one only by the gain of the sensor.
        variances = np.where(
            [x == 'stretch_bias' for x in (*self.prior.free, '', '')],
            np.maximum(np.diag(covariance), np.diag(doubt.covariance)), np.diag(covariance))
        if self._fixed is not None:
            covariance[:-2, :-2], off = self._fixed, np.zeros_like(off)
            variances, doubt = np.diag(covariance), BiasCase(off, covariance)
        deviations = {
            name: abs(derivative(name, values[name])) * math.sqrt(variances[i])
            for i, name in enumerate(self.prior.free)}
        trouble = self.screening.trouble or self._strange(found.z)
        return StateEstimate(
            time, float(state[-2]), float(state[-1]), values, self.prior.free, deviations,
            covariance, off, found.instead, doubt, window.suspects.gain, self.noise,
            not trouble, trouble, found.sensor.odds,
            self._origin + round(found.sensor.time * NANOSECONDS), found.changed, found.poor)

    def _strange(self, z: Array) -> str:
        """Return a message on implausible parameters that samples would need; else empty."""
        prior = self.prior
        off = np.abs(prior.departures(z[:-2]))
        names = [x for x, share in zip(prior.free, off.tolist(), strict=True)
                 if share >= _STRANGE * _BOUND and x not in _FREELY]
        return f'samples fit only with an implausible {" and ".join(names)}' if names else ''

    def _go_along(self, window: Window, found: Solution, until: float) -> None:
        """Drop the oldest samples."""
        here, count = found.here, len(window.time)
        span = _LONGEST * here.values['time_unit']
        # A whole move is fitted at once, since early in one linearisation would be inaccurate.
        before = int(np.searchsorted(window.time, self._seconds(self._move_begins(until))))
        jumps = found.actuator.odds > _JUMPED
        if jumps:
            place = min(int(np.searchsorted(window.time, found.actuator.time)), count - 1)
        elif before > 1:
            place = before - 1
        elif count > self.options.window or (
                count >= _FEWEST and float(window.time[-1]) - window.begin > span):
            place = int((1.0 - _KEPT) * count)
        elif count and TEMPERATURE in self.prior.free and self._rests(float(window.time[-1])):
            # Its equilibrium follows the temperature.
            place = count - 1
        elif self.learning is not (self._fixed is None):
            place = max(count - 1, 0)
        else:
            return
        # After the last sample use the requested time.
        time = float(window.time[place]) if place < count else until
        drift, known = np.zeros(len(window.mean)), np.full(len(window.mean), math.inf)
        # Vibration decays to nothing, and an exact state has no covariance.
        drift[-2:] = _AT_REST ** 2, (_AT_REST / here.values['time_unit']) ** 2
        if self._fixed is None:
            drift[:-2] = self._drift(time - window.begin)
        if jumps:
            for i, gained in found.actuator.drift:
                drift[i] += gained
                # Before, it was as the likely suspects leave open.
                known[i] = found.covariance[i, i]
            # It has moved since a time between two samples.
            since = max(found.actuator.time, time) - float(window.time[max(place - 1, 0)])
            unit = here.values['time_unit']
            drift[-2:] += np.square(
                _PUSHED * since / unit * np.array([since / unit, 1.0 / unit]))
        follows = self._with_rest(here.values, time)
        wander, warming = follows @ np.diag(drift) @ follows.T, self._warming(follows)
        shift = round(time * NANOSECONDS)
        seconds = shift / NANOSECONDS
        # Later motion shows how equilibrium depends on parameters.
        at = window.rest if self.learning is (self._fixed is None) and self._unchanged(
            self._origin, self._origin + shift, 0.0) and not (self._warmed or jumps) else None
        noise = window.scatter(self.noise)
        moved = window.move_on(
            place, time, found.z, here, noise, wander, warming, known) if at is None else (
            window.rest_on(at, place, time, here, noise, wander))
        if self._warmed:
            moved.values = {**moved.values, WARMED: moved.values[WARMED] + self._warmed}
            here = here._replace(values={**here.values, WARMED: moved.values[WARMED]})
            self._warmed = 0.0
        self._fix(moved, found)
        if here.motion.behind:
            until_then = self._follow(found, window, time)
            if until_then is not None:
                here = here._replace(values={**here.values, 'behind': until_then.behind})
                moved.values = {**moved.values, 'behind': until_then.behind}
        moved.begin -= seconds
        moved.time = moved.time - seconds
        self._origin += shift
        self._window = moved
        self._solution = replace(found, z=warming @ np.append(
            found.z[:-2], [here.motion.stretch[place], here.motion.rate[place]]),
            here=here, covariance=moved.covariance if at is None else found.covariance,
            off=np.zeros_like(found.off), instead=np.zeros_like(found.off),
            doubt=BiasCase(
                np.zeros_like(found.off), moved.covariance) if at is None else found.doubt)
        first = bisect_right(self._levels, self._origin, key=lambda x: x[0]) - 1
        # The field of a lagging coil depends on a few levels more.
        del self._levels[:max(first - 8, 0)]

    def _rests(self, until: float) -> bool:
        """Return whether the window until a time in s is long, and at rest by then."""
        begun = self._window.begin if self._window is not None else until
        calm = _SETTLED * self.prior.values['time_unit']
        return until - begun > _CONSTANT and all(
            self._seconds(x) < until - calm for x in self._moves(until))

    def _with_rest(self, values: Mapping[str, Any], time: float) -> Array:
        """Return the derivative of coordinates by each one, where rest follows temperature."""
        follows = np.eye(len(self.prior.free) + 2)
        if TEMPERATURE in self.prior.free:
            level = self._level(self._origin + round(time * NANOSECONDS))
            at = rest(values, self.prior.free, level)
            if at is not None:
                place = self.prior.free.index(TEMPERATURE)
                follows[-2, place] = at[2][place]
        return follows

    def _level(self, stamp: int) -> float:
        """Return the level in T at a timestamp in ns."""
        return self._levels[max(bisect_right(self._levels, stamp, key=lambda x: x[0]) - 1, 0)][1]

    def _fix(self, window: Window, found: Solution) -> None:
        """Fix the parameters of a window, or release them."""
        if self.learning is (self._fixed is None):
            return
        known = window.covariance[:-2, :-2].copy() if self._fixed is None else self._fixed
        window.mean[:-2] = found.z[:-2]
        window.covariance[:-2, -2:], window.covariance[-2:, :-2] = 0.0, 0.0
        window.covariance[:-2, :-2] = known * (1.0 if self.learning else _FIXED)
        self._fixed = None if self.learning else known

    def _seconds(self, stamp: int) -> float:
        return (stamp - self._origin) / NANOSECONDS

    def _taken(self, stamp: int) -> bool:
        """Return whether the window has a sample with this timestamp; its times are rounded."""
        if self._window is None:
            return False
        times, time = self._window.time, self._seconds(stamp) - 0.5 / NANOSECONDS
        if not len(times) or times[-1] < time:
            return False
        place = int(np.searchsorted(times, time))
        return float(times[place]) < time + 1.0 / NANOSECONDS

    def _unchanged(self, begin: int, end: int, units: float) -> bool:
        """Return whether no level changed from some time scales before a begin to an end."""
        before = begin - round(units * self.prior.values['time_unit'] * NANOSECONDS)
        return all(
            x[1] == y[1] or not before < y[0] <= end for x, y in itertools.pairwise(self._levels))

    def _move_begins(self, until: float) -> int:
        """Return the time in ns, until one in s, of the last change after a long calm."""
        calm = round(_CALM * self.prior.values['time_unit'] * NANOSECONDS)
        return max((
            y for x, y in itertools.pairwise([-10**19, *self._moves(until)]) if y - x > calm),
            default=self._origin)

    def _moves(self, until: float) -> list[int]:
        """Return the times in ns, until one in s, of changes of level that are no corrections."""
        most = max((abs(x) for _, x in self._levels), default=0.0)
        return [y[0] for x, y in itertools.pairwise(self._levels)
                if abs(x[1] - y[1]) > _CORRECTS * most and self._seconds(y[0]) <= until]

    def _as_levels(self) -> Levels:
        return Levels(
            np.array([self._seconds(x) for x, _ in self._levels]),
            np.array([x for _, x in self._levels]), self.options.slew_limit)


def _bounds(prior: Prior) -> Array:
    """Return the minimum and maximum coordinate of each tracked parameter."""
    mean = coordinates(prior.values, prior.free)
    bounds: Array = np.stack([mean - _BOUND * prior.spread, mean + _BOUND * prior.spread], axis=1)
    for i, name in enumerate(prior.free):
        if quantity_of(name).scale == 'linear':
            bounds[i, 0] = max(bounds[i, 0], quantity_of(name).least)
        elif quantity_of(name).scale == 'inverse':
            bounds[i, 0] = max(bounds[i, 0], 0.2 * mean[i])
    return bounds
