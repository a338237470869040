"""
Drafts: requests planned without changing the running plan.

Each function calls ``check`` after a bounded amount of work, which abandons the draft by raising.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
import math
from typing import Any

import numpy as np

from hmsa import motion
from hmsa.errors import BadInputError
from hmsa.model.equations import equilibrium_stretch
from hmsa.model.moves import check_target, Level, Move, Setpoint, State
from hmsa.model.simulation import RTOL
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa.planning import Check, proceed
from hmsa.planning.history import agree
from hmsa.planning.path import along, ON_PATH, Path
from hmsa.planning.sequence import Segment, segments
from hmsa.planning.shapers import SHAPERS
from hmsa.planning.shapers.request import MoveRequest, Shaper
from hmsa.planning.shapers.shooting import through
from hmsa.planning.timeline import (
    Draft,
    JointModel,
    PlannedLevel,
    PlannedSegment,
    Timeline,
    Warmth,
)

#: Stretch, rate in 1/s and acceleration in 1/s^2; the acceleration is NaN if not given.
PathPoint = tuple[float, float, float]

# Fractions of the hardest braking to try, in this order, if that leads to no plan.
_BRAKE_SHARES = (0.5, 0.1, 0.02, 0.0)
# Natural periods by which to delay further attempts if resuming at once is impossible.
_PATIENCE = (0.15, 0.3, 0.45, 0.6)
# Deviation of the field from the holding load that counts as settled, as a fraction of the load.
_SETTLED = 1e-6
# Rates up to this, in 1/s, count as rest at the end of a path.
_STOPPED = 1e-7
# Duration of the return to a path, in natural periods; in a longer one, vibration swings farther
# than without correction.
_BACK = 0.4
# Minimum tolerance of a corrected path, as a fraction of its range.
_ANEW = 1e-4
# Setpoints between two checks, in about 0.1 ms; levels take longer.
_CHECKED = 200
# Stretch rates below this fraction of the natural frequency are rounding errors.
_AT_REST = 1e-6
# Newton iterations for the braking load, and the tolerance of its duration, relative.
_PASSES = 8
_ON_TIME = 1e-14
# Margin of a stop from the flux density limits, relative.
_INSIDE = 1e-3


@dataclass(frozen=True)
class Brake:
    """A braking load and the stretch at which it stops a motion, its turning point."""

    load: float
    duration: float  #: time to the turning point; 0 if already at rest
    stretch: float


def brake(model: JointModel, state: State, share: float = 1.0) -> Brake:
    """Return the load that stops a motion, and its duration; a share of 1 brakes hardest."""
    # The share interpolates between the load that holds the stretch and the opposite limit. The
    # duration is also 0 if the motion cannot be followed to a turning point.
    holding = model.holding(state.stretch)
    rest = Brake(holding, 0.0, state.stretch)
    frequency = model.frequency(state.stretch)
    if abs(state.rate) <= _AT_REST * frequency:
        return rest
    up = state.rate > 0.0
    load = model.limits.minimum if up else model.limits.maximum
    if not math.isfinite(load):
        # Without limits, use a load that stops the motion within a fraction of a period.
        load = holding - math.copysign(10.0 * abs(state.rate) * frequency + 10.0, state.rate)
    if share < 1.0:
        load = holding + share * (load - holding)
    direction = 1.0 if up else -1.0

    def turn(load: float) -> tuple[float, float, float] | None:
        status, time, stretch, _, slope = motion.turning_point(
            state.stretch, state.rate, direction, load, 1.0, model.material.packed, RTOL)
        return (time, stretch, slope) if status == motion.DONE else None

    found = turn(load)
    if found is None:
        return rest
    # Commands have whole nanoseconds. The load is solved for the next one, so that the motion is
    # then at rest to rounding: at full load, half a nanosecond leaves more than a move does.
    aim = math.ceil(found[0] / model.delivery.resolution) * model.delivery.resolution
    for _ in range(_PASSES):
        time, stretch, slope = found
        if slope == 0.0 or abs(aim - time) <= _ON_TIME * aim:
            break
        found = turn(load + (aim - time) / slope)
        if found is None:
            break
        load += (aim - time) / slope
    return Brake(float(load), aim, stretch)


def holdable(model: JointModel, stretch: float) -> float:
    """Return the nearest stretch that a flux density within the limits holds."""
    load = model.holding(stretch)
    least, most = model.limits.minimum, model.limits.maximum
    if least <= load <= most:
        return stretch
    nearest = least if load < least else most
    margin = _INSIDE * min(most - least, 1.0 + abs(nearest))
    return float(equilibrium_stretch(
        nearest + math.copysign(margin, nearest - load), model.material))


@dataclass(frozen=True)
class PlanStart:
    """Start of a draft: a state predicted at a time in ns."""

    plan: Timeline
    model: JointModel
    begin: int  #: earliest time in ns
    state: State
    #: Index of the first level of the plan whose prediction is no longer valid.
    stale: int | None = None
    check: Check = field(default=proceed, compare=False)
    #: Temperature at the beginning; None if it changes nothing.
    warmth: Warmth | None = None


def check_points(
        points: Sequence[tuple[float, int]], rest: float, check: Check) -> None:
    """Check points (stretch, end in ns from the start); raise `RefusedError` if invalid."""
    for begin in range(0, max(len(points), 1), _CHECKED):
        part = points[begin:begin + _CHECKED]
        for stretch, _ in part:
            check_target(stretch, rest)
        check_times(part, 'point', begin, points[begin - 1][1] if begin else -1)
        check()


def check_times(
        points: Sequence[tuple[Any, int]], name: str, first: int = 0, previous: int = -1) -> None:
    """Raise `RefusedError` if there are no points, or times in ns do not increase."""
    if not points:
        raise RefusedError(
            Code.BAD_INPUT, 'the trajectory has no points: expected at least one')
    for number, (_, time) in enumerate(points, first):
        if time <= previous:
            raise RefusedError(
                Code.NOT_INCREASING,
                f'time_from_start of {name} {number} is {time / NANOSECONDS:g} s'
                + (f' after {previous / NANOSECONDS:g} s: expected strictly increasing '
                   'times' if number else ': expected at least 0 s'))
        previous = time


def draft_sequence(
        start: PlanStart, points: Sequence[tuple[float, int]], base: int,
        now: int) -> Draft | None:
    """
    Draft checked points (stretch, end in ns) from a start in ns; None if they change nothing.

    Raise `RefusedError` if the sequence cannot be carried out.
    """
    begin = start.begin
    if points[0][1] == 0 and len(points) > 1 and base == begin:
        # A first point at time 0 that repeats the planned position is ignored.
        here = start.plan.level(begin).at(begin).stretch
        if abs(points[0][0] - here) > 1e-6:
            raise RefusedError(
                Code.SPELL_TOO_SHORT,
                f'the first point asks for {start.model.units.coordinate} {points[0][0]:g} at '
                f'time_from_start 0, the actuator is at {here:.6g}: expected enough time for the '
                'move')
    if base + points[-1][1] <= begin:
        raise _over(points, base, now, start.model.units.coordinate)
    setpoints = []
    left = begin
    for number, (stretch, time) in enumerate(points):
        if base + time > begin:
            end = start.model.on_grid(base + time)
            if end == left:
                raise RefusedError(
                    Code.SPELL_TOO_SHORT,
                    f'{start.model.units.coordinate} {stretch:g} begins and ends within one '
                    f'command period of {start.model.options.period / NANOSECONDS:g} s: expected '
                    'a longer duration')
            setpoints.append(Setpoint(stretch, start.model.time(end - left)))
            left = end
        if number % _CHECKED == _CHECKED - 1:
            start.check()
    if len(setpoints) == 1 and start.plan.ends_at(setpoints[0].stretch, begin):
        return None
    return draft_moves(start, setpoints)


def check_path(points: Sequence[tuple[PathPoint, int]], rest: float) -> None:
    """Raise `RefusedError` if points, with times in ns, are no path that ends at rest."""
    check_times(points, 'point')
    given = math.isnan(points[0][0][2])
    for number, ((stretch, *more), _) in enumerate(points):
        check_target(stretch, rest)
        # Either all points have an acceleration, or none has.
        if not (math.isfinite(more[0]) and math.isnan(more[1]) is given
                and not math.isinf(more[1])):
            raise RefusedError(
                Code.BAD_INPUT,
                f'point {number} has velocity {more[0]:g} and acceleration {more[1]:g}: expected '
                'finite velocities, and accelerations in all points or in none')
    if abs(points[-1][0][1]) > _STOPPED:
        raise RefusedError(
            Code.BAD_INPUT,
            f'the last point has velocity {points[-1][0][1]:g}: expected 0, a path ends at rest')


def draft_path(
        start: PlanStart, points: Sequence[tuple[PathPoint, int]], base: int,
        now: int) -> Draft:
    """
    Draft a checked path from a start in ns, or join it if it has begun.

    An actuator that is not on the path moves to its first point, or to the first point that is at
    least a natural period ahead. Raise `RefusedError` if the path cannot be followed.
    """
    model, state, unit = start.model, start.state, start.model.units.time
    ended, last = points[-1]
    if base + last <= start.begin:
        raise _over([(ended[0], last)], base, now, model.units.coordinate)
    times = np.array([model.time(base + x - start.begin) for _, x in points])
    rows = np.array([x for x, _ in points]).T * np.array([[1.0], [unit], [unit * unit]])
    given = None if np.isnan(rows[2, 0]) else rows[2]
    path = None
    if times[0] <= 0.0 and len(times) > 1:
        path = Path.through(times, rows[0], rows[1], given).since(0.0)
        stretch, rate, _ = (float(x[0]) for x in path.course(np.zeros(1)))
        frequency = model.frequency(state.stretch)
        if abs(state.stretch - stretch) > ON_PATH or abs(
                state.rate - rate) > ON_PATH * frequency:
            path = None
    if path is None:
        soon = 0.0 if times[0] > 0.0 else min(
            2.0 * math.pi / model.frequency(rows[0, -1]), float(times[-1]) * (1.0 - 1e-9))
        ahead = times > soon
        here = np.array([state.stretch, state.rate, model.acceleration(state)])
        times = np.append(0.0, times[ahead])
        rows = np.column_stack([here, rows[:, ahead]])
        path = Path.through(times, rows[0], rows[1], None if given is None else rows[2])
    start.check()
    return _along(
        start, path, float(rows[0, -1]), model.options.path_tolerance,
        path=path.scaled(1.0 / unit))


def draft_path_anew(start: PlanStart) -> Draft:
    """
    Draft the rest of the running path again, with a return to it within half a natural period.

    Raise `RefusedError` if the path cannot be followed.
    """
    model, state, place = start.model, start.state, start.plan.under_way(start.begin)
    segment = start.plan.segments[place]
    if segment.path is None:
        raise ValueError('the setpoint under way is no path')
    left = segment.path.scaled(model.units.time).since(model.time(start.begin - segment.since))
    span = min(_BACK * 2.0 * math.pi / model.frequency(segment.stretch), float(left.breaks[-1]))
    return replace((_along(
        start, left.joined(state.stretch, state.rate, span), segment.stretch,
        max(model.options.path_tolerance, _ANEW), since=segment.since, path=segment.path)),
        resumed=place)


def _along(
        start: PlanStart, wanted: Path, target: float, tolerance: float,
        **known: Any) -> Draft:
    """Follow a path to rest at a target; further fields of its segment are given."""
    move = along(
        replace(_frame(start.model, start.state), target=target), wanted, tolerance,
        start.check)
    draft = draft_moves(
        start, [Setpoint(target, math.inf)], first=lambda request: move)
    return replace(draft, segments=(replace(draft.segments[0], **known),))


def draft_stop(start: PlanStart) -> Draft:
    """Draft a stop: rest as near as the flux density limits allow."""
    # A two-step command with the hardest braking load as beta_p: that load up to the first turning
    # point, then the load that holds this point. If a single brake is impossible (on a command
    # grid, with ramps or at a limit), plan a move to a stretch near by.
    model, state = start.model, start.state
    found = brake(model, state)
    # A coil that must not step brakes as the shaper smooth does, from the turning point on, and a
    # block with modes as modal does.
    own = model.options.shaper if model.options.shaper == 'smooth' or (
        model.options.shaper == 'modal' and model.material.modes.ratios) else ''
    if (not own and holdable(model, found.stretch) == found.stretch
            and not model.material.creeps
            and (model.delivery.ideal or found.duration == 0.0 and _settled(model, state))):
        move = Move(Code.HOLD, tuple(
            [Level(0.0, found.load)] * (found.duration > 0.0)
            + [Level(found.duration, model.holding(found.stretch))]),
            found.duration, 'stopped')
        end = State(found.stretch, 0.0, move.levels[-1].load)
        levels, placed = _placed(model, start.begin, start.check, Segment(
            Setpoint(found.stretch, math.inf), 0.0, state, end, move, end.load))
        return Draft(start.begin, tuple(levels), (placed,))
    ways = [(0.0, own)] * bool(own) + [(x, 'two_step') for x in _BRAKE_SHARES]
    for share, shaper in ways:
        stretch = holdable(model, brake(model, state, share).stretch)
        try:
            return draft_moves(start, [Setpoint(stretch, math.inf)], shaper)
        except BadInputError:
            start.check()
    # No command stops the motion at once: let it settle.
    return draft_moves(
        start, [Setpoint(holdable(model, state.stretch), math.inf)], 'step')


def _settled(model: JointModel, state: State) -> bool:
    """Return whether the field of a lagging coil already holds the stretch."""
    return model.delivery.lag == 0.0 or math.isclose(
        state.load, model.holding(state.stretch), rel_tol=_SETTLED, abs_tol=_SETTLED)


def later_starts(model: JointModel, stretch: float, begin: int) -> Iterator[int]:
    """Yield later times in ns at which to try in turn; ``stretch`` is that at the first time."""
    period = 2.0 * math.pi / model.frequency(stretch)
    for share in _PATIENCE:
        yield model.on_grid(begin + model.ns(share * period))


def draft_resumption(start: PlanStart, arrival: int | None = None) -> Draft | None:
    """
    Draft the rest of the running plan again, up to where both agree; None if nothing is left.

    The current setpoint is reached at ``arrival`` in ns, or as soon as its shaper can. Raise
    `RefusedError` if the rest cannot be carried out.
    """
    # Setpoints end when planned before; one without time left is skipped. Where the new plan meets
    # the running one, the running one continues.
    planned = start.plan.segments
    begun = max(start.plan.under_way(start.begin), 0)
    first = None if arrival is None else partial(
        through, duration=start.model.time(arrival - start.begin))
    refusal: RefusedError | None = None
    for index in range(begun, len(planned)):
        # A skipped setpoint leaves its time to the next one, to which the move starts at once.
        try:
            draft = draft_moves(
                start, _left(start, index), first=first, index=index)
        except RefusedError as error:
            refusal = refusal or error
            if error.code is not Code.SPELL_TOO_SHORT or arrival is not None:
                break
            start.check()
            continue
        anew = replace(
            draft.segments[0], since=min(planned[index].since, draft.segments[0].since))
        return replace(
            draft, segments=(anew, *draft.segments[1:]), resumed=begun, missed=index - begun)
    if refusal is not None:
        raise refusal
    return None


def draft_later(start: PlanStart, index: int) -> Draft:
    """
    Draft the setpoints of the running plan from an index on again, from the start of the first.

    Raise `RefusedError` if they cannot be carried out.
    """
    return replace(draft_moves(start, _left(start, index), index=index), resumed=index)


def _left(start: PlanStart, index: int) -> Iterator[Setpoint]:
    """Yield the setpoints of the running plan from an index on, with their remaining durations."""
    planned = start.plan.segments
    left = start.begin
    for place in range(index, len(planned) - 1):
        end = planned[place + 1].since
        yield Setpoint(planned[place].stretch, start.model.time(end - left))
        left = end
    yield Setpoint(planned[-1].stretch, math.inf)


def _meeting(start: PlanStart, state: State, following: int) -> int | None:
    """Return the index of the level at which the running plan continues a state, else None."""
    planned = start.plan.segments[following]
    place = start.plan.place(planned.begin)
    level = start.plan.levels[place]
    if (level.stamp != planned.begin or level.model is not start.model
            or start.stale is not None and place < start.stale):
        return None
    here = PlannedLevel(level.stamp, level.flux_density, state, level.model)
    return place if agree(here, level) else None


def draft_moves(
        start: PlanStart, setpoints: Iterable[Setpoint], shaper: str = '',
        first: Shaper | None = None, index: int | None = None) -> Draft:
    """
    Draft setpoints on the timeline; the default shaper is that of the options.

    With ``index``, they are those of the running plan from there on, which continues once met.
    """
    if start.warmth is not None:
        return _warming(
            start, start.warmth, setpoints, SHAPERS[shaper or start.model.options.shaper],
            first)
    model, planned = start.model, start.plan.segments
    levels: list[PlannedLevel] = []
    placed: list[PlannedSegment] = []
    for segment in segments(
            _frame(model, start.state), setpoints, SHAPERS[shaper or model.options.shaper],
            model.options.short_spell, first=first):
        if placed:
            start.check()
        more, one = _placed(model, start.begin, start.check, segment)
        levels += more
        placed.append(one)
        following = len(planned) if index is None else index + len(placed)
        place = _meeting(start, segment.end, following) if following < len(planned) else None
        if place is not None:
            levels += start.plan.levels[place:]
            placed += planned[following:]
            break
    return Draft(start.begin, tuple(levels), tuple(placed))


def draft_warmed(start: PlanStart, index: int, held: PlannedSegment | None = None) -> Draft:
    """
    Draft the setpoints of the running plan from an index on again, for a temperature.

    The first may be ``held``: it stays, and only the levels that hold it are new. Raise
    `RefusedError` if the others cannot be carried out.
    """
    if start.warmth is None:
        raise ValueError('the temperature changes nothing')
    return replace(_warming(
        start, start.warmth, _left(start, index), SHAPERS[start.model.options.shaper],
        held=held), resumed=index)


def _warming(
        start: PlanStart, warmth: Warmth, setpoints: Iterable[Setpoint], shaper: Shaper,
        first: Shaper | None = None, held: PlannedSegment | None = None) -> Draft:
    """Draft setpoints, each for the temperature foreseen at its begin, with levels that follow."""
    # Times count from the start in its units, so that rounding does not add up.
    model, begin, time = start.model, start.begin, 0.0
    state, now = start.state, warmth
    levels: list[PlannedLevel] = []
    placed: list[PlannedSegment] = []
    upcoming = iter(setpoints)
    setpoint = next(upcoming, None)
    while setpoint is not None:
        following = next(upcoming, None)
        time += setpoint.span
        end = math.inf if math.isinf(time) else start.begin + start.model.ns(time)
        if placed:
            start.check()
            now = now.along(levels[-1:], begin)
            before, model = model, now.model(model)
            state = model.held(
                model.taken_from(state, before), before, levels[-1].flux_density)
        if held is not None and not placed:
            more, one = [_held(model, begin, held.stretch, state)], held
        else:
            span = math.inf if math.isinf(end) else model.time(int(end) - begin)
            segment = next(segments(
                _frame(model, state), [Setpoint(setpoint.stretch, span)] + (
                    [] if following is None else [Setpoint(setpoint.stretch, math.inf)]),
                shaper, model.options.short_spell, first=None if placed else first))
            more, one = _placed(model, begin, start.check, segment)
            state = segment.end
        now = now.along([levels[-1], *more] if levels else more, more[-1].stamp)
        if one.arrival is not None and not model.material.creeps:
            # A level of a lagging coil takes effect later, and hardly changes anything.
            now = now.after(more[-1].flux_density, one.arrival)
            for number, changed in enumerate(now.changes(more[-1].flux_density, end)):
                before, model, now = model, changed.model(), changed
                state = model.held(
                    _rest(model, one.stretch, more[-1].flux_density, state), before,
                    more[-1].flux_density)
                more.append(_held(model, now.time or 0, one.stretch, state))
                if number % _CHECKED == _CHECKED - 1:
                    start.check()
        levels += more
        placed.append(one)
        begin, setpoint = int(end) if following is not None else begin, following
    return Draft(start.begin, tuple(levels), tuple(placed))


def _held(model: JointModel, time: int, stretch: float, state: State) -> PlannedLevel:
    """Return the level that holds a stretch from a time in ns on, set in a state."""
    load = model.holding(stretch)
    model.limits.check(load, stretch, model.units)
    return PlannedLevel(time, model.flux_density(load), state, model)


def _rest(model: JointModel, stretch: float, flux_density: float, state: State) -> State:
    """Return rest at a stretch under a level in T; ``state`` has the same modes and coil."""
    load = model.load(flux_density)
    return State(
        stretch, 0.0, load, None if state.amplifier is None else load,
        (stretch, 0.0) * len(model.material.modes.ratios))


def _frame(model: JointModel, state: State) -> MoveRequest:
    """Return the request to stay in a state."""
    options = model.options
    return MoveRequest(
        state, state.stretch, model.material, model.limits, model.delivery, options.order,
        model.units, options.errors, model.pace)


def _placed(
        model: JointModel, begin: int, check: Check,
        segment: Segment) -> tuple[list[PlannedLevel], PlannedSegment]:
    """Place a planned move on the timeline, in SI units."""
    start = begin + model.ns(segment.begin)
    state = segment.start
    if math.isnan(state.load):
        raise ValueError('a segment on the timeline must contain its initial load')
    levels = []
    time = 0.0
    known = len(segment.move.levels) - len(segment.move.tail)
    for number, level in enumerate(segment.move.levels):
        if number >= known:
            state = segment.move.tail[number - known]
        elif number:
            state = model.follow(state, segment.move.levels[number - 1].load, level.time - time)
        time = level.time
        levels.append(PlannedLevel(
            start + model.ns(time), model.flux_density(level.load), state, model))
        if number % _CHECKED == _CHECKED - 1:
            check()
    duration = segment.move.duration
    return levels, PlannedSegment(
        segment.setpoint.stretch, start,
        None if math.isinf(duration) else start + model.ns(duration),
        segment.move.code, segment.move.reason, start, segment.move.vibration,
        None if math.isinf(segment.setpoint.span) else start + model.ns(segment.setpoint.span),
        left=segment.left)


def _over(
        points: Sequence[tuple[float, int]], base: int, now: int, coordinate: str) -> RefusedError:
    """Return the error for a sequence that has already ended."""
    stretch, last = points[-1]
    if last == 0:
        return RefusedError(
            Code.SPELL_TOO_SHORT,
            f'{coordinate} {stretch:g} is due at time_from_start 0: expected time for the move')
    return RefusedError(
        Code.IN_THE_PAST,
        f'the sequence stamped {base / NANOSECONDS:.3f} s ends at '
        f'{(base + last) / NANOSECONDS:.3f} s, now is {now / NANOSECONDS:.3f} s: expected an '
        'end more than lead_time ahead; do sender and planner use the same clock (use_sim_time)?')
