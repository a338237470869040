"""
``python -m benchmarks.robustness``: robustness tables of the documentation, and their figures.

The script that draws all figures of the documentation (``make pictures``) draws these, too.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path
import sys

import numpy as np

from benchmarks.damped_sampled import (
    damped_study,
    DampedStudy,
    draw_damped,
    draw_sampled,
    LIMITS,
    sampled_study,
)
from hmsa.errors import complain, HmsaError
from hmsa.model.moves import State
from hmsa.model.parameters import Errors, NondimensionalParameters
from hmsa.planning.shapers import SHAPERS
from hmsa.planning.shapers.request import MoveRequest, SmoothLimits
from hmsa.report.looks import SCREEN
from hmsa.table import percent
from hmsa_studies.pictures import draw_front, draw_robustness, draw_sweep
from hmsa_studies.robustness import (
    Actual,
    Candidate,
    candidates,
    Case,
    PARAMETERS,
    Result,
    study,
)
from hmsa_studies.sweep import parse_grid, Sweep

MOVES = ((1.0, 1.1), (1.0, 1.4), (1.0, 0.7))
MATERIAL = NondimensionalParameters()
#: Command periods in the table, as fractions of tau_p; no multiple of one equals tau_p.
PERIODS = (0.03, 0.07, 0.13, 0.23, 0.33, 0.45)
#: Minimum durations of smooth moves in the table, in natural periods.
PACES = (0.5, 1.0, 1.5, 2.0, 3.0)
ZETAS = (2.2, 3.0, 4.0, 5.0, 6.0)

Table = list[tuple[str, ...]]


def robustness_table(start: float, target: float) -> Table:
    """Return header and rows that compare all shapers for one move, with errors up to 10 %."""
    case = Case(start, target, MATERIAL)
    rows: Table = [(
        'shaper', 'arrival', 'nominal', *(f'{name} ±10 %' for name in PARAMETERS),
        'all ±10 %')]
    for candidate in candidates():
        result = study(case, candidate)
        rows.append((
            candidate.label.partition(' (')[0],
            f'{result.arrival:.3f}' if candidate.shaper != 'step' else 'never',
            percent(result.nominal),
            *(percent(worst.residual) for worst in result.alone.values()),
            percent(result.worst.residual)))
    return rows


def smooth_table() -> Table:
    """Return header and rows with the residual vibration of smooth moves of several durations."""
    rows: Table = [('smooth, at least', *(f'{x:g} periods' for x in PACES))]
    for start, target in MOVES:
        moves = [
            SHAPERS['smooth'](MoveRequest(State(start), target, MATERIAL, pace=SmoothLimits(x)))
                 for x in PACES]
        name = f'{start:g} to {target:g}'
        rows.append((f'arrival, {name}', *(f'{x.duration:.3f}' for x in moves)))
        rows.append((f'G ±10 %, {name}', *(percent(max(
            Actual.off(MATERIAL, Errors(error)).residual(x, start, target, x.duration)
            for error in (-0.1, 0.1))) for x in moves)))
    return rows


def sampled_table() -> Table:
    """Return header and rows with residuals of commands rounded to a sampling grid."""
    rows: Table = [('rounded, at worst', *(f'T = {x:g} tau_p' for x in PERIODS))]
    for start, target in MOVES:
        found = sampled_study(start, target, MATERIAL, np.array(PERIODS))
        rows.append((f'{start:g} to {target:g}', *map(percent, found.bound.tolist())))
    return rows


def damped_table(found: DampedStudy) -> Table:
    """Return header and rows with times above critical damping, at the study's values of zeta."""
    rows: Table = [('time to', *(f'zeta = {x:g}' for x in found.zetas))]
    rows.append(('unshaped step: within 1 %', *(f'{x:.2f}' for x in found.step)))
    for (least, most), settled, arrival in zip(
            LIMITS, found.settled, found.arrival, strict=True):
        name = f'minimum time, {least:g} to {most:g} beta_1'
        rows.append((f'{name}: within 1 %', *(f'{x:.2f}' for x in settled)))
        rows.append((f'{name}: rest', *(f'{x:.2f}' for x in arrival)))
    return rows


def tables() -> list[Table]:
    """Return all tables of the documentation in their order there."""
    return [
        *(robustness_table(*move) for move in MOVES), smooth_table(), sampled_table(),
        damped_table(damped_study(1.0, 1.1, np.array(ZETAS)))]


@cache
def _compared() -> tuple[Case, list[Result]]:
    """Return the move of the figures, with the results of each shaper."""
    case = Case(1.0, 1.4, MATERIAL)
    return case, [study(case, x) for x in (
        *candidates(), Candidate('robust', 4), Candidate('minimax', 4))]


def _robustness(path: Path) -> None:
    case, results = _compared()
    draw_robustness(path, case, results[:-2], SCREEN)


def _map(path: Path) -> None:
    sweep = Sweep({
        'zeta': parse_grid('0:3:240', 'zeta'), 'j_lim': parse_grid('log:0.1:100:160', 'j_lim')})
    rows = sweep.rows(0, sweep.size).results
    draw_sweep([path], sweep.view(), {x: rows[x] for x in sweep.shown}, sweep.fixed, SCREEN)


#: Functions that draw the figures of the page, by name.
PICTURES: dict[str, Callable[[Path], None]] = {
    'robustness': _robustness,
    'front': lambda path: draw_front(path, [_compared()], SCREEN),
    'sampled': lambda path: draw_sampled(path, sampled_study(
        1.0, 1.4, MATERIAL, np.geomspace(0.041, 0.99, 700)), SCREEN),
    'damped': lambda path: draw_damped(
        path, damped_study(1.0, 1.1, np.linspace(2.2, 6.0, 77)), SCREEN),
    'map': _map}


def main() -> int:
    """Print the tables; return the exit status."""
    try:
        for table in tables():
            for number, row in enumerate(table):
                print(f'| {" | ".join(row)} |')
                if number == 0:
                    print(f'| --- |{" ---: |" * (len(row) - 1)}')
            print()
    except HmsaError as error:
        return complain(error)
    return 0


if __name__ == '__main__':
    sys.exit(main())
