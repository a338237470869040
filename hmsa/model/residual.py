"""Residual vibration after the arrival of a move."""

import math

import numpy as np
from numpy.typing import ArrayLike

from hmsa.errors import HmsaError

#: Smaller fractions of a step are not distinguished: no sensor resolves them.
RESOLVED = 1e-5


def residual_vibration(
        time: ArrayLike, stretch: ArrayLike, *, arrival: float, end: float,
        step: float) -> float:
    """
    Return the peak-to-peak stretch after arrival as a fraction (not percent) of the step.

    Samples from ``arrival`` to ``end``, both included, count; ``time`` (n,) increases, in the same
    unit. Raise `HmsaError` for fewer than two of them, or a step of zero. 0 means rest.
    """
    time = np.asarray(time, dtype=np.float64)
    inside = (time >= arrival) & (time <= end)
    count = int(np.count_nonzero(inside))
    if count < 2 or step == 0.0:
        raise HmsaError(
            f'{count} samples between {arrival:g} and {end:g} after a step of {step:g}: '
            'expected at least two samples and a step')
    return float(np.ptp(np.asarray(stretch, dtype=np.float64)[inside]) / abs(step))


def percent(share: float, sign: str = '') -> str:
    """
    Format a fraction of a step in percent, without the unit; NaN gives a question mark.

    Values below `RESOLVED` are shown as ``<``; with ``sign`` ``'+'`` others have a sign.
    """
    if math.isnan(share):
        return '?'
    if abs(share) < RESOLVED:
        return f'<{100.0 * RESOLVED:g}'
    value, size = 100.0 * share, 100.0 * abs(share)
    return f'{value:{sign}.{1 if size >= 1.0 else 2 if size >= 0.1 else 3}f}'
