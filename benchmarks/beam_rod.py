"""
A beam as an exact planar rod: clamped, inextensible, without shear, at any deflection.

The rotation of the tangent is a sum of sines that vanish at the clamp and are level at the tip. It
shares no equation with the package, whose beam has one or two degrees of freedom. Lengths are in
units of that of the beam, times of l^2 sqrt(rho A/(E I)), loads Br B A l^2/(mu0 E I).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import eigh
from scipy.optimize import brentq

from hmsa.model.equations import Array

#: First frequency of a straight beam, by Euler and Bernoulli.
FIRST = 1.8751040687119611 ** 2
# Points of Simpson's rule along the beam.
_POINTS = 201
_NEWTON = 50


@dataclass(frozen=True)
class Rod:
    """A rod with viscous bending, of a damping ratio of the first mode when straight."""

    ratio: float
    terms: int = 10

    @cached_property
    def _rule(self) -> tuple[Array, Array, Array]:
        """Return weights along the beam, the sum up to each point, and the sines there."""
        s = np.linspace(0.0, 1.0, _POINTS)
        step = s[1]
        weights = np.full(_POINTS, 2.0)
        weights[1::2] = 4.0
        weights[[0, -1]] = 1.0
        # Trapezoids, with the correction of Euler and Maclaurin in their place: cubics through
        # four neighbours.
        up_to = np.zeros((_POINTS, _POINTS))
        for i in range(1, _POINTS):
            up_to[i] = up_to[i - 1]
            first = min(max(i - 2, 0), _POINTS - 4)
            at = np.arange(4.0)
            begin = i - 1.0 - first
            powers = np.vander(at, increasing=True)
            means = np.array([((begin + 1.0) ** (k + 1) - begin ** (k + 1)) / (k + 1)
                              for k in range(4)])
            up_to[i, first:first + 4] += step * np.linalg.solve(powers.T, means)
        waves = (np.arange(self.terms) + 0.5) * math.pi
        return weights * step / 3.0, up_to, np.sin(waves[:, None] * s)

    @cached_property
    def _bending(self) -> Array:
        made: Array = 0.5 * ((np.arange(self.terms, dtype=np.float64) + 0.5) * math.pi) ** 2
        return made

    @cached_property
    def _damping(self) -> Array:
        return 2.0 * self.ratio / FIRST * self._bending

    def deflection(self, shapes: Array) -> Array:
        """Return deflections of the tip for coefficients of the sines, shape (..., terms)."""
        weights, _, sines = self._rule
        made: Array = np.sin(shapes @ sines) @ weights
        return made

    def rest(self, load: float) -> Array:
        """Return the coefficients at rest under a load."""
        weights, _, sines = self._rule
        shape: Array = np.zeros(self.terms)
        for part in np.linspace(0.0, load, 2 + int(abs(load)))[1:]:
            for _ in range(_NEWTON):
                turned = shape @ sines
                step = np.linalg.solve(
                    np.diag(self._bending) + part * (sines * (weights * np.sin(turned))) @ sines.T,
                    self._bending * shape - part * (sines * weights) @ np.cos(turned))
                shape = shape - step
                if np.max(np.abs(step)) < 1e-12:
                    break
        return shape

    def load_for(self, deflection: float) -> float:
        """Return the load that holds a deflection."""
        found = brentq(
            lambda x: float(self.deflection(self.rest(x))) - deflection, -20.0, 20.0, xtol=1e-9)
        return float(found)

    def _moving(self, shape: Array) -> tuple[Array, Array, Array]:
        """Return the displacements along and across with each coefficient, and the mass matrix."""
        weights, up_to, sines = self._rule
        turned = shape @ sines
        along, across = (
            (sign * of(turned) * sines) @ up_to.T for sign, of in ((-1.0, np.sin), (1.0, np.cos)))
        return along, across, (along * weights) @ along.T + (across * weights) @ across.T

    def _change(self, _: float, state: Array, load: float) -> Array:
        weights, up_to, sines = self._rule
        shape, rate = np.split(state, 2)
        along, across, mass = self._moving(shape)
        turned, squared = shape @ sines, (rate @ sines) ** 2
        force = (load * np.cos(turned) * weights) @ sines.T
        force -= self._bending * shape + self._damping * rate
        force -= along @ (weights * (up_to @ (-np.cos(turned) * squared)))
        force -= across @ (weights * (up_to @ (-np.sin(turned) * squared)))
        made: Array = np.concatenate([rate, np.linalg.solve(mass, force)])
        return made

    def follow(
            self, start: float, pieces: Sequence[tuple[float, float]],
            samples: int) -> tuple[Array, Array]:
        """Return times and deflections from rest under a load, for pieces of duration and load."""
        state = np.concatenate([self.rest(start), np.zeros(self.terms)])
        begin, times, deflections = 0.0, [], []
        for duration, load in pieces:
            grid: Array = np.linspace(0.0, duration, samples, dtype=np.float64)
            solved = solve_ivp(
                self._change, (0.0, duration), state, method='LSODA', t_eval=grid, args=(load,),
                rtol=1e-7, atol=1e-9)
            times.append(begin + grid)
            deflections.append(self.deflection(solved.y[:self.terms].T))
            state, begin = solved.y[:, -1], begin + duration
        return np.concatenate(times), np.concatenate(deflections)

    def frequencies(self, load: float) -> Array:
        """Return the natural frequencies of small motion about rest under a load."""
        weights, _, sines = self._rule
        shape = self.rest(load)
        softer = load * weights * np.sin(shape @ sines)
        squares: Array = eigh(
            np.diag(self._bending) + (sines * softer) @ sines.T, self._moving(shape)[2],
            eigvals_only=True)
        return np.sqrt(squares)
