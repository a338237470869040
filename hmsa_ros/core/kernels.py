"""
Compiled kernels: integration of the equation of motion, with and without sensitivities.

All quantities are nondimensional: stretch ``l``, stretch rate ``v``, time in units of
``L sqrt(rho/G)``, signed load ``beta = Br B/(mu0 G)``; ``material`` is packed by
`hmsa_ros.core.law`. Callers are the typed functions of `hmsa_ros.core`; nothing here checks its
arguments.

DOP853 integrates the equation, where it is asked for together with its derivative with respect to
the load (the variational equations), so that a turning point and its derivative come out of one
pass. ``s`` and ``r`` are the derivatives of stretch and rate.
"""

import math

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.dop853 import ERROR_3, ERROR_5, MATRIX, NODES, STAGES, WEIGHTS
from hmsa_ros.core.law import acceleration, at_rest, KIND, motion, natural_frequency, ZETA
from hmsa_ros.core.laws.record import ANY, BEAM, GENT, NEO_HOOKEAN, OGDEN, POLYNOMIAL, TABLE

# Status codes of the integration.
DONE = 0
NO_TURN = 1
STUCK = 2
TOO_CLOSE = 3

# A closer approach to an equilibrium than this share of the move counts as rest: what happens
# below it is lost in rounding.
_AT_REST = 1e-12
# A rate on which only damping still acts falls to numbers with which processors take ten times as
# long.
_NOTHING = 1e-200
MAX_STEPS = 200_000
# One swing takes tens of steps, a creep into an equilibrium thousands.
_MAX_TURN_STEPS = 20_000
# Closer to a limiting stretch than rounding lets this tolerance be kept, motion is not resolved.
RESOLVED = 1e-8


def work_space() -> NDArray[np.float64]:
    """Return the working space that the integration needs, one for each thread."""
    return np.empty((STAGES, 4))


@compiled(inline=True)
def _derivative(l, v, s, r, beta, material, family):  # noqa: E741
    """Right-hand side of Eq. 11 and of its variational equation."""
    a, a_l, a_v, a_beta = motion(l, v, beta, material, family)
    return v, a, r, a_l * s + a_v * r + a_beta


@compiled(inline=True)
def error_of(h, new_l, new_v, e5_l, e5_v, e3_l, e3_v, rtol):
    """Return the error of a step in units of the tolerance, from both error estimates."""
    scale_l = 1.0 / (rtol * (1.0 + abs(new_l)))
    scale_v = 1.0 / (rtol * (1.0 + abs(new_v)))
    e5 = (e5_l * scale_l) ** 2 + (e5_v * scale_v) ** 2
    e3 = (e3_l * scale_l) ** 2 + (e3_v * scale_v) ** 2
    error = 0.0
    if e5 != 0.0:
        error = abs(h) * e5 / math.sqrt(2.0 * (e5 + 0.01 * e3))
    return error


@compiled()
def step(k, l, v, s, r, beta, h, material, rtol):  # noqa: E741
    """
    One DOP853 step of length ``h`` under a constant load; ``k`` (12, 4) is working space.

    Returns the new state and the error in units of the tolerance.
    """
    if material[KIND] <= NEO_HOOKEAN:
        return _step(k, l, v, s, r, beta, h, material, rtol, GENT)
    if material[KIND] == POLYNOMIAL:
        return _polynomial_step(k, l, v, s, r, beta, h, material, rtol)
    if material[KIND] == OGDEN:
        return _ogden_step(k, l, v, s, r, beta, h, material, rtol)
    if material[KIND] == BEAM:
        return _beam_step(k, l, v, s, r, beta, h, material, rtol)
    return _table_step(k, l, v, s, r, beta, h, material, rtol)


@compiled()
def _polynomial_step(k, l, v, s, r, beta, h, material, rtol):  # noqa: E741
    """Make a step, compiled by itself to keep the one for Gent short."""
    return _step(k, l, v, s, r, beta, h, material, rtol, POLYNOMIAL)


@compiled()
def _ogden_step(k, l, v, s, r, beta, h, material, rtol):  # noqa: E741
    """Make a step, compiled by itself to keep the one for Gent short."""
    return _step(k, l, v, s, r, beta, h, material, rtol, OGDEN)


@compiled()
def _table_step(k, l, v, s, r, beta, h, material, rtol):  # noqa: E741
    """Make a step, compiled by itself to keep the one for Gent short."""
    return _step(k, l, v, s, r, beta, h, material, rtol, TABLE)


@compiled()
def _beam_step(k, l, v, s, r, beta, h, material, rtol):  # noqa: E741
    """Make a step, compiled by itself to keep the one for Gent short."""
    return _step(k, l, v, s, r, beta, h, material, rtol, BEAM)


@compiled(inline=True)
def _step(k, l, v, s, r, beta, h, material, rtol, family):  # noqa: E741
    """Make a step, compiled for a family of laws."""
    for i in range(STAGES):
        d0 = d1 = d2 = d3 = 0.0
        for j in range(i):
            w = MATRIX[i, j]
            d0 += w * k[j, 0]
            d1 += w * k[j, 1]
            d2 += w * k[j, 2]
            d3 += w * k[j, 3]
        k[i, 0], k[i, 1], k[i, 2], k[i, 3] = _derivative(
            l + h * d0, v + h * d1, s + h * d2, r + h * d3, beta, material, family)
    d0 = d1 = d2 = d3 = 0.0
    e5_l = e5_v = e3_l = e3_v = 0.0
    for j in range(STAGES):
        d0 += WEIGHTS[j] * k[j, 0]
        d1 += WEIGHTS[j] * k[j, 1]
        d2 += WEIGHTS[j] * k[j, 2]
        d3 += WEIGHTS[j] * k[j, 3]
        e5_l += ERROR_5[j] * k[j, 0]
        e5_v += ERROR_5[j] * k[j, 1]
        e3_l += ERROR_3[j] * k[j, 0]
        e3_v += ERROR_3[j] * k[j, 1]
    new_l = l + h * d0
    new_v = v + h * d1
    error = error_of(h, new_l, new_v, e5_l, e5_v, e3_l, e3_v, rtol)
    return new_l, new_v, s + h * d2, r + h * d3, error


@compiled()
def first_step(l, v, beta, material, rtol):  # noqa: E741
    """Return a first step length: a fixed phase of the local oscillation."""
    rate = natural_frequency(l, material)
    # Where the force turns, the frequency vanishes.
    return 4.0 * rtol ** 0.125 / (rate + 3.0 * material[ZETA] + 1e-9)


@compiled(inline=True)
def attainable(rtol, l, v, frequency):  # noqa: E741
    """
    Return a tolerance that rounding lets a step keep.

    A stretch rounded to one part in 2^52 changes the acceleration by that share of
    ``l frequency^2``, and a step lasts about ``1/frequency``. That matters close to the
    limiting stretches.
    """
    return max(rtol, 3e-16 * abs(l) * frequency / (1.0 + abs(v)))


@compiled()
def resize(h, error):
    """Return the next step length from the error of the last one."""
    if not error < math.inf:
        return 0.2 * h
    return h * min(6.0, max(0.2, 0.9 * max(error, 1e-12) ** -0.125))


@compiled()
def turning_point(k, l, v, direction, beta, move, material, rtol):  # noqa: E741
    """
    Follow a constant load to the first turning point that is reached in a direction.

    That is the first instant at which ``direction * v`` falls through zero. ``move`` is the
    length against which closeness to an equilibrium is measured.

    Returns status (`NO_TURN` when the motion creeps into an equilibrium instead, `TOO_CLOSE`
    when it meets a limiting stretch too hard to be resolved), time, stretch, its derivative
    with respect to the load, and the derivative of the time.
    """
    s = 0.0
    r = 0.0
    t = 0.0
    h = first_step(l, v, beta, material, rtol)
    armed = direction * v > 0.0
    rate = natural_frequency(l, material)
    for _ in range(_MAX_TURN_STEPS):
        new_l, new_v, new_s, new_r, error = step(
            k, l, v, s, r, beta, h, material, attainable(rtol, l, v, rate))
        if not error <= 1.0:
            h = resize(h, error)
            continue
        if armed and direction * new_v <= 0.0:
            return _land(
                k, l, v, s, r, t, direction, beta, h, new_v, material, rtol)
        a = k[0, 1]
        l, v, s, r = new_l, new_v, new_s, new_r  # noqa: E741
        t += h
        h = resize(h, error)
        armed = direction * v > 0.0
        rate = natural_frequency(l, material)
        if attainable(0.0, l, v, rate) > RESOLVED:
            return TOO_CLOSE, t, l, s, 0.0
        fast = rate + 3.0 * material[ZETA]
        if (abs(v) < _AT_REST * move * fast and abs(a) < _AT_REST * move * fast * fast):
            return NO_TURN, t, l, s, 0.0
    return STUCK, t, l, s, 0.0


@compiled(inline=True)
def turn_of(h, v, end_v, a, direction):
    """Return about when the rate turns in a step of length ``h``, from both rates and a slope."""
    # The secant; where the start decelerates, the parabola through both rates and that slope.
    dt = h * v / (v - end_v)
    if direction * a < 0.0:
        c = (end_v - v - a * h) / (h * h)
        root = a * a - 4.0 * c * v
        if root > 0.0:
            dt = 2.0 * v / (-a + direction * math.sqrt(root))
    return dt


@compiled()
def _land(k, l, v, s, r, t, direction, beta, h, end_v, material, rtol):  # noqa: E741
    """
    Find the turning point inside a step that passes it.

    Newton on the time, kept inside the step: each pass is a DOP853 step of its own from the
    same start. The last correction, far below rounding, is taken from the Taylor series.
    """
    dt = turn_of(h, v, end_v, k[0, 1], direction)
    before = 0.0
    after = h
    size = max(abs(v), abs(end_v))
    for _ in range(60):
        if not before < dt < after:
            dt = 0.5 * (before + after)
        new_l, new_v, new_s, new_r, _ = step(k, l, v, s, r, beta, dt, material, rtol)
        _, a, _, _ = _derivative(new_l, new_v, new_s, new_r, beta, material, ANY)
        if abs(new_v) <= 1e-6 * size and direction * a < 0.0:
            break
        if direction * new_v > 0.0:
            before = dt
        else:
            after = dt
        # Without deceleration it is too early or too late: bisect.
        dt = dt - new_v / a if direction * a < 0.0 else -1.0
    left = -new_v / a
    new_l += 0.5 * new_v * left
    new_s += new_r * left
    _, a, _, slope = _derivative(new_l, 0.0, new_s, new_r, beta, material, ANY)
    new_r += slope * left
    return DONE, t + dt + left, new_l, new_s, -new_r / a


# -- without sensitivities -----------------------------------------------------------------------


@compiled()
def _plain_step(k, l, v, beta, slope, excess, decay, h, material, rtol):  # noqa: E741
    """
    One DOP853 step without sensitivities; ``k`` (12, 4) is working space, half of it used.

    The load is ``beta + slope t + excess exp(-decay t)`` from the start of the step. Returns
    the new state and the error in units of the tolerance.
    """
    if material[KIND] <= NEO_HOOKEAN:
        return _bare_step(k, l, v, beta, slope, excess, decay, h, material, rtol, GENT)
    return _bare_family_step(k, l, v, beta, slope, excess, decay, h, material, rtol)


@compiled()
def _bare_family_step(k, l, v, beta, slope, excess, decay, h, material, rtol):  # noqa: E741
    """Make a step without sensitivities for a law beside Gent."""
    return _bare_step(k, l, v, beta, slope, excess, decay, h, material, rtol, ANY)


@compiled(inline=True)
def _bare_step(k, l, v, beta, slope, excess, decay, h, material, rtol, family):  # noqa: E741
    """Make a step without sensitivities, as `_step` does."""
    for i in range(STAGES):
        d0 = d1 = 0.0
        for j in range(i):
            w = MATRIX[i, j]
            d0 += w * k[j, 0]
            d1 += w * k[j, 1]
        t = h * NODES[i]
        load = beta + slope * t
        if excess != 0.0:
            load += excess * math.exp(-decay * t)
        new_v = v + h * d1
        k[i, 0] = new_v
        k[i, 1] = acceleration(l + h * d0, new_v, load, material, family)
    d0 = d1 = 0.0
    e5_l = e5_v = e3_l = e3_v = 0.0
    for j in range(STAGES):
        d0 += WEIGHTS[j] * k[j, 0]
        d1 += WEIGHTS[j] * k[j, 1]
        e5_l += ERROR_5[j] * k[j, 0]
        e5_v += ERROR_5[j] * k[j, 1]
        e3_l += ERROR_3[j] * k[j, 0]
        e3_v += ERROR_3[j] * k[j, 1]
    new_l = l + h * d0
    new_v = v + h * d1
    return new_l, new_v, error_of(h, new_l, new_v, e5_l, e5_v, e3_l, e3_v, rtol)


@compiled()
def follow_one(k, l, v, h, beta, slope, excess, decay, duration, material, rtol):  # noqa: E741
    """
    Integrate over a duration under the load that `_plain_step` takes.

    ``h`` is the step length to begin with, 0 for none known. Motion that meets a limiting
    stretch too hard to be resolved turns there, in no time and without loss. Returns status,
    state and the step length to go on with.
    """
    if h <= 0.0:
        h = first_step(l, v, beta + excess, material, rtol)
    done = 0.0
    for _ in range(MAX_STEPS):
        left = duration - done
        if not left > 0.0:
            return DONE, l, v, h
        span = min(h, left)
        rate = natural_frequency(l, material)
        if attainable(0.0, l, v, rate) > RESOLVED and v * (l - at_rest(material)) > 0.0:
            v = -v
        rest = excess
        if excess != 0.0:
            rest *= math.exp(-decay * done)
        new_l, new_v, error = _plain_step(
            k, l, v, beta + slope * done, slope, rest, decay, span, material,
            attainable(rtol, l, v, rate))
        if error <= 1.0:
            l, v = new_l, new_v  # noqa: E741
            if abs(v) < _NOTHING:
                v = 0.0
            done = duration if span == left else done + span
            if span == h or error > 0.5:
                h = resize(span, error)
        else:
            h = resize(span, error)
    return STUCK, l, v, h


@compiled()
def trajectory(
        l, v, switches, betas, slopes, times, material, rtol, stretch,  # noqa: E741
        rates):
    """
    Sample the response to a piecewise linear load at increasing times.

    The load is ``betas[m] + slopes[m] (t - switches[m])`` from ``switches[m]`` on; the motion
    begins at ``switches[0]``, which is not later than ``times[0]``. ``stretch`` and ``rates``
    (n,) take the samples. Returns the status of the integration.
    """
    k = np.empty((STAGES, 4))
    t = switches[0]
    piece = 0
    h = 0.0
    for i in range(times.size):
        while True:
            end = times[i]
            if piece + 1 < switches.size and switches[piece + 1] <= end:
                end = switches[piece + 1]
            status, l, v, h = follow_one(  # noqa: E741
                k, l, v, h, betas[piece] + slopes[piece] * (t - switches[piece]), slopes[piece],
                0.0, 0.0, end - t, material, rtol)
            if status != DONE:
                return status
            t = end
            if piece + 1 < switches.size and switches[piece + 1] <= times[i]:
                piece += 1
                h = 0.0
            else:
                break
        stretch[i] = l
        rates[i] = v
    return DONE


@compiled()
def faded(beta, excess, decay, duration):
    """Return what is left of an excess after a duration: nothing that a sum would not show."""
    if excess != 0.0:
        excess *= math.exp(-decay * duration)
        if not abs(excess) > 1e-17 * (1e-3 + abs(beta)):
            excess = 0.0
    return excess


@compiled()
def follow(k, first, last, wanted, state, drive, material, durations, rtol, status):
    """
    Integrate the actuators ``first`` to ``last`` of which ``wanted`` is true.

    Rows: ``state`` stretch, rate, step length (0 for none known); ``drive`` the load as
    ``_plain_step`` takes it, which is brought forward to the end; ``material`` as packed.
    One that does not get through keeps its state. Returns how many these are; ``status`` tells
    which.
    """
    failed = 0
    for i in range(first, last):
        if not wanted[i]:
            continue
        beta, slope, excess, decay = drive[i, 0], drive[i, 1], drive[i, 2], drive[i, 3]
        duration = durations[i]
        status[i], l, v, h = follow_one(  # noqa: E741
            k, state[i, 0], state[i, 1], state[i, 2], beta, slope, excess, decay, duration,
            material[i], rtol)
        if status[i] != DONE:
            failed += 1
            continue
        state[i, 0] = l
        state[i, 1] = v
        state[i, 2] = h
        drive[i, 0] = beta + slope * duration
        drive[i, 2] = faded(beta, excess, decay, duration)
    return failed
