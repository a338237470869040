"""Draw the curves of repeated sequences as a mean and a band."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np

from hmsa.model.equations import Array
from hmsa.report import looks, style
from hmsa.report.arrivals import around, Part, results_of, span
from hmsa.report.paper import Paper

_POINTS = 400


def draw_bands(
        paths: Sequence[Path], groups: Mapping[str, Sequence[Part]], paper: Paper) -> Any:
    """Draw each arrival: the mean of the repeats of each run, with a band of one std."""
    parts = [x for group in groups.values() for x in group]
    count = max(len(x.evaluation.results) for x in parts)
    columns = min(paper.columns(3), max(count, 1))
    rows = max(-(-count // columns), 1)
    with style.picture(paths, (0.5 + 1.6 * rows) * paper.letters / 8.0, paper) as figure:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel in panels[count:]:
            panel.set_visible(False)
        for number, panel in enumerate(panels[:count]):
            grid = np.linspace(0.0, span(parts, number), _POINTS).astype(np.float64)
            for place, (label, group) in enumerate(groups.items()):
                _draw_band(figure, panel, looks.case(place), label, grid, _curves(
                    group, number, grid))
            panel.axhline(0.0, **style.TARGET)
            style.finish(
                panel, style.axis('time in the move', unit='ms'), style.axis(
                    'error', unit='% of step') if number % columns == 0 else '',
                ascii_lowercase[number % 26])
            targets = dict.fromkeys(f'{x.stretch:.5g}' for x in results_of(parts, number))
            panel.set_title(f'to {"/".join(targets)}', loc='right', fontsize='small')
        style.legend_below(figure, *panels[:count])
    return figure


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


def _draw_band(
        figure: style.Picture, panel: Any, look: looks.LineStyle, label: str, grid: Array,
        curves: Array) -> None:
    known = np.isfinite(curves).all(axis=0) if len(curves) else np.zeros(len(grid), dtype=bool)
    if not known.any():
        return
    time, curves = 1e3 * grid[known], curves[:, known]
    mean = np.mean(curves, axis=0)
    panel.plot(time, mean, **look.line(), label=f'{label} ({len(curves)})')
    if len(curves) > 1:
        std = np.std(curves, axis=0, ddof=1)
        panel.fill_between(time, mean - std, mean + std, color=look.colour, alpha=0.25, lw=0.0)
        for sign, name in ((-1.0, 'mean - std'), (1.0, 'mean + std')):
            figure.remember(panel, f'{label}, {name}', time, mean + sign * std)
