"""
Draw runs on paper: command, response, phase plane, and the largest errors at arrivals.

Repeats of a run are drawn as a mean and a band.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hmsa.errors import BadInputError
from hmsa.model.equations import Array
from hmsa.report import charts, looks, style
from hmsa.report.charts import error_axis
from hmsa.report.comparison import around, Part, results_of, span
from hmsa.report.figures import Axis, Curve, Panel
from hmsa.report.looks import NARROW, Paper, WIDE

# Panels that share the axis of time, above each other; those beside them; and those below, beside
# each other.
_OVER_TIME, _BESIDE, _BELOW = ('command', 'response', 'plan', 'timing'), ('phase', 'residual'), (
    'error',)

# Points of a band.
_POINTS = 400


def draw(
        paths: Path | Sequence[Path], parts: Sequence[Part],
        paper: Paper | None = None) -> style.Picture:
    """
    Draw runs with as many arrivals as fit side by side; return the figure.

    Raises
    ------
    BadInputError
        If the runs have no data for a panel, or a file cannot be written.

    """
    paper = paper or Paper()
    columns = paper.columns(3)
    panels = {
        x: charts.errors(parts, columns) if x == 'error' else charts.PANELS[x](parts)
        for x in paper.panels or (WIDE if columns > 1 else NARROW)}
    for name in paper.panels:
        if not panels[name]:
            raise BadInputError(
                f'panel {name} of {", ".join(x.run.label for x in parts)} would be empty: '
                'expected setpoints, a plan that differs from the run, or times that vary; leave '
                'it out')
    return style.sheet(paths, _arranged(panels, columns), paper)


def _arranged(panels: dict[str, list[Panel]], columns: int) -> list[list[list[Panel]]]:
    """Return rows of columns of panels above each other."""
    if columns == 1:
        return [[[x for group in panels.values() for x in group]]]
    left, right, below = (
        [x for name, group in panels.items() if name in names for x in group]
        for names in (_OVER_TIME, _BESIDE, _BELOW))
    above = [x for x in (left, right) if x]
    return [*([above] if above else []), *([[[x] for x in below]] if below else [])]


def draw_bands(
        paths: Sequence[Path], groups: Mapping[str, Sequence[Part]],
        paper: Paper) -> style.Picture:
    """Draw each arrival: the mean of the repeats of each run, with a band of one std."""
    count = max(len(x.evaluation.results) for group in groups.values() for x in group)
    panels = [_panel(groups, i) for i in range(count)]
    columns = paper.columns(3)
    return style.sheet(paths, [
        [[x] for x in panels[i:i + columns]] for i in range(0, count, columns)], paper)


def _panel(groups: Mapping[str, Sequence[Part]], number: int) -> Panel:
    """Describe the error around one arrival, in ms and percent of the step."""
    parts = [x for group in groups.values() for x in group]
    end = span(parts, number)
    grid = np.linspace(0.0, end, _POINTS).astype(np.float64)
    curves = [curve for place, (label, group) in enumerate(groups.items())
              for curve in _band(looks.case(place), label, grid, _curves(group, number, grid))]
    targets = dict.fromkeys(f'{x.stretch:.5g}' for x in results_of(parts, number))
    return Panel(
        Axis('time in the move', unit='ms', limits=(0.0, 1e3 * end)),
        error_axis(curves, 1e3 * end), curves, f'to {"/".join(targets)}', 1.3)


def _curves(group: Sequence[Part], number: int, grid: Array) -> Array:
    """Return the error in % of the step of each repeat, shape (k, n); NaN where unknown."""
    found = []
    for part in group:
        for result in part.evaluation.results[number:number + 1]:
            time, off = around(result, part.evaluation.recorded)
            known = np.isfinite(off)
            if np.count_nonzero(known) > 1:
                found.append(np.interp(grid, time[known], off[known], np.nan, np.nan))
    return np.array(found).reshape(-1, len(grid))


def _band(look: looks.LineStyle, label: str, grid: Array, curves: Array) -> list[Curve]:
    """Describe the mean of curves, with a band of one std on both sides."""
    known = np.isfinite(curves).all(axis=0) if len(curves) else np.zeros(len(grid), dtype=bool)
    if not known.any():
        return []
    time, curves = 1e3 * grid[known], curves[:, known]
    mean = np.mean(curves, axis=0)
    described = [Curve(f'{label} ({len(curves)})', look, time, mean)]
    if len(curves) > 1:
        std = np.std(curves, axis=0, ddof=1)
        described.append(Curve(
            f'{label}, mean ± std', replace(look, opacity=0.25, order=1), time, mean + std, 'band',
            lower=mean - std, listed=False))
    return described
