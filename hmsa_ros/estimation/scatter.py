"""Whether samples scatter about the best fit as they do at rest; else the model lacks a term."""

import math

import numpy as np

from hmsa_ros.estimation.window import Solution
from hmsa_ros.identification.fit import robust_scale
from hmsa_ros.model.equations import Array

# Samples that show how much they scatter at rest, and how well they fit.
_FEWEST, _MOVING = 10, 20
# Order of the differences that show the noise of samples of a motion.
_ORDER = 4
# From which factor on they scatter more than at rest, at least and by this many deviations, where
# neighbours are alike by this correlation: jitter and noise that grows with speed are not.
_FACTOR, _SURE, _ALIKE = 1.6, 5.0, 0.4
# Deviations of an offset of all timestamps that explains it.
_LATE = 6.0


class Scatter:
    """
    Compares what a fit leaves with what one at rest leaves.

    A fit with the wrong model is as good as one with the right one at rest, where few parameters
    explain a constant, and leaves more of a motion.
    """

    def __init__(self) -> None:
        self.at_rest = math.nan  # deviation of a sample
        self.trouble = ''  # what the fit lacks; empty if nothing

    def look(self, found: Solution, stretch: Array, least: float, *, resting: bool) -> None:
        """Take in a fit of samples of rest, or judge one of samples of a motion, shape (n,)."""
        count = len(stretch)
        squares = found.weights * found.residual ** 2
        if resting:
            if count >= _FEWEST:
                self.at_rest = max(math.sqrt(float(np.mean(squares))), least)
            self.trouble = ''
            return
        if count < _MOVING:
            return
        noise = self.at_rest
        if math.isnan(noise):
            # What a motion through many samples cannot be: no more than this.
            noise = max(robust_scale(np.diff(stretch, _ORDER)) / math.sqrt(
                math.comb(2 * _ORDER, _ORDER)), least)
        factor = math.sqrt(float(np.mean(squares))) / noise
        alike = float(found.residual[1:] @ found.residual[:-1]) / max(
            float(found.residual @ found.residual), least ** 2)
        self.trouble = ''
        if factor > max(_FACTOR, 1.0 + _SURE / math.sqrt(2.0 * count)) and alike > _ALIKE:
            self.trouble = (
                f'samples scatter {factor:.1f} times as much about the best fit as at rest, by '
                f'what is not estimated{_offset(found, noise)}')


def _offset(found: Solution, noise: float) -> str:
    """Return in words by how much timestamps seem to be off, if that explains anything."""
    count = len(found.residual)
    shift = -found.motion.rate[:count] * found.values['stretch_gain']
    weighted = found.weights / noise ** 2
    cross = found.by.T @ (weighted * shift)
    known = float(shift @ (weighted * shift)) - float(cross @ found.covariance @ cross)
    if known <= 0.0:
        return ''
    late = float(shift @ (weighted * found.residual)) / known
    if abs(late) * math.sqrt(known) < _LATE or abs(late) > found.values['time_unit']:
        return ''
    return (f', as if timestamps were {1e3 * abs(late):.2g} ms too '
            f'{"late" if late > 0.0 else "early"}')
