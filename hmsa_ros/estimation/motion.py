"""The motion under known levels, with its derivatives by parameters and by where it began."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from hmsa_ros.identification.recording import pieces
from hmsa_ros.identification.response import sensed, set_rest, Setup
from hmsa_ros.model.delivery import late
from hmsa_ros.model.equations import Array
from hmsa_ros.model.law import elastic_force, evaluate, FORCE, natural_frequency
from hmsa_ros.motion import respond
from hmsa_ros.motion import theta as places

# Relative tolerance: far below the noise of a sensor.
_RTOL = 1e-7
# Time constants after which nothing is left of an earlier field.
_FORGOTTEN = 40.0
# Where the decay of a branch is interpolated, in its relaxation times, and how far apart in units
# of time the motion is that a branch follows, and in how many points at the most.
_NODES = -2.0 * np.log1p(-np.linspace(0.0, 1.0 - math.exp(-7.0), 40))
_FINE, _MOST = 0.05, 4000


@dataclass(frozen=True, eq=False)
class Levels:
    """What the amplifier is told, over time."""

    times: Array  # in s, increasing, shape (m,)
    values: Array  # in T, shape (m,)
    slew_limit: float = math.inf  # rate in T/s at which the amplifier ramps; infinite for steps

    def field(self, time: float, lag: float) -> float:
        """Return the field in T at a time in s behind a lag in s."""
        begin = float(max(self.times[0], time - _FORGOTTEN * lag))
        starts, values, slopes = pieces(self.times, self.values, self.slew_limit, begin)
        count = max(int(np.searchsorted(starts, time, side='right')), 1)
        rows = list(zip(starts[:count].tolist(), values[:count].tolist(),
                        slopes[:count].tolist(), strict=True))
        if lag > 0.0:
            return float(late(rows, time, rows[0][1], lag))
        start, value, slope = rows[-1]
        return float(value + slope * (time - start))


@dataclass(frozen=True, eq=False)
class Motion:
    """A simulated motion of the block."""

    stretch: Array  # shape (n,)
    rate: Array  # in 1/s, shape (n,)
    by: Array  # by the coordinates of the free parameters, and by stretch and rate at the begin
    rate_by: Array

    def measured(
            self, values: Mapping[str, float], free: Sequence[str]) -> tuple[Array, Array]:
        """Return what the sensor shows, shape (n,), and its derivatives, shape (n, p + 2)."""
        return sensed(
            values, free, self.stretch, self.rate, values['stretch_gain'] * self.by)


def follow(
        values: Mapping[str, Any], free: Sequence[str], state: tuple[float, float],
        levels: Levels, begin: float, times: Array) -> Motion | None:
    """
    Simulate a motion from stretch and rate (1/s) at a begin in s to times not before it.

    Where ``creep`` is among the values, ``behind`` says how far what its branches have followed is
    from the elastic force at the begin, in units of G; without it they have relaxed. Levels before
    the begin count where the field lags. None if the motion meets the limits of the chains.
    """
    setup = Setup.of(values, free)
    theta = setup.theta
    theta[places.STRETCH], theta[places.RATE] = state
    inner = len(setup.wanted)
    wanted = np.append(setup.wanted, [places.STRETCH, places.RATE])
    start = np.zeros(inner + 2)
    start[inner] = 1.0
    starts, heights, slopes = pieces(levels.times, levels.values, levels.slew_limit, begin)
    lag = values['coil_time_constant']
    field, field_lag = float(heights[0]), 0.0
    if lag > 0.0:
        field = levels.field(begin, lag)
        h = 1e-3 * lag
        field_lag = (levels.field(begin, lag + h) - field) / h
    elif math.isfinite(levels.slew_limit):
        field = heights[0] = levels.field(begin, 0.0)
    n = len(times)
    if any(values.get('behind', ())) and n:
        starts, heights, slopes, field = _relaxing(
            values, theta, float(times[-1]) - begin, starts, heights, slopes, field)
    stretch, rate = np.empty(n), np.empty(n)
    raw, raw_rate = np.empty((n, inner + 2)), np.empty((n, inner + 2))
    if not respond(
            theta, setup.material, setup.branches, wanted, start, starts, heights, slopes, field,
            field_lag, times, _RTOL, stretch, rate, raw, raw_rate):
        return None
    return Motion(
        stretch, rate, np.hstack([raw[:, :inner] @ setup.mixing, raw[:, inner:]]),
        np.hstack([raw_rate[:, :inner] @ setup.mixing, raw_rate[:, inner:]]))


def _relaxing(
        values: Mapping[str, Any], theta: Array, span: float, starts: Array, heights: Array,
        slopes: Array, field: float) -> tuple[Array, Array, Array, float]:
    """Return levels and field in T with the pull of branches that have not relaxed at first."""
    # The response begins relaxed; what the branches follow more than that decays by itself.
    creep, lag, begin = values['creep'], values['coil_time_constant'], float(starts[0])
    after: Array = np.unique(np.clip(np.outer(creep.times, _NODES), 0.0, max(span, 0.0)))
    strength = np.array(creep.ratios) * np.array(values['behind']) * (
        theta[places.STIFFNESS] / theta[places.DRIVE])
    pull = np.exp(-after[:, None] / np.array(creep.times)) @ strength
    rises: Array = np.append(np.diff(pull) / np.diff(after), 0.0)
    both = np.union1d(starts, begin + after)
    i = np.searchsorted(starts, both, side='right') - 1
    j = np.searchsorted(begin + after, both, side='right') - 1
    return (
        both, heights[i] + slopes[i] * (both - starts[i]) + pull[j]
        + rises[j] * (both - begin - after[j] + lag), slopes[i] + rises[j], field + float(pull[0]))


def behind(
        values: Mapping[str, Any], state: tuple[float, float], levels: Levels, begin: float,
        time: float) -> tuple[float, ...]:
    """
    Return how far what branches have followed is from the elastic force at a later time in s.

    It is in units of G, and empty where there are none; the rest is as for `follow`.
    """
    creep = values.get('creep')
    if not creep:
        return ()
    before = values.get('behind') or (0.0,) * len(creep.ratios)
    span = time - begin
    count = math.ceil(min(span / (_FINE * values['time_unit']), _MOST))
    if count == 0:
        return tuple(before)
    times: Array = np.linspace(begin, time, count + 1).astype(np.float64)
    motion = follow(values, (), state, levels, begin, times)
    if motion is None:
        return tuple(before)
    force = np.empty(count + 1)
    evaluate(FORCE, motion.stretch, Setup.of(values, ()).material, force)
    step, found = span / count, []
    left = span - step * np.arange(1, count + 1)
    for tau, more in zip(creep.times, before, strict=True):
        # Of a force that changes linearly over a step.
        decay = math.exp(-step / tau)
        mean = -math.expm1(-step / tau) * tau / step
        taken = np.exp(-left / tau) @ (force[1:] * (1.0 - mean) + force[:-1] * (mean - decay))
        found.append(float((force[0] + more) * math.exp(-span / tau) + taken - force[-1]))
    return tuple(found)


def followed(values: Mapping[str, Any], stretch: float) -> tuple[float, ...]:
    """Return what branches have followed at a stretch, in units of G; empty if they relaxed."""
    if not any(values.get('behind', ())):
        return ()
    force = float(elastic_force(stretch, Setup.of(values, ()).material))
    return tuple(force + x for x in values['behind'])


def held(
        values: Mapping[str, Any], stretch: float, level: float
) -> tuple[float, float, Array] | None:
    """Return as `rest` where a level would hold the block with what its branches hold now."""
    by = followed(values, stretch)
    if not by:
        return rest(values, (), level)
    a, k, f = Setup.of(values, ()).theta[[places.STIFFNESS, places.DRIVE, places.FORCE]]
    ratios = values['creep'].ratios
    pull = k * level + f + a * sum(x * y for x, y in zip(ratios, by, strict=True))
    found = rest(values, (), float((pull / (1.0 + sum(ratios)) - f) / k))
    return found and (found[0], found[1] * math.sqrt(1.0 + sum(ratios)), found[2])


def rest(
        values: Mapping[str, Any], free: Sequence[str], level: float
) -> tuple[float, float, Array] | None:
    """
    Return where a level in T holds the block once its branches have relaxed; None if nowhere.

    That is the stretch, the natural frequency there in 1/s, and the derivatives of the stretch by
    the coordinates of the free parameters, shape (p,).
    """
    setup = Setup.of(values, free)
    start = np.zeros(len(setup.wanted))
    if not set_rest(setup.theta, setup.material, level, setup.wanted, start):
        return None
    stretch = float(setup.theta[places.STRETCH])
    frequency = math.sqrt(setup.theta[places.STIFFNESS]) * float(
        natural_frequency(stretch, setup.material))
    return stretch, frequency, start @ setup.mixing
