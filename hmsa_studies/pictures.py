"""Figures of the studies: robustness, sampled hardware, heavy damping."""

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
import numpy as np

from hmsa.model.equations import critical_zeta, elastic_force
from hmsa.model.moves import Move, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.residual import percent
from hmsa.planning.shapers.linear import step
from hmsa.planning.shapers.minimum_time import minimum_time
from hmsa.planning.shapers.request import MoveRequest
from hmsa.report import looks, style
from hmsa.report.looks import LineStyle
from hmsa.report.paper import Paper
from hmsa_studies.residual import (
    Actual,
    DampedStudy,
    ideal_move,
    LIMITS,
    limits_of,
    PROMISED,
    rounded_move,
    SampledStudy,
    SETTLED,
    solved_move,
)
from hmsa_studies.robustness import Candidate, Case, ORDERED, Result

# Smaller residuals are drawn at this value.
_FLOOR = 1e-4
_SYMBOLS = {'G': '$G$', 'zeta': r'$\zeta$', 'J_lim': r'$J_\mathrm{lim}$'}
# Styles of orders of a shaper: fill of markers, and factor on the line width.
_ORDERS = (('full', 1.0), ('none', 0.7), ('left', 0.5), ('top', 0.5))
# Number of markers on a curve.
_MARKS = 5
# Smaller fractions of a step are rounding of the search on a grid.
_RESOLVED = 1e-8


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


def draw_sampled(
        path: Path, study: SampledStudy, paper: Paper | None = None, *,
        period: float = 0.28) -> None:
    """Draw residuals over the command period, and a run at one period (fraction of tau_p)."""
    with style.picture(path, 3.9, paper) as figure:
        figure.suptitle(
            rf'Commands every period $T$, $\lambda$ = {study.start:g} to {study.target:g}, '
            rf'$\zeta$ = {study.material.zeta:g}, $J_\mathrm{{lim}}$ = '
            rf'{study.material.j_lim:g}, $c_1$ = {study.material.c1:g}')
        panels = figure.subplot_mosaic(
            [['residual', 'command'], ['residual', 'response']], height_ratios=[1.0, 1.3])
        axes = panels['residual']
        axes.plot(
            study.periods, 100.0 * study.bound, label='rounded, worst case', color=looks.VERMILION,
            linewidth=0.8, linestyle=(0, (1, 1)))
        axes.plot(
            study.periods, 100.0 * np.maximum(study.rounded, _RESOLVED),
            label='switch rounded to the grid', **{**style.UNSHAPED, 'linestyle': '-'})
        axes.plot(
            study.periods, 100.0 * np.maximum(study.solved, _RESOLVED),
            label='solved on the grid', **style.SHAPED)
        style.note(axes, r'below $10^{-6}$ %: not resolved', (study.periods[0], 1e-6), (4, 3),
                   **style.SOFT)
        axes.axvline(PROMISED, color=looks.GREY, linewidth=0.8, linestyle=(0, (1, 1.5)))
        style.note(axes, r'$\tau_p/3$', (PROMISED, 1e-4), (4, 0), **style.SOFT)
        axes.set_xscale('log')
        axes.set_yscale('log')
        axes.set_ylim(5e-7, 300.0)
        style.finish(axes, style.axis('command period', r'T/\tau_p'),
                     style.axis('residual vibration', unit='% of step'), 'a')
        ticks = [x for x in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0) if x >= study.periods[0]]
        axes.set_xticks(ticks, [f'{x:g}' for x in ticks])
        axes.xaxis.minorticks_off()
        axes.yaxis.minorticks_off()
        axes.set_xlim(study.periods[0], max(1.0, study.periods[-1]))

        size = period * study.tau_p
        solved = solved_move(study.start, study.target, study.material, size)
        rounded = rounded_move(ideal_move(study.start, study.target, study.material), size)
        moves = [(rounded, {**style.UNSHAPED, 'linestyle': '-'})]
        if solved is not None:
            moves.append((solved, style.SHAPED))
        end = 4.5 * study.tau_p
        _draw_moves(panels, study, study.material, moves, end, 1200)
        axes = panels['command']
        for number in range(int(1.6 * study.tau_p / size) + 1):
            axes.axvline(number * size, **style.TARGET)
        axes.set_xlim(-0.1 * study.tau_p, 1.6 * study.tau_p)
        style.finish(
            axes, style.axis('time', r'\tau'), style.axis('load', r'\beta'), 'b')
        axes.set_title(rf'$T$ = {period:g} $\tau_p$, grid dashed', loc='right', fontsize='small')
        panels['response'].set_xlim(0.0, end)
        figure.align_ylabels([panels['command'], panels['response']])
        style.legend_below(figure, panels['residual'])


def _draw_moves(
        panels: Mapping[str, Axes], study: SampledStudy | DampedStudy,
        material: NondimensionalParameters, moves: Sequence[tuple[Move, dict[str, Any]]],
        end: float, count: int, unit: float = 1.0) -> None:
    """Draw commands, their loads over a unit, and their responses, each in its look."""
    times = np.linspace(0.0, end, count, dtype=np.float64)
    for move, look in moves:
        loads = [x.load / unit for x in move.levels]
        panels['command'].step(
            [*(x.time for x in move.levels), times[-1]], [*loads, loads[-1]], where='post', **look)
        panels['response'].plot(
            times, Actual.off(material).response(move, study.start, times), **look)
    panels['response'].axhline(study.target, **style.TARGET)
    style.finish(
        panels['response'], style.axis('time', r'\tau'), style.axis('stretch', r'\lambda'), 'c')


def draw_damped(
        path: Path, study: DampedStudy, paper: Paper | None = None, *,
        zeta: float = 4.0) -> None:
    """Draw settling times over zeta, and commands and responses at one zeta."""
    material = NondimensionalParameters(zeta)
    holding = float(elastic_force(study.target, material))
    kinds = (
        looks.RECORDED.line(), {**looks.SHAPERS['minimum_time'].line(), 'zorder': 3})
    names = [
        rf'minimum time, ${least:g}\,\beta_1$ to ${most:g}\,\beta_1$' for least, most in LIMITS]
    with style.picture(path, 3.9, paper) as figure:
        figure.suptitle(
            rf'Above critical damping ({float(critical_zeta(study.target, material)):.3f}), '
            rf'$\lambda$ = {study.start:g} to {study.target:g}, $J_\mathrm{{lim}}$ = '
            rf'{material.j_lim:g}, $c_1$ = {material.c1:g}')
        panels = figure.subplot_mosaic(
            [['times', 'command'], ['times', 'response']], height_ratios=[1.0, 1.3])
        axes = panels['times']
        axes.plot(study.zetas, study.step, label='unshaped step', **style.UNSHAPED)
        for row, look in enumerate(kinds):
            axes.plot(study.zetas, study.settled[row], **look, label=names[row])
        axes.set_xlim(study.zetas[0], study.zetas[-1])
        axes.set_ylim(0.0, None)
        style.finish(
            axes, style.axis('damping', r'\zeta'),
            rf'time $\tau$ to within {100.0 * SETTLED:g} % of the step', 'a')

        moves: list[tuple[Move, dict[str, Any]]] = [
            (step(MoveRequest(State(study.start), study.target, material)), style.UNSHAPED)]
        moves += [
            (minimum_time(MoveRequest(
                State(study.start), study.target, material,
                limits_of(study.target, material, row))),
             look)
            for row, look in enumerate(kinds)]
        end = float(np.interp(zeta, study.zetas, study.step)) * 1.1
        _draw_moves(panels, study, material, moves, end, 800, holding)
        axes = panels['command']
        axes.set_xlim(-0.02 * end, end)
        style.finish(axes, '', style.axis('load', r'\beta/\beta_1'), 'b')
        axes.set_title(rf'$\zeta$ = {zeta:g}', loc='right', fontsize='small')
        panels['response'].set_xlim(-0.02 * end, end)
        figure.align_ylabels([panels['command'], panels['response']])
        style.legend_below(figure, panels['times'])
