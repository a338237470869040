"""Columns of numbers out of whatever holds them: pairs, arrays, mappings and DataFrames."""

from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np

from hmsa_ros.errors import BadInputError, excerpt
from hmsa_ros.model.equations import Array

#: Other names of a column.
_ALIASES = {'duration': ('span', 'seconds'), 'stretch': ('deflection', 'position')}


def columns_of(value: Any, names: tuple[str, str], what: str) -> tuple[Array, Array]:
    """
    Return two columns of finite numbers, each of shape (n,).

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
        If it is none of these, or a number is not finite.

    """
    expected = (
        f'expected pairs of {names[0]} and {names[1]}, two arrays, or columns of these names')
    if isinstance(value, Mapping) or hasattr(value, 'columns') and hasattr(value, '__getitem__'):
        pair = [_column(value, x, what) for x in names]
    elif isinstance(value, tuple) and len(value) == 2 and all(
            isinstance(x, np.ndarray) for x in value):
        pair = list(value)
    else:
        rows = _numbers(value, what, expected)
        if rows.ndim != 2 or rows.shape[1] != 2:
            raise BadInputError(
                f'{what} have the shape {rows.shape}: {expected}, as in [(1.1, 0.5), (1.0, 0.5)]')
        pair = [rows[:, 0], rows[:, 1]]
    one, other = (np.ascontiguousarray(_numbers(x, what, expected)) for x in pair)
    if one.ndim != 1 or one.shape != other.shape or not len(one):
        raise BadInputError(
            f'{what} have {names[0]} of shape {one.shape} and {names[1]} of shape {other.shape}: '
            'expected two rows of one length, of at least 1')
    return one, other


def _column(value: Any, name: str, what: str) -> Any:
    found = next((x for x in (name, *_ALIASES.get(name, ())) if x in value), None)
    if found is None:
        raise BadInputError(
            f'{what} have the columns {", ".join(map(str, value))}: expected one named {name}')
    return value[found]


def _numbers(value: Any, what: str, expected: str) -> Array:
    try:
        found: Array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadInputError(f'{what} are {excerpt(value)}: {expected}') from error
    return found


def number(value: Any, what: str, unit: str = '') -> float:
    """Return a number, or raise `BadInputError` for what is none."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        raise BadInputError(
            f'{what} is {excerpt(value)}: expected a number' + (f' in {unit}' if unit else ''))
    return float(value)
