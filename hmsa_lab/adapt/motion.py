"""Motion under known levels, with derivatives by parameters and initial state."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from hmsa.identification.measurement import pieces
from hmsa.identification.response import ResponseArguments
from hmsa.model.delivery import late
from hmsa.model.equations import Array
from hmsa.model.law import elastic_force, natural_frequency
from hmsa.motion import derivatives

# Relative tolerance: far below the noise of a sensor.
_RTOL = 1e-7
# Time constants after which an earlier field has decayed.
_FORGOTTEN = 40.0


@dataclass(frozen=True, eq=False)
class Levels:
    """Commanded levels of the amplifier over time."""

    times: Array  # in s, increasing, shape (m,)
    values: Array  # in T, shape (m,)
    slew_limit: float = math.inf  # rate in T/s at which the amplifier ramps; infinite for steps

    def field(self, time: float, lag: float) -> float:
        """Return the field in T at a time in s, with a lag in s."""
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
class ModelMotion:
    """A simulated motion of the block."""

    stretch: Array  # shape (n,)
    rate: Array  # in 1/s, shape (n,)
    by: Array  # by the coordinates of the free parameters, and by initial stretch and rate
    rate_by: Array
    #: At the last time: branch states minus the elastic force, in units of G, and with secondary
    #: modes, position and rate of each mode minus those of all together.
    behind: tuple[float, ...]


def follow(
        values: Mapping[str, Any], free: Sequence[str], state: tuple[float, float],
        levels: Levels, begin: float, times: Array) -> ModelMotion | None:
    """
    Simulate a motion from stretch and rate (1/s) at ``begin`` in s until the given times.

    Before the begin the rate is constant. If ``behind`` is among the values, it is that of
    `ModelMotion` at the begin; without it branches are relaxed, and modes move together. Earlier
    levels count if the field lags. Return None if the motion meets the limits of the chains.
    """
    setup = ResponseArguments.of(values, free, (derivatives.STRETCH, derivatives.RATE))
    theta, wanted = setup.theta, setup.wanted
    theta[derivatives.STRETCH], theta[derivatives.RATE] = state
    start = np.zeros(len(wanted))
    start[-2] = 1.0
    starts, heights, slopes = pieces(levels.times, levels.values, levels.slew_limit, begin)
    lag = float(theta[derivatives.LAG])
    field, field_lag = float(heights[0]), 0.0
    if lag > 0.0:
        field = levels.field(begin, lag)
        h = 1e-3 * lag
        field_lag = (levels.field(begin, lag + h) - field) / h
    elif math.isfinite(levels.slew_limit):
        field = heights[0] = levels.field(begin, 0.0)
    n = len(times)
    stretch, rate = np.empty(n), np.empty(n)
    raw, raw_rate = np.empty((n, len(wanted))), np.empty((n, len(wanted)))
    behind = _behind(values, setup)
    behind_last = np.zeros_like(behind)
    if not derivatives.respond(
            theta, setup.material, setup.branches, wanted, start, starts, heights, slopes, field,
            field_lag, times, _RTOL, stretch, rate, raw, raw_rate, behind, behind_last):
        return None
    return ModelMotion(
        stretch, rate, raw @ setup.mixing, raw_rate @ setup.mixing, tuple(behind_last.tolist()))


def _behind(values: Mapping[str, Any], setup: ResponseArguments) -> Array:
    """Return `ModelMotion.behind` among values; a branch that was not in use is relaxed."""
    given = values.get('behind', ())
    return np.append(np.zeros(setup.states - len(given)), given)


def followed(values: Mapping[str, Any], stretch: float) -> tuple[float, ...]:
    """Return the branch states at a stretch, in units of G; empty if relaxed."""
    holds = 'creep' in values or values['viscoelastic_ratio'] > 0.0
    if not (holds and any(values.get('behind', ()))):
        return ()
    setup = ResponseArguments.of(values, ())
    force = float(elastic_force(stretch, setup.material))
    return tuple(force + x for x in _behind(values, setup)[:setup.branches].tolist())


def held(
        values: Mapping[str, Any], stretch: float, level: float
) -> tuple[float, float, Array] | None:
    """Return the equilibrium, as `rest`, under a level at the present branch states."""
    by = followed(values, stretch)
    if not by:
        return rest(values, (), level)
    theta = ResponseArguments.of(values, ()).theta
    a, k, f = theta[[derivatives.STIFFNESS, derivatives.DRIVE, derivatives.FORCE]]
    ratios = theta[derivatives.FIRST_BRANCH::derivatives.BRANCH][:len(by)].tolist()
    pull = k * level + f + a * sum(x * y for x, y in zip(ratios, by, strict=True))
    found = rest(values, (), float((pull / (1.0 + sum(ratios)) - f) / k))
    return found and (found[0], found[1] * math.sqrt(1.0 + sum(ratios)), found[2])


def rest(
        values: Mapping[str, Any], free: Sequence[str], level: float
) -> tuple[float, float, Array] | None:
    """
    Return the equilibrium of a block with relaxed branches under a level in T; None if none.

    The result contains the stretch, the natural frequency there in 1/s, and the derivatives of the
    stretch by the coordinates of the free parameters, shape (p,).
    """
    setup = ResponseArguments.of(values, free)
    slopes = np.zeros(len(setup.wanted))
    stretch = derivatives.rest(setup.theta, setup.material, level, setup.wanted, slopes)
    if math.isnan(stretch):
        return None
    frequency = math.sqrt(setup.theta[derivatives.STIFFNESS]) * float(
        natural_frequency(stretch, setup.material))
    return stretch, frequency, slopes @ setup.mixing
