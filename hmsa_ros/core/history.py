"""What really took effect, taken into the levels of a plan."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from hmsa_ros.core.timeline import PlannedLevel

# How near a prediction must come to the planned one for what follows to hold as planned: half a
# nanosecond, to which stamps are rounded, makes some 1e-8 of stretch at full speed. The rate is
# meant relative to the natural frequency.
_AS_PLANNED = 3e-8


@dataclass(frozen=True)
class Deviation:
    """How what took effect differs from what was planned."""

    late: int = 0  #: ns by which a change came later than planned; negative for earlier
    lost: int = 0  #: planned changes before it that never took effect
    foreign: bool = False  #: whether the level was not planned at all


@dataclass(frozen=True)
class History:
    """
    The levels of a plan, and how much of it has happened.

    Only what has been handed out is predicted anew where reality differs, so that the work
    does not grow with the plan; `predicted` catches up as far as somebody needs it.
    """

    levels: tuple[PlannedLevel, ...]
    sent: int = 1  #: how many, the first ones, have been handed out; at least 1
    known: int = 0  #: place of the last one known to have taken effect
    #: Place of the first level, not handed out yet, whose prediction holds no more.
    stale: int | None = None

    def unheard(self, now: int) -> int:
        """Count the levels after the last known one that never took effect (time in ns)."""
        # Only changes are reported. Commands that come so late that they apply all at once make
        # none if the last of them is the level in force: those before it never were.
        levels, first = self.levels, self.known + 1
        for i in reversed(range(first, self.sent)):
            if (levels[i].stamp <= now
                    and _same(levels[i].flux_density, levels[self.known].flux_density)
                    and self._changes(range(first, i + 1))):
                return i + 1 - first
        return 0

    def handed_out(self, end: int) -> 'History':
        """Return the history after all levels up to a place have been handed out."""
        return replace(self.predicted(end), sent=end)

    def without(self, start: int, end: int) -> 'History':
        """Return the history without levels ``start`` to ``end``, which never were in force."""
        sent = self.sent - max(min(self.sent, end) - start, 0)
        return History(
            self.levels[:start] + self.levels[end:], sent, self.known, start).predicted(sent)

    def with_news(
            self, stamp: int, flux_density: float,
            tolerance: int) -> tuple['History', Deviation | None]:
        """Return the history with a level (T) in effect from a stamp (ns), and its deviation."""
        # Changes take effect in the order in which they were sent. So those before the one there
        # is news of have been in force already or never will, and those after it come no earlier.
        levels, known = self.levels, self.known
        if stamp < levels[known].stamp or stamp == levels[known].stamp and _same(
                flux_density, levels[known].flux_density):
            return self, None
        sent = range(known + 1, self.sent)
        found = self._find(sent, stamp, flux_density, tolerance)
        if found is not None:
            passed = range(known + 1, found)
            news = replace(levels[found], stamp=stamp)
            rest = found + 1
            deviation = Deviation(stamp - levels[found].stamp, self._changes(passed))
        else:
            passed = range(known + 1, known + 1 + sum(levels[i].stamp < stamp for i in sent))
            before = levels[passed[-1] if passed else known]
            if _same(before.flux_density, flux_density):
                return self, None
            # Somebody else's command, or what a watchdog does.
            news = replace(before, stamp=stamp, flux_density=flux_density)
            rest = passed.stop
            deviation = Deviation(lost=self._changes(passed), foreign=True)
        after = tuple(replace(x, stamp=max(x.stamp, stamp)) for x in levels[rest:self.sent])
        changed = (*levels[:known + 1], news, *after, *levels[self.sent:])
        count = known + 2 + len(after)
        if deviation == Deviation():
            stale = None if self.stale is None else self.stale + count - self.sent
            return History(changed, count, known + 1, stale), deviation
        return History(changed, count, known + 1, known + 1).predicted(count), deviation

    def predicted(self, end: int) -> 'History':
        """Predict stale levels anew up to a place, or until a prediction is as planned."""
        if self.stale is None or self.stale >= end:
            return self
        anew: list[PlannedLevel] = []
        for place in range(self.stale, end):
            before = anew[-1] if anew else self.levels[place - 1]
            anew.append(self.levels[place].after(before))
            if place >= self.sent and agree(anew[-1], self.levels[place]):
                break
        stop = self.stale + len(anew)
        settled = stop < end or stop == len(self.levels) or (
            stop > self.sent and agree(anew[-1], self.levels[stop - 1]))
        return replace(
            self, levels=self.levels[:self.stale] + tuple(anew) + self.levels[stop:],
            stale=None if settled else stop)

    def _find(
            self, sent: range, stamp: int, flux_density: float, tolerance: int) -> int | None:
        """Return which of the levels that were sent has taken effect."""
        levels = self.levels
        same = [i for i in sent if _same(levels[i].flux_density, flux_density)]
        for i in same:
            if abs(levels[i].stamp - stamp) <= tolerance:
                return i
        for i in same:
            if levels[i].stamp < stamp and levels[i].flux_density != levels[i - 1].flux_density:
                return i
        # A driver that rounds to its own steps may be early, but leaves no change out for that.
        return next((i for i in same if not self._changes(range(self.known + 1, i))), None)

    def _changes(self, places: Sequence[int]) -> int:
        """Return how many of some levels are another one than that before."""
        return sum(
            self.levels[i].flux_density != self.levels[i - 1].flux_density for i in places)


def agree(one: PlannedLevel, other: PlannedLevel) -> bool:
    """Return whether two predictions are the same but for what rounding makes of them."""
    model = one.model
    return (
        abs(one.stretch - other.stretch) <= _AS_PLANNED
        and abs(one.rate - other.rate) * model.units.time
        <= _AS_PLANNED * model.frequency(one.stretch)
        and _same(one.in_force, other.in_force)
        and (one.amplifier is None) is (other.amplifier is None)
        and _same(one.amplifier or 0.0, other.amplifier or 0.0)
        and len(one.followed) == len(other.followed)
        and all(abs(x - y) <= _AS_PLANNED for x, y in zip(
            one.followed, other.followed, strict=True)))


def _same(one: float, other: float) -> bool:
    """Whether two flux densities in T are the same but for rounding on the way."""
    return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
