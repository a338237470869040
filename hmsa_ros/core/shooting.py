"""
Commands with two free numbers, solved for rest at the target.

The two-step command on ideal hardware has a solver of its own, `two_step_kernel.shoot`.
Everything else, a command on a grid, through ramps, or with two intermediate levels of given
height, has two unknowns as well, and they meet the same two conditions: stretch at the target,
rate zero, at the instant at which the last level is in force. Newton solves them with the
derivatives that come out of the integration.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmsa_ros.core import shooting_kernel
from hmsa_ros.core.model import Array
from hmsa_ros.core.moves import Level, State
from hmsa_ros.core.parameters import NondimensionalParameters


@dataclass(frozen=True)
class Template:
    """
    Levels with their derivatives by the two unknowns.

    Attributes
    ----------
    times, loads : ndarray, shape (n,)
        Of the levels; the first at time 0, the last holds the target.
    d_times, d_loads : ndarray, shape (n, 2)
        Derivatives by the unknowns.

    """

    times: Array
    loads: Array
    d_times: Array
    d_loads: Array

    @classmethod
    def of(cls, levels: Sequence[Level], unknowns: Sequence[tuple[str, int]]) -> 'Template':
        """
        Make a template of levels.

        Parameters
        ----------
        levels : sequence of Level
            First guess.
        unknowns : sequence of (str, int)
            Two of ``('load', i)`` and ``('time', i)``. A time moves all later levels with it.

        Returns
        -------
        Template
            At the first guess.

        """
        d_times = np.zeros((len(levels), 2))
        d_loads = np.zeros((len(levels), 2))
        for column, (kind, index) in enumerate(unknowns):
            if kind == 'load':
                d_loads[index, column] = 1.0
            else:
                d_times[index:, column] = 1.0
        return cls(
            np.array([x.time for x in levels]), np.array([x.load for x in levels]), d_times,
            d_loads)


def solve(
        template: Template, state: State, load: float, target: float,
        material: NondimensionalParameters, slew: float) -> tuple[tuple[Level, ...], float] | None:
    """
    Solve a template for rest at the target.

    Parameters
    ----------
    template : Template
        First guess.
    state : State
        At the start.
    load : float
        In force before the first level.
    target : float
        Stretch to come to rest at.
    material : NondimensionalParameters
        zeta, J_lim and c1.
    slew : float
        Largest change of the load per unit of time; infinite for steps.

    Returns
    -------
    tuple of (tuple of Level, float), or None
        The command and the time at which it is at rest, the last ramp included; None if no
        solution was found from this guess.

    """
    times, loads = template.times.copy(), template.loads.copy()
    status, duration = shooting_kernel.solve(
        times, loads, template.d_times, template.d_loads, float(state.stretch),
        float(state.rate), float(load), float(target), float(slew), material.packed)
    if status != shooting_kernel.SOLVED:
        return None
    levels = tuple(Level(t, x) for t, x in zip(times.tolist(), loads.tolist(), strict=True))
    return levels, duration
