"""
Expected error of a course, and the decision whether to change to another one.

The expected squared error is that of the most probable motion plus the contribution of the
covariance of state and parameters under this course; it combines vibration and distance from the
target. A course is corrected only if the expected error of another one is smaller. Early in a
move, with large uncertainty, a course that tolerates errors is therefore preferred to one that is
exact for uncertain parameters.

Other parameters are tried on likely next moves from the current target, with the exact motion. The
uncertainty of the estimate counts, so that it replaces the parameters in use only once it is well
determined.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
import math
from typing import NamedTuple

import numpy as np

from hmsa.errors import HmsaError
from hmsa.identification.quantities import TEMPERATURE
from hmsa.model.equations import Array
from hmsa.model.laws.record import coordinate_of
from hmsa.model.thermal import Thermal
from hmsa.model.units import NANOSECONDS
from hmsa.planning.planner import Planner
from hmsa.planning.timeline import JointModel
from hmsa_lab.adapt.estimator import StateEstimate
from hmsa_lab.adapt.motion import follow, Levels, ModelMotion, rest

#: Maximum error after a change, relative to that before, and to that of a plan with the given
#: parameters.
SHARE, CLEARLY = 0.9, 0.25
#: Required gain, as a fraction of the step, before samples have shown an arrival.
MUCH = 0.05
# Other parameters must reduce the predicted error by at least this fraction of the step.
_LEAST = 1e-4
# Shorter steps are replaced by this one.
_STEP = 0.15
# Time in ns of a level before the course, which the field has then reached.
_LONG = 1000 * NANOSECONDS
# Noise, as a fraction of the step, up to which it is small.
_QUIET = 0.004


def caution(count: int, noise: float) -> float:
    """
    Return the factor on the duration of a cautious move, by the number of estimated parameters.

    The factor is three for three parameters and five for six; each doubling of the noise of a
    sample above 0.4 % of the step adds one, up to two.
    """
    more = math.log2(max(noise, _QUIET) / _QUIET)
    return max(3.0, 1.0 + 2.0 * count / 3.0) + min(more, 2.0)


@dataclass(frozen=True)
class CandidateLevels:
    """Levels to a target."""

    # Timestamp in ns and level in T, by time; the last level is held.
    levels: tuple[tuple[int, float], ...]
    arrival: int  # time in ns of rest at the target
    target: float  # stretch
    before: float = math.nan  # level in T before the first one; NaN if that came long before
    relaxed: float = math.nan  # level in T that holds it after relaxation; NaN: the last level

    @property
    def holding(self) -> float:
        """Level in T that is held at the end."""
        return self.levels[-1][1] if math.isnan(self.relaxed) else self.relaxed


@dataclass(frozen=True, eq=False)
class ExpectedError:
    """Expected error of a course."""

    misses: Array  # expected errors of stretch, of rate, and of the target
    covariance: Array  # of these errors

    @property
    def size(self) -> float:
        """Root of the expected squared vibration and distance from the target together."""
        return math.sqrt(float(self.misses @ self.misses) + float(np.trace(self.covariance)))

    def apart(self, other: 'ExpectedError') -> float:
        """Return the distance between the expected errors of two courses."""
        return float(np.linalg.norm(self.misses - other.misses))


class Ahead(NamedTuple):
    """A section of a path to look ahead."""

    times: Array  # in s from the earliest change of the course, shape (n,)
    stretch: Array  # desired at these times, shape (n,)


#: Outcome of a motion that cannot be simulated.
_NOWHERE = ExpectedError(np.full(3, math.inf), np.zeros((3, 3)))


def expect(
        estimate: StateEstimate, course: CandidateLevels, slew_limit: float = math.inf,
        until: int = 0) -> ExpectedError:
    """
    Return the expected error of a course; infinite if the motion cannot be simulated.

    The course may be changed from the time of the estimate on, and contains the level at that
    time. If it ends before `until`, in ns, the decay of vibration until then counts.
    """
    begin = estimate.time
    end = max(course.arrival, begin, until)
    levels = course.levels
    if not math.isnan(course.before):
        # A first level at the time of the estimate is a step.
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
        # The target is defined by the reading of the sensor.
        rows[2, estimate.gain] = estimate.values['stretch_gain'] * (
            stretch - coordinate_of(estimate.values['law']).rest)
    return _outcome(estimate, np.array([
        motion.stretch[0] - stretch, motion.rate[0] / frequency, stretch - course.target]), rows)


def expect_along(
        estimate: StateEstimate, levels: Sequence[tuple[int, float]], ahead: Ahead,
        slew_limit: float = math.inf) -> ExpectedError:
    """Return the expected RMS deviation of levels (timestamp in ns, T) from a path."""
    motion = _motion(estimate, levels, slew_limit, ahead.times)
    if motion is None:
        return _NOWHERE
    root = math.sqrt(len(ahead.times))
    return _outcome(estimate, (motion.stretch - ahead.stretch) / root, motion.by / root)


def _motion(
        estimate: StateEstimate, levels: Sequence[tuple[int, float]], slew_limit: float,
        times: Array) -> ModelMotion | None:
    """Return the motion at times in s after that of an estimate; None if impossible."""
    return follow(
        estimate.values, estimate.free, (estimate.stretch, estimate.rate),
        Levels(np.array([(x - estimate.time) / NANOSECONDS for x, _ in levels]),
               np.array([x for _, x in levels]), slew_limit), 0.0, times)


def _outcome(estimate: StateEstimate, misses: Array, rows: Array) -> ExpectedError:
    """Return an outcome from the most probable errors and their derivatives."""
    off = rows @ estimate.off
    return ExpectedError(misses + off, rows @ estimate.covariance @ rows.T - np.outer(off, off))


def worthwhile(
        before: ExpectedError, after: ExpectedError, least: float, share: float = SHARE) -> bool:
    """
    Return whether another course has a sufficiently smaller error, and gains at least ``least``.

    Both are compared along the direction in which their errors differ, since common errors do not
    matter. The error has to decrease to less than ``share`` of the former one.
    """
    if not math.isfinite(before.size + after.size):
        return after.size < before.size
    apart = before.apart(after)
    way = (before.misses - after.misses) / apart if apart else np.zeros(len(before.misses))
    square = [float((x.misses @ way) ** 2 + way @ x.covariance @ way) for x in (before, after)]
    beside = [float(np.trace(x.covariance) - way @ x.covariance @ way) for x in (before, after)]
    one, other = (math.sqrt(max(x + y - min(beside), 0.0)) for x, y in zip(
        square, beside, strict=True))
    return other < min(share * one, one - least)


def clearly_better(
        estimate: StateEstimate, model: JointModel, used: JointModel, start: float, target: float,
        *, given: bool, shown: bool) -> bool:
    """
    Return whether moves planned with a model have a clearly smaller predicted error.

    The joint went from the start to the target; the trial moves lead back and further on. If the
    parameters in use are the ``given`` ones, ``model`` must be clearly better, and much better
    until samples have ``shown`` an arrival.
    """
    step = math.copysign(max(abs(target - start), _STEP), target - start)
    tried = [[_left(estimate, each, target, to) for each in (used, model)]
             for to in (target - step, target + 0.7 * step)]
    pairs = [(one, other) for one, other in tried if one is not None and other is not None]
    if not pairs:
        return False
    before, after = map(_together, zip(*pairs, strict=True))
    return worthwhile(
        before, after, MUCH if given and not shown else _LEAST, CLEARLY if given else SHARE)


def _together(outcomes: Sequence[ExpectedError]) -> ExpectedError:
    """Return the average predicted error of several moves."""
    count = len(outcomes)
    size = len(outcomes[0].misses)
    covariance = np.zeros((count, size, count, size))
    for i, each in enumerate(outcomes):
        covariance[i, :, i] = each.covariance / count
    return ExpectedError(
        np.concatenate([x.misses for x in outcomes]) / math.sqrt(count),
        covariance.reshape(count * size, -1))


def _left(
        estimate: StateEstimate, model: JointModel, start: float, target: float
) -> ExpectedError | None:
    """
    Return the predicted error of a move from rest that is planned with a model.

    The values are fractions of the step. None if the move cannot be planned or simulated.
    """
    try:
        model = model.at_temperature(estimate.values[TEMPERATURE])
        levels, arrival = _planned(model, start, target)
    except HmsaError:
        return None
    holding = model.flux_density(model.holding(start))
    resting = _at_rest(estimate, holding)
    if arrival is None or resting is None:
        return None
    left = expect(
        resting, CandidateLevels(levels, arrival, target, holding), model.options.slew_limit)
    step = abs(target - start)
    return ExpectedError(left.misses / step, left.covariance / step ** 2) if math.isfinite(
        left.size) else None


# The model in use is tried on the same moves after each sample of a setpoint.
@lru_cache(maxsize=8)
def _planned(
        model: JointModel, start: float, target: float
) -> tuple[tuple[tuple[int, float], ...], int | None]:
    """Return levels (timestamp in ns, T) and arrival of a move from rest at time 0."""
    plan = Planner(
        replace(model.actuator, thermal=Thermal()),
        replace(model.options, lead_time=0, period=0), stretch=start).setpoint(target, 0)
    return (tuple((x.stamp, x.flux_density) for x in plan.levels if x.stamp >= 0),
            plan.segments[-1].arrival)


def _at_rest(estimate: StateEstimate, level: float) -> StateEstimate | None:
    """Return the estimate at time 0 after a level in T has been in force for a long time."""
    values = {x: y for x, y in estimate.values.items() if x != 'behind'}
    at = rest(values, estimate.free, level)
    if at is None:
        return None
    count = len(estimate.free)
    change = np.zeros((count + 2, count))
    change[:count], change[count] = np.eye(count), at[2]
    known = estimate.covariance[:count, :count]
    return replace(
        estimate, time=0, stretch=at[0], rate=0.0, values=values,
        covariance=change @ known @ change.T, off=change @ estimate.off[:count])
