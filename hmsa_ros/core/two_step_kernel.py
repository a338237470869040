"""
Compiled two-step solution: the load whose first turning point is the target, and when.

As in `hmsa_ros.core.kernels`, everything is nondimensional and nothing checks its arguments.
"""

import math

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.kernels import (
    DONE,
    first_step,
    MAX_STEPS,
    NO_TURN,
    resize,
    step,
    STUCK,
    turning_point,
)
from hmsa_ros.core.law import (
    critical_zeta,
    damping,
    elastic_energy,
    elastic_force,
    elastic_stiffness,
    LOWER,
    mass,
    natural_frequency,
    UPPER,
    ZETA,
)

# Status codes of a two-step plan; `hmsa_ros.core.two_step.CODES` names them for callers.
TWO_STEP = 0
HOLD = 1
TOO_DAMPED = 2
INDISTINGUISHABLE = 3
NO_TWO_STEP = 4
NOT_CONVERGED = 5
OUT_OF_RANGE = 6
BAD_INPUT = 7

# Sign of the deviation is decided by the linearised motion below this share of the move or of
# the room to a limit.
_LINEAR = 1e-6
_MAX_ITERATIONS = 80
_COARSE = 1e-7
_FARTHEST = 1e3
_NEWTON_PASSES = 8
# Swings that do not end within the steps allowed are given up after so many.
_MAX_STUCK = 4


@compiled()
def crosses(k, l, v, target, material, rtol):  # noqa: E741
    """
    Return whether the response to the target's own load passes the target.

    Below critical damping it always does. Above, it is followed until it has, or until the
    linearised motion says: with eigenvalues a < b < 0 and deviation x it creeps in from its
    own side unless (v - a x) x < 0.
    """
    if material[ZETA] < critical_zeta(target, material):
        return True
    beta = elastic_force(target, material)
    half = 0.5 * damping(target, material) / mass(target, material)
    fast = -half - math.sqrt(
        max(half * half - natural_frequency(target, material) ** 2, 0.0))
    lower, upper = material[LOWER], material[UPPER]
    small = _LINEAR * max(abs(l - target), abs(v / fast), min(target - lower, upper - target))
    side = l - target
    h = 0.0
    for _ in range(MAX_STEPS):
        x = l - target
        if x * side < 0.0 or x == 0.0:
            return True
        if abs(x) < small and abs(v) < small * abs(fast):
            return (v - fast * x) * x < 0.0
        if h <= 0.0:
            h = first_step(l, v, beta, material, rtol)
        new_l, new_v, _, _, error = step(k, l, v, 0.0, 0.0, beta, h, material, rtol)
        if error <= 1.0:
            l, v = new_l, new_v  # noqa: E741
        h = resize(h, error)
    return False


@compiled()
def first_guess(l, v, target, direction, beta_1, material):  # noqa: E741
    """
    Return a first guess of ``direction * (beta_1 - beta_p)``.

    The energy balance gives it exactly without damping. The linear oscillator says how it
    shrinks with damping, by 2 K/(1 + K) with the decay K over half a period; its damping ratio
    is the damping force, at the rate that the balance gives half way, against that of the
    spring.
    """
    if target == l:
        return math.inf
    start = elastic_energy(l, material) + 0.5 * mass(l, material) * v * v
    beta = (elastic_energy(target, material) - start) / (target - l)
    delta = direction * (beta_1 - beta)
    half = 0.5 * (l + target)
    kinetic = start + beta * (half - l) - elastic_energy(half, material)
    fastest = math.sqrt(max(2.0 * kinetic / mass(half, material), 0.0))
    xi = 0.5 * damping(half, material) * fastest / abs(delta)
    decay = 1e-3
    if xi < 0.9:
        decay = math.exp(-math.pi * xi / math.sqrt(1.0 - xi * xi))
    return delta * 2.0 * decay / (1.0 + decay)


@compiled()
def precision(target, move, beta_1, material, rtol):  # noqa: E741
    """
    Return how precise a search must be, for a move that is so long.

    That is the tolerance of the last pass, the relative change of the load that ends it, the
    tolerance of the first pass, and the least difference of loads that is not rounding.
    """
    lower, upper = material[LOWER], material[UPPER]
    # Errors count against the move and the room that the limits leave.
    size = 1.0 + target
    rtol = max(min(rtol, 1e-10 * move / size), 1e-14)
    enough = max(0.1 * math.sqrt(rtol), 1e-14 * size / move)
    coarse = max(rtol, _COARSE * min(size, move, target - lower, upper - target) / size)
    # A smaller difference of loads is rounding of the elastic force.
    least = 1e-14 * (abs(beta_1) + abs(target) * elastic_stiffness(target, material))
    return rtol, enough, coarse, least


@compiled()
def shoot(
        k, l, v, target, direction, beta_min, beta_max, material, rtol):  # noqa: E741
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
    beta_1 = elastic_force(target, material)
    move = abs(target - l) + abs(v) / natural_frequency(target, material)
    lower, upper = material[LOWER], material[UPPER]
    rtol, enough, tolerance, least = precision(target, move, beta_1, material, rtol)
    most = math.inf
    if v == 0.0:
        most = direction * (beta_1 - elastic_force(l, material))
        if not most > 0.0:
            return NO_TWO_STEP, math.nan, math.nan, beta_1, 0
    top = direction * (beta_1 - (beta_min if direction > 0.0 else beta_max))
    if not top < math.inf:
        top = _FARTHEST * (1.0 + abs(beta_1))
    # From rest beta_p lies between the two holding loads: it is found there, inside or not.
    top = max(top, most) if most < math.inf else top
    guess = first_guess(l, v, target, direction, beta_1, material)
    if not 0.0 < guess < min(most, top):
        guess = 0.5 * most if most < math.inf else 1.0
    low, high, d = 0.0, most, guess
    stuck = 0
    for iteration in range(1, _MAX_ITERATIONS + 1):
        beta = beta_1 - direction * d
        status, t, end, s, dt_dbeta = turning_point(
            k, l, v, direction, beta, move, material, tolerance)
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


@compiled()
def two_step(k, l, v, target, material, beta_min, beta_max, rtol, hold):  # noqa: E741
    """
    Plan one move: the fastest single intermediate load that ends at rest at the target.

    There are at most two: one whose turning point is reached on the way up and one on the way
    down (Eqs. 13 and 14 from rest know the direct one only). ``hold`` is the deviation below
    which the actuator counts as being there already.

    Returns status, beta_p, tau_p, beta_1 and the number of passes.
    """
    lower, upper = material[LOWER], material[UPPER]
    beta_1 = math.nan
    if not (lower < target < upper and lower < l < upper):
        return OUT_OF_RANGE, math.nan, math.nan, beta_1, 0
    beta_1 = elastic_force(target, material)
    rate = natural_frequency(target, material)
    if abs(l - target) <= hold and abs(v) <= hold * rate:
        return HOLD, beta_1, 0.0, beta_1, 0
    up = 1.0 if target > l else -1.0
    if not crosses(k, l, v, target, material, max(rtol, 1e-10)):
        return TOO_DAMPED, math.nan, math.nan, beta_1, 0
    status, beta_p, tau_p, _, passes = shoot(
        k, l, v, target, up, beta_min, beta_max, material, rtol)
    if v == 0.0:
        return status, beta_p, tau_p, beta_1, passes
    usable = status == TWO_STEP and beta_min <= beta_p <= beta_max
    other, beta_q, tau_q, _, more = shoot(
        k, l, v, target, -up, beta_min, beta_max, material, rtol)
    passes += more
    if other == TWO_STEP and beta_min <= beta_q <= beta_max and (
            not usable or tau_q < tau_p):
        return other, beta_q, tau_q, beta_1, passes
    if status != TWO_STEP and other == TWO_STEP:
        return other, beta_q, tau_q, beta_1, passes
    return status, beta_p, tau_p, beta_1, passes
