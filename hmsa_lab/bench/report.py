"""Pictures of a calibration, and the HTML page of a driver check."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hmsa.identification.delays import Delays, response
from hmsa.model.equations import Array
from hmsa.report import looks, style
from hmsa.report.figures import Axis, Curve, Figure, Panel
from hmsa.report.looks import BLACK, BLUE, LineStyle, Paper
from hmsa.report.page import document
from hmsa.table import Column, Table
from hmsa_lab.bench.calibration import CoilCalibration, Statics
from hmsa_lab.bench.conformance import Conformance

_LINE = 400
# Of the panel, relative to those of a run.
_HEIGHT = 2.2
# End of the figure in lags after the transport delay, and its minimum in s.
_LAGS, _SHORTEST = 8.0, 2e-3

_BINS = 40


def _draw(
        paths: Sequence[Path], axes: tuple[Axis, Axis], points: tuple[Array, Array],
        line: tuple[Array, Array], paper: Paper) -> None:
    style.sheet(paths, [[[Panel(*axes, [
        Curve('fit', looks.RECORDED, *line),
        Curve('measured', looks.LineStyle(BLACK, marker='o', size=2.5, order=4), *points,
              'points')], height=_HEIGHT)]]], paper)


def draw_coil(
        paths: Sequence[Path], current: Array, flux_density: Array, found: CoilCalibration,
        paper: Paper) -> None:
    """Draw readings in T over currents in A, and the mean at each."""
    _draw(paths, (Axis('current', 'I', 'A'), Axis('flux density', 'B', 'mT')),
          (current, 1e3 * flux_density),
          (found.current, 1e3 * (found.flux_density + found.offset)), paper)


def draw_delays(paths: Sequence[Path], found: Delays, paper: Paper) -> None:
    """Draw the response of the field to its level; without a probe, the stretch and its fit."""
    seen = found.field
    if seen is None:
        motion = found.motion
        _draw(paths, (Axis('time', 't', 's'), Axis('stretch', 'λ', tex=r'\lambda')),
              (motion.recording.time, motion.recording.stretch),
              (motion.recording.time, motion.fit.response.stretch), paper)
        return
    end = max(seen.transport.value + _LAGS * seen.lag.value, _SHORTEST)
    since, near = np.linspace(0.0, end, _LINE, dtype=np.float64), seen.since <= end
    _draw(paths, (Axis('time since the level', unit='ms'), Axis('fraction of the step')),
          (1e3 * seen.since[near], seen.share[near]),
          (1e3 * since, response(since, seen.transport.value, seen.lag.value)), paper)


def draw_statics(
        paths: Sequence[Path], level: Array, stretch: Array, found: Statics,
        paper: Paper) -> None:
    """Draw stretches over levels in T, and the mean of both branches."""
    _draw(paths, (Axis('flux density', 'B', 'mT'), Axis('stretch', 'λ', tex=r'\lambda')),
          (1e3 * level, stretch / found.rest), (1e3 * found.level, found.stretch), paper)


def page(found: Conformance) -> str:
    """Return the HTML page of a driver check."""
    figures = [_histogram(name, x * 1e3) for name, x in found.durations.items() if len(x)]
    failed = sum(not x.passed for x in found.checks)
    return document(
        Path(__file__).with_name('conformance.html'), f'{found.name} – check of the driver',
        figures, name=found.name,
        summary=(
            ('passed' if found.passed else 'failed', 'verdict'),
            (len(found.checks) - failed, 'checks passed'), (failed, 'checks failed'),
            (len(found.untried), 'not tried')),
        untried=[f'not tried: {x}' for x in found.untried],
        checks=Table(
            (Column('check'), Column('result'), Column('figure', form='.3g'),
             Column('limit', form='.3g'), Column('unit'), Column('finding')),
            tuple((x.name, 'passed' if x.passed else 'FAILED', x.figure, x.limit, x.unit,
                   x.sentence) for x in found.checks)))


def _histogram(name: str, times: Array) -> Figure:
    counts, edges = np.histogram(times, bins=_BINS)
    title = 'lateness of levels' if name == 'lateness' else f'duration of {name}'
    return Figure(f'times-{name}', title, [Panel(Axis(title, unit='ms'), Axis('number'), [
        Curve(title, LineStyle(BLUE), (edges[1:] + edges[:-1]) / 2, counts.astype(np.float64),
              'bars', listed=False)])], 240)
