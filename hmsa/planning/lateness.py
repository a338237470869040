"""
Lateness of commands, its remedies, and its effect on plans, for delays of transport and driver.

Late commands leave vibration, and so does a new plan whose commands are late again. Both are
simulated in several scenarios, in which future commands are as late as the previous ones.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
import math
from typing import NamedTuple

import numpy as np
from numpy.random import default_rng  # at first use, when commands are late, it takes 30 ms
from numpy.typing import NDArray

from hmsa.errors import HmsaError
from hmsa.model.moves import Level
from hmsa.model.simulation import sampled
from hmsa.model.units import NANOSECONDS
from hmsa.planning.timeline import Draft, PlannedLevel, Timeline

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
#: Smaller steps are replaced by this one.
LEAST_STEP = 0.1
#: Peak-to-peak residual vibration, as a fraction of the step, from which it matters.
SHARE = 5e-3
# Required gain of a new plan, beyond this many standard deviations over the scenarios, and the
# largest error it may leave: one of a whole step is left to chance. After an exception: the
# fraction of the present error that it may leave, the fraction of the gain by which one scenario
# may be worse, and the fraction of the present error once no more information will come.
_GAIN, _SURE, _LARGEST, _LITTLE, _RISK, _CLEARLY = 5e-3, 3.0, 1.0, 0.35, 0.2, 0.5
# Stands for the error of a motion that cannot be predicted.
_LOST = 1e3
# Setpoints considered, how far ahead the next one may begin, time scales that may be simulated,
# and number of scenarios.
_SETPOINTS, _NEAR, _LONGEST, _WAYS = 2, 50.0, 2000.0, 16


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


def _median(values: Iterable[int]) -> int:
    """Return the lower median; the module statistics takes 5 % of the start of a node."""
    inside = sorted(values)
    return inside[(len(inside) - 1) // 2]


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
        middle, newest = _median(late), late[-_ENOUGH:]
        spread = _median(abs(x - middle) for x in late)
        usual = sorted(x for x in late if abs(x - middle) <= _APART * spread)
        if _APART * (max(newest) - min(newest)) < abs(_median(newest) - middle):
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
        return _median(self._likely()[0])

    @property
    def uneven(self) -> int:
        """Usual spread of the lateness of the next commands in ns."""
        usual = self._likely()[0]
        return usual[-1] - usual[0]

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
        chance = default_rng(0).choice(np.array(usual), (count, most)).T
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


@dataclass(frozen=True)
class Aim:
    """A setpoint to be reached; times in ns."""

    stretch: float
    step: float  #: of stretch, at least `LEAST_STEP`
    arrival: int
    end: int | None  #: begin of the next setpoint; None if there is none


def step_of(plan: Timeline, place: int) -> float:
    """Return the step of a setpoint by its place in a plan, at least `LEAST_STEP`."""
    return LEAST_STEP if place < 0 else max(plan.step(place), LEAST_STEP)


def aims(plan: Timeline, now: int) -> list[Aim]:
    """Return the setpoint that is under way at a time in ns, and the next ones."""
    found: list[Aim] = []
    unit = plan.levels[-1].model.units.time * NANOSECONDS
    first = max(plan.under_way(now), 0)
    for place in range(first, min(first + _SETPOINTS, len(plan.segments))):
        segment = plan.segments[place]
        end = plan.segments[place + 1].since if place + 1 < len(plan.segments) else None
        arrival = segment.arrival
        if arrival is None:
            arrival = end if end is not None else plan.levels[-1].stamp
        if found and segment.since - max(found[-1].arrival, now) > _NEAR * unit:
            break
        found.append(Aim(segment.stretch, step_of(plan, place), arrival, end))
    return found


def expected(
        start: PlannedLevel, levels: Sequence[PlannedLevel], wanted: Sequence[Aim],
        lateness: Lateness) -> NDArray[np.float64]:
    """
    Return the predicted error summed over the aims, for each of several scenarios of lateness.

    The error is the peak-to-peak vibration plus twice the distance from the aim, as a fraction of
    the step. The simulation starts in the state of ``start``; ``levels`` follow.
    """
    levels = [x for x in levels if wanted[-1].end is None or x.stamp <= wanted[-1].end]
    span = start.model.time(max(wanted[-1].arrival - start.stamp, 0)) + 1.0
    most = int(min(max(_LONGEST / span, 1.0), _WAYS))
    stamps = np.array([x.due for x in levels], dtype=np.int64)
    return np.array([_left(start, levels, stamps + late, wanted)
                     for late in lateness.scenarios(len(levels), most)])


def _left(
        start: PlannedLevel, levels: Sequence[PlannedLevel], stamps: NDArray[np.int64],
        wanted: Sequence[Aim]) -> float:
    """Return the predicted error if the levels take effect at times in ns."""
    model, begin = start.model, start.stamp
    times = np.maximum.accumulate(np.maximum(stamps, begin)).tolist()
    looks = list(_looks(levels, times, wanted, begin))
    end = max(looks)
    course = [Level(0.0, model.load(start.flux_density)), *(
        Level(model.time(x - begin), model.load(level.flux_density))
        for x, level in zip(times, levels, strict=True) if x < end)]
    # Of levels that take effect simultaneously, only the last one counts.
    course = [one for one, other in pairwise([*course, Level(math.inf, 0.0)])
              if one.time < other.time]
    state = start.at(begin)
    try:
        stretch, rate, *_ = sampled(
            course, state, np.array([model.time(x - begin) for x in looks]), model.material,
            model.delivery)
    except HmsaError:
        return _LOST
    return sum(
        2.0 * math.hypot(x - aim.stretch, v / model.frequency(aim.stretch)) / aim.step
        for x, v, aim in zip(stretch.tolist(), rate.tolist(), wanted, strict=True))


def _looks(
        levels: Sequence[PlannedLevel], times: Sequence[int], wanted: Sequence[Aim],
        begin: int) -> Iterator[int]:
    """Yield times in ns to evaluate: the last level is in force, and the next is not."""
    look = begin
    for aim in wanted:
        own = sum(aim.end is None or x.stamp < aim.end for x in levels)
        look = max(look, aim.arrival, times[own - 1] if own else begin)
        if aim.end is not None:
            look = min(look, times[own] if own < len(times) else max(aim.end, begin))
        yield look


def compared(
        plan: Timeline, start: PlannedLevel, levels: Sequence[PlannedLevel], draft: Draft,
        lateness: Lateness) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the predicted errors of a plan from a start on, and of a draft in its place."""
    first = max(plan.under_way(draft.begin), 0)
    kept = first if draft.resumed is None else draft.resumed + draft.missed
    wanted = []
    for place, aim in enumerate(aims(plan, draft.begin), first):
        # At the later arrival of the two; an aim that the draft leaves out, at its end.
        own = draft.segments[place - kept] if 0 <= place - kept < len(draft.segments) else None
        arrival = own.arrival if own is not None else (
            aim.end if draft.resumed is not None and place >= draft.resumed else None)
        wanted.append(replace(aim, arrival=max(aim.arrival, arrival or aim.arrival)))
    replanned = [*(x for x in levels if x.stamp < draft.begin), *draft.levels]
    # Each setpoint that the draft leaves out, beyond those considered, is missed by a step.
    out = max(len(plan.segments) - first - len(wanted), 0) if draft.resumed is None else 0
    return (
        expected(start, levels, wanted, lateness),
        expected(start, replanned, wanted, lateness) + 2.0 * out)


def better_than_keeping(
        before: NDArray[np.float64], after: NDArray[np.float64], *, news: bool,
        unsure: bool) -> bool:
    """
    Return whether to adopt a draft, given the errors without and with it in each scenario.

    The draft must not increase the error in any scenario, nor by chance in an untested one. If the
    newest command was an exception (``unsure``), a small increase is allowed; if there will be no
    further ``news`` in time either, a much smaller mean error is enough.
    """
    gain = before - after
    mean, harm = float(gain.mean()), float(-gain.min())
    if after.mean() > (max(_LITTLE * before.mean(), _LARGEST) if unsure else _LARGEST):
        return False
    if unsure and not news:
        return mean >= max(_GAIN, (1.0 - _CLEARLY) * float(before.mean()))
    if unsure:
        return mean >= _GAIN >= harm - _RISK * mean
    return mean >= _GAIN + _SURE * float(gain.std())
