"""What really took effect, taken into the levels of a plan."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from hmsa_ros.core.timeline import PlannedLevel


@dataclass(frozen=True)
class Deviation:
    """
    How what took effect differs from what was planned.

    Attributes
    ----------
    late : int
        By how many ns a planned change came later; negative for earlier.
    lost : int
        Planned changes before it that never took effect.
    foreign : bool
        Whether the level was not planned at all.

    """

    late: int = 0
    lost: int = 0
    foreign: bool = False


@dataclass(frozen=True)
class History:
    """
    The levels of a plan, and how much of it has happened.

    Attributes
    ----------
    levels : tuple of PlannedLevel
        By stamp.
    sent : int
        How many of them, the first ones, have been handed out; at least 1.
    known : int
        Place of the last one that is known to have taken effect.

    """

    levels: tuple[PlannedLevel, ...]
    sent: int = 1
    known: int = 0

    def unheard(self, now: int) -> int:
        """
        Count levels that never took effect, although that cannot have been told.

        What is told are changes. Commands that come so late that they apply all at once make
        none if the last of them is the level in force: those before it never were.

        Parameters
        ----------
        now : int
            Time in ns up to which everything has been told.

        Returns
        -------
        int
            How many levels after the last one known, up to one that is the same.

        """
        levels, first = self.levels, self.known + 1
        for i in reversed(range(first, self.sent)):
            if (levels[i].stamp <= now
                    and _same(levels[i].flux_density, levels[self.known].flux_density)
                    and self._changes(range(first, i + 1))):
                return i + 1 - first
        return 0

    def without(self, start: int, end: int) -> 'History':
        """
        Take levels out that never were in force, and never will be.

        Parameters
        ----------
        start, end : int
            Places of the first of them and of the first after them.

        Returns
        -------
        History
            In which the level before them stays in force.

        """
        levels = self.levels[:start] + self.levels[end:]
        handed = max(min(self.sent, end) - start, 0)
        return replace(self, levels=predicted(levels, start), sent=self.sent - handed)

    def with_news(
            self, stamp: int, flux_density: float,
            tolerance: int) -> tuple['History', Deviation | None]:
        """
        Take in that a level has taken effect.

        Changes take effect in the order in which they were sent. So those before the one there
        is news of have been in force already or never will, and those after it come no earlier.

        Parameters
        ----------
        stamp : int
            Time in ns at which it did.
        flux_density : float
            Level in T from then on.
        tolerance : int
            In ns: a planned change this near to it is the same.

        Returns
        -------
        history : History
            With predictions under what really happened.
        deviation : Deviation or None
            All zero if it is as planned; None if it is no news.

        """
        levels, known = self.levels, self.known
        if stamp < levels[known].stamp or stamp == levels[known].stamp and _same(
                flux_density, levels[known].flux_density):
            return self, None
        sent = range(known + 1, self.sent)
        found = self._place(sent, stamp, flux_density, tolerance)
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
        after = [
            replace(x, stamp=max(x.stamp, stamp)) if i < self.sent else x
            for i, x in enumerate(levels[rest:], rest)]
        changed = (*levels[:known + 1], news, *after)
        count = known + 2 + max(self.sent - rest, 0)
        if deviation == Deviation():
            return History(changed, count, known + 1), deviation
        return History(predicted(changed, known + 1), count, known + 1), deviation

    def _place(
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
        return None

    def _changes(self, places: range) -> int:
        """Return how many of some levels are another one than that before."""
        return sum(
            self.levels[i].flux_density != self.levels[i - 1].flux_density for i in places)


def predicted(levels: Sequence[PlannedLevel], start: int) -> tuple[PlannedLevel, ...]:
    """
    Return levels with their predictions worked out anew.

    Parameters
    ----------
    levels : sequence of PlannedLevel
        By stamp.
    start : int
        Place of the first whose prediction is to be worked out, at least 1.

    Returns
    -------
    tuple of PlannedLevel
        Each with the state that the one before it leads to.

    """
    anew = list(levels[:start])
    for level in levels[start:]:
        anew.append(level.after(anew[-1]))
    return tuple(anew)


def _same(one: float, other: float) -> bool:
    """Whether two flux densities in T are the same but for rounding on the way."""
    return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
