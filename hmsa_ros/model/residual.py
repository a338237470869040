"""What is left of a move: residual vibration after arrival."""

import numpy as np
from numpy.typing import ArrayLike

from hmsa_ros.errors import HmsaError


def residual_vibration(
        time: ArrayLike, stretch: ArrayLike, *, arrival: float, end: float,
        step: float) -> float:
    """
    Return the peak-to-peak stretch after arrival as a share, not percent, of the commanded step.

    Samples from ``arrival`` to ``end``, both included, count; ``time`` (n,) increases, in the unit
    of both. Fewer than two of them, or a step of zero, are an `HmsaError`. 0 is rest.
    """
    time = np.asarray(time, dtype=np.float64)
    inside = (time >= arrival) & (time <= end)
    count = int(np.count_nonzero(inside))
    if count < 2 or step == 0.0:
        raise HmsaError(
            f'{count} samples between {arrival:g} and {end:g} after a step of {step:g}: '
            'expected at least two samples and a step')
    return float(np.ptp(np.asarray(stretch, dtype=np.float64)[inside]) / abs(step))
