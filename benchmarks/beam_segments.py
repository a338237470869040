"""
A beam as a chain of rigid links with springs and dashpots between them, in a plane.

It has as many modes as links and allows large deflections. It is independent of the package's
single mode, so it measures how much a plan for that mode excites the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from scipy.integrate import solve_ivp

from hmsa.model.equations import Array
from hmsa.model.units import MU_0


@dataclass(frozen=True)
class Chain:
    """A clamped-free beam, magnetised along its length, in SI units."""

    links: int
    length: float
    width: float
    thickness: float
    density: float
    youngs: float
    remanence: float
    tip_damping: float  # in its first mode in N s/m; joints damp in proportion to stiffness

    def follow(self, pieces: Sequence[tuple[float, float]], samples: int) -> tuple[Array, Array]:
        """Return times in s and deflections over the length from rest, for pieces in s and T."""
        n, link = self.links, self.length / self.links
        area = self.width * self.thickness
        bending = self.youngs * self.width * self.thickness ** 3 / 12.0
        last = np.maximum.outer(np.arange(n), np.arange(n))
        weight = n - last - 0.5 - np.eye(n) / 6.0
        weight *= self.density * area * link ** 3
        # Half a link bends between the clamp and the middle of the first one.
        differences = np.eye(n) - np.eye(n, k=-1)
        spring = differences.T @ np.diag([2.0] + [1.0] * (n - 1)) @ differences * bending / link
        # E I theta'^2 against c y'^2 in the first mode: 4/1.8751^4 of c l^3.
        damper = spring / bending * self.tip_damping * self.length ** 3 * 4.0 / 1.8751041 ** 4
        torque = self.remanence / MU_0 * area * link

        def change(_: float, state: Array, flux: float) -> Array:
            angle, rate = state[:n], state[n:]
            apart = np.subtract.outer(angle, angle)
            load = torque * flux * np.cos(angle) - spring @ angle - damper @ rate
            load -= (weight * np.sin(apart)) @ rate ** 2
            made: Array = np.concatenate([rate, np.linalg.solve(weight * np.cos(apart), load)])
            return made

        state, begin = np.zeros(2 * n), 0.0
        times, deflections = [], []
        for duration, flux in pieces:
            grid = np.linspace(0.0, duration, samples)
            solved = solve_ivp(
                change, (0.0, duration), state, method='LSODA', t_eval=grid, args=(flux,),
                rtol=1e-7, atol=1e-9)
            times.append(begin + grid)
            deflections.append(np.sin(solved.y[:n]).mean(axis=0))
            state, begin = solved.y[:, -1], begin + duration
        return np.concatenate(times), np.concatenate(deflections)

    @property
    def first_period(self) -> float:
        """Period of the first mode in s, by Euler and Bernoulli."""
        inertia = self.density * self.width * self.thickness * self.length ** 4
        bending = self.youngs * self.width * self.thickness ** 3 / 12.0
        return 2.0 * math.pi / 1.8751041 ** 2 * math.sqrt(inertia / bending)
