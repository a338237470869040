"""What really took effect, taken into the levels of a plan."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import math

from hmsa_ros.planning.timeline import PlannedLevel

# How near a prediction must come to the planned one for what follows to hold as planned: half a
# nanosecond, to which stamps are rounded, makes some 1e-8 of stretch at full speed. The rate is
# meant relative to the natural frequency.
_AS_PLANNED = 3e-8
# Levels that differ by less than this share of the largest one are the same to a coil's hardware,
# which rounds: some steps of a converter of 14 bits.
_RESOLUTION = 2e-4


@dataclass(frozen=True)
class Deviation:
    """How what took effect differs from what was planned."""

    late: int = 0  #: ns by which a change came later than planned; negative for earlier
    lost: int = 0  #: planned changes before it that never took effect
    foreign: bool = False  #: whether the level was not planned at all
    asked: float | None = None  #: level in T that the coil did not reach; None where it did
    change: float = field(default=0.0, compare=False)  #: of the level in T
    #: Amplitude of stretch that is not planned for, beyond a lateness that is expected.
    effect: float = field(default=0.0, compare=False)

    def beyond(self, tolerance: int) -> bool:
        """Return whether it is more than a change that is some ns late."""
        return bool(
            self.foreign or self.lost or self.asked is not None or abs(self.late) > tolerance)


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
                    and self._near(levels[i].flux_density, levels[self.known].flux_density)
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
        if stamp < levels[known].stamp or stamp == levels[known].stamp and self._near(
                flux_density, levels[known].flux_density):
            return self, None
        sent = range(known + 1, self.sent)
        found = self._find(sent, stamp, flux_density, tolerance)
        short = None
        if found is None:
            found = short = self._short(sent, stamp, flux_density, tolerance)
        if found is not None:
            passed = range(known + 1, found)
            # As the hardware rounds it.
            news = replace(
                levels[found], stamp=stamp, flux_density=flux_density, sent_for=None)
            rest = found + 1
            deviation = Deviation(
                stamp - levels[found].due, self._changes(passed),
                asked=None if short is None else levels[found].flux_density)
        else:
            passed = range(known + 1, known + 1 + sum(levels[i].stamp < stamp for i in sent))
            before = levels[passed[-1] if passed else known]
            if self._near(before.flux_density, flux_density):
                return self, None
            # Somebody else's command, or what a watchdog does.
            news = replace(before, stamp=stamp, flux_density=flux_density)
            rest = passed.stop
            deviation = Deviation(lost=self._changes(passed), foreign=True)
        deviation = replace(deviation, change=flux_density - levels[known].flux_density)
        after = tuple(
            replace(x, stamp=stamp, sent_for=x.due) if x.stamp < stamp else x
            for x in levels[rest:self.sent])
        changed = (*levels[:known + 1], news, *after, *levels[self.sent:])
        count = known + 2 + len(after)
        if short is not None:
            # Nor does it reach what is to come.
            changed = (*changed[:known + 2], *(
                replace(x, flux_density=flux_density) if _beyond(x.flux_density, flux_density)
                else x for x in changed[known + 2:]))
        elif deviation == Deviation() and _same(
                flux_density, levels[found if found is not None else known].flux_density):
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
        # Nearly always the next one, of perhaps hundreds along a path.
        for i in sent:
            if abs(levels[i].stamp - stamp) <= tolerance and self._near(
                    levels[i].flux_density, flux_density):
                return i
        same = [i for i in sent if self._near(levels[i].flux_density, flux_density)]
        for i in same:
            if levels[i].stamp < stamp and levels[i].flux_density != levels[i - 1].flux_density:
                return i
        if _same(flux_density, levels[self.known].flux_density):
            return None  # in force already, and not the early beginning of a gentle path
        # A driver that rounds to its own steps may be early, but leaves no change out for that.
        return next((i for i in same if not self._changes(range(self.known + 1, i))), None)

    def _short(
            self, sent: range, stamp: int, flux_density: float, tolerance: int) -> int | None:
        """Return which of the levels that were sent an amplifier did not reach."""
        due = [i for i in sent if self.levels[i].stamp <= stamp + tolerance]
        if not due:
            return None
        level = self.levels[due[-1]]
        asked, options = level.flux_density, level.model.options
        # What a watchdog or somebody else does comes later, or is nothing at all.
        soon = stamp - level.stamp <= max(options.lead_time, level.model.ns(1.0))
        short = _beyond(asked, flux_density) and not (
            self._near(asked, flux_density) or self._near(0.0, flux_density))
        return due[-1] if soon and short else None

    def _changes(self, places: Sequence[int]) -> int:
        """Return how many of some levels are another one than that before."""
        return sum(not self._near(
            self.levels[i].flux_density, self.levels[i - 1].flux_density) for i in places)

    def _near(self, one: float, other: float) -> bool:
        """Whether two levels in T are the same to hardware that rounds them."""
        if _same(one, other):
            return True
        options = self.levels[-1].model.options
        largest = max(abs(options.flux_density_min), abs(options.flux_density_max))
        if math.isinf(largest):
            largest = max(abs(one), abs(other), abs(self.levels[self.sent - 1].flux_density))
        return abs(one - other) <= _RESOLUTION * largest


def agree(one: PlannedLevel, other: PlannedLevel) -> bool:
    """Return whether two predictions are the same but for what rounding makes of them."""
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
    """Whether a level in T is beyond what a coil reaches in its direction."""
    return level * limit > 0.0 and abs(level) > abs(limit)


def _same(one: float, other: float) -> bool:
    """Whether two flux densities in T are the same but for rounding on the way."""
    return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
