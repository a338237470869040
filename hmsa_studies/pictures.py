"""Pictures of the studies: robustness, sampled hardware, heavy damping."""

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
import numpy as np

from hmsa_ros.model.equations import critical_zeta, elastic_force
from hmsa_ros.model.moves import Move, State
from hmsa_ros.model.parameters import NondimensionalParameters
from hmsa_ros.planning.shapers.linear import step
from hmsa_ros.planning.shapers.minimum_time import minimum_time
from hmsa_ros.planning.shapers.request import Request
from hmsa_ros.report import style
from hmsa_studies.damped import DampedStudy, LIMITS, limits_of, SETTLED
from hmsa_studies.residual import Actual
from hmsa_studies.robustness import Candidate, Case, ORDERED, percent, Result
from hmsa_studies.sampled import ideal_move, PROMISED, rounded_move, SampledStudy, solved_move

# Residuals below this are drawn on it.
_FLOOR = 1e-4
# The same where rounding errors are shown.
_EXACT = 1e-15
_SYMBOLS = {'G': '$G$', 'zeta': r'$\zeta$', 'J_lim': r'$J_\mathrm{lim}$'}
_CURVES: dict[str, dict[str, Any]] = {
    'two_step': {'color': style.BLUE, 'linewidth': 1.9},
    'minimum_time': {'color': style.PURPLE, 'linewidth': 1.3, 'linestyle': (0, (5, 1, 1, 1))},
    'smooth': {'color': style.BLUE, 'linewidth': 1.3, 'linestyle': (0, (1, 1))},
    'step': {'color': style.VERMILION, 'linewidth': 1.1, 'linestyle': (0, (4, 1.5))},
    'zv': {'color': style.GREY, 'linewidth': 1.1, 'linestyle': (0, (1, 1))},
    'zvd': {'color': style.GREY, 'linewidth': 1.1, 'linestyle': (0, (4, 1.5))},
    'ei': {'color': style.BLACK, 'linewidth': 1.0, 'linestyle': (0, (6, 1, 1, 1, 1, 1))},
}
_MARKERS = {
    'two_step': 'o', 'robust': 's', 'minimax': 'D', 'minimum_time': '^', 'smooth': 'P', 'zv': 'v',
    'zvd': '<', 'ei': '>'}
# Orders of the robust shaper, one after the other.
_ORDERS: tuple[dict[str, Any], ...] = (
    {'color': style.GREEN, 'linewidth': 1.9},
    {'color': style.GREEN, 'linewidth': 1.2, 'linestyle': (0, (4, 1.5))},
    {'color': style.ORANGE, 'linewidth': 1.2},
    {'color': style.ORANGE, 'linewidth': 1.2, 'linestyle': (0, (4, 1.5))},
)
_DASHES = ('-', (0, (4, 1.5)), (0, (1, 1)))


def draw_robustness(
        paths: Path | Sequence[Path], case: Case, results: Sequence[Result]) -> None:
    """Draw one move's residuals, PNG or PDF: over each error alone, and the worst in the box."""
    shown = [x for x in results if x.move is not None]
    looks = _looks([x.candidate for x in shown])
    errors = 100.0 * case.errors()
    with style.picture(paths, 6.4) as figure:
        figure.suptitle(
            f'Residual vibration, {case.material.coordinate.name} {case.start:g} to '
            f'{case.target:g}; {_nominal(case)}', fontsize=10)
        names = list(case.parameters)
        panels = figure.subplot_mosaic(
            [['G', 'zeta'], ['J_lim' if 'J_lim' in names else 'box', 'box']])
        for name, letter in zip(names, 'abc', strict=False):
            axes = panels[name]
            for result, look in zip(shown, looks, strict=True):
                axes.plot(
                    errors, 100.0 * np.maximum(result.curves[name], _FLOOR),
                    label=_label(result), **look)
            axes.axvspan(-100.0 * case.box, 100.0 * case.box, color='#F2F2F2', zorder=0)
            axes.set_yscale('log')
            axes.set_ylim(100.0 * _FLOOR, 400.0)
            axes.set_xlim(errors[0], errors[-1])
            style.finish(
                axes, f'error of {_SYMBOLS[name]} alone [%]', 'residual [% of the step]', letter)
            axes.yaxis.minorticks_off()
        _bars(panels['box'], case, shown, looks, 'abcd'[len(names)])
        style.legend_below(figure, panels['G'], most=2)


def _nominal(case: Case) -> str:
    """Return the model in a title."""
    material = case.material
    whose = rf'$J_\mathrm{{lim}}$ = {material.j_lim:g}' if material.law is None else (
        f'law {material.law.law}')
    return rf'nominal $\zeta$ = {material.zeta:.4g}, {whose}, $c_1$ = {material.c1:.4g}'


def _looks(candidates: Sequence[Candidate]) -> list[dict[str, Any]]:
    orders = list(dict.fromkeys(x.order for x in candidates if x.shaper in ORDERED))

    def look(candidate: Candidate) -> dict[str, Any]:
        if candidate.shaper not in ORDERED:
            return _CURVES.get(candidate.shaper, {'color': style.BLACK})
        place = orders.index(candidate.order)
        if candidate.shaper == 'robust':
            return _ORDERS[place % len(_ORDERS)]
        return {'color': style.SKY_BLUE, 'linewidth': 1.6,
                'linestyle': _DASHES[place % len(_DASHES)]}

    return [look(x) for x in candidates]


def draw_front(
        paths: Path | Sequence[Path], studies: Sequence[tuple[Case, Sequence[Result]]]) -> None:
    """Draw the worst residuals over the duration of a move, PNG or PDF, a panel for each."""
    rows = max(-(-len(studies) // 3), 1)
    with style.picture(paths, 0.9 + 2.7 * rows) as figure:
        columns = max(min(len(studies), 3), 1)
        axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
        for panel, (case, results) in zip(axes, studies, strict=False):
            shown = [
                x for x in results if x.move is not None and math.isfinite(x.move.duration)]
            for result, look in zip(shown, _looks([x.candidate for x in shown]), strict=True):
                label = result.candidate.name
                for worst, face in ((result.worst, look['color']), (result.alone['G'], 'white')):
                    panel.plot(
                        [result.arrival], [100.0 * max(worst.residual, _FLOOR)],
                        color=look['color'], linestyle='none',
                        marker=_MARKERS.get(result.candidate.shaper, 'x'), markersize=6.0,
                        markerfacecolor=face, label=label)
                    label = '_nolegend_'
            panel.set_yscale('log')
            style.finish(
                panel, r'arrival [$L\sqrt{\rho/G}$]' if case.material.law is None
                else 'arrival [units of time]',
                'worst residual [% of the step]' if panel is axes[0] else '', '')
            panel.yaxis.minorticks_off()
            panel.set_title(
                rf'{case.material.coordinate.name} {case.start:g} to {case.target:g}, '
                rf'$\pm${100.0 * case.box:g} %',
                fontsize=9)
        for panel in axes[len(studies):]:
            panel.set_axis_off()
        figure.legend(
            *axes[0].get_legend_handles_labels(), loc='outside lower center', ncols=4,
            title=f'filled: {", ".join(studies[0][0].parameters)} off together; open: G alone',
            fontsize=8,
            title_fontsize=8)


def _label(result: Result) -> str:
    """Name a curve; a shaper that fell back says to what."""
    label = result.candidate.label
    return f'{label}: {result.code}' if result.reason else label


def _bars(
        axes: Axes, case: Case, results: Sequence[Result], looks: Sequence[dict[str, Any]],
        letter: str) -> None:
    """Draw the worst in the box of all errors."""
    worst = np.array([x.worst.residual for x in results])
    lengths = 100.0 * np.nan_to_num(np.maximum(worst, _FLOOR), nan=_FLOOR)
    places = np.arange(len(results))
    axes.barh(
        places, lengths, color=[x['color'] for x in looks],
        height=0.62, zorder=2)
    for place, length, value in zip(places, lengths, worst, strict=True):
        axes.annotate(
            percent(value), (float(length), float(place)), xytext=(3, 0),
            textcoords='offset points', va='center', fontsize=8)
    axes.set_xscale('log')
    axes.set_xlim(100.0 * _FLOOR, 1000.0)
    axes.set_yticks(places, [x.candidate.name for x in results])
    axes.set_ylim(len(results) - 0.4, -0.6)
    style.finish(
        axes, rf'worst, all within $\pm${100.0 * case.box:g} % [% of the step]', '', letter)
    axes.xaxis.minorticks_off()
    axes.yaxis.minorticks_off()
    axes.grid(visible=False, axis='y')


def draw_sampled(path: str | Path, study: SampledStudy, *, period: float = 0.28) -> None:
    """Write a PNG of residuals over the command period, and a run at one (share of tau_p)."""
    with style.picture(Path(path), 3.9) as figure:
        figure.suptitle(
            rf'Commands every period $T$, $\lambda$ = {study.start:g} to {study.target:g}, '
            rf'$\zeta$ = {study.material.zeta:g}, $J_\mathrm{{lim}}$ = '
            rf'{study.material.j_lim:g}, $c_1$ = {study.material.c1:g}', fontsize=10)
        panels = figure.subplot_mosaic(
            [['residual', 'command'], ['residual', 'response']], height_ratios=[1.0, 1.3])
        axes = panels['residual']
        axes.plot(
            study.periods, 100.0 * study.bound, label='rounded, at worst', color=style.VERMILION,
            linewidth=0.8, linestyle=(0, (1, 1)))
        axes.plot(
            study.periods, 100.0 * np.maximum(study.rounded, _EXACT),
            label='switch rounded to the grid', **{**style.UNSHAPED, 'linestyle': '-'})
        axes.plot(
            study.periods, 100.0 * np.maximum(study.solved, _EXACT),
            label='solved on the grid', **style.SHAPED)
        axes.axhline(1e-6, color=style.GREY, linewidth=0.8, linestyle=(0, (4, 2)))
        small = {'fontsize': 8, 'color': '#555555'}
        style.note(axes, r'$10^{-8}$ of the step', (study.periods[0], 1e-6), (4, 3), **small)
        axes.axvline(PROMISED, color=style.GREY, linewidth=0.8, linestyle=(0, (1, 1.5)))
        style.note(axes, r'$\tau_p/3$', (PROMISED, 1e-9), (4, 0), **small)
        axes.set_xscale('log')
        axes.set_yscale('log')
        axes.set_ylim(5e-14, 300.0)
        style.finish(axes, r'command period $T/\tau_p$ [1]', 'residual [% of the step]', 'a')
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
            axes, r'time $\tau$ [1]', r'load $\beta$ [1]', 'b')
        axes.set_title(rf'$T$ = {period:g} $\tau_p$, grid dotted', loc='right', fontsize=8)
        panels['response'].set_xlim(0.0, end)
        figure.align_ylabels([panels['command'], panels['response']])
        style.legend_below(figure, panels['residual'])


def _draw_moves(
        panels: Mapping[str, Axes], study: SampledStudy | DampedStudy,
        material: NondimensionalParameters, moves: Sequence[tuple[Move, dict[str, Any]]],
        end: float, count: int, unit: float = 1.0) -> None:
    """Draw commands, their loads over a unit, and the responses to them, each in its look."""
    times = np.linspace(0.0, end, count, dtype=np.float64)
    for move, look in moves:
        loads = [x.load / unit for x in move.levels]
        panels['command'].step(
            [*(x.time for x in move.levels), times[-1]], [*loads, loads[-1]], where='post', **look)
        panels['response'].plot(
            times, Actual.off(material).response(move, study.start, times), **look)
    panels['response'].axhline(study.target, **style.TARGET)
    style.finish(panels['response'], r'time $\tau$ [1]', r'stretch $\lambda$ [1]', 'c')


def draw_damped(path: str | Path, study: DampedStudy, *, zeta: float = 4.0) -> None:
    """Write a PNG of settling times over zeta, and one zeta's commands and responses."""
    material = NondimensionalParameters(zeta)
    holding = float(elastic_force(study.target, material))
    colours = (style.BLUE, style.GREEN)
    names = [
        rf'minimum time, ${least:g}\,\beta_1$ to ${most:g}\,\beta_1$' for least, most in LIMITS]
    with style.picture(Path(path), 3.9) as figure:
        figure.suptitle(
            rf'Above critical damping ({float(critical_zeta(study.target, material)):.3f}), '
            rf'$\lambda$ = {study.start:g} to {study.target:g}, $J_\mathrm{{lim}}$ = '
            rf'{material.j_lim:g}, $c_1$ = {material.c1:g}', fontsize=10)
        panels = figure.subplot_mosaic(
            [['times', 'command'], ['times', 'response']], height_ratios=[1.0, 1.3])
        axes = panels['times']
        axes.plot(study.zetas, study.step, label='plain step', **style.UNSHAPED)
        for row, colour in enumerate(colours):
            axes.plot(
                study.zetas, study.settled[row], color=colour, linewidth=1.8,
                label=names[row])
        axes.set_xlim(study.zetas[0], study.zetas[-1])
        axes.set_ylim(0.0, None)
        style.finish(
            axes, r'damping coefficient $\zeta$ [1]',
            rf'time $\tau$ to within {100.0 * SETTLED:g} % of the step [1]', 'a')

        moves: list[tuple[Move, dict[str, Any]]] = [
            (step(Request(State(study.start), study.target, material)), style.UNSHAPED)]
        moves += [
            (minimum_time(Request(
                State(study.start), study.target, material,
                limits_of(study.target, material, row))),
             {'color': colour, 'linewidth': 1.6})
            for row, colour in enumerate(colours)]
        end = float(np.interp(zeta, study.zetas, study.step)) * 1.1
        _draw_moves(panels, study, material, moves, end, 800, holding)
        axes = panels['command']
        axes.set_xlim(-0.02 * end, end)
        style.finish(axes, '', r'load $\beta/\beta_1$ [1]', 'b')
        axes.set_title(rf'$\zeta$ = {zeta:g}', loc='right', fontsize=8)
        panels['response'].set_xlim(-0.02 * end, end)
        figure.align_ylabels([panels['command'], panels['response']])
        style.legend_below(figure, panels['times'])
