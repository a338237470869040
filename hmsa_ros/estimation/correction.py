"""
What a course is expected to leave, and whether another one is worth changing to.

A course is expected to leave, squared, what the most probable motion leaves, and what the
covariance of state and parameters adds to it under this very course: vibration and distance from
the target together. A course is corrected only where another one is expected to leave less. Early
in a move, when little is known, a course that forgives errors so wins against one that is exact
for parameters which are a guess.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from hmsa_ros.estimation.estimator import Estimate
from hmsa_ros.estimation.motion import follow, Levels, Motion, rest
from hmsa_ros.model.equations import Array
from hmsa_ros.model.laws.coordinate import coordinate_of
from hmsa_ros.model.units import NANOSECONDS

#: A move that is expected to leave more than this share of its step is given more time.
TOLERANCE = 5e-3
#: A correction leaves at most this share of what the course in force leaves, while there is time
#: for more of them, and at rest.
SHARE, AT_REST = 0.9, 0.5
#: And of what plans by the parameters given leave.
CLEARLY = 0.25
#: Share of the step that is to be gained before samples have shown an arrival.
MUCH = 0.05
#: Share of the step up to which what a correction changes is little.
LITTLE = 2.5e-3
# How long in ns a level has been in force that a field has followed.
_LONG = 1000 * NANOSECONDS
# Time constants of a coil after which it has followed.
_LAGS = 10.0
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
    before: float = math.nan  # level in T until the first one; NaN where that came long before
    relaxed: float = math.nan  # level in T that holds it once branches have relaxed; NaN: the last

    @property
    def holding(self) -> float:
        """Level in T that is held at the end."""
        return self.levels[-1][1] if math.isnan(self.relaxed) else self.relaxed


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a course is expected to leave."""

    misses: Array  # as expected: of stretch, of rate, and of the target
    covariance: Array  # what is not known of these

    @property
    def size(self) -> float:
        """Root of the expected square of vibration and distance from the target together."""
        return math.sqrt(float(self.misses @ self.misses) + float(np.trace(self.covariance)))

    def apart(self, other: 'Outcome') -> float:
        """Return how far what another course leaves is from it."""
        return float(np.linalg.norm(self.misses - other.misses))


class Ahead(NamedTuple):
    """A path as far as it is looked ahead."""

    times: Array  # in s from when a course may still be changed, shape (n,)
    stretch: Array  # wanted then, shape (n,)


#: What a motion leaves that cannot be followed.
_NOWHERE = Outcome(np.full(3, math.inf), np.zeros((3, 3)))


def expect(
        estimate: Estimate, course: Course, slew_limit: float = math.inf,
        until: int = 0) -> Outcome:
    """
    Return what a course is expected to leave; infinite where the motion cannot be followed.

    The estimate is of a time from which on the course may still be changed; the course has the
    level in force then. If it ends before `until`, in ns, that counts: vibration decays meanwhile.
    """
    begin = estimate.time
    # A coil that lags shifts a motion, and leaves nothing once it has arrived too.
    lag = estimate.values['coil_time_constant'] + 2.0 * estimate.deviations.get(
        'coil_time_constant', 0.0)
    end = max(course.arrival, begin, until) + round(_LAGS * lag * NANOSECONDS)
    levels = course.levels
    if not math.isnan(course.before):
        # A level that begins with the course is a step in it.
        levels = ((min(begin, levels[0][0]) - _LONG, course.before), *(
            (x + (x == begin), y) for x, y in levels))
    motion = _motion(estimate, levels, slew_limit, np.array([(end - begin) / NANOSECONDS]))
    at = rest(estimate.values, estimate.free, course.holding)
    if motion is None or at is None:
        return _NOWHERE
    stretch, frequency, by = at
    rows = np.zeros((3, len(estimate.covariance)))
    rows[0] = motion.by[0]
    rows[0, :-2] -= by
    rows[1] = motion.rate_by[0] / frequency
    rows[2, :-2] = by
    if estimate.gain >= 0:
        # The target is where the sensor shows it.
        rows[2, estimate.gain] = estimate.values['stretch_gain'] * (
            stretch - coordinate_of(estimate.values['law']).rest)
    return _outcome(estimate, np.array([
        motion.stretch[0] - stretch, motion.rate[0] / frequency, stretch - course.target]), rows)


def expect_along(
        estimate: Estimate, levels: Sequence[tuple[int, float]], ahead: Ahead,
        slew_limit: float = math.inf) -> Outcome:
    """Return how far levels (stamp in ns, T) are expected to lead off a path, in the mean."""
    motion = _motion(estimate, levels, slew_limit, ahead.times)
    if motion is None:
        return _NOWHERE
    root = math.sqrt(len(ahead.times))
    return _outcome(estimate, (motion.stretch - ahead.stretch) / root, motion.by / root)


def _motion(
        estimate: Estimate, levels: Sequence[tuple[int, float]], slew_limit: float,
        times: Array) -> Motion | None:
    """Return the motion at times in s after that of an estimate; None if it has none."""
    return follow(
        estimate.values, estimate.free, (estimate.stretch, estimate.rate),
        Levels(np.array([(x - estimate.time) / NANOSECONDS for x, _ in levels]),
               np.array([x for _, x in levels]), slew_limit), 0.0, times)


def _outcome(estimate: Estimate, misses: Array, rows: Array) -> Outcome:
    """Return an outcome by the most probable misses, and how they follow the coordinates."""
    off = rows @ estimate.off
    return Outcome(misses + off, rows @ estimate.covariance @ rows.T - np.outer(off, off))


def worthwhile(
        before: Outcome, after: Outcome, least: float = 0.0, *, little: float,
        share: float = SHARE) -> bool:
    """
    Return whether another course leaves enough less, and that by the least gain.

    Both are compared along the direction by which what they leave differs: what they leave alike
    besides is no reason to choose. The other one has to leave at most a share; one that changes
    little, in units of stretch, can do little harm, and only has to leave less.
    """
    if not math.isfinite(before.size + after.size):
        return after.size < before.size
    apart = before.apart(after)
    share = SHARE if apart < little else share
    way = (before.misses - after.misses) / apart if apart else np.zeros(len(before.misses))
    square = [float((x.misses @ way) ** 2 + way @ x.covariance @ way) for x in (before, after)]
    beside = [float(np.trace(x.covariance) - way @ x.covariance @ way) for x in (before, after)]
    one, other = (math.sqrt(max(x + y - min(beside), 0.0)) for x, y in zip(
        square, beside, strict=True))
    return other < min(share * one, one - least)
