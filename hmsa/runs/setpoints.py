"""
Setpoints of a run as requested, with their results after replanning.

Requests contain setpoints and their times, statuses show which requests were accepted, and plans
contain the arrivals. Without plans, arrivals follow from levels; without requests, each level that
lasts for at least a period of the actuator gives a setpoint.
"""

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from hmsa.judge.records import RequestedSetpoint
from hmsa.model.equations import Array, equilibrium_stretch, natural_frequency, stretch_limits
from hmsa.model.law import critical_zeta
from hmsa.model.units import NANOSECONDS
from hmsa.runs.levels import (
    in_force,
    RecordedLevel,
    ROUNDED,
    ROUNDED_STAMP,
    without_repeats,
)
from hmsa.runs.record import RecordedRequest, Run
from hmsa.runs.topics import COMMAND

#: Smaller differences of stretch do not change a setpoint.
SAME = 1e-6
# Tolerances for rest, to the precision of a planner, and of creep tails: relative to the step, and
# to the step per radian of vibration.
_AT_REST = ((0.0, 1e-3), (2e-3, 1e-2))
# Flux density in T that counts as zero.
_NO_FIELD = 1e-9
# Codes of plans that were replaced because of a deviation; feedback replaces others.
_NEEDED = {'replanned', 'saturated'}


@dataclass(frozen=True)
class Requested:
    """A setpoint as it was requested, with its result."""

    setpoint: RequestedSetpoint
    due: int | None  #: requested end in ns; None if it was to be held on
    last: bool = False  #: whether it is held after the end of the sequence
    #: Recording times of changed plans, and their arrivals, in ns; None if it was skipped.
    moves: tuple[tuple[int, int | None], ...] = ()
    corrected: bool = False  #: whether the plan was changed by feedback, not due to a deviation
    left_out: bool = False  #: whether the levels skip it
    until: int | None = None  #: start of the request that replaced it, in ns, if any

    @property
    def missed(self) -> bool:
        """Whether it was finally skipped."""
        return self.left_out or bool(self.moves) and self.moves[-1][1] is None

    @property
    def arrival(self) -> int | None:
        """Planned rest at the target in ns; None if only approached."""
        return self.moves[-1][1] if self.moves else self.setpoint.arrival


@dataclass(frozen=True)
class _Act:
    """An accepted request, or a stop (None); its recording time and its start, in ns."""

    request: RecordedRequest | None
    sent: int
    begin: int


def setpoints_of(run: Run) -> list[Requested]:
    """Return the setpoints that were requested in a run, or else those held by its levels."""
    levels = in_force((x,) for x in without_repeats(run.commands)[0])
    acts = _acts(run, levels)
    found: list[Requested] = []
    previous = start_of(run, acts[0].begin if acts else int(run.time[0]))
    for i, act in enumerate(acts):
        after = acts[i + 1] if i + 1 < len(acts) else None
        mine = [] if act.request is None else list(
            _of(run, act, act.request, after, levels, previous))
        # A setpoint that another request replaced before arrival was not missed.
        found += mine if after is None else [
            replace(x, until=after.begin) for x in mine
            if (x.setpoint.begins if x.arrival is None else x.arrival) < after.begin]
        if mine:
            previous = mine[-1].setpoint.target
    return found if any(x.points for x in run.requests) else _held(run, levels)


# -- requests -----------------------------------------------------------------------------------

def _acts(run: Run, levels: Sequence[RecordedLevel]) -> list[_Act]:
    """Return the changes of the plan, by time."""
    acts = [_Act(x, x.sent, _begin(run, x, levels)) for x in run.requests
            if x.taken and all(math.isfinite(y) for y, _ in x.points)]
    acts += (_Act(None, x, _new(run, _plan_at(run, x)) or x) for x in run.stops)
    return sorted(acts, key=lambda x: x.sent)


def _begin(run: Run, request: RecordedRequest, levels: Sequence[RecordedLevel]) -> int:
    """Return the start of a request's execution in ns."""
    later = [x for x in levels if x.sent >= request.sent]
    place = next((i for i, x in enumerate(run.plans) if x and x[0].sent >= request.sent), None)
    by_plan = () if place is None else (_under_way(run, place, later), _new(run, place))
    known = (*by_plan, *(x.stamp for x in later[:1]))
    return next((x for x in known if x is not None), request.stamp or request.sent + round(
        run.number('planner.lead_time') * NANOSECONDS))


def _under_way(run: Run, place: int, levels: Sequence[RecordedLevel]) -> int | None:
    """
    Return the time of the first level sent for a plan, if the plan starts with one already sent.

    Such a plan contains only what remains of its motion; None for other plans. ``levels`` are
    those sent since the request.
    """
    plan = run.plans[place]
    old = {(x.stamp, x.flux_density) for x in (run.plans[place - 1] if place else ())}
    new = [x for x in levels if (x.stamp, x.flux_density) not in old]
    # A new controller first sends the present level.
    if new and _in_force(run, new[0]):
        del new[0]
    # A late level takes effect after its time.
    return new[0].stamp if any(
        x.stamp <= plan[0].stamp + ROUNDED_STAMP and math.isclose(
            x.flux_density, plan[0].flux_density, rel_tol=ROUNDED, abs_tol=_NO_FIELD)
        for x in new) else None


def _in_force(run: Run, level: RecordedLevel) -> bool:
    """Return whether a level equals, up to rounding, the last field measured before its time."""
    place = int(np.searchsorted(run.time, level.stamp)) - 1
    return place >= 0 and math.isclose(
        level.flux_density, run.flux_density[place], rel_tol=ROUNDED, abs_tol=_NO_FIELD)


def _plan_at(run: Run, sent: int) -> int | None:
    """Return the index of the newest plan at a recording time."""
    return max((i for i, x in enumerate(run.plans) if x and x[0].sent <= sent), default=None)


def _new(run: Run, place: int | None) -> int | None:
    """Return the first timestamp of a plan that is not in the previous one."""
    if place is None:
        return None
    plan, before = run.plans[place], run.plans[place - 1] if place else ()
    if not before and len(plan) > 1 and (
            plan[0].stamp < plan[0].sent or _uncommanded(run, plan[0])) and (
            abs(float(balance(run, plan[:1])[0]) - plan[0].stretch) <= ROUNDED
            or _in_force(run, plan[0])):
        # The level was already applied, and holds the initial stretch.
        plan = plan[1:]
    fresh = _fresh(plan, before)
    return None if fresh == math.inf else int(fresh)


def _uncommanded(run: Run, level: RecordedLevel) -> bool:
    """Return whether no command has a level's timestamp: simulated time of a recorder lags."""
    return bool(run.commands) and all(x.stamp != level.stamp for x in run.commands)


def _begun(plan: Sequence[RecordedLevel], before: Sequence[RecordedLevel]) -> bool:
    """Return whether the first level was already applied, perhaps not at its planned time."""
    return bool(before) and plan[0].stamp < plan[0].sent


def _fresh(
        plan: Sequence[RecordedLevel], before: Sequence[RecordedLevel],
        sent: Container[int] | None = None) -> float:
    """
    Return the time from which a plan differs from the previous one; infinite if it continues it.

    ``sent`` are the timestamps of commands, if known: levels of the previous plan that were never
    sent count as missing from the new one.
    """
    if not plan:
        return math.inf
    begun = _begun(plan, before)
    new = {(x.stamp, x.flux_density) for x in plan[begun:]}
    # The present level took effect at the time reported, perhaps slightly before its timestamp.
    old = {(x.stamp, x.flux_density) for x in before if plan[0].stamp < x.stamp and not (
        begun and x.stamp <= plan[0].sent
        and math.isclose(x.flux_density, plan[0].flux_density, rel_tol=ROUNDED))}
    if begun and sent is not None:
        old |= {(x.stamp, x.flux_density) for x in before[1:] if x.stamp not in sent}
    return min((stamp for stamp, level in new ^ old if (stamp, level) in new
                or stamp <= plan[-1].stamp), default=math.inf)


def start_of(run: Run, stamp: int) -> float:
    """Return the stretch before a time: planned if known, else measured."""
    planned = next((x.stretch for x in in_force(run.plans) if x.stamp == stamp), None)
    if planned is not None:
        return planned
    return float(run.stretch[max(int(np.searchsorted(run.time, stamp, side='right')) - 1, 0)])


# -- setpoints ----------------------------------------------------------------------------------

def _of(
        run: Run, act: _Act, request: RecordedRequest, after: _Act | None,
        levels: Sequence[RecordedLevel], start: float) -> Iterator[Requested]:
    """Yield the setpoints of a request."""
    base = request.stamp or act.begin
    points = [(x, None if y is None else base + y) for x, y in request.points]
    points = [(x, y) for x, y in points if y is None or y > act.begin]
    until = math.inf if after is None else after.sent
    plans = [x for x in run.plans if x and act.sent <= x[0].sent < until]
    codes = [x.code for x in run.verdicts if act.sent <= x.sent < until]
    sent = {x.stamp for x in run.commands} or None
    earliest = begin = act.begin
    start = next((x.stretch for plan in plans for x in plan if x.stamp == begin), start)
    for number, (target, end) in enumerate(points, 1):
        last = number == len(points)
        setpoint = _described(run, target, start, begin, end)
        setpoint = replace(setpoint, number=number, count=len(points))
        here = replace(setpoint, end=None) if last else setpoint
        arrival: int | None
        if request.path is not None:
            arrival, moves, left_out = base + request.path, [], False
        elif plans:
            moves = list(_arrivals(run, plans, sent, here, earliest, last=last))
            arrival, left_out = moves.pop(0)[1] if moves else None, False
        else:
            arrival, moves = _by_levels(run, levels, here), []
            # Without recorded commands only requests and samples are known.
            left_out = setpoint.step > SAME and COMMAND in run.topics and not _within(
                levels, here)
        yield Requested(
            replace(setpoint, arrival=arrival), end, last, tuple(moves),
            bool(codes) and _NEEDED.isdisjoint(codes), left_out)
        earliest, begin, start = begin, end or begin, target


def _described(
        run: Run, target: float, start: float, begins: int, end: int | None) -> RequestedSetpoint:
    """Return a setpoint with frequency, decay and range from the planner's model."""
    material, unit = run.planner.nondimensional, run.planner.time_unit
    low, high = stretch_limits(material)
    inside = min(max(target, low + SAME), high - SAME)
    omega = float(natural_frequency(inside, material)) / unit
    decay = material.zeta / critical_zeta(inside, material.packed) * omega
    return RequestedSetpoint(target, start, begins, None, end, omega, decay, possible=(low, high))


def _within(levels: Sequence[RecordedLevel], setpoint: RequestedSetpoint) -> list[RecordedLevel]:
    """Return the changes of level during a setpoint."""
    end = math.inf if setpoint.end is None else setpoint.end
    return [x for x in levels if setpoint.begins <= x.stamp < end]


def _arrivals(
        run: Run, plans: Sequence[Sequence[RecordedLevel]], sent: Container[int] | None,
        setpoint: RequestedSetpoint, earliest: int, *,
        last: bool) -> Iterator[tuple[int, int | None]]:
    """Yield the recording times of plans that change a setpoint, and the arrival of each."""
    before: Sequence[RecordedLevel] = ()
    arrival = None
    rests: set[int] = set()  # timestamps of the final levels in any plan
    for plan in plans:
        fresh, begun = _fresh(plan, before, sent), _begun(plan, before)
        goes_on = before and fresh > before[-1].stamp and not last
        before = plan
        if fresh == math.inf or arrival and goes_on or (
                setpoint.end is not None and fresh >= setpoint.end):
            continue
        new = [x for x in plan[begun:] if x.stamp >= fresh]
        if begun and not _within(new, setpoint) and _rest(run, plan[:1], setpoint) is not None:
            # The actuator rests at the setpoint, and no level changes that.
            continue
        if setpoint.end is not None and plan[0].stamp >= setpoint.end and any(
                x in (sent or ()) for x in rests):
            # The setpoint was carried out, and is over.
            continue
        found = _rest(run, new, setpoint)
        if found is None and arrival is not None:
            # A skipped setpoint leaves its time to the next one.
            found = _rest(run, new, replace(setpoint, begins=earliest))
        if found is not None:
            rests.add(max((x.stamp for x in plan if x.stamp <= found), default=found))
        if found is not None or arrival is not None:
            yield plan[0].sent, found
        arrival = found if found is not None else arrival


def _rest(run: Run, plan: Sequence[RecordedLevel], setpoint: RequestedSetpoint) -> int | None:
    """Return the time at which a plan rests at a setpoint; None if it does not."""
    for share, slow in _AT_REST:
        for level in _within(plan, setpoint):
            if abs(level.stretch - setpoint.target) <= SAME + share * setpoint.step and (
                    abs(level.rate) <= slow * setpoint.frequency * setpoint.step):
                return level.stamp + _ramp(run, plan, level)
    # Some shapers leave a vibration.
    return _by_levels(run, plan, setpoint)


def _ramp(run: Run, levels: Sequence[RecordedLevel], level: RecordedLevel) -> int:
    """Return the duration in ns of the amplifier's ramp to a level."""
    slew = run.number('plant.slew_limit') or run.number('planner.slew_limit')
    before = max((x for x in levels if x.stamp < level.stamp), key=lambda x: x.stamp, default=None)
    if not slew or before is None:
        return 0
    # A bag may contain any slew limit: bound the result.
    return round(min(abs(level.flux_density - before.flux_density) / slew, 1e6) * NANOSECONDS)


def _by_levels(
        run: Run, levels: Sequence[RecordedLevel], setpoint: RequestedSetpoint) -> int | None:
    """Return the start of the level that holds a setpoint; None if a single step leads to it."""
    inside = _within(levels, setpoint)
    if setpoint.step <= SAME:
        return setpoint.begins
    near = ROUNDED * max(setpoint.step, abs(setpoint.target - run.planner.rest))
    held = None
    for level, stretch in zip(inside[:0:-1], balance(run, inside)[:0:-1].tolist(), strict=True):
        if abs(stretch - setpoint.target) > near:
            break
        held = level
    return None if held is None else held.stamp + _ramp(run, levels, held)


def balance(run: Run, levels: Sequence[RecordedLevel]) -> Array:
    """Return the equilibrium stretches of levels with the planner's parameters."""
    return equilibrium_stretch(
        [run.planner.units.of_level(x.flux_density) for x in levels],
        run.planner.nondimensional)


def _held(run: Run, levels: Sequence[RecordedLevel]) -> list[Requested]:
    """Return setpoints of a run without requests: levels that are held for a period."""
    held = balance(run, levels)
    found: list[Requested] = []
    begin, start = 0, start_of(run, levels[0].stamp if levels else 0)
    for i, (level, target) in enumerate(zip(levels, held.tolist(), strict=True)):
        until = levels[i + 1].stamp if i + 1 < len(levels) else int(run.time[-1])
        setpoint = _described(run, target, start, levels[begin].stamp, until)
        if not (until - level.stamp) / NANOSECONDS * setpoint.frequency >= 2.0 * math.pi:
            continue
        if setpoint.step > SAME:
            found.append(Requested(replace(
                setpoint, arrival=None if i == begin else level.stamp
                + _ramp(run, levels, level)), until))
            start = target
        begin = i + 1
    return [replace(
        x, last=i == len(found), setpoint=replace(x.setpoint, number=i, count=len(found)))
        for i, x in enumerate(found, 1)]
