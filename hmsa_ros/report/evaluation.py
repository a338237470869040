"""
The evaluation of a run: its setpoints, residual vibration, and prediction.

Times are in s from the first level of the run; stamps stay integer nanoseconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from hmsa_ros.errors import HmsaError
from hmsa_ros.interfaces.topics import PLANNER
from hmsa_ros.judge.records import Finding, Tolerances
from hmsa_ros.model.delivery import Delivery
from hmsa_ros.model.equations import (
    Array,
    elastic_force,
    signed_root,
    stretch_limits,
)
from hmsa_ros.model.moves import Level as PlannedLoad
from hmsa_ros.model.moves import State
from hmsa_ros.model.parameters import ActuatorParameters
from hmsa_ros.model.residual import residual_vibration
from hmsa_ros.model.simulation import follow, response, sampled
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.recordings.levels import in_force, Level, without_repeats
from hmsa_ros.recordings.parameters import creep_of
from hmsa_ros.recordings.record import Run, Times
from hmsa_ros.recordings.setpoints import Requested, SAME, setpoints_of, start_of
from hmsa_ros.report.curves import Curve, fine, through
from hmsa_ros.report.outcome import findings_of

#: Samples a period below which peaks are missed.
FEW_SAMPLES = 10
# Of the step: a block that covers less did not move.
_MOVED = 0.1


@dataclass(frozen=True)
class Move:
    """One setpoint, as it was commanded; stamps in ns."""

    stretch: float  #: target
    start: float  #: stretch before
    begin: int  #: of the first command
    arrival: int  #: of planned rest at the target
    end: int  #: until when the target was held
    flux_densities: tuple[float, ...]  #: levels in T, the last one holds the target
    place: int = 0  #: of the setpoint among all that were requested, from 0


@dataclass(frozen=True)
class MoveResult:
    """The result of one setpoint."""

    stretch: float  #: target
    start: float  #: stretch before
    #: first and last level and the time between begin and arrival, nondimensional as in the paper
    b_p: float
    tau_p: float
    b_1: float
    begin: float  #: in s of the run
    arrival: float  #: of planned rest at the target, in s from the begin
    end: float  #: in s of the run
    error: float  #: largest distance from the target after arrival, as a share of the step
    #: peak-to-peak stretch after arrival as a share of the step: recorded, and simulated for
    #: unshaped steps on the same plant; NaN where there are no samples, and of a block that did
    #: not move
    residual: float
    residual_unshaped: float
    #: whether the block covered a tenth of the step at least, on the mean after arrival
    moved: bool
    place: int = 0  #: of the setpoint among all that were requested, from 0

    @property
    def step(self) -> float:
        """How far it was to go, with its sign."""
        return self.stretch - self.start

    @property
    def rests(self) -> float:
        """Time of planned rest in s of the run."""
        return self.begin + self.arrival


@dataclass(frozen=True)
class Evaluation:
    """A run, measured."""

    #: stamp in ns of time 0: the first level of the run, or the first sample without one
    zero: int
    time: Array  #: times of the samples in s, shape (n,)
    start: float  #: stretch at rest before the first move
    levels: tuple[Level, ...]  #: commands that came into force and changed the level, by stamp
    moves: tuple[Move, ...]  #: setpoints
    results: tuple[MoveResult, ...]  #: one a move
    recorded: Curve  #: through the samples
    #: simulated for unshaped steps; NaN without a move, and where they are too large to follow
    plain: Curve
    plan: tuple[Level, ...]  #: changes of level that were planned and not replanned, by stamp
    #: by the plan, at the samples and between them; NaN before and without one
    planned: Curve
    findings: tuple[Finding, ...] = ()  #: one a setpoint that was requested

    def seconds(self, stamp: int) -> float:
        """Return a stamp in s of the run."""
        return (stamp - self.zero) / NANOSECONDS


def judged_from(finding: Finding) -> float:
    """Return from when on samples were judged, in s from the start of the move."""
    return (finding.setpoint.rests_from - finding.setpoint.begins) / NANOSECONDS


def verdicts(evaluations: Sequence[Evaluation], number: int) -> str:
    """Return the verdicts on a move in all runs that have it, each after a comma; or nothing."""
    places = [(x.findings, x.results[number].place) for x in evaluations
              if number < len(x.results)]
    return ''.join(f', {x}' for x in dict.fromkeys(
        _verdict(found[i]) for found, i in places if i < len(found)))


def _verdict(finding: Finding) -> str:
    """Return a verdict, and from when on it holds where that is after the move."""
    words = str(finding.verdict).replace('_', ' ')
    late = finding.setpoint.arrival is None and finding.arrived
    return f'{words} after {1e3 * judged_from(finding):.3g} ms' if late else words


def evaluate(run: Run, tolerances: Tolerances | None = None) -> Evaluation:
    """Measure a run, and judge it by tolerances, by default those of its planner."""
    levels = in_force((x,) for x in without_repeats(run.commands)[0])
    plan = in_force(run.plans)
    asked = setpoints_of(run)
    first = _first(run, levels, asked)
    start = asked[0].setpoint.start if asked else start_of(run, first)
    found = tuple(find_moves(run, levels, asked))
    time = (run.time - first) / NANOSECONDS
    period = run.plant.period
    plain = _plain(run, time, found, first, start)
    results = [_measure(run, time, plain, x, first) for x in found]
    stamps = run.time
    if plan:
        between = np.rint(fine(time, period) * NANOSECONDS).astype(np.int64) + first
        stamps = np.unique(np.concatenate([run.time, between, [
            x.stamp for x in plan if run.time[0] <= x.stamp <= run.time[-1]]]).astype(np.int64))
    return Evaluation(
        first, time, start, levels, found, tuple(results),
        through(Curve(time, run.stretch, run.rate), period), plain, plan,
        Curve((stamps - first) / NANOSECONDS, *_predict(run, plan, stamps)),
        tuple(findings_of(run, tolerances, asked=asked)))


def _first(run: Run, levels: Sequence[Level], asked: Sequence[Requested]) -> int:
    """Return when the first level of a run begins, in ns; of an earlier run one may still hold."""
    begins = asked[0].setpoint.begins if asked else int(run.time[0])
    later = [x for x in levels if x.stamp >= begins]
    if not later:
        return levels[0].stamp if levels else int(run.time[0])
    before = int(np.searchsorted(run.time, later[0].stamp)) - 1
    held = next((x.flux_density for x in reversed(levels) if x.stamp < begins), float(
        run.flux_density[before]) if before >= 0 else math.nan)
    return next((x for x in later if x.flux_density != held), later[0]).stamp


def find_moves(run: Run, levels: Sequence[Level], setpoints: Sequence[Requested]) -> list[Move]:
    """Return how setpoints were commanded that were reached before the recording ended."""
    last = int(run.time[-1])
    moves = []
    for place, asked in enumerate(setpoints):
        setpoint, arrival = asked.setpoint, asked.arrival
        end = min(x for x in (asked.due, asked.until, last) if x is not None)
        inside = [x for x in levels if setpoint.begins <= x.stamp <= (arrival or end)]
        if asked.missed or setpoint.step <= SAME or not inside:
            continue
        if arrival is None:
            # An unshaped step has none: half a period on, when a shaped one would arrive.
            arrival = inside[0].stamp + round(math.pi / setpoint.frequency * NANOSECONDS)
            inside = [x for x in inside if x.stamp <= arrival]
        if arrival < end:
            moves.append(Move(
                setpoint.target, setpoint.start, inside[0].stamp, arrival, end,
                tuple(x.flux_density for x in inside), place))
    return moves


def _plain(
        run: Run, time: Array, moves: Sequence[Move], zero: int, start: float) -> Curve:
    """Simulate unshaped steps, at the samples and between them."""
    nothing = Curve(time, np.full_like(time, np.nan), np.full_like(time, np.nan))
    if not moves:
        return nothing
    begins = np.array([(x.begin - zero) / NANOSECONDS for x in moves])
    before = time[time < begins[0]]
    grid = fine(np.union1d(begins[:1], time[len(before):]), run.plant.period)
    lower, upper = stretch_limits(run.plant.nondimensional)
    margin = 1e-6 * (min(upper, 2.0) - lower)
    start = min(max(start, lower + margin), upper - margin)
    try:
        # By the same amplifier, coil and elastomer as in the run.
        stretch, rate, _ = response(
            replace(run.plant, creep=creep_of(run.parameters, run.joint)),
            _delivery(run, run.plant, 'plant'), begins,
            np.array([x.flux_densities[-1] for x in moves]), grid, start)
    except HmsaError:
        return nothing
    return Curve(*(np.concatenate(x) for x in (
        (before, grid), (np.full_like(before, start), stretch), (np.zeros_like(before), rate))))


def _delivery(run: Run, actuator: ActuatorParameters, node: str) -> Delivery:
    """Return how levels reach the coil of a node."""
    unit = actuator.time_unit
    return Delivery(
        slew=run.number(f'{node}.slew_limit') / actuator.flux_density_unit * unit or math.inf,
        lag=run.number(f'{node}.coil_time_constant') / unit)


def _measure(run: Run, time: Array, plain: Curve, move: Move, zero: int) -> MoveResult:
    """Measure one setpoint."""
    step = move.stretch - move.start
    begin, arrival, end = (
        (x - zero) / NANOSECONDS for x in (move.begin, move.arrival, move.end))
    window = {'arrival': arrival, 'end': end, 'step': step}
    after = (time >= arrival) & (time <= end)
    error = residual = unshaped = math.nan
    moved = True
    if np.count_nonzero(after) >= 2:
        error = float(np.max(np.abs(run.stretch[after] - move.stretch)) / abs(step))
        before = run.stretch[max(int(np.searchsorted(time, begin, side='right')) - 1, 0)]
        moved = bool((np.mean(run.stretch[after]) - before) / step >= _MOVED)
        if moved:
            residual = residual_vibration(time, run.stretch, **window)
        unshaped = residual_vibration(plain.time, plain.stretch, **window)
    of_level = run.planner.units.of_level
    return MoveResult(
        stretch=move.stretch, start=move.start,
        b_p=float(signed_root(of_level(move.flux_densities[0]))),
        tau_p=(arrival - begin) / run.planner.time_unit,
        b_1=float(signed_root(of_level(move.flux_densities[-1]))), begin=begin,
        arrival=arrival - begin, end=end, error=error, residual=residual,
        residual_unshaped=unshaped, moved=moved, place=move.place)


def _predict(run: Run, plan: Sequence[Level], stamps: Times) -> tuple[Array, Array]:
    """Return what the plan predicts for some stamps: stretch and rate, from point to point."""
    predicted = np.full((2, len(stamps)), np.nan)
    actuator: ActuatorParameters = run.planner
    creep = creep_of(run.parameters, run.joint, PLANNER)
    material = replace(actuator, creep=creep).nondimensional
    lower, upper = stretch_limits(material)
    # No block can be where the others are; a message of anything may have been recorded.
    plan = [x for x in plan if lower < x.stretch < upper]
    if not plan:
        return predicted[0], predicted[1]
    unit, delivery = actuator.time_unit, _delivery(run, actuator, 'planner')
    state = State(plan[0].stretch, load=float(elastic_force(plan[0].stretch, material)))
    for i, point in enumerate(plan):
        until = plan[i + 1].stamp if i + 1 < len(plan) else max(int(run.time[-1]), point.stamp)
        level = PlannedLoad(0.0, actuator.units.of_level(point.flux_density))
        state = replace(state, stretch=point.stretch, rate=point.rate * unit)
        part = slice(
            int(np.searchsorted(stamps, point.stamp)), int(np.searchsorted(
                stamps, until, side='right' if i + 1 == len(plan) else 'left')))
        try:
            if part.start < part.stop:
                predicted[:, part] = sampled(
                    (level,), state, (stamps[part] - point.stamp) / NANOSECONDS / unit, material,
                    delivery)[:2]
            state = follow(
                (level,), state, (until - point.stamp) / NANOSECONDS / unit, material, delivery)
        except HmsaError:
            # A plan of other parameters than are known here: nothing to compare.
            continue
    return predicted[0], predicted[1] / unit


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
    planned = evaluation.planned.at(evaluation.time)
    stretch, rate = planned.stretch, planned.rate
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
