"""
The two-step command (Eq. 13) by other means, each as its users would write it.

Every factory returns a function of (start, target) that returns beta_p and tau_p, or an object
that runs a program; `None` if a requirement is not installed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
import os
from pathlib import Path
import shutil
import subprocess

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from benchmarks.reference import Actuator

Move = tuple[float, float]
Solver = Callable[[float, float], tuple[float, float]]

HERE = Path(__file__).resolve().parent
_PATIENCE = 600.0


def holding_load(stretch: float, j_lim: float) -> float:
    """Return the signed load beta_1 of a stretch inside the limits."""
    return (stretch - stretch ** -2) / (1.0 - (2.0 / stretch + stretch ** 2 - 3.0) / j_lim)


def acceleration(stretch, rate, load, actuator: Actuator):
    """Return l'' of Eq. 11 for numbers, arrays or symbols."""
    cube = stretch * stretch * stretch
    left = 1.0 - (2.0 / stretch + stretch * stretch - 3.0) / actuator.j_lim
    return (1.5 * rate * rate / stretch - 3.0 * actuator.zeta * actuator.c1 * cube * rate
            - 6.0 * ((cube * stretch - stretch) / left - load * cube)) / (
                1.0 + actuator.c1 * cube)


def with_scipy(actuator: Actuator, tolerance: float) -> Solver:
    """Shoot with SciPy: DOP853, its event for the turning point, brentq on the load."""
    def solve(start: float, target: float) -> tuple[float, float]:
        times = []

        def rate(_, state):
            return state[1]

        # SciPy reads attributes of the function.
        vars(rate).update(terminal=True, direction=-1.0 if target > start else 1.0)

        def miss(load: float) -> float:
            found = solve_ivp(
                lambda _, y: (y[1], acceleration(y[0], y[1], load, actuator)), (0.0, 100.0),
                (start, 0.0), method='DOP853', events=rate, rtol=tolerance, atol=tolerance)
            times.append(found.t_events[0][0])
            return found.y_events[0][0][0] - target

        low, high = holding_load(start, actuator.j_lim), holding_load(target, actuator.j_lim)
        load = brentq(
            miss, low + 0.01 * (high - low), high, xtol=0.1 * tolerance * abs(high - low),
            rtol=max(0.1 * tolerance, 1e-15))
        miss(load)
        return load, times[-1]

    return solve


@dataclass(frozen=True)
class Collocation:
    """Legendre collocation in CasADi on a few elements of free length."""

    elements: int = 2
    degree: int = 9

    def equations(self, actuator: Actuator):
        """Return symbols of unknowns and of start and target, equations, and a first guess."""
        import casadi

        # CasADi's own table of these points ends at degree 9 and has about ten digits.
        nodes = np.array([0.0, *(0.5 + 0.5 * np.polynomial.legendre.leggauss(self.degree)[0])])
        gaps = nodes[:, None] - nodes + np.eye(nodes.size)
        weights = 1.0 / np.prod(gaps, axis=1)
        # slopes[i, j] is the slope of the basis polynomial i at node j.
        slopes = weights[:, None] / weights / gaps.T
        np.fill_diagonal(slopes, 0.0)
        np.fill_diagonal(slopes, -np.sum(slopes, axis=0))
        ends = weights / (1.0 - nodes)
        ends /= np.sum(ends)
        load, time = casadi.SX.sym('load'), casadi.SX.sym('time')
        ends_of_move = casadi.SX.sym('ends', 2)
        unknowns, equations, stretches = [], [], []
        stretch, rate = ends_of_move[0], casadi.SX(0)
        for m in range(self.elements):
            inner = casadi.SX.sym(f'inner_{m}', 2, self.degree)
            unknowns.append(casadi.vec(inner))
            states = casadi.horzcat(casadi.vertcat(stretch, rate), inner)
            length = time / self.elements
            for j in range(1, nodes.size):
                slope = casadi.mtimes(states, slopes[:, j])
                force = acceleration(states[0, j], states[1, j], load, actuator)
                equations += [slope[0] - length * states[1, j], slope[1] - length * force]
            end = casadi.mtimes(states, ends)
            stretches += [(m + x) / self.elements for x in nodes[1:]]
            if m + 1 < self.elements:
                # The ends of elements are unknowns too, which keeps the equations sparse.
                node = casadi.SX.sym(f'node_{m}', 2)
                unknowns.append(node)
                equations += [node[0] - end[0], node[1] - end[1]]
                stretches.append((m + 1.0) / self.elements)
                stretch, rate = node[0], node[1]
        equations += [end[0] - ends_of_move[1], end[1]]
        shares = np.array(stretches)

        def guess(start: float, target: float):
            # Half a period of a linear oscillator.
            middle = holding_load(0.5 * (start + target), actuator.j_lim)
            mass = (target ** -3 + actuator.c1) / 6.0
            step = 1e-6
            stiffness = (holding_load(target + step, actuator.j_lim)
                         - holding_load(target - step, actuator.j_lim)) / (2.0 * step)
            swing = math.pi * math.sqrt(mass / stiffness)
            states = np.empty((2, shares.size))
            states[0] = start + (target - start) * 0.5 * (1.0 - np.cos(math.pi * shares))
            states[1] = ((target - start) * 0.5 * math.pi / swing
                         * np.sin(math.pi * shares))
            return np.array([*states.T.ravel(), middle, swing])

        symbols = casadi.vertcat(*unknowns, load, time)
        return symbols, ends_of_move, casadi.vertcat(*equations), guess


def with_casadi(method: str, actuator: Actuator, collocation: Collocation) -> Solver | None:
    """Solve the collocation equations by IPOPT, as an optimal control problem, or by Newton."""
    try:
        import casadi
    except ImportError:
        return None
    symbols, ends, equations, guess = collocation.equations(actuator)
    problem = {'x': symbols, 'p': ends, 'g': equations}
    bounds = {}
    if method == 'ipopt':
        bounds = {'lbg': 0.0, 'ubg': 0.0}
        solver = casadi.nlpsol(
            'plan', 'ipopt', {**problem, 'f': 0},
            {'ipopt.print_level': 0, 'print_time': False, 'ipopt.sb': 'yes', 'ipopt.tol': 1e-13,
             'ipopt.constr_viol_tol': 1e-13})
    else:
        solver = casadi.rootfinder(
            'plan', 'newton', problem,
            {'abstol': 1e-12, 'linear_solver': 'csparse', 'max_iter': 50})

    def solve(start: float, target: float) -> tuple[float, float]:
        found = solver(x0=guess(start, target), p=[start, target], **bounds)['x']
        return float(found[-2]), float(found[-1])

    return solve


class External:
    """
    A program that reads moves, solves them repeatedly and times itself.

    Tolerance and number of repetitions follow the first arguments of ``command``.
    """

    def __init__(
            self, command: Sequence[str], actuator: Actuator, moves: Sequence[Move]) -> None:
        """Store the command and the input."""
        self._command = command
        self._input = ''.join(
            f'{start!r} {target!r} {actuator.zeta!r} {actuator.j_lim!r} {actuator.c1!r}\n'
            for start, target in moves)

    def run(self, tolerance: float, repeats: int) -> tuple[list[float], float, float]:
        """Solve the moves; return beta_p of each, and minimum and median seconds per plan."""
        done = subprocess.run(
            [*self._command, repr(tolerance), str(repeats)], input=self._input, check=True,
            capture_output=True, text=True, timeout=_PATIENCE)
        *solutions, times = done.stdout.strip().splitlines()
        least, median = (1e-9 * float(x) for x in times.split())
        return [float(line.split()[0]) for line in solutions], least, median


def compiler() -> str | None:
    """Return the C compiler named by CC, else cc; None if there is none."""
    return shutil.which(os.environ.get('CC') or 'cc')


def compile_c(
        directory: Path, name: str, options: Sequence[str], source: str = 'two_step.c') -> Path:
    """Compile a C program with -O2, unless options override it."""
    program = directory / name
    subprocess.run(
        [compiler() or 'cc', '-O2', *options, '-o', str(program), str(HERE / source),
         '-lm'], check=True, capture_output=True, timeout=_PATIENCE)
    return program


def octave() -> str | None:
    """Return GNU Octave's program without windows, None if there is none."""
    return shutil.which('octave-cli') or shutil.which('octave')
