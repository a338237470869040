"""Tables that compare runs."""

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np

from hmsa_ros.errors import BadInputError
from hmsa_ros.recordings.record import Run
from hmsa_ros.report.arrivals import around, Part
from hmsa_ros.report.evaluation import judged_from, MoveResult
from hmsa_ros.report.looks import RUNS
from hmsa_ros.table import Column, Table


def labelled(runs: list[Run]) -> list[Run]:
    """Return the runs with unique labels."""
    labels = [x.label for x in runs]
    # Bags with the same name are in different folders, unless a bag is given twice.
    labels = [
        f'{run.path.resolve().parent.name}/{run.label}'
        if labels.count(run.label) > 1 and run.origin == 'recorded'
        else run.label for run in runs]
    return [
        replace(run, label=label if labels.count(label) == 1 else f'{label} ({i})')
        for i, (run, label) in enumerate(zip(runs, labels, strict=True), 1)]


def parts_of(runs: list[Run]) -> list[Part]:
    """Return evaluated runs with unique labels and, for several runs, different colours."""
    return [Part.of(run, RUNS[i % len(RUNS)] if len(runs) > 1 else '')
            for i, run in enumerate(labelled(runs))]


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
        (number + 1, label, *_measured(part, number), _apart(parts[0], part, number),
         _verdict(part, number))
        for number in range(count) for label, part in zip(labels, parts, strict=True)
        if number < len(part.evaluation.findings)]
    return Table(
        (Column('setpoint'), Column('run'), *_MEASURED, Column('apart', '%', '%'),
         Column('verdict')), tuple(rows),
        f'{_CAPTION}; apart: largest distance from the curve of {labels[0]}, from the start of '
        'the move on; in % of the step')


def setpoints(parts: Sequence[Part]) -> Table:
    """Return the results of each setpoint of a run; ``parts`` are its joints."""
    return Table(
        (Column('setpoint'), *_MEASURED, Column('frequency', 'Hz', '.3g', 'f'),
         Column('verdict')),
        tuple((
            f'{x.setpoint.joint} {x.setpoint.number}' if x.setpoint.joint else x.setpoint.number,
            *_measured(part, number), x.frequency, _verdict(part, number))
            for part in parts for number, x in enumerate(part.evaluation.findings)),
        f'{_CAPTION}; f: frequency of the vibration; in % of the step')


_MEASURED = (
    Column('target'), Column('move time', 'ms', '.4g'), Column('residual', '%', '%'),
    Column('judged from', 'ms', '.4g'), Column('offset', '%', '+%'),
    Column('offset std', '%', '%', '±'), Column('vibration', '%', '%'),
    Column('vibration std', '%', '%', '±'))
_CAPTION = (
    'move time: from the first level to planned rest, half a period for an unshaped step; '
    'residual: peak to peak from then on; judged from: start of the samples that decide the '
    'verdict, for an unshaped step once its vibration should have faded; offset: their mean less '
    'the target; vibration: peak to peak in their first period; ±: standard deviations')


def _measured(part: Part, number: int) -> tuple[float, ...]:
    """Return the values of the columns `_MEASURED`; NaN if not measured."""
    found, result = part.evaluation.findings[number], _result(part, number)
    return (
        found.setpoint.target, *((math.nan, math.nan) if result is None else (
            1e3 * result.arrival, 100.0 * result.residual)), 1e3 * judged_from(found),
        *(found.setpoint.percent(x) for x in (
            found.offset, found.offset_std, found.vibration, found.vibration_std)))


def _verdict(part: Part, number: int) -> str:
    return str(part.evaluation.findings[number].verdict).replace('_', ' ')


def _result(part: Part, number: int) -> MoveResult | None:
    """Return the result of a setpoint; None without an arrival in the recording."""
    return next((x for x in part.evaluation.results if x.place == number), None)


def _apart(first: Part, part: Part, number: int) -> float:
    """Return the largest distance of two curves around an arrival, in percent of the step."""
    reference, move = _result(first, number), _result(part, number)
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
