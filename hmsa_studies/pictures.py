"""Figures of robustness."""

from collections.abc import Sequence
import math
from pathlib import Path

from matplotlib.axes import Axes
import numpy as np

from hmsa.report import looks, style
from hmsa.report.looks import LineStyle, Paper
from hmsa.table import percent
from hmsa_studies.robustness import Candidate, Case, ORDERED, Result

# Smaller residuals are drawn at this value.
_FLOOR = 1e-4
_SYMBOLS = {'G': '$G$', 'zeta': r'$\zeta$', 'J_lim': r'$J_\mathrm{lim}$'}
# Styles of orders of a shaper: fill of markers, and factor on the line width.
_ORDERS = (('full', 1.0), ('none', 0.7), ('left', 0.5), ('top', 0.5))
# Number of markers on a curve.
_MARKS = 5


def draw_robustness(
        paths: Path | Sequence[Path], case: Case, results: Sequence[Result],
        paper: Paper | None = None) -> None:
    """Draw the residuals of one move: over each error alone, and the worst of all together."""
    shown = [x for x in results if x.move is not None]
    curves = _looks([x.candidate for x in shown])
    errors = 100.0 * case.errors()
    paper = paper or Paper()
    names = list(case.parameters)
    cells = ['G', 'zeta', *(['J_lim'] if 'J_lim' in names else []), 'box']
    columns = paper.columns(2)
    if columns == 2:
        rows = [['G', 'zeta'], ['J_lim' if 'J_lim' in names else 'box', 'box']]
    else:
        rows = [[x] for x in cells]
    # In a single column the panels are lower, so that all fit on a page.
    height = 2.3 if columns > 1 else 1.6
    with style.picture(paths, 1.4 + height * len(rows) + 0.3 * (3 - columns), paper) as figure:
        figure.suptitle(
            f'{case.material.coordinate.name} {case.start:g} to {case.target:g}; '
            f'{_nominal(case)}')
        panels = figure.subplot_mosaic(rows)  # type: ignore[arg-type]
        for name, letter in zip(names, 'abc', strict=False):
            axes = panels[name]
            for place, (result, (look, order)) in enumerate(zip(shown, curves, strict=True)):
                fill, thin = _ORDERS[order % len(_ORDERS)]
                # Offset markers of different curves.
                every = max(len(errors) // _MARKS, 1)
                axes.plot(
                    errors, 100.0 * np.maximum(result.curves[name], _FLOOR),
                    **{**look.line(label=_label(result)), 'linewidth': thin * look.width},
                    marker=look.marker, fillstyle=fill, markersize=4.0, markeredgewidth=0.8,
                    markevery=(place * every // len(shown), every))
            axes.axvspan(-100.0 * case.box, 100.0 * case.box, color='#F2F2F2', zorder=0)
            axes.set_yscale('log')
            axes.set_ylim(100.0 * _FLOOR, 400.0)
            axes.set_xlim(errors[0], errors[-1])
            style.finish(
                axes, f'error in {_SYMBOLS[name]} alone (%)',
                style.axis('residual vibration', unit='% of step'), letter)
            axes.yaxis.minorticks_off()
        _bars(panels['box'], case, shown, [x for x, _ in curves], 'abcd'[len(names)])
        linear = [x.candidate.name for x in shown if x.candidate.linear]
        style.legend_below(
            figure, panels['G'], most=4,
            title=f'{", ".join(linear)}: linear, designed at the target' if linear else '')


def _nominal(case: Case) -> str:
    """Return a description of the model for a title."""
    material = case.material
    whose = rf'$J_\mathrm{{lim}}$ = {material.j_lim:g}' if material.law is None else (
        f'law {material.law.law}')
    return rf'nominal $\zeta$ = {material.zeta:.4g}, {whose}, $c_1$ = {material.c1:.4g}'


def _looks(candidates: Sequence[Candidate]) -> list[tuple[LineStyle, int]]:
    """Return the look of each candidate, and the index of its order."""
    orders = list(dict.fromkeys(x.order for x in candidates if x.shaper in ORDERED))
    return [
        (looks.SHAPERS.get(x.shaper, LineStyle(looks.BLACK)),
         orders.index(x.order) if x.shaper in ORDERED else 0) for x in candidates]


def draw_front(
        paths: Path | Sequence[Path], studies: Sequence[tuple[Case, Sequence[Result]]],
        paper: Paper | None = None) -> None:
    """Draw the worst residuals over the duration of a move, with a panel for each move."""
    paper = paper or Paper()
    columns = paper.columns(max(min(len(studies), 3), 1))
    rows = max(-(-len(studies) // columns), 1)
    with style.picture(paths, 1.0 + 2.5 * rows, paper) as figure:
        axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
        for place, (panel, (case, results)) in enumerate(zip(axes, studies, strict=False)):
            shown = [
                x for x in results if x.move is not None and math.isfinite(x.move.duration)]
            for result, (look, _) in zip(
                    shown, _looks([x.candidate for x in shown]), strict=True):
                _draw_point(figure, panel, result, look)
            panel.set_yscale('log')
            panel.margins(x=0.1, y=0.1)
            style.finish(
                panel, style.axis('move time', r'\tau'), style.axis(
                    'worst residual vibration', unit='% of step') if place % columns == 0 else '',
                'abcdefghi'[place] if 1 < len(studies) <= 9 else '')
            panel.yaxis.minorticks_off()
            panel.set_title(
                f'{case.material.coordinate.name} {case.start:g} to {case.target:g}',
                loc='right')
        for panel in axes[len(studies):]:
            panel.set_axis_off()
        case = studies[0][0]
        together = ', '.join(_SYMBOLS[x] for x in case.parameters)
        style.legend_below(
            figure, title=rf'filled: {together} within $\pm${100.0 * case.box:g} % together; '
            'open: $G$ alone; number: order', most=6)


def _draw_point(figure: style.Picture, panel: Axes, result: Result, look: LineStyle) -> None:
    """Draw one result: all errors together above, the modulus alone below, and the order."""
    both = [100.0 * max(x.residual, _FLOOR) for x in (result.worst, result.alone['G'])]
    panel.plot([result.arrival] * 2, both, color=look.colour, linewidth=0.7, zorder=2)
    for value, face in zip(both, (look.colour, 'white'), strict=True):
        panel.plot(
            [result.arrival], [value], color=look.colour, linestyle='none', marker=look.marker,
            markersize=5.5, markerfacecolor=face, zorder=3, label='_')
        figure.remember(
            panel, f'{result.candidate.name}, {"G alone" if face == "white" else "all"}',
            [result.arrival], [value])
    if result.candidate.shaper in ORDERED:
        style.note(panel, f'{result.candidate.order}', (result.arrival, both[0]), (6, -3),
                   **style.SOFT)
    # A shaper of several orders has a single entry.
    name = result.candidate.name.partition(',')[0]
    if name not in panel.get_legend_handles_labels()[1]:
        panel.plot([], [], color=look.colour, linestyle='none', marker=look.marker,
                   markersize=5.5, label=name)


def _label(result: Result) -> str:
    """Return the label of a curve, with the code of a shaper that fell back."""
    name = result.candidate.name
    return f'{name}: {result.code}' if result.reason else name


def _bars(
        axes: Axes, case: Case, results: Sequence[Result], curves: Sequence[LineStyle],
        letter: str) -> None:
    """Draw the worst residuals in the box of all errors."""
    worst = np.array([x.worst.residual for x in results])
    lengths = 100.0 * np.nan_to_num(np.maximum(worst, _FLOOR), nan=_FLOOR)
    places = np.arange(len(results))
    axes.barh(
        places, lengths, color=[x.colour for x in curves], height=0.62, zorder=2)
    for place, length, value in zip(places, lengths, worst, strict=True):
        axes.annotate(
            percent(value), (float(length), float(place)), xytext=(3, 0),
            textcoords='offset points', va='center', fontsize='small')
    axes.set_xscale('log')
    axes.set_xlim(100.0 * _FLOOR, 1000.0)
    axes.set_yticks(places, [x.candidate.name for x in results])
    axes.set_ylim(len(results) - 0.4, -0.6)
    style.finish(
        axes, rf'worst case within $\pm${100.0 * case.box:g} % (% of step)', '', letter)
    axes.xaxis.minorticks_off()
    axes.yaxis.minorticks_off()
    axes.grid(visible=False, axis='y')
