"""
The evaluation of a run: its setpoints, residual vibration, and prediction.

Times are in s from the first command of the run; stamps stay integer nanoseconds.
"""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from hmsa_ros.contract.topics import PLANNER
from hmsa_ros.core.delivery import late, pieces
from hmsa_ros.core.model import (
    Array,
    elastic_force,
    equilibrium_stretch,
    natural_frequency,
    signed_root,
    stretch_limits,
)
from hmsa_ros.core.moves import Level as PlannedLoad
from hmsa_ros.core.moves import State
from hmsa_ros.core.parameters import ActuatorParameters
from hmsa_ros.core.residual import residual_vibration
from hmsa_ros.core.simulation import RTOL, sampled, simulate
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.runs.levels import in_force, Level, without_repeats
from hmsa_ros.runs.parameters import creep_of
from hmsa_ros.runs.record import Run

# Stretches that differ by less are one setpoint: what comes back from a flux density in double
# precision is some 1e-12 off.
_SAME = 1e-6
# Stretch rates below this share of the natural frequency are rest, to a planner's precision.
_AT_REST = 1e-3
# Plain steps are simulated with this many points a period of the actuator at least, up to so many.
_POINTS_A_PERIOD, _MOST_POINTS = 100, 2_000_000
#: Samples a period below which peaks are missed.
FEW_SAMPLES = 10
# Of the step: a block that covers less did not move.
_MOVED = 0.1


@dataclass(frozen=True)
class Move:
    """
    One setpoint, as it was commanded; stamps in ns.

    Raises
    ------
    BadInputError
        If the times are not in order, or there is no level.

    """

    stretch: float  #: target
    begin: int  #: of the first command
    arrival: int  #: of planned rest at the target
    end: int  #: until when the target was held
    flux_densities: tuple[float, ...]  #: levels in T, the last one holds the target

    def __post_init__(self) -> None:
        if not self.begin <= self.arrival <= self.end or not self.flux_densities:
            raise BadInputError(
                f'a move from {self.begin} to {self.arrival} until {self.end} ns with '
                f'{len(self.flux_densities)} levels: expected times in order and a level')


@dataclass(frozen=True)
class MoveResult:
    """The result of one setpoint."""

    stretch: float  #: target
    #: first and last level and the time between begin and arrival, nondimensional as in the paper
    b_p: float
    tau_p: float
    b_1: float
    #: in s of the run
    begin: float
    arrival: float
    end: float
    error: float  #: largest distance from the target after arrival, as a share of the step
    #: peak-to-peak stretch after arrival as a share of the step: recorded, and simulated for
    #: plain steps on the same plant; NaN where there are no samples, and of a block that did not
    #: move
    residual: float
    residual_unshaped: float
    #: whether the block covered a tenth of the step at least, on the mean after arrival
    moved: bool


@dataclass(frozen=True)
class Evaluation:
    """A run, measured."""

    zero: int  #: stamp in ns of time 0: the first command, or the first sample without one
    time: Array  #: times of the samples in s, shape (n,)
    start: float  #: stretch at rest before the first move
    levels: tuple[Level, ...]  #: commands that came into force and changed the level, by stamp
    moves: tuple[Move, ...]  #: setpoints
    results: tuple[MoveResult, ...]  #: one a move
    #: stretch, and stretch rate in 1/s, simulated for plain steps; NaN without a move, and where
    #: they are too large to follow, shape (n,)
    unshaped: tuple[Array, Array]
    plan: tuple[Level, ...]  #: changes of level that were planned and not replanned, by stamp
    #: stretch, and stretch rate in 1/s, by the plan; NaN before and without one, shape (n,)
    predicted: tuple[Array, Array]

    def seconds(self, stamp: int) -> float:
        """Return a stamp in s of the run."""
        return (stamp - self.zero) / NANOSECONDS


def evaluate(run: Run, moves: Sequence[Move] | None = None) -> Evaluation:
    """Measure a run; the setpoints are what `find_moves` finds, unless they are given."""
    levels = in_force((x,) for x in without_repeats(run.commands)[0])
    plan = in_force(run.plans)
    start = _start(run, levels, plan)
    found = tuple(find_moves(run, levels, plan) if moves is None else moves)
    zero = levels[0].stamp if levels else int(run.time[0])
    time = (run.time - zero) / NANOSECONDS
    *unshaped, grid, fine = _unshaped(run, time, found, zero, start)
    results = []
    previous = start
    for move in found:
        results.append(_measure(run, time, (grid, fine), move, move.stretch - previous, zero))
        previous = move.stretch
    return Evaluation(
        zero, time, start, levels, found, tuple(results), (unshaped[0], unshaped[1]), plan,
        _predict(run, plan))


def find_moves(
        run: Run, levels: Sequence[Level], plan: Sequence[Level]) -> list[Move]:
    """Find the setpoints that the commands of a run reached before the recording ended."""
    # A setpoint is reached with the level that holds it: the one whose equilibrium is a stretch
    # that was asked for, or at which the plan is at rest at one (with what feedback has learnt,
    # levels have another equilibrium). Where neither finds a setpoint, a level that lasts for a
    # period of the actuator holds one.
    last = int(run.time[-1])
    asked = _asked(run)
    unit = run.planner.flux_density_unit
    material = run.planner.nondimensional
    balance = equilibrium_stretch([x.flux_density / unit for x in levels], material)
    period = 2.0 * math.pi / natural_frequency(balance, material) * run.planner.time_unit
    predicted = {x.stamp: x for x in plan}

    def by_request(i: int, previous: float, begin: int) -> float | None:
        held = _nearest(asked, float(balance[i]))
        if held is not None:
            return held
        point = predicted.get(levels[i].stamp)
        if point is None or abs(point.rate) * period[i] > 2.0 * math.pi * _AT_REST:
            return None
        near = _nearest(asked, point.stretch)
        # The first level of a move begins at rest, too.
        return None if near is None or i == begin and abs(near - previous) <= _SAME else near

    def by_duration(i: int, *_: float) -> float | None:
        until = levels[i + 1].stamp if i + 1 < len(levels) else last
        lasts = (until - levels[i].stamp) / NANOSECONDS >= period[i]
        return float(balance[i]) if lasts else None

    for target_of in (by_request, by_duration):
        moves = _group(run, levels, period, target_of, _start(run, levels, plan), last)
        if moves:
            return moves
    return []


def _group(
        run: Run, levels: Sequence[Level], period: Array,
        target_of: Callable[[int, float, int], float | None], start: float,
        last: int) -> list[Move]:
    """Return the moves that end with the levels that hold a target."""
    corrections = [x.sent for x in run.verdicts if x.code == 'corrected']
    found: list[tuple[int, int, float]] = []
    begin, previous = 0, start
    for i in range(len(levels)):
        target = target_of(i, previous, begin)
        if target is None:
            continue
        # The same level again, or one that holds what is held, is no move, but feedback may
        # have made the move end there.
        if abs(target - previous) > _SAME:
            found.append((begin, i, target))
        elif i > begin and found and any(
                levels[found[-1][0]].stamp < x < levels[i].stamp for x in corrections):
            found[-1] = found[-1][0], i, target
        begin, previous = i + 1, target
    slew = run.number('plant.slew_limit') or run.number('planner.slew_limit')
    moves = []
    for n, (first, hold, target) in enumerate(found):
        stamp = levels[first].stamp
        end = levels[hold + 1].stamp if hold + 1 < len(levels) else _held_until(
            run, stamp, target, len(found) - n, last)
        arrival = levels[hold].stamp
        if first == hold:
            # A plain step has no arrival: half a period on, when a shaped one would arrive.
            arrival += round(0.5 * period[hold] * NANOSECONDS)
        elif slew:
            change = abs(levels[hold].flux_density - levels[hold - 1].flux_density)
            # A bag may contain any slew limit.
            arrival += round(min(change / slew, 1e6) * NANOSECONDS)
        if arrival < min(end, last):
            moves.append(Move(target, stamp, arrival, end, tuple(
                x.flux_density for x in levels[first:hold + 1])))
    return moves


def _held_until(run: Run, begin: int, target: float, left: int, last: int) -> int:
    """Return until when the last setpoint was requested, at most the end of the record."""
    for request in reversed(run.requests):
        stretch, duration = request.points[-1] if request.points else (math.nan, None)
        if request.sent <= begin and abs(stretch - target) < _SAME:
            if duration is not None and request.stamp:
                return min(request.stamp + duration, last)
            if duration is not None and left == 1 and len(request.points) > 1:
                # From the point before, which is when this move began.
                return min(begin + duration - (request.points[-2][1] or 0), last)
            if duration is not None and len(request.points) == 1:
                return min(begin + duration, last)
            break
    return last


def _asked(run: Run) -> list[float]:
    """Return the requested stretches, sorted."""
    asked = {x for request in run.requests for x, _ in request.points if math.isfinite(x)}
    for verdict in run.verdicts:
        # Rounded for the message: a request says it better.
        if math.isfinite(verdict.stretch) and _nearest(sorted(asked), verdict.stretch) is None:
            asked.add(verdict.stretch)
    return sorted(asked)


def _nearest(values: Sequence[float], value: float) -> float | None:
    """Return the one of some sorted values that is the same to within rounding."""
    i = bisect_left(values, value - _SAME)
    return values[i] if i < len(values) and values[i] <= value + _SAME else None


def _start(run: Run, levels: Sequence[Level], plan: Sequence[Level]) -> float:
    """Return the stretch before the first move: planned if that is known, else recorded."""
    if plan and levels and plan[0].stamp == levels[0].stamp:
        return plan[0].stretch
    stamp = levels[0].stamp if levels else int(run.time[0])
    before = max(int(np.searchsorted(run.time, stamp, side='right')) - 1, 0)
    return float(run.stretch[before])


def _unshaped(
        run: Run, time: Array, moves: Sequence[Move], zero: int,
        start: float) -> tuple[Array, Array, Array, Array]:
    """Simulate plain steps: stretch and rate at the samples; times and stretch between, too."""
    stretch, rate = np.full_like(time, start), np.zeros_like(time)
    nothing = np.full_like(time, np.nan), np.full_like(time, np.nan), time, \
        np.full_like(time, np.nan)
    if not moves:
        return nothing
    unit = run.plant.time_unit
    begins = [(x.begin - zero) / NANOSECONDS for x in moves]
    running = time >= begins[0]
    grid = _fine(time[running], period_of(run))
    lower, upper = stretch_limits(run.plant.nondimensional)
    margin = 1e-6 * (min(upper, 2.0) - lower)
    start = min(max(start, lower + margin), upper - margin)
    try:
        # By the same amplifier, coil and elastomer as in the run.
        material = replace(
            run.plant, creep=creep_of(run.parameters, run.joint)).nondimensional
        held = float(elastic_force(start, material))
        switches, loads, slopes, _ = pieces(
            [PlannedLoad(x / unit, y.flux_densities[-1] / run.plant.flux_density_unit)
             for x, y in zip(begins, moves, strict=True)], held, float(grid[-1]) / unit,
            _slew(run, run.plant, 'plant'))
        fine, fine_rate = simulate(
            switches, loads, grid / unit, material, stretch=start, slopes=slopes,
            lag=run.number('plant.coil_time_constant') / unit, field=held)
    except HmsaError:
        return nothing
    places = np.searchsorted(grid, time[running])
    stretch[running], rate[running] = fine[places], fine_rate[places] / unit
    return stretch, rate, grid, fine


def _slew(run: Run, actuator: ActuatorParameters, node: str) -> float:
    """Return the slew limit of a node without a dimension; infinite for none."""
    return run.number(f'{node}.slew_limit') / actuator.flux_density_unit \
        * actuator.time_unit or math.inf


def _fine(time: Array, period: float) -> Array:
    """Return times with more between them where samples are too few for the peaks."""
    if len(time) < 2:
        return time
    spacing = max(period / _POINTS_A_PERIOD, (time[-1] - time[0]) / _MOST_POINTS)
    if np.max(np.diff(time)) <= spacing:
        return time
    return np.union1d(time, np.arange(time[0], time[-1], spacing))


def period_of(run: Run) -> float:
    """Return the period in s of small undamped motion about rest."""
    material = run.plant.nondimensional
    return 2.0 * math.pi / float(natural_frequency(material.rest, material)) * run.plant.time_unit


def _measure(
        run: Run, time: Array, unshaped: tuple[Array, Array], move: Move, step: float,
        zero: int) -> MoveResult:
    """Measure one setpoint; unshaped are times and stretch of plain steps."""
    begin, arrival, end = (
        (x - zero) / NANOSECONDS for x in (move.begin, move.arrival, move.end))
    window = {'arrival': arrival, 'end': end, 'step': step}
    after = (time >= arrival) & (time <= end)
    error = residual = plain = math.nan
    moved = True
    if np.count_nonzero(after) >= 2 and step != 0.0:
        error = float(np.max(np.abs(run.stretch[after] - move.stretch)) / abs(step))
        before = run.stretch[max(int(np.searchsorted(time, begin, side='right')) - 1, 0)]
        moved = bool((np.mean(run.stretch[after]) - before) / step >= _MOVED)
        if moved:
            residual = residual_vibration(time, run.stretch, **window)
        plain = residual_vibration(*unshaped, **window)
    unit = run.planner.flux_density_unit
    return MoveResult(
        stretch=move.stretch, b_p=float(signed_root(move.flux_densities[0] / unit)),
        tau_p=(arrival - begin) / run.planner.time_unit,
        b_1=float(signed_root(move.flux_densities[-1] / unit)), begin=begin, arrival=arrival,
        end=end, error=error, residual=residual, residual_unshaped=plain, moved=moved)


def _predict(run: Run, plan: Sequence[Level]) -> tuple[Array, Array]:
    """Return what the plan predicts for the samples: stretch and rate, from point to point."""
    predicted = np.full((2, len(run.time)), np.nan)
    actuator: ActuatorParameters = run.planner
    creep = creep_of(run.parameters, run.joint, PLANNER)
    material = replace(actuator, creep=creep).nondimensional
    lower, upper = stretch_limits(material)
    # No block can be where the others are; a message of anything may have been recorded.
    plan = [x for x in plan if lower < x.stretch < upper]
    if not plan:
        return predicted[0], predicted[1]
    slew = _slew(run, actuator, 'planner')
    lag = run.number('planner.coil_time_constant') / actuator.time_unit
    load = field = float(elastic_force(plan[0].stretch, material))
    followed: tuple[float, ...] = ()
    for i, point in enumerate(plan):
        until = plan[i + 1].stamp if i + 1 < len(plan) else max(int(run.time[-1]), point.stamp)
        duration = (until - point.stamp) / NANOSECONDS / actuator.time_unit
        if math.isinf(slew):
            load = point.flux_density / actuator.flux_density_unit
        switches, loads, slopes, load = pieces(
            (PlannedLoad(0.0, point.flux_density / actuator.flux_density_unit),), load,
            duration, slew)
        begun = field
        if lag:
            field = late(list(zip(switches, loads, slopes, strict=True)), duration, field, lag)
        part = slice(
            int(np.searchsorted(run.time, point.stamp)), int(np.searchsorted(
                run.time, until, side='right' if i + 1 == len(plan) else 'left')))
        if part.start == part.stop and not creep:
            continue
        times = (run.time[part] - point.stamp) / NANOSECONDS / actuator.time_unit
        rate = point.rate * actuator.time_unit
        try:
            if creep:
                rows = sampled(
                    switches, loads, slopes, np.append(times, duration),
                    State(point.stretch, rate, begun, followed=followed), material, RTOL, lag)
                predicted[:, part] = rows[:2, :-1]
                followed = tuple(rows[3:, -1].tolist())
                continue
            predicted[:, part] = simulate(
                switches, loads, times, material, stretch=point.stretch, rate=rate,
                slopes=slopes, lag=lag, field=begun)
        except HmsaError:
            # A plan of other parameters than are known here: nothing to compare.
            continue
    return predicted[0], predicted[1] / actuator.time_unit


@dataclass(frozen=True)
class PlanPoint:
    """A change of level in the plan, and what was recorded there; NaN for what is not."""

    time: float  #: in s of the run
    planned: float  #: flux density in T
    commanded: float  #: with the same stamp, in T
    stretch: float  #: predicted for the first sample from then on
    rate: float  #: likewise, in 1/s
    recorded_stretch: float  #: that sample
    recorded_rate: float
    deviation: float  #: largest of the recorded from the predicted stretch until the next


def plan_points(run: Run, evaluation: Evaluation) -> list[PlanPoint]:
    """Compare the plan of a run with what was recorded, by time."""
    commanded = {x.stamp: x.flux_density for x in evaluation.levels}
    stretch, rate = evaluation.predicted
    # Of each point the first sample, and behind the last point the end.
    firsts = [int(np.searchsorted(run.time, x.stamp)) for x in evaluation.plan]
    firsts.append(len(run.time))
    points = []
    for point, first, until in zip(evaluation.plan, firsts, firsts[1:], strict=False):
        values = [math.nan] * 5
        if first < until:
            values = [float(x[first]) for x in (stretch, rate, run.stretch, run.rate)]
            values.append(float(np.max(np.abs(
                run.stretch[first:until] - stretch[first:until]))))
        points.append(PlanPoint(
            evaluation.seconds(point.stamp), point.flux_density,
            commanded.get(point.stamp, math.nan), *values))
    return points
