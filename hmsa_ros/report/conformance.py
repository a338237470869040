"""A trial of hardware as one HTML page: checks, and histograms of times."""

from html import escape

import numpy as np

from hmsa_ros import __version__
from hmsa_ros.device.conformance import Conformance
from hmsa_ros.model.equations import Array
from hmsa_ros.report.charts import axis, Figure, label
from hmsa_ros.report.curves import numbers
from hmsa_ros.report.looks import BLUE
from hmsa_ros.report.page import document, placed, text
from hmsa_ros.report.tables import cell, table

_BINS = 40


def page(found: Conformance) -> str:
    """Return the HTML page of a trial."""
    figures = [_histogram(name, x * 1e3) for name, x in found.durations.items() if len(x)]
    failed = sum(not x.passed for x in found.checks)
    body = [
        f'<h1>{escape(found.name)}: check of the driver</h1>',
        '<div class="tiles">' + ''.join(
            f'<div><b>{x}</b><span>{y}</span></div>' for x, y in (
                ('passed' if found.passed else 'failed', 'verdict'),
                (len(found.checks) - failed, 'checks passed'), (failed, 'checks failed'),
                (len(found.untried), 'not tried'))) + '</div>',
        '<ul class="notes">' + ''.join(
            f'<li>not tried: {escape(x)}</li>' for x in found.untried) + '</ul>',
        '<section id="checks-section"><h2>Checks</h2>' + table(
            'checks', 'A figure must not exceed its limit.',
            ('check', 'result', 'figure', 'limit', 'unit', 'finding'),
            [[x.name, 'passed' if x.passed else 'FAILED', cell(x.figure, '.3g'),
              cell(x.limit, '.3g'), x.unit, x.sentence] for x in found.checks]) + '</section>',
        '<section id="times"><h2>Times</h2>' + text(
            'Duration of each call, and how long after their times the levels took effect.')
        + ''.join(placed(x, x.alt) for x in figures) + '</section>',
        f'<footer class="soft"><p>Written by hmsa_ros {__version__}.</p></footer>']
    return document(f'{found.name} – check of the driver', body, figures)


def _histogram(name: str, times: Array) -> Figure:
    counts, edges = np.histogram(times, bins=_BINS)
    title = 'lateness of levels' if name == 'lateness' else f'duration of {name}'
    return Figure(f'times-{name}', title, 240, [{
        'type': 'bar', 'x': numbers((edges[1:] + edges[:-1]) / 2), 'y': numbers(counts),
        'width': numbers(np.diff(edges)), 'marker': {'color': BLUE}}], {
        'xaxis': axis(label(title, unit='ms')), 'yaxis': axis('number')})
