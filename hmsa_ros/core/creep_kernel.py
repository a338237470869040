"""
Compiled integration of actuators whose elastomer creeps: Maxwell branches beside the law.

Branch i holds ``h_i = gamma_i (psi'(l) - w_i)``, where ``w_i`` follows the elastic force,
``tau_i w_i' = psi'(l) - w_i``; that is ``h_i' = gamma_i (psi'(l))' - h_i/tau_i``. As in
`hmsa_ros.core.kernels`, everything is nondimensional and nothing checks its arguments.
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
    MAX_STEPS,
    resize,
    RESOLVED,
    STUCK,
)
from hmsa_ros.core.law import acceleration, at_rest, elastic_force, natural_frequency
from hmsa_ros.core.laws.record import ANY

#: Columns of a branch: gamma, 1/tau and w.
RATIO, SPEED, FOLLOWER = range(3)


def work_space(most: int) -> NDArray[np.float64]:
    """Return the working space for so many branches: stages, a state and the next one."""
    return np.empty((STAGES + 2, 2 + most))


@compiled()
def _step(k, x, beta, slope, excess, decay, h, material, branches, width, rtol):
    """
    One DOP853 step of length ``h`` from the state ``x``; the last row of ``k`` takes the new one.

    The load is as `hmsa_ros.core.kernels.follow_one` takes it. Returns the error in units of the
    tolerance.
    """
    here = k[STAGES + 1]
    for i in range(STAGES):
        here[:width] = 0.0
        for j in range(i):
            w = MATRIX[i, j]
            if w != 0.0:
                for m in range(width):
                    here[m] += w * k[j, m]
        for m in range(width):
            here[m] = x[m] + h * here[m]
        t = h * NODES[i]
        load = beta + slope * t
        if excess != 0.0:
            load += excess * math.exp(-decay * t)
        force = elastic_force(here[0], material)
        for b in range(width - 2):
            above = force - here[2 + b]
            load -= branches[b, RATIO] * above
            k[i, 2 + b] = branches[b, SPEED] * above
        k[i, 0] = here[1]
        k[i, 1] = acceleration(here[0], here[1], load, material, ANY)
    e5 = e3 = 0.0
    for m in range(width):
        d = f5 = f3 = 0.0
        for j in range(STAGES):
            d += WEIGHTS[j] * k[j, m]
            f5 += ERROR_5[j] * k[j, m]
            f3 += ERROR_3[j] * k[j, m]
        here[m] = x[m] + h * d
        scale = 1.0 / (rtol * (1.0 + abs(here[m])))
        e5 += (f5 * scale) ** 2
        e3 += (f3 * scale) ** 2
    error = 0.0
    if e5 != 0.0:
        # A step that left the limits has no number, and is rejected.
        error = abs(h) * e5 / math.sqrt(width * (e5 + 0.01 * e3))
    return error


@compiled()
def _follow_one(k, state, beta, slope, excess, decay, duration, material, branches, rtol):
    """Integrate one actuator; returns the status, and the step length in ``state``."""
    width, total, fastest = 2, 1.0, 0.0
    for b in range(branches.shape[0]):
        if branches[b, SPEED] > 0.0:
            width += 1
            total += branches[b, RATIO]
            fastest = max(fastest, branches[b, SPEED])
    stiff = math.sqrt(total)
    x, new = k[STAGES], k[STAGES + 1]
    x[0], x[1] = state[0], state[1]
    for b in range(width - 2):
        x[2 + b] = branches[b, FOLLOWER]
    h = state[2]
    if h <= 0.0:
        h = 1.0 / (stiff / first_step(x[0], x[1], beta + excess, material, rtol)
                   + 0.25 * rtol ** -0.125 * fastest)
    done = 0.0
    for _ in range(MAX_STEPS):
        left = duration - done
        if not left > 0.0:
            state[0], state[1], state[2] = x[0], x[1], h
            for b in range(width - 2):
                branches[b, FOLLOWER] = x[2 + b]
            return DONE
        span = min(h, left)
        frequency = stiff * natural_frequency(x[0], material)
        if attainable(0.0, x[0], x[1], frequency) > RESOLVED and x[1] * (
                x[0] - at_rest(material)) > 0.0:
            x[1] = -x[1]
        rest = excess
        if excess != 0.0:
            rest *= math.exp(-decay * done)
        error = _step(
            k, x, beta + slope * done, slope, rest, decay, span, material, branches, width,
            attainable(rtol, x[0], x[1], frequency))
        if error <= 1.0:
            x[:width] = new[:width]
            done = duration if span == left else done + span
            if span == h or error > 0.5:
                h = resize(span, error)
        else:
            h = resize(span, error)
    return STUCK


@compiled()
def trajectory_creeping(
        l, v, switches, loads, slopes, times, material, branches, rtol, out):  # noqa: E741
    """
    Sample the response to a piecewise linear load at increasing times.

    Arguments are those of `hmsa_ros.core.kernels.trajectory`; ``branches`` (n, 3) is at the
    start and goes on with the state. ``out`` (2 + n, m) takes stretch, rate and what the
    branches follow. Returns the status of the integration.
    """
    count = branches.shape[0]
    k = np.empty((STAGES + 2, 2 + count))
    state = np.array([l, v, 0.0])
    t, piece = switches[0], 0
    for i in range(times.size):
        while True:
            end = times[i]
            ends = piece + 1 < switches.size and switches[piece + 1] <= end
            if ends:
                end = switches[piece + 1]
            status = _follow_one(
                k, state, loads[piece] + slopes[piece] * (t - switches[piece]), slopes[piece],
                0.0, 0.0, end - t, material, branches, rtol)
            if status != DONE:
                return status
            t = end
            if not ends:
                break
            piece += 1
            state[2] = 0.0
        out[0, i], out[1, i] = state[0], state[1]
        for b in range(count):
            out[2 + b, i] = branches[b, FOLLOWER]
    return DONE


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
