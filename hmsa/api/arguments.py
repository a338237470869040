"""Checks of the arguments of public functions, and the planning model of an actuator from them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import wraps
import inspect
import math
from numbers import Real
import os
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np

from hmsa.errors import BadInputError, check_choice, check_number, excerpt, meant
from hmsa.interfaces.actuator import actuator_from, along_elastica, model_from
from hmsa.interfaces.parameters import (
    ACTUATOR,
    BULK_RATIO,
    COIL_TIME_CONSTANT,
    CREEP_TOLERANCE,
    LAW_NAME,
    PLANNED,
    THERMAL,
    VISCOELASTIC,
)
from hmsa.interfaces.topics import PLANNER
from hmsa.model.delivery import IDEAL
from hmsa.model.equations import Array, critical_zeta
from hmsa.model.laws import LAWS
from hmsa.model.modes import MOUNTS
from hmsa.model.moves import check_target
from hmsa.model.parameters import ActuatorParameters
from hmsa.planning.timeline import JointModel
from hmsa.runs.parameters import values_of

# Shortest period of a command grid in s.
_FINEST = 1e-9
#: Alternative names of columns.
_ALIASES = {'duration': ('span', 'seconds'), 'stretch': ('deflection', 'position')}


# Units of columns; others have none.
_UNITS = {'time': 's', 'duration': 's', 'flux_density': 'T'}

_P = ParamSpec('_P')
_R = TypeVar('_R')


def suggesting(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Have a function name the argument that a misspelt one may mean."""
    known = inspect.signature(function).parameters.values()
    if any(x.kind is x.VAR_KEYWORD for x in known):
        return function  # which checks them
    names = [x.name for x in known if x.name != 'self']

    @wraps(function)
    def checked(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        check_names(function.__qualname__.removesuffix('.__init__'), kwargs, names)
        return function(*args, **kwargs)

    return checked


def check_names(function: str, given: Iterable[str], names: Sequence[str]) -> None:
    """Raise `TypeError`, as Python does, if a function has no argument of a given name."""
    for name in given:
        if name not in names:
            raise TypeError(
                f'{function}() got an unexpected keyword argument {name!r}: expected some of '
                f'{", ".join(names)}' + meant(name, names))


def plain(value: Any, unit: str, what: str) -> Any:
    """
    Return a quantity of pint as numbers in a unit, and anything else unchanged.

    An empty unit is that of a dimensionless value.

    Raises
    ------
    BadInputError
        If the quantity has another dimension.

    """
    if not hasattr(value, 'm_as'):
        return value
    try:
        return value.m_as(unit)
    except (AttributeError, TypeError, ValueError) as error:
        raise BadInputError(
            f'{excerpt(value)} is given for {what}: expected '
            + (f'a quantity that converts to {unit}' if unit else 'a number without a unit')
        ) from error


def columns_of(value: Any, names: tuple[str, str], what: str) -> tuple[Array, Array]:
    """
    Return two columns of numbers, each of shape (n,).

    Parameters
    ----------
    value : pairs, tuple of two arrays, array of shape (n, 2), mapping or DataFrame
        The numbers; a mapping contains the columns by name.
    names : tuple of str
        Names of the columns.
    what : str
        Description of the numbers, for messages.

    Returns
    -------
    tuple of ndarray
        Both columns.

    Raises
    ------
    BadInputError
        If the value has none of these forms.

    """
    expected = (
        f'expected pairs of {names[0]} and {names[1]}, two arrays, or columns of these names')
    if isinstance(value, Mapping) or hasattr(value, 'columns') and hasattr(value, '__getitem__'):
        pair = [_column(value, x, what) for x in names]
    elif isinstance(value, tuple) and len(value) == 2 and all(
            isinstance(x, np.ndarray) or np.ndim(x) and hasattr(x, 'm_as') for x in value):
        pair = list(value)
    else:
        rows = numbers(_plain_rows(value, names), what, expected)
        if rows.ndim != 2 or rows.shape[1] != 2:
            raise BadInputError(
                f'{what} have the shape {rows.shape}: {expected}, as in '
                f'[({", ".join(names)}), ({", ".join(names)})]')
        pair = [rows[:, 0], rows[:, 1]]
    one, other = (np.ascontiguousarray(numbers(x, what, expected, _UNITS.get(name, '')))
                  for x, name in zip(pair, names, strict=True))
    if one.ndim != 1 or one.shape != other.shape or not len(one):
        raise BadInputError(
            f'{what} have {names[0]} of shape {one.shape} and {names[1]} of shape {other.shape}: '
            'expected two rows of one length, of at least 1')
    return one, other


def setpoints_of(value: Any, rest: float) -> tuple[Array, Array]:
    """
    Return stretches and durations in s, each of shape (n,).

    Raises
    ------
    BadInputError
        If the value has no such columns, a stretch is impossible for an actuator with this rest,
        a duration is not above 0, or one before the last is infinite.

    """
    stretches, durations = columns_of(value, ('stretch', 'duration'), 'setpoints')
    for stretch, duration in zip(stretches.tolist(), durations.tolist(), strict=True):
        check_target(stretch, rest)
        check_number('duration', duration, 's', above=0.0, endless=True)
    if np.any(np.isinf(durations[:-1])):
        raise BadInputError('duration is inf s: only that of the last setpoint may be')
    return stretches, durations


def file_of(value: Any, what: str = 'the path of a file') -> Path:
    """Return a path, or raise `BadInputError`."""
    if not isinstance(value, (str, os.PathLike)) or '\0' in os.fsdecode(value):
        raise BadInputError(f'path is {excerpt(value)}: expected {what}')
    return Path(value)


def grid_of(period: Any) -> float:
    """Return the period of a command grid in s, 0 for none, or raise `BadInputError`."""
    found = number(period, 'period', 's', least=0.0)
    if 0.0 < found < _FINEST:
        raise BadInputError(
            f'period is {found:g} s: expected 0 for any time, or at least {_FINEST:g} s')
    return found


def mapping_of(value: Any, what: str, example: str) -> Mapping[str, Any]:
    """Return values by name, none for None, or raise `BadInputError`."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise BadInputError(
            f'{what} are {excerpt(value)}: expected values by name, as in {{{example}}}')
    return value


def names_of(value: Any, what: str) -> list[str]:
    """Return names of parameters, or raise `BadInputError`."""
    if isinstance(value, str) or not np.iterable(value) or not all(
            isinstance(x, str) for x in value):
        raise BadInputError(
            f"{what} is {excerpt(value)}: expected names of parameters, as in ['remanence']")
    return list(value)


def whole(value: Any, what: str, least: float = -math.inf) -> int:
    """Return a whole number of at least ``least``, or raise `BadInputError`."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise BadInputError(
            f'{what} is {excerpt(value)}: expected a whole number'
            + (f' of at least {least:g}' if least > -math.inf else ''))
    return int(value)


def _column(value: Any, name: str, what: str) -> Any:
    found = [name] if name in value else [x for x in _ALIASES.get(name, ()) if x in value]
    if len(found) != 1:
        raise BadInputError(
            f'{what} have the columns {", ".join(map(str, value))}: expected one named {name}')
    return value[found[0]]


def _plain_rows(value: Any, names: tuple[str, str]) -> Any:
    """Return pairs with each quantity as a number in the unit of its column."""
    if not isinstance(value, (tuple, list)):
        return value
    return [
        [plain(x, _UNITS.get(name, ''), name) for x, name in zip(row, names, strict=True)]
        if isinstance(row, (tuple, list)) and len(row) == len(names) else row for row in value]


def numbers(
        value: Any, what: str, expected: str = 'expected numbers', unit: str = '') -> Array:
    """Return numbers of any shape, those of quantities in a unit, or raise `BadInputError`."""
    value = plain(value, unit, what)
    if isinstance(value, (tuple, list)):
        value = [plain(x, unit, what) for x in value]
    try:
        if value is None or np.iscomplexobj(value):
            raise TypeError  # NumPy would make it NaN, or drop the imaginary parts
        found: Array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInputError(f'{what} are {excerpt(value)}: {expected}') from error
    return found


def number(
        value: Any, what: str, unit: str = '', *, least: float = -math.inf,
        above: float = -math.inf, most: float = math.inf) -> float:
    """
    Return a number, checked against the bounds ``least``, ``above`` (exclusive) and ``most``.

    Raises
    ------
    BadInputError
        If the value is no number or out of range, or not finite although it has a lower bound.

    """
    value = plain(value, unit, what)
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        raise BadInputError(
            f'{what} is {excerpt(value)}: expected a number' + (f' in {unit}' if unit else ''))
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if least > -math.inf or above > -math.inf:
        check_number(what, found, unit, least=least, above=above, most=most)
    return found


def several(value: Any) -> list[Any]:
    """Return the items as a list; a single item becomes a list of one."""
    return list(value) if np.iterable(value) and not isinstance(value, str) else [value]


#: Arguments of `Actuator` of which one describes the damping.
DAMPED = ('zeta', 'damping_ratio', 'damping_coefficient')
# Arguments of `Actuator` that are single numbers, and those that may be None.
_NUMBERS = {x.name.rpartition('.')[2]: x for x in (*ACTUATOR, BULK_RATIO, COIL_TIME_CONSTANT)}
_OPTIONAL = ('shear_modulus', 'half_thickness', *DAMPED, 'constants', 'thermal')
# Plans made here need not be sent, so the levels are very fine unless a file sets the tolerance.
_SPECS = (*PLANNED, *VISCOELASTIC, replace(CREEP_TOLERANCE, default=IDEAL.ripple))
_PAPER, *_BLOCK, CLAMPED = MOUNTS


def parameters_in(given: Mapping[str, Any], law: str = 'gent') -> dict[str, Any]:
    """
    Return the node parameters for arguments of `Actuator`, except zeta and the damping ratio.

    The constants belong to the model in ``given``, else to ``law``.

    Raises
    ------
    BadInputError
        If an argument has the wrong type, or some of them exclude each other.

    """
    given = {x: y for x, y in given.items() if y is not None or x not in _OPTIONAL}
    damped = [x for x in DAMPED if x in given]
    if len(damped) > 1:
        raise BadInputError(f'both {" and ".join(damped)} are given: expected one of them')
    values: dict[str, Any] = {
        x.name: number(given[name], name, x.unit) for name, x in _NUMBERS.items() if name in given}
    values |= _law_values(
        given.get('law', law), given.get('constants'), 'shear_modulus' in given)
    if 'creep' in given:
        values |= _creep_values(given['creep'])
    if 'thermal' in given:
        values |= _thermal_values(given['thermal'])
    if 'flux_density_limits' in given:
        values['flux_density_min'], values['flux_density_max'] = limits_of(
            given['flux_density_limits'])
    if 'slew_limit' in given:
        slew = number(given['slew_limit'], 'slew_limit', 'T/s')
        check_number('slew_limit', slew, 'T/s', above=0.0, endless=True)
        values['slew_limit'] = 0.0 if math.isinf(slew) else slew
    return values


def _law_values(name: Any, constants: Any, modulus_given: bool) -> dict[str, Any]:
    """Return the parameters of a model; a number is accepted for a constant that is a list."""
    check_choice('law', name, LAWS)
    law = LAWS[name]
    constants = mapping_of(constants, 'constants', "'mu': 5e3")
    names = {x.name.partition('.')[2]: x for x in law.constants}
    unknown = [x for x in constants if x not in names]
    if unknown:
        raise BadInputError(
            f'law {name} has no constant {unknown[0]!r}: expected '
            + (', '.join(names) or 'none') + meant(unknown[0], names))
    if modulus_given and law.scaled is not None:
        raise BadInputError(
            f'shear_modulus is given with law {name}, whose constants it follows from: expected '
            f'constants={{...}} of {", ".join(names)} alone')
    values: dict[str, Any] = {LAW_NAME.name: name}
    for key, value in constants.items():
        kind = names[key].kind
        values[names[key].name] = (
            number(value, key, names[key].unit) if kind is float
            else [number(x, key, names[key].unit) for x in several(value)] if kind is list
            else str(value))
    return values


def _creep_values(creep: Any) -> dict[str, Any]:
    """Return the parameters of viscoelastic branches, pairs of stiffness ratio and time."""
    if isinstance(creep, (tuple, list)) and not creep:
        return {}
    ratios, times = columns_of(creep, ('ratio', 'time'), 'branches of creep')
    return {'viscoelastic.ratio': ratios.tolist(), 'viscoelastic.time': times.tolist()}


def _thermal_values(thermal: Any) -> dict[str, Any]:
    """Return the parameters ``thermal.*`` of values by name."""
    known = {x.name.partition('.')[2]: x for x in THERMAL}
    values = {}
    for name, value in mapping_of(thermal, 'thermal coefficients', "'remanence': -1e-3").items():
        check_choice('a thermal coefficient', name, known)
        values[known[name].name] = number(value, f'thermal {name}', known[name].unit)
    return values


def limits_of(limits: Any) -> tuple[float, float]:
    """
    Return the minimum and the maximum flux density in T.

    Raises
    ------
    BadInputError
        If they are no numbers or not in increasing order.

    """
    given = [number(x, 'a flux density limit', 'T') for x in several(limits)]
    if len(given) not in (1, 2):
        raise BadInputError(
            f'limits are {excerpt(limits)}: expected minimum and maximum flux density '
            'in T, or one number for both directions')
    low, high = given if len(given) == 2 else (-given[0], given[0])
    if not low < high:
        raise BadInputError(
            f'flux densities from {low:g} to {high:g} T: expected the minimum below the maximum')
    return low, high


def model_of(
        values: Mapping[str, Any], zeta: float | None = None, ratio: float | None = None,
        mount: Any = _PAPER) -> JointModel:
    """
    Return the planning model of parameters; zeta or a ratio replace the damping coefficient.

    A mount adds the factors and the modes of the actuator as a continuum; ``ratio`` is then the
    damping ratio of the first mode. Raise `BadInputError` if a value is out of range, or the mount
    unknown or one of another actuator.
    """
    if ratio is not None:
        undamped = model_of(values, 0.0).material
        zeta = number(ratio, 'damping_ratio', least=0.0) * float(
            critical_zeta(undamped.rest, undamped))
    if zeta is not None:
        unit = actuator_from(checked(values)).damping_unit
        values = {**values, 'actuator.damping_coefficient': unit * number(
            zeta, 'zeta', least=0.0)}
    model = model_from(checked(values))
    check_choice('mount', mount, MOUNTS)
    return model if mount == _PAPER else JointModel(
        _mounted(model.actuator, mount, ratio), model.options)


def checked(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return all parameters that a plan needs, checked and with defaults."""
    return values_of({f'{PLANNER}.{x}': y for x, y in values.items()}, PLANNER, _SPECS)


def _mounted(actuator: ActuatorParameters, mount: str, ratio: float | None) -> ActuatorParameters:
    """Return an actuator with the modes of its mount; without a ratio, the damping stays."""
    if (actuator.rest == 0.0) is not (mount == CLAMPED):
        form, others = ('beam', [CLAMPED]) if actuator.rest == 0.0 else ('block', _BLOCK)
        raise BadInputError(
            f'mount {mount} is given for a {form}: expected {", ".join([_PAPER, *others])}')
    if actuator.modes.ratios or any(x != 1.0 for x in actuator.factors.values()):
        raise BadInputError(
            f'mount {mount} is given for an actuator that already has modes: expected mount '
            'alone, which computes them')
    return clamped_beam(actuator, ratio) if mount == CLAMPED else _held(actuator, mount, ratio)


def _held(block: ActuatorParameters, mount: str, ratio: float | None) -> ActuatorParameters:
    """Return a block with its modes."""
    from hmsa.model.continuum import mounted  # slow to import

    shape = block.half_thickness / block.half_length
    given = math.inf if block.law is not None else block.chain_limit

    def made(damping_ratio: float) -> ActuatorParameters:
        found = mounted(shape, mount, given, damping_ratio, block.bulk_ratio)
        return replace(
            block, shear_modulus=block.shear_modulus * found.stiffness,
            mass_factor=found.mass_factor, transverse_mass_factor=found.transverse_mass_factor,
            transverse_mass_exponent=found.transverse_mass_exponent, modes=found.modes)

    ratio, coefficient = _damped(made(0.0), ratio)
    return replace(made(ratio), damping_coefficient=coefficient)


def clamped_beam(beam: ActuatorParameters, ratio: float | None = None) -> ActuatorParameters:
    """Return a beam along its elastica, with its second mode."""
    from hmsa.model.continuum import clamped  # slow to import

    made = along_elastica(beam)
    ratio, coefficient = _damped(made, ratio)
    return replace(made, damping_coefficient=coefficient, modes=clamped(ratio))


def _damped(made: ActuatorParameters, ratio: float | None) -> tuple[float, float]:
    """Return damping ratio and coefficient for a given ratio, by default for the coefficient."""
    material = made.nondimensional
    critical = float(critical_zeta(material.rest, material))
    if ratio is None:
        return material.zeta / critical, made.damping_coefficient
    return ratio, ratio * critical * made.damping_unit
