"""Arguments of the public functions, checked: numbers, columns of them, laws, branches, limits."""

from collections.abc import Mapping
import math
from numbers import Real
import os
from pathlib import Path
from typing import Any

import numpy as np

from hmsa_ros.errors import BadInputError, excerpt
from hmsa_ros.interfaces.parameters import ACTUATOR, LAW_NAME
from hmsa_ros.model.creep import Creep
from hmsa_ros.model.equations import Array
from hmsa_ros.model.laws import LAWS
from hmsa_ros.model.moves import Limits
from hmsa_ros.planning.setpoint import impossible

#: Parameters of a block by their names without the group, with their defaults.
DEFAULTS = {x.name.partition('.')[2]: x.default for x in ACTUATOR}

# Period of a grid in s, below which commands have any time.
_FINEST = 1e-9
#: Other names of a column.
_ALIASES = {'duration': ('span', 'seconds'), 'stretch': ('deflection', 'position')}


def columns_of(value: Any, names: tuple[str, str], what: str) -> tuple[Array, Array]:
    """
    Return two columns of numbers, each of shape (n,).

    Parameters
    ----------
    value : pairs, tuple of two arrays, array of shape (n, 2), mapping or DataFrame
        The numbers; a mapping has the columns by name.
    names : tuple of str
        Of the columns.
    what : str
        What they are, for messages.

    Returns
    -------
    tuple of ndarray
        Both columns.

    Raises
    ------
    BadInputError
        If it is none of these.

    """
    expected = (
        f'expected pairs of {names[0]} and {names[1]}, two arrays, or columns of these names')
    if isinstance(value, Mapping) or hasattr(value, 'columns') and hasattr(value, '__getitem__'):
        pair = [_column(value, x, what) for x in names]
    elif isinstance(value, tuple) and len(value) == 2 and all(
            isinstance(x, np.ndarray) for x in value):
        pair = list(value)
    else:
        rows = numbers(value, what, expected)
        if rows.ndim != 2 or rows.shape[1] != 2:
            raise BadInputError(
                f'{what} have the shape {rows.shape}: {expected}, as in '
                f'[({", ".join(names)}), ({", ".join(names)})]')
        pair = [rows[:, 0], rows[:, 1]]
    one, other = (np.ascontiguousarray(numbers(x, what, expected)) for x in pair)
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
        If they are none, no actuator with such a rest has a stretch, or a duration is not above 0,
        or endless before the last.

    """
    stretches, durations = columns_of(value, ('stretch', 'duration'), 'setpoints')
    for stretch, duration in zip(stretches.tolist(), durations.tolist(), strict=True):
        if reason := impossible(stretch, rest):
            raise BadInputError(reason)
        if not duration > 0.0:
            raise BadInputError(f'duration is {duration:g} s: expected a number greater than 0')
    if np.any(np.isinf(durations[:-1])):
        raise BadInputError('duration is inf s: only that of the last setpoint may be')
    return stretches, durations


def file_of(value: Any, what: str = 'the path of a file') -> Path:
    """Return a path, or raise `BadInputError`."""
    if not isinstance(value, (str, os.PathLike)) or '\0' in os.fsdecode(value):
        raise BadInputError(f'path is {excerpt(value)}: expected {what}')
    return Path(value)


def grid_of(period: Any) -> float:
    """Return the period of a grid in s, 0 for any time, or raise `BadInputError`."""
    if 0.0 < number(period, 'period', 's', least=0.0) < _FINEST:
        raise BadInputError(
            f'period is {period:g} s: expected 0 for any time, or at least {_FINEST:g} s')
    return float(period)


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
    """Return a whole number of at least one, or raise `BadInputError`."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise BadInputError(
            f'{what} is {excerpt(value)}: expected a whole number'
            + (f' of at least {least:g}' if least > -math.inf else ''))
    return int(value)


def _column(value: Any, name: str, what: str) -> Any:
    found = next((x for x in (name, *_ALIASES.get(name, ())) if x in value), None)
    if found is None:
        raise BadInputError(
            f'{what} have the columns {", ".join(map(str, value))}: expected one named {name}')
    return value[found]


def numbers(value: Any, what: str, expected: str = 'expected numbers') -> Array:
    """Return numbers of any shape, or raise `BadInputError`."""
    try:
        if np.iscomplexobj(value):
            raise TypeError  # NumPy would drop the imaginary parts
        found: Array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInputError(f'{what} are {excerpt(value)}: {expected}') from error
    return found


def number(
        value: Any, what: str, unit: str = '', *, least: float = -math.inf,
        above: float = -math.inf, most: float = math.inf) -> float:
    """
    Return a number of at least one, above another and at most a third.

    Raises
    ------
    BadInputError
        If it is none, out of range, or with a bound from below not finite.

    """
    units = f' {unit}' if unit else ''
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        raise BadInputError(
            f'{what} is {excerpt(value)}: expected a number' + (f' in {unit}' if unit else ''))
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    bounded = least > -math.inf or above > -math.inf
    if bounded and not (least <= found and above < found <= most and found < math.inf):
        raise BadInputError(
            f'{what} is {found:g}{units}: expected a finite number '
            + (f'of at least {least:g}' if least > -math.inf else f'above {above:g}')
            + (f' and at most {most:g}' if most < math.inf else '') + units)
    return found


def law_values(
        name: Any, constants: Any, modulus: float | None) -> dict[str, Any]:
    """
    Return the parameters of a law; a constant of several values may be one number.

    Raises
    ------
    BadInputError
        If there is no such law or constant, or a constant is of another type.

    """
    if not isinstance(name, str) or name not in LAWS:
        raise BadInputError(f'law is {excerpt(name)}: expected one of {", ".join(LAWS)}')
    law = LAWS[name]
    constants = mapping_of(constants, 'constants', "'mu': 5e3")
    names = {x.name.partition('.')[2]: x for x in law.constants}
    unknown = [x for x in constants if x not in names]
    if unknown:
        raise BadInputError(
            f'law {name} has no constant {unknown[0]!r}: expected '
            + (', '.join(names) or 'none'))
    owns = law.scaled is not None and law.own_modulus
    if owns and modulus is not None:
        raise BadInputError(
            f'shear_modulus is given with law {name}, whose constants it follows from: expected '
            f'constants={{...}} of {", ".join(names)} alone')
    values: dict[str, Any] = {LAW_NAME.name: name}
    for key, value in constants.items():
        kind = names[key].kind
        values[names[key].name] = (
            number(value, key, names[key].unit) if kind is float
            else str(value) if kind is not list else [
                number(x, key) for x in (
                    value if np.iterable(value) and not isinstance(value, str) else [value])])
    if not owns:
        values['actuator.shear_modulus'] = number(
            DEFAULTS['shear_modulus'] if modulus is None else modulus, 'shear_modulus', 'Pa')
    return values


def creep_values(creep: Any) -> dict[str, Any]:
    """Return the parameters of branches, pairs of ratio and time unless they are `Creep`."""
    if isinstance(creep, Creep):
        return creep.parameters
    if isinstance(creep, (tuple, list)) and not creep:
        return {}
    ratios, times = columns_of(creep, ('ratio', 'time'), 'branches of creep')
    return {'viscoelastic.ratio': ratios.tolist(), 'viscoelastic.time': times.tolist()}


def limits_of(limits: Any) -> tuple[float, float]:
    """
    Return the least and the largest flux density in T.

    Raises
    ------
    BadInputError
        If they are no numbers or not in this order.

    """
    if isinstance(limits, Limits):
        raise BadInputError('limits are without a dimension: expected flux densities in T')
    if isinstance(limits, (tuple, list)) or np.ndim(limits):
        if len(limits) != 2:
            raise BadInputError(
                f'limits are {excerpt(limits)}: expected the least and the largest flux density '
                'in T, or one number for both directions')
        low, high = (number(x, 'a flux density limit', 'T') for x in limits)
    else:
        high = number(limits, 'flux density limit', 'T')
        low = -high
    if not low < high:
        raise BadInputError(
            f'flux densities from {low:g} to {high:g} T: expected the least below the largest')
    return low, high
