"""
Compiled two-step plans of many moves at once, for Gent blocks from rest: several in lock-step.

The method is that of `hmsa_ros.core.two_step_kernel.shoot`. A step of DOP853 is one loop over
moves without a branch, which the compiler turns into vector instructions; a lane whose move is
done takes the next one, so that none waits for another. What a lane does depends on its own
numbers alone: the plan of a row is the same, to the bit, in any batch. Whatever is out of the
ordinary is left to the kernel for one move.
"""

import math

from numba import prange, types
from numba.extending import intrinsic
import numpy as np

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.dop853 import ERROR_3, ERROR_5, MATRIX, STAGES, WEIGHTS
from hmsa_ros.core.kernels import turn_of
from hmsa_ros.core.law import (
    at_rest,
    C1,
    critical_zeta,
    elastic_force,
    KIND,
    LOWER,
    natural_frequency,
    UPPER,
    ZETA,
)
from hmsa_ros.core.laws.record import CONSTANTS, NEO_HOOKEAN
from hmsa_ros.core.two_step_kernel import (
    BAD_INPUT,
    first_guess,
    precision,
    TWO_STEP,
    two_step,
)

LANES = 8
#: Status of a row that is not planned yet.
LATER = -1

# Of each lane, a row of vectors: state with derivatives by the load, ...
_L, _V, _S, _R = 0, 1, 2, 3
# ... its load, direction, step, time, tolerance and material, ...
_BETA, _SIGN, _H, _T, _RTOL, _DAMPING, _C1, _I_J = 4, 5, 6, 7, 8, 9, 10, 11
# ... the end of its step, and its acceleration at the start, ...
_NEW_L, _NEW_V, _NEW_S, _NEW_R, _A = 12, 13, 14, 15, 16
# ... steps of this pass, whether it is inside its last one, and whether it needs a decision.
_STEPS, _INSIDE, _DECIDE = 17, 18, 19
_VECTORS = 20

# What only decisions use: the move, its search, and the search inside the last step.
_START, _TARGET, _LOWER, _UPPER, _MOVE, _BETA_1, _MOST, _LEAST, _FINE, _ENOUGH = range(10)
_LOW, _HIGH, _D, _TOLERANCE, _SCALE, _BEFORE, _AFTER, _SIZE = range(10, 18)
_NUMBERS = 18

# A pass of more steps and a search of more passes are left to the kernel for one move, and so is
# a difference of loads that is not clear of rounding.
_MAX_STEPS = 150.0
_MAX_INSIDE = 20.0
_MAX_PASSES = 12
_CLEAR = 4.0
_CLOSE = 1e-8 / 3e-16

# What a lane goes on with.
_GOES_ON, _DONE, _GIVEN_UP = 0, 1, 2

_M10, _M20, _M21 = MATRIX[1, 0], MATRIX[2, 0], MATRIX[2, 1]


@compiled(allocates=False)
def _motion(l, v, beta, damping, c1, i_j):  # noqa: E741
    """Return `hmsa_ros.core.law.motion` and 1/l for Gent with one division for four."""
    u = l - 1.0
    l2 = l * l
    l3 = l2 * l
    lg = l - u * u * (l + 2.0) * i_j
    inertia = 1.0 + c1 * l3
    product = l * lg
    inverse = 1.0 / (product * inertia)
    rest = inverse * inertia
    i_l = rest * lg
    i_lg = rest * l
    i_inertia = inverse * product
    # Six times the force and the stiffness, times l^3.
    force = u * (l2 + l + 1.0) * (6.0 * l2) * i_lg
    slope = ((30.0 * l3 - 12.0) * l - force * (1.0 + 3.0 * i_j - 3.0 * i_j * l2)) * i_lg
    w = v * i_l
    drive = 6.0 * (beta - damping * v)
    a = (l3 * drive - force + 1.5 * v * w) * i_inertia
    a_l = (3.0 * l2 * (drive - c1 * a) - slope - 1.5 * w * w) * i_inertia
    a_v = (3.0 * w - 6.0 * damping * l3) * i_inertia
    return a, a_l, a_v, 6.0 * l3 * i_inertia, lg, (slope - 3.0 * force * i_l) * i_inertia


@compiled(allocates=False)
def _stage(l, v, s, r, beta, damping, c1, i_j):  # noqa: E741
    """Return a stage's acceleration, its derivative by the load, and what must be above 0."""
    a, a_l, a_v, a_beta, lg, _ = _motion(l, v, beta, damping, c1, i_j)
    return a, a_l * s + a_v * r + a_beta, min(l, lg)


# The sums of the stages, without what is multiplied by 0.


@compiled(allocates=False)
def _to_3(y, h, k0, k2):
    return y + h * (MATRIX[3, 0] * k0 + MATRIX[3, 2] * k2)


@compiled(allocates=False)
def _to_4(y, h, k0, k2, k3):
    return y + h * (MATRIX[4, 0] * k0 + MATRIX[4, 2] * k2 + MATRIX[4, 3] * k3)


@compiled(allocates=False)
def _to_5(y, h, k0, k3, k4):
    return y + h * (MATRIX[5, 0] * k0 + MATRIX[5, 3] * k3 + MATRIX[5, 4] * k4)


@compiled(allocates=False)
def _to_6(y, h, k0, k3, k4, k5):
    return y + h * (
        MATRIX[6, 0] * k0 + MATRIX[6, 3] * k3 + MATRIX[6, 4] * k4 + MATRIX[6, 5] * k5)


@compiled(allocates=False)
def _to_later(i, y, h, k0, k3, k4, k5, k6, k7, k8, k9, k10):
    """Return the state at stage 7 or later; what it does not need yet is given as 0."""
    total = MATRIX[i, 0] * k0 + MATRIX[i, 3] * k3 + MATRIX[i, 4] * k4 + MATRIX[i, 5] * k5 \
        + MATRIX[i, 6] * k6
    if i > 7:
        total += MATRIX[i, 7] * k7
    if i > 8:
        total += MATRIX[i, 8] * k8
    if i > 9:
        total += MATRIX[i, 9] * k9
    if i > 10:
        total += MATRIX[i, 10] * k10
    return y + h * total


@compiled(allocates=False)
def _sum(weights, k0, k5, k6, k7, k8, k9, k10, k11):
    return weights[0] * k0 + weights[5] * k5 + weights[6] * k6 + weights[7] * k7 \
        + weights[8] * k8 + weights[9] * k9 + weights[10] * k10 + weights[11] * k11


@intrinsic
def _wide(_):
    """Let the vectors of the function that this is in be as wide as those of the processor."""
    def generate(context, builder, _signature, _arguments):
        # LLVM keeps to 256 bits where 512 once cost clock rate. Its own class of attributes knows
        # only those without a value.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.void(), generate


@compiled(allocates=False)
def _step(w):
    """
    Make one step of all lanes; ``w`` is the rows of vectors, one after the other.

    A lane whose step is as accurate as it must be moves on, one whose step is not tries a
    shorter one; one that has turned, or is near a limiting stretch, waits for a decision.
    """
    _wide()
    for i in range(LANES):
        l, v, s, r = w[_L * LANES + i], w[_V * LANES + i], w[_S * LANES + i], w[_R * LANES + i]  # noqa: E741
        h, beta, rtol = w[_H * LANES + i], w[_BETA * LANES + i], w[_RTOL * LANES + i]
        damping, c1, i_j = (
            w[_DAMPING * LANES + i], w[_C1 * LANES + i], w[_I_J * LANES + i])
        a0, a_l, a_v, a_beta, least, squared = _motion(l, v, beta, damping, c1, i_j)
        b0 = a_l * s + a_v * r + a_beta
        g = h * _M10
        v1 = v + g * a0
        r1 = r + g * b0
        a1, b1, inside = _stage(l + g * v, v1, s + g * r, r1, beta, damping, c1, i_j)
        least = min(least, inside)
        g = h * _M20
        f = h * _M21
        v2 = v + g * a0 + f * a1
        r2 = r + g * b0 + f * b1
        a2, b2, inside = _stage(
            l + g * v + f * v1, v2, s + g * r + f * r1, r2, beta, damping, c1, i_j)
        least = min(least, inside)
        v3 = _to_3(v, h, a0, a2)
        r3 = _to_3(r, h, b0, b2)
        a3, b3, inside = _stage(
            _to_3(l, h, v, v2), v3, _to_3(s, h, r, r2), r3, beta, damping, c1, i_j)
        least = min(least, inside)
        v4 = _to_4(v, h, a0, a2, a3)
        r4 = _to_4(r, h, b0, b2, b3)
        a4, b4, inside = _stage(
            _to_4(l, h, v, v2, v3), v4, _to_4(s, h, r, r2, r3), r4, beta, damping, c1, i_j)
        least = min(least, inside)
        v5 = _to_5(v, h, a0, a3, a4)
        r5 = _to_5(r, h, b0, b3, b4)
        a5, b5, inside = _stage(
            _to_5(l, h, v, v3, v4), v5, _to_5(s, h, r, r3, r4), r5, beta, damping, c1, i_j)
        least = min(least, inside)
        v6 = _to_6(v, h, a0, a3, a4, a5)
        r6 = _to_6(r, h, b0, b3, b4, b5)
        a6, b6, inside = _stage(
            _to_6(l, h, v, v3, v4, v5), v6, _to_6(s, h, r, r3, r4, r5), r6, beta, damping, c1,
            i_j)
        least = min(least, inside)
        v7 = _to_later(7, v, h, a0, a3, a4, a5, a6, 0.0, 0.0, 0.0, 0.0)
        r7 = _to_later(7, r, h, b0, b3, b4, b5, b6, 0.0, 0.0, 0.0, 0.0)
        l7 = _to_later(7, l, h, v, v3, v4, v5, v6, 0.0, 0.0, 0.0, 0.0)
        s7 = _to_later(7, s, h, r, r3, r4, r5, r6, 0.0, 0.0, 0.0, 0.0)
        a7, b7, inside = _stage(l7, v7, s7, r7, beta, damping, c1, i_j)
        least = min(least, inside)
        v8 = _to_later(8, v, h, a0, a3, a4, a5, a6, a7, 0.0, 0.0, 0.0)
        r8 = _to_later(8, r, h, b0, b3, b4, b5, b6, b7, 0.0, 0.0, 0.0)
        l8 = _to_later(8, l, h, v, v3, v4, v5, v6, v7, 0.0, 0.0, 0.0)
        s8 = _to_later(8, s, h, r, r3, r4, r5, r6, r7, 0.0, 0.0, 0.0)
        a8, b8, inside = _stage(l8, v8, s8, r8, beta, damping, c1, i_j)
        least = min(least, inside)
        v9 = _to_later(9, v, h, a0, a3, a4, a5, a6, a7, a8, 0.0, 0.0)
        r9 = _to_later(9, r, h, b0, b3, b4, b5, b6, b7, b8, 0.0, 0.0)
        l9 = _to_later(9, l, h, v, v3, v4, v5, v6, v7, v8, 0.0, 0.0)
        s9 = _to_later(9, s, h, r, r3, r4, r5, r6, r7, r8, 0.0, 0.0)
        a9, b9, inside = _stage(l9, v9, s9, r9, beta, damping, c1, i_j)
        least = min(least, inside)
        v10 = _to_later(10, v, h, a0, a3, a4, a5, a6, a7, a8, a9, 0.0)
        r10 = _to_later(10, r, h, b0, b3, b4, b5, b6, b7, b8, b9, 0.0)
        l10 = _to_later(10, l, h, v, v3, v4, v5, v6, v7, v8, v9, 0.0)
        s10 = _to_later(10, s, h, r, r3, r4, r5, r6, r7, r8, r9, 0.0)
        a10, b10, inside = _stage(l10, v10, s10, r10, beta, damping, c1, i_j)
        least = min(least, inside)
        v11 = _to_later(11, v, h, a0, a3, a4, a5, a6, a7, a8, a9, a10)
        r11 = _to_later(11, r, h, b0, b3, b4, b5, b6, b7, b8, b9, b10)
        l11 = _to_later(11, l, h, v, v3, v4, v5, v6, v7, v8, v9, v10)
        s11 = _to_later(11, s, h, r, r3, r4, r5, r6, r7, r8, r9, r10)
        a11, b11, inside = _stage(l11, v11, s11, r11, beta, damping, c1, i_j)
        least = min(least, inside)
        new_l = l + h * _sum(WEIGHTS, v, v5, v6, v7, v8, v9, v10, v11)
        new_v = v + h * _sum(WEIGHTS, a0, a5, a6, a7, a8, a9, a10, a11)
        new_s = s + h * _sum(WEIGHTS, r, r5, r6, r7, r8, r9, r10, r11)
        new_r = r + h * _sum(WEIGHTS, b0, b5, b6, b7, b8, b9, b10, b11)
        # As `hmsa_ros.core.kernels.error_of` and `resize`, with one division for both scales and
        # the power -1/8 by roots.
        size_l = 1.0 + abs(new_l)
        size_v = 1.0 + abs(new_v)
        scale = 1.0 / (rtol * size_l * size_v)
        e_l = _sum(ERROR_5, v, v5, v6, v7, v8, v9, v10, v11) * size_v * scale
        e_v = _sum(ERROR_5, a0, a5, a6, a7, a8, a9, a10, a11) * size_l * scale
        fifth = e_l * e_l + e_v * e_v
        e_l = _sum(ERROR_3, v, v5, v6, v7, v8, v9, v10, v11) * size_v * scale
        e_v = _sum(ERROR_3, a0, a5, a6, a7, a8, a9, a10, a11) * size_l * scale
        third = e_l * e_l + e_v * e_v
        error = h * fifth / math.sqrt(2.0 * (fifth + 0.01 * third) + 1e-300)
        error = error if least > 0.0 else math.nan
        factor = 0.9 / math.sqrt(math.sqrt(math.sqrt(error + 1e-12)))
        # NaN shortens the step.
        factor = factor if factor > 0.2 else 0.2
        factor = factor if factor < 6.0 else 6.0
        good = error <= 1.0
        sign = w[_SIGN * LANES + i]
        turned = good & (sign * v > 0.0) & (sign * new_v <= 0.0)
        steps = w[_STEPS * LANES + i] + 1.0
        # Rounding would be felt, as `hmsa_ros.core.kernels.attainable` says.
        room = min(rtol * (1.0 / 3e-16), _CLOSE) * (1.0 + abs(v))
        decide = turned | (w[_INSIDE * LANES + i] > 0.0) | (steps > _MAX_STEPS) | (
            l * l * squared > room * room)
        keep = decide | (not good)
        w[_DECIDE * LANES + i] = 1.0 if decide else 0.0
        w[_STEPS * LANES + i] = steps
        w[_NEW_L * LANES + i] = new_l
        w[_NEW_V * LANES + i] = new_v
        w[_NEW_S * LANES + i] = new_s
        w[_NEW_R * LANES + i] = new_r
        w[_A * LANES + i] = a0
        w[_L * LANES + i] = l if keep else new_l
        w[_V * LANES + i] = v if keep else new_v
        w[_S * LANES + i] = s if keep else new_s
        w[_R * LANES + i] = r if keep else new_r
        w[_T * LANES + i] += 0.0 if keep else h
        w[_H * LANES + i] = h if decide else h * factor


@compiled(allocates=False)
def _begin_pass(w, x, i):
    """Begin a pass of a lane with the load and tolerance of its search."""
    root = math.sqrt(math.sqrt(math.sqrt(x[i, _TOLERANCE])))
    w[_L * LANES + i] = x[i, _START]
    w[_V * LANES + i] = w[_S * LANES + i] = w[_R * LANES + i] = 0.0
    w[_T * LANES + i] = w[_STEPS * LANES + i] = w[_INSIDE * LANES + i] = 0.0
    w[_BETA * LANES + i] = x[i, _BETA_1] - w[_SIGN * LANES + i] * x[i, _D]
    w[_RTOL * LANES + i] = x[i, _TOLERANCE]
    w[_H * LANES + i] = x[i, _SCALE] * root


@compiled(allocates=False)
def _begin_move(w, x, i, l, v, target, material, rtol, hold):  # noqa: E741
    """Give a lane a move; False for one that is left to the kernel for one move."""
    lower, upper = material[LOWER], material[UPPER]
    if not (v == 0.0 and material[KIND] <= NEO_HOOKEAN and material[ZETA] >= 0.0
            and material[C1] > 0.0 and lower < l < upper and lower < target < upper
            and abs(l - target) > hold and math.isfinite(material[ZETA] + material[C1])):
        return False
    if not material[ZETA] < critical_zeta(target, material):
        return False
    beta_1 = elastic_force(target, material)
    direction = 1.0 if target > l else -1.0
    most = direction * (beta_1 - elastic_force(l, material))
    if not most > 0.0:
        return False
    x[i, _START], x[i, _TARGET], x[i, _LOWER], x[i, _UPPER] = l, target, lower, upper
    x[i, _MOVE] = abs(target - l)
    x[i, _BETA_1], x[i, _MOST], x[i, _LOW], x[i, _HIGH] = beta_1, most, 0.0, most
    x[i, _FINE], x[i, _ENOUGH], x[i, _TOLERANCE], x[i, _LEAST] = precision(
        target, x[i, _MOVE], beta_1, material, rtol)
    guess = first_guess(l, v, target, direction, beta_1, material)
    x[i, _D] = guess if 0.0 < guess < most else 0.5 * most
    x[i, _SCALE] = 4.0 / (natural_frequency(l, material) + 3.0 * material[ZETA] + 1e-9)
    w[_SIGN * LANES + i] = direction
    w[_DAMPING * LANES + i] = 0.5 * material[ZETA] * material[C1]
    w[_C1 * LANES + i], w[_I_J * LANES + i] = material[C1], material[CONSTANTS]
    _begin_pass(w, x, i)
    return True


@compiled(allocates=False)
def _decide(w, x, i):
    """
    Go on with a lane that has turned: find the turning point inside its last step.

    As `hmsa_ros.core.kernels.turning_point` and `_land`, but the jerk takes part, so that fewer
    steps are needed. Returns what the lane goes on with, stretch and its derivative by the load
    at the turning point, and the derivative of the time.
    """
    direction, h = w[_SIGN * LANES + i], w[_H * LANES + i]
    v = w[_V * LANES + i]
    new_v = w[_NEW_V * LANES + i]
    if w[_INSIDE * LANES + i] == 0.0:
        if not (w[_STEPS * LANES + i] <= _MAX_STEPS and direction * v > 0.0
                and direction * new_v <= 0.0):
            return _GIVEN_UP, 0.0, 0.0, 0.0
        dt = turn_of(h, v, new_v, w[_A * LANES + i], direction)
        x[i, _BEFORE], x[i, _AFTER] = 0.0, h
        x[i, _SIZE] = max(abs(v), abs(new_v))
        w[_INSIDE * LANES + i], w[_STEPS * LANES + i] = 1.0, 0.0
    else:
        l, s, r = w[_NEW_L * LANES + i], w[_NEW_S * LANES + i], w[_NEW_R * LANES + i]  # noqa: E741
        a, a_l, a_v, a_beta, _, _ = _motion(
            l, new_v, w[_BETA * LANES + i], w[_DAMPING * LANES + i], w[_C1 * LANES + i],
            w[_I_J * LANES + i])
        if not w[_STEPS * LANES + i] < _MAX_INSIDE:
            return _GIVEN_UP, 0.0, 0.0, 0.0
        # Without deceleration it is too early or too late: outside, so that it is bisected.
        left = -1.0 - h
        if direction * a < 0.0:
            jerk = a_l * new_v + a_v * a
            left = -new_v / a
            left -= 0.5 * jerk / a * left * left
            # The error of the time is of the third order.
            root = math.sqrt(math.sqrt(math.sqrt(x[i, _TOLERANCE])))
            if abs(new_v) <= root * root * root * x[i, _SIZE]:
                slope = a_l * s + a_v * r + a_beta
                w[_T * LANES + i] += h + left
                l += left * (new_v + left * (0.5 * a + jerk / 6.0 * left))  # noqa: E741
                s += left * (r + 0.5 * slope * left)
                r += slope * left
                return _DONE, l, s, -r / (a + jerk * left)
        if direction * new_v > 0.0:
            x[i, _BEFORE] = h
        else:
            x[i, _AFTER] = h
        dt = h + left
    if not x[i, _BEFORE] < dt < x[i, _AFTER]:
        dt = 0.5 * (x[i, _BEFORE] + x[i, _AFTER])
    w[_H * LANES + i] = dt
    return _GOES_ON, 0.0, 0.0, 0.0


@compiled(allocates=False)
def _end_pass(w, x, i, end, s):
    """Make the Newton step of `shoot` for a lane; returns what it goes on with, and the step."""
    direction, d = w[_SIGN * LANES + i], x[i, _D]
    target, lower, upper = x[i, _TARGET], x[i, _LOWER], x[i, _UPPER]
    miss = end - target
    excess = math.log1p(miss / (target - lower)) - math.log1p(-miss / (upper - target))
    change = direction * excess / (s * (1.0 / (end - lower) + 1.0 / (upper - end)))
    if direction * miss > 0.0:
        x[i, _LOW] = max(x[i, _LOW], d)
    else:
        x[i, _HIGH] = min(x[i, _HIGH], d)
    new = d + change
    if not x[i, _LOW] < new < x[i, _HIGH]:
        return _GIVEN_UP, change
    relative = abs(change) / min(d, 1.0 + abs(w[_BETA * LANES + i]))
    fine = x[i, _FINE]
    if (x[i, _TOLERANCE] <= fine and relative <= x[i, _ENOUGH]
            and abs(miss) <= 1e-6 * x[i, _MOVE]):
        return (_DONE if new > _CLEAR * x[i, _LEAST] else _GIVEN_UP), change
    x[i, _D] = new
    if relative < 0.1 and x[i, _TOLERANCE] > fine:
        x[i, _TOLERANCE] = max(fine, min(x[i, _TOLERANCE], 1e-2 * relative * relative))
        if x[i, _TOLERANCE] < 1e3 * fine:
            x[i, _TOLERANCE] = fine
            x[i, _LOW], x[i, _HIGH] = 0.0, x[i, _MOST]
    _begin_pass(w, x, i)
    return _GOES_ON, change


@compiled()
def _plan_rows(
        begin, end, start, rate, target, materials, rtol, hold, status, beta_p, tau_p, beta_1):
    """Plan the rows of a part in lock-step; those left have the status `LATER`."""
    w = np.zeros(_VECTORS * LANES)
    x = np.zeros((LANES, _NUMBERS))
    rows = np.full(LANES, -1)
    passes = np.zeros(LANES, np.int64)
    following = begin
    busy = LANES
    # Lanes without a move rest.
    w[_L * LANES:(_L + 1) * LANES] = 1.0
    w[_RTOL * LANES:(_RTOL + 1) * LANES] = 1.0
    w[_DECIDE * LANES:(_DECIDE + 1) * LANES] = 1.0
    while True:
        for i in range(LANES):
            if w[_DECIDE * LANES + i] == 0.0:
                continue
            found = _GIVEN_UP
            if rows[i] >= 0:
                found, stretch, s, dt_dbeta = _decide(w, x, i)
                if found == _DONE:
                    found, change = _end_pass(w, x, i, stretch, s)
                    passes[i] += 1
                    if passes[i] == _MAX_PASSES and found == _GOES_ON:
                        found = _GIVEN_UP
                if found == _DONE:
                    row = rows[i]
                    change *= w[_SIGN * LANES + i]
                    status[row], beta_1[row] = TWO_STEP, x[i, _BETA_1]
                    beta_p[row] = w[_BETA * LANES + i] - change
                    tau_p[row] = w[_T * LANES + i] - dt_dbeta * change
            if found == _GOES_ON:
                continue
            rows[i] = -1
            while following < end and rows[i] < 0:
                status[following] = LATER
                if _begin_move(
                        w, x, i, start[following], rate[following], target[following],
                        materials[min(following, materials.shape[0] - 1)], rtol, hold):
                    rows[i] = following
                    passes[i] = 0
                following += 1
            if rows[i] < 0:
                busy -= 1
                w[_H * LANES + i] = w[_V * LANES + i] = w[_INSIDE * LANES + i] = 0.0
                w[_L * LANES + i] = w[_RTOL * LANES + i] = 1.0
                w[_STEPS * LANES + i] = -math.inf
        if busy == 0:
            return
        _step(w)


@compiled(parallel=True)
def two_step_batch(
        start, rate, target, materials, beta_min, beta_max, rtol, hold, part, lockstep, status,
        beta_p, tau_p, beta_1):
    """
    Plan many moves over all cores, a part at a time; the last four arrays (n,) take the results.

    ``materials`` has a row for each, or one for all. Without ``lockstep`` one move is planned
    after the other.
    """
    for number in prange(-(-start.size // part)):
        begin = number * part
        end = min(begin + part, start.size)
        if lockstep:
            _plan_rows(begin, end, start, rate, target, materials, rtol, hold, status, beta_p,
                       tau_p, beta_1)
        k = np.empty((STAGES, 4))
        for i in range(begin, end):
            if lockstep and status[i] != LATER:
                continue
            material = materials[min(i, materials.shape[0] - 1)]
            if not (material[ZETA] >= 0.0 and material[C1] > 0.0
                    and material[LOWER] < at_rest(material) < material[UPPER] and math.isfinite(
                        material[ZETA] + material[C1] + start[i] + rate[i] + target[i])):
                status[i] = BAD_INPUT
                beta_p[i] = tau_p[i] = beta_1[i] = math.nan
                continue
            status[i], beta_p[i], tau_p[i], beta_1[i], _ = two_step(
                k, start[i], rate[i], target[i], material, beta_min, beta_max, rtol, hold)
