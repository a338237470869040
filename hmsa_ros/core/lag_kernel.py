"""
Compiled integration under a field that follows the amplifier with a lag of first order.

The field follows ``T b' + b = u``; where the amplifier's output ``u`` is piecewise linear, it is
a line and an exponential, so that only stretch and rate are integrated. As in
`hmsa_ros.core.kernels`, everything is nondimensional and nothing checks its arguments.
"""

import math

import numpy as np

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.dop853 import ERROR_3, ERROR_5, MATRIX, NODES, STAGES, WEIGHTS
from hmsa_ros.core.kernels import (
    attainable,
    DONE,
    error_of,
    first_step,
    follow_one,
    MAX_STEPS,
    resize,
    STUCK,
)
from hmsa_ros.core.law import motion, natural_frequency
from hmsa_ros.core.laws.record import ANY

# Columns of the state: stretch, rate, and their derivatives by three parameters.
_WIDTH = 8


@compiled()
def _step(k, x, new, line, line_slope, rest, decay, d_line, d_rest, h, material, rtol):
    """
    One DOP853 step of length ``h`` from the state ``x`` (8,) to ``new``; ``k`` (13, 8) is work.

    The load is ``line + line_slope t + rest exp(-decay t)``; ``d_line`` and ``d_rest`` (3,) are
    the derivatives of its parts. Returns the error in units of the tolerance.
    """
    here = k[STAGES]
    for i in range(STAGES):
        here[:] = 0.0
        for j in range(i):
            w = MATRIX[i, j]
            if w != 0.0:
                for m in range(_WIDTH):
                    here[m] += w * k[j, m]
        for m in range(_WIDTH):
            here[m] = x[m] + h * here[m]
        t = h * NODES[i]
        left = math.exp(-decay * t)
        a, a_l, a_v, a_beta = motion(
            here[0], here[1], line + line_slope * t + rest * left, material, ANY)
        k[i, 0] = here[1]
        k[i, 1] = a
        for c in range(3):
            s, r = here[2 + 2 * c], here[3 + 2 * c]
            k[i, 2 + 2 * c] = r
            k[i, 3 + 2 * c] = a_l * s + a_v * r + a_beta * (d_line[c] + d_rest[c] * left)
    here[:] = 0.0
    e5_l = e5_v = e3_l = e3_v = 0.0
    for j in range(STAGES):
        for m in range(_WIDTH):
            here[m] += WEIGHTS[j] * k[j, m]
        e5_l += ERROR_5[j] * k[j, 0]
        e5_v += ERROR_5[j] * k[j, 1]
        e3_l += ERROR_3[j] * k[j, 0]
        e3_v += ERROR_3[j] * k[j, 1]
    for m in range(_WIDTH):
        new[m] = x[m] + h * here[m]
    return error_of(h, new[0], new[1], e5_l, e5_v, e3_l, e3_v, rtol)


@compiled()
def _advance(k, x, new, line, line_slope, rest, decay, d_line, d_rest, duration, material, rtol):
    """Integrate the state ``x`` in place over a duration; returns the status."""
    h = min(first_step(x[0], x[1], line + rest, material, rtol), 4.0 * rtol ** 0.125 / decay)
    done = 0.0
    later = np.empty(3)
    for _ in range(MAX_STEPS):
        left = duration - done
        if not left > 0.0:
            return DONE
        span = min(h, left)
        decayed = math.exp(-decay * done)
        for c in range(3):
            later[c] = d_rest[c] * decayed
        error = _step(
            k, x, new, line + line_slope * done, line_slope, rest * decayed, decay, d_line,
            later, span, material,
            attainable(rtol, x[0], x[1], natural_frequency(x[0], material)))
        if error <= 1.0:
            x[:] = new
            done = duration if span == left else done + span
            if span == h or error > 0.5:
                h = resize(span, error)
        else:
            h = resize(span, error)
    return STUCK


@compiled()
def respond_late(
        l, v, field, durations, begins, slopes, d_durations, d_begins, lag,  # noqa: E741
        material, rtol, jacobian):
    """
    Follow a piecewise linear amplifier through the lag, differentiated by three parameters.

    Arguments are those of `hmsa_ros.core.kernels.respond`, with three columns of derivatives
    and the field at the start. ``jacobian`` (3, 3) takes the derivatives of stretch, rate and
    field. Returns status, stretch, rate and field.
    """
    k = np.empty((STAGES + 1, _WIDTH))
    x, new = np.zeros(_WIDTH), np.empty(_WIDTH)
    x[0], x[1] = l, v
    d_field, d_rest = np.zeros(3), np.empty(3)
    decay = 1.0 / lag
    for m in range(durations.size):
        span, slope = durations[m], slopes[m]
        line = begins[m] - slope * lag
        rest = field - line
        for c in range(3):
            d_rest[c] = d_field[c] - d_begins[m, c]
        status = _advance(
            k, x, new, line, slope, rest, decay, d_begins[m], d_rest, span, material, rtol)
        if status != DONE:
            return status, x[0], x[1], field
        left = math.exp(-decay * span)
        field = line + slope * span + rest * left
        change = slope - rest * decay * left
        a, _, _, _ = motion(x[0], x[1], field, material, ANY)
        for c in range(3):
            x[2 + 2 * c] += x[1] * d_durations[m, c]
            x[3 + 2 * c] += a * d_durations[m, c]
            d_field[c] = d_begins[m, c] + d_rest[c] * left + change * d_durations[m, c]
    for c in range(3):
        jacobian[0, c] = x[2 + 2 * c]
        jacobian[1, c] = x[3 + 2 * c]
        jacobian[2, c] = d_field[c]
    return DONE, x[0], x[1], field


@compiled()
def trajectory_late(
        l, v, field, switches, loads, slopes, lag, times, material, rtol, out):  # noqa: E741
    """
    Sample the response to a piecewise linear amplifier at increasing times.

    Arguments are those of `hmsa_ros.core.kernels.trajectory`; ``out`` (3, n) takes stretch,
    rate and field. Returns the status of the integration.
    """
    k = np.empty((STAGES, 4))
    t = switches[0]
    piece = 0
    h = 0.0
    line = loads[0] - slopes[0] * lag
    rest = field - line
    for i in range(times.size):
        while True:
            end = times[i]
            ends = piece + 1 < switches.size and switches[piece + 1] <= end
            if ends:
                end = switches[piece + 1]
            status, l, v, h = follow_one(  # noqa: E741
                k, l, v, h, line, slopes[piece], rest, 1.0 / lag, end - t, material, rtol)
            if status != DONE:
                return status
            line += slopes[piece] * (end - t)
            rest *= math.exp(-(end - t) / lag)
            field = line + rest
            t = end
            if not ends:
                break
            piece += 1
            h = 0.0
            line = loads[piece] - slopes[piece] * lag
            rest = field - line
        out[0, i] = l
        out[1, i] = v
        out[2, i] = field
    return DONE
