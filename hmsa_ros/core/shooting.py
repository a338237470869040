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
import math

import numpy as np

from hmsa_ros.core import kernels, law
from hmsa_ros.core.model import Array
from hmsa_ros.core.moves import Level, State
from hmsa_ros.core.parameters import NondimensionalParameters

_RTOL = 1e-13
_ITERATIONS = 25
# A Newton step that must be cut shorter than this leads nowhere.
_LEAST_SHARE = 0.01
# Trials leave the first guess by this factor at the most.
_FARTHEST = 10.0
#: Distance from rest at the target, as a share of the move, at which a command is accepted.
_ACCEPTED = 1e-10


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

    def moved(self, change: Array) -> 'Template':
        """
        Return the template with changed unknowns.

        Parameters
        ----------
        change : ndarray, shape (2,)
            Of the unknowns.

        Returns
        -------
        Template
            Derivatives are constant.

        """
        return Template(
            self.times + self.d_times @ change, self.loads + self.d_loads @ change,
            self.d_times, self.d_loads)

    def levels(self) -> tuple[Level, ...]:
        """
        Return the levels.

        Returns
        -------
        tuple of Level
            Without derivatives.

        """
        return tuple(
            Level(float(t), float(x)) for t, x in zip(self.times, self.loads, strict=True))


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
    frequency = law.natural_frequency(target, material.packed)
    move = abs(target - state.stretch) + abs(state.rate) / frequency
    found = _end(template, state, load, target, frequency, material, slew)
    if found is None:
        return None
    farthest = _FARTHEST * (np.max(np.abs(template.loads)) + abs(load) + 1.0)
    longest = _FARTHEST * template.times[-1]
    for _ in range(_ITERATIONS):
        error, jacobian, duration = found
        size = float(np.hypot(*error))
        try:
            change = np.asarray(-np.linalg.solve(jacobian, error), dtype=np.float64)
        except np.linalg.LinAlgError:
            return None
        if not np.all(np.isfinite(change)):
            return None
        share = 1.0
        while share > _LEAST_SHARE:
            trial = template.moved(share * change)
            result = None
            # A wild trial is not worth its integration.
            if np.max(np.abs(trial.loads)) < farthest and trial.times[-1] < longest:
                result = _end(trial, state, load, target, frequency, material, slew)
            if result is not None and np.hypot(*result[0]) < (1.0 - 0.1 * share) * size:
                break
            share *= 0.5
        else:
            # No way down: rounding, if the end is as near as rounding allows.
            return (template.levels(), duration) if size <= _ACCEPTED * move else None
        template, found = trial, result
        if float(np.hypot(*result[0])) <= 1e-14 * move:
            return template.levels(), result[2]
    return None


def _end(
        template: Template, state: State, load: float, target: float, frequency: float,
        material: NondimensionalParameters, slew: float) -> tuple[Array, Array, float] | None:
    """Return distance from rest at the target, its derivatives and the duration."""
    made = _pieces(template, load, slew)
    if made is None:
        return None
    durations, loads, slopes, d_durations, d_loads = made
    jacobian = np.empty((2, 2))
    status, stretch, rate = kernels.respond(
        state.stretch, state.rate, durations, loads, slopes, d_durations, d_loads,
        material.packed, _RTOL, jacobian)
    if status != kernels.DONE or not np.all(np.isfinite(jacobian)):
        return None
    jacobian[1] /= frequency
    return (np.array([stretch - target, rate / frequency]), jacobian, float(np.sum(durations)))


def _pieces(
        template: Template, load: float, slew: float
) -> tuple[Array, Array, Array, Array, Array] | None:
    """Return durations, loads, slopes and their derivatives; None if a ramp does not fit."""
    count = len(template.times)
    rows = []
    d_load = np.zeros(2)
    for i in range(count):
        level, d_level = template.loads[i], template.d_loads[i]
        last = i == count - 1
        span = 0.0 if last else template.times[i + 1] - template.times[i]
        d_span = np.zeros(2) if last else template.d_times[i + 1] - template.d_times[i]
        if not math.isinf(slew):
            sign = math.copysign(1.0, level - load)
            ramp = abs(level - load) / slew
            d_ramp = sign * (d_level - d_load) / slew
            rows.append((ramp, load, sign * slew, d_ramp, d_load))
            span, d_span = span - ramp, d_span - d_ramp
        if not last:
            if span < 0.0:
                return None
            rows.append((span, level, 0.0, d_span, d_level))
        load, d_load = level, d_level
    return (
        np.array([x[0] for x in rows]), np.array([x[1] for x in rows]),
        np.array([x[2] for x in rows]), np.array([x[3] for x in rows]),
        np.array([x[4] for x in rows]))
