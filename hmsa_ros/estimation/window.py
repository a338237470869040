"""
A moving horizon: the most probable motion through the newest samples, by Gauss and Newton.

Unknown are the coordinates of the free parameters and stretch and rate at the begin of the window,
in this order. What came before the window is a Gaussian prior of them: when the window moves on,
the samples that leave it are taken into the prior at the present estimate, and the prior goes
along with the motion (C. V. Rao, J. B. Rawlings and D. Q. Mayne, IEEE Trans. Autom. Control 48
(2003) 246).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

import numpy as np

from hmsa_ros.estimation.motion import follow, Levels, Motion
from hmsa_ros.identification.fit import loss, weights_of
from hmsa_ros.identification.quantities import from_coordinate, QUANTITIES, to_coordinate
from hmsa_ros.identification.response import clip, complete
from hmsa_ros.model.equations import Array

# Steps of Gauss and Newton at most, halvings of each, and the step, in deviations, that ends them.
_PASSES, _HALVINGS, _SMALL = 6, 4, 0.03
# A coordinate sought by its logarithm goes no further than this in one step.
_STRIDE = 0.3


class Trial(NamedTuple):
    """What some coordinates make of the samples."""

    values: dict[str, Any]  # of all quantities
    motion: Motion  # at the samples, and at the time asked for last
    residual: Array  # measured less simulated, shape (n,)
    by: Array  # derivatives of what the sensor shows by the coordinates, shape (n, q)
    weights: Array  # how far each sample counts, 0 to 1
    cost: float  # negative logarithm of the probability


@dataclass(frozen=True, eq=False)
class Solution:
    """The most probable motion."""

    z: Array  # coordinates, stretch and rate at the begin, shape (q,)
    values: dict[str, Any]  # of all quantities
    motion: Motion  # at the samples, and at the time asked for last
    by: Array  # derivatives of what the sensor shows by z, shape (n, q)
    residual: Array  # measured less simulated, shape (n,)
    weights: Array  # how far each counts, 0 to 1
    covariance: Array  # of z

    def at_end(self) -> tuple[Array, Array]:
        """Return coordinates, stretch and rate at the time asked for, and their covariance."""
        change = transport(self.motion, len(self.residual))
        state = np.append(
            self.z[:-2], [self.motion.stretch[-1], self.motion.rate[-1]])
        return state, change @ self.covariance @ change.T


def transport(motion: Motion, place: int) -> Array:
    """Return the derivative of coordinates, stretch and rate at a sample by those at the begin."""
    size = motion.by.shape[1]
    change = np.eye(size)
    change[-2], change[-1] = motion.by[place], motion.rate_by[place]
    return change


@dataclass(eq=False)
class Window:
    """Samples, and what is known besides them; times in s from the same instant."""

    values: dict[str, Any]  # of all quantities; those not free stay
    free: tuple[str, ...]  # what is sought
    mean: Array  # of the prior, shape (q,)
    covariance: Array  # of the prior, shape (q, q)
    bounds: Array  # coordinates are kept in them, shape (p, 2)
    begin: float  # time of the stretch and rate that are sought
    time: Array  # of the samples, from the begin on
    stretch: Array

    def values_at(self, z: Array) -> dict[str, Any]:
        """Return the values of all quantities for coordinates."""
        found = dict(self.values)
        for name, x in zip(self.free, z.tolist(), strict=False):
            found[name] = clip(name, from_coordinate(name, x))
        return complete(found, self.free)

    def solve(
            self, z: Array, levels: Levels, noise: float, until: float, here: Trial | None = None
    ) -> Solution | None:
        """
        Seek the most probable motion from coordinates on; None if none can be followed from there.

        The noise is the standard deviation of a sample. The motion is wanted until a time that is
        not before the last sample. What `simulate` says of the coordinates may be given.
        """
        prior: Array = np.asarray(np.linalg.inv(self.covariance), dtype=np.float64)
        here = here or self.simulate(z, levels, noise, until, prior)
        if here is None:
            here = self.simulate(self.mean, levels, noise, until, prior)
            if here is None:
                return None
            z = self.mean
        for _ in range(_PASSES):
            residual, by, weights, cost = here[2:]
            weighted = weights[:, None] * by / noise ** 2
            matrix = prior + by.T @ weighted
            step: Array = np.asarray(np.linalg.solve(
                matrix, weighted.T @ residual + prior @ (self.mean - z)), dtype=np.float64)
            size = math.sqrt(max(float(step @ matrix @ step), 0.0))
            if size < _SMALL:
                break
            step *= min([1.0] + [
                _STRIDE / abs(x) for name, x in zip(self.free, step.tolist(), strict=False)
                if QUANTITIES[name].scale == 'log' and abs(x) > _STRIDE])
            for _ in range(_HALVINGS):
                trial = self._bounded(z + step)
                there = self.simulate(trial, levels, noise, until, prior)
                if there is not None and there[-1] <= cost:
                    break
                step *= 0.4
            else:
                break
            z, here = trial, there
        values, motion, residual, by, weights, _ = here
        matrix = prior + by.T @ (weights[:, None] * by) / noise ** 2
        covariance = np.linalg.inv(matrix)
        return Solution(
            z, values, motion, by, residual, weights, 0.5 * (covariance + covariance.T))

    def _bounded(self, z: Array) -> Array:
        kept: Array = z.copy()
        kept[:-2] = np.clip(z[:-2], self.bounds[:, 0], self.bounds[:, 1])
        return kept

    def simulate(
            self, z: Array, levels: Levels, noise: float, until: float, prior: Array | None = None
    ) -> Trial | None:
        """Return what coordinates make of the samples; the prior is the inverse covariance."""
        values, times = self.values_at(z), np.append(self.time, until)
        if prior is None:
            prior = np.asarray(np.linalg.inv(self.covariance), dtype=np.float64)
        motion = follow(
            values, self.free, (float(z[-2]), float(z[-1])), levels, self.begin,
            np.maximum(times - values['sensor_latency'], self.begin))
        if motion is None:
            return None
        n = len(self.stretch)
        shown, by = motion.measured(values, self.free)
        residual: Array = self.stretch - shown[:n]
        apart = z - self.mean
        cost = loss(residual, noise, convex=True) + 0.5 * float(apart @ prior @ apart)
        return Trial(
            values, motion, residual, by[:n], weights_of(residual, noise, convex=True), cost)

    def move_on(
            self, count: int, begin: float, solution: Solution, noise: float,
            drift: Array) -> 'Window':
        """
        Return the window without the first samples, and with a prior that knows them.

        It begins at the time of the next sample, or at the time asked for last. The drift is the
        variance that parameters and state gain on the way, shape (q,).
        """
        by, weights = solution.by[:count], solution.weights[:count, None]
        prior: Array = np.asarray(np.linalg.inv(self.covariance), dtype=np.float64)
        matrix = prior + by.T @ (weights * by) / noise ** 2
        gradient = by.T @ (solution.weights[:count] * solution.residual[:count]) / noise ** 2
        gradient = gradient + prior @ (self.mean - solution.z)
        covariance = np.linalg.inv(matrix)
        change = transport(solution.motion, count)
        here = np.append(
            solution.z[:-2], [solution.motion.stretch[count], solution.motion.rate[count]])
        covariance = change @ covariance @ change.T + np.diag(drift)
        return Window(
            self.values, self.free, here + change @ np.linalg.solve(matrix, gradient),
            0.5 * (covariance + covariance.T), self.bounds, begin,
            self.time[count:], self.stretch[count:])


def coordinates(values: Mapping[str, float], free: Sequence[str]) -> Array:
    """Return the coordinates of the free parameters."""
    return np.array([to_coordinate(x, values[x]) for x in free], dtype=np.float64)
