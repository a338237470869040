"""
Parameters that can be estimated: names, units, ranges, coordinates of the search, and uncertainty.

The uncertainty of an identification, or of feedback, is known to the next run.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
import math
from typing import Any

import numpy as np

from hmsa.errors import BadInputError, check_number, meant
from hmsa.model.compressible import BULK_RATIOS, condensed
from hmsa.model.creep import CONSTANTS, Creep, Flow, FLOWS, MAXWELL
from hmsa.model.equations import Array
from hmsa.model.laws import LAWS
from hmsa.model.laws.record import BEAMS, Constant, Elastic
from hmsa.model.modes import Modes
from hmsa.model.parameters import ActuatorParameters, Geometry, NondimensionalParameters
from hmsa.model.thermal import COLDEST, HOTTEST, Thermal

#: Prefix in parameter files.
PREFIX = 'identification.'
# Minimum eigenvalue of the correlation matrix, and the one that is written.
_SINGULAR, _REGULAR = 1e-12, 1e-11


@dataclass(frozen=True)
class Quantity:
    """One parameter of actuator, coil or sensor."""

    unit: str  # in plain text
    default: float = math.nan  # unless given; NaN for parameters of the actuator
    # Coordinate of the search: 'log', 'inverse' (0 for infinite J_lim) or 'linear'.
    scale: str = 'log'
    least: float = 0.0  # minimum
    most: float = math.inf  # maximum
    advice: str = ''  # what to record or measure if the data do not determine it


_STEP = 'record unshaped steps that ring, at a rate above twice the frequency of the ringing'
_SCALE = ('only ratios of shear_modulus, density and remanence act on the motion: measure one of '
          'them (weigh the actuator for the density) and leave it out of --free')
_CREEP = 'record rest far from that without field for several times the time of the creep'
_NUMBERS = ('', '_2', '_3')
_MODE = 'record unshaped steps, at a rate above twice the frequency of the mode'
_MODE_NUMBERS = ('', '.2', '.3')
#: Fields of `ActuatorParameters` that are measured with a ruler, and never estimated.
GEOMETRY = ('half_length', 'half_thickness')
#: Quantities by name; those of the actuator have the names of its parameters.
QUANTITIES: dict[str, Quantity] = {
    'shear_modulus': Quantity('Pa', advice=_STEP),
    'density': Quantity('kg/m^3', advice=_SCALE),
    'remanence': Quantity('T', advice='record rest at two or more levels that differ widely'),
    'chain_limit': Quantity(
        '', scale='inverse', advice='record larger stretches, and rest at three or more levels'),
    'damping_coefficient': Quantity('N s/m', scale='linear', advice=_STEP),
    'damping_exponent': Quantity(
        '', 0.0, 'linear', -6.0, 6.0,
        advice='record unshaped steps about stretches that differ widely, below and above 1'),
    'time_unit': Quantity('s', advice=_STEP),
    'stretch_bias': Quantity(
        '', 0.0, 'linear', -math.inf, advice='record rest without field, or calibrate the '
        'sensor there'),
    'stretch_gain': Quantity(
        '', 1.0, advice='calibrate the sensor with a known length and leave stretch_gain out of '
        '--free: its gain looks like remanence and chain_limit'),
    'sensor_latency': Quantity(
        's', 0.0, 'linear', -math.inf,
        advice='record unshaped steps with timestamps of one clock'),
    'coil_time_constant': Quantity(
        's', 0.0, 'linear', advice='record steps at more than two samples per time constant'),
    'constant_force': Quantity(
        'N', 0.0, 'linear', -math.inf, advice='record rest at three or more levels of both '
        'signs'),
    'initial_stretch': Quantity(
        '', scale='linear', least=-math.inf, advice='begin to record before the first step'),
    'initial_rate': Quantity(
        '1/s', 0.0, 'linear', -math.inf, advice='begin to record at rest'),
    'viscoelastic_ratio': Quantity('', 0.0, 'linear', advice=_CREEP),
    'viscoelastic_time': Quantity('s', 0.01, advice=_CREEP),
    'viscoelastic_ratio_2': Quantity('', 0.0, 'linear', advice=_CREEP),
    'viscoelastic_time_2': Quantity('s', 0.1, advice=_CREEP),
    'viscoelastic_ratio_3': Quantity('', 0.0, 'linear', advice=_CREEP),
    'viscoelastic_time_3': Quantity('s', 1.0, advice=_CREEP),
    **{f'viscoelastic_{name}{x}': Quantity(
        '', 1.0, 'linear', constant.minimum, constant.maximum,
        f'{_CREEP}, from steps of different heights')
       for name, constant in CONSTANTS.items() for x in _NUMBERS},
    'bulk_ratio': Quantity(
        '', math.inf, 'inverse', *BULK_RATIOS,
        'record rest at three or more levels of both signs, and motion about them, with '
        'shear_modulus or density known'),
    'mass_factor': Quantity('', advice=_STEP),
    'transverse_mass_factor': Quantity(
        '', least=0.1, most=10.0,
        advice='record motion about stretches that differ widely, below and above 1'),
    **{f'modes.{name}{x}': Quantity('', default, scale, least, most, _MODE)
       for x in _MODE_NUMBERS for name, default, scale, least, most in (
           ('frequency_ratio', 2.0, 'log', 1.05, 100.0),
           ('share', 0.0, 'linear', -0.9, 0.9),
           ('damping_ratio', 0.05, 'linear', 0.0, 0.95),
           ('ratio_exponent', 0.0, 'linear', -5.0, 5.0),
           ('share_exponent', 0.0, 'linear', -10.0, 10.0))},
    **dict.fromkeys(GEOMETRY, Quantity('m')),
}
#: Ratio and time of each viscoelastic branch.
BRANCHES = tuple((f'viscoelastic_ratio{x}', f'viscoelastic_time{x}') for x in _NUMBERS)
#: Constants of the flow rule of each branch.
FLOWING = tuple(tuple(f'viscoelastic_{y}{x}' for y in CONSTANTS) for x in _NUMBERS)
# Each flow rule with the names of its constants.
_FLOWS = tuple(
    (flow, tuple(f'viscoelastic_{x.name}{y}' for x in flow.constants for y in _NUMBERS))
    for flow in FLOWS.values())
#: Name that frees secondary modes, as many as the recording shows, and the mass factor.
MODES = 'modes'
#: Ratio, share, damping ratio and exponents of each secondary mode.
SECONDARY = tuple(tuple(f'modes.{y}{x}' for y in (
    'frequency_ratio', 'share', 'damping_ratio', 'ratio_exponent', 'share_exponent'))
    for x in _MODE_NUMBERS)
# Parameter of a compressible block that is never estimated.
_EXPONENT = 'transverse_mass_exponent'
#: Factors on the mass.
FACTORS = ('mass_factor', 'transverse_mass_factor')
#: Constants of the hyperelastic models, by the name of their parameter.
_OF_LAWS = {
    x.name: Quantity(
        x.unit, scale='inverse' if x.inverse else 'linear', least=x.minimum, most=x.maximum,
        advice='record larger stretches of both signs, and rest at three or more levels; or '
               'choose a law with fewer constants')
    for law in LAWS.values() for x in law.constants if x.place >= 0}
#: Temperature of an actuator with coefficients, its change over the measured one, and the thermal
#: expansion of the length that a sensor measures; and the measured change, in K.
TEMPERATURE, WARMING, EXPANSION, WARMED = 'temperature', 'warming', 'expansion', 'warmed'
#: Those that only feedback estimates.
THERMAL = {
    TEMPERATURE: Quantity('degrees Celsius', math.nan, 'linear', COLDEST, HOTTEST),
    WARMING: Quantity('', 1.0, 'linear', -math.inf),
    EXPANSION: Quantity('1/K', 0.0, 'linear', -math.inf)}
#: Free by default.
DEFAULT_FREE = (
    'shear_modulus', 'damping_coefficient', 'chain_limit', 'remanence', 'stretch_bias')
#: Parameters that levels at rest determine, even if the frequency is unknown.
STATIC = {'chain_limit', 'stretch_bias', 'stretch_gain', 'initial_stretch'}


def check_free(names: Iterable[str], law: Elastic | None = None) -> tuple[str, ...]:
    """
    Return the names of free parameters, each once.

    A prefix ``actuator.`` or ``law.`` is dropped, and the modulus may have its name in the model.
    Models other than Gent exclude J_lim, but allow their constants: ``law.c10``, or for all
    elements of a list ``law.mu`` and for its first ``law.mu.1``. Raise `BadInputError` if a name
    is unknown, none is given, or two exclude each other.
    """
    constants = constants_of(law)
    whole = {'shear_modulus': ['shear_modulus'], modulus_of(law)[0]: ['shear_modulus']}
    for name in constants:
        whole.setdefault(name.removeprefix('law.'), [name])
        first = '.'.join(name.split('.')[:2]).removeprefix('law.')
        whole[first] = [x for x in constants if x.split('.')[1] == first]
    free = tuple(dict.fromkeys(z for x in names for y in [
        x.strip().removeprefix('actuator.').removeprefix('law.')] for z in whole.get(y, [y])))
    possible = [*(x for x in QUANTITIES if x not in GEOMETRY), MODES, *constants]
    unknown = [x for x in free if x not in possible]
    if unknown or not free:
        raise BadInputError(
            f'free parameter {", ".join(map(repr, unknown)) or "missing"}: expected some of '
            f'{", ".join(possible)}' + ''.join(meant(x, possible) for x in unknown[:1]))
    sought = [x for x in free if x in constants]
    scales = [x for x in free if x in ('shear_modulus', 'time_unit')]
    if sought and scales:
        raise BadInputError(
            f'both {scales[0]} and {sought[0]} are free: expected one of them, since the shear '
            'modulus follows from the constants of the law')
    if law is not None and 'chain_limit' in free:
        if free != DEFAULT_FREE:
            raise BadInputError(
                f'chain_limit is free: expected none for law {law.law}, whose constants keep '
                'their ratios while shear_modulus is sought')
        free = tuple(x for x in free if x != 'chain_limit')
    if 'time_unit' in free and 'density' in free:
        raise BadInputError(
            'both time_unit and density are free: expected one of them, since one follows from '
            'the other')
    return free


def free_of(
        text: str, law: Elastic | None = None, known: Iterable[str] = ()) -> tuple[str, ...]:
    """
    Return the names of free parameters from a command line.

    Names replace the default list, without known ones; ``+NAME`` adds to it and ``-NAME`` removes
    from it. Raise `BadInputError` if the latter is not free, if a name is known too, and as
    `check_free` does.
    """
    names = [x.strip() for x in text.split(',') if x.strip()]
    if both := [x for x in known if x in names or f'+{x}' in names]:
        raise BadInputError(f'{both[0]} is free and known: expected only one of them')
    free = [x for x in names if x[0] not in '+-']
    if not free:
        free = [x for x in DEFAULT_FREE if x not in known and (
            law is None or x != 'chain_limit')]
    free += [x[1:] for x in names if x[0] == '+']
    without = {x[1:] for x in names if x[0] == '-'}
    if missing := sorted(without.difference(free)):
        raise BadInputError(
            f'--free=-{missing[0]} removes a parameter that is not free: expected one of '
            f'{", ".join(free)}')
    return check_free((x for x in free if x not in without), law)


@lru_cache(maxsize=64)
def constants_of(law: Elastic | None) -> dict[str, tuple[Constant, int]]:
    """
    Return the constants of a model that can be estimated, by name.

    Each comes with its index in its list; the name has this number, from 1 on, after a point.
    """
    found = {}
    for constant in LAWS[law.law].constants if law is not None else ():
        if constant.place >= 0 and law is not None:
            value = dict(law.given)[constant.name]
            count = len(value) if isinstance(value, tuple) else 1
            for i in range(count):
                found[f'{constant.name}.{i + 1}' if count > 1 else constant.name] = constant, i
    return found


def complete(values: Mapping[str, Any], free: Iterable[str]) -> dict[str, Any]:
    """
    Return values with consistent density and time unit, and with the model from its constants.

    If the time unit is free, it determines the density, otherwise vice versa. Raise
    `BadInputError` if no model has such constants.
    """
    done = dict(values)
    law: Elastic | None = done['law']
    names, scaled = constants_of(law), law and LAWS[law.law].scaled
    if scaled and any(x in done for x in names):
        given: dict[str, Any] = {}
        for name, (constant, _) in names.items():
            if constant.kind is list:
                given.setdefault(constant.name, []).append(done[name])
            else:
                given[constant.name] = done[name]
        done['shear_modulus'], done['law'] = scaled(given)
    if 'time_unit' in free:
        done['density'] = done['shear_modulus'] * (
            done['time_unit'] / done['half_length']) ** 2 / geometry_of(done).inertia
    else:
        done['time_unit'] = done['half_length'] * math.sqrt(
            done['density'] * geometry_of(done).inertia / done['shear_modulus'])
    return done


@lru_cache(maxsize=256)
def quantity_of(name: str) -> Quantity:
    """
    Return a parameter by name, including constants of a model.

    Raise `BadInputError` if there is none with this name.
    """
    found = QUANTITIES.get(name) or THERMAL.get(name) or _OF_LAWS.get(
        '.'.join(name.split('.')[:2]))
    if found is None:
        raise BadInputError(
            f'unknown parameter {name!r}: expected some of {", ".join(QUANTITIES)}'
            + meant(name, QUANTITIES))
    return found


def values_of(
        actuator: ActuatorParameters, others: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """
    Return values of all quantities, with the hyperelastic model as ``law``.

    ``others`` replace those of the actuator and defaults. Raise `BadInputError` if a name is
    unknown or a value out of range.
    """
    others = {x: float(y) for x, y in (others or {}).items()}
    actuator = replace(
        actuator, half_length=others.get('half_length', actuator.half_length),
        half_thickness=others.get('half_thickness', actuator.half_thickness))
    for name, value in others.items():
        quantity = quantity_of(name)
        check_number(name, value, least=quantity.least, most=quantity.most)
    return {name: x.default for name, x in QUANTITIES.items()} | actuator.numbers | {
        'time_unit': actuator.time_unit, 'law': actuator.law, 'initial_stretch': actuator.rest,
        'bulk_ratio': actuator.bulk_ratio, _EXPONENT: actuator.transverse_mass_exponent,
        **actuator.factors, **values_of_modes(actuator.modes),
        **others}


def of_beam(values: Mapping[str, Any]) -> bool:
    """Return whether values are those of a beam."""
    law = values['law']
    return law is not None and law.family in BEAMS


def values_of_modes(modes: Modes) -> dict[str, float]:
    """Return the values of secondary modes."""
    return {name: value for names, row in zip(SECONDARY, modes.numbers, strict=False)
            for name, value in zip(names, row, strict=True)}


def modes_of(
        values: Mapping[str, Any], free: Collection[str] = ()) -> tuple[tuple[str, ...], ...]:
    """Return the names of the secondary modes that have a share, or are free."""
    return tuple(
        names for names in SECONDARY if values[names[1]] or set(names) & set(free))


def actuator_of(values: Mapping[str, Any]) -> ActuatorParameters:
    """Return the block with values from `values_of`."""
    return ActuatorParameters(
        shear_modulus=values['shear_modulus'], density=values['density'],
        half_length=values['half_length'], half_thickness=values['half_thickness'],
        remanence=values['remanence'], chain_limit=values['chain_limit'],
        damping_coefficient=values['damping_coefficient'], law=values.get('law'),
        creep=values.get('creep', Creep()),
        modes=Modes.of_numbers([[values[x] for x in names] for names in modes_of(values)]),
        bulk_ratio=values['bulk_ratio'], thermal=values.get('thermal', Thermal()),
        transverse_mass_exponent=values[_EXPONENT], **{x: values[x] for x in FACTORS})


def flow_of(values: Mapping[str, Any], free: Iterable[str]) -> Flow:
    """Return the flow rule of the branches: the one with a constant that is free, or not 1."""
    sought = set(free)
    for flow, names in _FLOWS:
        for name in names:
            if name in sought or values[name] != 1.0:
                return flow
    return MAXWELL


def group_of(values: Mapping[str, Any]) -> NondimensionalParameters:
    """Return the dimensionless group of values from `values_of`, without damping."""
    return NondimensionalParameters(
        0.0, values['chain_limit'], geometry_of(values).inertia_c1, energy_of(values))


def energy_of(values: Mapping[str, Any]) -> Elastic | None:
    """Return the elastic energy, with the change of volume if there is one; None for Gent."""
    law: Elastic | None = values.get('law')
    if math.isinf(values['bulk_ratio']):
        return law
    return condensed(
        law, values['chain_limit'], values['bulk_ratio'], values[_EXPONENT])


def modulus_of(law: Elastic | None) -> tuple[str, float]:
    """Return the name of the reported modulus, and its ratio to the shear modulus: E of a beam."""
    if law is None or not law.section:
        return 'shear_modulus', 1.0
    name, ratio = law.given[0]
    return name.removeprefix('law.'), float(ratio)


def geometry_of(values: Mapping[str, Any]) -> Geometry:
    """Return the geometric factors of values of all quantities."""
    return Geometry(
        values['half_length'], values['half_thickness'], values.get('law'),
        bulk_ratio=values['bulk_ratio'], **{x: values[x] for x in FACTORS})


def damping_unit(values: Mapping[str, Any]) -> float:
    """Return the damping coefficient in N s/m for zeta 1, for values of all quantities."""
    return geometry_of(values).damping_unit(values['density'], values['shear_modulus'])


def to_coordinate(name: str, value: float) -> float:
    """Return the coordinate of a value."""
    scale = quantity_of(name).scale
    return math.log(value) if scale == 'log' else 1.0 / value if scale == 'inverse' else value


def from_coordinate(name: str, x: float) -> float:
    """Return the value of a coordinate; J_lim is limited to 1e9."""
    scale = quantity_of(name).scale
    if scale == 'log':
        return math.exp(min(max(x, -230.0), 230.0))
    if scale == 'inverse':
        return 1.0 / x if x > 1e-9 else 1e9
    return x


def coordinates(values: Mapping[str, Any], free: Iterable[str]) -> Array:
    """Return the coordinates of the free parameters."""
    return np.array([to_coordinate(x, values[x]) for x in free], dtype=np.float64)


def values_at(values: Mapping[str, Any], free: Sequence[str], z: Array) -> dict[str, Any]:
    """Return values with the free ones at coordinates, clipped to their ranges."""
    found = dict(values)
    for name, x in zip(free, z.tolist(), strict=True):
        quantity = quantity_of(name)
        found[name] = min(max(from_coordinate(name, x), quantity.least), quantity.most)
    return found


def derivative(name: str, value: float) -> float:
    """Return the derivative of a value by its coordinate."""
    scale = quantity_of(name).scale
    return value if scale == 'log' else -value * value if scale == 'inverse' else 1.0


@dataclass(frozen=True, eq=False)
class Known:
    """Values of parameters and their covariance, in SI units; empty if none were identified."""

    names: tuple[str, ...] = ()
    values: tuple[float, ...] = ()  # in the order of the names; empty if given elsewhere
    # Of shape (p, p).
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        matrix, size = self.covariance, len(self.names)
        if matrix.shape != (size, size) or not np.all(np.isfinite(matrix)):
            raise BadInputError(
                f'{PREFIX}covariance has {matrix.size} numbers for {size} names: expected '
                f'{size ** 2} finite ones')
        if len(self.values) not in (0, size):
            raise BadInputError(
                f'{PREFIX}values has {len(self.values)} numbers for {size} names: expected '
                f'{size}')
        scale = np.sqrt(np.abs(np.diag(matrix)))
        if not np.all(scale > 0.0) or size and (
                not np.allclose(matrix, matrix.T, 1e-6, 0.0)
                or np.min(np.linalg.eigvalsh(matrix / np.outer(scale, scale))) < _SINGULAR):
            raise BadInputError(
                f'{PREFIX}covariance is not a covariance matrix: expected a symmetric one with '
                'positive eigenvalues, row after row')

    @classmethod
    def of(cls, names: tuple[str, ...], values: tuple[float, ...], covariance: Array) -> 'Known':
        """
        Return what a fit found, also if only combinations of its parameters are determined.

        Their correlation matrix is singular up to rounding. Standard deviations are not changed.
        """
        own = np.diag(np.diag(covariance))
        return cls(names, values, (1.0 - _REGULAR) * covariance + _REGULAR * own)

    @classmethod
    def read(cls, settings: Mapping[str, Any]) -> 'Known':
        """Return the values in parameters by dotted name; raise `BadInputError` if unusable."""
        names, values, flat = (
            settings.get(PREFIX + x) or [] for x in ('names', 'values', 'covariance'))
        # Constants of a model, modes, compressibility and factors of the mass are not estimated
        # further: keep only the other parameters.
        kept = [i for i, x in enumerate(names)
                if not x.startswith(('law.', 'modes.')) and x not in (
                    *FACTORS, 'damping_exponent', 'bulk_ratio')]
        if not kept:
            return cls()
        free = check_free(names[i] for i in kept)
        try:
            matrix: Array = np.array(flat, dtype=np.float64).ravel()
            numbers = tuple(float(x) for x in values)
        except (TypeError, ValueError):
            raise BadInputError(
                f'{PREFIX}values and {PREFIX}covariance are not all numbers: expected numbers') \
                from None
        if matrix.size == len(names) ** 2:
            matrix = matrix.reshape(len(names), -1)[np.ix_(kept, kept)]
        if len(numbers) == len(names):
            numbers = tuple(numbers[i] for i in kept)
        return cls(free, numbers, matrix)

    def value(self, name: str) -> float | None:
        """Return a value; None if unknown."""
        if name not in self.names or not self.values:
            return None
        return self.values[self.names.index(name)]

    def parameters(self) -> dict[str, list[Any]]:
        """Return the parameters by dotted name, the inverse of `read`."""
        return {
            f'{PREFIX}names': list(self.names), f'{PREFIX}values': list(self.values),
            f'{PREFIX}covariance': self.covariance.ravel().tolist()}
