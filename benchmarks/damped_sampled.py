"""
Moves above critical damping, and on a sampling grid, with figures of both.

Above critical damping the unshaped step approaches without overshoot; the minimum-time command,
which pushes and brakes within the load limits, arrives in finite time.

With a command period, either the two-step command is solved for on the sampling grid, or the
switching time of the ideal one is rounded to the grid.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
import numpy as np

from hmsa.errors import HmsaError
from hmsa.model.delivery import Delivery
from hmsa.model.equations import Array, critical_zeta, elastic_force, Floats
from hmsa.model.moves import Level, Limits, Move, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.linear import step
from hmsa.planning.shapers.minimum_time import minimum_time
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.shapers.two_step import two_step
from hmsa.report import looks, style
from hmsa.report.looks import Paper
from hmsa_studies.robustness import Actual, ringing

# Smaller fractions of a step are rounding of the search on a grid.
_RESOLVED = 1e-8
#: Deviation from the target, as a fraction of the step, at which a motion counts as settled.
SETTLED = 0.01
#: Load limits to compare, relative to the load that holds the target.
LIMITS = ((0.0, 1.2), (-2.0, 2.0))
# At the end, e^-14 of the move remains of the slowest motion.
_FADED = 14.0
_SETTLING = 6001

#: Maximum command period, as a fraction of tau_p, for which the residual should be exact.
PROMISED = 1.0 / 3.0


@dataclass(frozen=True)
class DampedStudy:
    """Times of a move between stretches at rest, over zeta (n,)."""

    start: float
    target: float
    zetas: Array
    step: Array  #: (n,), settling time of the unshaped step
    arrival: Array  #: (m, n), move time of the minimum-time command under each of LIMITS
    settled: Array  #: (m, n), its settling time


def limits_of(target: float, material: NondimensionalParameters, number: int) -> Limits:
    """Return the entry of `LIMITS` as loads, relative to the load of a stretch above 1."""
    holding = float(elastic_force(target, material))
    least, most = LIMITS[number]
    return Limits(least * holding, most * holding)


def settling_time(
        move: Move, start: float, target: float, material: NondimensionalParameters) -> float:
    """Return when the stretch stays within 1 % of the step for good, or raise `HmsaError`."""
    _, decay = ringing(target, material)
    times = np.linspace(0.0, move.levels[-1].time + _FADED / decay, _SETTLING)
    away = np.abs(Actual.off(material).response(move, start, times) - target)
    band = SETTLED * abs(target - start)
    outside = np.flatnonzero(away > band)
    if outside.size == 0:
        return 0.0
    last = int(outside[-1])
    if last + 1 == times.size:
        raise HmsaError(
            f'the move from {material.coordinate.name} {start:g} to {target:g} has not settled in '
            f'{times[-1]:.4g}: expected a command that leads there')
    share = (away[last] - band) / (away[last] - away[last + 1])
    return float(times[last] + share * (times[last + 1] - times[last]))


def damped_study(start: float, target: float, zetas: Floats) -> DampedStudy:
    """Compare the unshaped step with the minimum-time command over values of zeta above 0."""
    materials = [NondimensionalParameters(float(zeta)) for zeta in zetas]
    plain = np.array([
        settling_time(step(MoveRequest(State(start), target, x)), start, target, x)
        for x in materials])
    arrival = np.empty((len(LIMITS), len(materials)))
    settled = np.empty_like(arrival)
    for row in range(len(LIMITS)):
        for column, material in enumerate(materials):
            move = minimum_time(MoveRequest(
                State(start), target, material, limits_of(target, material, row)))
            arrival[row, column] = move.duration
            settled[row, column] = settling_time(move, start, target, material)
    return DampedStudy(start, target, np.asarray(zetas), plain, arrival, settled)


@dataclass(frozen=True)
class SampledStudy:
    """Residuals of a move between stretches at rest, over the command period."""

    start: float
    target: float
    material: NondimensionalParameters
    tau_p: float  #: of the ideal command
    periods: Floats  #: as fractions of tau_p
    solved: Array  #: of the command solved for on the grid; NaN if there is none
    rounded: Array  #: of the ideal command with its switching time rounded to the grid
    #: The worse of the ideal command switched half a period early and late: the worst rounding
    #: error if the period is not matched to tau_p.
    bound: Array


def ideal_move(start: float, target: float, material: NondimensionalParameters) -> Move:
    """Return the two-step command for ideal hardware; raise `HmsaError` if there is none."""
    move = two_step(MoveRequest(State(start), target, material))
    if move.code is not Code.TWO_STEP:
        raise HmsaError(
            f'there is no two-step command from {material.coordinate.name} {start:g} to '
            f'{target:g} at zeta {material.zeta:g} ({move.code}): expected another move')
    return move


def rounded_move(move: Move, period: float) -> Move:
    """Return a two-step command with its switching time rounded to a grid after its start."""
    return _switched_at(move, max(1, round(move.duration / period)) * period)


def _switched_at(move: Move, time: float) -> Move:
    """Return a two-step command with another switching time, which is its duration."""
    first, last = move.levels
    return Move(move.code, (first, Level(time, last.load)), time)


def solved_move(
        start: float, target: float, material: NondimensionalParameters,
        period: float) -> Move | None:
    """Return the command solved for on a grid, None if there is none."""
    try:
        return two_step(MoveRequest(State(start), target, material, delivery=Delivery(period)))
    except RefusedError:
        return None


def sampled_study(
        start: float, target: float, material: NondimensionalParameters,
        periods: Floats) -> SampledStudy:
    """Compute residuals over the command period, as fractions of tau_p."""
    ideal = ideal_move(start, target, material)
    tau_p = ideal.duration

    def left(move: Move | None) -> float:
        if move is None:
            return math.nan
        return Actual.off(material).residual(move, start, target, move.duration)

    return SampledStudy(
        start, target, material, tau_p, periods,
        np.array([left(solved_move(start, target, material, x * tau_p)) for x in periods]),
        np.array([left(rounded_move(ideal, x * tau_p)) for x in periods]),
        np.array([max(left(_switched_at(ideal, (1.0 + sign * 0.5 * x) * tau_p))
                      for sign in (-1.0, 1.0)) for x in periods]))


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
