"""Checks of the arguments of public functions: numbers, columns and actuator parameters."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
import inspect
import math
from numbers import Real
import os
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np

from hmsa.errors import BadInputError, check_number, excerpt, meant
from hmsa.model.equations import Array
from hmsa.model.moves import check_target

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
