"""Results of each requested setpoint and of each level of a run."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from hmsa.interfaces.outcome import Outcome
from hmsa.interfaces.parameters import number_of
from hmsa.judge.records import Finding, SensorModel, Tolerances, unobserved
from hmsa.judge.setpoint_samples import SetpointSamples
from hmsa.model.equations import equilibrium_stretch
from hmsa.model.status import Code
from hmsa.model.units import NANOSECONDS
from hmsa.runs.parameters import of_joint
from hmsa.runs.record import Run
from hmsa.runs.setpoints import setpoints_of
from hmsa.table import Column, Table

_CUT_SHORT = 'the samples end before its arrival'
_SENSOR = SensorModel()
# Later than any timestamp, in ns.
_END = 2**62
# Maximum number of rows in the table of levels.
_MOST_LEVELS = 12


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
