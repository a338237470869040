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
from hmsa_ros.core.law import (
    acceleration_slopes,
    BY_CONSTANT,
    BY_LOAD,
    BY_MODULUS,
    CONSTANTS,
    elastic_force,
    elastic_stiffness,
    mass,
    motion,
)

# Places in theta.
STIFFNESS, DAMPING, DRIVE, FORCE, LAG, STRETCH, RATE, FIRST_BRANCH = range(8)
#: Beyond all places: constant i of the law is wanted as the first plus i, the time at which
#: piece m begins as the second plus m.
CONSTANT, SWITCH = 500, 1000

# Phase of the fastest motion over which a quintic interpolates to about 1e-8.
_SMOOTH = 0.45
# What no recording needs and a start value far off may ask for.
_MAX_STEPS, _STEPS_PER_SAMPLE = 20_000, 20


@compiled()
def constant_slope(l, i, material, slopes):  # noqa: E741
    """Return the derivative of psi' by constant i of the law; ``slopes`` is for work."""
    acceleration_slopes(l, 0.0, 0.0, material, slopes)
    return -slopes[BY_CONSTANT + i] / slopes[BY_LOAD]


@compiled()
def _unit_of(theta, branches):
    """Return share, total and root of the stiffness with all branches, and their inverses."""
    share = 1.0
    for b in range(branches):
        share += theta[FIRST_BRANCH + 2 * b]
    total = theta[STIFFNESS] * share
    speed = math.sqrt(total)
    return share, total, speed, 1.0 / total, 1.0 / speed


@compiled()
def _slope(y, n, count, field, field_lag, theta, unit, material, wanted, partial, slopes, out):
    """
    Right-hand side of the equations and of their derivatives.

    ``y`` holds ``n`` rows (stretch, rate, branches) of ``1 + count`` columns (value and its
    derivatives by the wanted parameters); ``out`` takes the slopes alike. ``unit`` is what
    `_unit_of` returns; ``partial`` and ``slopes`` are for work.
    """
    w = 1 + count
    l = y[0]  # noqa: E741
    v = y[w]
    a, k = theta[STIFFNESS], theta[DRIVE]
    share, total, speed, per_total, per_speed = unit
    held = 0.0
    for b in range(n - 2):
        held += theta[FIRST_BRANCH + 2 * b] * y[(2 + b) * w]
    load = (k * field + theta[FORCE] + a * held) * per_total
    acc, acc_l, acc_v, i_m = motion(l, v * per_speed, load, material)
    acc *= total
    acc_l *= total
    acc_v *= speed
    for c in range(w):
        out[c] = y[w + c]
        out[w + c] = acc_l * y[c] + acc_v * y[w + c]
    out[w] = acc
    if n > 2:
        p1, p2 = elastic_force(l, material), elastic_stiffness(l, material)
        for b in range(n - 2):
            row = (2 + b) * w
            acc_w = a * theta[FIRST_BRANCH + 2 * b] * i_m
            rate = 1.0 / theta[FIRST_BRANCH + 2 * b + 1]
            for c in range(1, w):
                out[w + c] += acc_w * y[row + c]
                out[row + c] = rate * (p2 * y[c] - y[row + c])
            out[row] = rate * (p1 - y[row])
            partial[FIRST_BRANCH + 2 * b] = a * (y[row] - p1) * i_m
    if count == 0:
        return
    acceleration_slopes(l, v * per_speed, load, material, slopes)
    partial[STIFFNESS] = held * i_m + share * slopes[BY_MODULUS]
    partial[DAMPING] = -v * i_m
    partial[DRIVE] = field * i_m
    partial[FORCE] = i_m
    partial[LAG] = k * field_lag * i_m
    for j in range(count):
        place = wanted[j]
        if place < STRETCH or (
                FIRST_BRANCH <= place < CONSTANT and (place - FIRST_BRANCH) % 2 == 0):
            out[w + 1 + j] += partial[place]
        elif CONSTANT <= place < SWITCH:
            by = slopes[BY_CONSTANT + place - CONSTANT]
            out[w + 1 + j] += total * by
            for b in range(n - 2):
                out[(2 + b) * w + 1 + j] -= by / (i_m * theta[FIRST_BRANCH + 2 * b + 1])
        for b in range(n - 2):
            row, tau = (2 + b) * w, theta[FIRST_BRANCH + 2 * b + 1]
            if place == FIRST_BRANCH + 2 * b + 1:
                out[row + 1 + j] -= (p1 - y[row]) / (tau * tau)


@compiled()
def _field(dt, level, slope, excess, excess_lag, lag):
    """Return the field and its derivative by the coil's time constant."""
    field = level + slope * dt
    if lag <= 0.0:
        return field, -slope
    decay = math.exp(-dt / lag)
    return (field - slope * lag + excess * decay,
            (excess_lag + excess * dt / (lag * lag)) * decay - slope)


@compiled()
def _step(
        k, y, new, n, count, dt, h, drive, theta, unit, material, wanted, partial, slopes, rtol,
        fastest):
    """Make one DOP853 step, whose first slope is in ``k[0]``; return the scaled error."""
    size = n * (1 + count)
    w = 1 + count
    for i in range(1, STAGES):
        for c in range(size):
            new[c] = 0.0
        for j in range(i):
            weight = MATRIX[i, j]
            if weight != 0.0:
                for c in range(size):
                    new[c] += weight * k[j, c]
        for c in range(size):
            new[c] = y[c] + h * new[c]
        field, field_lag = _field(
            dt + h * NODES[i], drive[0], drive[1], drive[2], drive[3], theta[LAG])
        _slope(new, n, count, field, field_lag, theta, unit, material, wanted,
            partial, slopes, k[i])
    for c in range(size):
        new[c] = 0.0
    for j in range(STAGES):
        weight = WEIGHTS[j]
        if weight != 0.0:
            for c in range(size):
                new[c] += weight * k[j, c]
    for c in range(size):
        new[c] = y[c] + h * new[c]
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


@compiled()
def _interpolate(x, h, y, start, new, end, w, c):
    """Return stretch (column ``c``) and rate at the share ``x`` of a step: a quintic."""
    p0, v0, a0 = y[c], h * y[w + c], h * h * start[w + c]
    p1, v1, a1 = new[c], h * new[w + c], h * h * end[w + c]
    r = p1 - p0 - v0 - 0.5 * a0
    s = v1 - v0 - a0
    u = a1 - a0
    c3 = 10.0 * r - 4.0 * s + 0.5 * u
    c4 = -15.0 * r + 7.0 * s - u
    c5 = 6.0 * r - 3.0 * s + 0.5 * u
    value = p0 + x * (v0 + x * (0.5 * a0 + x * (c3 + x * (c4 + x * c5))))
    rate = v0 + x * (a0 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)))
    return value, rate / h


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
    size = n * w
    k = np.zeros((STAGES, size))
    y, new, end = np.zeros(size), np.zeros(size), np.zeros(size)
    partial = np.zeros(theta.size)
    slopes = np.zeros(BY_CONSTANT + material.size - CONSTANTS)
    drive = np.zeros(4)
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
    lag = theta[LAG]
    t, piece, i = begins[0], 0, 0
    while i < times.size and times[i] < t:
        stretch[i] = y[0] + (times[i] - t) * y[w]
        rate[i] = y[w]
        for j in range(count):
            jacobian[i, j] = y[1 + j] + (times[i] - t) * y[w + 1 + j]
        for j in range(by_rate.shape[0] and count):
            by_rate[i, j] = y[w + 1 + j]
        i += 1
    drive[0], drive[1] = levels[0], ramps[0]
    drive[2] = field - (levels[0] - ramps[0] * lag)
    drive[3] = field_lag + ramps[0]
    fresh = True
    unit = _unit_of(theta, branches)
    material[law.DAMPING] = theta[DAMPING] / unit[2]
    fastest = math.sqrt(theta[STIFFNESS] / mass(1.0, material))
    h = 0.2 / fastest
    for _ in range(_MAX_STEPS + _STEPS_PER_SAMPLE * times.size):
        if fresh:
            now, now_lag = _field(
                t - begins[piece], drive[0], drive[1], drive[2], drive[3], lag)
            _slope(y, n, count, now, now_lag, theta, unit, material, wanted, partial, slopes, k[0])
            fresh = False
        while i < times.size and times[i] <= t:
            stretch[i] = y[0]
            rate[i] = y[w]
            for j in range(count):
                jacobian[i, j] = y[1 + j]
            for j in range(by_rate.shape[0] and count):
                by_rate[i, j] = y[w + 1 + j]
            i += 1
        if i == times.size:
            return True
        limit = begins[piece + 1] if piece + 1 < begins.size else math.inf
        p2 = elastic_stiffness(y[0], material)
        smooth = _SMOOTH / math.sqrt(theta[STIFFNESS] * p2 / mass(y[0], material))
        target = min(limit, times[i] if times[i] - t >= smooth else t + smooth)
        step = min(h, target - t)
        error = _step(
            k, y, new, n, count, t - begins[piece], step, drive, theta, unit, material,
            wanted, partial, slopes, rtol, fastest)
        if not error <= 1.0:
            h = 0.2 * step if not error < math.inf else step * max(
                0.2, 0.9 * error ** -0.125)
            if not h > 1e-12 / fastest:
                return False
            continue
        after = target if step == target - t else t + step
        now, now_lag = _field(
            after - begins[piece], drive[0], drive[1], drive[2], drive[3], lag)
        _slope(new, n, count, now, now_lag, theta, unit, material, wanted, partial, slopes, end)
        while i < times.size and times[i] < after:
            x = (times[i] - t) / step
            stretch[i], rate[i] = _interpolate(x, step, y, k[0], new, end, w, 0)
            for j in range(count):
                jacobian[i, j], slope = _interpolate(x, step, y, k[0], new, end, w, 1 + j)
                if by_rate.shape[0]:
                    by_rate[i, j] = slope
            i += 1
        for c in range(size):
            y[c] = new[c]
            k[0, c] = end[c]
        t = after
        if step == h or error > 0.5:
            h = step * min(6.0, max(0.2, 0.9 * max(error, 1e-12) ** -0.125))
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
