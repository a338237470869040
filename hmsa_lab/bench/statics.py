"""Evaluation of a slow staircase of levels: static response of an actuator, and its sensor."""

from dataclasses import dataclass
import math

import numpy as np

from hmsa.errors import BadInputError
from hmsa.model.equations import Array
from hmsa_lab.bench.assembly import SensorScale
from hmsa_lab.bench.calibration import branch_means

# Minimum number of rows of a table of the law.
_FEWEST = 6
# Minimum number of different lengths for a straight line.
_LENGTHS = 3


@dataclass(frozen=True, eq=False)
class Statics:
    """
    An actuator at rest.

    Attributes
    ----------
    level, stretch : ndarray, shape (m,)
        Levels in T, and the stretch that they hold, in ascending order; 1 without a field.
    rest : float
        Stretch reported by the sensor without a field.
    apart : float
        Largest difference of the stretches at one level that was approached from both sides, as a
        fraction of the range; NaN if there was none.

    """

    level: Array
    stretch: Array
    rest: float
    apart: float


def statics(level: Array, stretch: Array) -> Statics:
    """
    Evaluate a staircase.

    Parameters
    ----------
    level, stretch : ndarray, shape (n,)
        Levels in T in chronological order, and the measured stretch at each.

    Returns
    -------
    Statics
        With increasing stretches.

    Raises
    ------
    BadInputError
        If there are too few levels, or the stretch does not increase with them.

    """
    if not np.all(np.isfinite(level) & np.isfinite(stretch)):
        raise BadInputError('levels and stretches are not all finite: expected numbers')
    if len(np.unique(level)) < _FEWEST or not np.min(level) < 0.0 < np.max(level):
        raise BadInputError(
            f'{len(np.unique(level))} levels: expected at least {_FEWEST}, of both signs')
    at, mean, apart = branch_means(level, stretch)
    rest = float(np.interp(0.0, at, mean))
    if not rest > 0.0:
        raise BadInputError(
            f'the sensor shows a stretch of {rest:g} without a field: expected one above 0; see '
            'its gain, offset and rest_length')
    if not np.all(np.diff(mean) > 0.0):
        place = int(np.argmin(np.diff(mean)))
        raise BadInputError(
            f'the stretch goes from {mean[place]:.6g} at {at[place]:.4g} T to '
            f'{mean[place + 1]:.6g} at {at[place + 1]:.4g} T: expected a rising one; swap the '
            'leads or the sign of the gain where it falls, else raise --settle or --limit, or '
            'lower --steps')
    return Statics(at, mean / rest, rest, apart)


def scale_at_rest(scale: SensorScale, rest: float) -> SensorScale:
    """Return a scale with stretch 1 at the reading where the given one shows ``rest``."""
    return SensorScale(scale.gain, scale.offset, scale.rest_length * rest, scale.latency)


def scale_by_gauge(
        scale: SensorScale, level: Array, stretch: Array, length: Array
) -> tuple[SensorScale, float]:
    """
    Calibrate a sensor with a gauge of the actuator's length.

    Parameters
    ----------
    scale : SensorScale
        Scale of the measured stretches.
    level : ndarray, shape (n,)
        Levels in T.
    stretch : ndarray, shape (n,)
        Measured stretches.
    length : ndarray, shape (n,)
        Lengths from the gauge, in the unit of the rest length.

    Returns
    -------
    (SensorScale, float)
        The scale, and the largest deviation of a length from it, as a fraction of their range.

    Raises
    ------
    BadInputError
        If the lengths do not depend on the sensor.

    """
    span = float(np.ptp(length)) if np.all(np.isfinite(length)) else math.nan
    if not span > 0.0 or len(np.unique(stretch)) < _LENGTHS:
        raise BadInputError(
            f'the gauge shows lengths over {span:g}: expected at least {_LENGTHS} different ones')
    reading = (stretch * scale.rest_length - scale.offset) / scale.gain
    gain, offset = (float(x) for x in np.polyfit(reading, length, 1))
    misses = float(np.max(np.abs(gain * reading + offset - length))) / span
    still = np.abs(level) <= 1e-9 * float(np.max(np.abs(level)))
    rest = float(np.mean(length[still])) if np.any(still) else math.nan
    if not rest > 0.0 or misses > 0.5:
        raise BadInputError(
            f'the gauge shows {rest:g} without a field, and misses a straight line by '
            f'{100.0 * misses:.3g} % of its range: expected the length of the actuator')
    return SensorScale(gain, offset, rest, scale.latency), misses
