"""Lateness of commands and its remedies, for delays of transport and of the driver."""

from collections import deque
from collections.abc import Iterable
from statistics import median_low
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmsa.model.units import NANOSECONDS

# Number of commands that are compared, and the smallest number that is conclusive.
_RECENT = 16
_ENOUGH = 3
# A command is an exception if it differs by more than this many times the usual spread; smallest
# fraction of commands that are none.
_APART, _MOST = 5.0, 0.6
# Time in ns after a disturbance within which late commands are due to it; number of disturbances.
_AFTER, _DISTURBANCES = 500_000_000, 16
# The driver causes the delay if the spread of the lateness is below this fraction of that of the
# time from sending to effect; the transport causes it in the opposite case.
_CONSTANT = 0.5
# Vibration, as a fraction of the step, that is negligible.
_NOTHING = 1e-3
# Quantiles of the recent lateness that all of the next commands may have.
_SHARES = (0.1, 0.5, 0.9)
# Number of scenarios after an exception, which persists in one of them.
_RARE = 8


class Disturbance(NamedTuple):
    """An outage, a stall, or a clock that was set: lateness from it is no reason to plan ahead."""

    begin: int  # in ns by the steady clock
    end: int
    words: str  # as a clause


class _Late(NamedTuple):
    """A late command; times in ns."""

    time: int  # of the report, by the steady clock
    late: int
    ahead: int | None  # from sending to its timestamp; None if unknown


class Lateness:
    """
    Count late commands, find their pattern, and predict the lateness of the next commands.

    A command delayed in transport is later the later it is sent. A command delayed by the driver
    is equally late, however far ahead of its timestamp it is sent.
    """

    def __init__(self) -> None:
        self.count = 0
        self.largest = 0  # largest lateness in ns
        self.earliest = 0  # largest time in ns by which a command was early
        self._missed = False
        self._effects: dict[str, int] = {}  # time of effect of the newest command, in ns
        # Lateness in ns, and vibration per ns of lateness, as a fraction of the step.
        self._recent: deque[tuple[int, float]] = deque(maxlen=_RECENT)
        self._late: deque[_Late] = deque(maxlen=_RECENT)
        self._needed = 0  # largest lateness in ns of forgotten commands, without disturbances
        self._disturbances: deque[Disturbance] = deque(maxlen=_DISTURBANCES)

    def note(
            self, late: int, joint: str, stamp: int, tolerance: int = 0,
            cost: float = 0.0, time: int = 0, ahead: int | None = None) -> None:
        """
        Record that a command of a joint took effect ``late`` ns after its timestamp.

        ``cost`` is the vibration per ns of lateness, as a fraction of the step; ``time`` that of
        the steady clock; ``ahead`` that from sending to the timestamp, if known.
        """
        before, self._effects[joint] = self._effects.get(joint), stamp + late
        if late < 0 or before is None or stamp + late > before + tolerance:
            # A command that arrives with the previous one was delayed together with it.
            self._recent.append((late, cost))
        if late > tolerance:
            self._add(_Late(time, late, ahead))
        elif late < -tolerance:
            self.earliest = max(self.earliest, -late)

    def missed(self, late: int, time: int = 0) -> None:
        """Count a command that is sent ``late`` ns late, or not sent for that reason."""
        self._add(_Late(time, late, None))
        self._missed = True

    def _add(self, one: _Late) -> None:
        self.count += 1
        self.largest = max(self.largest, one.late)
        if len(self._late) == _RECENT and not self._cause(self._late[0]):
            self._needed = max(self._needed, self._late[0].late)
        self._late.append(one)

    def disturbed(self, found: Iterable[Disturbance]) -> None:
        """Record disturbances; lateness that follows one is due to it."""
        self._disturbances += found

    def _cause(self, one: _Late) -> str:
        """Return the disturbance that made a command late, as a clause; empty for none."""
        return next((x.words for x in reversed(self._disturbances)
                     if x.begin <= one.time <= x.end + _AFTER), '')

    # -- prediction ----------------------------------------------------------------------------

    def _likely(self) -> tuple[list[int], list[int]]:
        """Return the usual lateness in ns, sorted, and the newest one if it is an exception."""
        # The initial assumption is that commands are in time.
        late = [0, 0, *(x for x, _ in self._recent)]
        middle, newest = median_low(late), late[-_ENOUGH:]
        spread = median_low(abs(x - middle) for x in late)
        usual = sorted(x for x in late if abs(x - middle) <= _APART * spread)
        if _APART * (max(newest) - min(newest)) < abs(median_low(newest) - middle):
            # The usual lateness has changed.
            return sorted(newest), []
        if len(usual) < _MOST * len(late):
            return sorted(late), []
        return usual, [] if late[-1] in usual else [late[-1]]

    @property
    def unsure(self) -> bool:
        """Whether the newest command is an exception, or the first after a change."""
        return bool(self._likely()[1])

    @property
    def expected(self) -> int:
        """Expected lateness of the next commands in ns."""
        return median_low(self._likely()[0])

    def scenarios(self, count: int, most: int) -> NDArray[np.int64]:
        """Return the possible lateness of commands in ns; shape (at most `most`, count)."""
        usual, exception = self._likely()
        if most == 1 or not exception and usual[0] == usual[-1]:
            return np.full((1, count), self.expected)
        if exception:
            # The exception persists or is over; the more usual commands there were, the more
            # scenarios assume that it is over.
            ways = [*exception, *usual[::-(-len(usual) // (min(most, _RARE) - 1))]]
            return np.repeat(np.array(ways)[:, None], count, axis=1)
        alike = np.array([usual[int(x * len(usual))] for x in _SHARES])[:most, None]
        chance = np.random.default_rng(0).choice(np.array(usual), (count, most)).T
        chance[:len(alike)] = alike
        return chance

    # -- words ---------------------------------------------------------------------------------

    @property
    def cost(self) -> float:
        """Largest vibration due to uneven recent lateness, as a fraction of the step."""
        alike = self.expected
        return min(max((abs(late - alike) * x for late, x in self._recent), default=0.0), 1.0)

    @property
    def harms(self) -> bool:
        """Whether late commands leave vibration; equally late commands do not."""
        return self._missed or self.count > 0 and self.cost >= _NOTHING

    def _by_driver(self) -> bool | None:
        """Return whether the driver delays the last commands; None if that is undetermined."""
        known = [(x.late, x.ahead) for x in self._late
                 if x.ahead is not None and not self._cause(x)]
        if known and known[-1][1] < 0:
            # The commands were sent too late.
            return False
        if len(known) < _ENOUGH:
            return None
        late = [x for x, _ in known]
        under_way = [x + ahead for x, ahead in known]
        spread, explained = max(late) - min(late), max(under_way) - min(under_way)
        if spread < _CONSTANT * explained:
            return True
        return False if explained < _CONSTANT * spread else None

    def words(self) -> str:
        """Return what happens to commands, as the first half of a sentence."""
        if self.largest:
            said = f'commands take effect up to {self.largest / 1e6:.3g} ms late'
        elif self.earliest:
            said = f'commands take effect up to {self.earliest / 1e6:.3g} ms early'
        else:
            return 'commands are lost, or overridden by another publisher'
        if self.cost < _NOTHING:
            return f'{said}, all alike, which leaves no vibration'
        cost = float(f'{100.0 * self.cost:.2g}')
        return f'{said}: about {cost:g} % of the step of residual vibration'

    def advice(self, lead_time: int) -> str:
        """Return the remedy as the rest of a sentence; `lead_time` is in ns."""
        if not self.largest:
            return 'let the driver apply commands at their timestamps' if self.earliest else (
                'find out which other node publishes commands, or what drops them')
        causes = [self._cause(x) for x in self._late]
        largest = max((x.late for x, cause in zip(self._late, causes, strict=True) if not cause),
                      default=0)
        largest = max(largest, self._needed)
        if not largest:
            return f'{causes[-1]}: a larger lead_time is no remedy for that'
        by_driver = self._by_driver()
        if by_driver:
            return (
                'the driver applies them this long after their timestamps however early they are '
                'sent, so a larger lead_time does not help: ' + (
                    'nothing needs to be done, but it may write that much earlier'
                    if self.cost < _NOTHING else 'have it write at more even times'))
        needed = (lead_time + largest) / NANOSECONDS
        return f'raise lead_time to more than {needed:.3g} s' + (
            ', unless the driver itself is that slow' if by_driver is None else '')
