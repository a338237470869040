"""
Compiled levels that keep an elastomer at rest while it creeps: the tail of a move.

As in `hmsa_ros.core.response_kernel`, everything is nondimensional, branch i holds
``gamma_i (psi'(l) - w_i)``, and nothing checks its arguments. ``branches`` (n, 2) has the columns
`hmsa_ros.core.response_kernel.RATIO` and `SPEED`. Levels are those of the amplifier. Where the
field lags behind it, so does the vibration that they leave: its bound holds as well.
"""

import cmath
import math

import numpy as np

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.law import damping, elastic_stiffness, mass, natural_frequency
from hmsa_ros.core.response_kernel import RATIO, SPEED

#: Columns of a staircase: time, load over that of rest, and, where it begins, deviation of
#: stretch, rate, and field over that of rest.
TIME, EXCESS, DEVIATION, RATE, FIELD = range(5)

# Vibration that a pair of levels leaves, in units of slope of the tail times duration^3/mass.
_PAIR = 0.05
# Longest level of a pair, in half periods, and the phase beyond which a grid allows none.
_LONGEST = 0.5
_LAST_PHASE = 2.6
# Vibration about a single level in units of the drift during it: the drift, what a step of that
# height rings to both sides, and some to be sure.
_SINGLE = 3.5
# Half periods of a single level at the most.
_FOREVER = 1e15
# How the vibration grows until there is room for its levels, and how often the way back is halved.
_COARSER, _HALVINGS = 3.0, 5


@compiled()
def _left(excess, branches, time):
    """Return of the tail at a time: its value, and the bounds of value and slope."""
    value = bound = steepest = 0.0
    for b in range(excess.size):
        part = excess[b] * math.exp(-branches[b, SPEED] * time)
        value += part
        bound += abs(part)
        steepest += branches[b, SPEED] * abs(part)
    return value, bound, steepest


@compiled(inline=True)
def _taken(mode, turned, speed, span):
    """Return what a mode, exp(mode t) and ``turned`` after a span, takes up of exp(-speed t)."""
    gap = mode + speed
    if abs(gap) * span > 1e-7:
        return (turned - math.exp(-speed * span)) / gap
    return span * turned


@compiled()
def _passed(excess, branches, mode, turned, time, span):
    """Return what a mode has taken up of the tail at the end of a span."""
    taken = 0.0j
    for b in range(excess.size):
        speed = branches[b, SPEED]
        taken += excess[b] * math.exp(-speed * time) * _taken(mode, turned, speed, span)
    return taken


@compiled()
def _pair(excess, branches, modes, time, span):
    """Return two levels of the same length between which the oscillator goes from rest to rest."""
    # Both modes are still at the end: a turned once + b once = what they have taken up by then.
    one, other = cmath.exp(modes[0] * span), cmath.exp(modes[1] * span)
    first = _both(excess, branches, modes[0], one, time, span)
    second = _both(excess, branches, modes[1], other, time, span)
    a = (first - second) / (one - other)
    return a.real, (first - a * one).real


@compiled(inline=True)
def _both(excess, branches, mode, turned, time, span):
    """Return what a mode takes up of the tail in two spans, in units of a level in one."""
    taken = _passed(excess, branches, mode, turned, time, span) * turned + _passed(
        excess, branches, mode, turned, time + span, span)
    return taken * mode / (turned - 1.0)


@compiled()
def _single_span(excess, branches, time, drift, shortest, period):
    """Return for how long the tail may go down by a drift: odd multiples of a half period."""
    _, bound, _ = _left(excess, branches, time)
    low, high = 0.0, 1.0
    while high < _FOREVER:
        _, later, _ = _left(excess, branches, time + high * shortest)
        if bound - later > drift:
            break
        low = high
        if later < drift:
            break
        high *= 2.0
    while high - low > 1.0:
        middle = math.floor(0.5 * (low + high))
        _, later, _ = _left(excess, branches, time + middle * shortest)
        if bound - later > drift:
            high = middle
        else:
            low = middle
    count = max(low, 1.0)
    # Rings of equal steps an odd number of half periods apart cancel.
    span = shortest * (count - (count % 2.0 == 0.0))
    if period > 0.0:
        span = max(math.floor(span / period + 0.5), 1.0) * period
    return span


@compiled()
def _oscillator(branches, stretch, material):
    """Return stiffness and frequency of fast motion, and the eigenvalues of the two modes."""
    stiffness = elastic_stiffness(stretch, material)
    inertia = mass(stretch, material)
    # Branches are springs to fast motion, dampers to slow motion.
    frequency, drag = natural_frequency(stretch, material), damping(stretch, material)
    stiff = stiffness
    for _ in range(3):
        stiff, drag = stiffness, damping(stretch, material)
        for b in range(branches.shape[0]):
            phase = frequency / branches[b, SPEED]
            part = branches[b, RATIO] * stiffness * phase / (1.0 + phase * phase)
            stiff += part * phase
            drag += part / frequency
        frequency = math.sqrt(stiff / inertia)
    decay = 0.5 * drag / inertia
    root = cmath.sqrt(complex(decay * decay - frequency * frequency, 0.0))
    if abs(root) < 1e-6 * frequency:
        root = complex(1e-6 * frequency, 0.0)
    half = math.pi / (abs(root) if decay < frequency else frequency)
    return frequency, half, np.array([-decay + root, -decay - root])


@compiled()
def _levels(
        excess, branches, stiffness, inertia, frequency, half, modes, period, end, ripple, out,
        counting):
    """Return how many levels a ripple takes and their vibration; write them if not counting."""
    time, count, most, drifting = 0.0, 0, ripple, False
    while True:
        value, bound, steepest = _left(excess, branches, time)
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
            later, rest, _ = _left(excess, branches, time + span)
            out[count, TIME] = time
            out[count, EXCESS] = 0.5 * (value + later) if drifting else value
            most = max(most, _SINGLE * (bound - rest) / stiffness)
            time += span
            count += 1
            drifting = True
            continue
        span = min((ripple * inertia / (_PAIR * steepest)) ** (1.0 / 3.0), _LONGEST * half)
        if period > 0.0:
            span = max(math.floor(span / period + 1e-9), 1.0) * period
        if not counting:
            out[count, TIME], out[count + 1, TIME] = time, time + span
            out[count, EXCESS], out[count + 1, EXCESS] = _pair(
                excess, branches, modes, time, span)
        most = max(most, _PAIR * steepest * span ** 3 / inertia)
        time += 2.0 * span
        count += 2
    out[count, TIME], out[count, EXCESS] = time, 0.0
    return count + 1, most


@compiled()
def _predict(held, branches, modes, inertia, lag, count, out):
    """Write deviation, rate and field where levels begin, for a tail from rest on target."""
    gap = inertia * (modes[0] - modes[1])
    taken = np.zeros(2, np.complex128)
    field = np.sum(held)
    for i in range(count):
        out[i, DEVIATION] = ((taken[0] - taken[1]) / gap).real
        out[i, RATE] = ((modes[0] * taken[0] - modes[1] * taken[1]) / gap).real
        out[i, FIELD] = field
        if i + 1 == count:
            break
        time, level = out[i, TIME], out[i, EXCESS]
        span = out[i + 1, TIME] - time
        over = field - level
        for j in range(2):
            mode = modes[j]
            turned = cmath.exp(mode * span)
            taken[j] = taken[j] * turned + level * _taken(mode, turned, 0.0, span) - _passed(
                held, branches, mode, turned, time, span)
            if lag > 0.0:
                taken[j] += over * _taken(mode, turned, 1.0 / lag, span)
        field = level
        if lag > 0.0:
            field += over * math.exp(-span / lag)


@compiled()
def staircase(held, branches, stretch, material, lag, period, end, ripple, out):
    """
    Follow the tail of what branches hold at rest, ``held`` (n,), by constant levels.

    While it is steep, by pairs of levels, from rest to rest; later by single levels as long as
    the ``ripple``, a vibration of the stretch from peak to peak, allows, or one as near above it
    as there is room for. Times are multiples of ``period``, which may be 0. ``out`` (most, 5)
    takes the levels up to the ``end``, or up to the last one of excess 0. Returns how many there
    are, and a bound of the vibration.
    """
    stiffness = elastic_stiffness(stretch, material)
    inertia = mass(stretch, material)
    frequency, half, modes = _oscillator(branches, stretch, material)
    # So that the field, behind the amplifier, is what they hold.
    excess = np.empty(held.size)
    for b in range(held.size):
        excess[b] = held[b] * (1.0 - lag * branches[b, SPEED])
    fine = coarse = ripple
    while True:
        count, most = _levels(
            excess, branches, stiffness, inertia, frequency, half, modes, period, end, coarse,
            out, True)
        if count >= 0:
            break
        fine, coarse = coarse, _COARSER * coarse
    for _ in range(_HALVINGS if coarse > fine else 0):
        middle = math.sqrt(fine * coarse)
        count, most = _levels(
            excess, branches, stiffness, inertia, frequency, half, modes, period, end, middle,
            out, True)
        if count < 0:
            fine = middle
        else:
            coarse = middle
    count, most = _levels(
        excess, branches, stiffness, inertia, frequency, half, modes, period, end, coarse, out,
        False)
    _predict(held, branches, modes, inertia, lag, count, out)
    return count, most
