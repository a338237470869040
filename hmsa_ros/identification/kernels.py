"""
Compiled kernel: the response to recorded levels with its derivatives by the parameters.

The equation of motion in the energy form, divided by the density and L^2, in seconds::

    m(l) l'' + m'(l) l'^2 / 2 + d l' + a psi'(l) + sum_i gamma_i a (psi'(l) - w_i) = k B + f
    w_i' = (psi'(l) - w_i) / tau_i        tau_c B' = u - B

Inertia and elastic force are those of `hmsa_ros.core.law`, whatever the law, in units of the
time in which the stiffness with all branches is 1. ``u`` is the piecewise linear level of the
amplifier, ``B`` the field behind the lag of the coil, known in closed form. The variational
equations by all wanted parameters are integrated beside the state with DOP853. Places in
``theta`` are named below; after `FIRST_BRANCH` come gamma and tau of each Maxwell branch in
turn. Nothing here checks its arguments.
"""

import math

import numpy as np

from hmsa_ros.core import law
from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.dop853 import ERROR_3, ERROR_5, MATRIX, NODES, STAGES, WEIGHTS
from hmsa_ros.core.kernels import resize
from hmsa_ros.core.law import (
    acceleration_slopes,
    at_rest,
    BY_CONSTANT,
    BY_LOAD,
    BY_MODULUS,
    BY_ZETA,
    elastic_force,
    elastic_stiffness,
    mass,
)

# Places in theta.
STIFFNESS, DAMPING, DRIVE, FORCE, LAG, STRETCH, RATE, FIRST_BRANCH = range(8)
#: Beyond all places: constant i of the law is wanted as the first plus i, the time at which
#: piece m begins as the second plus m.
CONSTANT, SWITCH = 500, 1000

# Phase of the fastest motion over which a quintic interpolates to about 1e-8.
_SMOOTH = 0.45
# Largest phase of a step where there are derivatives: they ring on when the motion is over, and
# the error that is controlled is that of the motion alone.
_LONGEST = 1.0
# And in times of the fastest branch: beyond some six the derivatives would grow without an end.
_RELAXED = 4.0
# Stages and, in the last row, the solution.
_TABLEAU = np.vstack([MATRIX, WEIGHTS[None, :]])
# Columns that are added at once; the state is filled up to a multiple of them.
_BLOCK = 4
# What no recording needs and a start value far off may ask for.
_MAX_STEPS, _STEPS_PER_SAMPLE = 20_000, 20


@compiled(allocates=False)
def constant_slope(l, i, material, slopes):  # noqa: E741
    """Return the derivative of psi' by constant i of the law; ``slopes`` is for work."""
    acceleration_slopes(l, 0.0, 0.0, material, slopes)
    return -slopes[BY_CONSTANT + i] / slopes[BY_LOAD]


@compiled(allocates=False)
def _unit_of(theta, branches):
    """Return share, total and root of the stiffness with all branches, and their inverses."""
    share = 1.0
    for b in range(branches):
        share += theta[FIRST_BRANCH + 2 * b]
    total = theta[STIFFNESS] * share
    speed = math.sqrt(total)
    return share, total, speed, 1.0 / total, 1.0 / speed


@compiled()
def _slots(wanted, branches, size):
    """
    Return for each wanted parameter where `_slope` leaves the slope that it adds to the rate.

    The first places are those in theta; the constants of the law follow, then one that stays 0.
    """
    slots = np.empty(wanted.size, np.int64)
    for j in range(wanted.size):
        place = wanted[j]
        slots[j] = size - 1
        if place < STRETCH or (
                FIRST_BRANCH <= place < CONSTANT and (place - FIRST_BRANCH) % 2 == 0):
            slots[j] = place
        elif CONSTANT <= place < SWITCH:
            slots[j] = FIRST_BRANCH + 2 * branches + place - CONSTANT
    return slots


@compiled(inline=True)
def _slope(
        y, n, count, field, field_lag, theta, unit, material, wanted, slots, partial, slopes, k,
        i):
    """
    Right-hand side of the equations and of their derivatives.

    ``y`` holds ``n`` rows (stretch, rate, branches) of ``1 + count`` columns (value and its
    derivatives by the wanted parameters); row ``i`` of ``k`` takes the slopes alike. ``unit`` is
    what `_unit_of` returns, ``slots`` what `_slots` does; ``partial`` and ``slopes`` are for work.
    """
    w = 1 + count
    l = y[0]  # noqa: E741
    v = y[w]
    a, drive = theta[STIFFNESS], theta[DRIVE]
    share, total, speed, per_total, per_speed = unit
    held = 0.0
    for b in range(n - 2):
        held += theta[FIRST_BRANCH + 2 * b] * y[(2 + b) * w]
    load = (drive * field + theta[FORCE] + a * held) * per_total
    acc, acc_l, acc_v, i_m = acceleration_slopes(l, v * per_speed, load, material, slopes)
    acc_l *= total
    acc_v *= speed
    partial[STIFFNESS] = held * i_m + share * slopes[BY_MODULUS]
    partial[DAMPING] = 2.0 * speed / material[law.C1] * slopes[BY_ZETA]
    partial[DRIVE] = field * i_m
    partial[FORCE] = i_m
    partial[LAG] = drive * field_lag * i_m
    first = FIRST_BRANCH + 2 * (n - 2)
    for c in range(slopes.size - BY_CONSTANT):
        partial[first + c] = total * slopes[BY_CONSTANT + c]
    k[i, 0] = v
    k[i, w] = total * acc
    for j in range(count):
        k[i, 1 + j] = y[w + 1 + j]
        k[i, w + 1 + j] = acc_l * y[1 + j] + acc_v * y[w + 1 + j] + partial[slots[j]]
    if n > 2:
        p1, p2 = elastic_force(l, material), elastic_stiffness(l, material)
        for b in range(n - 2):
            row, tau = (2 + b) * w, theta[FIRST_BRANCH + 2 * b + 1]
            acc_w = a * theta[FIRST_BRANCH + 2 * b] * i_m
            by_ratio = a * (y[row] - p1) * i_m
            k[i, row] = (p1 - y[row]) / tau
            for j in range(count):
                place = wanted[j]
                k[i, w + 1 + j] += acc_w * y[row + 1 + j]
                rate = p2 * y[1 + j] - y[row + 1 + j]
                if place == FIRST_BRANCH + 2 * b:
                    k[i, w + 1 + j] += by_ratio
                elif place == FIRST_BRANCH + 2 * b + 1:
                    rate -= (p1 - y[row]) / tau
                elif CONSTANT <= place < SWITCH:
                    rate -= slopes[BY_CONSTANT + place - CONSTANT] / i_m
                k[i, row + 1 + j] = rate / tau


@compiled(inline=True)
def _field(dt, level, slope, excess, excess_lag, lag):
    """Return the field and its derivative by the coil's time constant."""
    field, by_lag = level + slope * dt, -slope
    if lag > 0.0:
        decay = math.exp(-dt / lag)
        field += excess * decay - slope * lag
        by_lag += (excess_lag + excess * dt / (lag * lag)) * decay
    return field, by_lag


@compiled(inline=True)
def _combined(k, y, new, h, matrix, row, count):
    """Add the slopes in the first rows of ``k``, weighted by a row of a matrix, to ``y``."""
    for c in range(0, new.size, _BLOCK):
        d0 = d1 = d2 = d3 = 0.0
        for j in range(count):
            weight = matrix[row, j]
            d0 += weight * k[j, c]
            d1 += weight * k[j, c + 1]
            d2 += weight * k[j, c + 2]
            d3 += weight * k[j, c + 3]
        new[c] = y[c] + h * d0
        new[c + 1] = y[c + 1] + h * d1
        new[c + 2] = y[c + 2] + h * d2
        new[c + 3] = y[c + 3] + h * d3


@compiled(allocates=False)
def _step(
        k, y, new, n, count, dt, h, drive, theta, unit, material, wanted, slots, partial, slopes,
        rtol, fastest):
    """Make one DOP853 step, whose first slope is in ``k[0]``; return the scaled error."""
    w = 1 + count
    for i in range(1, STAGES):
        _combined(k, y, new, h, _TABLEAU, i, i)
        field, field_lag = _field(
            dt + h * NODES[i], drive[0], drive[1], drive[2], drive[3], theta[LAG])
        _slope(
            new, n, count, field, field_lag, theta, unit, material, wanted, slots, partial,
            slopes, k, i)
    _combined(k, y, new, h, _TABLEAU, STAGES, STAGES)
    e5 = e3 = 0.0
    for i in range(2):
        scale = rtol * (1.0 + abs(new[0])) if i == 0 else rtol * (fastest + abs(new[w]))
        one = three = 0.0
        for j in range(STAGES):
            one += ERROR_5[j] * k[j, i * w]
            three += ERROR_3[j] * k[j, i * w]
        e5 += (one / scale) ** 2
        e3 += (three / scale) ** 2
    if e5 == 0.0:
        return 0.0
    return abs(h) * e5 / math.sqrt(2.0 * (e5 + 0.01 * e3))


@compiled(inline=True)
def _quintic(x, h, y, k, new, w, c):
    """Return column ``c`` of stretch and rate at the share ``x`` of a step."""
    p0, v0, a0 = y[c], h * y[w + c], h * h * k[0, w + c]
    p1, v1, a1 = new[c], h * new[w + c], h * h * k[STAGES, w + c]
    r = p1 - p0 - v0 - 0.5 * a0
    s = v1 - v0 - a0
    u = a1 - a0
    c3 = 10.0 * r - 4.0 * s + 0.5 * u
    c4 = -15.0 * r + 7.0 * s - u
    c5 = 6.0 * r - 3.0 * s + 0.5 * u
    value = p0 + x * (v0 + x * (0.5 * a0 + x * (c3 + x * (c4 + x * c5))))
    rate = v0 + x * (a0 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)))
    return value, rate / h


@compiled(allocates=False)
def _follow(
        y, new, k, n, count, theta, unit, material, wanted, slots, partial, slopes, drive, begins,
        levels, ramps, times, rtol, stretch, rate, jacobian, by_rate):
    """Do what `respond` does, from the state ``y`` and the field in ``drive`` on."""
    w = 1 + count
    lag = theta[LAG]
    t, piece, i = begins[0], 0, 0
    fresh = True
    material[law.DAMPING] = theta[DAMPING] / unit[2]
    fastest = math.sqrt(theta[STIFFNESS] / mass(at_rest(material), material))
    h, relaxed = 0.2 / fastest, math.inf
    for b in range(n - 2):
        relaxed = min(relaxed, _RELAXED * theta[FIRST_BRANCH + 2 * b + 1])
    for _ in range(_MAX_STEPS + _STEPS_PER_SAMPLE * times.size):
        if fresh:
            now, now_lag = _field(
                t - begins[piece], drive[0], drive[1], drive[2], drive[3], lag)
            _slope(
                y, n, count, now, now_lag, theta, unit, material, wanted, slots, partial, slopes,
                k, 0)
            fresh = False
        while i < times.size and times[i] <= t:
            # Before the begin the motion is uniform.
            stretch[i] = y[0] + (times[i] - t) * y[w]
            rate[i] = y[w]
            for j in range(count):
                jacobian[i, j] = y[1 + j] + (times[i] - t) * y[w + 1 + j]
                if by_rate.shape[0]:
                    by_rate[i, j] = y[w + 1 + j]
            i += 1
        if i == times.size:
            return True
        limit = begins[piece + 1] if piece + 1 < begins.size else math.inf
        p2 = elastic_stiffness(y[0], material)
        per_phase = math.sqrt(mass(y[0], material) / (theta[STIFFNESS] * p2))
        smooth = _SMOOTH * per_phase
        target = min(limit, times[i] if times[i] - t >= smooth else t + smooth)
        if count:
            h = min(h, _LONGEST * per_phase, relaxed)
        step = min(h, target - t)
        error = _step(
            k, y, new, n, count, t - begins[piece], step, drive, theta, unit, material,
            wanted, slots, partial, slopes, rtol, fastest)
        if not error <= 1.0:
            h = resize(step, error)
            if not h > 1e-12 / fastest:
                return False
            continue
        after = target if step == target - t else t + step
        now, now_lag = _field(
            after - begins[piece], drive[0], drive[1], drive[2], drive[3], lag)
        _slope(
            new, n, count, now, now_lag, theta, unit, material, wanted, slots, partial, slopes,
            k, STAGES)
        while i < times.size and times[i] < after:
            x = (times[i] - t) / step
            stretch[i], rate[i] = _quintic(x, step, y, k, new, w, 0)
            for j in range(count):
                jacobian[i, j], slope = _quintic(x, step, y, k, new, w, 1 + j)
                if by_rate.shape[0]:
                    by_rate[i, j] = slope
            i += 1
        for c in range(y.size):
            y[c] = new[c]
            k[0, c] = k[STAGES, c]
        t = after
        if step == h or error > 0.5:
            h = resize(step, error)
        while piece + 1 < begins.size and begins[piece + 1] <= t:
            before, before_lag = _field(
                begins[piece + 1] - begins[piece], drive[0], drive[1], drive[2], drive[3], lag)
            piece += 1
            jump = levels[piece] - before
            drive[0], drive[1] = levels[piece], ramps[piece]
            drive[2] = before - (levels[piece] - ramps[piece] * lag)
            drive[3] = before_lag + ramps[piece]
            fresh = True
            if jump != 0.0:
                # By a lag of 0, or by a later switch: what the step lacks is an impulse.
                impulse = theta[DRIVE] * jump / mass(y[0], material)
                for j in range(count):
                    if wanted[j] == SWITCH + piece or (wanted[j] == LAG and lag <= 0.0):
                        y[w + 1 + j] -= impulse
    return False


@compiled()
def respond(
        theta, material, branches, wanted, start, begins, levels, ramps, field, field_lag, times,
        rtol, stretch, rate, jacobian, by_rate):
    """
    Sample the response and its derivatives at increasing times.

    Parameters: ``theta`` and ``wanted``, places in it, as the module says; ``material`` as the
    law packs it, whose damping is set; ``start`` derivatives of the initial stretch by the
    wanted parameters; the amplifier's level is ``levels[m] + ramps[m] (t - begins[m])`` from
    ``begins[m]`` on, the field at ``begins[0]`` is ``field``, its derivative by the lag
    ``field_lag``; a branch has relaxed there. ``stretch``, ``rate`` (n,) and ``jacobian``
    (n, wanted) take the samples, ``by_rate`` the derivatives of the rate, (n, wanted) or
    (0, wanted) for none; before the begin the motion is uniform. Returns whether the motion was
    followed to its end.
    """
    n, count = 2 + branches, wanted.size
    w = 1 + count
    size = (n * w + _BLOCK - 1) // _BLOCK * _BLOCK
    k = np.zeros((STAGES + 1, size))
    y, new = np.zeros(size), np.zeros(size)
    # A table has hundreds of constants, of which none is sought; Gent's is always differentiated.
    constants = 1
    for j in range(count):
        if CONSTANT <= wanted[j] < SWITCH:
            constants = max(constants, wanted[j] - CONSTANT + 1)
    slopes = np.zeros(BY_CONSTANT + constants)
    partial = np.zeros(FIRST_BRANCH + 2 * branches + constants + 1)
    slots = _slots(wanted, branches, partial.size)
    y[0], y[w] = theta[STRETCH], theta[RATE]
    p1, p2 = elastic_force(y[0], material), elastic_stiffness(y[0], material)
    for b in range(branches):
        y[(2 + b) * w] = p1
    for j in range(count):
        y[1 + j] = start[j]
        if wanted[j] == RATE:
            y[w + 1 + j] = 1.0
        by = 0.0
        if CONSTANT <= wanted[j] < SWITCH:
            by = constant_slope(y[0], wanted[j] - CONSTANT, material, slopes)
        for b in range(branches):
            y[(2 + b) * w + 1 + j] = p2 * start[j] + by
    drive = np.array([levels[0], ramps[0], field - (levels[0] - ramps[0] * theta[LAG]),
                      field_lag + ramps[0]])
    return _follow(
        y, new, k, n, count, theta, _unit_of(theta, branches), material, wanted, slots, partial,
        slopes, drive, begins, levels, ramps, times, rtol, stretch, rate, jacobian, by_rate)
