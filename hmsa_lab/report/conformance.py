"""The HTML page of a driver check: checks, and histograms of durations."""

from pathlib import Path

import numpy as np

from hmsa.model.equations import Array
from hmsa.report.figures import Axis, Curve, Figure, Panel
from hmsa.report.looks import BLUE, LineStyle
from hmsa.report.page import document
from hmsa.table import Column, Table
from hmsa_lab.bench.conformance import Conformance

_BINS = 40


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
