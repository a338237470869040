"""
Compare the two-step command of this package with other ways to compute it.

All solve the same nine moves: the paper's steps up and down in stretch, and steps between them.
Errors are those of beta_p against solutions in 40-digit arithmetic (`benchmarks.reference`).
A contender with a tolerance of its own uses the loosest one that keeps the error below a limit,
so times compare at equal accuracy.
"""

from collections.abc import Callable
from dataclasses import replace
import math
import os
from pathlib import Path
import statistics
import subprocess
import sys
import sysconfig
import tempfile
from time import perf_counter
import venv

import numpy as np

from benchmarks import contenders
from benchmarks.measure import Contender, loosest, race, Row, stopwatch, table
from benchmarks.reference import Actuator, two_step
from benchmarks.sheet import Sheet
from hmsa import motion
from hmsa.model.creep import Creep
from hmsa.model.delivery import Delivery
from hmsa.model.moves import State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.shapers.two_step import two_step as shaper
from hmsa.planning.two_step import (
    available_cores,
    HOLD_TOLERANCE,
    plan_two_step,
    plan_two_step_batch,
)

MOVES = [(1.0, 1.1), (1.1, 1.2), (1.2, 1.4), (1.0, 0.9), (0.9, 0.8), (0.8, 0.7), (1.0, 0.85),
         (0.85, 0.7), (0.7, 0.85)]
ACTUATOR = Actuator(zeta=0.2, j_lim=5.0, c1=2.0)
MATERIAL = NondimensionalParameters(zeta=0.2, j_lim=5.0, c1=2.0)
#: Error limit of the contenders.
LIMIT = 1e-10
#: The cheapest setting that keeps it.
POLYNOMIALS = contenders.Collocation(elements=2, degree=7)
#: As in the package: initial guess, a coarse first iteration, and the end of the search.
OURS = ['-DGUESS=2', '-DCOARSE=1e-7', '-DCUBICS']
NOT_INSTALLED = 'not installed'
ROOT = Path(__file__).resolve().parent.parent

Loads = Callable[[], list[float]]


class Reference:
    """The nine loads beta_p, to more digits than double precision."""

    def __init__(self) -> None:
        """Solve."""
        self._loads = [two_step(start, target, ACTUATOR)[0] for start, target in MOVES]

    def error(self, loads: list[float]) -> float:
        """Return the largest relative error of beta_p of each move."""
        return max(
            float(abs(type(exact)(load) / exact - 1))
            for load, exact in zip(loads, self._loads, strict=True))


def _all(solve: contenders.Solver) -> Loads:
    return lambda: [solve(start, target)[0] for start, target in MOVES]


def _contender(
        name: str, setting: str, solve: contenders.Solver, reference: Reference) -> Contender:
    loads = _all(solve)
    return Contender(
        name, setting, stopwatch(loads, len(MOVES)), reference.error(loads()))


def _ours(reference: Reference) -> list[Contender]:
    def public(rtol: float) -> contenders.Solver:
        def solve(start: float, target: float) -> tuple[float, float]:
            plan = plan_two_step(start, target, MATERIAL, rtol=rtol)
            return plan.beta_p, plan.tau_p
        return solve

    def bare(rtol: float) -> contenders.Solver:
        def solve(start: float, target: float) -> tuple[float, float]:
            return motion.two_step(
                start, 0.0, target, MATERIAL.packed, -np.inf, np.inf, rtol, HOLD_TOLERANCE)[1:3]
        return solve

    return [
        _contender(name, f'rtol {rtol:g}', make(rtol), reference)
        for make, name in ((public, 'plan_two_step'), (bare, 'its search alone'))
        for rtol in (1e-10, 1e-12)]


def _shaped(reference: Reference, setting: str, lag: float, creep: Creep) -> Contender:
    """Time the shaper; a lag of the coil adds an unknown, a branch adds a state."""
    material = replace(MATERIAL, creep=creep)
    requests = [
        MoveRequest(State(start), target, material, delivery=Delivery(lag=lag))
        for start, target in MOVES]

    def loads() -> list[float]:
        return [shaper(x).levels[0].load for x in requests]

    # The reference includes neither.
    error = reference.error(loads()) if lag == 0.0 and not creep else math.nan
    return Contender(
        'shaper two_step', setting, stopwatch(loads, len(MOVES)), error)


def _batches(reference: Reference, copies: int) -> list[Contender]:
    """Time the batch function on one thread and on all."""
    start, target = np.tile(np.array(MOVES), (copies, 1)).T
    found = []
    for rtol in (1e-10, 1e-12):
        for threads in sorted({1, available_cores()}):
            def work(rtol: float = rtol, threads: int = threads) -> np.ndarray:
                return plan_two_step_batch(start, target, rtol=rtol, workers=threads).beta_p

            loads = [float(x) for x in work()[:len(MOVES)]]
            found.append(Contender(
                f'plan_two_step_batch, {_threads(threads)}', f'rtol {rtol:g}',
                stopwatch(work, start.size), reference.error(loads)))
    return found


def _threads(count: int) -> str:
    return '1 thread' if count == 1 else f'{count} threads'


def _external(
        name: str, program: contenders.External, reference: Reference, repeats: int,
        limit: float, *, start: float = 1e-8) -> Contender:
    """Time a program at the loosest tolerance that keeps an error limit."""
    errors: dict[float, float] = {}

    def error(tolerance: float) -> float:
        errors[tolerance] = reference.error(program.run(tolerance, 1)[0])
        return errors[tolerance]

    tolerance = loosest(error, limit, start=start)

    def clock() -> tuple[float, float]:
        return program.run(tolerance, repeats)[1:]

    return Contender(name, f'tolerance {tolerance:.0e}', clock, errors[tolerance])


def _c_programs(
        directory: Path, reference: Reference, repeats: int, ours: float
) -> list[Contender]:
    found: list[Contender] = []
    for limit in sorted({LIMIT, ours}, reverse=True):
        for name, options in (
                ('C -O2, plainly written', []),
                ("C -O2, this package's choices", OURS)):
            program = contenders.compile_c(directory, f'c{len(found)}', options)
            found.append(_external(
                name, contenders.External([str(program)], ACTUATOR, MOVES), reference, repeats,
                limit))
    return found


def compare(*, quick: bool = False) -> Sheet:
    """Measure all installed contenders."""
    rounds = 1 if quick else 15
    reference = Reference()
    rows: list[Row] = []
    # Short batches find both cores free now and then, even on a busy machine.
    entries = _ours(reference) + _batches(reference, 2000)
    ours = entries[0].error
    branch = Creep((0.1,), (2.0,))
    entries += [_shaped(reference, *x) for x in (
        ('no lag', 0.0, Creep()), ('lag 0.1', 0.1, Creep()), ('a branch', 0.0, branch),
        ('lag 0.1 and a branch', 0.1, branch))]
    missing = []
    with tempfile.TemporaryDirectory() as folder:
        if contenders.compiler():
            entries += _c_programs(Path(folder), reference, 10 if quick else 1000, ours)
        else:
            missing.append('C')
        for name, method in (('CasADi, collocation, Newton', 'newton'),
                             ('CasADi, collocation, IPOPT', 'ipopt')):
            solve = contenders.with_casadi(method, ACTUATOR, POLYNOMIALS)
            if solve is None:
                missing.append(name)
            else:
                entries.append(_contender(
                    name, f'{POLYNOMIALS.elements} elements, degree {POLYNOMIALS.degree}',
                    solve, reference))
        tolerance = loosest(
            lambda x: reference.error(_all(contenders.with_scipy(ACTUATOR, x))()), LIMIT,
            start=1e-10)
        entries.append(_contender(
            'SciPy, DOP853 and brentq', f'tolerance {tolerance:.0e}',
            contenders.with_scipy(ACTUATOR, tolerance), reference))
        rows += race(entries, rounds)
        if contenders.octave() is None:
            missing.append('GNU Octave, ode45 and fzero')
        elif quick:
            rows.append(Row('GNU Octave, ode45 and fzero', note='left out: takes a minute'))
        else:
            program = contenders.External(
                [contenders.octave() or '', str(contenders.HERE / 'two_step.m')], ACTUATOR,
                MOVES)
            rows += race([_external(
                'GNU Octave, ode45 and fzero', program, reference, 2, LIMIT, start=1e-10)], 1)
    rows += [Row(name, note=NOT_INSTALLED) for name in missing]
    return table(
        'planner', 'Two-step plans: nine moves, zeta 0.2, J_lim 5, c1 2', 'time per plan',
        'error in beta_p', rows, _summary(rows))


def _summary(rows: list[Row]) -> list[str]:
    """Return the results of the batch function as sentences."""
    lines = []
    batches = [(x.setting, int(x.name.split()[-2]), x.least) for x in rows
               if x.name.startswith('plan_two_step_batch') and x.least is not None]
    for setting, _, one in (x for x in batches if x[1] == 1):
        lines.append(f'batch, {setting}, 1 thread: {1.0 / one:,.0f} plans/s')
        for other, threads, least in batches:
            if other == setting and threads > 1:
                lines.append(
                    f'batch, {setting}, {threads} threads: {1.0 / least:,.0f} plans/s, '
                    f'{100.0 * one / (threads * least):.0f} % of {threads} times one thread')
    return lines


# Effect of each choice in the kernel, shown in the C program, which has switches for them.
_GUESSES = (('half way', '0'), ('undamped energy', '1'), ('energy and damping', '2'))
CHOICES = [
    *((f'guess: {guess}', [f'-DGUESS={key}', *option], passes)
      for guess, key in reversed(_GUESSES)
      for option, passes in (
          ([], 'all iterations fine'), (['-DCOARSE=1e-7'], 'first at 1e-7'),
          (['-DCOARSE=1e-5'], 'first at 1e-5'),
          (['-DCOARSE=1e-7', '-DCUBICS'], 'first at 1e-7, ends by cubics'))),
    *((f'guess: {guess}; secant', [f'-DGUESS={key}', '-DSECANT'], 'all iterations fine')
      for guess, key in reversed(_GUESSES)),
]


def choices(*, quick: bool = False) -> Sheet:
    """Measure the effect of guess, derivatives and coarse integrations, in C, at equal error."""
    title = 'What the choices are worth, in the C program; error below 1e-11'
    if contenders.compiler() is None:
        return table('choices', title, 'time per plan', 'error in beta_p',
                     [Row('C', note=NOT_INSTALLED)])
    reference = Reference()
    with tempfile.TemporaryDirectory() as folder:
        entries = []
        for number, (name, options, passes) in enumerate(CHOICES[:2] if quick else CHOICES):
            program = contenders.compile_c(Path(folder), f'c{number}', options)
            entry = _external(
                name, contenders.External([str(program)], ACTUATOR, MOVES), reference,
                10 if quick else 1000, 1e-11)
            entries.append(replace(entry, setting=passes))
        rows = race(entries, 1 if quick else 10)
    return table('choices', title, 'time per plan', 'error in beta_p', rows)


_FIRST = (
    'from time import perf_counter; begin = perf_counter()\n'
    'from hmsa.model.parameters import NondimensionalParameters\n'
    'from hmsa.planning.two_step import plan_two_step\n'
    'imported = perf_counter()\n'
    'plan_two_step(1.0, 1.1, NondimensionalParameters())\n'
    'print(imported - begin, perf_counter() - imported)\n')


def _children() -> float:
    times = os.times()
    return times.children_user + times.children_system


def _process(command: list[str], **environment: str) -> list[float]:
    """Return elapsed and processor time of a command, and the numbers it prints."""
    before = _children()
    begin = perf_counter()
    done = subprocess.run(
        command, cwd=ROOT, check=True, capture_output=True, text=True, timeout=600.0,
        env={**os.environ, **environment})
    span = perf_counter() - begin
    printed = [float(x) for x in done.stdout.split() if x.replace('.', '', 1).isdigit()]
    return [span, _children() - before, *printed]


def start_up(*, quick: bool = False) -> Sheet:
    """Measure the first plan of a new process and of a new installation."""
    _process([sys.executable, '-c', _FIRST])
    runs = [_process([sys.executable, '-c', _FIRST]) for _ in range(1 if quick else 9)]
    names = ('new process, first plan, from start to end', 'of that, processor time',
             'of that, importing', 'of that, the first plan')
    rows = [Row(name, '', min(times), statistics.median(times))
            for name, times in zip(names, zip(*runs, strict=True), strict=True)]
    # Threads of the linear algebra library wait busily for work after the import of NumPy.
    alone = [_process([sys.executable, '-c', _FIRST], OMP_NUM_THREADS='1')[1] for _ in runs]
    rows.insert(2, Row(
        'of that, with OMP_NUM_THREADS=1, as hmsa sets it', '', min(alone),
        statistics.median(alone)))
    if not quick:
        rows += _installed()
    return table('start', 'Start', 'time', 'error', rows)


def _installed() -> list[Row]:
    """Install only the package into a new environment, and compute the first plan there."""
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        python = str(Path(folder) / 'bin' / 'python')
        # A clone has no files of an earlier build, which would be reused.
        clone = str(Path(folder) / 'clone')
        subprocess.run(['git', 'clone', '--quiet', str(ROOT), clone], check=True)
        install = _process([
            python, '-m', 'pip', 'install', '--no-deps', '--quiet',
            '--disable-pip-version-check', clone])
        # The requirements, whose download time depends on the network, are those of this Python.
        for site in Path(folder).glob('lib/python*/site-packages'):
            (site / 'requirements.pth').write_text(f'{sysconfig.get_path("purelib")}\n')
        first = _process([python, '-I', '-c', _FIRST])
    return [
        Row('pip install . without requirements, processor time', '', install[1], install[1]),
        Row('the first plan after it, processor time from start to end', '', first[1], first[1])]
