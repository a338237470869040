"""Record of the levels that took effect, and its merge into the levels of a plan."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, chain
import math
from typing import Any, overload

from hmsa.planning.timeline import PlannedLevel, Timeline

# Tolerance within which a prediction agrees with the planned one, so that the rest of the plan
# remains valid: rounding timestamps by half a nanosecond changes the stretch by about 1e-8 at full
# speed. The rate is relative to the natural frequency.
_AS_PLANNED = 3e-8
# Levels that differ by less than this fraction of the largest one are equal for the hardware,
# which rounds: a few steps of a 14-bit converter.
_RESOLUTION = 2e-4
# Levels of a plan from which on it is edited in pieces, and of a piece: to copy 60,000 levels at
# each report of hardware that rounds takes 1.6 ms, longer than a level lasts.
_MANY, _PIECE = 4096, 512


@dataclass(frozen=True)
class Deviation:
    """Difference between the level that took effect and the plan."""

    late: int = 0  #: ns by which a change was late; negative if early
    lost: int = 0  #: earlier planned changes that never took effect
    foreign: bool = False  #: whether the level was not planned
    asked: float | None = None  #: level in T that the coil did not reach; None if it did
    change: float = field(default=0.0, compare=False)  #: of the level in T
    #: Unplanned amplitude of stretch, beyond that of the expected lateness.
    effect: float = field(default=0.0, compare=False)

    def beyond(self, tolerance: int) -> bool:
        """Return whether it is more than a change that is late within the tolerance in ns."""
        return bool(
            self.foreign or self.lost or self.asked is not None or abs(self.late) > tolerance)


@dataclass(frozen=True)
class History:
    """A plan, and the part of it that has happened."""

    plan: Timeline
    sent: int = 1  #: number of levels sent, from the first on; at least 1
    known: int = 0  #: index of the last level known to have taken effect
    #: Index of the first level, not sent yet, whose prediction is no longer valid.
    stale: int | None = None

    @property
    def levels(self) -> Sequence[PlannedLevel]:
        """The levels of the plan."""
        return self.plan.levels

    def _with(
            self, start: int, end: int, levels: Sequence[PlannedLevel], **known: Any) -> 'History':
        """Return the history with other levels in place of some."""
        plan = replace(self.plan, levels=_edited(self.levels, start, end, levels))
        return replace(self, plan=plan, **known)

    def unheard(self, now: int, lost: int) -> int:
        """
        Count the levels after the last known one that never took effect.

        ``now`` is the time in ns up to which changes are known. Levels before a time ``lost``
        cannot take effect any more.
        """
        # Only changes are reported. Commands that arrive so late that they apply all at once cause
        # no change if the last of them equals the present level: those before it never applied.
        levels, first = self.levels, self.known + 1
        for i in reversed(range(first, self.sent)):
            if (levels[i].stamp <= now
                    and (levels[i].stamp <= lost or self.near(
                        levels[i].flux_density, levels[self.known].flux_density))
                    and self._changes(range(first, i + 1))):
                return i + 1 - first
        return 0

    @property
    def awaiting_change(self) -> bool:
        """Whether a change of level that was sent has not been reported yet."""
        return self._changes(range(self.known + 1, self.sent)) > 0

    def without(self, start: int, end: int) -> 'History':
        """Return the history without levels ``start`` to ``end``, which never took effect."""
        sent = self.sent - max(min(self.sent, end) - start, 0)
        return self._with(
            start, end, (), sent=sent,
            stale=start if self.stale is None else min(self.stale, start))

    def with_news(
            self, stamp: int, flux_density: float,
            tolerance: int) -> tuple['History', Deviation | None]:
        """Return the history with a level (T) in effect from a time (ns), and its deviation."""
        # Changes take effect in the order of sending. Levels before the reported one have already
        # been in effect or never will; later ones come no earlier.
        levels, known = self.levels, self.known
        if stamp < levels[known].stamp or stamp == levels[known].stamp and self.near(
                flux_density, levels[known].flux_density):
            return self, None
        sent = range(known + 1, self.sent)
        found = self._find(sent, stamp, flux_density, tolerance)
        short = None
        if found is None:
            found = short = self._short(sent, stamp, flux_density, tolerance)
        if found is not None:
            rest, taken = found + 1, replace(levels[found], sent_for=None)
            deviation = Deviation(
                stamp - levels[found].due, self._changes(range(known + 1, found)),
                asked=None if short is None else taken.flux_density)
        else:
            rest = known + 1 + sum(levels[i].stamp < stamp for i in sent)
            taken = levels[rest - 1]
            if self.near(taken.flux_density, flux_density):
                return self, None
            # A command from another publisher, or a watchdog.
            deviation = Deviation(lost=self._changes(range(known + 1, rest)), foreign=True)
        # The level as the hardware rounds it.
        news = replace(taken, stamp=stamp, flux_density=flux_density)
        deviation = replace(deviation, change=flux_density - levels[known].flux_density)
        if rest == known + 2 and news == levels[known + 1]:
            # As planned: the work does not grow with the plan.
            return replace(self, known=known + 1).predicted(known + 3), deviation
        after = levels[rest:self.sent]
        if after and after[0].stamp < stamp:
            after = tuple(
                replace(x, stamp=stamp, sent_for=x.due) if x.stamp < stamp else x for x in after)
        changed, until = (news, *after), self.sent
        count = known + 2 + len(after)
        stale: int | None = known + 1
        if short is not None:
            # The coil will not reach higher levels to come either.
            until = len(levels)
            changed = (news, *(
                replace(x, flux_density=flux_density) if _beyond(x.flux_density, flux_density)
                else x for x in (*after, *levels[self.sent:])))
        elif deviation == Deviation() and _same(flux_density, taken.flux_density):
            stale = None if self.stale is None else self.stale + count - self.sent
        # Up to the next level, which may agree. Others are predicted when that is read, since
        # there may be hundreds, and as many reports.
        return self._with(
            known + 1, until, changed, sent=count, known=known + 1,
            stale=stale).predicted(known + 3), deviation

    def predicted(self, end: int) -> 'History':
        """
        Predict stale levels again up to an index, or until a prediction agrees with the plan.

        The rest of the plan is then valid, unless levels that follow were moved.
        """
        end = min(end, len(self.levels))
        if self.stale is None or self.stale >= end:
            return self
        moved = next((
            i for i in reversed(range(self.known + 1, self.sent))
            if self.levels[i].sent_for is not None), self.known)
        anew: list[PlannedLevel] = []
        settled = end == len(self.levels)
        for place in range(self.stale, end):
            before = anew[-1] if anew else self.levels[place - 1]
            anew.append(self.levels[place].after(before))
            if place > moved and agree(anew[-1], self.levels[place]):
                settled = True
                break
        stop = self.stale + len(anew)
        return self._with(self.stale, stop, anew, stale=None if settled else stop)

    def _find(
            self, sent: range, stamp: int, flux_density: float, tolerance: int) -> int | None:
        """Return the index of the sent level that has taken effect, else None."""
        levels = self.levels
        # Almost always the next one, among perhaps hundreds along a path.
        for i in sent:
            if abs(levels[i].stamp - stamp) <= tolerance and self.near(
                    levels[i].flux_density, flux_density):
                return i
        for i in sent:
            if (levels[i].stamp < stamp and levels[i].flux_density != levels[i - 1].flux_density
                    and self.near(levels[i].flux_density, flux_density)):
                return i
        if _same(flux_density, levels[self.known].flux_density):
            return None  # already in effect, and not the early start of a slow path
        # A driver that rounds to its own steps may be early, but not by skipping a change.
        return next((
            i for i in sent if self.near(levels[i].flux_density, flux_density)
            and not self._changes(range(self.known + 1, i))), None)

    def _short(
            self, sent: range, stamp: int, flux_density: float, tolerance: int) -> int | None:
        """Return the index of the sent level that the amplifier did not reach, else None."""
        due = [i for i in sent if self.levels[i].stamp <= stamp + tolerance]
        if not due:
            return None
        level = self.levels[due[-1]]
        asked, options = level.flux_density, level.model.options
        # Levels of a watchdog or another publisher come later, or are 0 T.
        soon = stamp - level.stamp <= max(options.lead_time, level.model.ns(1.0))
        short = _beyond(asked, flux_density) and not (
            self.near(asked, flux_density) or self.near(0.0, flux_density))
        return due[-1] if soon and short else None

    def _changes(self, places: Sequence[int]) -> int:
        """Return how many of the levels differ from the one before."""
        return sum(not self.near(
            self.levels[i].flux_density, self.levels[i - 1].flux_density) for i in places)

    def near(self, one: float, other: float) -> bool:
        """Return whether two levels in T are equal for hardware that rounds them."""
        if _same(one, other):
            return True
        options = self.levels[-1].model.options
        largest = max(abs(options.flux_density_min), abs(options.flux_density_max))
        if math.isinf(largest):
            largest = max(abs(one), abs(other), abs(self.levels[self.sent - 1].flux_density))
        return abs(one - other) <= _RESOLUTION * largest


class _Pieces(Sequence[PlannedLevel]):
    """Levels in pieces, so that an edit does not copy all of them."""

    def __init__(self, pieces: Sequence[Sequence[PlannedLevel]]) -> None:
        self._pieces = pieces
        self._ends = list(accumulate(map(len, pieces)))

    def __len__(self) -> int:
        return self._ends[-1]

    def __iter__(self) -> Iterator[PlannedLevel]:
        return chain.from_iterable(self._pieces)

    @overload
    def __getitem__(self, place: int) -> PlannedLevel: ...

    @overload
    def __getitem__(self, place: slice) -> Sequence[PlannedLevel]: ...

    def __getitem__(self, place: int | slice) -> PlannedLevel | Sequence[PlannedLevel]:
        if isinstance(place, slice):
            start, end, _ = place.indices(len(self))
            first, last = bisect_right(self._ends, start), bisect_left(self._ends, end)
            before = self._ends[first - 1] if first else 0
            return tuple(chain.from_iterable(
                self._pieces[first:last + 1]))[start - before:max(end, start) - before]
        place += len(self) if place < 0 else 0
        number = bisect_right(self._ends, place)
        return self._pieces[number][place - self._ends[number]]

    def edited(self, start: int, end: int, levels: Sequence[PlannedLevel]) -> '_Pieces':
        """Return the levels with others in place of some."""
        first, last = bisect_right(self._ends, start), bisect_right(self._ends, end)
        before = self._ends[first - 1] if first else 0
        after = self._ends[last] if last < len(self._ends) else len(self)
        joined = (*self[before:start], *levels, *self[end:after])
        return _Pieces([*self._pieces[:first], *_cut(joined), *self._pieces[last + 1:]])


def _cut(levels: Sequence[PlannedLevel]) -> list[Sequence[PlannedLevel]]:
    return [levels[i:i + _PIECE] for i in range(0, len(levels), _PIECE)]


def _edited(
        levels: Sequence[PlannedLevel], start: int, end: int,
        others: Sequence[PlannedLevel]) -> Sequence[PlannedLevel]:
    """Return levels with others in place of some."""
    if len(levels) <= _MANY:
        return (*levels[:start], *others, *levels[end:])
    return (levels if isinstance(levels, _Pieces) else _Pieces(_cut(levels))).edited(
        start, end, others)


def agree(one: PlannedLevel, other: PlannedLevel) -> bool:
    """Return whether two predictions agree to rounding."""
    x, y, level = one.state, other.state, one.model.units.level
    return (
        abs(x.stretch - y.stretch) <= _AS_PLANNED
        and abs(x.rate - y.rate) <= _AS_PLANNED * one.model.frequency(x.stretch)
        and (x.amplifier is None) is (y.amplifier is None)
        and _same(level(x.load), level(y.load))
        and _same(level(x.ramps_from), level(y.ramps_from))
        and len(x.followed) == len(y.followed)
        and all(abs(a - b) <= _AS_PLANNED for a, b in zip(x.followed, y.followed, strict=True)))


def _beyond(level: float, limit: float) -> bool:
    """Return whether a level in T exceeds the limit that a coil reaches in its direction."""
    return level * limit > 0.0 and abs(level) > abs(limit)


def _same(one: float, other: float) -> bool:
    """Return whether two flux densities in T are equal to rounding."""
    return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
