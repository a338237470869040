"""
What plans are expected to leave, where commands take effect late.

Late commands leave vibration, and so does a new plan whose commands are late again. Both are
simulated with commands to come as late as those before, in several ways that this may happen.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
import math

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.control.lateness import Lateness
from hmsa_ros.errors import HmsaError
from hmsa_ros.model.moves import Level
from hmsa_ros.model.simulation import sampled
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.timeline import Draft, Plan, PlannedLevel

#: A step that is smaller counts as this one.
LEAST_STEP = 0.1
#: Residual vibration from peak to peak, as a share of the step, from which on it counts.
SHARE = 5e-3
# How much less a new plan is to leave, beyond so many deviations over the ways, and how much it
# may leave itself: one that misses by a whole step is left to chance. After an exception: which
# share of what is there it may leave then, which share of the gain it may leave more in one way,
# and which share of what is there, once no more will be known.
_GAIN, _SURE, _MOST, _LITTLE, _RISK, _CLEARLY = 5e-3, 3.0, 1.0, 0.35, 0.2, 0.5
# What stands for a motion that cannot be predicted.
_LOST = 1e3
# Setpoints that are looked at, how far ahead the next one may begin, units of time that may be
# simulated, and ways in which commands may be late.
_SETPOINTS, _NEAR, _LONGEST, _WAYS = 2, 50.0, 2000.0, 16


@dataclass(frozen=True)
class Aim:
    """A setpoint that is to be arrived at; times in ns."""

    stretch: float
    step: float  #: of stretch, at least `LEAST_STEP`
    arrival: int
    end: int | None  #: when the next setpoint begins; None for never


def step_of(plan: Plan, place: int) -> float:
    """Return the step of a setpoint of a plan by its place; small ones count as larger."""
    return LEAST_STEP if place < 0 else max(plan.step(place), LEAST_STEP)


def aims(plan: Plan, now: int) -> list[Aim]:
    """Return the setpoint of a plan that is under way at a time in ns, and the next ones."""
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
    Return how far from rest at its aims an actuator may be, in sum over them, in several ways.

    That is the vibration from peak to peak, and twice the distance, as a share of the step. It
    starts in the state of a level, and the others follow.
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
    """Return what is left where levels take effect at times in ns."""
    model, begin = start.model, start.stamp
    times = np.maximum.accumulate(np.maximum(stamps, begin)).tolist()
    looks = list(_looks(levels, times, wanted, begin))
    end = max(looks)
    course = [Level(0.0, model.load(start.flux_density)), *(
        Level(model.time(x - begin), model.load(level.flux_density))
        for x, level in zip(times, levels, strict=True) if x < end)]
    # Of commands that come at once the last one counts.
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
    """Yield times in ns at which to look: the last level is in force, and the next is not."""
    look = begin
    for aim in wanted:
        own = sum(aim.end is None or x.stamp < aim.end for x in levels)
        look = max(look, aim.arrival, times[own - 1] if own else begin)
        if aim.end is not None:
            look = min(look, times[own] if own < len(times) else max(aim.end, begin))
        yield look


def compared(
        plan: Plan, start: PlannedLevel, levels: Sequence[PlannedLevel], draft: Draft,
        lateness: Lateness) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what a plan leaves from a start on, by `expected`, and what a draft in its place."""
    first = max(plan.under_way(draft.begin), 0)
    kept = first if draft.resumed is None else draft.resumed + draft.missed
    wanted = []
    for place, aim in enumerate(aims(plan, draft.begin), first):
        # As late as the later of the two arrives; what a draft leaves, at its end.
        own = draft.segments[place - kept] if 0 <= place - kept < len(draft.segments) else None
        arrival = own.arrival if own is not None else (
            aim.end if draft.resumed is not None and place >= draft.resumed else None)
        wanted.append(replace(aim, arrival=max(aim.arrival, arrival or aim.arrival)))
    anew = [*(x for x in levels if x.stamp < draft.begin), *draft.levels]
    # What a draft leaves out, beyond what is looked at, is missed by a step each.
    out = max(len(plan.segments) - first - len(wanted), 0) if draft.resumed is None else 0
    return (
        expected(start, levels, wanted, lateness),
        expected(start, anew, wanted, lateness) + 2.0 * out)


def worthwhile(
        before: NDArray[np.float64], after: NDArray[np.float64], *, news: bool,
        unsure: bool) -> bool:
    """
    Return whether to take a draft, by what is left without it and with it in several ways.

    It must do no harm in any way, or by chance in one that was not tried. Where the newest command
    was an exception (``unsure``), a little is allowed; once there will be no ``news`` in time, it
    is enough that much less is left.
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
