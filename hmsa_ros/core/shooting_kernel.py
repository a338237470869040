"""
Compiled Newton for commands of levels with two free numbers, for `hmsa_ros.core.shooting`.

As in `hmsa_ros.core.kernels`, everything is nondimensional and nothing checks its arguments.
"""

import math

import numpy as np

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.kernels import DONE, respond, STUCK
from hmsa_ros.core.law import natural_frequency

SOLVED = 0
UNSOLVED = 1

# Tolerances far from the solution and at it, and the distance from rest, as a share of the
# move, below which the second one counts.
_COARSE = 1e-9
_FINE = 1e-13
_NEAR = 1e-5
# A ramp that misses the next level by less has just reached it.
_ROUNDING = 1e-12
_ITERATIONS = 25
# A Newton step that must be cut shorter than this leads nowhere.
_LEAST_SHARE = 0.01
# Trials leave the first guess by this factor at the most.
_FARTHEST = 10.0
# Distance from rest at the target, as a share of the move: wanted, and accepted where rounding
# ends the search.
_WANTED = 1e-14
_ACCEPTED = 1e-10


@compiled()
def _pieces(times, loads, d_times, d_loads, load, slew, durations, begins, slopes, d_durations,
            d_begins):
    """Fill in the pieces of the load and their derivatives; -1 if a ramp does not fit."""
    count = 0
    d_load_0 = d_load_1 = 0.0
    levels = times.size
    for i in range(levels):
        last = i == levels - 1
        span = d_span_0 = d_span_1 = 0.0
        if not last:
            span = times[i + 1] - times[i]
            d_span_0 = d_times[i + 1, 0] - d_times[i, 0]
            d_span_1 = d_times[i + 1, 1] - d_times[i, 1]
        if slew < math.inf:
            sign = math.copysign(1.0, loads[i] - load)
            durations[count] = abs(loads[i] - load) / slew
            begins[count] = load
            slopes[count] = sign * slew
            d_durations[count, 0] = sign * (d_loads[i, 0] - d_load_0) / slew
            d_durations[count, 1] = sign * (d_loads[i, 1] - d_load_1) / slew
            d_begins[count, 0] = d_load_0
            d_begins[count, 1] = d_load_1
            span -= durations[count]
            d_span_0 -= d_durations[count, 0]
            d_span_1 -= d_durations[count, 1]
            count += 1
        if not last:
            if span < -_ROUNDING:
                return -1
            durations[count] = max(span, 0.0)
            begins[count] = loads[i]
            slopes[count] = 0.0
            d_durations[count, 0] = d_span_0
            d_durations[count, 1] = d_span_1
            d_begins[count] = d_loads[i]
            count += 1
        load = loads[i]
        d_load_0 = d_loads[i, 0]
        d_load_1 = d_loads[i, 1]
    return count


@compiled()
def solve(times, loads, d_times, d_loads, l, v, load, target, slew, material):  # noqa: E741
    """
    Move levels along two unknowns until they end at rest at the target, in place.

    ``d_times`` and ``d_loads`` (n, 2) are the derivatives of ``times`` and ``loads`` (n,).
    Returns the status and the duration, the last ramp included.
    """
    room = 2 * times.size
    durations, begins, slopes = np.empty(room), np.empty(room), np.empty(room)
    d_durations, d_begins = np.empty((room, 2)), np.empty((room, 2))
    jacobian = np.empty((2, 2))
    first_times, first_loads = times.copy(), loads.copy()
    rate = natural_frequency(target, material)
    move = abs(target - l) + abs(v) / rate
    farthest = _FARTHEST * (np.max(np.abs(loads)) + abs(load) + 1.0)
    longest = _FARTHEST * times[-1]
    x = y = 0.0  # where the unknowns are
    d_x = d_y = 0.0  # the step to try
    share = 1.0
    size = math.inf
    rtol = max(_FINE, min(_COARSE, 1e-6 * move))
    duration = math.nan
    passes = 0
    while passes < _ITERATIONS:
        new_x, new_y = x + share * d_x, y + share * d_y
        for i in range(times.size):
            times[i] = first_times[i] + d_times[i, 0] * new_x + d_times[i, 1] * new_y
            loads[i] = first_loads[i] + d_loads[i, 0] * new_x + d_loads[i, 1] * new_y
        status, new_size, miss, speed, count = STUCK, math.inf, 0.0, 0.0, 0
        # A wild trial is not worth its integration.
        if np.max(np.abs(loads)) < farthest and times[-1] < longest:
            count = _pieces(
                times, loads, d_times, d_loads, load, slew, durations, begins, slopes,
                d_durations, d_begins)
            if count > 0:
                status, end, speed = respond(
                    l, v, durations[:count], begins[:count], slopes[:count],
                    d_durations[:count], d_begins[:count], material, rtol, jacobian)
                miss, speed = end - target, speed / rate
                new_size = math.hypot(miss, speed)
        better = status == DONE and new_size < (1.0 - 0.1 * share) * size
        if not better and size < math.inf:
            share *= 0.5
            if share > _LEAST_SHARE and not size <= _ACCEPTED * move:
                continue
            # No way down: rounding, if the end is as near as rounding allows.
            for i in range(times.size):
                times[i] = first_times[i] + d_times[i, 0] * x + d_times[i, 1] * y
                loads[i] = first_loads[i] + d_loads[i, 0] * x + d_loads[i, 1] * y
            return SOLVED if rtol == _FINE and size <= _ACCEPTED * move else UNSOLVED, duration
        if not better:
            return UNSOLVED, duration
        x, y, size = new_x, new_y, new_size
        duration = np.sum(durations[:count])
        if rtol == _FINE and size <= _WANTED * move:
            return SOLVED, duration
        a, b = jacobian[0, 0], jacobian[0, 1]
        c, d = jacobian[1, 0] / rate, jacobian[1, 1] / rate
        determinant = a * d - b * c
        d_x = -(d * miss - b * speed) / determinant
        d_y = -(a * speed - c * miss) / determinant
        if not math.isfinite(d_x + d_y):
            return UNSOLVED, duration
        share = 1.0
        passes += 1
        if rtol > _FINE and size <= _NEAR * move:
            # What the coarse pass has found is measured anew.
            rtol, size = _FINE, math.inf
    return UNSOLVED, duration
