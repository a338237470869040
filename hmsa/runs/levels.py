"""Levels of the field: commanded, superseded, repeated, and applied."""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from hmsa.model.equations import Array
from hmsa.model.schedule import CommandSchedule, Superseding
from hmsa.model.units import NANOSECONDS

#: Maximum rounding error of a level by the hardware, relative to the largest.
ROUNDED = 1e-3
#: Maximum clock error of a device in reported timestamps, in ns.
ROUNDED_STAMP = 100_000
# Largest usual difference in ns between the recording of a command and its arrival at a device.
_RECORDED = 20_000_000


@dataclass(frozen=True)
class RecordedLevel:
    """A command, or a change of level in a plan."""

    stamp: int  # start time in ns
    flux_density: float  # in T
    sent: int  # recording time in ns
    stretch: float = math.nan  # predicted at the timestamp; NaN for a command
    rate: float = math.nan  # predicted at the timestamp, in 1/s


def in_force(messages: Iterable[Sequence[RecordedLevel]]) -> tuple[RecordedLevel, ...]:
    """Return the remaining levels; each message replaces all at or after its first timestamp."""
    levels: Superseding[RecordedLevel] = Superseding()
    for message in messages:
        for level in sorted(message, key=lambda x: x.stamp):
            levels.put(level.stamp, level)
    return tuple(levels)


def held_at(levels: Sequence[RecordedLevel], stamps: NDArray[np.int64]) -> Array:
    """Return the level in T at timestamps in ns, for levels by time; NaN before the first."""
    place = np.searchsorted([x.stamp for x in levels], stamps, side='right')
    return np.array([math.nan, *(x.flux_density for x in levels)])[place]


def without_repeats(commands: Sequence[RecordedLevel]) -> tuple[tuple[RecordedLevel, ...], int]:
    """Return the commands that change the level, and the number of those that do not."""
    schedule = CommandSchedule(math.nan)
    kept = tuple(x for x in commands if schedule.insert(x.stamp, x.flux_density))
    return kept, len(commands) - len(kept)


def came_too_late(
        commands: Sequence[RecordedLevel], applied: Sequence[RecordedLevel] | None,
        limit: float) -> list[bool]:
    """
    Return for each command whether it came later than a limit in s, and was rejected.

    ``applied`` contains the reported levels, None if there are no reports. A command that took
    effect was not rejected, although the recorder may have received it late.
    """
    if applied is None:
        return [x.sent - x.stamp > limit * NANOSECONDS for x in commands]
    known = _ByLevel(applied, _rounding(commands))
    return [
        x.sent - x.stamp > limit * NANOSECONDS - _RECORDED
        and known.first(x, x.stamp - ROUNDED_STAMP, x.sent + _RECORDED + 1) is None
        for x in commands]


def lateness_of(
        commands: Sequence[RecordedLevel], applied: Sequence[RecordedLevel],
        last: int) -> tuple[Array, int]:
    """
    Return the lateness of each command, and the number of commands that never took effect.

    The lateness is in s, for each command from `without_repeats`: NaN for one that never took
    effect, empty if changes were not reported. The number counts changes of level that were due
    before ``last`` (ns), were not replaced, and never took effect. One that came late, when the
    next one was due, too, was replaced by that; its lateness is infinite.
    """
    if not applied:
        return np.empty(0), 0
    result = np.full(len(commands), np.nan)
    unapplied = 0
    # Commands that were replaced before their time never took effect.
    standing = in_force((x,) for x in commands)
    places = {x: i for i, x in enumerate(commands)}
    rounding = _rounding(commands)
    taken, changes = _ByLevel(applied, rounding), _ByLevel(standing, rounding)
    # The level when the first command was due; reported levels may be older.
    begin = standing[0].stamp if standing else 0
    before: RecordedLevel | None = max(
        (x for x in applied if x.stamp <= begin), key=lambda x: x.stamp,
        default=min(applied, key=lambda x: x.stamp))
    for i, command in enumerate(standing):
        until = changes.first(command, command.stamp + 1)
        when = taken.first(
            command, command.stamp - ROUNDED_STAMP,
            math.inf if until is None else until - ROUNDED_STAMP)
        following = standing[i + 1] if i + 1 < len(standing) else None
        if when is not None:
            result[places[command]] = (when - command.stamp) / NANOSECONDS
        elif command.stamp < last and not (
                before and abs(before.flux_density - command.flux_density) <= rounding):
            if following and command.sent > following.stamp and (
                    taken.first(following, following.stamp) is not None):
                result[places[command]] = math.inf
            else:
                unapplied += 1
        before = command
    return result, unapplied


def _rounding(commands: Sequence[RecordedLevel]) -> float:
    """Return the difference in T by which the hardware may round a level."""
    return ROUNDED * max((abs(x.flux_density) for x in commands), default=0.0)


class _ByLevel:
    """Levels to be found by level, up to ``rounding`` in T, and time: a path has thousands."""

    def __init__(self, levels: Iterable[RecordedLevel], rounding: float) -> None:
        self._rounding = rounding
        self._cells: defaultdict[int, list[tuple[int, float]]] = defaultdict(list)
        for x in sorted(levels, key=lambda x: x.stamp):
            if math.isfinite(x.flux_density):
                self._cells[self._cell(x.flux_density)].append((x.stamp, x.flux_density))

    def _cell(self, level: float) -> int:
        return math.floor(level / self._rounding) if self._rounding else int(level != 0.0)

    def first(self, like: RecordedLevel, since: int, until: float = math.inf) -> int | None:
        """Return the first timestamp from ``since`` and before ``until`` of the same level."""
        cell, found = self._cell(like.flux_density), until
        for near in (cell - 1, cell, cell + 1):
            rows = self._cells.get(near, [])
            for place in range(bisect_left(rows, (since,)), len(rows)):
                stamp, level = rows[place]
                if stamp >= found:
                    break
                if abs(level - like.flux_density) <= self._rounding:
                    found = stamp
                    break
        return None if found == until else int(found)
