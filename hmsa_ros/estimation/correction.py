"""
What a course is expected to leave, and whether another one is worth changing to.

A course is expected to leave, squared, what the most probable motion leaves, and what the
covariance of state and parameters adds to it under this very course: vibration and distance from
the target together. A course is corrected only where another one is expected to leave less. Early
in a move, when little is known, a course that forgives errors so wins against one that is exact
for parameters which are a guess.
"""

from dataclasses import dataclass
import math

import numpy as np

from hmsa_ros.estimation.estimator import Estimate
from hmsa_ros.estimation.motion import follow, Levels, rest
from hmsa_ros.model.units import NANOSECONDS

#: A move that is expected to leave more than this share of its step is given more time.
TOLERANCE = 5e-3
# A correction leaves at most this share of what the course in force leaves, in squares, and
# gains at least this, as a share of the noise of a sample.
_SHARE, _GAIN = 0.8, 0.02
# Share of the step up to which noise is little.
_QUIET = 0.004


def caution(count: int, noise: float) -> float:
    """
    Return how many times as long a cautious move takes, by the number of estimated parameters.

    Three times as long for three, five times for six; each doubling of the noise of a sample above
    0.4 % of the step adds one more, up to two.
    """
    more = math.log2(max(noise, _QUIET) / _QUIET)
    return max(3.0, 1.0 + 2.0 * count / 3.0) + min(more, 2.0)


@dataclass(frozen=True)
class Course:
    """Levels to a target."""

    # Stamp in ns and level in T, by time; the last one holds.
    levels: tuple[tuple[int, float], ...]
    arrival: int  # time in ns of rest at the target
    target: float  # stretch
    relaxed: float = math.nan  # level in T that holds it once branches have relaxed; NaN: the last

    @property
    def holding(self) -> float:
        """Level in T that is held at the end."""
        return self.levels[-1][1] if math.isnan(self.relaxed) else self.relaxed


def expect(
        estimate: Estimate, course: Course, slew_limit: float = math.inf,
        until: int = 0) -> float:
    """
    Return what a course is expected to leave; infinite where the motion cannot be followed.

    It is the root of the expected square of vibration and distance from the target together.

    The estimate is of a time from which on the course may still be changed; the course has the
    level in force then. If it ends before `until`, in ns, that counts: vibration decays meanwhile.
    """
    begin = estimate.time
    end = max(course.arrival, begin, until)
    motion = follow(
        estimate.values, estimate.free, (estimate.stretch, estimate.rate),
        Levels(np.array([(x - begin) / NANOSECONDS for x, _ in course.levels]),
               np.array([x for _, x in course.levels]), slew_limit),
        0.0, np.array([(end - begin) / NANOSECONDS]))
    at = rest(estimate.values, estimate.free, course.holding)
    if motion is None or at is None:
        return math.inf
    stretch, frequency, by = at
    rows = np.zeros((3, len(estimate.covariance)))
    rows[0] = motion.by[0]
    rows[0, :-2] -= by
    rows[1] = motion.rate_by[0] / frequency
    rows[2, :-2] = by
    misses = np.array([
        motion.stretch[0] - stretch, motion.rate[0] / frequency, stretch - course.target])
    spread = float(np.einsum('ij,jk,ik->', rows, estimate.covariance, rows))
    return math.sqrt(float(misses @ misses) + max(spread, 0.0))


def worthwhile(before: float, after: float, noise: float, least: float = 0.0) -> bool:
    """Return whether a correction leaves enough less: sizes of `expect`, and the least gain."""
    return after < min(math.sqrt(_SHARE) * before, before - max(_GAIN * noise, least))
