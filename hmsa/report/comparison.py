"""Compare runs: timing of commands and samples, arrivals of moves, statistics of repeats."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import Any

import numpy as np

from hmsa.errors import BadInputError
from hmsa.judge.records import Finding, Tolerances
from hmsa.model.equations import Array
from hmsa.model.units import NANOSECONDS
from hmsa.report.evaluation import (
    evaluate,
    Evaluation,
    judged_from,
    MoveResult,
    result_of,
    verdict_on,
    verdicts,
)
from hmsa.report.figures import TimeCurve
from hmsa.runs.record import lateness_of, RecordedLevel, Run, Times, without_repeats
from hmsa.table import Column, DEVIATION, percent, Table

# A change of level that took effect within this time in s of its timestamp was on time: the clock
# of a board with a schedule of its own is known to a few us.
_PUNCTUAL = 1e-5


@dataclass(frozen=True)
class Timing:
    """Timing of commands and samples; all arrays are in s."""

    commands: tuple[RecordedLevel, ...]  #: commands that change the level, in the order received
    repeats: int  #: number of commands that repeat the level
    #: Shape (m,): timestamp minus recording time of each command; below 0 if late. Empty if
    #: recorder and timestamps used different clocks.
    lead: Array
    #: Shape (k,): time at which each change of level took effect, as the plant or the driver
    #: reported, minus its timestamp; NaN if not reported. Empty without any report.
    lateness: Array
    delay: Array  #: shape (n,): recording time minus timestamp of each sample; or empty
    interval: Array  #: shape (n - 1,): between consecutive timestamps of samples
    arrival_interval: Array  #: shape (n - 1,): between consecutive recording times
    missing: int  #: number of samples that would fill the gaps in the timestamps
    unapplied: int  #: changes of level that were due and were not reported as taking effect

    @property
    def late(self) -> int:
        """Number of commands that took effect late; without reports, that were recorded late."""
        if len(self.lateness):
            return int(np.count_nonzero(self.lateness > _PUNCTUAL))
        return int(np.count_nonzero(self.lead < 0.0))


def timing(run: Run) -> Timing:
    """Return the timing of the commands and samples of a run."""
    commands, repeats = without_repeats(run.accepted)
    delay = (run.logged - run.time) / NANOSECONDS
    interval = np.diff(run.time) / NANOSECONDS
    lead = np.array([x.stamp - x.sent for x in commands], dtype=np.int64) / NANOSECONDS
    if not run.one_clock:
        delay, lead = np.empty(0), np.empty(0)
    recorded: Times = np.sort(run.logged)
    usual = float(np.median(interval)) if len(interval) else math.inf
    gaps = np.rint(interval / usual) - 1.0
    lateness, unapplied = lateness_of(commands, run.applied, int(run.time[-1]))
    return Timing(
        commands, repeats, lead, lateness, delay, interval, np.diff(recorded) / NANOSECONDS,
        int(np.sum(gaps[gaps > 0.0])) if len(interval) else 0, unapplied)


# Data of an arrival's panel, from the begin of the move, in durations of the move.
_PANEL_SPAN = 20.0
# Initial view of that panel, in durations of the move.
_SHOWN = 4.0
#: Shown in place of a residual.
NOT_MOVED = 'did not move'


@dataclass(frozen=True)
class Part:
    """One run of a report."""

    run: Run
    evaluation: Evaluation
    timing: Timing

    @classmethod
    def of(cls, run: Run, tolerances: Tolerances | None = None) -> 'Part':
        """Evaluate a run with the given tolerances, by default those of its planner."""
        return cls(run, evaluate(run, tolerances), timing(run))


def worst(parts: Sequence[Part], most: int) -> list[int]:
    """Return the indices of the setpoints with the largest residual vibration, sorted."""
    count = max((len(x.evaluation.results) for x in parts), default=0)
    ranked = sorted(range(count), key=lambda i: -max(
        (x.residual if x.moved else math.inf for x in results_of(parts, i)
         if math.isfinite(x.residual) or not x.moved), default=0.0))
    return sorted(ranked[:most])


def results_of(parts: Sequence[Part], number: int) -> list[MoveResult]:
    """Return the results of one setpoint in all runs that have it."""
    return [x.evaluation.results[number] for x in parts
            if number < len(x.evaluation.results)]


def residual_text(results: Sequence[MoveResult], *, least: bool = False) -> str:
    """Return the largest residual vibration of several moves as text, or the range with least."""
    if not all(x.moved for x in results):
        return NOT_MOVED
    shares = [x.residual for x in results if math.isfinite(x.residual)]
    if not shares:
        return '–'
    return ' to '.join(dict.fromkeys(
        f'{percent(x)} %' for x in ([min(shares)] if least else []) + [max(shares)]))


def left_text(results: Sequence[MoveResult], *, least: bool = False) -> str:
    """Return the residual vibration of several moves as text for a heading."""
    text = residual_text(results, least=least)
    return text if text == NOT_MOVED else f'residual {text}'


def around(x: MoveResult, curve: TimeCurve) -> tuple[Array, Array]:
    """Return a curve around an arrival: time in the move in s, and error in % of the step."""
    inside = curve.between(x.begin, min(x.end, x.begin + _PANEL_SPAN * max(x.arrival, 1e-9)))
    return inside.time - x.begin, 100.0 * (inside.stretch - x.stretch) / abs(x.step)


def span(parts: Sequence[Part], number: int) -> float:
    """Return the length of an arrival's panel in s."""
    return max((
        min(x.end - x.begin, _SHOWN * x.arrival) for x in results_of(parts, number)), default=1.0)


def title(parts: Sequence[Part], number: int) -> str:
    """Return the heading of an arrival."""
    results = results_of(parts, number)
    targets = ', '.join(dict.fromkeys(f'{x.stretch:.6g}' for x in results))
    said = verdicts([x.evaluation for x in parts], number)
    left = left_text(results, least=True)
    return f'{results[0].place + 1}. to {targets}: {left}{said}'


def labelled(runs: list[Run]) -> list[Run]:
    """Return the runs with unique labels."""
    labels = [x.label for x in runs]
    # Bags with the same name are in different folders, unless a bag is given twice.
    labels = [
        f'{run.path.resolve().parent.name}/{run.label}'
        if labels.count(run.label) > 1 and run.summary is not None
        else run.label for run in runs]
    return [
        replace(run, label=label if labels.count(label) == 1 else f'{label} ({i})')
        for i, (run, label) in enumerate(zip(runs, labels, strict=True), 1)]


def parts_of(runs: list[Run]) -> list[Part]:
    """Return evaluated runs with unique labels."""
    return [Part.of(run) for run in labelled(runs)]


def comparison(parts: Sequence[Part]) -> Table:
    """
    Return the results of each setpoint in each run, and its distance from the first run's curve.

    Raises
    ------
    BadInputError
        If no run has a setpoint.

    """
    count = max(len(x.evaluation.findings) for x in parts)
    if not count:
        raise BadInputError(
            f'{", ".join(x.run.label for x in parts)} have no setpoint: expected runs with '
            'requests or levels that hold a stretch')
    labels = [x.label for x in labelled([x.run for x in parts])]
    rows = [
        (number + 1, label, *_measured(part, number), _apart(parts[0], part, number))
        for number in range(count) for label, part in zip(labels, parts, strict=True)
        if number < len(part.evaluation.findings)]
    return Table(
        (Column('setpoint'), Column('run'), *_MEASURED, Column('apart', '%', '%')), tuple(rows),
        _CAPTION, tuple(
            f'{label}, {note}' for label, part in zip(labels, parts, strict=True)
            for note in _open(part)), (*_LEGEND, (
                'apart', f'largest distance from the curve of {labels[0]} after the start of the '
                'move')))


def setpoints(parts: Sequence[Part]) -> Table:
    """Return the results of each setpoint of a run; ``parts`` are its joints."""
    return Table(
        (Column('setpoint'), *_MEASURED, Column('frequency', 'Hz', '.3g', 'f')),
        tuple((
            f'{x.setpoint.joint} {x.setpoint.number}' if x.setpoint.joint else x.setpoint.number,
            *_measured(part, number), x.frequency)
            for part in parts for number, x in enumerate(part.evaluation.findings)),
        _CAPTION, tuple(note for part in parts for note in _open(part)),
        (*_LEGEND, ('f', 'frequency of the vibration')))


def _open(part: Part) -> list[str]:
    """Return why setpoints of a run have no verdict."""
    return [x.message for x in part.evaluation.findings if x.open]


def ringing(parts: Sequence[Part]) -> str:
    """Return how long unshaped steps rang before they arrived, as the end of a sentence."""
    rang = [result_of(x.evaluation, i) for x in parts for i in range(len(x.evaluation.findings))
            if verdict_on(x.evaluation, i).endswith('ringing')]
    most = max((x.settled for x in rang if x is not None), default=math.nan)
    return f', unshaped steps after ringing for up to {1e3 * most:.3g} ms' if rang else ''


_MEASURED = (
    Column('target'), Column('move time', 'ms', '.4g'),
    Column('settling time', 'ms', '.4g', 'settled'), Column('residual', '%', '%'),
    Column('verdict'),
    Column('judged from', 'ms', '.4g'), Column('offset', '%', '+%'),
    Column('offset std', '%', '%', DEVIATION), Column('vibration', '%', '%'),
    Column('vibration std', '%', '%', DEVIATION))
_CAPTION = 'percentages are of the step'
_LEGEND = (
    ('move time', 'from the first level to planned rest; half a period for an unshaped step'),
    ('settled', 'time after which the stretch stays within arrival_tolerance of the target'),
    ('residual', 'peak to peak after the move time'),
    ('judged from', 'start of the samples that decide the verdict; for an unshaped step, after '
                    'its vibration should have decayed'),
    ('offset', 'mean of these samples minus the target'),
    ('vibration', 'peak to peak in their first period'), (DEVIATION, 'standard deviation'))


def _measured(part: Part, number: int) -> tuple[float | str, ...]:
    """Return the values of the columns `_MEASURED`; NaN if not measured."""
    found, result = part.evaluation.findings[number], result_of(part.evaluation, number)
    return (
        found.setpoint.target, *((math.nan,) * 3 if result is None else (
            1e3 * result.arrival, 1e3 * result.settled, 100.0 * result.residual)),
        verdict_on(part.evaluation, number),
        1e3 * judged_from(found, math.inf if result is None else result.settled),
        *(found.setpoint.percent(x) for x in (
            found.offset, found.offset_std, found.vibration, found.vibration_std)))


def _apart(first: Part, part: Part, number: int) -> float:
    """Return the largest distance of two curves around an arrival, in percent of the step."""
    reference, move = (result_of(x.evaluation, number) for x in (first, part))
    if part is first or reference is None or move is None:
        return math.nan
    (time, off), (other, values) = (
        (time[np.isfinite(off)], off[np.isfinite(off)]) for time, off in (
            around(reference, first.evaluation.recorded), around(move, part.evaluation.recorded)))
    if len(other) < 2 or len(time) < 2:
        return math.nan
    inside = (time >= other[0]) & (time <= other[-1])
    # Each curve is in percent of its own step, relative to its own target.
    step = abs(reference.step)
    shift = 100.0 * (move.stretch - reference.stretch) / step
    away = np.interp(time[inside], other, values) * abs(move.step) / step + shift - off[inside]
    return float(np.max(np.abs(away), initial=0.0))


def repeats_in(folder: Path) -> list[Path]:
    """Return the bags of the repeats that ``hmsa run --repeat`` wrote in a folder, in order."""
    if (folder / 'metadata.yaml').exists() or not folder.is_dir():
        return []
    return sorted((x for x in folder.glob('*/run') if x.parent.name.isdecimal()),
                  key=lambda x: int(x.parent.name))


def statistics(each: Sequence[Sequence[Finding]]) -> list[dict[str, Any]]:
    """
    Return statistics of vibration and steady-state error, in % of the step, by setpoint.

    They are the mean, the standard deviation, and the value of the largest size.
    """
    found = []
    for group in zip(*each, strict=False):
        row: dict[str, Any] = {
            'joint': group[0].setpoint.joint, 'setpoint': group[0].setpoint.number,
            'target': group[0].setpoint.target, 'repeats': len(group),
            'arrived': sum(x.arrived for x in group)}
        for name in ('vibration', 'offset'):
            values = np.array([x.setpoint.percent(getattr(x, name)) for x in group])
            values = values[np.isfinite(values)]
            row[f'{name}_percent'] = {
                'mean': float(np.mean(values)) if len(values) else None,
                'std': float(np.std(values, ddof=1)) if len(values) > 1 else None,
                'largest': float(values[np.argmax(np.abs(values))]) if len(values) else None}
        found.append(row)
    return found


def statistics_table(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> Table:
    """
    Return a table of the statistics of one or more runs, by setpoint and label.

    Raises
    ------
    BadInputError
        If no run has a setpoint.

    """
    rows = []
    for place in range(max(map(len, runs.values()), default=0)):
        for label, found in runs.items():
            if place < len(found):
                x = found[place]
                figures = [x[f'{y}_percent'][z] for y in ('vibration', 'offset')
                           for z in ('mean', 'std', 'largest')]
                rows.append((
                    f'{x["joint"]} {x["setpoint"]}'.strip(), *([label] if len(runs) > 1 else []),
                    x['target'], f'{x["arrived"]} of {x["repeats"]}',
                    *(math.nan if y is None else y for y in figures)))
    if not rows:
        raise BadInputError(
            f'{", ".join(runs)} have no setpoint: expected repeats of a sequence of setpoints')
    return Table(
        (Column('setpoint'), *([Column('run')] if len(runs) > 1 else []), Column('target'),
         Column('arrived'), *(
            Column(f'{y}{z}', '', '.3g') for y in ('vibration', 'offset')
            for z in ('', ' std', ' max'))), tuple(rows),
        'over the repeats: mean, standard deviation and largest; in % of the step')
