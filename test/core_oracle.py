"""
Eq. 11 and the two-step command, implemented independently: an oracle for the tests.

The equation is written as in the paper, SciPy integrates it, and the intermediate load is found by
bracketing. Nothing here calls the package.
"""

from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
import math

import numpy as np
from scipy.integrate import ode, odeint
from scipy.optimize import brentq

TOLERANCE = 1e-13


def extension(stretch: float, j_lim: float) -> float:
    """Return the factor in the braces of Eq. 11, which vanishes at the limiting stretches."""
    return 1.0 - (2.0 / stretch + stretch * stretch - 3.0) / j_lim


def holding_load(stretch: float, j_lim: float) -> float:
    """Return b^2 of Eq. 11 at rest."""
    return (stretch ** 4 - stretch) / extension(stretch, j_lim) / stretch ** 3


def stored_energy(stretch: float, j_lim: float) -> float:
    """Return the elastic energy of Eq. 4 in units of G."""
    return -0.5 * j_lim * math.log(extension(stretch, j_lim))


def equation(
        load: float, zeta: float, j_lim: float, c1: float, slope: float = 0.0
) -> Callable[[float, Sequence[float]], list[float]]:
    """Return the right-hand side of Eq. 11 with b^2 = load + slope t, of either sign."""
    def right_hand_side(t: float, state: Sequence[float]) -> list[float]:
        # Products of Python's numbers, which take half the time of those of NumPy.
        stretch, rate = float(state[0]), float(state[1])
        cube = stretch * stretch * stretch
        inertia = 1.0 + c1 * cube
        return [rate, (
            1.5 * rate * rate / (stretch * inertia)
            - 3.0 * zeta * c1 * cube * rate / inertia
            - 6.0 / inertia * (
                stretch * (cube - 1.0) / extension(stretch, j_lim)
                - (load + slope * t) * cube))]
    return right_hand_side


def integrate(
        rates: Callable[..., Sequence[float]], times: Sequence[float], state: Sequence[float],
        *arguments: float, **options: float) -> np.ndarray:
    """Return the states at times, by LSODA, which takes a tenth of the time of `solve_ivp`."""
    # Times that only differ by rounding are not accepted.
    apart = np.diff(times, prepend=-math.inf) > 1e-11
    states = odeint(
        rates, state, np.asarray(times)[apart], arguments, tfirst=True, mxstep=100_000, **options)
    return states[np.cumsum(apart) - 1]


def ended(
        rates: Callable[..., Sequence[float]], state: Sequence[float], span: float,
        *arguments: float, rtol: float = TOLERANCE, atol: float = TOLERANCE,
        seen: Callable[[float, np.ndarray], int] = lambda *_: 0) -> np.ndarray:
    """
    Return the state after a span, by the compiled DOP853: in a third of `solve_ivp`'s time.

    ``seen`` is called after each step, and returns -1 to end there.
    """
    # Its own guess of the first step fails where rates underflow.
    solver = ode(rates).set_integrator(
        'dop853', rtol=rtol, atol=atol, nsteps=100_000, first_step=0.01 * span)
    solver.set_solout(seen)
    end = solver.set_f_params(*arguments).set_initial_value(state).integrate(span)
    assert solver.successful(), f'DOP853 ends with {solver.get_return_code()}'
    return end


def follow(
        state: Sequence[float], pieces: Sequence[tuple[float, float]], zeta: float,
        j_lim: float, c1: float, tolerance: float = TOLERANCE) -> tuple[float, float]:
    """Return stretch and rate after pieces of (duration, load)."""
    end = state
    for duration, load in pieces:
        if duration > 0.0:
            end = ended(
                equation(load, zeta, j_lim, c1), end, duration, rtol=tolerance, atol=tolerance)
    return float(end[0]), float(end[1])


def samples(
        state: Sequence[float], switches: Sequence[float], loads: Sequence[float],
        times: Sequence[float], zeta: float, j_lim: float, c1: float) -> np.ndarray:
    """Return stretch and rate (2, n) at times, with each piece integrated separately."""
    edges = sorted({*switches, *times})
    edges = [t for t in edges if t >= switches[0]]
    found = {edges[0]: np.array(state, dtype=float)}
    for begin, end in pairwise(edges):
        load = loads[int(np.searchsorted(switches, begin, side='right')) - 1]
        found[end] = np.array(
            follow(found[begin], [(end - begin, load)], zeta, j_lim, c1))
    return np.array([found[t] for t in times]).T


def turning_point(
        state: Sequence[float], load: float, direction: float, zeta: float, j_lim: float,
        c1: float, longest: float = 200.0) -> tuple[float, float] | None:
    """
    Return time and stretch of the first turning point of a motion in a direction.

    The steps of the integration enclose it; Newton's method finds it from the last step before.
    """
    right_hand_side = equation(load, zeta, j_lim, c1)
    steps = []

    def turned() -> bool:
        return len(steps) > 1 and steps[-2][2] * direction >= 0.0 >= steps[-1][2] * direction

    def seen(time: float, y: np.ndarray) -> int:
        steps.append((time, *y))
        return -1 if turned() else 0

    ended(right_hand_side, state, longest, seen=seen)
    if not turned():
        return None
    (begin, *before), (after, _, rate) = steps[-2:]
    time = begin + (after - begin) * before[1] / (before[1] - rate)
    for _ in range(10):
        end = follow(before, [(time - begin, load)], zeta, j_lim, c1)
        change = -end[1] / right_hand_side(0.0, end)[1]
        time += change
        if abs(change) < 1e-14 * time:
            break
    return time, follow(before, [(time - begin, load)], zeta, j_lim, c1)[0]


@cache
def two_step(
        start: float, target: float, zeta: float, j_lim: float, c1: float = 2.0
) -> tuple[float, float, float]:
    """Return beta_p, tau_p and beta_1 of a move from rest, by bracketing beta_p."""
    direction = math.copysign(1.0, target - start)
    held = holding_load(target, j_lim)
    # Without damping the energy balance is exact; damping needs more.
    least = (stored_energy(target, j_lim) - stored_energy(start, j_lim)) / (target - start)

    def miss(load: float) -> float:
        found = turning_point((start, 0.0), load, direction, zeta, j_lim, c1)
        # Without a turning point, the motion approaches the equilibrium of the load.
        return -abs(target - start) if found is None else direction * (found[1] - target)

    share = 1e-3
    while miss(least + share * (held - least)) < 0.0:
        share = 2.0 * share if share < 0.5 else 0.5 * (1.0 + share)
        assert share < 0.9999, 'no load below the holding one overshoots'
    most = least + share * (held - least)
    # Without damping, the smallest load is the solution itself, within rounding.
    least -= 1e-9 * (held - least)
    load = brentq(miss, least, most, xtol=1e-15, rtol=1e-14)
    time, _ = turning_point((start, 0.0), load, direction, zeta, j_lim, c1)
    return load, time, held


#: The paper's sequences: figure, zeta, J_lim, stretches; Fig. 9 ends near the limit.
UPPER_LIMIT = {
    j_lim: brentq(extension, 1.0, 10.0, args=(j_lim,), xtol=1e-15) for j_lim in (1.0, 3.0, 5.0)}
SEQUENCES = (
    ('fig_4_5', 0.2, 5.0, (1.10, 1.20, 1.40)),
    ('fig_5', 0.2, 5.0, (1.15, 1.25, 1.35)),
    ('fig_6', 0.2, 5.0, (0.90, 0.80, 0.70)),
    ('fig_6_return', 0.2, 5.0, (0.85, 0.70, 0.85)),
    *(('fig_7a', zeta, 5.0, (1.10, 1.20, 1.40)) for zeta in (0.02, 0.40, 1.10)),
    *(('fig_7b', zeta, 5.0, (0.90, 0.80, 0.60)) for zeta in (0.02, 0.40, 1.10)),
    *(('fig_9', 0.2, j_lim, (1.20, 1.40, 0.999 * UPPER_LIMIT[j_lim]))
      for j_lim in (1.0, 3.0, 5.0)),
)
#: Every move of every sequence, and moves to 0.999 of the limit with the other dampings.
MOVES = tuple(sorted({
    *((start, target, zeta, j_lim)
      for _, zeta, j_lim, stretches in SEQUENCES
      for start, target in pairwise((1.0, *stretches))),
    *((1.4, 0.999 * UPPER_LIMIT[j_lim], zeta, j_lim)
      for j_lim in (1.0, 3.0, 5.0) for zeta in (0.02, 0.40, 1.10)),
}))
