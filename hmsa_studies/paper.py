"""Figs. 2 to 10 of the paper (Polymers 2022, 14, 3037) as figures and tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from hmsa.model.equations import signed_root, stretch_limits
from hmsa.report import looks, style
from hmsa.report.looks import named, Paper
from hmsa_studies import paper_data
from hmsa_studies.paper_data import Data, PaperResponse, PaperSweep

TAU = style.axis('time', r'\tau')
STRETCH = style.axis('stretch', r'\lambda')
RATE = style.axis('stretch rate', r'\dot{\lambda}')
FLUX = style.axis('flux density', 'b')
TAU_P = style.axis('time of first level', r'\tau_p')
#: Critical damping as quoted in the paper, for 1 -> 1.1.
PAPER_CRITICAL = 2.14
_COMMANDS = (('unshaped', style.UNSHAPED), ('shaped', style.SHAPED))
_ALONE = looks.LineStyle(looks.INDIGO, 1.2, (6.0, 1.5, 1.0, 1.5)).line()
# The first is broad: those on it remain visible where all coincide.
_CASES = (
    looks.LineStyle(looks.BLUE, 2.0), looks.LineStyle(looks.ORANGE, 1.4, (4.0, 3.0), order=3),
    looks.LineStyle(looks.BLACK, 1.0, (1.0, 2.0), order=4))
# Width in inches below which panels are stacked.
_NARROW = 4.0


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper."""

    number: int
    title: str  #: description
    compute: Callable[[int], Data]  #: data from the number of samples, or points of a sweep
    draw: Callable[[Figure, Any], None]
    height: float  #: in inches
    stacked: float  #: height with stacked panels

    @property
    def default_points(self) -> int:
        """Samples or points of the figure as published with this package."""
        sweep = self.compute in (paper_data.damping_sweep, paper_data.chain_limit_sweep)
        return paper_data.SWEEP_POINTS if sweep else paper_data.SAMPLES


def write_figure(
        figure: PaperFigure, folder: Path, *, points: int | None = None,
        paper: Paper | None = None, kinds: Sequence[str] = ('png',)) -> list[Path]:
    """Write figures and CSV with a number of samples or points of a sweep; return their paths."""
    # The table contains the data of the figure.
    paper = replace(paper or Paper(), data=False)
    images = named(folder, f'figure_{figure.number:02d}', kinds)
    table = images[0].with_suffix('.csv')
    data = figure.compute(points or figure.default_points)
    paper_data.write_csv(table, data)
    _draw(figure, data, images, paper)
    return [*images, table]


def draw_figure(figure: PaperFigure, paths: Sequence[Path], paper: Paper) -> None:
    """Compute and draw a figure."""
    _draw(figure, figure.compute(figure.default_points), paths, paper)


def _draw(figure: PaperFigure, data: Data, paths: Sequence[Path], paper: Paper) -> None:
    height = figure.stacked if paper.inches < _NARROW else figure.height
    with style.picture(paths, height, paper) as canvas:
        figure.draw(canvas, data)


def _stacked(figure: Figure) -> bool:
    return bool(figure.get_figwidth() < _NARROW)


def _pair(figure: Figure) -> Any:
    """Return two panels, side by side or stacked."""
    return figure.subplots(2, 1) if _stacked(figure) else figure.subplots(1, 2)


def _find(runs: Sequence[PaperResponse], command: str) -> PaperResponse:
    return next(x for x in runs if x.command == command)


def _plot_command(axes: Axes, run: PaperResponse, **look: Any) -> None:
    """Draw the level b, from 0 before the start to the end of the run."""
    end = float(run.time[-1])
    b = signed_root(run.loads)
    axes.plot(
        np.append(np.repeat(run.switches, 2), end),
        np.concatenate(([0.0], np.repeat(b, 2))), drawstyle='default', **look)


def _plot_targets(axes: Axes, run: PaperResponse) -> None:
    """Mark each target during its setpoint."""
    for i, target in enumerate(run.targets):
        axes.plot(
            [i * paper_data.SPAN, (i + 1) * paper_data.SPAN], [target, target],
            label='target' if i == 0 else None, **style.TARGET)


def _plot_responses(axes: Axes, runs: Sequence[PaperResponse]) -> None:
    for command, look in _COMMANDS:
        run = _find(runs, command)
        axes.plot(run.time, run.stretch, label=command, **look)
    axes.set_xlim(0.0, float(run.time[-1]))


def _plot_phase(axes: Axes, runs: Sequence[PaperResponse]) -> None:
    for command, look in _COMMANDS:
        run = _find(runs, command)
        axes.plot(run.stretch, run.rate, label=command, **look)
    axes.plot(
        run.targets, np.zeros(len(run.targets)), label='equilibrium', **style.EQUILIBRIUM)


def _draw_multi_step(figure: Figure, runs: tuple[PaperResponse, ...]) -> None:
    run, = runs
    left, right = _pair(figure)
    _plot_command(left, run, **style.UNSHAPED | {'linestyle': '-', 'linewidth': 1.4})
    for i, load in enumerate(run.loads):
        style.note(
            left, f'$b_{i + 1}$', (float(run.switches[i]) + 5.0, float(signed_root(load))), (0, 4),
            ha='center')
    left.set_xlim(-0.5, float(run.time[-1]))
    left.set_ylim(0.0, 1.12)
    style.finish(left, TAU, FLUX, 'a')
    for i, target in enumerate(run.targets):
        right.axhline(target, **style.TARGET)
        # Beside the panel, where there are no curves.
        style.note(
            right, rf'$\lambda(b_{i + 1})={target:.2f}$', (1.0, target), (3, 0),
            xycoords=('axes fraction', 'data'), va='center', fontsize='small')
    right.plot(
        run.time, run.stretch, **style.UNSHAPED | {'linestyle': '-', 'linewidth': 1.4})
    right.set_xlim(0.0, float(run.time[-1]))
    style.finish(right, TAU, STRETCH, 'b')


def _draw_single_move(figure: Figure, runs: tuple[PaperResponse, ...]) -> None:
    shaped, plain, alone = (_find(runs, x) for x in ('shaped', 'unshaped', 'b_p alone'))
    tau_p = float(shaped.switches[1])
    b_p, b_1 = (float(x) for x in signed_root(shaped.loads))
    left, right = _pair(figure)
    _plot_command(left, plain, **style.UNSHAPED)
    _plot_command(left, shaped, **style.SHAPED)
    left.plot([tau_p, 10.0], [b_p, b_p], **_ALONE)
    left.plot([tau_p, tau_p], [b_p, b_1], **style.EQUILIBRIUM)
    left.annotate(
        '', (6.5, b_1), xytext=(6.5, b_p),
        arrowprops={'arrowstyle': '<->', 'color': looks.BLACK, 'linewidth': 0.8,
                    'shrinkA': 0, 'shrinkB': 0})
    style.note(
        left, f'$b_a=b_1-b_p={b_1 - b_p:.4f}$', (6.5, 0.5 * (b_1 + b_p)), (-4, 0), ha='right',
        va='center')
    style.note(left, f'$b_1={b_1:.4f}$', (10.0, b_1), (0, 4), ha='right')
    style.note(left, f'$b_p={b_p:.4f}$', (10.0, b_p), (0, -11), ha='right')
    # The balance of forces at the two critical points, Eq. 11 times m.
    for text, b, height in (
            (r'$b_1^2$ equals the elastic force: $\ddot{\lambda}=0$', b_1, 26),
            (r'$b_p^2$ below the elastic force: $\ddot{\lambda}<0$', b_p, -32)):
        style.note(
            left, text, (tau_p, b), (16, height), va='center',
            arrowprops={'arrowstyle': '-', 'linewidth': 0.6, 'shrinkB': 4})
    left.axvline(tau_p, **style.TARGET)
    style.note(left, rf'$\tau_p={tau_p:.4f}$', (tau_p, 0.03), (4, 0))
    left.set_xlim(-0.3, 10.0)
    left.set_ylim(0.0, 0.7)
    style.finish(left, TAU, FLUX, 'a')

    right.axhline(shaped.targets[0], label=r'target $\lambda_d$', **style.TARGET)
    right.axvline(tau_p, **style.TARGET)
    right.plot(plain.time, plain.stretch, label='$b_1$ alone (unshaped)', **style.UNSHAPED)
    right.plot(alone.time, alone.stretch, label='$b_p$ alone', **_ALONE)
    right.plot(shaped.time, shaped.stretch, label='shaped', **style.SHAPED)
    right.plot([tau_p], shaped.targets, **style.EQUILIBRIUM)
    right.set_xlim(0.0, 10.0)
    style.finish(right, TAU, STRETCH, 'b')
    style.legend_below(figure, right)


def _draw_shaped_multi_step(figure: Figure, runs: tuple[PaperResponse, ...]) -> None:
    left, right = _pair(figure)
    shaped = _find(runs, 'shaped')
    _plot_command(left, _find(runs, 'unshaped'), **style.UNSHAPED)
    _plot_command(left, shaped, **style.SHAPED)
    for i in range(len(shaped.targets)):
        begin, arrival = shaped.switches[2 * i:2 * i + 2]
        b_p, b_1 = signed_root(shaped.loads[2 * i:2 * i + 2])
        style.note(left, f'$b_{{p{i + 1}}}$', (arrival, b_p), (3, -6))
        style.note(
            left, f'$b_{i + 1}$', (begin + paper_data.SPAN / 2, b_1), (0, 4), ha='center')
    left.set_xlim(-0.5, float(shaped.time[-1]))
    left.set_ylim(0.0, 1.12)
    style.finish(left, TAU, FLUX, 'a')
    _plot_targets(right, shaped)
    _plot_responses(right, runs)
    style.finish(right, TAU, STRETCH, 'b')
    style.legend_below(figure, right)


def _draw_sequences(figure: Figure, runs: tuple[PaperResponse, ...]) -> None:
    """Draw Figs. 5 and 6: two sequences over time, the first one in the phase plane."""
    rows = [['first'], ['second'], ['phase']]
    if not _stacked(figure):
        rows = [['first', 'phase'], ['second', 'phase']]
    panels: dict[str, Axes] = figure.subplot_mosaic(
        rows, width_ratios=[1.3, 1.0][:len(rows[0])])  # type: ignore[arg-type]
    for name, part, letter in (('first', runs[:2], 'a'), ('second', runs[2:], '')):
        axes = panels[name]
        _plot_targets(axes, part[0])
        _plot_responses(axes, part)
        style.finish(axes, TAU if name == 'second' else '', STRETCH, letter)
        axes.set_title(
            r'$\lambda_d$ = ' + ', '.join(f'{x:.2f}' for x in part[0].targets), loc='right')
    panels['first'].tick_params(labelbottom=False)
    axes = panels['phase']
    _plot_phase(axes, runs[:2])
    style.finish(axes, STRETCH, RATE, 'b')
    axes.set_title(
        r'$\lambda_d$ = ' + ', '.join(f'{x:.2f}' for x in runs[0].targets), loc='right')
    style.legend_below(figure, panels['first'], axes)


def _draw_damping_cases(figure: Figure, runs: tuple[PaperResponse, ...]) -> None:
    grid = figure.subplots(4, 1, sharex=True).reshape(2, 2).T if _stacked(figure) else (
        figure.subplots(2, 2, sharex=True, sharey='col'))
    half = len(runs) // 2
    for column, (part, letter) in enumerate(((runs[:half], 'a'), (runs[half:], 'b'))):
        mode = 'expansion' if column == 0 else 'contraction'
        for row, command in enumerate(('unshaped', 'shaped')):
            axes = grid[row, column]
            _plot_targets(axes, part[0])
            chosen = [x for x in part if x.command == command]
            for run, look in zip(chosen, _CASES, strict=True):
                axes.plot(
                    run.time, run.stretch, **look.line(
                        label=rf'$\zeta={run.material.zeta:.2f}$'))
            axes.set_xlim(0.0, float(part[0].time[-1]))
            first = not column or _stacked(figure)
            style.finish(
                axes, TAU if row else '', STRETCH if first else '', letter if row == 0 else '')
            axes.set_title(f'{mode}, {command}', loc='right')
    style.legend_below(figure, grid[0, 0])


def _draw_damping_sweep(figure: Figure, sweep: PaperSweep) -> None:
    left, right = _pair(figure)
    for axes in (left, right):
        axes.plot(sweep.zeta, sweep.tau_p, label=r'$\tau_p$, $1\to1.1$', **style.SHAPED)
        axes.axvline(
            PAPER_CRITICAL, color=looks.VERMILION, linewidth=1.2, linestyle=(0, (4, 1.5)),
            label=f'critical, as the paper quotes it: {PAPER_CRITICAL}')
        axes.axvline(
            sweep.critical, color=looks.BLACK, linewidth=1.0, linestyle=(0, (1, 1.2)),
            label=f'critical, linearised at 1.1: {sweep.critical:.4f}')
    top = math.ceil(float(np.nanmax(sweep.tau_p))) + 0.5
    left.set_xlim(0.0, 1.05 * sweep.critical)
    left.set_ylim(0.0, top)
    style.finish(left, style.axis('damping', r'\zeta'), TAU_P, 'a')
    near = 2.0
    right.set_xlim(near, near + 1.12 * (sweep.critical - near))
    right.set_ylim(0.0, top)
    style.finish(
        right, style.axis('damping', r'\zeta') + ', close-up',
        TAU_P if _stacked(figure) else '', 'b')
    style.legend_below(figure, left)


def _draw_chain_limit_cases(figure: Figure, runs: tuple[PaperResponse, ...]) -> None:
    pairs = [runs[i:i + 2] for i in range(0, len(runs), 2)]
    grid = figure.subplots(2 * len(pairs), 1).reshape(-1, 2) if _stacked(figure) else (
        figure.subplots(len(pairs), 2, sharex='col', width_ratios=[1.6, 1.0]))
    begin = 2 * paper_data.SPAN
    for (left, right), pair, letter in zip(grid, pairs, 'abc', strict=True):
        limit = stretch_limits(pair[0].material)[1]
        for axes in (left, right):
            axes.axhline(
                limit, color=looks.BLACK, linewidth=0.9, linestyle=(0, (6, 2)),
                label=r'limiting stretch $\lambda_m$')
            _plot_targets(axes, pair[0])
            _plot_responses(axes, pair)
        right.set_xlim(begin - 0.2, begin + 2.0)
        last = pair is pairs[-1]
        style.finish(left, TAU if last else '', STRETCH, letter)
        style.finish(right, TAU if last else '', STRETCH)
        right.set_title(f'close-up of ({letter})', loc='right')
        left.set_title(
            rf'$J_{{\mathrm{{lim}}}}={pair[0].material.j_lim:g}$, $\lambda_m={limit:.3f}$, '
            rf'$\tilde{{\lambda}}_m={paper_data.NEAR_LIMIT:g}\,\lambda_m'
            rf'={pair[0].targets[2]:.3f}$', loc='right')
        right.set_ylim(1.35, 1.35 + 1.05 * (limit - 1.35))
    style.legend_below(figure, grid[0, 0])


def _draw_chain_limit_sweep(figure: Figure, sweep: PaperSweep) -> None:
    left, right = _pair(figure)
    marks = np.searchsorted(sweep.j_lim, paper_data.J_LIMS)
    extension = style.axis('chain extensibility', r'J_{\mathrm{lim}}')
    b_p = signed_root(sweep.beta_p)
    for axes, values in ((left, sweep.tau_p), (right, b_p)):
        axes.plot(sweep.j_lim, values, label=r'$1\to1.2$', **style.SHAPED)
        axes.plot(
            sweep.j_lim[marks], values[marks], label=r'$J_{\mathrm{lim}}$ of Fig. 9',
            **style.EQUILIBRIUM)
    for axes in (left, right):
        axes.set_xlim(0.0, float(sweep.j_lim[-1]))
    style.finish(left, extension, TAU_P, 'a')
    style.finish(right, extension, style.axis('intermediate flux density', 'b_p'), 'b')
    style.legend_below(figure, right)


#: The figures by number.
FIGURES: dict[int, PaperFigure] = {x.number: x for x in (
    PaperFigure(2, 'unshaped steps and the response', paper_data.multi_step,
                _draw_multi_step, 2.7, 4.6),
    PaperFigure(3, 'the command-shaping scheme, 1 to 1.1', paper_data.single_move,
                _draw_single_move, 3.1, 5.4),
    PaperFigure(4, 'shaped steps and the response', paper_data.shaped_multi_step,
                _draw_shaped_multi_step, 3.0, 5.0),
    PaperFigure(5, 'expansion', paper_data.expansion, _draw_sequences, 4.0, 6.4),
    PaperFigure(6, 'contraction', paper_data.contraction, _draw_sequences, 4.0, 6.4),
    PaperFigure(7, 'effect of damping', paper_data.damping_cases, _draw_damping_cases, 4.4, 7.6),
    PaperFigure(8, 'intermediate time over damping', paper_data.damping_sweep,
                _draw_damping_sweep, 3.1, 5.2),
    PaperFigure(9, 'effect of chain extensibility', paper_data.chain_limit_cases,
                _draw_chain_limit_cases, 5.4, 9.4),
    PaperFigure(10, 'intermediate time and flux density over chain extensibility',
                paper_data.chain_limit_sweep, _draw_chain_limit_sweep, 3.0, 5.0),
)}
