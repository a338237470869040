"""Simulated measurement of a recording, with derivatives by the free parameters."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmsa.errors import BadInputError
from hmsa.identification import quantities
from hmsa.identification.measurement import Measurement, pieces, UncheckedMeasurement
from hmsa.model.creep import Creep
from hmsa.model.equations import Array
from hmsa.model.law import KIND, pack
from hmsa.model.laws.record import Elastic, GENT
from hmsa.model.parameters import Geometry
from hmsa.model.thermal import Thermal
from hmsa.model.units import MU_0
from hmsa.motion import derivatives, SPEED

#: Relative tolerance of the integration: far below the noise of any sensor.
RTOL = 1e-8
_NOTHING: Array = np.empty(0)
# Step of a difference by the delay of a switch, relative to its uncertainty: the motion is nearly
# linear in it, and its rounding error, `RTOL`, a thousandth of the difference or less.
_SHIFT = 1e-2
# Parameters whose derivatives are central differences of the motion, and half their width in
# coordinates; for moduli, in units of the shear modulus.
_ASIDE, _WIDTH = ('transverse_mass_factor', 'bulk_ratio'), 1e-3
_SENSOR = (
    'stretch_bias', 'stretch_gain', 'sensor_latency', quantities.WARMING, quantities.EXPANSION)
# Parameters to which values of theta are proportional, by index.
_LINEAR = {
    'shear_modulus': derivatives.STIFFNESS, 'damping_coefficient': derivatives.DAMPING,
    'remanence': derivatives.DRIVE, 'constant_force': derivatives.FORCE}
# By coefficient of the temperature: the value of theta that changes, and the power of it; a lag
# is L/R.
_WARMING = {
    'shear_modulus': (derivatives.STIFFNESS, 1), 'damping_coefficient': (derivatives.DAMPING, 1),
    'remanence': (derivatives.DRIVE, 1), 'coil_resistance': (derivatives.LAG, -1)}
# Parameters that are values of theta, by index.
_PLACES = {
    'coil_time_constant': derivatives.LAG, 'initial_stretch': derivatives.STRETCH,
    'initial_rate': derivatives.RATE, 'damping_exponent': derivatives.EXPONENT,
    **{x: derivatives.FIRST_BRANCH + derivatives.BRANCH * i + j
       for i, z in enumerate(quantities.BRANCHES) for j, x in enumerate(z)},
    **{x: derivatives.FIRST_BRANCH + derivatives.BRANCH * i + derivatives.FLOW_CONSTANT + j
       for i, z in enumerate(quantities.FLOWING) for j, x in enumerate(z)}}


@dataclass(frozen=True, eq=False)
class Response:
    """Simulated reading of the sensor."""

    values: dict[str, Any]  # of all quantities, as `quantities.complete` returns them
    stretch: Array  # measured, shape (n,)
    rate: Array  # of the block in 1/s
    # Of the measured stretch by the coordinates of the free parameters, shape (n, p).
    jacobian: Array
    by_switch: Array  # by the uncertain times of switches, shape (n, u)


@lru_cache(maxsize=32)
def _places(first: int, modes: tuple[tuple[str, ...], ...]) -> dict[str, int]:
    """Return the indices in theta of parameters that are values of it; modes are from first on."""
    return {x: i for x, i in _PLACES.items() if i < first} | {
        x: i for i, x in enumerate((y for names in modes for y in names), first)}


def _chain(
        values: Mapping[str, Any], geometry: Geometry, branches: int, free: Sequence[str]
) -> tuple[Array, dict[str, dict[int, float]]]:
    """Return theta of the motion and, by name, its derivatives by the free parameters."""
    density = values['density']
    inertia = density * geometry.inertia * geometry.half_length ** 2
    modulus, remanence = values['shear_modulus'], values['remanence']
    a, k = modulus / inertia, remanence / (MU_0 * inertia)
    per_damping = 0.5 * geometry.c1 * geometry.half_length / geometry.damped / inertia
    per_force = 1.0 / (geometry.loaded * inertia)
    modes = quantities.modes_of(values, free)
    first = derivatives.FIRST_BRANCH + derivatives.BRANCH * branches
    theta = np.zeros(first + derivatives.MODE * len(modes))
    theta[:derivatives.LAG] = (
        a, per_damping * values['damping_coefficient'], k, per_force * values['constant_force'])
    by_value = dict(zip(
        _LINEAR.values(), (a / modulus, per_damping, k / remanence, per_force), strict=True))
    own = _places(first, modes)
    theta[list(own.values())] = [values[name] for name in own]
    if 'creep' in values:
        rows = np.array(values['creep'].rows())
        rows[:, SPEED] = values['creep'].times
        theta[derivatives.FIRST_BRANCH:first] = rows[:, :derivatives.BRANCH].ravel()
    else:
        flow = slice(derivatives.FIRST_BRANCH + derivatives.FLOW, first, derivatives.BRANCH)
        theta[flow] = quantities.flow_of(values, free).kind
    warming = _warmed(values, theta, by_value)
    per_density = {i: -float(theta[i]) / density for i in _LINEAR.values()}
    aside = differenced(values, free)
    chain: dict[str, dict[int, float]] = {}
    for name in free:
        if name == quantities.TEMPERATURE:
            chain[name] = warming
        elif name in own:
            chain[name] = {own[name]: by_value.get(own[name], 1.0)}
        elif name in _PLACES:
            chain[name] = {}  # of a branch that is not there
        elif name in _LINEAR:
            chain[name] = {_LINEAR[name]: by_value[_LINEAR[name]]}
            if name == 'shear_modulus' and 'time_unit' in free:
                # The density changes with the time unit, L sqrt(rho/G).
                for i, x in per_density.items():
                    chain[name][i] = chain[name].get(i, 0.0) + x * density / values[name]
        elif name == 'time_unit':
            chain[name] = {i: 2.0 * x * density / values[name] for i, x in per_density.items()}
        elif name in ('density', 'mass_factor'):
            chain[name] = {i: x * density / values[name] for i, x in per_density.items()}
        elif name in aside:
            continue
        elif name == 'chain_limit':
            chain[name] = {derivatives.CONSTANT: -1.0 / values[name] ** 2}
        elif name not in _SENSOR:
            constant, i = quantities.constants_of(values['law'])[name]
            # The scale of the model stays: constants in Pa change its force in proportion.
            chain[name] = {derivatives.CONSTANT + constant.place + 2 * i: (
                1.0 / values['shear_modulus'] if constant.unit == 'Pa' else 1.0)}
    return theta, chain


def _warmed(
        values: Mapping[str, Any], theta: Array, by_value: dict[int, float]) -> dict[int, float]:
    """
    Scale theta and its derivatives by the values to the temperature.

    Return the derivatives by the temperature; none without coefficients.
    """
    thermal: Thermal | None = values.get('thermal')
    if not thermal:
        return {}
    by_temperature = {}
    for name, (i, power) in _WARMING.items():
        factor = thermal.factor(name, values[quantities.TEMPERATURE])
        theta[i] *= factor ** power
        by_value[i] = by_value.get(i, 1.0) * factor ** power
        by_temperature[i] = power * float(theta[i]) * getattr(thermal, name) / factor
    return by_temperature


def differenced(values: Mapping[str, Any], free: Sequence[str]) -> tuple[str, ...]:
    """
    Return the free parameters whose derivatives are differences of the motion.

    With a change of volume, these include the constants of the hyperelastic model.
    """
    aside = _ASIDE if math.isinf(values['bulk_ratio']) else (
        *_ASIDE, 'chain_limit', *quantities.constants_of(values['law']))
    return tuple(x for x in free if x in aside)


def difference(
        values: Mapping[str, Any], name: str, of: Callable[[Mapping[str, Any]], Array | None]
) -> Array | None:
    """Return the derivative of a function of the values by a coordinate; None if it fails."""
    quantity, value = quantities.quantity_of(name), values[name]
    width = _WIDTH * (values['shear_modulus'] if quantity.unit == 'Pa' else 1.0)
    middle = quantities.to_coordinate(name, value)
    least, most = min(quantity.least, value), max(quantity.most, value)
    ends = [min(max(quantities.from_coordinate(name, middle + x), least), most)
            for x in (width, -width)]
    one, other = (of({**values, name: x}) for x in ends)
    if one is None or other is None:
        return None
    return (one - other) / (
        quantities.to_coordinate(name, ends[0]) - quantities.to_coordinate(name, ends[1]))


@lru_cache(maxsize=32)
def _packed(limit: float, c1: float, law: Elastic | None) -> Array:
    """Return the packed material; computing its limits is slow."""
    return pack(0.0, limit, c1, law)


@dataclass(frozen=True, eq=False)
class ResponseArguments:
    """Arguments of the motion for some values, and the chain rule to the free parameters."""

    theta: Array  # with indices as in `hmsa.motion.derivatives`
    material: Array  # the packed material
    branches: int  # number of viscoelastic branches
    # Indices in theta, or of constants of the model, to differentiate by, shape (w,).
    wanted: NDArray[np.int64]
    # Derivatives of these by the coordinates of the free parameters; 0 for the sensor's.
    mixing: Array
    states: int  # number of states that branches and secondary modes have behind

    @classmethod
    def of(
            cls, values: Mapping[str, Any], free: Sequence[str], more: Sequence[int] = ()
    ) -> 'ResponseArguments':
        """
        Return the setup for values from `quantities.complete`, with its own arrays.

        Maxwell branches may be given as ``creep``. Indices in ``more`` to differentiate by come
        last, with a column each.
        """
        given: Creep | None = values.get('creep')
        modes = len(quantities.modes_of(values, free))
        modal = 2 + 2 * modes if modes else 0
        branches = len(given.ratios) if given else max((
            i for i, names in enumerate(quantities.BRANCHES, 1)
            if values[names[0]] > 0.0 or set(names) & set(free)
        ), default=max(len(values.get('behind', ())) - modal, 0))
        geometry = quantities.geometry_of(values)
        theta, chain = _chain(values, geometry, branches, free)
        inner = sorted({i for x in chain.values() for i in x})
        rows = {x: i for i, x in enumerate(inner)}
        material = _packed(
            values['chain_limit'], geometry.inertia_c1, quantities.energy_of(values)).copy()
        if 'chain_limit' in free and math.isinf(values['bulk_ratio']):
            material[KIND] = GENT
        mixing = np.zeros((len(inner) + len(more), len(free) + len(more)))
        for j, name in enumerate(free):
            if by := chain.get(name):
                slope = quantities.derivative(name, values[name])
                for i, x in by.items():
                    mixing[rows[i], j] = slope * x
        for j in range(1, len(more) + 1):
            mixing[-j, -j] = 1.0
        return cls(
            theta, material, branches, np.array([*inner, *more], dtype=np.int64), mixing,
            branches + modal)


def respond(
        recording: Measurement | UncheckedMeasurement, values: Mapping[str, float],
        free: Sequence[str], *,
        rtol: float = RTOL, shifts: Array | None = None, more: Sequence[int] = ()
) -> Response | None:
    """
    Simulate the reading of the sensor; None if the motion meets the limits of the chains.

    The motion begins at rest at its first level, or else with ``initial_stretch`` and
    ``initial_rate`` at the first sample. ``shifts``, shape (u,), are the delays in s of uncertain
    switches after their recorded times; default minus half their uncertainty. Indices in ``more``
    give columns of the Jacobian after those of the free parameters.
    """
    try:
        values = quantities.complete(values, free)
    except BadInputError:
        return None
    setup = ResponseArguments.of(values, free, more)
    theta, material, wanted = setup.theta, setup.material, setup.wanted
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
        wanted = np.append(wanted, derivatives.SWITCH + place)
    start = np.zeros(len(wanted))
    if recording.at_rest:
        theta[derivatives.STRETCH] = derivatives.rest(
            theta, material, float(levels[0]), wanted, start)
        theta[derivatives.RATE] = 0.0
        if math.isnan(theta[derivatives.STRETCH]):
            return None
    else:
        start[wanted == derivatives.STRETCH] = 1.0
    n = len(times)
    stretch, rate, raw = np.empty(n), np.empty(n), np.empty((n, len(wanted)))
    if not derivatives.respond(
            theta, material, setup.branches, wanted, start, begins, levels, slopes,
            float(levels[0]), 0.0, times, rtol, stretch, rate, raw, _NOTHING, _NOTHING, _NOTHING):
        return None
    raw *= values['stretch_gain']
    shown, jacobian = sensed(values, free, stretch, rate, raw[:, :inner_count] @ setup.mixing)

    def shown_at(other: Mapping[str, Any]) -> Array | None:
        found = respond(recording, other, (), rtol=rtol, shifts=shifts)
        return None if found is None else found.stretch

    for name in differenced(values, free):
        by = difference(values, name, shown_at)
        if by is None:
            return None
        jacobian[:, free.index(name)] = by
    switched = raw[:, inner_count:]
    if switched.size and not math.isinf(recording.slew_limit):
        # Both ends of a ramp move with its level, which the derivative by one begin leaves out.
        _switch(switched, recording, shifts, lambda x: respond(
            recording, values, (), rtol=rtol, shifts=x), shown)
    return Response(values, shown, rate, jacobian, switched)


def _switch(
        switched: Array, recording: Measurement | UncheckedMeasurement, shifts: Array | None,
        shifted: Callable[[Array], Response | None], shown: Array) -> None:
    """Replace derivatives by delays of switches, shape (n, u), by differences."""
    count, step = switched.shape[1], _SHIFT * recording.earlier
    base = np.full(count, -0.5 * recording.earlier) if shifts is None else shifts
    for j in range(count):
        other = shifted(base + step * (np.arange(count) == j))
        if other is not None:
            switched[:, j] = (other.stretch - shown) / step


def gain_of(values: Mapping[str, float]) -> float:
    """Return the gain of the sensor for stretch, including thermal expansion."""
    return values['stretch_gain'] * (1.0 + values.get(quantities.EXPANSION, 0.0) * values.get(
        quantities.WARMED, 0.0))


def sensed(
        values: Mapping[str, float], free: Sequence[str], stretch: Array, rate: Array, by: Array
) -> tuple[Array, Array]:
    """
    Return the reading of the sensor for a motion, and its derivatives.

    ``by`` contains those by parameters of the motion; columns of sensor parameters are filled in.
    """
    gain, warmed = gain_of(values), values.get(quantities.WARMED, 0.0)
    by_sensor: dict[str, float | Array] = {
        'stretch_bias': 1.0, 'stretch_gain': quantities.derivative('stretch_gain', gain) * stretch,
        'sensor_latency': -gain * rate,
        quantities.EXPANSION: values['stretch_gain'] * warmed * stretch}
    for j, name in enumerate(free):
        if name in by_sensor:
            by[:, j] = by_sensor[name]
    return gain * stretch + values['stretch_bias'], by
