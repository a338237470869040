"""
Predict the error of plans if commands take effect late.

Late commands leave vibration, and so does a new plan whose commands are late again. Both are
simulated in several scenarios, in which future commands are as late as the previous ones.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
import math

import numpy as np
from numpy.typing import NDArray

from hmsa.errors import HmsaError
from hmsa.model.moves import Level
from hmsa.model.simulation import sampled
from hmsa.model.units import NANOSECONDS
from hmsa.planning.lateness import Lateness
from hmsa.planning.timeline import Draft, PlannedLevel, Timeline

#: Smaller steps are replaced by this one.
LEAST_STEP = 0.1
#: Peak-to-peak residual vibration, as a fraction of the step, from which it matters.
SHARE = 5e-3
# Required gain of a new plan, beyond this many standard deviations over the scenarios, and the
# largest error it may leave: one of a whole step is left to chance. After an exception: the
# fraction of the present error that it may leave, the fraction of the gain by which one scenario
# may be worse, and the fraction of the present error once no more information will come.
_GAIN, _SURE, _MOST, _LITTLE, _RISK, _CLEARLY = 5e-3, 3.0, 1.0, 0.35, 0.2, 0.5
# Stands for the error of a motion that cannot be predicted.
_LOST = 1e3
# Setpoints considered, how far ahead the next one may begin, time scales that may be simulated,
# and number of scenarios.
_SETPOINTS, _NEAR, _LONGEST, _WAYS = 2, 50.0, 2000.0, 16


@dataclass(frozen=True)
class Aim:
    """A setpoint to be reached; times in ns."""

    stretch: float
    step: float  #: of stretch, at least `LEAST_STEP`
    arrival: int
    end: int | None  #: begin of the next setpoint; None if there is none


def step_of(plan: Timeline, place: int) -> float:
    """Return the step of a setpoint by its place in a plan, at least `LEAST_STEP`."""
    return LEAST_STEP if place < 0 else max(plan.step(place), LEAST_STEP)


def aims(plan: Timeline, now: int) -> list[Aim]:
    """Return the setpoint that is under way at a time in ns, and the next ones."""
    found: list[Aim] = []
    unit = plan.levels[-1].model.units.time * NANOSECONDS
    first = max(plan.under_way(now), 0)
    for place in range(first, min(first + _SETPOINTS, len(plan.segments))):
        segment = plan.segments[place]
        end = plan.segments[place + 1].since if place + 1 < len(plan.segments) else None
        arrival = segment.arrival
        if arrival is None:
            arrival = end if end is not None else plan.levels[-1].stamp
        if found and segment.since - max(found[-1].arrival, now) > _NEAR * unit:
            break
        found.append(Aim(segment.stretch, step_of(plan, place), arrival, end))
    return found


def expected(
        start: PlannedLevel, levels: Sequence[PlannedLevel], wanted: Sequence[Aim],
        lateness: Lateness) -> NDArray[np.float64]:
    """
    Return the predicted error summed over the aims, for each of several scenarios of lateness.

    The error is the peak-to-peak vibration plus twice the distance from the aim, as a fraction of
    the step. The simulation starts in the state of ``start``; ``levels`` follow.
    """
    levels = [x for x in levels if wanted[-1].end is None or x.stamp <= wanted[-1].end]
    span = start.model.time(max(wanted[-1].arrival - start.stamp, 0)) + 1.0
    most = int(min(max(_LONGEST / span, 1.0), _WAYS))
    stamps = np.array([x.due for x in levels], dtype=np.int64)
    return np.array([_left(start, levels, stamps + late, wanted)
                     for late in lateness.scenarios(len(levels), most)])


def _left(
        start: PlannedLevel, levels: Sequence[PlannedLevel], stamps: NDArray[np.int64],
        wanted: Sequence[Aim]) -> float:
    """Return the predicted error if the levels take effect at times in ns."""
    model, begin = start.model, start.stamp
    times = np.maximum.accumulate(np.maximum(stamps, begin)).tolist()
    looks = list(_looks(levels, times, wanted, begin))
    end = max(looks)
    course = [Level(0.0, model.load(start.flux_density)), *(
        Level(model.time(x - begin), model.load(level.flux_density))
        for x, level in zip(times, levels, strict=True) if x < end)]
    # Of levels that take effect simultaneously, only the last one counts.
    course = [one for one, other in pairwise([*course, Level(math.inf, 0.0)])
              if one.time < other.time]
    state = start.at(begin)
    try:
        stretch, rate, *_ = sampled(
            course, state, np.array([model.time(x - begin) for x in looks]), model.material,
            model.delivery)
    except HmsaError:
        return _LOST
    return sum(
        2.0 * math.hypot(x - aim.stretch, v / model.frequency(aim.stretch)) / aim.step
        for x, v, aim in zip(stretch.tolist(), rate.tolist(), wanted, strict=True))


def _looks(
        levels: Sequence[PlannedLevel], times: Sequence[int], wanted: Sequence[Aim],
        begin: int) -> Iterator[int]:
    """Yield times in ns to evaluate: the last level is in force, and the next is not."""
    look = begin
    for aim in wanted:
        own = sum(aim.end is None or x.stamp < aim.end for x in levels)
        look = max(look, aim.arrival, times[own - 1] if own else begin)
        if aim.end is not None:
            look = min(look, times[own] if own < len(times) else max(aim.end, begin))
        yield look


def compared(
        plan: Timeline, start: PlannedLevel, levels: Sequence[PlannedLevel], draft: Draft,
        lateness: Lateness) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the predicted errors of a plan from a start on, and of a draft in its place."""
    first = max(plan.under_way(draft.begin), 0)
    kept = first if draft.resumed is None else draft.resumed + draft.missed
    wanted = []
    for place, aim in enumerate(aims(plan, draft.begin), first):
        # At the later arrival of the two; an aim that the draft leaves out, at its end.
        own = draft.segments[place - kept] if 0 <= place - kept < len(draft.segments) else None
        arrival = own.arrival if own is not None else (
            aim.end if draft.resumed is not None and place >= draft.resumed else None)
        wanted.append(replace(aim, arrival=max(aim.arrival, arrival or aim.arrival)))
    replanned = [*(x for x in levels if x.stamp < draft.begin), *draft.levels]
    # Each setpoint that the draft leaves out, beyond those considered, is missed by a step.
    out = max(len(plan.segments) - first - len(wanted), 0) if draft.resumed is None else 0
    return (
        expected(start, levels, wanted, lateness),
        expected(start, replanned, wanted, lateness) + 2.0 * out)


def better_than_keeping(
        before: NDArray[np.float64], after: NDArray[np.float64], *, news: bool,
        unsure: bool) -> bool:
    """
    Return whether to adopt a draft, given the errors without and with it in each scenario.

    The draft must not increase the error in any scenario, nor by chance in an untested one. If the
    newest command was an exception (``unsure``), a small increase is allowed; if there will be no
    further ``news`` in time either, a much smaller mean error is enough.
    """
    gain = before - after
    mean, harm = float(gain.mean()), float(-gain.min())
    if after.mean() > (max(_LITTLE * before.mean(), _MOST) if unsure else _MOST):
        return False
    if unsure and not news:
        return mean >= max(_GAIN, (1.0 - _CLEARLY) * float(before.mean()))
    if unsure:
        return mean >= _GAIN >= harm - _RISK * mean
    return mean >= _GAIN + _SURE * float(gain.std())
