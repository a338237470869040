"""
Compiled planning for an elastomer that creeps: moves with their derivatives, and the tail.

As in `hmsa_ros.core.creep_kernel`, everything is nondimensional, branch i holds
``gamma_i (psi'(l) - w_i)``, and nothing checks its arguments. ``branches`` (n, 2) has the columns
`hmsa_ros.core.creep_kernel.RATIO` and `SPEED`.
"""

import cmath
import math

import numpy as np

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.creep_kernel import RATIO, SPEED
from hmsa_ros.core.dop853 import ERROR_3, ERROR_5, MATRIX, STAGES, WEIGHTS
from hmsa_ros.core.kernels import attainable, DONE, first_step, MAX_STEPS, resize, STUCK
from hmsa_ros.core.law import (
    damping,
    elastic_force,
    elastic_stiffness,
    mass,
    motion,
    natural_frequency,
)
from hmsa_ros.core.laws.record import ANY

#: Columns of a staircase: time, load over that of rest, deviation of stretch, and rate.
TIME, EXCESS, DEVIATION, RATE = range(4)

# Derivatives of the state by so many parameters.
_PARAMETERS = 2
# Vibration that a pair of levels leaves, in units of slope of the tail times duration^3/mass.
_PAIR = 0.05
# Longest level of a pair, in half periods, and the phase beyond which a grid allows none.
_LONGEST = 0.5
_LAST_PHASE = 2.6
# Vibration about a single level in units of the drift during it: the drift, what a step of that
# height rings to both sides, and some to be sure.
_SINGLE = 3.5
_HALVINGS = 60


@compiled(inline=True)
def _change(x, load, d_load, material, branches, change):
    """
    Write the derivative by time of the state and of its derivatives by the parameters.

    The state ``x`` is stretch, rate and what the branches follow, then the same of each
    parameter, of which ``d_load`` are the derivatives of the load.
    """
    count = branches.shape[0]
    width = 2 + count
    force, stiffness = elastic_force(x[0], material), elastic_stiffness(x[0], material)
    for b in range(count):
        above = force - x[2 + b]
        load -= branches[b, RATIO] * above
        change[2 + b] = branches[b, SPEED] * above
    a, a_l, a_v, a_beta = motion(x[0], x[1], load, material, ANY)
    change[0] = x[1]
    change[1] = a
    for c in range(_PARAMETERS):
        at = (1 + c) * width
        pull = d_load[c]
        for b in range(count):
            above = stiffness * x[at] - x[at + 2 + b]
            pull -= branches[b, RATIO] * above
            change[at + 2 + b] = branches[b, SPEED] * above
        change[at] = x[at + 1]
        change[at + 1] = a_l * x[at] + a_v * x[at + 1] + a_beta * pull


@compiled()
def _step(k, x, new, load, d_load, h, material, branches, rtol):
    """One DOP853 step of length ``h`` from ``x`` to ``new``; returns the error of the state."""
    size = x.size
    width = 2 + branches.shape[0]
    for i in range(STAGES):
        new[:] = 0.0
        for j in range(i):
            w = MATRIX[i, j]
            if w != 0.0:
                for m in range(size):
                    new[m] += w * k[j, m]
        for m in range(size):
            new[m] = x[m] + h * new[m]
        _change(new, load, d_load, material, branches, k[i])
    e5 = e3 = 0.0
    for m in range(size):
        d = f5 = f3 = 0.0
        for j in range(STAGES):
            d += WEIGHTS[j] * k[j, m]
            f5 += ERROR_5[j] * k[j, m]
            f3 += ERROR_3[j] * k[j, m]
        new[m] = x[m] + h * d
        if m < width:
            scale = 1.0 / (rtol * (1.0 + abs(new[m])))
            e5 += (f5 * scale) ** 2
            e3 += (f3 * scale) ** 2
    error = 0.0
    if e5 != 0.0:
        error = abs(h) * e5 / math.sqrt(width * (e5 + 0.01 * e3))
    return error


@compiled()
def _advance(k, x, new, load, d_load, duration, material, branches, rtol):
    """Integrate the state ``x`` in place over a duration; returns the status."""
    total, fastest = 1.0, 0.0
    for b in range(branches.shape[0]):
        total += branches[b, RATIO]
        fastest = max(fastest, branches[b, SPEED])
    stiff = math.sqrt(total)
    h = 1.0 / (stiff / first_step(x[0], x[1], load, material, rtol)
               + 0.25 * rtol ** -0.125 * fastest)
    done = 0.0
    for _ in range(MAX_STEPS):
        left = duration - done
        if not left > 0.0:
            return DONE
        span = min(h, left)
        error = _step(
            k, x, new, load, d_load, span, material, branches,
            attainable(rtol, x[0], x[1], stiff * natural_frequency(x[0], material)))
        if error <= 1.0:
            x[:] = new
            done = duration if span == left else done + span
            if span == h or error > 0.5:
                h = resize(span, error)
        else:
            h = resize(span, error)
    return STUCK


@compiled()
def respond_creeping(
        l, v, followed, durations, loads, d_durations, d_loads, material, branches,  # noqa: E741
        rtol, jacobian):
    """
    Follow levels and differentiate the end by two parameters, as `kernels.respond` does.

    ``followed`` (n,) is what the branches have followed at the start. Returns status, stretch
    and rate.
    """
    width = 2 + branches.shape[0]
    size = (1 + _PARAMETERS) * width
    k = np.empty((STAGES, size))
    x, new = np.zeros(size), np.empty(size)
    x[0], x[1] = l, v
    x[2:width] = followed
    for m in range(durations.size):
        status = _advance(
            k, x, new, loads[m], d_loads[m], durations[m], material, branches, rtol)
        if status != DONE:
            return status, x[0], x[1]
        _change(x, loads[m], d_loads[m], material, branches, k[0])
        for c in range(_PARAMETERS):
            for i in range(width):
                x[(1 + c) * width + i] += k[0, i] * d_durations[m, c]
    for c in range(_PARAMETERS):
        jacobian[0, c] = x[(1 + c) * width]
        jacobian[1, c] = x[(1 + c) * width + 1]
    return DONE, x[0], x[1]


# -- the tail ------------------------------------------------------------------------------------


@compiled()
def _left(excess, branches, time):
    """Return of the tail at a time: its value, the bounds of value and slope, and its slope."""
    value = bound = steepest = slope = 0.0
    for b in range(excess.size):
        part = excess[b] * math.exp(-branches[b, SPEED] * time)
        value += part
        slope -= branches[b, SPEED] * part
        bound += abs(part)
        steepest += branches[b, SPEED] * abs(part)
    return value, bound, steepest, slope


@compiled()
def _passed(excess, branches, mode, time, span):
    """Return what a mode exp(mode t) has taken up of the tail at the end of a span."""
    taken = 0.0j
    for b in range(excess.size):
        speed = branches[b, SPEED]
        gap = (mode + speed) * span
        weight = span * cmath.exp(mode * span)
        if abs(gap) > 1e-7:
            weight = (cmath.exp(mode * span) - math.exp(-speed * span)) / (mode + speed)
        taken += excess[b] * math.exp(-speed * time) * weight
    return taken


@compiled()
def _pair(excess, branches, modes, inertia, time, span, out):
    """
    Write two levels of the same length between which the oscillator goes from rest to rest.

    ``modes`` are the two eigenvalues of its motion. Row 0 of ``out`` gets the first level and
    row 1 the second, with deviation and rate where it begins; False if there are none.
    """
    once = np.empty(2, np.complex128)
    first, second = np.empty(2, np.complex128), np.empty(2, np.complex128)
    for i in range(2):
        once[i] = (cmath.exp(modes[i] * span) - 1.0) / modes[i]
        first[i] = _passed(excess, branches, modes[i], time, span)
        second[i] = first[i] * cmath.exp(modes[i] * span) + _passed(
            excess, branches, modes[i], time + span, span)
    # Both modes are still at the end: a exp(mode span) once + b once = second.
    a = (second[0] / once[0] - second[1] / once[1]) / (
        cmath.exp(modes[0] * span) - cmath.exp(modes[1] * span))
    b = second[0] / once[0] - a * cmath.exp(modes[0] * span)
    gap = inertia * (modes[0] - modes[1])
    z, y = a * once[0] - first[0], a * once[1] - first[1]
    out[0, TIME], out[0, EXCESS], out[0, DEVIATION], out[0, RATE] = time, a.real, 0.0, 0.0
    out[1, TIME], out[1, EXCESS] = time + span, b.real
    out[1, DEVIATION] = ((z - y) / gap).real
    out[1, RATE] = ((modes[0] * z - modes[1] * y) / gap).real


@compiled()
def _single_span(excess, branches, time, drift, shortest, period):
    """Return for how long the tail may go down by a drift: odd multiples of a half period."""
    _, bound, _, _ = _left(excess, branches, time)
    low, high = 0.0, shortest
    while high < 1e300:
        _, later, _, _ = _left(excess, branches, time + high)
        if bound - later > drift or later < drift:
            break
        high *= 2.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        _, later, _, _ = _left(excess, branches, time + middle)
        if bound - later > drift:
            high = middle
        else:
            low = middle
    count = max(math.floor(low / shortest), 1.0)
    # Rings of equal steps an odd number of half periods apart cancel.
    span = shortest * (count - (count % 2.0 == 0.0))
    if period > 0.0:
        span = max(math.floor(span / period + 0.5), 1.0) * period
    return span


@compiled()
def staircase(excess, branches, stretch, material, period, end, ripple, out):
    """
    Follow the tail of what branches hold at rest, ``excess`` (n,), by constant levels.

    While it is steep, by pairs of levels, from rest to rest; later by single levels as long as
    the ``ripple``, a vibration of the stretch from peak to peak, allows. Times are multiples of
    ``period``, which may be 0. ``out`` (most, 4) takes the levels up to the ``end``, or up to
    the last one of excess 0. Returns how many there are, -1 for more than there is room for, and
    a bound of the vibration.
    """
    stiffness = elastic_stiffness(stretch, material)
    inertia = mass(stretch, material)
    # Branches are springs to fast motion, dampers to slow motion.
    frequency, drag = natural_frequency(stretch, material), damping(stretch, material)
    stiff = stiffness
    for _ in range(3):
        stiff, drag = stiffness, damping(stretch, material)
        for b in range(excess.size):
            phase = frequency / branches[b, SPEED]
            part = branches[b, RATIO] * stiffness * phase / (1.0 + phase * phase)
            stiff += part * phase
            drag += part / frequency
        frequency = math.sqrt(stiff / inertia)
    decay = 0.5 * drag / inertia
    root = cmath.sqrt(complex(decay * decay - frequency * frequency, 0.0))
    if abs(root) < 1e-6 * frequency:
        root = complex(1e-6 * frequency, 0.0)
    modes = np.array([-decay + root, -decay - root])
    half = math.pi / (abs(root) if decay < frequency else frequency)
    time, count, most, drifting = 0.0, 0, ripple, False
    while True:
        value, bound, steepest, slope = _left(excess, branches, time)
        if count + 2 > out.shape[0]:
            return -1, most
        if time >= end:
            return count, most
        if bound <= 0.25 * ripple * stiffness:
            break
        if _SINGLE * steepest * half <= ripple * stiffness or frequency * period > _LAST_PHASE:
            drift = ripple * stiffness / _SINGLE
            # From rest on target half of it, and about the target then.
            span = _single_span(
                excess, branches, time, drift if drifting else 0.5 * drift, half, period)
            later, rest, _, _ = _left(excess, branches, time + span)
            before = out[count - 1, EXCESS] if drifting else value
            out[count, TIME] = time
            out[count, EXCESS] = 0.5 * (value + later) if drifting else value
            out[count, DEVIATION] = (before - value) / stiff
            out[count, RATE] = -slope / stiff if drifting else 0.0
            most = max(most, _SINGLE * (bound - rest) / stiffness)
            time += span
            count += 1
            drifting = True
            continue
        span = min((ripple * inertia / (_PAIR * steepest)) ** (1.0 / 3.0), _LONGEST * half)
        if period > 0.0:
            span = max(math.floor(span / period + 1e-9), 1.0) * period
        _pair(excess, branches, modes, inertia, time, span, out[count:count + 2])
        most = max(most, _PAIR * steepest * span ** 3 / inertia)
        time += 2.0 * span
        count += 2
    out[count, TIME], out[count, EXCESS] = time, 0.0
    out[count, DEVIATION], out[count, RATE] = 0.0, 0.0
    if drifting:
        out[count, DEVIATION] = (out[count - 1, EXCESS] - value) / stiff
        out[count, RATE] = -slope / stiff
    return count + 1, most
