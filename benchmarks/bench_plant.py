"""
Time the simulation of one unit of nondimensional time by the plant at an error of 1e-9.

The paper's sequence 1 to 1.1 to 1.2 to 1.4 with unshaped steps, ten units each, vibrates
throughout. It is sampled ten times a unit, more often than by a plant node at 1 kHz. Errors are
those of the samples against solutions in 40-digit arithmetic. Every method uses the loosest
tolerance, or the longest step, that keeps the error.
"""

from collections.abc import Callable
from functools import partial
import math

import numpy as np
from scipy.integrate import odeint, solve_ivp

from benchmarks.contenders import acceleration, holding_load
from benchmarks.measure import Contender, loosest, race, stopwatch, table
from benchmarks.reference import Actuator, response
from benchmarks.sheet import Sheet
from hmsa.model.moves import Level, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import RTOL, sampled

LIMIT = 1e-9
ACTUATOR = Actuator(zeta=0.2, j_lim=5.0, c1=2.0)
MATERIAL = NondimensionalParameters(zeta=0.2, j_lim=5.0, c1=2.0)
TARGETS = (1.1, 1.2, 1.4)

#: Returns stretch and rate at times from a state on, under a load.
Follow = Callable[[np.ndarray, float, np.ndarray], np.ndarray]


class Sequence:
    """Steps of equal duration, and the sampling times."""

    def __init__(self, span: float, rate: int) -> None:
        """Make the grid."""
        self.span = span
        self.switches = [i * span for i in range(len(TARGETS))]
        self.loads = [holding_load(x, ACTUATOR.j_lim) for x in TARGETS]
        self.each = round(span * rate)
        self.times = np.arange(1, len(TARGETS) * self.each + 1) / rate

    @property
    def length(self) -> float:
        """Simulated time."""
        return self.span * len(TARGETS)

    def pieces(self, follow: Follow) -> np.ndarray:
        """Simulate step by step, with times from the start of the step."""
        state = np.array([1.0, 0.0])
        stretch = []
        times = self.times[:self.each]
        for load in self.loads:
            states = follow(state, load, times)
            stretch.append(states[0])
            state = states[:, -1]
        return np.concatenate(stretch)


def _package(sequence: Sequence, rtol: float) -> np.ndarray:
    levels = list(map(Level, sequence.switches, sequence.loads))
    return sampled(levels, State(1.0), sequence.times, MATERIAL, rtol=rtol)[0]


def _scipy(
        tolerance: float, state: np.ndarray, load: float, times: np.ndarray) -> np.ndarray:
    return solve_ivp(
        lambda _, y: (y[1], acceleration(y[0], y[1], load, ACTUATOR)), (0.0, times[-1]), state,
        method='DOP853', t_eval=times, rtol=tolerance, atol=tolerance).y


def _odeint(
        tolerance: float, state: np.ndarray, load: float, times: np.ndarray) -> np.ndarray:
    return odeint(
        lambda y, _: (y[1], acceleration(y[0], y[1], load, ACTUATOR)), state,
        np.concatenate([[0.0], times]), rtol=tolerance, atol=tolerance, mxstep=10_000)[1:].T


def _python(steps: int, state: np.ndarray, load: float, times: np.ndarray) -> np.ndarray:
    """Follow by RK4 in plain Python with a number of steps between two samples."""
    l, v = (float(x) for x in state)  # noqa: E741
    h = float(times[0]) / steps
    half = 0.5 * h
    samples = np.empty((2, times.size))
    for i in range(times.size):
        for _ in range(steps):
            a1 = acceleration(l, v, load, ACTUATOR)
            v2 = v + half * a1
            a2 = acceleration(l + half * v, v2, load, ACTUATOR)
            v3 = v + half * a2
            a3 = acceleration(l + half * v2, v3, load, ACTUATOR)
            v4 = v + h * a3
            a4 = acceleration(l + h * v3, v4, load, ACTUATOR)
            l += h / 6.0 * (v + 2.0 * (v2 + v3) + v4)  # noqa: E741
            v += h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)
        samples[:, i] = l, v
    return samples


def compare(*, quick: bool = False) -> Sheet:
    """Measure all."""
    sequence = Sequence(1.0, 10) if quick else Sequence(10.0, 10)
    exact = np.array(
        [float(x) for x in response(
            sequence.switches, sequence.loads, sequence.times.tolist(), 1.0, ACTUATOR)])

    def error(stretch: np.ndarray) -> float:
        if stretch.size != exact.size or not np.all(np.isfinite(stretch)):
            return math.nan
        return float(np.max(np.abs(stretch - exact)))

    def timed(name: str, setting: str, run: Callable[[], np.ndarray]) -> Contender:
        return Contender(name, setting, stopwatch(run, sequence.length), error(run()))

    def stepped(follow: Callable[..., np.ndarray], setting: float) -> np.ndarray:
        return sequence.pieces(partial(follow, setting))

    entries = []
    for name, run in (
            ('simulate', partial(_package, sequence)),
            ('SciPy solve_ivp, DOP853', partial(stepped, _scipy)),
            ('SciPy odeint, LSODA', partial(stepped, _odeint))):
        def error_at(tolerance: float, run: Callable[[float], np.ndarray] = run) -> float:
            return error(run(tolerance))

        tolerance = loosest(error_at, LIMIT)
        entries.append(timed(name, f'tolerance {tolerance:.0e}', partial(run, tolerance)))
    entries.insert(1, timed(
        'simulate, as the plant node', f'rtol {RTOL:.0e}', partial(_package, sequence, RTOL)))
    march = partial(stepped, _python)
    steps = 1
    while not error(march(steps)) <= LIMIT:
        steps += 1
    entries.append(timed(
        'RK4 in plain Python', f'{sequence.each / sequence.span * steps:.0f} steps a unit',
        partial(march, steps)))
    return table(
        'plant', f'Simulation of {sequence.length:g} units of time, '
        f'{sequence.times.size} samples, error below {LIMIT:g}', 'time per unit',
        'error in stretch', race(entries, 1 if quick else 7))
