"""A creeping block under levels, ramps and lag, by SciPy: independent of the package."""

from itertools import pairwise
import math

from core_oracle import integrate
import numpy as np

from hmsa.model.creep import Creep

J, ZETA, C1 = 5.0, 0.2, 2.0
TOLERANCE = 1e-12


def elastic(x, j_lim=J):
    """Return psi' and psi'' of a Gent block."""
    above = x - x ** -2
    g = 1.0 - (x * x + 2.0 / x - 3.0) / j_lim
    return above / g, ((1.0 + 2.0 * x ** -3) + 2.0 * above ** 2 / (j_lim * g)) / g


def yeoh(x):
    """Return psi' and psi'' of a Yeoh block with c10, c20 and c30 of 0.5, -0.02 and 0.004."""
    i, d, dd = x * x + 2.0 / x - 3.0, 2.0 * (x - x ** -2), 2.0 + 4.0 * x ** -3
    first = 0.5 - 0.04 * i + 0.012 * i * i
    return first * d, first * dd + (-0.04 + 0.024 * i) * d * d


def relaxing(held, ratio, time, exponent=1.0, stress=1.0):
    """Return the rate at which a branch relaxes: J. S. Bergstroem and M. C. Boyce, 1998."""
    return held / time * (abs(held) / (ratio * stress)) ** (exponent - 1.0)


def motion(t, y, load, slope, begin, lag, branches, zeta, law):
    """Return the derivative of stretch, rate, field and branch stresses."""
    x, v, field, *held = y.tolist()
    output = load + slope * (t - begin)
    force, stiffness = law(x)
    pull = (field if lag else output) - force - sum(held)
    return [v, (pull - 0.5 * zeta * C1 * v + 0.25 * x ** -4 * v * v) * 6.0 / (x ** -3 + C1),
            (output - field) / lag if lag else 0.0,
            *(branch[0] * stiffness * v - relaxing(h, *branch)
              for h, branch in zip(held, branches, strict=True))]


def follow(
        levels, times, creep=None, slew=math.inf, lag=0.0, zeta=ZETA, law=elastic,
        start=(1.0, 0.0), output=0.0, field=None, tolerance=TOLERANCE):
    """Return the states at increasing times under levels (time, load), with ramps and lag."""
    creep = creep or Creep()
    constants = creep.constants if creep.flow == 'power_law' else ()
    branches = list(zip(creep.ratios, creep.times, *constants, strict=True))
    y = np.array([*start, output if field is None else field, *(0.0 for _ in branches)])
    rows, done = [], 0
    last = max(times[-1], levels[-1][0]) + 1e-9
    for (begin, load), (until, _) in pairwise([*levels, (last, 0.0)]):
        reached = min(begin + abs(load - output) / slew, until)
        ramp = math.copysign(slew, load - output) if reached > begin else 0.0
        after = output + ramp * (reached - begin) if reached == until else load
        for first, stop, value, slope in (
                (begin, reached, output, ramp), (reached, until, after, 0.0)):
            if stop > first:
                here = np.searchsorted(times, stop)
                seen = integrate(
                    motion, [first, *times[done:here], stop], y, value, slope, first, lag,
                    branches, zeta, law, rtol=tolerance, atol=tolerance)
                rows += list(seen[1:-1])
                y, done = seen[-1], here
        output = after
    return np.array(rows)


def ended(levels, creep, end, delivery):
    """Return the state at the end; without lag, the field is that of the amplifier."""
    levels = [x for x in levels if x[0] < end]
    state = judged(levels, creep, end, delivery.slew, delivery.lag)[2]
    if delivery.lag == 0.0:
        state[2] = levels[-1][1]
    return state


def judged(levels, creep, end, slew=math.inf, lag=0.0, **more):
    """Return times and stretches under levels from rest at 1, and the state at the end."""
    times = np.concatenate([
        np.linspace(begin, until, 9 + int(6.0 * (until - begin)))
        for (begin, _), (until, _) in pairwise([*levels, (end, 0.0)])])
    states = follow(levels, times, creep, slew, lag, **more)
    return times, states[:, 0], states[-1]
