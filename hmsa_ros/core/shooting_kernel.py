"""
Compiled Newton for commands of levels with free numbers, for `hmsa_ros.core.shooting`.

As in `hmsa_ros.core.kernels`, everything is nondimensional and nothing checks its arguments.
"""

import math

import numpy as np

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.creep_plan_kernel import respond_creeping
from hmsa_ros.core.kernels import DONE, respond, STUCK
from hmsa_ros.core.lag_kernel import respond_late
from hmsa_ros.core.law import elastic_stiffness, natural_frequency

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
    levels, unknowns = d_times.shape
    d_load = np.zeros(unknowns)
    d_span = np.zeros(unknowns)
    for i in range(levels):
        last = i == levels - 1
        span = 0.0
        d_span[:] = 0.0
        if not last:
            span = times[i + 1] - times[i]
            for c in range(unknowns):
                d_span[c] = d_times[i + 1, c] - d_times[i, c]
        if slew < math.inf:
            sign = math.copysign(1.0, loads[i] - load)
            durations[count] = abs(loads[i] - load) / slew
            begins[count] = load
            slopes[count] = sign * slew
            span -= durations[count]
            for c in range(unknowns):
                d_durations[count, c] = sign * (d_loads[i, c] - d_load[c]) / slew
                d_begins[count, c] = d_load[c]
                d_span[c] -= d_durations[count, c]
            count += 1
        if not last:
            if span < -_ROUNDING:
                return -1
            durations[count] = max(span, 0.0)
            begins[count] = loads[i]
            slopes[count] = 0.0
            for c in range(unknowns):
                d_durations[count, c] = d_span[c]
                d_begins[count, c] = d_loads[i, c]
            count += 1
        load = loads[i]
        for c in range(unknowns):
            d_load[c] = d_loads[i, c]
    return count


@compiled()
def _newton(jacobian, misses, step):
    """Write the Newton step for two or three unknowns, by Cramer's rule."""
    if step.size == 2:
        a, b = jacobian[0, 0], jacobian[0, 1]
        c, d = jacobian[1, 0], jacobian[1, 1]
        determinant = a * d - b * c
        step[0] = -(d * misses[0] - b * misses[1]) / determinant
        step[1] = -(a * misses[1] - c * misses[0]) / determinant
        return
    determinant = 0.0
    for i in range(3):
        j, m = (i + 1) % 3, (i + 2) % 3
        determinant += jacobian[0, i] * (
            jacobian[1, j] * jacobian[2, m] - jacobian[1, m] * jacobian[2, j])
    for i in range(3):
        j, m = (i + 1) % 3, (i + 2) % 3
        value = 0.0
        for row in range(3):
            up, down = (row + 1) % 3, (row + 2) % 3
            value += misses[row] * (
                jacobian[up, j] * jacobian[down, m] - jacobian[up, m] * jacobian[down, j])
        step[i] = -value / determinant


@compiled()
def _place(values, first, slopes, unknowns, share, step):
    """Write what is linear in the unknowns, a share of a step on from where they are."""
    for i in range(values.size):
        values[i] = first[i]
        for c in range(step.size):
            values[i] += slopes[i, c] * (unknowns[c] + share * step[c])


@compiled()
def solve(
        times, loads, d_times, d_loads, l, v, field, load, target, slew, lag,  # noqa: E741
        material, branches, followed):
    """
    Move levels along unknowns until they end at rest at the target, in place.

    ``d_times`` and ``d_loads`` (n, 2) are the derivatives of ``times`` and ``loads`` (n,) by two
    unknowns. With a lag of the field there are three: the ``field`` has to arrive at the last
    load as well, and what ramps begin at the amplifier's ``load``. Branches (n, 2) have
    ``followed`` (n,) at the start; with any, nothing ramps or lags. Returns the status and the
    duration, the last ramp included.
    """
    room = 2 * times.size
    unknowns = d_times.shape[1]
    durations, begins, slopes = np.empty(room), np.empty(room), np.empty(room)
    d_durations, d_begins = np.empty((room, unknowns)), np.empty((room, unknowns))
    jacobian = np.empty((unknowns, unknowns))
    first_times, first_loads = times.copy(), loads.copy()
    rate = natural_frequency(target, material)
    stiffness = elastic_stiffness(target, material)
    move = abs(target - l) + abs(v) / rate
    if lag > 0.0:
        move += abs(field - loads[-1]) / stiffness
    farthest = _FARTHEST * (np.max(np.abs(loads)) + abs(load) + 1.0)
    longest = _FARTHEST * times[-1]
    x = np.zeros(unknowns)  # where the unknowns are
    step = np.zeros(unknowns)  # to try
    misses = np.zeros(unknowns)
    share = 1.0
    size = math.inf
    rtol = max(_FINE, min(_COARSE, 1e-6 * move))
    duration = math.nan
    passes = 0
    while passes < _ITERATIONS:
        _place(times, first_times, d_times, x, share, step)
        _place(loads, first_loads, d_loads, x, share, step)
        status, new_size, count = STUCK, math.inf, 0
        # A wild trial is not worth its integration.
        if np.max(np.abs(loads)) < farthest and times[-1] < longest:
            count = _pieces(
                times, loads, d_times, d_loads, load, slew, durations, begins, slopes,
                d_durations, d_begins)
            if count > 0 and lag > 0.0:
                status, end, speed, late = respond_late(
                    l, v, field, durations[:count], begins[:count], slopes[:count],
                    d_durations[:count], d_begins[:count], lag, material, rtol, jacobian)
                misses[2] = (late - loads[-1]) / stiffness
            elif count > 0 and followed.size > 0:
                status, end, speed = respond_creeping(
                    l, v, followed, durations[:count], begins[:count], d_durations[:count],
                    d_begins[:count], material, branches, rtol, jacobian)
            elif count > 0:
                status, end, speed = respond(
                    l, v, durations[:count], begins[:count], slopes[:count],
                    d_durations[:count], d_begins[:count], material, rtol, jacobian)
            if count > 0:
                misses[0], misses[1] = end - target, speed / rate
                new_size = math.hypot(misses[0], misses[1])
                if lag > 0.0:
                    new_size = math.hypot(new_size, misses[2])
        better = status == DONE and new_size < (1.0 - 0.1 * share) * size
        if not better and size < math.inf:
            share *= 0.5
            if share > _LEAST_SHARE and not size <= _ACCEPTED * move:
                continue
            # No way down: rounding, if the end is as near as rounding allows.
            _place(times, first_times, d_times, x, 0.0, step)
            _place(loads, first_loads, d_loads, x, 0.0, step)
            return SOLVED if rtol == _FINE and size <= _ACCEPTED * move else UNSOLVED, duration
        if not better:
            return UNSOLVED, duration
        x += share * step
        size = new_size
        duration = np.sum(durations[:count])
        if rtol == _FINE and size <= _WANTED * move:
            return SOLVED, duration
        for c in range(unknowns):
            jacobian[1, c] /= rate
            if lag > 0.0:
                # The last load holds the target: it is not an unknown.
                jacobian[2, c] /= stiffness
        _newton(jacobian, misses, step)
        if not math.isfinite(np.sum(step)):
            return UNSOLVED, duration
        share = 1.0
        passes += 1
        if rtol > _FINE and size <= _NEAR * move:
            # What the coarse pass has found is measured anew.
            rtol, size = _FINE, math.inf
    return UNSOLVED, duration
