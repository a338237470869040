"""
Compiled integration under a field that lags, with an elastomer that creeps, and derivatives.

The field follows ``T b' + b = u``; where the amplifier's output ``u`` is piecewise linear, it is
a line and an exponential, and is not integrated. Branch i holds ``gamma_i (psi'(l) - w_i)``,
where ``w_i`` follows the elastic force, ``tau_i w_i' = psi'(l) - w_i``. As in
`hmsa_ros.core.kernels`, everything is nondimensional and nothing checks its arguments.

A state is stretch, rate and what the branches follow, then the derivatives of the same by each
parameter. Stages and steps are rows of the working space, the state the last but one.
"""

import math

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.dop853 import ERROR_3, ERROR_5, MATRIX, NODES, STAGES, WEIGHTS
from hmsa_ros.core.kernels import (
    attainable,
    DONE,
    faded,
    first_step,
    follow_one,
    MAX_STEPS,
    resize,
    RESOLVED,
    STUCK,
)
from hmsa_ros.core.law import at_rest, elastic, KIND, motion, natural_frequency
from hmsa_ros.core.laws.record import ANY, GENT, NEO_HOOKEAN

#: Columns of a branch: gamma, 1/tau and, where it goes on with the state, w.
RATIO, SPEED, FOLLOWER = range(3)
#: Rows of a response before what the branches follow.
STRETCH, RATE, FIELD, FOLLOWED = range(4)


def work_space(most: int) -> NDArray[np.float64]:
    """Return the working space for so many branches: stages, a state and the next one."""
    return np.empty((STAGES + 2, 2 + most))


@compiled(inline=True)
def _change(
        x, load, left, d_line, d_rest, material, family, branches, count, parameters, change):
    """
    Write the derivative by time of a state.

    ``d_line`` and ``left d_rest`` are the derivatives of the load by the parameters.
    """
    width = 2 + count
    stiffness = 0.0
    if count > 0:
        force, stiffness = elastic(x[0], material, family)
        for b in range(count):
            above = force - x[2 + b]
            load -= branches[b, RATIO] * above
            change[2 + b] = branches[b, SPEED] * above
    a, a_l, a_v, a_beta = motion(x[0], x[1], load, material, family)
    change[0] = x[1]
    change[1] = a
    for c in range(parameters):
        at = (1 + c) * width
        pull = d_line[c] + d_rest[c] * left
        for b in range(count):
            above = stiffness * x[at] - x[at + 2 + b]
            pull -= branches[b, RATIO] * above
            change[at + 2 + b] = branches[b, SPEED] * above
        change[at] = x[at + 1]
        change[at + 1] = a_l * x[at] + a_v * x[at + 1] + a_beta * pull


@compiled(allocates=False)
def _step(
        k, beta, slope, excess, decay, d_line, d_rest, still, h, material, branches, count,
        parameters, rtol):
    """
    One DOP853 step of length ``h``; the last row of ``k`` takes the new state.

    The load is ``beta + slope t + excess exp(-decay t)``; its derivatives by the parameters are
    ``d_line + d_rest still exp(-decay t)``. Returns the error in units of the tolerance.
    """
    if material[KIND] <= NEO_HOOKEAN:
        return _stages(
            k, beta, slope, excess, decay, d_line, d_rest, still, h, material, GENT, branches,
            count, parameters, rtol)
    return _family_step(
        k, beta, slope, excess, decay, d_line, d_rest, still, h, material, branches, count,
        parameters, rtol)


@compiled(allocates=False)
def _family_step(
        k, beta, slope, excess, decay, d_line, d_rest, still, h, material, branches, count,
        parameters, rtol):
    """Make a step for a law beside Gent."""
    return _stages(
        k, beta, slope, excess, decay, d_line, d_rest, still, h, material, ANY, branches, count,
        parameters, rtol)


@compiled(inline=True)
def _stages(
        k, beta, slope, excess, decay, d_line, d_rest, still, h, material, family, branches,
        count, parameters, rtol):
    """Make a step, compiled for a family of laws."""
    width = 2 + count
    size = width * (1 + parameters)
    x, new = k[STAGES], k[STAGES + 1]
    fades = decay > 0.0 and (excess != 0.0 or parameters > 0)
    for i in range(STAGES):
        for m in range(size):
            new[m] = 0.0
        for j in range(i):
            w = MATRIX[i, j]
            if w != 0.0:
                for m in range(size):
                    new[m] += w * k[j, m]
        for m in range(size):
            new[m] = x[m] + h * new[m]
        t = h * NODES[i]
        load, left = beta + slope * t, 0.0
        if fades:
            left = math.exp(-decay * t)
            load += excess * left
        _change(
            new, load, still * left, d_line, d_rest, material, family, branches, count,
            parameters, k[i])
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
        # A step that left the limits has no number, and is rejected.
        error = abs(h) * e5 / math.sqrt(width * (e5 + 0.01 * e3))
    return error


@compiled(allocates=False)
def _advance(
        k, h, beta, slope, excess, decay, d_line, d_rest, duration, material, branches, count,
        parameters, rtol):
    """
    Integrate the state in ``k`` over a duration, as `hmsa_ros.core.kernels.follow_one` does.

    Returns the status and the step length to go on with.
    """
    x, new = k[STAGES], k[STAGES + 1]
    width = 2 + count
    size = width * (1 + parameters)
    total, fastest = 1.0, decay if excess != 0.0 else 0.0
    for b in range(count):
        total += branches[b, RATIO]
        fastest = max(fastest, branches[b, SPEED])
    stiff = math.sqrt(total)
    if h <= 0.0:
        h = 1.0 / (stiff / first_step(x[0], x[1], beta + excess, material, rtol)
                   + 0.25 * rtol ** -0.125 * fastest)
    done = 0.0
    for _ in range(MAX_STEPS):
        left = duration - done
        if not left > 0.0:
            return DONE, h
        span = min(h, left)
        frequency = stiff * natural_frequency(x[0], material)
        if attainable(0.0, x[0], x[1], frequency) > RESOLVED and x[1] * (
                x[0] - at_rest(material)) > 0.0:
            x[1] = -x[1]
        still = 1.0
        if decay > 0.0:
            still = math.exp(-decay * done)
        error = _step(
            k, beta + slope * done, slope, excess * still, decay, d_line, d_rest, still, span,
            material, branches, count, parameters, attainable(rtol, x[0], x[1], frequency))
        if error <= 1.0:
            for m in range(size):
                x[m] = new[m]
            done = duration if span == left else done + span
            if span == h or error > 0.5:
                h = resize(span, error)
        else:
            h = resize(span, error)
    return STUCK, h


@compiled()
def respond(
        l, v, field, followed, durations, begins, slopes, d_durations, d_begins,  # noqa: E741
        parameters, lag, material, branches, rtol, end, d_end):
    """
    Follow a piecewise linear amplifier and differentiate the end by parameters.

    Piece m lasts ``durations[m]`` and applies ``begins[m] + slopes[m] t``; ``d_durations`` and
    ``d_begins`` (m, p) are the derivatives by the parameters, of which the first ``parameters``
    count. ``field`` and ``followed`` (n,) are at the start. ``end`` (3 + n,) takes stretch, rate,
    field and what branches follow, ``d_end`` (3 + n, p) their derivatives. Returns the status.
    """
    count = followed.size
    width = 2 + count
    k = np.empty((STAGES + 2, width * (1 + parameters)))
    x = k[STAGES]
    x[:] = 0.0
    x[0], x[1] = l, v
    x[2:width] = followed
    d_field, d_rest = np.zeros(d_begins.shape[1]), np.zeros(d_begins.shape[1])
    decay = 1.0 / lag if lag > 0.0 else 0.0
    for m in range(durations.size):
        span, slope = durations[m], slopes[m]
        line, rest, left = begins[m] - slope * lag, 0.0, 0.0
        if lag > 0.0:
            rest, left = field - line, math.exp(-decay * span)
            for c in range(parameters):
                d_rest[c] = d_field[c] - d_begins[m, c]
        if parameters == 0 and count == 0:
            status, x[0], x[1], _ = follow_one(
                k, x[0], x[1], 0.0, line, slope, rest, decay, span, material, rtol)
        else:
            status, _ = _advance(
                k, 0.0, line, slope, rest, decay, d_begins[m], d_rest, span, material, branches,
                count, parameters, rtol)
        if status != DONE:
            return status
        field = line + slope * span + rest * left
        if parameters > 0:
            change = slope - rest * decay * left
            _change(
                x, field, left, d_begins[m], d_rest, material, ANY, branches, count,
                parameters, k[0])
            for c in range(parameters):
                for i in range(width):
                    x[(1 + c) * width + i] += k[0, i] * d_durations[m, c]
                d_field[c] = d_begins[m, c] + d_rest[c] * left + change * d_durations[m, c]
    end[STRETCH], end[RATE], end[FIELD] = x[0], x[1], field
    end[FOLLOWED:] = x[2:width]
    for c in range(parameters):
        at = (1 + c) * width
        d_end[STRETCH, c], d_end[RATE, c], d_end[FIELD, c] = x[at], x[at + 1], d_field[c]
        for b in range(count):
            d_end[FOLLOWED + b, c] = x[at + 2 + b]
    return DONE


@compiled()
def trajectory_late(
        l, v, field, switches, loads, slopes, lag, times, material, branches, rtol,  # noqa: E741
        out):
    """
    Sample the response to a piecewise linear amplifier at increasing times.

    Its level is ``loads[m] + slopes[m] (t - switches[m])`` from ``switches[m]`` on; the motion
    begins at ``switches[0]``, which is not later than ``times[0]``. The field and ``branches``
    (n, 3) are at the start, and go on with the state. ``out`` (3 + n, m) takes stretch, rate,
    field and what the branches follow. Returns the status of the integration.
    """
    count = branches.shape[0]
    k = np.empty((STAGES + 2, 2 + count))
    state = np.array([l, v, 0.0])
    t, piece = switches[0], 0
    decay = 1.0 / lag if lag > 0.0 else 0.0
    line = loads[0] - slopes[0] * lag
    rest = field - line if lag > 0.0 else 0.0
    for i in range(times.size):
        while True:
            end = times[i]
            ends = piece + 1 < switches.size and switches[piece + 1] <= end
            if ends:
                end = switches[piece + 1]
            if count > 0:
                status = _follow_one(
                    k, state, line, slopes[piece], rest, decay, end - t, material, branches,
                    rtol)
            else:
                status, state[0], state[1], state[2] = follow_one(
                    k, state[0], state[1], state[2], line, slopes[piece], rest, decay, end - t,
                    material, rtol)
            if status != DONE:
                return status
            line += slopes[piece] * (end - t)
            rest *= math.exp(-decay * (end - t))
            field = line + rest
            t = end
            if not ends:
                break
            piece += 1
            state[2] = 0.0
            line = loads[piece] - slopes[piece] * lag
            rest = field - line if lag > 0.0 else 0.0
        out[STRETCH, i], out[RATE, i], out[FIELD, i] = state[0], state[1], field
        for b in range(count):
            out[FOLLOWED + b, i] = branches[b, FOLLOWER]
    return DONE


# -- the plant ------------------------------------------------------------------------------------


@compiled()
def _follow_one(k, state, beta, slope, excess, decay, duration, material, branches, rtol):
    """Integrate one actuator that creeps; returns the status, and the step length in ``state``."""
    count = 0
    x = k[STAGES]
    for b in range(branches.shape[0]):
        if branches[b, SPEED] > 0.0:
            x[2 + b] = branches[b, FOLLOWER]
            count += 1
    x[0], x[1] = state[0], state[1]
    # There are no parameters, and so no derivatives of the load.
    status, h = _advance(
        k, state[2], beta, slope, excess, decay, material, material, duration, material,
        branches, count, 0, rtol)
    if status == DONE:
        state[0], state[1], state[2] = x[0], x[1], h
        for b in range(count):
            branches[b, FOLLOWER] = x[2 + b]
    return status


@compiled()
def follow_creeping(
        k, first, last, wanted, state, drive, material, branches, durations, rtol, status):
    """
    Integrate as `hmsa_ros.core.kernels.follow`; ``branches`` (n, most, 3) goes on with the state.

    A branch of speed 0 is none, and those that there are come first.
    """
    failed = 0
    for i in range(first, last):
        if not wanted[i]:
            continue
        beta, slope, excess, decay = drive[i, 0], drive[i, 1], drive[i, 2], drive[i, 3]
        duration = durations[i]
        status[i] = _follow_one(
            k, state[i], beta, slope, excess, decay, duration, material[i], branches[i], rtol)
        if status[i] != DONE:
            failed += 1
            continue
        drive[i, 0] = beta + slope * duration
        drive[i, 2] = faded(beta, excess, decay, duration)
    return failed
