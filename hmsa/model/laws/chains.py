"""Stretches at which chains of limited length are fully extended."""

import math
from typing import Any

import numpy as np


def gent_limits(i_j: Any) -> tuple[Any, Any]:
    """
    Return the stretches at which chains of limit 1/i_j are fully extended, also for arrays.

    They are the positive roots of l^3 - (1/i_j + 3) l + 2; 0 and infinity for i_j = 0.
    """
    with np.errstate(divide='ignore', invalid='ignore'):
        p = 1.0 / np.asarray(i_j, dtype=np.float64) + 3.0
        angle = np.arccos(-((3.0 / p) ** 1.5))
        lower = 2.0 * np.sqrt(p / 3.0) * np.cos((angle - 2.0 * math.pi) / 3.0)
        upper = 2.0 * np.sqrt(p / 3.0) * np.cos(angle / 3.0)
        for _ in range(2):
            # Newton steps recover digits lost if the roots lie close together.
            lower = lower - (lower ** 3 - p * lower + 2.0) / (3.0 * lower * lower - p)
            upper = upper - (upper ** 3 - p * upper + 2.0) / (3.0 * upper * upper - p)
    endless = np.isinf(p)
    return np.where(endless, 0.0, lower), np.where(endless, math.inf, upper)
