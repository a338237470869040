"""The motion under known levels, with its derivatives by parameters and by where it began."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np

from hmsa_ros.core.delivery import late
from hmsa_ros.core.law import natural_frequency
from hmsa_ros.core.model import Array
from hmsa_ros.identification import kernels
from hmsa_ros.identification.quantities import derivative
from hmsa_ros.identification.recording import pieces
from hmsa_ros.identification.response import set_rest, Setup

# Relative tolerance: far below the noise of a sensor.
_RTOL = 1e-7
# Time constants after which nothing is left of an earlier field.
_FORGOTTEN = 40.0


@dataclass(frozen=True, eq=False)
class Levels:
    """
    What the amplifier is told, over time.

    Attributes
    ----------
    times, values : ndarray, shape (m,)
        In s, increasing, and in T.
    slew_limit : float
        Rate in T/s at which the amplifier ramps; infinite for steps.

    """

    times: Array
    values: Array
    slew_limit: float = math.inf

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
    """
    A simulated motion.

    Attributes
    ----------
    stretch, rate : ndarray, shape (n,)
        Of the block, the rate in 1/s.
    by, rate_by : ndarray, shape (n, p + 2)
        Derivatives of both by the coordinates of the free parameters and by stretch and rate at
        the begin; 0 for parameters of the sensor.

    """

    stretch: Array
    rate: Array
    by: Array
    rate_by: Array

    def measured(
            self, values: Mapping[str, float], free: Sequence[str]) -> tuple[Array, Array]:
        """
        Return what the sensor shows.

        Parameters
        ----------
        values : mapping of str to float
            Of all quantities.
        free : sequence of str
            As simulated.

        Returns
        -------
        stretch : ndarray, shape (n,)
            Measured.
        by : ndarray, shape (n, p + 2)
            Its derivatives.

        """
        gain = values['stretch_gain']
        by = gain * self.by
        for j, name in enumerate(free):
            if name == 'stretch_bias':
                by[:, j] = 1.0
            elif name == 'stretch_gain':
                by[:, j] = derivative(name, gain) * self.stretch
            elif name == 'sensor_latency':
                by[:, j] = -gain * self.rate
        return gain * self.stretch + values['stretch_bias'], by


def follow(
        values: Mapping[str, float], free: Sequence[str], state: tuple[float, float],
        levels: Levels, begin: float, times: Array) -> Motion | None:
    """
    Simulate a motion.

    Parameters
    ----------
    values : mapping of str to float
        Of all quantities, complete.
    free : sequence of str
        By which to differentiate.
    state : (float, float)
        Stretch, and rate in 1/s, at the begin.
    levels : Levels
        Those before the begin count where the field lags.
    begin : float
        In s.
    times : ndarray, shape (n,)
        In s, not decreasing, from the begin on.

    Returns
    -------
    Motion or None
        None if it meets the limits of the chains.

    """
    setup = Setup.of(values, free)
    theta = setup.theta
    theta[kernels.STRETCH], theta[kernels.RATE] = state
    inner = len(setup.wanted)
    wanted = np.append(setup.wanted, [kernels.STRETCH, kernels.RATE])
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
    stretch, rate = np.empty(n), np.empty(n)
    raw, raw_rate = np.empty((n, inner + 2)), np.empty((n, inner + 2))
    if not kernels.respond(
            theta, setup.material, setup.branches, wanted, start, starts, heights, slopes, field,
            field_lag, times, _RTOL, stretch, rate, raw, raw_rate):
        return None
    return Motion(
        stretch, rate, np.hstack([raw[:, :inner] @ setup.mixing, raw[:, inner:]]),
        np.hstack([raw_rate[:, :inner] @ setup.mixing, raw_rate[:, inner:]]))


def rest(
        values: Mapping[str, float], free: Sequence[str], level: float
) -> tuple[float, float, Array] | None:
    """
    Return where a level holds the block.

    Parameters
    ----------
    values : mapping of str to float
        Of all quantities, complete.
    free : sequence of str
        By which to differentiate.
    level : float
        In T.

    Returns
    -------
    (float, float, ndarray), or None
        Stretch, natural frequency there in 1/s, and derivatives of the stretch by the coordinates
        of the free parameters, shape (p,); None if nothing holds it.

    """
    setup = Setup.of(values, free)
    start = np.zeros(len(setup.wanted))
    if not set_rest(setup.theta, setup.material, level, setup.wanted, start):
        return None
    stretch = float(setup.theta[kernels.STRETCH])
    frequency = math.sqrt(setup.theta[kernels.STIFFNESS]) * float(
        natural_frequency(stretch, setup.material))
    return stretch, frequency, start @ setup.mixing
