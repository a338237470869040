"""Recordings out of CSV files, with what is wrong in them said."""

import csv
from dataclasses import dataclass
import io
import math
from pathlib import Path
import re

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.core.model import Array
from hmsa_ros.errors import BadInputError, excerpt
from hmsa_ros.identification.recording import Recording

_SEPARATORS = (';', '\t', ',', '|')
_LARGEST_FILE = 512 * 1024 * 1024
_UNITS = {
    'time': {'s': 1.0, 'sec': 1.0, 'seconds': 1.0, 'ms': 1e-3, 'us': 1e-6, 'µs': 1e-6,
             'ns': 1e-9},
    'stretch': {'1': 1.0, '-': 1.0, '': 1.0},
    'flux_density': {'t': 1.0, 'tesla': 1.0, 'mt': 1e-3, 'g': 1e-4, 'gauss': 1e-4},
}
_ALIASES = {
    't': 'time', 'stamp': 'time', 'timestamp': 'time', 'lambda': 'stretch',
    'position': 'stretch', 'b': 'flux_density', 'flux': 'flux_density', 'field': 'flux_density',
    'effort': 'flux_density'}
_HEADER = re.compile(r'\s*([A-Za-z_µ ]+?)\s*(?:[\[(/]\s*([^\])]*?)\s*[\])]?)?\s*')
# Of what is left out: more than this is not a few bad rows.
_MOST_LEFT_OUT = 0.2
# A jump of the stamps this many intervals long is said; a level for nearly every sample is a
# measured field.
_GAP = 20.0
_MEASURED_FIELD = 0.3
_FEW_LEVELS = 8
# More unknown times of switches than this take too long.
_MOST_SWITCHES = 300
# Levels whose times fit the motion so much better in another unit are in that unit.
_OTHER_UNITS = {1e3: 'ms', 1e6: 'us', 1e9: 'ns'}
_BETTER = 0.5


@dataclass(frozen=True, eq=False)
class Table:
    """
    Columns of a CSV file.

    Attributes
    ----------
    columns : dict of str to ndarray
        By name, in SI; NaN where a cell was empty or no number.
    lines : ndarray
        Number of each row's line.
    notes : tuple of str
        What was converted.

    """

    columns: dict[str, Array]
    lines: Array
    notes: tuple[str, ...]


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise BadInputError(
                f'{path} has {path.stat().st_size} bytes: expected a CSV of at most '
                f'{_LARGEST_FILE}')
        return path.read_text(encoding='utf-8-sig')
    except UnicodeDecodeError as error:
        raise BadInputError(f'{path} is no text: expected a CSV or the folder of a bag') from error
    except OSError as error:
        raise BadInputError(
            f'{path} cannot be read ({error.strerror or error}): expected a CSV or the folder of '
            'a bag') from error


def read_table(path: Path, wanted: tuple[str, ...], optional: tuple[str, ...] = ()) -> Table:
    """
    Read columns of a CSV file.

    Separators are found out; so are units behind a name, as in ``flux_density [mT]``.

    Parameters
    ----------
    path : Path
        The file.
    wanted, optional : tuple of str
        Names of columns.

    Returns
    -------
    Table
        In SI.

    Raises
    ------
    BadInputError
        If the file cannot be read, has no header, or a column is missing.

    """
    rows = [(i, x) for i, x in enumerate(_text(path).splitlines(), 1)
            if x.strip() and not x.lstrip().startswith('#')]
    if not rows:
        raise BadInputError(f'{path} is empty: expected a header and rows of numbers')
    head = rows[0][1]
    separator = next((x for x in _SEPARATORS if x in head), None)
    cells = _split(head, separator)
    if all(_number(x, separator) is not None for x in cells):
        raise BadInputError(
            f'{path} begins with numbers ({excerpt(head)}): expected a header with the columns '
            f'{", ".join(wanted)} in line {rows[0][0]}')
    places, notes = _places(path, cells, (*wanted, *optional))
    missing = [x for x in wanted if x not in places]
    if missing:
        raise BadInputError(
            f'{path} has no column {" and no column ".join(missing)}: expected '
            f'{", ".join(wanted)}; its columns are {excerpt(", ".join(cells))}'
            + ('; stretch is strain plus 1' if 'stretch' in missing
               and any('strain' in x.lower() for x in cells) else ''))
    columns: dict[str, Array] = {name: np.full(len(rows) - 1, np.nan) for name in places}
    for i, (line, text) in enumerate(rows[1:]):
        parts = _split(text, separator)
        if any(parts[len(cells):]):
            raise BadInputError(
                f'{path} line {line} has {len(parts)} cells in {len(cells)} columns '
                f'({excerpt(text)}): expected a number a column{_decimal_commas(separator)}')
        for name, (place, factor) in places.items():
            if place >= len(parts):
                continue
            value = _number(parts[place], separator)
            if value is None:
                raise BadInputError(
                    f'{path} line {line} has {excerpt(parts[place])} in column {name}: expected '
                    f'a number{_decimal_commas(separator) if "," in parts[place] else ""}')
            columns[name][i] = value * factor
    return Table(columns, np.array([x[0] for x in rows[1:]]), tuple(notes))


def _decimal_commas(separator: str | None) -> str:
    return ('; numbers with decimal commas need semicolons between the columns'
            if separator == ',' else '')


def _split(text: str, separator: str | None) -> list[str]:
    if separator is None:
        return text.split()
    return [x.strip() for x in next(csv.reader(io.StringIO(text), delimiter=separator))]


def _number(text: str, separator: str | None) -> float | None:
    """Return the number in a cell, NaN for an empty one; None for what is none."""
    if text.lower() in ('', 'nan', 'na', 'n/a', 'null', 'none'):
        return math.nan
    try:
        return float(text.replace(',', '.') if separator != ',' else text)
    except ValueError:
        return None


def _places(
        path: Path, cells: list[str], names: tuple[str, ...]
) -> tuple[dict[str, tuple[int, float]], list[str]]:
    """Return place and factor of each column that is known, and notes."""
    places: dict[str, tuple[int, float]] = {}
    notes = []
    for place, cell in enumerate(cells):
        match = _HEADER.fullmatch(cell)
        if match is None:
            continue
        name = '_'.join(match[1].lower().split())
        unit = (match[2] or '').strip().lower()
        for suffix in ('ms', 'us', 'mt', 'mm', 's', 't'):
            stem = name.removesuffix(f'_{suffix}')
            if not unit and stem != name and _ALIASES.get(stem, stem) in names:
                name, unit = stem, suffix
        name = _ALIASES.get(name, name)
        if name not in names or name in places:
            continue
        known = _UNITS[name]
        default = {'time': 's', 'stretch': '', 'flux_density': 't'}[name]
        if (unit or default) not in known:
            raise BadInputError(
                f'{path} gives {name} in {unit}: expected '
                + ('no unit: divide a length by the length at rest, percent by 100'
                   if name == 'stretch' else ', '.join(known)))
        factor = known[unit or default]
        if factor != 1.0:
            notes.append(f'{name} was converted from {unit} as the header says')
        places[name] = place, factor
    return places, notes


def read_levels(path: Path) -> tuple[Array, Array, tuple[str, ...]]:
    """
    Read the levels of the field from CSV.

    Parameters
    ----------
    path : Path
        With the columns ``time`` (s) and ``flux_density`` (T).

    Returns
    -------
    times, levels : ndarray, shape (m,)
        Flux density in T from each time in s on, increasing.
    notes : tuple of str
        What was converted.

    Raises
    ------
    BadInputError
        If it cannot be used.

    """
    table = read_table(path, ('time', 'flux_density'))
    if not len(table.lines):
        raise BadInputError(f'{path} has a header and no row: expected levels')
    times, levels = table.columns['time'], table.columns['flux_density']
    bad = ~(np.isfinite(times) & np.isfinite(levels))
    if np.any(bad):
        raise BadInputError(
            f'{path} line {table.lines[np.argmax(bad)]} has no number for time or '
            'flux_density: expected both in every line; a level that is left out would be a '
            'wrong one')
    back = np.flatnonzero(np.diff(times) < 0.0)
    if len(back):
        raise BadInputError(
            f'{path} line {table.lines[back[0] + 1]} goes back in time from '
            f'{times[back[0]]:.9g} to {times[back[0] + 1]:.9g} s: expected increasing times')
    # Of levels at one time the last one holds.
    keep = np.append(np.diff(times) > 0.0, True)
    return times[keep], levels[keep], table.notes


def read_csv(
        path: Path, commands: Path | None = None, *, slew_limit: float = math.inf) -> Recording:
    """
    Read a recording from CSV.

    Parameters
    ----------
    path : Path
        With the columns ``time`` (s) and ``stretch``, and ``flux_density`` (T) where there is
        no other file with the levels.
    commands : Path, optional
        With ``time`` and ``flux_density``: the level in force from that time on.
    slew_limit : float
        Rate in T/s at which the amplifier ramps.

    Returns
    -------
    Recording
        With notes on what was left out.

    Raises
    ------
    BadInputError
        If it cannot be used: a sentence that says what, got and expected.

    """
    own = () if commands is not None else ('flux_density',)
    table = read_table(path, ('time', 'stretch', *own))
    notes = list(table.notes)
    if not len(table.lines):
        raise BadInputError(f'{path} has a header and no row: expected samples')
    keep = _kept(path, table, notes)
    time, stretch = table.columns['time'][keep], table.columns['stretch'][keep]
    if commands is not None:
        times, levels, more = read_levels(commands)
        notes += more
        _check_units(path, time, stretch, commands, times, levels)
        if times[0] > time[-1]:
            raise BadInputError(
                f'{commands} begins at {times[0]:.9g} s, after the last sample of {path} at '
                f'{time[-1]:.9g} s: expected times of one clock')
        if times[0] > time[0]:
            # As a coil is before anybody commands it.
            times, levels = np.append(time[0], times), np.append(0.0, levels)
            notes.append(f'before the first level at {times[1]:.6g} s the field is taken to be 0')
        earlier = 0.0
    else:
        times, levels, earlier = _sampled_levels(
            path, time, table.columns['flux_density'][keep], notes)
    # From the first sample on: seconds of an epoch leave no digits for what happens between.
    return Recording(
        time - time[:1], stretch, times - time[:1], levels, slew_limit, earlier, str(path),
        tuple(notes))


def _kept(path: Path, table: Table, notes: list[str]) -> NDArray[np.bool_]:
    """Return which rows can be used, and note the others; refuse a file with too many."""
    time, stretch = table.columns['time'], table.columns['stretch']
    keep: NDArray[np.bool_] = np.isfinite(time) & np.isfinite(stretch)
    lost = int(np.count_nonzero(~keep))
    if lost:
        notes.append(f'{lost} rows without a number were left out')
    places = np.flatnonzero(keep)
    steps = np.diff(time[places])
    back = np.flatnonzero(steps < 0.0)
    if len(back):
        i, j = places[back[0]], places[back[0] + 1]
        raise BadInputError(
            f'{path} line {table.lines[j]} jumps back in time from {time[i]:.9g} to '
            f'{time[j]:.9g} s, {len(back)} times in all: expected increasing times of one clock; '
            'sort the rows by time, or cut the file where the clock was set')
    double = places[1:][steps == 0.0]
    if len(double):
        keep[double] = False
        notes.append(f'{len(double)} rows with the stamp of the row before were left out')
    left_out = lost + len(double)
    if left_out > _MOST_LEFT_OUT * len(time):
        raise BadInputError(
            f'{path} has {left_out} of {len(time)} rows without a number or with the stamp of '
            'the row before: expected a stamp of its own for each sample')
    steps = steps[steps > 0.0]
    if len(steps) and float(np.max(steps)) > _GAP * float(np.median(steps)):
        notes.append(
            f'the stamps have a gap of {np.max(steps):.3g} s, where the others are '
            f'{np.median(steps):.3g} s apart')
    return keep


def _check_units(
        path: Path, time: Array, stretch: Array, commands: Path, times: Array, levels: Array
) -> None:
    """Refuse times of samples and of levels that are in different units."""
    def unexplained(factor: float) -> float:
        # How much of the motion is left when each level has a mean of its own.
        place = np.searchsorted(factor * times, time, side='right') - 1
        _, group = np.unique(np.where(place < 0, 0.0, levels[place]), return_inverse=True)
        mean = np.bincount(group, stretch) / np.bincount(group)
        return float(np.sum((stretch - mean[group]) ** 2))

    least = _BETTER * unexplained(1.0)
    for factor, unit in _OTHER_UNITS.items():
        for finer, wrong in ((factor, path), (1.0 / factor, commands)):
            if unexplained(finer) < least:
                raise BadInputError(
                    f'{path} has samples from {time[0]:.6g} to {time[-1]:.6g} s and {commands} '
                    f'levels from {times[0]:.6g} to {times[-1]:.6g} s: expected both in s, but '
                    f'the motion follows the levels as if the times of {wrong} were in {unit}; '
                    f'if they are, write "time [{unit}]" in its header')


def _sampled_levels(
        path: Path, time: Array, field: Array, notes: list[str]
) -> tuple[Array, Array, float]:
    """Return the levels of a column beside the samples, and how much earlier they may be."""
    good = np.isfinite(field)
    if not np.all(good):
        raise BadInputError(
            f'{path} has {np.count_nonzero(~good)} rows without a flux_density: expected the '
            'field in force at each sample, or its levels in a file of their own (--commands)')
    changed = np.append(True, np.diff(field) != 0.0)
    count = int(np.count_nonzero(changed))
    if count > max(_MEASURED_FIELD * len(time), _FEW_LEVELS) or count > _MOST_SWITCHES:
        notes.append(
            f'the flux density changes at {count} of {len(time)} samples: taken as measured, '
            'and as constant from each sample to the next; give the levels with --commands if '
            'they are known')
        return time[changed], field[changed], 0.0
    interval = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if count > 1:
        notes.append(
            f'each of {count - 1} switches lies somewhere in the {interval:.3g} s before the '
            'sample that shows it, and is estimated too: give their true times with --commands '
            'for the full accuracy')
    return time[changed], field[changed], interval
