"""Joint states as columns: reading, selection of a joint, sorting."""

from array import array
from collections import defaultdict
from itertools import chain
from typing import Any

import numpy as np

from hmsa.errors import BadInputError, meant
from hmsa.interfaces.parameters import JOINT
from hmsa.model.units import NANOSECONDS

#: Maximum step back in time, in ns, due to samples that overtake one another; more is a clock.
CLOCK_JUMP = 100_000_000
# Distance of a timestamp from the others, in ns, above which the sample is invalid.
_FAR = 30 * 86_400 * NANOSECONDS
# Larger values are not a motion of a block and cannot be plotted; the rate is in 1/s.
_LARGEST_STRETCH, _LARGEST_RATE = 1e6, 1e12

#: Columns of a run by name, of shape (n,); see `hmsa.runs.record.Run`.
Columns = dict[str, Any]
_COLUMNS = ('logged', 'time', 'stretch', 'rate', 'flux_density')


def nanoseconds_of(stamp: Any) -> int:
    """Return a timestamp or a duration in ns."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


# Names, and numbers of positions, velocities and efforts.
_Shape = tuple[tuple[str, ...], int, int, int]


class SampleColumns:
    """Columns of joint states with any joints and shapes."""

    def __init__(self) -> None:
        # Recording times and timestamps, and the values, row by row.
        self._columns: defaultdict[_Shape, tuple[array[int], array[float]]] = defaultdict(
            lambda: (array('q'), array('d')))

    def take(self, logged: int, message: Any) -> None:
        """Add a sample."""
        numbers = [tuple(x) for x in (message.position, message.velocity, message.effort)]
        position, velocity, effort = map(len, numbers)
        # Convert both first, so that an error leaves no partial row.
        times = array('q', (logged, nanoseconds_of(message.header.stamp)))
        row = array('d', chain.from_iterable(numbers))
        kept = self._columns[tuple(message.name), position, velocity, effort]
        kept[0].extend(times)
        kept[1].extend(row)

    @property
    def names(self) -> set[str]:
        """Names of joints in the samples."""
        return {x for shape in self._columns for x in shape[0]}

    def columns(
            self, where: str, joint: str, *, required: bool) -> tuple[Columns, list[str], int]:
        """
        Return a joint's sorted samples, notes for the reader, and the number of rejected samples.

        Unless ``required``, another joint may be used. Raise `BadInputError` if there is no such
        joint, or none of its samples can be used; ``where`` names the source.
        """
        if not self._columns:
            raise BadInputError(
                f'{where} contains no usable message: expected samples of the actuator')
        joint = self._joint(where, joint, required)
        parts = []
        total = 0
        for (names, *widths), (stamps, rows) in self._columns.items():
            place = names.index(joint) if joint in names else 0
            times = np.array(stamps).reshape(-1, 2)
            total += len(times)
            if names and joint not in names or place >= widths[0]:
                continue
            numbers = np.array(rows).reshape(len(times), -1)
            picked = [
                numbers[:, sum(widths[:i]) + place] if place < width
                else np.full(len(times), np.nan) for i, width in enumerate(widths)]
            parts.append((times[:, 0], times[:, 1], *picked))
        if not parts:
            raise BadInputError(
                f'{where} contains no position of joint {joint!r}: expected the stretch, '
                'or the deflection of a beam')
        found = dict(zip(
            _COLUMNS, map(np.concatenate, zip(*parts, strict=True)), strict=True))
        left_out = total - len(found['logged'])
        found, notes, more = _tidy(
            where, _rows(found, np.argsort(found['logged'], kind='stable')))
        return found, notes, left_out + more

    def _joint(self, where: str, joint: str, required: bool) -> str:
        names = self.names
        if joint in names or not names:
            return joint
        if required:
            raise BadInputError(
                f'{where} has no joint {joint!r}: expected one of {", ".join(sorted(names))}'
                + meant(joint, names))
        if JOINT.default in names:
            return str(JOINT.default)
        if len(names) == 1:
            return names.pop()
        raise BadInputError(
            f'{where} has the joints {", ".join(sorted(names))}: expected one; name it with '
            '--joint')


def _rows(columns: Columns, rows: Any) -> Columns:
    """Return some rows of all columns."""
    return {name: x[rows] for name, x in columns.items()}


def _tidy(where: str, columns: Columns) -> tuple[Columns, list[str], int]:
    """Reject impossible samples, sort by timestamp and complete the rate; see `columns`."""
    notes = []
    if not columns['time'].any():
        columns['time'] = columns['logged'].copy()
        notes.append('The samples have no timestamps: the receive times are used.')
    stamps = columns['time']
    near = np.abs(stamps - np.sort(stamps)[len(stamps) // 2]) < _FAR
    good = near & (np.abs(columns['stretch']) < _LARGEST_STRETCH)
    far, odd = len(near) - int(np.count_nonzero(near)), int(np.count_nonzero(near & ~good))
    if far:
        notes.append(
            f'{far} samples are stamped more than 30 days away from the others: left out.')
    if odd:
        notes.append(
            f'{odd} samples are not finite numbers, or beyond {_LARGEST_STRETCH:g}: left out.')
    if not np.any(good):
        raise BadInputError(
            f'{where} contains no finite position: expected the stretch as a number')
    columns = _rows(columns, good)
    if np.any(np.diff(columns['time']) < -CLOCK_JUMP):
        notes.append(
            'The timestamps of the samples jump back: the samples are sorted by timestamp. Was '
            'the clock reset in the run?')
    # Of samples with equal timestamps use the first, so that time increases.
    columns = _rows(columns, np.unique(columns['time'], return_index=True)[1])
    stamps, stretch, rate = columns['time'], columns['stretch'], columns['rate']
    missing = ~(np.abs(rate) < _LARGEST_RATE)
    if np.any(missing):
        which = 'Stretch rates' if np.all(missing) \
            else f'{np.count_nonzero(missing)} stretch rates'
        notes.append(f'{which} were not recorded: they are differences of the stretch.')
        slope = np.gradient(stretch, (stamps - stamps[0]) / NANOSECONDS) \
            if len(stamps) > 1 else np.zeros_like(stretch)
        columns['rate'] = np.where(missing, slope, rate)
    return columns, notes, far + odd
