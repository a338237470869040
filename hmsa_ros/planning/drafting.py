"""
Requests worked out as drafts, step by step, without changing the plan in force.

Each function is a generator that pauses after a bounded amount of work and returns the draft:
whoever plans a long sequence can do other things in between. `finish` does it at once.
"""

from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
import math
from typing import Any, TypeVar

import numpy as np

from hmsa_ros.errors import BadInputError
from hmsa_ros.model.moves import Level, Move, State
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.history import agree
from hmsa_ros.planning.path import along, ON_PATH, Path
from hmsa_ros.planning.sequence import Segment, segments
from hmsa_ros.planning.setpoint import impossible, Setpoint
from hmsa_ros.planning.shapers import get_shaper
from hmsa_ros.planning.shapers.free import through
from hmsa_ros.planning.shapers.request import Request, Shaper
from hmsa_ros.planning.stopping import brake, holdable
from hmsa_ros.planning.timeline import Draft, Model, Plan, PlannedLevel, PlannedSegment

T = TypeVar('T')
#: Stretch, rate in 1/s and acceleration in 1/s^2, the latter NaN where it is not given.
PathPoint = tuple[float, float, float]
#: Work that pauses now and then.
Steps = Generator[None, None, T]

# How hard to brake where the hardest does not lead to a plan, from the nearest stop on.
_BRAKE_SHARES = (0.5, 0.1, 0.02, 0.0)
# How many natural periods later to try again where a plan cannot be made anew at once.
_PATIENCE = (0.0, 0.15, 0.3, 0.45, 0.6)
# How far off its stretch a field at rest may be, as a share of the load.
_SETTLED = 1e-6
# Rate in 1/s that is rest at the end of a path.
_STOPPED = 1e-7
# Share of a natural period in which a path is joined again: in a longer one vibration swings
# farther than if it were left alone.
_BACK = 0.4
# Deviation from a path, as a share of its range, that is too little for a correction to keep.
_ANEW = 1e-4
# Setpoints that are checked between two pauses, which takes some 0.1 ms; levels take more.
_CHECKED = 200


def finish(steps: Steps[T]) -> T:
    """Do work without a pause and return its result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result


@dataclass(frozen=True)
class Outset:
    """What a draft is worked out from: a state predicted at a time in ns."""

    plan: Plan
    model: Model
    begin: int  #: the soonest time
    state: State
    #: Place of the first level of the plan whose prediction holds no more.
    stale: int | None = None


def check_points(points: Sequence[tuple[float, int]], rest: float) -> Steps[None]:
    """Refuse points (stretch, end in ns from the start) that are no sequence: `RefusedError`."""
    for begin in range(0, max(len(points), 1), _CHECKED):
        part = points[begin:begin + _CHECKED]
        for stretch, _ in part:
            check_target(stretch, rest)
        check_times(part, 'point', begin, points[begin - 1][1] if begin else -1)
        yield


def check_times(
        points: Sequence[tuple[Any, int]], name: str, first: int = 0, previous: int = -1) -> None:
    """Refuse with `RefusedError` where there are no points, or times in ns do not increase."""
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


def check_target(stretch: float, rest: float) -> None:
    """Refuse with `RefusedError` what no actuator with a rest there has as a stretch."""
    if reason := impossible(stretch, rest):
        raise RefusedError(Code.BAD_INPUT, reason)


def draft_sequence(
        outset: Outset, points: Sequence[tuple[float, int]], base: int,
        now: int) -> Steps[Draft | None]:
    """
    Plan checked points (stretch, end in ns) from a start in ns; None if they change nothing.

    What cannot be carried out is a `RefusedError`.
    """
    begin = outset.begin
    if points[0][1] == 0 and len(points) > 1 and base == begin:
        # A first point at time 0 that repeats where the actuator is asks for nothing.
        here = outset.state.stretch
        if abs(points[0][0] - here) > 1e-6:
            raise RefusedError(
                Code.SPELL_TOO_SHORT,
                f'the first point asks for {outset.model.units.coordinate} {points[0][0]:g} at '
                f'time_from_start 0, the actuator is at {here:.6g}: expected enough time for the '
                'move')
    if base + points[-1][1] <= begin:
        raise _over(points, base, now, outset.model.units.coordinate)
    setpoints = []
    left = begin
    for number, (stretch, time) in enumerate(points):
        if base + time > begin:
            end = outset.model.on_grid(base + time)
            if end == left:
                raise RefusedError(
                    Code.SPELL_TOO_SHORT,
                    f'{outset.model.units.coordinate} {stretch:g} begins and ends within one '
                    f'command period of {outset.model.options.period / NANOSECONDS:g} s: expected '
                    'a longer duration')
            setpoints.append(Setpoint(stretch, outset.model.time(end - left)))
            left = end
        if number % _CHECKED == _CHECKED - 1:
            yield
    return (yield from draft_setpoints(outset, setpoints))


def check_path(points: Sequence[tuple[PathPoint, int]], rest: float) -> None:
    """Refuse points and times in ns that are no path to rest: `RefusedError`."""
    check_times(points, 'point')
    given = math.isnan(points[0][0][2])
    for number, ((stretch, *more), _) in enumerate(points):
        check_target(stretch, rest)
        # Accelerations are of all points or of none.
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
        outset: Outset, points: Sequence[tuple[PathPoint, int]], base: int,
        now: int) -> Steps[Draft]:
    """
    Follow a checked path from a start in ns, or join it where it is by now.

    From beside it the actuator goes to its first point, or to the first that is a natural period
    ahead. What cannot be carried out is a `RefusedError`.
    """
    model, state, unit = outset.model, outset.state, outset.model.units.time
    ended, last = points[-1]
    if base + last <= outset.begin:
        raise _over([(ended[0], last)], base, now, model.units.coordinate)
    times = np.array([model.time(base + x - outset.begin) for _, x in points])
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
    yield
    return (yield from _along(
        outset, path, float(rows[0, -1]), model.options.path_tolerance,
        path=path.scaled(1.0 / unit)))


def draft_path_anew(outset: Outset) -> Steps[Draft]:
    """
    Plan what is left of the path under way anew, back to it within half a natural period.

    What cannot be carried out is a `RefusedError`.
    """
    model, state, place = outset.model, outset.state, outset.plan.under_way(outset.begin)
    segment = outset.plan.segments[place]
    if segment.path is None:
        raise ValueError('the setpoint under way is no path')
    left = segment.path.scaled(model.units.time).since(model.time(outset.begin - segment.since))
    span = min(_BACK * 2.0 * math.pi / model.frequency(segment.stretch), float(left.breaks[-1]))
    return replace((yield from _along(
        outset, left.joined(state.stretch, state.rate, span), segment.stretch,
        max(model.options.path_tolerance, _ANEW), since=segment.since, path=segment.path)),
        resumed=place)


def _along(
        outset: Outset, wanted: Path, target: float, tolerance: float,
        **known: Any) -> Steps[Draft]:
    """Follow a path to rest at a target, of whose setpoint more is known."""
    move = yield from along(
        replace(_frame(outset.model, outset.state), target=target), wanted, tolerance)
    draft = yield from draft_moves(
        outset, [Setpoint(target, math.inf)], first=lambda request: move)
    return replace(draft, segments=(replace(draft.segments[0], **known),))


def draft_setpoints(outset: Outset, setpoints: Sequence[Setpoint]) -> Steps[Draft | None]:
    """Plan setpoints; None where the plan is on the way to the only one, with nothing between."""
    planned = outset.plan.segments
    if len(setpoints) == 1 and planned and planned[-1].stretch == setpoints[0].stretch \
            and planned[-1].since <= outset.begin:
        return None
    return (yield from draft_moves(outset, setpoints))


def draft_stop(outset: Outset) -> Steps[Draft]:
    """Plan how to come to rest as near as the flux density limits allow."""
    # The load that brakes hardest is held until the first turning point, then the load that
    # holds that stretch: a two-step command whose target is chosen by its beta_p. Where one
    # brake does not do, on a grid, through ramps or at a limit, it is a move to a stretch near by.
    model, state = outset.model, outset.state
    found = brake(model, state)
    # A coil that must not step brakes as the shaper smooth does, on from where it would turn.
    smooth = model.options.shaper == 'smooth'
    if (not smooth and holdable(model, found.stretch) == found.stretch
            and not model.material.creep
            and (model.delivery.ideal or found.duration == 0.0 and _settled(model, state))):
        move = Move(Code.HOLD, tuple(
            [Level(0.0, found.load)] * (found.duration > 0.0)
            + [Level(found.duration, model.holding(found.stretch))]),
            found.duration, 'stopped')
        end = State(found.stretch, 0.0, move.levels[-1].load)
        levels, placed = yield from _placed(model, outset.begin, Segment(
            Setpoint(found.stretch, math.inf), 0.0, state, end, move, end.load))
        return Draft(outset.begin, tuple(levels), (placed,))
    ways = [(0.0, 'smooth')] * smooth + [(x, 'two_step') for x in _BRAKE_SHARES]
    for share, shaper in ways:
        stretch = holdable(model, brake(model, state, share).stretch)
        try:
            return (yield from draft_moves(outset, [Setpoint(stretch, math.inf)], shaper))
        except BadInputError:
            yield
    # Nothing stops it at once: let it settle.
    return (yield from draft_moves(
        outset, [Setpoint(holdable(model, state.stretch), math.inf)], 'step'))


def _settled(model: Model, state: State) -> bool:
    """Return whether the field of a coil that lags holds the stretch already."""
    return model.delivery.lag == 0.0 or math.isclose(
        state.load, model.holding(state.stretch), rel_tol=_SETTLED, abs_tol=_SETTLED)


def later_outsets(outset: Outset) -> Iterator[int]:
    """Yield times in ns to begin at where there is no way from the motion at the first."""
    model = outset.model
    period = 2.0 * math.pi / model.frequency(outset.state.stretch)
    for share in _PATIENCE:
        yield model.on_grid(outset.begin + model.ns(share * period))


def draft_resumption(outset: Outset, arrival: int | None = None) -> Steps[Draft | None]:
    """
    Plan what is left of the running plan anew, until it is on its way again; None if nothing is.

    Rest at the setpoint under way is at ``arrival`` in ns, or as soon as its shaper can. What
    cannot be carried out from there is a `RefusedError`.
    """
    # Setpoints end when they did; one that there is no time left for is left out. From where the
    # new plan meets the running one it goes on as that.
    planned = outset.plan.segments
    begun = max(outset.plan.under_way(outset.begin), 0)
    first = None if arrival is None else partial(
        through, duration=outset.model.time(arrival - outset.begin))
    refusal: RefusedError | None = None
    for index in range(begun, len(planned)):
        # Left out setpoints make room for the next one, which is gone to at once.
        try:
            draft = yield from draft_moves(
                outset, _left(outset, index), first=first, index=index)
        except RefusedError as error:
            refusal = refusal or error
            if error.code is not Code.SPELL_TOO_SHORT or arrival is not None:
                break
            yield
            continue
        anew = replace(
            draft.segments[0], since=min(planned[index].since, draft.segments[0].since))
        return replace(
            draft, segments=(anew, *draft.segments[1:]), resumed=begun, missed=index - begun)
    if refusal is not None:
        raise refusal
    return None


def _left(outset: Outset, index: int) -> Iterator[Setpoint]:
    """Yield the setpoints of the running plan from a place on, with the time left for them."""
    planned = outset.plan.segments
    left = outset.begin
    for place in range(index, len(planned) - 1):
        end = planned[place + 1].since
        yield Setpoint(planned[place].stretch, outset.model.time(end - left))
        left = end
    yield Setpoint(planned[-1].stretch, math.inf)


def _meeting(outset: Outset, state: State, following: int) -> int | None:
    """Return from which level on the running plan continues a state at a setpoint's begin."""
    planned = outset.plan.segments[following]
    place = outset.plan.place(planned.begin)
    level = outset.plan.levels[place]
    if (level.stamp != planned.begin or level.model is not outset.model
            or outset.stale is not None and place < outset.stale):
        return None
    here = PlannedLevel(level.stamp, level.flux_density, state, level.model)
    return place if agree(here, level) else None


def draft_moves(
        outset: Outset, setpoints: Iterable[Setpoint], shaper: str = '',
        first: Shaper | None = None, index: int | None = None) -> Steps[Draft]:
    """
    Plan setpoints and place them on the timeline; the shaper is that of the options.

    Where they are those of the running plan from a place on, they go on as that once they meet it.
    """
    model, planned = outset.model, outset.plan.segments
    levels: list[PlannedLevel] = []
    placed: list[PlannedSegment] = []
    for segment in segments(
            _frame(model, outset.state), setpoints, get_shaper(shaper or model.options.shaper),
            model.options.short_spell, first=first):
        more, one = yield from _placed(model, outset.begin, segment)
        levels += more
        placed.append(one)
        following = len(planned) if index is None else index + len(placed)
        place = _meeting(outset, segment.end, following) if following < len(planned) else None
        if place is not None:
            levels += outset.plan.levels[place:]
            placed += planned[following:]
            break
        yield
    return Draft(outset.begin, tuple(levels), tuple(placed))


def _frame(model: Model, state: State) -> Request:
    """Return the request to stay where a state is."""
    options = model.options
    return Request(
        state, state.stretch, model.material, model.limits, model.delivery, options.order,
        model.units, options.errors, model.pace)


def _placed(
        model: Model, begin: int,
        segment: Segment) -> Steps[tuple[list[PlannedLevel], PlannedSegment]]:
    """Place a planned move on the timeline, in SI units."""
    start = begin + model.ns(segment.begin)
    state = segment.start
    if math.isnan(state.load):
        raise ValueError('a segment on the timeline knows the load it starts from')
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
            yield
    duration = segment.move.duration
    return levels, PlannedSegment(
        segment.setpoint.stretch, start,
        None if math.isinf(duration) else start + model.ns(duration),
        segment.move.code, segment.move.reason, start, segment.move.vibration,
        None if math.isinf(segment.setpoint.span) else start + model.ns(segment.setpoint.span))


def _over(
        points: Sequence[tuple[float, int]], base: int, now: int, coordinate: str) -> RefusedError:
    """Return the refusal of a sequence that is over."""
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
