"""A creeping Gent block under levels, by SciPy: an oracle independent of the package."""

import math

import numpy as np
from scipy.integrate import solve_ivp

J, ZETA, C1 = 5.0, 0.2, 2.0


def elastic(x):
    """Return psi' and psi'' of a Gent block."""
    above = x - x ** -2
    g = 1.0 - (x * x + 2.0 / x - 3.0) / J
    return above / g, ((1.0 + 2.0 * x ** -3) + 2.0 * above ** 2 / (J * g)) / g


def motion(t, y, load, slope, lag, creep, zeta):
    """Return the derivative of stretch, rate, field and branch stresses; t within a piece."""
    ratios = np.array(creep.ratios)
    x, v, field, held = y[0], y[1], y[2], y[3:]
    field = field if lag else load + slope * t
    force, stiffness = elastic(x)
    mass = (x ** -3 + C1) / 6.0
    return [v, (field - force - held.sum() - 0.5 * zeta * C1 * v + 0.25 * x ** -4 * v * v) / mass,
            (load + slope * t - field) / lag if lag else 0.0,
            *(ratios * stiffness * v - flowing(held, ratios, creep))]


def flowing(held, ratios, creep):
    """Return the rate at which branches relax: J. S. Bergstroem and M. C. Boyce, 1998."""
    lost = held / np.array(creep.times)
    if creep.flow == 'power_law':
        exponents, stresses = map(np.array, creep.constants)
        lost = lost * (np.abs(held) / (ratios * stresses)) ** (exponents - 1.0)
    return lost


def ended(levels, creep, end, delivery):
    """Return the state at the end; without lag, the field is that of the amplifier."""
    levels = [x for x in levels if x[0] < end]
    state = judged(levels, creep, end, delivery.slew, delivery.lag)[2]
    if delivery.lag == 0.0:
        state[2] = levels[-1][1]
    return state


def judged(levels, creep, end, slew=math.inf, lag=0.0, zeta=ZETA):
    """Return times and stretches under levels (time, load) from rest at 1, by SciPy; the end."""
    state = np.zeros(3 + len(creep.ratios))
    state[0], output = 1.0, 0.0
    times, stretches = [], []
    for (begin, load), until in zip(levels, [x[0] for x in levels[1:]] + [end], strict=True):
        reached = min(begin + abs(load - output) / slew, until)
        ramp = math.copysign(slew, load - output) if reached > begin else 0.0
        after = output + ramp * (reached - begin) if reached == until else load
        for start, stop, first, slope in (
                (begin, reached, output, ramp), (reached, until, after, 0.0)):
            if stop <= start:
                continue
            found = solve_ivp(
                motion, (0.0, stop - start), state, method='DOP853', rtol=1e-11, atol=1e-12,
                t_eval=np.linspace(0.0, stop - start, 9 + int(6 * (stop - start))),
                # Longer steps would miss a field that decays within a few lags.
                max_step=max(lag, (stop - start) / 1000.0) if lag else math.inf,
                args=(first, slope, lag, creep, zeta))
            times.append(start + found.t)
            stretches.append(found.y[0])
            state = found.y[:, -1]
        output = after
    return np.concatenate(times), np.concatenate(stretches), state
