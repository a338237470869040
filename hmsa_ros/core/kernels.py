"""
Compiled kernels: integration of Eq. 11 with sensitivities, and the two-step solution.

Everything that Numba compiles stands in this one file, because Numba renews a cached function
when its own file changes, not when a function that it calls does. All quantities are
nondimensional as in Eq. 11: stretch ``l``, stretch rate ``v``, time in units of
``L sqrt(rho/G)``, signed load ``beta = Br B/(mu0 G)``. The chain limit enters as
``i_j = 1/J_lim``. Callers are the typed functions of `hmsa_ros.core`; nothing here checks its
arguments.

The equation of motion is integrated with DOP853 together with its derivative with respect to
one parameter of the load (the variational equations), so that a turning point and its
derivative come out of one pass. ``s`` and ``r`` are the derivatives of stretch and rate.
"""

import math

from numba import njit, prange
import numpy as np
from numpy.typing import NDArray

from hmsa_ros.core.dop853 import ERROR_3, ERROR_5, MATRIX, NODES, STAGES, WEIGHTS

# Status codes of the integration.
DONE = 0
NO_TURN = 1
STUCK = 2
TOO_CLOSE = 3

# Status codes of a two-step plan; `hmsa_ros.core.two_step.Status` names them for callers.
TWO_STEP = 0
HOLD = 1
TOO_DAMPED = 2
INDISTINGUISHABLE = 3
NO_TWO_STEP = 4
NOT_CONVERGED = 5
OUT_OF_RANGE = 6
BAD_INPUT = 7

# A closer approach to an equilibrium than this share of the move counts as rest: what happens
# below it is lost in rounding.
_AT_REST = 1e-12
# Sign of the deviation is decided by the linearised motion below this share of the move or of
# the room to a limit.
_LINEAR = 1e-6
_MAX_STEPS = 200_000
# One swing takes tens of steps, a creep into an equilibrium thousands.
_MAX_TURN_STEPS = 20_000
_MAX_ITERATIONS = 80
_COARSE = 1e-7
# Closer to a limiting stretch than rounding lets this tolerance be kept, motion is not resolved.
_RESOLVED = 1e-8
_FARTHEST = 1e3
_NEWTON_PASSES = 8
# Swings that do not end within the steps allowed are given up after so many.
_MAX_STUCK = 4


# Fused multiply-add, but nothing that would treat NaN as impossible: it ends bad steps.
_FAST = {'contract', 'nsz'}
_compiled = njit(cache=True, error_model='numpy', fastmath=_FAST)


def work_space() -> NDArray[np.float64]:
    """Return the working space that the integration needs, one for each thread."""
    return np.empty((STAGES, 4))


@njit(cache=True, error_model='numpy', fastmath=_FAST, inline='always')
def _derivative(l, v, s, r, beta, p, zeta, c1, i_j):  # noqa: E741
    """
    Right-hand side of Eq. 11 and of its variational equation.

    ``p`` is the derivative of the load with respect to the parameter. Outside the admissible
    stretches the result is NaN, which makes the step control reject the step.
    """
    l2 = l * l
    l3 = l2 * l
    # l g(l), with g as in Eq. 4, free of cancellation near l = 1.
    lg = l - (l - 1.0) * (l - 1.0) * (l + 2.0) * i_j
    if not (l > 0.0 and lg > 0.0):
        return math.nan, math.nan, math.nan, math.nan
    inertia = 1.0 + c1 * l3
    # One division serves the three reciprocals.
    inverse = 1.0 / (inertia * lg * l)
    i_inertia = inverse * lg * l
    i_lg = inverse * inertia * l
    i_l = inverse * inertia * lg
    elastic = l2 * (l3 - 1.0) * i_lg
    d_elastic = (5.0 * l3 * l - 2.0 * l - elastic * (1.0 - 3.0 * (l2 - 1.0) * i_j)) * i_lg
    damping = 3.0 * zeta * c1 * l2
    a = (6.0 * (beta * l3 - elastic) - damping * l * v + 1.5 * v * v * i_l) * i_inertia
    a_l = (6.0 * (3.0 * beta * l2 - d_elastic) - 3.0 * damping * v - 1.5 * v * v * i_l * i_l
           - 3.0 * a * c1 * l2) * i_inertia
    a_v = (3.0 * v * i_l - damping * l) * i_inertia
    return v, a, r, a_l * s + a_v * r + 6.0 * l3 * i_inertia * p


@njit(cache=True, error_model='numpy', fastmath=_FAST, inline='always')
def _error(h, new_l, new_v, e5_l, e5_v, e3_l, e3_v, rtol):
    """Return the error of a step in units of the tolerance, from both error estimates."""
    scale_l = 1.0 / (rtol * (1.0 + abs(new_l)))
    scale_v = 1.0 / (rtol * (1.0 + abs(new_v)))
    e5 = (e5_l * scale_l) ** 2 + (e5_v * scale_v) ** 2
    e3 = (e3_l * scale_l) ** 2 + (e3_v * scale_v) ** 2
    error = 0.0
    if e5 != 0.0:
        error = abs(h) * e5 / math.sqrt(2.0 * (e5 + 0.01 * e3))
    return error


@_compiled
def _step(k, l, v, s, r, beta, slope, p, q, h, zeta, c1, i_j, rtol):  # noqa: E741
    """
    One DOP853 step of length ``h``; ``k`` (12, 4) is working space.

    The load is ``beta + slope t`` and its parameter derivative ``p + q t`` from the start of
    the step. Returns the new state and the error in units of the tolerance.
    """
    for i in range(STAGES):
        d0 = d1 = d2 = d3 = 0.0
        for j in range(i):
            w = MATRIX[i, j]
            d0 += w * k[j, 0]
            d1 += w * k[j, 1]
            d2 += w * k[j, 2]
            d3 += w * k[j, 3]
        t = h * NODES[i]
        k[i, 0], k[i, 1], k[i, 2], k[i, 3] = _derivative(
            l + h * d0, v + h * d1, s + h * d2, r + h * d3,
            beta + slope * t, p + q * t, zeta, c1, i_j)
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
    error = _error(h, new_l, new_v, e5_l, e5_v, e3_l, e3_v, rtol)
    return new_l, new_v, s + h * d2, r + h * d3, error


@_compiled
def elastic_force(l, i_j):  # noqa: E741
    """Return the load that balances the stretch at rest, psi'(l)."""
    return (l - 1.0) * (l * l + l + 1.0) / (l * (
        l - (l - 1.0) * (l - 1.0) * (l + 2.0) * i_j))


@_compiled
def elastic_stiffness(l, i_j):  # noqa: E741
    """Return psi''(l)."""
    g = 1.0 - (l - 1.0) * (l - 1.0) * (l + 2.0) * i_j / l
    f = (l - 1.0) * (l * l + l + 1.0) / (l * l)
    return (1.0 + 2.0 / l ** 3) / g + 2.0 * f * f * i_j / (g * g)


@_compiled
def mass(l, c1):  # noqa: E741
    """Return the inertia m(l) of Eq. 7."""
    return (l ** -3 + c1) / 6.0


@_compiled
def natural_frequency(l, c1, i_j):  # noqa: E741
    """Return the frequency of small undamped motion about a stretch."""
    return math.sqrt(elastic_stiffness(l, i_j) / mass(l, c1))


@_compiled
def elastic_energy(l, i_j):  # noqa: E741
    """Return psi(l), zero at l = 1."""
    return -0.5 / i_j * math.log1p(-(l - 1.0) * (l - 1.0) * (l + 2.0) * i_j / l)


@_compiled
def critical_zeta(l, c1, i_j):  # noqa: E741
    """Return the damping that is critical for small motion about a stretch."""
    return 4.0 / c1 * math.sqrt(mass(l, c1) * elastic_stiffness(l, i_j))


@_compiled
def stretch_limits(i_j):
    """Return the lower and the upper limiting stretch, the roots of g."""
    p = 1.0 / i_j + 3.0
    angle = math.acos(-((3.0 / p) ** 1.5))
    lower = 2.0 * math.sqrt(p / 3.0) * math.cos((angle - 2.0 * math.pi) / 3.0)
    upper = 2.0 * math.sqrt(p / 3.0) * math.cos(angle / 3.0)
    for _ in range(2):
        # One or two Newton steps recover the digits lost where the roots lie close together.
        lower -= (lower ** 3 - p * lower + 2.0) / (3.0 * lower * lower - p)
        upper -= (upper ** 3 - p * upper + 2.0) / (3.0 * upper * upper - p)
    return lower, upper


@_compiled
def equilibrium_stretch(beta, i_j):
    """Return the stretch at which a constant load is in balance; psi' is monotone."""
    lower, upper = stretch_limits(i_j)
    if beta > 0.0:
        lower = 1.0
    elif beta < 0.0:
        upper = 1.0
    else:
        return 1.0
    l = 0.5 * (lower + upper)  # noqa: E741
    for _ in range(200):
        # Newton on l^2 g(l) (psi'(l) - beta), which has no pole at the limits.
        lg = l - (l - 1.0) * (l - 1.0) * (l + 2.0) * i_j
        value = (l - 1.0) * (l * l + l + 1.0) - beta * l * lg
        slope = 3.0 * l * l - beta * (lg + l * (1.0 - 3.0 * (l * l - 1.0) * i_j))
        if value > 0.0:
            upper = l
        else:
            lower = l
        new = l - value / slope
        if not lower < new < upper:
            new = 0.5 * (lower + upper)
        if abs(new - l) <= 2e-16 * l:
            return new
        l = new  # noqa: E741
    return l


@_compiled
def _first_step(l, v, beta, zeta, c1, i_j, rtol):  # noqa: E741
    """Return a first step length: a fixed phase of the local oscillation."""
    rate = natural_frequency(l, c1, i_j)
    return 4.0 * rtol ** 0.125 / (rate + 3.0 * zeta)


@njit(cache=True, error_model='numpy', fastmath=_FAST, inline='always')
def _attainable(rtol, l, v, frequency):  # noqa: E741
    """
    Return a tolerance that rounding lets a step keep.

    A stretch rounded to one part in 2^52 changes the acceleration by that share of
    ``l frequency^2``, and a step lasts about ``1/frequency``. That matters close to the
    limiting stretches.
    """
    return max(rtol, 3e-16 * l * frequency / (1.0 + abs(v)))


@_compiled
def _resize(h, error):
    """Return the next step length from the error of the last one."""
    if not error < math.inf:
        return 0.2 * h
    return h * min(6.0, max(0.2, 0.9 * max(error, 1e-12) ** -0.125))


@_compiled
def advance(k, l, v, s, r, beta, slope, p, q, duration, zeta, c1, i_j, rtol, h):  # noqa: E741
    """
    Integrate over a duration under the load ``beta + slope t``.

    ``h`` is the step length to begin with, 0 for none known. Motion that meets a limiting
    stretch too hard to be resolved turns there, in no time and without loss. Returns status,
    state, sensitivities and the step length to go on with.
    """
    if h <= 0.0:
        h = _first_step(l, v, beta, zeta, c1, i_j, rtol)
    done = 0.0
    for _ in range(_MAX_STEPS):
        left = duration - done
        if not left > 0.0:
            return DONE, l, v, s, r, h
        step = min(h, left)
        rate = natural_frequency(l, c1, i_j)
        if _attainable(0.0, l, v, rate) > _RESOLVED and v * (l - 1.0) > 0.0:
            v, s, r = -v, -s, -r
        new_l, new_v, new_s, new_r, error = _step(
            k, l, v, s, r, beta + slope * done, slope, p + q * done, q, step, zeta, c1, i_j,
            _attainable(rtol, l, v, rate))
        if error <= 1.0:
            l, v, s, r = new_l, new_v, new_s, new_r  # noqa: E741
            done = duration if step == left else done + step
            if step == h or error > 0.5:
                h = _resize(step, error)
        else:
            h = _resize(step, error)
    return STUCK, l, v, s, r, h


@_compiled
def turning_point(k, l, v, direction, beta, move, zeta, c1, i_j, rtol):  # noqa: E741
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
    h = _first_step(l, v, beta, zeta, c1, i_j, rtol)
    armed = direction * v > 0.0
    rate = natural_frequency(l, c1, i_j)
    for _ in range(_MAX_TURN_STEPS):
        new_l, new_v, new_s, new_r, error = _step(
            k, l, v, s, r, beta, 0.0, 1.0, 0.0, h, zeta, c1, i_j,
            _attainable(rtol, l, v, rate))
        if not error <= 1.0:
            h = _resize(h, error)
            continue
        if armed and direction * new_v <= 0.0:
            return _land(
                k, l, v, s, r, t, direction, beta, h, new_v, zeta, c1, i_j, rtol)
        a = k[0, 1]
        l, v, s, r = new_l, new_v, new_s, new_r  # noqa: E741
        t += h
        h = _resize(h, error)
        armed = direction * v > 0.0
        rate = natural_frequency(l, c1, i_j)
        if _attainable(0.0, l, v, rate) > _RESOLVED:
            return TOO_CLOSE, t, l, s, 0.0
        fast = rate + 3.0 * zeta
        if (abs(v) < _AT_REST * move * fast and abs(a) < _AT_REST * move * fast * fast):
            return NO_TURN, t, l, s, 0.0
    return STUCK, t, l, s, 0.0


@_compiled
def _land(k, l, v, s, r, t, direction, beta, h, end_v, zeta, c1, i_j, rtol):  # noqa: E741
    """
    Find the turning point inside a step that passes it.

    Newton on the time, kept inside the step: each pass is a DOP853 step of its own from the
    same start. The last correction, far below rounding, is taken from the Taylor series.
    """
    a = k[0, 1]
    # The secant; where the start decelerates, the parabola through both rates and that slope.
    dt = h * v / (v - end_v)
    if direction * a < 0.0:
        c = (end_v - v - a * h) / (h * h)
        root = a * a - 4.0 * c * v
        if root > 0.0:
            dt = 2.0 * v / (-a + direction * math.sqrt(root))
    before = 0.0
    after = h
    size = max(abs(v), abs(end_v))
    for _ in range(60):
        if not before < dt < after:
            dt = 0.5 * (before + after)
        new_l, new_v, new_s, new_r, _ = _step(
            k, l, v, s, r, beta, 0.0, 1.0, 0.0, dt, zeta, c1, i_j, rtol)
        _, a, _, _ = _derivative(new_l, new_v, new_s, new_r, beta, 1.0, zeta, c1, i_j)
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
    _, a, _, slope = _derivative(new_l, 0.0, new_s, new_r, beta, 1.0, zeta, c1, i_j)
    new_r += slope * left
    return DONE, t + dt + left, new_l, new_s, -new_r / a


@_compiled
def crosses(k, l, v, target, zeta, c1, i_j, rtol):  # noqa: E741
    """
    Return whether the response to the target's own load passes the target.

    Below critical damping it always does. Above, it is followed until it has, or until the
    linearised motion tells: with eigenvalues a < b < 0 and deviation x it creeps in from its
    own side unless (v - a x) x < 0.
    """
    if zeta < critical_zeta(target, c1, i_j):
        return True
    beta = elastic_force(target, i_j)
    half = 0.25 * zeta * c1 / mass(target, c1)
    fast = -half - math.sqrt(
        max(half * half - natural_frequency(target, c1, i_j) ** 2, 0.0))
    lower, upper = stretch_limits(i_j)
    small = _LINEAR * max(abs(l - target), abs(v / fast), min(target - lower, upper - target))
    side = l - target
    h = 0.0
    for _ in range(_MAX_STEPS):
        x = l - target
        if x * side < 0.0 or x == 0.0:
            return True
        if abs(x) < small and abs(v) < small * abs(fast):
            return (v - fast * x) * x < 0.0
        if h <= 0.0:
            h = _first_step(l, v, beta, zeta, c1, i_j, rtol)
        new_l, new_v, _, _, error = _step(
            k, l, v, 0.0, 0.0, beta, 0.0, 0.0, 0.0, h, zeta, c1, i_j, rtol)
        if error <= 1.0:
            l, v = new_l, new_v  # noqa: E741
        h = _resize(h, error)
    return False


@_compiled
def _guess(l, v, target, direction, beta_1, zeta, c1, i_j):  # noqa: E741
    """
    Return a first guess of ``direction * (beta_1 - beta_p)``.

    The energy balance gives it exactly without damping. The linear oscillator says how it
    shrinks with damping, by 2 K/(1 + K) with the decay K over half a period; its damping ratio
    is the damping force, at the rate that the balance gives half way, against that of the
    spring.
    """
    if target == l:
        return math.inf
    start = elastic_energy(l, i_j) + 0.5 * mass(l, c1) * v * v
    beta = (elastic_energy(target, i_j) - start) / (target - l)
    delta = direction * (beta_1 - beta)
    half = 0.5 * (l + target)
    kinetic = start + beta * (half - l) - elastic_energy(half, i_j)
    fastest = math.sqrt(max(2.0 * kinetic / mass(half, c1), 0.0))
    xi = 0.25 * zeta * c1 * fastest / abs(delta)
    decay = 1e-3
    if xi < 0.9:
        decay = math.exp(-math.pi * xi / math.sqrt(1.0 - xi * xi))
    return delta * 2.0 * decay / (1.0 + decay)


@_compiled
def shoot(
        k, l, v, target, direction, beta_min, beta_max, zeta, c1, i_j, rtol):  # noqa: E741
    """
    Find the load whose turning point in a direction is the target.

    Newton on ``d = direction * (beta_1 - beta_p) > 0``, kept inside a bracket: at d = 0 the
    motion overshoots the target, at a large d it stops short. The difference is the unknown
    because it falls below the rounding of beta_p itself near critical damping. The turning
    point is compared to the target by ``log((l - lower)/(upper - l))``, on which the load acts
    about linearly even close to a limiting stretch. The first passes are coarse and only guess
    for the last ones, which bracket anew. The search ends at the admissible loads, or far from
    the target's own where they are infinite.

    Returns status, beta_p, tau_p, beta_1 and the number of passes.
    """
    beta_1 = elastic_force(target, i_j)
    move = abs(target - l) + abs(v) / natural_frequency(target, c1, i_j)
    lower, upper = stretch_limits(i_j)
    # Errors count against the move and the room that the limits leave.
    size = 1.0 + target
    rtol = max(min(rtol, 1e-10 * move / size), 1e-14)
    enough = max(0.1 * math.sqrt(rtol), 1e-14 * size / move)
    tolerance = max(rtol, _COARSE * min(size, move, target - lower, upper - target) / size)
    # A smaller difference of loads is rounding of the elastic force.
    least = 1e-14 * (abs(beta_1) + target * elastic_stiffness(target, i_j))
    most = math.inf
    if v == 0.0:
        most = direction * (beta_1 - elastic_force(l, i_j))
        if not most > 0.0:
            return NO_TWO_STEP, math.nan, math.nan, beta_1, 0
    top = direction * (beta_1 - (beta_min if direction > 0.0 else beta_max))
    if not top < math.inf:
        top = _FARTHEST * (1.0 + abs(beta_1))
    # From rest beta_p lies between the two holding loads: it is found there, inside or not.
    top = max(top, most) if most < math.inf else top
    guess = _guess(l, v, target, direction, beta_1, zeta, c1, i_j)
    if not 0.0 < guess < min(most, top):
        guess = 0.5 * most if most < math.inf else 1.0
    low, high, d = 0.0, most, guess
    stuck = 0
    for iteration in range(1, _MAX_ITERATIONS + 1):
        beta = beta_1 - direction * d
        status, t, end, s, dt_dbeta = turning_point(
            k, l, v, direction, beta, move, zeta, c1, i_j, tolerance)
        stuck += status == STUCK
        if stuck == _MAX_STUCK:
            break
        miss = end - target
        change = math.inf
        if status == DONE:
            excess = math.log1p(miss / (target - lower)) - math.log1p(-miss / (upper - target))
            change = direction * excess / (
                s * (1.0 / (end - lower) + 1.0 / (upper - end)))
        if status != NO_TURN and direction * miss > 0.0:
            low = max(low, d)
        else:
            high = min(high, d)
        new = d + change
        if high == math.inf and iteration > _NEWTON_PASSES:
            # Newton creeps along an excess that never ends: stride out to the bound.
            new = max(new, 4.0 * d)
        # Against beta_p, where that is the smaller one: close to a limit.
        relative = abs(new - d) / min(d, 1.0 + abs(beta))
        if not low < new < high:
            lost = high < 8.0 * least
            closed = high - low <= 4e-16 * (abs(beta_1) + high)
            if tolerance > rtol and (lost or closed):
                # Coarse passes have misled the search: begin again.
                tolerance = rtol
                low, high, d = 0.0, most, guess
                continue
            if lost and status not in (DONE, NO_TURN):
                break
            if lost:
                return INDISTINGUISHABLE, math.nan, math.nan, beta_1, iteration
            if status == DONE and abs(miss) <= 1e-7 * move and (
                    closed or abs(change) <= 1e-13 * d):
                # As near as rounding allows.
                new = d
            elif closed:
                break
            elif high == math.inf:
                new = 4.0 * d
            elif low == 0.0:
                new = 0.125 * high
            else:
                new = 0.5 * (low + high)
            relative = abs(new - d) / min(d, 1.0 + abs(beta))
        if (tolerance <= rtol and relative <= enough and status == DONE
                and abs(miss) <= 1e-6 * move):
            if new < least:
                return INDISTINGUISHABLE, math.nan, math.nan, beta_1, iteration
            change = new - d
            return TWO_STEP, beta - direction * change, t - dt_dbeta * direction * change, \
                beta_1, iteration
        d = new
        if d > top:
            return NO_TWO_STEP, math.nan, math.nan, beta_1, iteration
        if relative < 0.1 and tolerance > rtol:
            # What quadratic convergence leaves for the next pass to resolve.
            tolerance = max(rtol, min(tolerance, 1e-2 * relative * relative))
            if tolerance < 1e3 * rtol:
                tolerance = rtol
                low, high = 0.0, most
    return NOT_CONVERGED, math.nan, math.nan, beta_1, iteration


@_compiled
def two_step(k, l, v, target, zeta, c1, i_j, beta_min, beta_max, rtol, hold):  # noqa: E741
    """
    Plan one move: the fastest single intermediate load that ends at rest at the target.

    There are at most two: one whose turning point is reached on the way up and one on the way
    down (Eqs. 13 and 14 from rest know the direct one only). ``hold`` is the deviation below
    which the actuator counts as being there already.

    Returns status, beta_p, tau_p, beta_1 and the number of passes.
    """
    lower, upper = stretch_limits(i_j)
    beta_1 = math.nan
    if not (lower < target < upper and lower < l < upper):
        return OUT_OF_RANGE, math.nan, math.nan, beta_1, 0
    beta_1 = elastic_force(target, i_j)
    rate = natural_frequency(target, c1, i_j)
    if abs(l - target) <= hold and abs(v) <= hold * rate:
        return HOLD, beta_1, 0.0, beta_1, 0
    up = 1.0 if target > l else -1.0
    if not crosses(k, l, v, target, zeta, c1, i_j, max(rtol, 1e-10)):
        return TOO_DAMPED, math.nan, math.nan, beta_1, 0
    status, beta_p, tau_p, _, passes = shoot(
        k, l, v, target, up, beta_min, beta_max, zeta, c1, i_j, rtol)
    if v == 0.0:
        return status, beta_p, tau_p, beta_1, passes
    usable = status == TWO_STEP and beta_min <= beta_p <= beta_max
    other, beta_q, tau_q, _, more = shoot(
        k, l, v, target, -up, beta_min, beta_max, zeta, c1, i_j, rtol)
    passes += more
    if other == TWO_STEP and beta_min <= beta_q <= beta_max and (
            not usable or tau_q < tau_p):
        return other, beta_q, tau_q, beta_1, passes
    if status != TWO_STEP and other == TWO_STEP:
        return other, beta_q, tau_q, beta_1, passes
    return status, beta_p, tau_p, beta_1, passes


@njit(cache=True, error_model='numpy', fastmath=_FAST, parallel=True)
def two_step_batch(
        start, rate, target, zeta, c1, j_lim, beta_min, beta_max, rtol, hold, status,
        beta_p, tau_p, beta_1):
    """Plan many moves over all cores; the last four arrays (n,) take the results."""
    for i in prange(start.size):
        k = np.empty((STAGES, 4))
        if not (zeta[i] >= 0.0 and c1[i] > 0.0 and j_lim[i] > 0.0
                and math.isfinite(zeta[i] + c1[i] + j_lim[i] + start[i] + rate[i] + target[i])):
            status[i], beta_p[i], tau_p[i], beta_1[i] = BAD_INPUT, math.nan, math.nan, math.nan
            continue
        status[i], beta_p[i], tau_p[i], beta_1[i], _ = two_step(
            k, start[i], rate[i], target[i], zeta[i], c1[i], 1.0 / j_lim[i], beta_min,
            beta_max, rtol, hold)


@_compiled
def trajectory(
        l, v, switches, betas, slopes, times, zeta, c1, i_j, rtol, stretch,  # noqa: E741
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
            status, l, v, _, _, h = advance(  # noqa: E741
                k, l, v, 0.0, 0.0,
                betas[piece] + slopes[piece] * (t - switches[piece]), slopes[piece],
                0.0, 0.0, end - t, zeta, c1, i_j, rtol, h)
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


@_compiled
def respond(
        l, v, durations, loads, slopes, d_durations, d_loads, zeta, c1, i_j, rtol,  # noqa: E741
        jacobian):
    """
    Follow a piecewise linear load and differentiate the end by two parameters.

    Piece m lasts ``durations[m]`` and applies ``loads[m] + slopes[m] t``; ``d_durations`` and
    ``d_loads`` (m, 2) are the derivatives by the parameters. ``jacobian`` (2, 2) takes the
    derivatives of stretch (row 0) and rate (row 1). Returns status and state.
    """
    k = np.empty((STAGES, 4))
    end_l, end_v = l, v
    for j in range(2):
        end_l, end_v = l, v
        s = 0.0
        r = 0.0
        for m in range(durations.size):
            status, end_l, end_v, s, r, _ = advance(
                k, end_l, end_v, s, r, loads[m], slopes[m], d_loads[m, j], 0.0, durations[m],
                zeta, c1, i_j, rtol, 0.0)
            if status != DONE:
                return status, end_l, end_v
            _, a, _, _ = _derivative(
                end_l, end_v, 0.0, 0.0, loads[m] + slopes[m] * durations[m], 0.0, zeta, c1,
                i_j)
            s += end_v * d_durations[m, j]
            r += a * d_durations[m, j]
        jacobian[0, j] = s
        jacobian[1, j] = r
    return DONE, end_l, end_v


# -- the plant ----------------------------------------------------------------------------------


@njit(cache=True, error_model='numpy', fastmath=_FAST, inline='always')
def _acceleration(l, v, beta, zeta, c1, i_j):  # noqa: E741
    """Right-hand side of Eq. 11 alone; NaN outside the admissible stretches."""
    l2 = l * l
    l3 = l2 * l
    lg = l - (l - 1.0) * (l - 1.0) * (l + 2.0) * i_j
    if not (l > 0.0 and lg > 0.0):
        return math.nan
    elastic = l2 * (l3 - 1.0) / lg
    return (6.0 * (beta * l3 - elastic) - 3.0 * zeta * c1 * l3 * v + 1.5 * v * v / l) / (
        1.0 + c1 * l3)


@_compiled
def _plain_step(k, l, v, beta, slope, excess, decay, h, zeta, c1, i_j, rtol):  # noqa: E741
    """
    One DOP853 step without sensitivities; ``k`` (12, 4) is working space, half of it used.

    The load is ``beta + slope t + excess exp(-decay t)`` from the start of the step. Returns
    the new state and the error in units of the tolerance.
    """
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
        k[i, 1] = _acceleration(l + h * d0, new_v, load, zeta, c1, i_j)
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
    return new_l, new_v, _error(h, new_l, new_v, e5_l, e5_v, e3_l, e3_v, rtol)


@_compiled
def _follow(k, l, v, h, beta, slope, excess, decay, duration, zeta, c1, i_j, rtol):  # noqa: E741
    """Integrate one actuator as `advance` does; returns status, state and step length."""
    if h <= 0.0:
        h = _first_step(l, v, beta + excess, zeta, c1, i_j, rtol)
    done = 0.0
    for _ in range(_MAX_STEPS):
        left = duration - done
        if not left > 0.0:
            return DONE, l, v, h
        step = min(h, left)
        rate = natural_frequency(l, c1, i_j)
        if _attainable(0.0, l, v, rate) > _RESOLVED and v * (l - 1.0) > 0.0:
            v = -v
        rest = excess
        if excess != 0.0:
            rest *= math.exp(-decay * done)
        new_l, new_v, error = _plain_step(
            k, l, v, beta + slope * done, slope, rest, decay, step, zeta, c1, i_j,
            _attainable(rtol, l, v, rate))
        if error <= 1.0:
            l, v = new_l, new_v  # noqa: E741
            done = duration if step == left else done + step
            if step == h or error > 0.5:
                h = _resize(step, error)
        else:
            h = _resize(step, error)
    return STUCK, l, v, h


@_compiled
def follow(k, first, last, wanted, state, drive, material, durations, rtol, status):
    """
    Integrate the actuators ``first`` to ``last`` of which ``wanted`` is true.

    Rows: ``state`` stretch, rate, step length (0 for none known); ``drive`` the load as
    ``_plain_step`` takes it, which is brought forward to the end; ``material`` zeta, c1, i_j.
    One that does not get through keeps its state. Returns how many these are; ``status`` tells
    which.
    """
    failed = 0
    for i in range(first, last):
        if not wanted[i]:
            continue
        beta, slope, excess, decay = drive[i, 0], drive[i, 1], drive[i, 2], drive[i, 3]
        duration = durations[i]
        status[i], l, v, h = _follow(  # noqa: E741
            k, state[i, 0], state[i, 1], state[i, 2], beta, slope, excess, decay, duration,
            material[i, 0], material[i, 1], material[i, 2], rtol)
        if status[i] != DONE:
            failed += 1
            continue
        state[i, 0] = l
        state[i, 1] = v
        state[i, 2] = h
        drive[i, 0] = beta + slope * duration
        if excess != 0.0:
            excess *= math.exp(-decay * duration)
            # Nothing that a sum of loads could still show.
            drive[i, 2] = excess if abs(excess) > 1e-17 * (1e-3 + abs(beta)) else 0.0
    return failed
