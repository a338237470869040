"""
Evaluate a run: its setpoints, levels, residual vibration, and prediction.

Times are in s from the first level of the run; timestamps stay integer nanoseconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from hmsa.errors import HmsaError
from hmsa.interfaces.diagnostics import Outcome
from hmsa.interfaces.parameters import number_of
from hmsa.interfaces.topics import PLANNER
from hmsa.judge.records import Finding, RequestedSetpoint, SensorModel, Tolerances, unobserved
from hmsa.judge.setpoint_samples import SetpointSamples
from hmsa.model.delivery import Delivery
from hmsa.model.equations import (
    Array,
    elastic_force,
    equilibrium_stretch,
    signed_root,
    stretch_limits,
)
from hmsa.model.moves import Level as PlannedLoad
from hmsa.model.moves import State
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.simulation import follow, residual_vibration, response, sampled
from hmsa.model.status import Code
from hmsa.model.units import NANOSECONDS
from hmsa.report.figures import fine, through, TimeCurve
from hmsa.runs.parameters import creep_of, of_joint
from hmsa.runs.record import (
    in_force,
    RecordedLevel,
    Run,
    SAME,
    setpoints_of,
    start_of,
    Times,
    without_repeats,
)
from hmsa.table import Column, Table

_CUT_SHORT = 'the samples end before its arrival'
_SENSOR = SensorModel()
# Later than any timestamp, in ns.
_END = 2**62
# Maximum number of rows in the table of levels.
_MOST_LEVELS = 12
#: With fewer samples per period, peaks are missed.
FEW_SAMPLES = 10
# Fraction of the step; a block that covers less did not move.
_MOVED = 0.1
# Maximum natural periods to simulate: more take minutes, and indicate a pause or another clock.
_MOST_PERIODS = 1e6


def findings_of(
        run: Run, tolerances: Tolerances | None = None, *,
        asked: Sequence[Outcome] | None = None) -> list[Finding]:
    """
    Return the finding of each requested setpoint.

    It is that of the planner; with other tolerances, or without one, the samples are judged.
    """
    own = tolerances_of(run)
    return [
        x.finding if x.finding is not None and (x.missed or tolerances in (None, own))
        else _judged(run, x, tolerances or own)
        for x in (setpoints_of(run) if asked is None else asked)]


def tolerances_of(run: Run) -> Tolerances:
    """Return the tolerances of a run's planner."""
    own = {x: number_of(of_joint(run.parameters, run.joint, f'planner.{x}_tolerance'))
           for x in ('arrival', 'vibration', 'stretch')}
    return Tolerances(**{x: y for x, y in own.items() if y is not None and y >= 0.0})


def _judged(run: Run, asked: Outcome, tolerances: Tolerances) -> Finding:
    """Judge a setpoint by its recorded samples, as the planner does."""
    hold = SetpointSamples(replace(asked.setpoint, moved=None))
    if asked.setpoint.moved is not None:
        hold.move(asked.setpoint.moved, corrected=asked.corrected)
    sensors, sensor = list(run.sensors), _SENSOR
    part = slice(*np.searchsorted(run.time, (
        asked.setpoint.begins, _END if asked.until is None else asked.until)))
    for stamp, logged, stretch in zip(
            run.time[part].tolist(), run.logged[part].tolist(), run.stretch[part].tolist(),
            strict=True):
        if hold.over:
            break
        while sensors and sensors[0].sent <= logged:
            sensor = sensors.pop(0).sensor
        hold.add((stamp,), (stretch,), stamp, logged)
        if stamp >= hold.due:
            hold.judge(stamp, logged, tolerances, sensor, observable=True)
    patience = _END
    while not hold.over:
        # All samples have been added.
        hold.judge(_END, patience, tolerances, sensor, observable=False)
        patience *= 2
    found = hold.found or unobserved(hold.setpoint)
    if found.verdict is Code.UNOBSERVED and run.time[-1] < found.setpoint.rests_from:
        return unobserved(found.setpoint, _CUT_SHORT)
    return found


@dataclass(frozen=True)
class LevelResult:
    """The measured stretch at one level of the field."""

    joint: str  #: empty if unknown
    flux_density: float  #: in T
    times: int  #: number of intervals; the last interval of the run has a row of its own
    duration: float  #: total, in s
    #: equilibrium stretch with the planner's parameters; NaN outside the model's range
    rest: float
    #: measured stretch in these intervals; NaN without samples
    mean: float
    least: float
    greatest: float


def level_results(run: Run) -> list[LevelResult]:
    """Return the results of each level in order of first use, combining equal levels."""
    levels = [x for x in run.levels if x.stamp <= run.time[-1]]
    ends = [*(x.stamp for x in levels[1:]), int(run.time[-1]) + 1]
    groups: dict[tuple[float, bool], list[tuple[int, int]]] = {}
    for i, (level, end) in enumerate(zip(levels, ends, strict=True)):
        groups.setdefault((level.flux_density, i + 1 == len(levels)), []).append(
            (level.stamp, end))
    results = []
    for (flux_density, _), spans in groups.items():
        parts = [run.stretch[slice(*np.searchsorted(run.time, x))] for x in spans]
        inside = np.concatenate(parts)
        rest = float(equilibrium_stretch(
            run.planner.units.of_level(flux_density), run.planner.nondimensional))
        figures = [float(x(inside)) for x in (np.mean, np.min, np.max)] if len(inside) else [
            math.nan] * 3
        results.append(LevelResult(
            run.joint, flux_density, len(spans), sum(y - x for x, y in spans) / NANOSECONDS, rest,
            *figures))
    return results


def level_table(levels: Sequence[LevelResult]) -> Table:
    """Return the table of the levels with the longest durations."""
    longest = sorted(levels, key=lambda x: -x.duration)[:_MOST_LEVELS]
    chosen = [x for x in levels if x in longest or x is levels[-1]]
    short = len(levels) - len(chosen)
    several = len({x.joint for x in levels}) > 1
    return Table((
        *([Column('joint')] if several else []), Column('level', 'mT', '.4g'),
        Column('times'),
        Column('in all', 'ms', '.4g', 'total'), Column('rest', '', '.5f'),
        Column('mean', '', '.5f'), Column('least', '', '.5f', 'minimum'),
        Column('greatest', '', '.5f', 'maximum')), tuple(
        (*([x.joint] if several else []), x.flux_density * 1e3, x.times, x.duration * 1e3,
         x.rest, x.mean, x.least, x.greatest) for x in chosen),
        'the last row is the end' + (
            f'; {short} short levels are left out' if short else ''), legend=(
                ('times, total', 'number and sum of the durations of the level'),
                ('rest', 'stretch that the level holds, according to the parameters'),
                ('mean, minimum, maximum', 'stretches while the level was in force')))


@dataclass(frozen=True)
class CommandedMove:
    """One setpoint as it was commanded; timestamps in ns."""

    stretch: float  #: target
    start: float  #: stretch before
    begin: int  #: of the first command
    arrival: int  #: planned rest at the target
    end: int  #: end of the hold at the target
    flux_densities: tuple[float, ...]  #: levels in T; the last one holds the target
    place: int = 0  #: index among all requested setpoints


@dataclass(frozen=True)
class MoveResult:
    """The result of one setpoint."""

    stretch: float  #: target
    start: float  #: stretch before
    #: first and last level and duration of the move, nondimensional as in the paper
    b_p: float
    tau_p: float
    b_1: float
    begin: float  #: in s of the run
    arrival: float  #: planned rest at the target, in s from the begin
    end: float  #: in s of the run
    error: float  #: largest distance from the target after arrival, as a fraction of the step
    #: peak-to-peak stretch after arrival as a fraction of the step: recorded, and simulated for
    #: unshaped steps of the same plant; NaN without samples, and for a block that did not move
    residual: float
    residual_unshaped: float
    #: from the begin until the recorded stretch stays within the tolerance of the target, in s;
    #: NaN if it does not, or without samples
    settled: float
    #: whether the mean after arrival lies at least a tenth of the step from the start
    moved: bool
    place: int = 0  #: index among all requested setpoints

    @property
    def step(self) -> float:
        """Target minus start."""
        return self.stretch - self.start

    @property
    def rests(self) -> float:
        """Planned rest at the target in s of the run."""
        return self.begin + self.arrival


@dataclass(frozen=True)
class Evaluation:
    """The results of a run."""

    #: timestamp in ns of time 0: the first level of the run, or the first sample without levels
    zero: int
    time: Array  #: times of the samples in s, shape (n,)
    start: float  #: stretch at rest before the first move
    levels: tuple[
        RecordedLevel, ...]  #: commands that took effect and changed the level, by timestamp
    moves: tuple[CommandedMove, ...]  #: setpoints
    results: tuple[MoveResult, ...]  #: one per move
    recorded: TimeCurve  #: through the samples
    #: simulated for unshaped steps; NaN without a move, and for steps too large or too long to
    #: simulate
    plain: TimeCurve
    plan: tuple[
        RecordedLevel, ...]  #: planned changes of level that were not replanned, by timestamp
    #: predicted by the plan, at the samples and between them; NaN before and without a plan
    planned: TimeCurve
    findings: tuple[Finding, ...] = ()  #: one per requested setpoint
    tolerances: Tolerances = Tolerances()

    def allowed(self, result: MoveResult) -> float:
        """Return the tolerance of a setpoint, in stretch."""
        return self.tolerances.of(self.findings[result.place].setpoint)[0]

    def seconds(self, stamp: int) -> float:
        """Return a timestamp in s of the run."""
        return (stamp - self.zero) / NANOSECONDS


def judged_from(finding: Finding, settled: float) -> float:
    """
    Return the time of the first judged sample in s from the start of the move.

    A setpoint that has not arrived, and settled, as requested is judged from the arrival of its
    newest plan on.
    """
    setpoint = finding.setpoint
    asked, moved = (math.nan if x is None else (x - setpoint.begins) / NANOSECONDS
                    for x in (setpoint.rests_from, setpoint.moved))
    followed = finding.arrived and not asked < min(moved, settled)
    return asked if followed or math.isnan(moved) else moved


def verdicts(evaluations: Sequence[Evaluation], number: int) -> str:
    """Return the different verdicts on a move in several runs, each after a comma."""
    places = [(x, x.results[number].place) for x in evaluations if number < len(x.results)]
    return ''.join(f', {x}' for x in dict.fromkeys(
        verdict_on(found, i) for found, i in places if i < len(found.findings)))


def verdict_on(evaluation: Evaluation, number: int) -> str:
    """
    Return the verdict on a setpoint in words.

    An unshaped step is judged once its vibration has faded: the words say that it rang before.
    """
    finding, result = evaluation.findings[number], result_of(evaluation, number)
    setpoint, words = finding.setpoint, str(finding.verdict).replace('_', ' ')
    rang = setpoint.newest_arrival is None and setpoint.decay < setpoint.frequency and (
        result is not None and not result.settled <= result.arrival)
    return f'{words} after ringing' if finding.arrived and rang else words


def result_of(evaluation: Evaluation, number: int) -> MoveResult | None:
    """Return the result of a setpoint; None without an arrival in the recording."""
    return next((x for x in evaluation.results if x.place == number), None)


def evaluate(run: Run, tolerances: Tolerances | None = None) -> Evaluation:
    """Evaluate a run with the given tolerances, by default those of its planner."""
    levels = in_force((x,) for x in without_repeats(run.accepted)[0])
    plan = in_force(run.plans)
    asked = setpoints_of(run)
    first = _first(run, levels, asked)
    start = asked[0].setpoint.start if asked else start_of(run, first)
    found = tuple(find_moves(run, levels, asked))
    time = (run.time - first) / NANOSECONDS
    period = run.plant.period
    plain = _plain(run, time, found, first, start)
    recorded = through(TimeCurve(time, run.stretch, run.rate), period)
    tolerances = tolerances or tolerances_of(run)
    results = [_measure(
        run, time, recorded, plain, x, first, asked[x.place].setpoint, tolerances) for x in found]
    stamps = run.time
    if plan:
        between = np.rint(fine(time, period) * NANOSECONDS).astype(np.int64) + first
        stamps = np.unique(np.concatenate([run.time, between, [
            x.stamp for x in plan if run.time[0] <= x.stamp <= run.time[-1]]]).astype(np.int64))
    return Evaluation(
        first, time, start, levels, found, tuple(results), recorded, plain, plan,
        TimeCurve((stamps - first) / NANOSECONDS, *_predict(run, plan, stamps)),
        tuple(findings_of(run, tolerances, asked=asked)), tolerances)


def _first(run: Run, levels: Sequence[RecordedLevel], asked: Sequence[Outcome]) -> int:
    """Return the begin of the first level in ns, skipping the level that an earlier run left."""
    begins = asked[0].setpoint.begins if asked else int(run.time[0])
    later = [x for x in levels if x.stamp >= begins]
    if not later:
        return levels[0].stamp if levels else int(run.time[0])
    before = int(np.searchsorted(run.time, later[0].stamp)) - 1
    held = next((x.flux_density for x in reversed(levels) if x.stamp < begins), float(
        run.flux_density[before]) if before >= 0 else math.nan)
    return next((x for x in later if x.flux_density != held), later[0]).stamp


def find_moves(run: Run, levels: Sequence[RecordedLevel], setpoints: Sequence[Outcome]) -> list[
        CommandedMove]:
    """Return the moves whose planned arrival lies within the recording."""
    last = int(run.time[-1])
    moves = []
    for place, asked in enumerate(setpoints):
        setpoint, arrival = asked.setpoint, asked.arrival
        end = min(x for x in (setpoint.end, asked.until, last) if x is not None)
        inside = [x for x in levels if setpoint.begins <= x.stamp <= (arrival or end)]
        if asked.missed or setpoint.step <= SAME or not inside:
            continue
        if arrival is None:
            # An unshaped step has no arrival: take half a period, that of a two-step command.
            arrival = inside[0].stamp + round(math.pi / setpoint.frequency * NANOSECONDS)
            inside = [x for x in inside if x.stamp <= arrival]
        if arrival < end:
            moves.append(CommandedMove(
                setpoint.target, setpoint.start, inside[0].stamp, arrival, end,
                tuple(x.flux_density for x in inside), place))
    return moves


def _plain(
        run: Run, time: Array, moves: Sequence[CommandedMove], zero: int,
        start: float) -> TimeCurve:
    """Simulate unshaped steps, at the samples and between them."""
    nothing = TimeCurve(time, np.full_like(time, np.nan), np.full_like(time, np.nan))
    begins = np.array([(x.begin - zero) / NANOSECONDS for x in moves])
    if not moves or time[-1] - begins[0] > _MOST_PERIODS * run.plant.period:
        return nothing
    before = time[time < begins[0]]
    grid = fine(np.union1d(begins[:1], time[len(before):]), run.plant.period)
    lower, upper = stretch_limits(run.plant.nondimensional)
    margin = 1e-6 * (min(upper, 2.0) - lower)
    start = min(max(start, lower + margin), upper - margin)
    try:
        # With the amplifier, coil and elastomer of the run.
        stretch, rate, _ = response(
            replace(run.plant, creep=creep_of(run.parameters, run.joint)),
            _delivery(run, run.plant, 'plant'), begins,
            np.array([x.flux_densities[-1] for x in moves]), grid, start)
    except HmsaError:
        return nothing
    return TimeCurve(*(np.concatenate(x) for x in (
        (before, grid), (np.full_like(before, start), stretch), (np.zeros_like(before), rate))))


def _delivery(run: Run, actuator: ActuatorParameters, node: str) -> Delivery:
    """Return slew limit and lag between the levels of a node and the field."""
    unit = actuator.time_unit
    return Delivery(
        slew=run.number(f'{node}.slew_limit') / actuator.flux_density_unit * unit or math.inf,
        lag=run.coil_time_constant(node) / unit)


def _measure(
        run: Run, time: Array, recorded: TimeCurve, plain: TimeCurve, move: CommandedMove,
        zero: int,
        setpoint: RequestedSetpoint, tolerances: Tolerances) -> MoveResult:
    """Evaluate one setpoint."""
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
    allowed, _ = tolerances.of(setpoint)
    return MoveResult(
        stretch=move.stretch, start=move.start,
        b_p=float(signed_root(of_level(move.flux_densities[0]))),
        tau_p=(arrival - begin) / run.planner.time_unit,
        b_1=float(signed_root(of_level(move.flux_densities[-1]))), begin=begin,
        arrival=arrival - begin, end=end, error=error, residual=residual,
        residual_unshaped=unshaped,
        settled=_settled(recorded.between(begin, end), move.stretch, allowed) - begin,
        moved=moved, place=move.place)


def _settled(curve: TimeCurve, target: float, allowed: float) -> float:
    """Return the time in s from which a curve stays within a distance of the target; else NaN."""
    off = np.flatnonzero(np.abs(curve.stretch - target) > allowed)
    place = int(off[-1]) + 1 if len(off) else 0
    return float(curve.time[place]) if place < len(curve.time) else math.nan


def _predict(run: Run, plan: Sequence[RecordedLevel], stamps: Times) -> tuple[Array, Array]:
    """Return the stretch and rate that the plan predicts, simulated from point to point."""
    predicted = np.full((2, len(stamps)), np.nan)
    actuator: ActuatorParameters = run.planner
    creep = creep_of(run.parameters, run.joint, PLANNER)
    material = replace(actuator, creep=creep).nondimensional
    lower, upper = stretch_limits(material)
    # A recorded message can contain impossible stretches.
    plan = [x for x in plan if lower < x.stretch < upper]
    if not plan:
        return predicted[0], predicted[1]
    unit, delivery = actuator.time_unit, _delivery(run, actuator, 'planner')
    state = State(plan[0].stretch, load=float(elastic_force(plan[0].stretch, material)))
    for i, point in enumerate(plan):
        until = plan[i + 1].stamp if i + 1 < len(plan) else max(int(run.time[-1]), point.stamp)
        if until - point.stamp > _MOST_PERIODS * actuator.period * NANOSECONDS:
            continue
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
            # The plan was made with other parameters than the run contains.
            continue
    return predicted[0], predicted[1] / unit


@dataclass(frozen=True)
class PlanPoint:
    """A change of level in the plan and the recorded values there; NaN if not recorded."""

    time: float  #: in s of the run
    planned: float  #: flux density in T
    commanded: float  #: command with the same timestamp, in T
    stretch: float  #: predicted for the first sample at or after the change
    rate: float  #: predicted likewise, in 1/s
    recorded_stretch: float  #: of that sample
    recorded_rate: float
    deviation: float  #: largest difference of recorded and predicted stretch until the next point


def plan_points(run: Run, evaluation: Evaluation) -> list[PlanPoint]:
    """Compare the plan of a run with the recorded motion, by time."""
    commanded = {x.stamp: x.flux_density for x in evaluation.levels}
    planned = evaluation.planned.at(evaluation.time)
    stretch, rate = planned.stretch, planned.rate
    # The first sample of each point, then the end.
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
