"""
What a course is expected to leave, and a better one from the estimated state.

A course is expected to leave, squared, what the most probable motion leaves, and what the
covariance of state and parameters adds to it under this very course: vibration and distance from
the target together. A course is corrected only where another one is expected to leave less. Early
in a move, when little is known, a course that forgives errors so wins against one that is exact
for parameters which are a guess.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
import math

import numpy as np

from hmsa_ros.errors import BadInputError
from hmsa_ros.estimation.estimator import Estimate
from hmsa_ros.estimation.motion import follow, followed, Levels, rest
from hmsa_ros.model.moves import Move, State
from hmsa_ros.model.status import RefusedError
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.shapers import get_shaper
from hmsa_ros.planning.shapers.request import Request
from hmsa_ros.planning.shapers.through import through
from hmsa_ros.planning.timeline import Model, Options

#: A move that is expected to leave more than this share of its step is given more time.
TOLERANCE = 5e-3
# A correction leaves at most this share of what the course in force leaves, in squares, and
# gains at least this, as a share of the noise of a sample.
_SHARE, _GAIN = 0.8, 0.02
# Share of the step up to which noise is little.
_QUIET = 0.004
# Durations of a correction in half periods: the least with which a move still arrives in time, and
# those tried where it does not.
_LEAST, _TRIED = 0.15, (0.5, 1.0, 1.6)

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

    def follows(self, other: 'Course', begin: int) -> 'Course':
        """Return this course after what another one does before a time in ns."""
        return replace(self, levels=(
            *(x for x in other.levels if x[0] < begin), *self.levels))


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


def lengthening(
        estimate: Estimate, course: Course, step: float, slew_limit: float = math.inf,
        tolerance: float = TOLERANCE) -> float:
    """
    Return how many times as long a move is to take: 1, or `caution` where it may leave too much.

    The estimate is of the begin of the move, the step its change of stretch, above 0, and the
    tolerance the share of the step from which on that is too much.
    """
    if expect(estimate, course, slew_limit) <= tolerance * step:
        return 1.0
    return caution(len(estimate.free), estimate.noise / step)


def worthwhile(before: float, after: float, noise: float, least: float = 0.0) -> bool:
    """Return whether a correction leaves enough less: sizes of `expect`, and the least gain."""
    return after < min(math.sqrt(_SHARE) * before, before - max(_GAIN * noise, least))


class Corrector:
    """Plans courses from estimates; an estimated lag takes the place of that in the options."""

    def __init__(self, options: Options) -> None:
        self.options = options

    def first(
            self, estimate: Estimate, target: float, in_force: float, *,
            shaper: str = 'two_step', order: int = 2,
            tolerance: float = math.inf) -> Course:
        """
        Plan a move from the level in force, in T, to a stretch; refuse one that cannot be reached.

        Where it is expected to leave more than a share of the step, its levels stay, since their
        early effect shows what the actuator is, but it gets more time, by `caution`, for
        corrections until rest.
        """
        model = estimate.model(self.options)
        move = get_shaper(shaper)(replace(
            self._request(model, estimate, target, in_force), order=order))
        found = _placed(move, model, estimate.time, target)
        if math.isinf(tolerance):
            return found
        longer = lengthening(
            estimate, found, max(abs(target - estimate.stretch), estimate.noise),
            self.options.slew_limit, tolerance)
        return replace(found, arrival=estimate.time + round(
            longer * (found.arrival - estimate.time)))

    def correct(self, estimate: Estimate, course: Course) -> Course | None:
        """
        Plan what is left of a move anew, where that is expected to leave less; else None.

        The estimate is of the time from which on levels may be changed; those of the course in
        force before that time stay.
        """
        if not estimate.trusted:
            return None
        slew = self.options.slew_limit
        best: Course | None = None
        least = math.inf
        try:
            model = estimate.model(self.options)
        except BadInputError:
            return None
        for found in self._candidates(model, estimate, course):
            whole = found.follows(course, estimate.time)
            size = expect(estimate, whole, slew)
            now = expect(estimate, course, slew, whole.arrival)
            if size < least and worthwhile(now, size, estimate.noise):
                best, least = whole, math.sqrt(_SHARE) * size
        return best

    def _request(
            self, model: Model, estimate: Estimate, target: float, in_force: float) -> Request:
        units = model.units
        load = in_force / units.load
        return Request(
            State(estimate.stretch, estimate.rate * units.time, load,
                  load if model.delivery.lag > 0.0 else None,
                  followed(estimate.values, estimate.stretch)),
            target, model.material, model.limits, model.delivery, units=units,
            pace=model.pace)

    def _candidates(
            self, model: Model, estimate: Estimate, course: Course) -> Iterator[Course]:
        """Yield courses from now on, those that arrive sooner first."""
        begin = estimate.time
        levels = [x for x in course.levels if x[0] < begin]
        in_force = levels[-1][1] if levels else course.levels[0][1]
        request = self._request(model, estimate, course.target, in_force)
        if model.delivery.lag > 0.0:
            lag = model.delivery.lag * model.units.time
            field = Levels(
                np.array([(x - begin) / NANOSECONDS for x, _ in course.levels]),
                np.array([x for _, x in course.levels]), self.options.slew_limit
            ).field(0.0, lag) / model.units.load
            request = replace(request, state=replace(request.state, load=field))
        half = math.pi / model.frequency(course.target)
        left = model.time(course.arrival - begin)
        # On the way in the time that is left, and afterwards in times of their own.
        durations = [left] if left > 0.0 else [x * half for x in _TRIED]
        for duration in durations:
            if duration > _LEAST * half:
                with suppress(RefusedError):
                    yield _placed(through(request, duration), model, begin, course.target)


def _placed(move: Move, model: Model, begin: int, target: float) -> Course:
    """Return the course of a move that begins at a time in ns."""
    unit = model.units.load
    end = move.duration if math.isfinite(move.duration) else move.levels[-1].time
    return Course(
        tuple((begin + model.ns(x.time), x.load * unit) for x in move.levels),
        begin + model.ns(end), target)

