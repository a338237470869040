"""The simulated measurement of a recording, with its derivatives by the free parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmsa_ros import motion
from hmsa_ros.identification.quantities import derivative, geometry_of, group_of, QUANTITIES
from hmsa_ros.identification.recording import Course, pieces, Recording
from hmsa_ros.model.creep import Creep
from hmsa_ros.model.equations import Array
from hmsa_ros.model.law import elastic_force, elastic_stiffness, equilibrium_stretch, KIND
from hmsa_ros.model.laws.record import GENT
from hmsa_ros.model.parameters import NondimensionalParameters
from hmsa_ros.model.units import MU_0
from hmsa_ros.motion import theta as places

#: Relative tolerance of the integration: far below the noise of any sensor.
RTOL = 1e-8
_SENSOR = ('stretch_bias', 'stretch_gain', 'sensor_latency')


@dataclass(frozen=True, eq=False)
class Response:
    """What the sensor would have shown."""

    stretch: Array  # measured, shape (n,)
    rate: Array  # of the block in 1/s
    # Of the measured stretch by the coordinates of the free parameters, shape (n, p).
    jacobian: Array
    by_switch: Array  # by the uncertain times of switches, shape (n, u)


def _chain(
        values: Mapping[str, float], branches: int) -> tuple[Array, dict[str, dict[int, float]]]:
    """Return theta of the motion and, by name, its derivatives by the parameters."""
    geometry = geometry_of(values)
    inertia = values['density'] * geometry.half_length ** 2
    a = values['shear_modulus'] / inertia
    per_damping = 0.5 * geometry.c1 * geometry.half_length / geometry.damped / inertia
    d = per_damping * values['damping_coefficient']
    k = values['remanence'] / (MU_0 * inertia)
    per_force = 1.0 / (geometry.loaded * inertia)
    f = per_force * values['constant_force']
    theta = np.zeros(places.FIRST_BRANCH + 2 * branches)
    theta[:places.FIRST_BRANCH] = (
        a, d, k, f, values['coil_time_constant'], values['initial_stretch'],
        values['initial_rate'])
    density = values['density']
    by_density = {
        places.STIFFNESS: -a / density, places.DAMPING: -d / density,
        places.DRIVE: -k / density, places.FORCE: -f / density}
    by_modulus = {places.STIFFNESS: a / values['shear_modulus']}
    chain = {
        'density': by_density, 'shear_modulus': by_modulus,
        'remanence': {places.DRIVE: k / values['remanence']},
        'damping_coefficient': {places.DAMPING: per_damping},
        'constant_force': {places.FORCE: per_force},
        'chain_limit': {places.CONSTANT: -1.0 / values['chain_limit'] ** 2},
        'coil_time_constant': {places.LAG: 1.0},
        'initial_stretch': {places.STRETCH: 1.0}, 'initial_rate': {places.RATE: 1.0}}
    if branches == 1:
        theta[places.FIRST_BRANCH:] = values['viscoelastic_ratio'], values['viscoelastic_time']
        chain['viscoelastic_ratio'] = {places.FIRST_BRANCH: 1.0}
        chain['viscoelastic_time'] = {places.FIRST_BRANCH + 1: 1.0}
    # The density that goes with a time unit, L sqrt(rho/G).
    chain['time_unit'] = {i: x * 2.0 * density / values['time_unit']
                          for i, x in by_density.items()}
    return theta, chain


def complete(values: Mapping[str, float], free: Sequence[str]) -> dict[str, float]:
    """
    Return values in which the density and the time unit agree.

    Where the time unit is free the density follows from it, else the other way round.
    """
    done = dict(values)
    if 'time_unit' in free:
        done['density'] = (
            done['shear_modulus'] * (done['time_unit'] / done['half_length']) ** 2)
    else:
        done['time_unit'] = done['half_length'] * math.sqrt(
            done['density'] / done['shear_modulus'])
    return done


@lru_cache(maxsize=8)
def _packed(group: NondimensionalParameters) -> Array:
    """Return the packed law; finding its limits takes a while."""
    return group.packed


@dataclass(frozen=True, eq=False)
class Setup:
    """What the motion needs of values, and how its derivatives make those by free parameters."""

    theta: Array  # as `hmsa_ros.motion.theta` names its places
    material: Array  # the packed law
    branches: int  # of creep
    # Places in theta, or of constants of the law, by which to differentiate, shape (w,).
    wanted: NDArray[np.int64]
    # Derivatives of these by the coordinates of the free parameters; 0 for the sensor's.
    mixing: Array

    @classmethod
    def of(cls, values: Mapping[str, Any], free: Sequence[str]) -> 'Setup':
        """
        Work it out for values as `complete` returns them, with arrays of its own.

        Maxwell branches may be given under the name ``creep``.
        """
        given: Creep | None = values.get('creep')
        branches = len(given.ratios) if given else int(
            values['viscoelastic_ratio'] > 0.0 or 'viscoelastic_ratio' in free)
        theta, chain = _chain(values, branches)
        if given:
            theta[places.FIRST_BRANCH::2] = given.ratios
            theta[places.FIRST_BRANCH + 1::2] = given.times
        if 'time_unit' in free and 'shear_modulus' in free:
            extra = values['density'] / values['shear_modulus']
            modulus = dict(chain['shear_modulus'])
            for i, x in chain['density'].items():
                modulus[i] = modulus.get(i, 0.0) + x * extra
            chain['shear_modulus'] = modulus
        inner = [x for x in free if x not in _SENSOR]
        wanted = np.array(sorted({i for x in inner for i in chain[x]}), dtype=np.int64)
        material = _packed(group_of(values)).copy()
        if 'chain_limit' in free:
            material[KIND] = GENT
        mixing = np.zeros((len(wanted), len(free)))
        for j, name in enumerate(free):
            if name not in _SENSOR:
                for i, x in chain[name].items():
                    mixing[np.searchsorted(wanted, i), j] = derivative(name, values[name]) * x
        return cls(theta, material, branches, wanted, mixing)


def respond(
        recording: Recording | Course, values: Mapping[str, float], free: Sequence[str], *,
        rtol: float = RTOL, shifts: Array | None = None) -> Response | None:
    """
    Simulate what the sensor would have shown; None if the motion meets the limits of the chains.

    The motion begins at rest at its first level, or else with ``initial_stretch`` and
    ``initial_rate`` at the first sample. Shifts, shape (u,), say by how much in s the uncertain
    switches are later than recorded; by default half of what they may be earlier.
    """
    values = complete(values, free)
    setup = Setup.of(values, free)
    theta, material, wanted = setup.theta, setup.material, setup.wanted
    branches = setup.branches
    times = recording.time - values['sensor_latency']
    begin = float(recording.time[0])
    if recording.at_rest:
        begin = min(begin, float(recording.level_times[0]), float(times[0]))
    level_times, uncertain = recording.level_times, recording.uncertain
    if len(uncertain):
        level_times = level_times.copy()
        level_times[uncertain] += -0.5 * recording.earlier if shifts is None else shifts
    begins, levels, slopes = pieces(level_times, recording.levels, recording.slew_limit, begin)
    inner_count = len(wanted)
    if len(uncertain) and free:
        # Steps: a piece begins with each level.
        place = np.searchsorted(begins, level_times[uncertain])
        wanted = np.append(wanted, places.SWITCH + place)
    start = np.zeros(len(wanted))
    if not recording.at_rest:
        start[wanted == places.STRETCH] = 1.0
    elif not set_rest(theta, material, float(levels[0]), wanted, start):
        return None
    n = len(times)
    stretch, rate, raw = np.empty(n), np.empty(n), np.empty((n, len(wanted)))
    if not motion.respond(
            theta, material, branches, wanted, start, begins, levels, slopes, float(levels[0]),
            0.0, times, rtol, stretch, rate, raw, np.empty((0, len(wanted)))):
        return None
    raw *= values['stretch_gain']
    shown, jacobian = sensed(values, free, stretch, rate, raw[:, :inner_count] @ setup.mixing)
    return Response(shown, rate, jacobian, raw[:, inner_count:])


def sensed(
        values: Mapping[str, float], free: Sequence[str], stretch: Array, rate: Array, by: Array
) -> tuple[Array, Array]:
    """
    Return what the sensor shows of a motion, and its derivatives.

    Given are those by parameters of the motion; the columns of the sensor's own are filled in.
    """
    gain = values['stretch_gain']
    by_sensor: dict[str, float | Array] = {
        'stretch_bias': 1.0, 'stretch_gain': derivative('stretch_gain', gain) * stretch,
        'sensor_latency': -gain * rate}
    for j, name in enumerate(free):
        if name in by_sensor:
            by[:, j] = by_sensor[name]
    return gain * stretch + values['stretch_bias'], by


def set_rest(
        theta: Array, material: Array, level: float, wanted: NDArray[np.int64], start: Array
) -> bool:
    """
    Begin at the rest of a level in T; return whether there is one.

    Stretch and rate are set in ``theta``, and in ``start``, shape (w,), the derivatives of the
    stretch by what is wanted.
    """
    a, k, f = theta[[places.STIFFNESS, places.DRIVE, places.FORCE]]
    rest = equilibrium_stretch((k * level + f) / a, material)
    force, stiffness = elastic_force(rest, material), elastic_stiffness(rest, material)
    if not math.isfinite(stiffness):
        return False
    theta[places.STRETCH], theta[places.RATE] = rest, 0.0
    slopes = {places.STIFFNESS: -force, places.DRIVE: level, places.FORCE: 1.0}
    for j, i in enumerate(wanted.tolist()):
        slope = slopes.get(i, 0.0)
        if places.CONSTANT <= i < places.SWITCH:
            slope = -a * motion.constant_slope(rest, i - places.CONSTANT, material)
        start[j] = slope / (a * stiffness)
    return True


def clip(name: str, value: float) -> float:
    """Return a value within its range."""
    quantity = QUANTITIES[name]
    return min(max(value, quantity.least), quantity.most)
