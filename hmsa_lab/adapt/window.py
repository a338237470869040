"""
Moving horizon estimation: the most probable motion through the newest samples, by Gauss-Newton.

The unknowns are the coordinates of the free parameters, then stretch and rate at the start of the
window. Earlier data form a Gaussian prior: when the window moves on, the samples that leave
it are added to the prior at the present estimate, and the prior is propagated along the motion
(C. V. Rao, J. B. Rawlings and D. Q. Mayne, IEEE Trans. Autom. Control 48 (2003) 246).
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmsa.identification.fit import loss, weights_of
from hmsa.identification.quantities import complete, modes_of, quantity_of, TEMPERATURE, values_at
from hmsa.identification.response import gain_of, sensed
from hmsa.model.equations import Array
from hmsa.model.laws.record import coordinate_of
from hmsa_lab.adapt.hypotheses import Evidence, GAIN, Hypotheses, inverse, optimum, Others
from hmsa_lab.adapt.motion import follow, Levels, ModelMotion, rest
from hmsa_lab.adapt.prior import SensorBefore

# Maximum Gauss-Newton iterations, halvings of each step, and small step in standard deviations.
_PASSES, _HALVINGS, _SMALL = 4, 4, 0.1
# Growth of the number of samples after which the suspects are examined again.
_MORE = 1.3
# Mean negative log probability of a sample above which a fit is poor, its usual value, and the
# number of standard deviations by which it surely differs from that.
_POOR, _USUAL, _SURELY = 1.0, 0.5, 5.0
# Motion that weak modes add to given secondary ones, as a fraction of it: on finite elements with
# the modes of `free` or `glued`, 0.3 to 3 % (RMS). With 0.01, 2 of 12 random blocks are not
# corrected. With 0.02, feedback leaves more than open loop in 7 of 58, with 0.05 in 4.
_WEAK_MODES = 0.05
# Standard deviations of a jump of bias and gain of the sensor, and its prior improbability as a
# logarithm.
_JUMPS, _RARELY = np.array([0.05, 0.1]), 3.0
#: Quantities that may jump beside those of the sensor, and by which part of their standard
#: deviations before any sample.
JUMPING, PART = ('shear_modulus', 'constant_force'), 0.5
# Part of a change of the state up to which its effect on later motion is accurate (`motion`).
_FADED = 1e-4
# Maximum change per step of a coordinate that is a logarithm.
_STRIDE = 0.3


class Simulation(NamedTuple):
    """Simulation of the samples for some coordinates."""

    values: dict[str, Any]  # of all quantities
    motion: ModelMotion  # at the samples, and last at the requested time
    residual: Array  # measured minus simulated, shape (n,)
    by: Array  # derivatives of the reading by the coordinates, shape (n, q)
    weights: Array  # weight of each sample, 0 to 1
    cost: float  # negative log probability

    def moved(self, values: dict[str, Any], step: Array) -> 'Simulation':
        """Return the linearised simulation after a small step of the coordinates."""
        motion = replace(
            self.motion, stretch=self.motion.stretch + self.motion.by @ step,
            rate=self.motion.rate + self.motion.rate_by @ step)
        return self._replace(
            values=values, motion=motion, residual=self.residual - self.by @ step)


class Optimum(NamedTuple):
    """The most probable values of the estimated coordinates."""

    z: Array
    here: Simulation
    matrix: Array  # second derivatives of the cost
    gradient: Array  # negative first derivatives
    loose: NDArray[np.bool_]  # which coordinates vary


class BiasCase(NamedTuple):
    """Expectation if a constant force and the gain of the sensor may be in error, too."""

    off: Array  # expected minus most probable coordinates, shape (q,)
    covariance: Array  # about the most probable ones, shape (q, q)


class Jump(NamedTuple):
    """How probable it is that quantities have jumped."""

    odds: float = -math.inf  # log odds
    time: float = 0.0  # in s from the origin of the window
    drift: tuple[tuple[int, float], ...] = ()  # indices, and variances that they have gained


@dataclass(frozen=True, eq=False)
class Solution:
    """The most probable motion."""

    z: Array  # coordinates, initial stretch and rate, shape (q,)
    here: Simulation  # simulation with these
    covariance: Array  # about z
    off: Array  # expected values minus z, shape (q,)
    # As `off` for plans, where other parameters represent an apparent gain of the sensor.
    instead: Array
    doubt: BiasCase
    sensor: Jump = Jump()  # of bias and gain of the sensor, before or in the window
    actuator: Jump = Jump()  # of one of `JUMPING` in the window
    # Log odds that the sensor is not as before, if it may not be, relative to the possible ones
    # against that.
    changed: float = -math.inf
    poor: bool = False  # whether the samples fit worse than their noise

    @property
    def without_samples(self) -> 'Solution':
        """The solution with the simulation at the requested time only, which is smaller."""
        here = self.here
        motion = replace(here.motion, **{
            x: getattr(here.motion, x)[-1:] for x in ('stretch', 'rate', 'by', 'rate_by')})
        return replace(self, here=here._replace(
            motion=motion, residual=here.residual[:0], by=here.by[:0], weights=here.weights[:0]))

    def at_end(self) -> tuple[Array, Array, Array, BiasCase]:
        """Return coordinates and state at the requested time, their covariance and `off`."""
        motion = self.here.motion
        change = transport(motion, -1)
        state = np.append(self.z[:-2], [motion.stretch[-1], motion.rate[-1]])
        return state, change @ self.covariance @ change.T, change @ self.off, BiasCase(
            change @ self.doubt.off, change @ self.doubt.covariance @ change.T)


def transport(motion: ModelMotion, place: int) -> Array:
    """Return the derivative of coordinates and state at a sample by those at the start."""
    size = motion.by.shape[1]
    change = np.eye(size)
    change[-2], change[-1] = motion.by[place], motion.rate_by[place]
    return change


class Rest(NamedTuple):
    """An equilibrium, which depends on parameters, and its observation."""

    level: float  # in T
    mean: Array  # of the parameters, before the observation, shape (p,)
    covariance: Array
    shown: float = 0.0  # reading of the sensor
    weight: float = 0.0  # information in the reading


@dataclass(eq=False)
class Window:
    """Samples and prior of the horizon; times in s from a common origin."""

    values: dict[str, Any]  # of all quantities; those that are not free stay
    free: tuple[str, ...]  # estimated quantities
    mean: Array  # of the prior, shape (q,)
    covariance: Array  # of the prior, shape (q, q)
    bounds: Array  # of the coordinates, shape (p, 2)
    jumps: Array  # standard deviations of jumps of `JUMPING`, shape (p,)
    begin: float  # time of the estimated stretch and rate
    time: Array  # of the samples, not before the begin
    stretch: Array
    suspects: Hypotheses
    suspected: tuple[int, ...] = ()  # indices of suspects that are estimated
    weighed: int = 0  # number of samples when these were chosen
    others: Others = Others(1.0, *(np.zeros(()),) * 3)  # effect of other sets
    rest: Rest | None = None  # equilibrium at the begin
    # Whether the prior contains no samples, or what may have jumped already has.
    first: bool = True
    # As in `Solution`, when the suspects were weighed.
    sensor: Jump = Jump()
    actuator: Jump = Jump()
    changed: float = -math.inf
    before: SensorBefore | None = None  # of a sensor that may have changed
    known: tuple[int, ...] = field(init=False)  # suspects estimated in earlier windows
    information: Array = field(init=False)  # inverse of the covariance, set by `settle`

    def __post_init__(self) -> None:
        self.known = self.suspected

    @property
    def modal(self) -> bool:
        """Whether the model has secondary modes."""
        return bool(modes_of(self.values))

    def scatter(self, noise: float) -> float:
        """Return the standard deviation of samples with some noise about the motion."""
        return max(noise, _WEAK_MODES * float(np.ptp(self.stretch))) if (
            self.modal and len(self.stretch)) else noise

    def values_at(self, z: Array) -> dict[str, Any]:
        """Return the values of all quantities for coordinates."""
        return complete(values_at(self.values, self.free, z[:-2]), self.free)

    def settle(self, z: Array, off: float) -> None:
        """
        Start at equilibrium, if applicable, to within a deviation, linearised at coordinates.

        Far from them a force would shift it differently, which would look like an observation.
        """
        if self.rest is None or not self._rest(self.rest, z, off):
            self.information = np.asarray(np.linalg.inv(self.covariance), dtype=np.float64)

    def _rest(self, known: Rest, z: Array, off: float) -> bool:
        """Start at an equilibrium; return whether there is one."""
        values = self.values_at(z)
        at = rest(values, self.free, known.level)
        if at is None:
            return False
        tie = np.vstack([np.eye(len(z) - 2), at[2], np.zeros(len(z) - 2)])
        there = np.append(z[:-2], [at[0], 0.0])
        self.mean = there + tie @ (known.mean - z[:-2])
        self.covariance = tie @ known.covariance @ tie.T
        self.covariance[[-2, -1], [-2, -1]] += np.square([off, off * at[1]])
        # Its inverse would not be positive definite, since the state hardly varies for itself.
        apart = np.eye(len(z))[-2:]
        apart[0, :-2] = -at[2]
        self.information = apart.T @ (apart / np.square([[off], [off * at[1]]]))
        self.information[:-2, :-2] += np.linalg.inv(known.covariance)
        if known.weight > 0.0:
            state = np.zeros((1, len(z)))
            state[0, -2] = gain_of(values)
            shown, by_all = sensed(values, self.free, np.array([at[0]]), np.zeros(1), state)
            by = self._about_rest(values, by_all)[0]
            pull = self.covariance @ by
            share = pull / (by @ pull + 1.0 / known.weight)
            self.mean += share * (known.shown - float(shown[0]) - by @ (self.mean - there))
            self.covariance -= np.outer(share, pull)
            self.information += known.weight * np.outer(by, by)
        return True

    def rest_on(
            self, at: Rest, count: int, begin: float, here: Simulation, noise: float,
            drift: Array) -> 'Window':
        """Return the window, entirely at rest, without the first samples; as `move_on`."""
        before, weights = at.weight, here.weights[:count]
        before /= 1.0 + before * float(np.sum(
            (here.by[:count][-1:] @ drift) * here.by[:count][-1:]))
        weight = before + float(np.sum(weights)) / noise ** 2
        shown = before * at.shown + float(weights @ self.stretch[:count]) / noise ** 2
        return replace(
            self, begin=begin, time=self.time[count:], stretch=self.stretch[count:], weighed=0,
            first=False,
            rest=at._replace(
                covariance=at.covariance + drift[:-2, :-2],
                shown=shown / weight if weight else 0.0, weight=weight))

    def solve(
            self, z: Array, levels: Levels, noise: float, until: float,
            here: Simulation | None = None
    ) -> Solution | None:
        """
        Estimate the most probable motion from initial coordinates; None if there is none.

        The noise is the standard deviation of a sample. The motion extends to a time that is not
        before the last sample. The result of `simulate` at the coordinates may be given.
        """
        def descend(z: Array, here: Simulation | None = None) -> Optimum | None:
            return self._descend(z, here, levels, noise, until)

        found = descend(z, here) or descend(self._at_ease(self.mean))
        if found is None:
            return None
        if len(self.time) >= _MORE * self.weighed or self._is_poor(found, noise):
            found = self._look(found, descend)
            if self._is_poor(found, noise):
                # There may be another local optimum.
                before = self.suspected, self.others
                self.suspected = tuple(
                    i for i in self.suspects.places if i != self.suspects.gain)
                other = descend(self._at_ease(self.mean))
                other = other and self._look(other, descend)
                if other and other.here.cost < found.here.cost:
                    found = other
                else:
                    self.suspected, self.others = before
            self._look_for_jumps(found, noise)
            self.changed = self._sensor_changed(found)
        sure, off, square, instead = self.others
        doubt = self._doubt(found)
        poor = self._is_poor(found, noise, 0.5 * float(found.gradient @ doubt.off) + (
            _SURELY * math.sqrt(0.5 * len(self.time))))
        return Solution(
            found.z, found.here, sure * inverse(found.matrix, found.loose) + square,
            np.broadcast_to(off, z.shape), np.broadcast_to(instead, z.shape), doubt, self.sensor,
            self.actuator, self.changed, poor)

    def _doubt(self, found: Optimum) -> BiasCase:
        """Return the expectation if a constant force and a gain may be in error, too."""
        loose = found.loose | self.suspects.of(('constant_force', GAIN), len(found.loose))
        covariance = inverse(found.matrix, loose)
        off = covariance @ found.gradient
        return BiasCase(off, covariance + np.outer(off, off))

    def wider(self, samples: Sequence[tuple[float, float]]) -> 'Window':
        """Return the window with further samples (time in s, stretch)."""
        found = copy(self)
        if samples:
            time, stretch = np.array(samples).T
            place = np.searchsorted(self.time, time)
            found.time = np.insert(self.time, place, time)
            found.stretch = np.insert(self.stretch, place, stretch)
        return found

    def jump_of_actuator(self, z: Array, levels: Levels, noise: float, until: float) -> Jump:
        """Return the jump of the actuator at coordinates."""
        here = self.simulate(z, levels, noise, until)
        if here is None:
            return Jump()
        self._look_for_jumps(Optimum(
            z, here, *self._slopes(z, here, noise), np.ones(len(z), dtype=np.bool_)), noise)
        return self.actuator

    def _slopes(self, z: Array, here: Simulation, noise: float) -> tuple[Array, Array]:
        """Return second derivatives of the cost, and the negative first ones."""
        weighted = here.weights[:, None] * here.by / noise ** 2
        return (self.information + here.by.T @ weighted,
                weighted.T @ here.residual + self.information @ (self.mean - z))

    def _look_for_jumps(self, found: Optimum, noise: float) -> None:
        """
        Weigh that bias and gain of the sensor jumped, or one quantity of the actuator.

        They jumped before the window, or at one of its samples, all of which are as probable. The
        rival is that all is as in earlier windows, or as their samples leave open. Before the
        first motion, a sensor may have jumped at a sample at rest.
        """
        self.sensor, self.actuator = Jump(), Jump()
        if len(self.time) <= self.first or self.first and (
                self.rest is None or TEMPERATURE in self.free):
            return
        here = found.here
        rival = Evidence(
            self.suspects, found.z, found.matrix, found.gradient, *self._room(found.z))
        none = rival.best()
        shown = self.stretch - here.residual - coordinate_of(here.values['law']).rest
        self.sensor = self._best_jump(found, rival, self._sums(
            here, noise, np.column_stack([np.ones(len(shown)), shown])), _JUMPS, none)
        # A block that warms changes in the course of time, and weak modes look like a change.
        if self.first or self.modal or TEMPERATURE in self.free:
            return
        places = [i for i, x in enumerate(self.free) if x in JUMPING]
        jumps = [
            self._best_jump(found, rival, self._sums_of_actuator(here, noise, i), self.jumps[[i]],
                            none + max(self.sensor.odds, 0.0)) for i in places]
        if jumps:
            best = max(jumps)
            likely = np.exp([x.odds - best.odds for x in jumps])
            gained = likely / np.sum(likely) * self.jumps[places] ** 2
            self.actuator = best._replace(drift=tuple(zip(places, gained.tolist(), strict=True)))

    def _sums(self, here: Simulation, noise: float, jump: Array) -> tuple[Array, Array, Array]:
        """Return derivatives of the cost by m quantities that add to later readings."""
        weighted = here.weights[:, None] * jump / noise ** 2
        across, square, pull = (np.cumsum(x[::-1], axis=0)[::-1] for x in (
            here.by[:, :, None] * weighted[:, None], jump[:, :, None] * weighted[:, None],
            here.residual[:, None] * weighted))
        return across, square, pull

    def _sums_of_actuator(
            self, here: Simulation, noise: float, place: int) -> tuple[Array, Array, Array]:
        """Return as `_sums` for a quantity of the actuator that differs from a sample on."""
        motion, count = here.motion, len(self.time)
        state = np.stack([motion.by[:count], motion.rate_by[:count]], axis=1)
        size = np.linalg.norm(state[:, :, -2:], axis=(1, 2))
        state = state[:int(np.argmin(np.append(size, 0.0) > _FADED * size[0]))]
        # What it changes of later motion, less what it would have changed of the state until then.
        less = np.linalg.solve(state[:, :, -2:], state[:, :, [place]])
        way = np.concatenate([np.ones((len(state), 1, 1)), -less], axis=1)
        across, square, pull = (x[:len(state)] for x in self._sums(
            here, noise, here.by[:, [place, -2, -1]]))
        return (across @ way, np.swapaxes(way, 1, 2) @ square @ way,
                (pull[:, None, :] @ way)[:, 0])

    def _best_jump(
            self, found: Optimum, rival: Evidence, sums: tuple[Array, Array, Array],
            sizes: Array, none: float) -> Jump:
        """Return the jump of one or more quantities, against the log probability of none."""
        across, square, pull = sums
        square = square + np.diag(sizes ** -2)
        # The time is the most probable one with the suspects of earlier windows.
        inner = inverse(found.matrix, self.suspects.sought(len(found.z), self.known))
        step = self.suspects.at_ease(found.z, self.known) - found.z
        step = step + inner @ (found.gradient - found.matrix @ step)
        left = pull - np.einsum('kqj,q->kj', across, step)
        matrix = square - np.einsum('kqi,qr,krj->kij', across, inner, across)
        gain = 0.5 * (np.einsum('ki,kij,kj->k', left, np.linalg.inv(matrix), left)
                      - np.linalg.slogdet(matrix)[1])
        if TEMPERATURE in self.free:
            # A block that warms or cools moves within the window, too.
            gain = gain[:1]
        if self.first:
            # Before, any bias and gain are as given.
            gain[0] = -math.inf
        best = int(np.argmax(gain))
        odds, place = max(
            (rival.with_more(across[k, :, :n], square[k, :n, :n], pull[k, :n]).best()
             - float(np.sum(np.log(sizes[:n]))) + share, k)
            for k, share in (
                (0, 0.0), (best, math.log(np.mean(np.exp(gain - gain[best])))))[self.first:]
            for n in range(1, len(sizes) + 1))
        return Jump(
            odds - _RARELY - none, float(self.time[place]) if place else self.begin)

    def _sensor_changed(self, found: Optimum) -> float:
        """
        Return the log odds that bias and gain of the sensor are not as before.

        They are relative to those against another bias that agrees with the one before.
        """
        if self.before is None:
            return -math.inf
        places, mean = list(self.before.places), self.before.mean
        off, room = found.z[places] - mean, self._room(found.z)
        odds = [Evidence(self.suspects, found.z, found.matrix, found.gradient, *room).best()]
        for more, log_density in zip(self.before.more, self.before.log_density, strict=True):
            matrix, gradient = found.matrix.copy(), found.gradient.copy()
            matrix[np.ix_(places, places)] += more
            gradient[places] -= more @ off
            odds.append(Evidence(self.suspects, found.z, matrix, gradient, *room).best()
                        - 0.5 * float(off @ more @ off) + float(log_density))
        return (max(odds[0], odds[2]) - odds[1]) / float(
            self.before.log_density[0] - self.before.log_density[1])

    def _is_poor(self, found: Optimum, noise: float, more: float = 0.0) -> bool:
        """
        Return whether the estimated quantities explain the samples poorly.

        ``more`` is the part that others may explain, and chance.
        """
        found_loss, count = loss(found.here.residual, noise, convex=True), len(self.time)
        return found_loss > _POOR * count and found_loss > _USUAL * count + more

    def _look(
            self, found: Optimum, descend: Callable[[Array], Optimum | None]) -> Optimum:
        """Choose the suspects to estimate, and return the most probable coordinates then."""
        self.weighed, before = len(self.time), self.suspected
        self.suspected, self.others = Evidence(
            self.suspects, found.z, found.matrix, found.gradient,
            *self._room(found.z)).choose(before)
        if self.suspected == before:
            return found
        return descend(self._at_ease(found.z)) or found

    def _descend(
            self, z: Array, here: Simulation | None, levels: Levels, noise: float, until: float
    ) -> Optimum | None:
        """
        Search the most probable values of the estimated coordinates.

        The last step, which is small, is not simulated.
        """
        here = here or self.simulate(z, levels, noise, until)
        if here is None:
            return None
        for number in range(_PASSES + 1):
            matrix, gradient = self._slopes(z, here, noise)
            step, loose = self._step(z, matrix, gradient)
            if float(step @ matrix @ step) < _SMALL ** 2:
                z = z + step
                gradient = gradient - matrix @ step
                here = here.moved(self.values_at(z), step)
                break
            there = None
            for _ in range(_HALVINGS if number < _PASSES else 0):
                there = self.simulate(self._bounded(z + step), levels, noise, until)
                if there is not None and there.cost <= here.cost:
                    break
                step *= 0.4
                there = None
            if there is None:
                break
            z, here = self._bounded(z + step), there
        return Optimum(z, here, matrix, gradient, loose)

    def _at_ease(self, z: Array) -> Array:
        """Return coordinates with the given values for those that are not estimated."""
        return self.suspects.at_ease(z, self.suspected)

    def _room(self, z: Array) -> tuple[Array, Array]:
        """Return the minimum and maximum step within the bounds."""
        low, high = np.full(len(z), -math.inf), np.full(len(z), math.inf)
        low[:-2], high[:-2] = (self.bounds - z[:-2, None]).T
        return low, high

    def _bounded(self, z: Array) -> Array:
        kept: Array = z.copy()
        kept[:-2] = np.clip(z[:-2], self.bounds[:, 0], self.bounds[:, 1])
        return kept

    def _step(
            self, z: Array, matrix: Array, gradient: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the bounded step to the optimum, and which coordinates vary."""
        longest = np.array([
            _STRIDE if quantity_of(x).scale == 'log' else math.inf for x in self.free] + [
                math.inf] * 2)
        low, high = self._room(z)
        return optimum(
            matrix, gradient, np.zeros(len(z)), self.suspects.sought(len(z), self.suspected),
            np.maximum(low, -longest), np.minimum(high, longest))

    def simulate(
            self, z: Array, levels: Levels, noise: float, until: float) -> Simulation | None:
        """Return the simulation of the samples for coordinates."""
        values, times = self.values_at(z), np.append(self.time, until)
        motion = follow(
            values, self.free, (float(z[-2]), float(z[-1])), levels, self.begin,
            times - values['sensor_latency'])
        if motion is None:
            return None
        n = len(self.stretch)
        shown, by = sensed(
            values, self.free, motion.stretch, motion.rate, gain_of(values) * motion.by)
        residual: Array = self.stretch - shown[:n]
        apart = z - self.mean
        cost = loss(residual, noise, convex=True) + 0.5 * float(
            apart @ self.information @ apart)
        return Simulation(
            values, motion, residual, self._about_rest(values, by[:n]),
            weights_of(residual, noise, convex=True), cost)

    def _about_rest(self, values: dict[str, Any], by: Array) -> Array:
        """Return derivatives of the reading, with a suspected gain about rest."""
        if self.suspects.gain >= 0:
            by[:, self.suspects.gain] -= (
                values['stretch_gain'] * coordinate_of(values['law']).rest)
        return by

    def move_on(
            self, count: int, begin: float, z: Array, here: Simulation, noise: float,
            drift: Array, warming: Array, known: Array) -> 'Window':
        """
        Return the window without the first samples, which become part of the prior.

        ``known`` is the variance of each coordinate at most, shape (q,).

        It begins at the next sample, or at the requested time. In between, coordinates change by
        the matrix ``warming``, and gain the covariance ``drift``, both of shape (q, q).
        """
        matrix, gradient = self._slopes(z, here._replace(
            residual=here.residual[:count], by=here.by[:count], weights=here.weights[:count]),
            noise)
        every = np.ones(len(z), dtype=np.bool_)
        matrix[np.diag_indices_from(matrix)] += np.maximum(
            1.0 / known - 1.0 / np.diag(inverse(matrix, every)), 0.0)
        covariance = inverse(matrix, every)
        change = warming @ transport(here.motion, count)
        there = np.append(z[:-2], [here.motion.stretch[count], here.motion.rate[count]])
        there = warming @ there + change @ (covariance @ gradient)
        covariance = change @ covariance @ change.T + drift
        return Window(
            self.values, self.free, there,
            0.5 * (covariance + covariance.T), self.bounds, self.jumps, begin,
            self.time[count:], self.stretch[count:], self.suspects, self.suspected, first=False,
            before=self.before)
