"""
Compiled Newton for commands of levels with free numbers, for `hmsa_ros.core.shooting`.

As in `hmsa_ros.core.kernels`, everything is nondimensional and nothing checks its arguments.
"""

import math

import numpy as np

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.kernels import DONE
from hmsa_ros.core.law import elastic_force, elastic_stiffness, natural_frequency
from hmsa_ros.core.response_kernel import (
    FIELD,
    FOLLOWED,
    RATE,
    RATIO,
    respond,
    SPEED,
    STRETCH,
)

SOLVED = 0
UNSOLVED = 1

# Tolerances of the first pass, far from the solution and at it, the largest and as shares of the
# move; and the distance from rest, as a share, from which on it is measured with the last one.
_FIRST = 1e-6
_COARSE, _COARSE_SHARE = 1e-8, 1e-7
_FINE, _FINE_SHARE, _FINEST = 1e-12, 1e-11, 1e-13
_NEAR = 2e-4
# A ramp that misses the next level by less has just reached it.
_ROUNDING = 1e-12
_ITERATIONS = 25
# A Newton step that must be cut shorter than this leads nowhere.
_LEAST_SHARE = 0.01
# Trials leave the first guess by this factor at the most.
_FARTHEST = 10.0
# As shares of the move: what the last step may leave, and what is accepted where rounding ends the
# search. And the share of the distance that a fine pass has to leave less than.
_LAST, _ACCEPTED, _SLOWEST = 1e-12, 1e-10, 0.1


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
def _newton(jacobian, misses, work, step):
    """Write the Newton step, by elimination in ``work`` (n, n + 1)."""
    count = step.size
    for i in range(count):
        for j in range(count):
            work[i, j] = jacobian[i, j]
        work[i, count] = -misses[i]
    for i in range(count):
        best = i
        for j in range(i + 1, count):
            if abs(work[j, i]) > abs(work[best, i]):
                best = j
        for m in range(count + 1):
            work[i, m], work[best, m] = work[best, m], work[i, m]
        for j in range(i + 1, count):
            factor = work[j, i] / work[i, i]
            for m in range(i, count + 1):
                work[j, m] -= factor * work[i, m]
    for i in range(count - 1, -1, -1):
        value = work[i, count]
        for j in range(i + 1, count):
            value -= work[i, j] * step[j]
        step[i] = value / work[i, i]


@compiled()
def _place(values, first, slopes, unknowns, share, step):
    """Write what is linear in the unknowns, a share of a step on from where they are."""
    for i in range(values.size):
        values[i] = first[i]
        for c in range(step.size):
            values[i] += slopes[i, c] * (unknowns[c] + share * step[c])


@compiled()
def _missed(
        end, d_end, load, d_load, target, slew, lag, material, branches, parameters, misses,
        jacobian):
    """
    Write how far the end of a command is from rest at the target, and the derivatives.

    In units of stretch: the stretch, the rate, where the field lags the field, and where branches
    creep and the amplifier ramps its last ``load``, from which the next levels go on.
    """
    rate = natural_frequency(target, material)
    stiffness = elastic_stiffness(target, material)
    force = elastic_force(target, material)
    misses[0], misses[1] = end[STRETCH] - target, end[RATE] / rate
    for c in range(parameters):
        jacobian[0, c], jacobian[1, c] = d_end[STRETCH, c], d_end[RATE, c] / rate
    row = 2
    if lag > 0.0:
        misses[row] = (end[FIELD] - force) / stiffness
        for c in range(parameters):
            jacobian[row, c] = d_end[FIELD, c] / stiffness
        row += 1
    creeping = end.size - FOLLOWED
    if creeping > 0 and slew < math.inf:
        misses[row] = (load - force) / stiffness
        for c in range(parameters):
            jacobian[row, c] = d_load[c] / stiffness
        row += 1
    for b in range(creeping):
        # What a branch holds the field has to balance, and the amplifier to lead.
        for i in range(2, row):
            share = branches[b, RATIO] / stiffness
            if i + 1 == row and slew < math.inf:
                share *= 1.0 - lag * branches[b, SPEED]
            misses[i] -= share * (force - end[FOLLOWED + b])
            for c in range(parameters):
                jacobian[i, c] += share * d_end[FOLLOWED + b, c]


@compiled()
def solve(
        times, loads, d_times, d_loads, l, v, field, load, target, slew, lag,  # noqa: E741
        material, branches, followed):
    """
    Move levels along unknowns until they end at rest at the target, in place.

    ``d_times`` and ``d_loads`` (n, p) are the derivatives of ``times`` and ``loads`` (n,) by the
    unknowns, as many as `_missed` says. ``field`` is in force at the start, ``load`` is the
    amplifier's, and branches (n, 2) have ``followed`` (n,). Coarse passes bring the derivatives
    and a guess for those that measure the end finely, without derivatives. Returns the status and
    the duration, the last ramp included.
    """
    room = 2 * times.size
    unknowns = d_times.shape[1]
    durations, begins, slopes = np.empty(room), np.empty(room), np.empty(room)
    d_durations, d_begins = np.empty((room, unknowns)), np.empty((room, unknowns))
    end, d_end = np.empty(FOLLOWED + followed.size), np.empty((FOLLOWED + followed.size, unknowns))
    jacobian, trial = np.empty((unknowns, unknowns)), np.empty((unknowns, unknowns))
    work = np.empty((unknowns, unknowns + 1))
    first_times, first_loads = times.copy(), loads.copy()
    move = abs(target - l) + abs(v) / natural_frequency(target, material)
    if lag > 0.0:
        move += abs(field - loads[-1]) / elastic_stiffness(target, material)
    farthest = _FARTHEST * (np.max(np.abs(loads)) + abs(load) + 1.0)
    longest = _FARTHEST * times[-1]
    x = np.zeros(unknowns)  # where the unknowns are
    step = np.zeros(unknowns)  # to try
    misses = np.zeros(unknowns)
    share, size, before = 1.0, math.inf, math.inf
    fine = max(_FINEST, min(_FINE, _FINE_SHARE * move))
    rtol = max(fine, min(_COARSE, _COARSE_SHARE * move))
    tolerance = max(rtol, min(_FIRST, _COARSE_SHARE * move))
    measuring = False
    duration = math.nan
    passes = 0
    while passes < _ITERATIONS:
        _place(times, first_times, d_times, x, share, step)
        _place(loads, first_loads, d_loads, x, share, step)
        new_size, count = math.inf, 0
        # A wild trial is not worth its integration.
        if np.max(np.abs(loads)) < farthest and times[-1] < longest:
            count = _pieces(
                times, loads, d_times, d_loads, load, slew, durations, begins, slopes,
                d_durations, d_begins)
        if count > 0:
            parameters = 0 if measuring else unknowns
            status = respond(
                l, v, field, followed, durations[:count], begins[:count], slopes[:count],
                d_durations[:count], d_begins[:count], parameters, lag, material, branches,
                tolerance, end, d_end)
            if status == DONE:
                _missed(
                    end, d_end, loads[-1], d_loads[-1], target, slew, lag, material, branches,
                    parameters, misses, trial)
                new_size = math.sqrt(np.sum(misses * misses))
        passes += 1
        if measuring:
            duration = np.sum(durations[:count])
            slow = not new_size < _SLOWEST * before
            if slow and new_size <= _ACCEPTED * move:
                # As near as rounding allows.
                return SOLVED, duration
            if slow and (rtol == fine or not new_size < math.inf):
                return UNSOLVED, duration
            if slow:
                # The derivatives were too coarse.
                measuring, rtol, tolerance, size = False, fine, fine, math.inf
                continue
            _newton(jacobian, misses, work, step)
            x += step
            before, share = new_size, 0.0
            # Derivatives of so far away leave about that share.
            if new_size * size <= _LAST * move * move:
                _place(times, first_times, d_times, x, share, step)
                _place(loads, first_loads, d_loads, x, share, step)
                count = _pieces(
                    times, loads, d_times, d_loads, load, slew, durations, begins, slopes,
                    d_durations, d_begins)
                return SOLVED if count > 0 else UNSOLVED, np.sum(durations[:count])
            continue
        if not new_size < (1.0 - 0.1 * share) * size:
            share *= 0.5
            if size == math.inf or not share > _LEAST_SHARE:
                return UNSOLVED, duration
            passes -= 1
            continue
        x += share * step
        size, tolerance = new_size, rtol
        jacobian[:] = trial
        _newton(jacobian, misses, work, step)
        if not math.isfinite(np.sum(step)):
            return UNSOLVED, duration
        share = 1.0
        if size <= _NEAR * move:
            measuring, tolerance, before = True, fine, math.inf
            x += step
            share = 0.0
    return UNSOLVED, duration
