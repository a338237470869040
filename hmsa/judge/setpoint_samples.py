"""Samples of one setpoint, and when they suffice to judge it."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from hmsa.judge.judging import ENOUGH, judge
from hmsa.judge.records import (
    Finding,
    GoalTolerances,
    missed,
    RequestedSetpoint,
    SensorModel,
    Tolerances,
    unobserved,
)
from hmsa.model.status import Code
from hmsa.model.units import NANOSECONDS
from hmsa.offload import ANSWER, Awaited, Doing, here

# Time in ns after an arrival to wait for infrequent samples.
_RARE = NANOSECONDS // 4
# Number of samples kept from the move: they show whether the sensor moves at all.
_MOVING = 32
# Time in ns after an arrival until which a setpoint that is held waits for samples again, if those
# after the arrival are lost, as where reader or network pause.
_LOST = 2 * NANOSECONDS
# Time without samples, by the steady clock, after which the setpoint is judged without them.
_PATIENCE = NANOSECONDS // 2
_TOLERANCES = Tolerances()
#: Tolerated lead in ns of a timestamp over the clock, since clock updates may arrive late.
AHEAD = NANOSECONDS // 20


class SetpointSamples:
    """
    Gather the relevant samples of a setpoint, and judge it once there are enough.

    ``found`` is the newest finding; once ``over``, no more samples are needed. ``doing`` executes
    the judging.
    """

    def __init__(
            self, setpoint: RequestedSetpoint, goal: GoalTolerances | None = None,
            doing: Doing = here) -> None:
        self.setpoint = setpoint
        self.found: Finding | None = None
        self._told: Finding | None = None  # that returned last by `judge`
        self.over = False
        self.unreported = False  # whether it is missed and this is not reported yet
        self.news = False  # whether judged samples await an audit
        # An arrival before the newest correction from samples.
        self._arrived: Finding | None = None
        # The setpoint judged last, and its finding.
        self._answer: tuple[RequestedSetpoint, Finding] | None = None
        self._doing = doing
        self._judging: Awaited[Finding | None] | None = None
        self._end, self._goal = setpoint.end, goal
        self._cut: int | None = None  # time in ns at which another setpoint takes its place
        self._samples: dict[int, float] = {}
        self._moving: set[int] = set()  # parts of the move that have a sample
        # Timestamp of the newest sample, the newest timestamp seen, and when that was.
        self._newest = self._seen = self._heard = 0
        # Largest lead of a timestamp over the clock.
        self._ahead = 0
        # Arrival as requested, and according to the newest plan.
        self.asked = setpoint.rests_from
        self._begin_at(self.asked)

    def _begin_at(self, begin: int) -> None:
        setpoint = self.setpoint
        self._judging = None
        self._begin, self._length = begin, setpoint.look
        # The last setpoint is held, so there is always time for a look, even at infrequent
        # samples.
        least = begin + 2 * self._length if setpoint.held else begin
        self._enough = least if setpoint.end is None else max(setpoint.end, least)
        self._closes = max(self._enough, begin + _RARE) if setpoint.held else self._enough
        # Latest time of arrival that counts.
        self._grace = begin + (0 if self._goal is None else self._goal.time)
        self._closes = max(self._closes, self._grace)
        self.due = min(begin + self._length, self._closes)
        self._few: bool | None = None
        self._waits = False  # whether it waits for a last sample
        self._again = False  # whether it waited for samples after lost ones

    def move(self, arrival: int, *, corrected: bool) -> None:
        """Adopt the arrival in ns of a new plan, ``corrected`` if it was made from samples."""
        # A setpoint that is held may be corrected for as long as it is held.
        held = self.setpoint.held
        end = None if corrected and held else self._end
        if arrival == self._begin and (
                self.found is None or self.found.verdict is not Code.MISSED):
            self.setpoint = replace(self.setpoint, end=end)
            return
        self.setpoint = replace(
            self.setpoint, end=end, moved=None if arrival == self.setpoint.arrival else arrival)
        if not held and end is not None and arrival >= end:
            self.miss('after replanning, it is reached only after its time')
            return
        self._arrived = self.found if corrected and self.found is not None and (
            self.found.arrived) else None
        self.found = self._told = None
        self.over = self.unreported = False
        self._begin_at(arrival)

    @property
    def requested(self) -> RequestedSetpoint:
        """The setpoint as requested, with the arrival of the newest plan."""
        return replace(self.setpoint, end=self._end)

    def cut(self, time: int) -> None:
        """Judge it by the samples before a time in ns, at which another takes its place."""
        # Its outcome is another then, also if the finding is not.
        self._cut, self._told = time, None

    def miss(self, reason: str) -> None:
        """Record that the setpoint is not carried out, whatever the samples have shown so far."""
        if self.found is None or self.found.verdict is not Code.MISSED:
            self.found, self.over, self.unreported = missed(self.setpoint, reason), True, True
            self._judging = None

    # -- samples -------------------------------------------------------------------------------

    def add(
            self, stamps: Sequence[int], stretches: Sequence[float], now: int,
            steady: int) -> None:
        """
        Add samples that are read at a time in ns, and at a steady time in ns.

        Those with a timestamp in the future are left out. Old ones show that newer ones may
        follow.
        """
        if self.over:
            return
        closes, looks, newest = self._closes, 2 * self._length, max(stamps)
        if closes < min(stamps) and newest <= now + AHEAD:
            # It only waits to be judged.
            self._newest = max(self._newest, newest)
            return
        # Most samples are from the first looks after the arrival, in which all of them count.
        first, last = max(self.asked, self._begin), self._begin + looks
        last = min(closes if closes - looks <= last else last, now + AHEAD)
        if self._cut is not None:
            last = min(last, self._cut - 1)
        samples = self._samples
        for stamp, stretch in zip(stamps, stretches, strict=True):
            if first <= stamp <= last:
                samples.setdefault(stamp, stretch)
            else:
                self._add(stamp, stretch, now, steady)
        counted = max((x for x in stamps if first <= x <= last), default=0)
        self._hear(counted, steady)
        self._newest = max(self._newest, counted)

    def _add(self, stamp: int, stretch: float, now: int, steady: int) -> None:
        """Add a sample of any time."""
        if stamp <= self._closes:
            self._hear(stamp, steady)
        if stamp > now + AHEAD:
            self._ahead = max(self._ahead, stamp - now)
            return
        self._newest = max(self._newest, stamp)
        if (self._cut is None or stamp < self._cut) and self._counts(stamp):
            self._samples.setdefault(stamp, stretch)
            if stamp < self.asked:
                self._moving.add(self._cell(stamp))

    def _hear(self, stamp: int, steady: int) -> None:
        if stamp > self._seen:
            self._seen, self._heard = stamp, steady

    def _counts(self, stamp: int) -> bool:
        """Return whether a timestamp is in one of the looks."""
        begins, asked = self.setpoint.begins, self.asked
        if stamp < min(asked, self._begin):
            return stamp >= begins and self._cell(stamp) not in self._moving
        if stamp > self._closes:
            return False
        return stamp >= self._closes - 2 * self._length or any(
            self._looks_at(stamp - x) for x in {asked, self._begin} if x <= stamp)

    def _cell(self, stamp: int) -> int:
        """Return the number of the part of the move that contains a timestamp."""
        begins = self.setpoint.begins
        return (stamp - begins) // max((self.asked - begins) // _MOVING, 1)

    def _looks_at(self, after: int) -> bool:
        """Return whether a time in ns after an arrival is in one of the looks."""
        if after <= 2 * self._length:
            return True
        if self._few is None:
            self._few = self._first() < ENOUGH
        looks = after // self._length
        return self._few or looks == 1 << (looks.bit_length() - 1)

    def _first(self) -> int:
        """Return the number of samples in the first look."""
        end = self._begin + self._length
        return sum(self._begin <= x <= end for x in self._samples)

    # -- judging -------------------------------------------------------------------------------

    def judge(
            self, now: int, steady: int, tolerances: Tolerances, sensor: SensorModel, *,
            observable: bool) -> Finding | None:
        """Judge if due at a time in ns; None if not due or if the finding does not change."""
        if self.unreported:
            self.unreported = False
            return self.found
        if self._judging is None:
            if self.over or not self._ready(now, steady, observable=observable):
                return None
            self._judging = self._judge(tolerances, sensor)
        try:
            next(self._judging)
        except StopIteration as end:
            self._judging = None
            found: Finding | None = end.value
            return found
        return None

    def _judge(self, tolerances: Tolerances, sensor: SensorModel) -> Awaited[Finding | None]:
        """Judge the samples up to the due time; return the finding if it changed."""
        # Only samples up to the due time count, whenever the judging runs.
        after, setpoint = self.due - self._begin, self.setpoint
        if self._grace > self._begin:
            # Use the samples of the second half of the time, or of the last looks.
            setpoint = replace(setpoint, end=None, moved=(
                self._begin + after // 2 if self.due < self._closes
                else self._closes - 2 * self._length))
        elif self._again and (begin := self._resumed(self._newest)) is not None:
            setpoint = replace(setpoint, end=None, moved=begin)
        found = yield from self.judged(
            setpoint, self._goal or tolerances, sensor=sensor, until=self.due)
        self.news = bool(self._samples)
        self._answer = setpoint, found
        self.over = self.due >= self._closes or self.due >= self._enough and not (
            found.open or found.failed and self.due < self._grace)
        last = self._closes if self.due >= self._enough else self._enough
        due = self._begin + max(2 * after, self._length)
        # Not twice within a short time.
        self.due = due if last - due >= after else last
        before = self.found
        if before is not None and found.open and (
                before.failed or before.arrived and found.verdict is Code.UNOBSERVED):
            # A shown miss stays a miss, and an arrival stays one until samples leave it open.
            found = before
        elif self.over and found.open and self._arrived is not None:
            # It has arrived before a correction that left too little time to judge it anew.
            found = self._arrived
        self.found = found
        same = before is not None and before.verdict is found.verdict
        if found == self._told or same and not self.over:
            return None
        self._told = found
        return found

    def rests(self, now: int, *, observable: bool) -> bool:
        """Return whether there is nothing to judge at a time in ns."""
        if self.unreported or self._judging is not None:
            return False
        return self.over or now < (self._next_look if observable else self._begin)

    def wake(self, now: int) -> int:
        """Return the time in ns at which to judge next; 0 for now."""
        if self.unreported:
            return 0
        if self._judging is not None:
            return now + ANSWER
        return self._begin if now < self._begin else (
            self._next_look if now < self._next_look else 0)

    @property
    def _next_look(self) -> int:
        """Time in ns at which to judge next."""
        return self.due if self._cut is None else min(self.due, self._cut)

    def _ready(self, now: int, steady: int, *, observable: bool) -> bool:
        if now >= self._begin and not observable and not self._samples:
            self.due = self._closes
            return True
        if now < self._next_look:
            return False
        closes = self._closes if self._cut is None else min(self._closes, self._cut)
        if self._newest >= self.due and self._first() < ENOUGH:
            self.due = max(self.due, min(self._begin + _RARE, self._closes))
        if self._newest >= closes and self._waits_again():
            return False
        if self._newest >= self.due:
            return True
        if self._newest >= closes:
            # Another setpoint has taken its place.
            self.due = self._closes
            return True
        if now < closes:
            return False
        if not self._waits:
            # Samples may still wait to be read.
            self._waits, self._heard = True, steady
        if steady - self._heard <= _PATIENCE:
            return False
        self.due = self._closes
        return True

    def _waits_again(self) -> bool:
        """Return whether samples after the arrival are lost and later ones can show the rest."""
        if self._again or not self.setpoint.held or self._cut is not None:
            return False
        begin = self._resumed(self._newest)
        if begin is None or begin > self._begin + _LOST:
            return False
        self._again = True
        self.due = begin + self._length
        self._closes = max(self._closes, begin + 2 * self._length)
        return self._newest < self.due

    def _resumed(self, newest: int) -> int | None:
        """Return when samples came again after a gap in the first look; None without one."""
        stamps = np.array(sorted(x for x in (*self._samples, newest) if x >= self._begin))
        gaps = np.diff(stamps, prepend=self._begin)
        # Few samples have a longer look.
        look = max(self._length, ENOUGH * int(np.median(gaps[1:])) if len(gaps) > 2 else 0)
        lost = np.flatnonzero((2 * gaps > look) & (stamps - gaps < self._begin + look))
        return int(stamps[lost[-1]]) if len(lost) else None

    def shown(self, setpoint: RequestedSetpoint, *, sensor: SensorModel) -> Awaited[Finding]:
        """Return the last finding of a setpoint, or judge it."""
        if self._answer is not None and self._answer[0] == setpoint:
            return self._answer[1]
        return (yield from self.judged(setpoint, sensor=sensor))

    def judged(
            self, setpoint: RequestedSetpoint, tolerances: Tolerances = _TOLERANCES, *,
            sensor: SensorModel, until: int | None = None) -> Awaited[Finding]:
        """Judge the samples up to a time in ns as those of a setpoint."""
        samples = self._samples if until is None else {
            x: y for x, y in self._samples.items() if x <= until}
        if not samples:
            return unobserved(
                setpoint, self._ahead and (
                    f'timestamps of samples are up to {self._ahead / NANOSECONDS:.3g} s ahead '
                    'of the clock') or '')
        stamps = np.fromiter(samples, dtype=np.int64, count=len(samples))
        values = np.fromiter(samples.values(), dtype=np.float64, count=len(stamps))
        finding: Finding = yield from self._doing(
            partial(judge, sensor=sensor), stamps, values, setpoint, tolerances)
        return finding
