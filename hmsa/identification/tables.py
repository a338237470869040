"""Recordings from CSV files, with notes and errors."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmsa.columns import CsvColumns, read_table
from hmsa.errors import BadInputError
from hmsa.identification.measurement import FEWEST, Measurement
from hmsa.model.equations import Array
from hmsa.model.laws.coordinate import Coordinate, STRETCH

# Maximum fraction of rows to leave out.
_MOST_LEFT_OUT = 0.2
# Interval, in median ones, above which a gap is noted.
_GAP = 20.0
# A clock was set back if this many rows are in order on either side of a jump back by this many
# intervals.
_RUN, _OVERTAKEN = 10, 3.0
# Number of levels, relative to samples and at least, above which the column is a measured field.
_MEASURED_FIELD = 0.3
_FEW_LEVELS = 8
# Maximum number of unknown switching times, for speed; of a field that changes at fewer samples
# than the fraction, those after it are left out: taken as measured, they come half an interval
# late, which a longer recording does not make up for.
_MOST_SWITCHES, _SWITCHED = 300, 0.02
# Difference of times, in s, above which clocks started at different times.
_ANOTHER_CLOCK = 1e8
# Units of levels to test, and the improvement of the fit of the motion that shows another unit.
_OTHER_UNITS = {1e3: 'ms', 1e6: 'us', 1e9: 'ns'}
_BETTER = 0.5


def read_levels(path: Path, notes: list[str] | None = None) -> tuple[Array, Array]:
    """
    Read the levels of the field from CSV: times in s and flux densities in T.

    The columns are ``time`` (s) and ``flux_density`` (T); each level applies from its time on.
    ``notes`` are those of `read_table`. Raise `BadInputError` if the file cannot be used.
    """
    table = read_table(path, ('time', 'flux_density'), notes=notes)
    if not len(table.lines):
        raise BadInputError(f'{path} has a header and no row: expected levels')
    times, levels = table.columns['time'], table.columns['flux_density']
    table.check_complete(path, '; a level that is left out would be a wrong one')
    back = np.flatnonzero(np.diff(times) < 0.0)
    if len(back):
        raise BadInputError(
            f'{path} line {table.lines[back[0] + 1]} goes back in time from '
            f'{times[back[0]]:.9g} to {times[back[0] + 1]:.9g} s: expected increasing times')
    # Of levels at the same time the last one applies.
    keep = np.append(np.diff(times) > 0.0, True)
    return times[keep], levels[keep]


def read_csv(
        path: Path, commands: Path | None = None, *, slew_limit: float = math.inf,
        coordinate: Coordinate = STRETCH, rest_length: float | None = None) -> Measurement:
    """
    Read a recording from CSV, with notes on rows that were left out.

    The columns are ``time`` (s) and ``stretch``, and ``flux_density`` (T) unless another file
    contains the levels as ``time`` and ``flux_density``, which apply from that time on. With a
    ``rest_length`` in m, a column of lengths replaces the stretch. Raise `BadInputError` if a file
    cannot be used.
    """
    own = () if commands is not None else ('flux_density',)
    notes: list[str] = []
    table = read_table(
        path, ('time', 'stretch', *own), kind='a CSV or the folder of a bag',
        rest_length=rest_length, notes=notes)
    if not len(table.lines):
        raise BadInputError(f'{path} has a header and no row: expected samples')
    keep = _kept(path, table, notes)
    time, stretch = table.columns['time'][keep], table.columns['stretch'][keep]
    if commands is not None:
        times, levels = read_levels(commands, notes)
        if time[0] - times[-1] > _ANOTHER_CLOCK:
            raise BadInputError(
                f'{commands} ends at {times[-1]:.9g} s, and the first sample of {path} is at '
                f'{time[0]:.9g} s: expected times of one clock, not seconds since a start '
                'beside the time of day')
        if len(time) >= FEWEST:
            _check_units(path, time, stretch, commands, times, levels)
        if times[0] > time[-1]:
            raise BadInputError(
                f'{commands} begins at {times[0]:.9g} s, after the last sample of {path} at '
                f'{time[-1]:.9g} s: expected times of one clock')
        if times[0] > time[0]:
            # The field is zero before the first command.
            times, levels = np.append(time[0], times), np.append(0.0, levels)
            notes.append(f'before the first level at {times[1]:.6g} s the field is taken to be 0')
        earlier = 0.0
    else:
        times, levels, earlier, used = _sampled_levels(
            path, time, table.columns['flux_density'][keep], notes)
        time, stretch = time[:used], stretch[:used]
    # Subtract the first time: seconds since an epoch leave few digits for differences.
    return Measurement(
        time - time[:1], stretch, times - time[:1], levels, slew_limit, earlier, str(path),
        tuple(dict.fromkeys(notes)), coordinate)


def _kept(path: Path, table: CsvColumns, notes: list[str]) -> NDArray[np.int64]:
    """Return the usable rows by time, and note the others; raise `BadInputError` for too many."""
    time, stretch = table.columns['time'], table.columns['stretch']
    places: NDArray[np.int64] = np.flatnonzero(np.isfinite(time) & np.isfinite(stretch))
    lost = len(time) - len(places)
    if lost:
        notes.append(f'{lost} rows without a number were left out')
    places = _ordered(path, table, places, notes)
    steps = np.diff(time[places])
    double = int(np.count_nonzero(steps == 0.0))
    if double:
        places = places[np.append(True, steps > 0.0)]
        notes.append(f'{double} rows with the timestamp of the row before were left out')
    if lost + double > _MOST_LEFT_OUT * len(time):
        raise BadInputError(
            f'{path} has {lost + double} of {len(time)} rows without a number or with the '
            'timestamp of the row before: expected a different timestamp for each sample')
    steps = steps[steps > 0.0]
    if len(steps) and float(np.max(steps)) > _GAP * float(np.median(steps)):
        notes.append(
            f'the timestamps have a gap of {np.max(steps):.3g} s, where the others are '
            f'{np.median(steps):.3g} s apart')
    return places


def _ordered(
        path: Path, table: CsvColumns, places: NDArray[np.int64], notes: list[str]
) -> NDArray[np.int64]:
    """Return rows sorted by time; raise `BadInputError` if a clock was set back."""
    time = table.columns['time'][places]
    steps = np.diff(time)
    back = np.flatnonzero(steps < 0.0)
    if not len(back):
        return places
    # Samples in order before and after, beyond frames that overtook each other.
    runs = np.diff(np.concatenate([[0], back + 1, [len(time)]]))
    usual = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else math.inf
    clock = back[(np.minimum(runs[:-1], runs[1:]) >= _RUN) & (-steps[back] > _OVERTAKEN * usual)]
    if len(clock):
        i, j = places[clock[0]], places[clock[0] + 1]
        raise BadInputError(
            f'{path} line {table.lines[j]} jumps back in time from '
            f'{table.columns["time"][i]:.9g} to {table.columns["time"][j]:.9g} s, between '
            'rows that are in order: expected increasing times of one clock; cut the '
            'file where the clock was set, or, if these are points in any order, sort the rows '
            'by time')
    notes.append(f'the rows were not in the order of time ({len(back)} jumps back): sorted')
    order: NDArray[np.int64] = np.argsort(time, kind='stable')
    return places[order]


def _check_units(
        path: Path, time: Array, stretch: Array, commands: Path, times: Array, levels: Array
) -> None:
    """Raise `BadInputError` if times of samples and of levels have different units."""
    def unexplained(factor: float) -> float:
        # Variance that remains if each level has its own mean.
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
) -> tuple[Array, Array, float, int]:
    """
    Return the levels of a column of the samples, and the uncertainty of their times.

    Also return the number of samples to use.
    """
    good = np.isfinite(field)
    if not np.all(good):
        raise BadInputError(
            f'{path} has {np.count_nonzero(~good)} rows without a flux_density: expected the '
            'field in force at each sample, or its levels in a file of their own (--commands)')
    changed = np.append(True, np.diff(field) != 0.0)
    count, used = int(np.count_nonzero(changed)), len(time)
    if _MOST_SWITCHES < count < _SWITCHED * len(time):
        used = int(np.flatnonzero(changed)[_MOST_SWITCHES])
        notes.append(
            f'the flux density has {count - 1} switches: the first {_MOST_SWITCHES - 1}, up to '
            f'{time[used] - time[0]:.4g} s, are used, since their times are estimated too; give '
            'their true times with --commands to use all samples')
        time, field, changed, count = time[:used], field[:used], changed[:used], _MOST_SWITCHES
    if count > max(_MEASURED_FIELD * len(time), _FEW_LEVELS) or count > _MOST_SWITCHES:
        notes.append(
            f'the flux density changes at {count} of {len(time)} samples: taken as measured, '
            'and as constant from each sample to the next; give the levels with --commands if '
            'they are known')
        return time[changed], field[changed], 0.0, used
    interval = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if count > 1:
        notes.append(
            f'each of {count - 1} switches lies somewhere in the {interval:.3g} s before the '
            'sample that shows it, and is estimated too: give their true times with --commands '
            'for the full accuracy')
    return time[changed], field[changed], interval, used
