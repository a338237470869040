"""Which samples show whether setpoints are arrived at, and what they show."""

from collections.abc import Iterator
from dataclasses import dataclass, field
import math

import numpy as np

from hmsa_ros.core.group import PlannerGroup
from hmsa_ros.core.law import critical_zeta
from hmsa_ros.core.timeline import Plan, PlannedSegment
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.runtime.measured import CODES, Expected, Finding, judge, Tolerances, unobserved
from hmsa_ros.runtime.slices import Clock

# Periods of vibration that are looked at after an arrival, and time in ns if samples are rare.
_PERIODS = 6
_RARE = NANOSECONDS // 4
# Samples of the first periods that are enough, and how many are kept of each period at most.
_ENOUGH = 24
_KEPT = 40
# Windows of a joint that wait for their samples.
_OPEN = 8
# How long samples may stay away, by the steady clock, before it is judged without them.
_PATIENCE = NANOSECONDS // 2


@dataclass
class _Window:
    """A time in ns in which samples show how a setpoint is held."""

    segment: PlannedSegment
    expected: Expected
    begin: int
    # First periods, all of it, and length of the grid of which one sample a cell is kept.
    early: int
    end: int
    cell: int
    samples: dict[int, tuple[int, float]] = field(default_factory=dict)
    # Newest sample of the joint by its stamp; of all that were looked at before the end, and when
    # that was.
    newest: int = 0
    seen: int = 0
    heard: int = 0

    def lacks(self, stamp: int, steady: int) -> bool:
        """Return whether a sample of a time is of use; old ones show that newer ones may come."""
        if self.seen < stamp <= self.end:
            self.seen, self.heard = stamp, steady
        return stamp >= self.begin and (
            stamp > self.newest or (stamp - self.begin) // self.cell not in self.samples)

    def add(self, stamp: int, stretch: float, now: int) -> None:
        """Take a sample; the first of each cell counts, and none is from the future."""
        if stamp < self.begin:
            return
        self.newest = max(self.newest, min(stamp, now))
        if stamp <= self.end and math.isfinite(stretch):
            self.samples.setdefault((stamp - self.begin) // self.cell, (stamp, stretch))

    def chosen(self) -> list[tuple[int, float]]:
        """Return the samples to be judged: those of the first periods, if they are enough."""
        samples = sorted(self.samples.values())
        early = [x for x in samples if x[0] <= self.early]
        return early if len(early) >= _ENOUGH else samples

    def complete(self) -> bool:
        """Return whether there are all samples that count."""
        return self.newest >= self.end or self.newest >= self.early and (
            sum(x <= self.early for x, _ in self.samples.values()) >= _ENOUGH)


@dataclass
class _Joint:
    """What is watched of a joint, and what was found since its last request."""

    number: int = 0
    plan: Plan | None = None
    # Place of the next setpoint to watch.
    place: int = 0
    windows: list[_Window] = field(default_factory=list)
    newest: Finding | None = None
    worst: Finding | None = None


class Watch:
    """Looks at samples after each arrival, and judges them."""

    def __init__(self, group: PlannerGroup, steady: Clock) -> None:
        self._group, self._steady = group, steady
        self._joints: dict[str, _Joint] = {}
        # Reading a clock for each sample of each joint would take longer than all else.
        self._now = 0
        self.restart()

    def restart(self) -> None:
        """Forget everything; what is planned by now is not judged."""
        self._joints = {
            name: _Joint(x.plan.number, x.plan, len(x.plan.segments))
            for name, x in self._group.planners.items()}

    @property
    def open(self) -> bool:
        """Whether setpoints that hold have not been judged yet."""
        return any(x.windows for x in self._joints.values())

    @property
    def finished(self) -> bool:
        """Whether the last setpoints have been judged."""
        return not self.open and all(
            x.expected.setpoint == x.expected.setpoints for x in self.findings.values())

    @property
    def findings(self) -> dict[str, Finding]:
        """Return the newest finding of each joint, where there is one."""
        return {
            name: x.newest for name, x in self._joints.items() if x.newest is not None}

    @property
    def worst(self) -> Finding | None:
        """Return the worst that was found since the last request of each joint."""
        found = [x.worst for x in self._joints.values() if x.worst is not None]
        return max(found, key=_rank, default=None)

    def again(self, name: str) -> None:
        """Judge the setpoint of a joint that is under way anew, since its plan was corrected."""
        joint = self._joints[name]
        newest = joint.newest
        if newest is None or joint.plan is None or newest.expected.setpoint != (
                joint.place - joint.plan.kept):
            return
        joint.newest = None
        if joint.worst is newest:
            joint.worst = None

    def wake(self, now: int) -> int | None:
        """Return when to judge next, a time in ns; None for never, 0 for now."""
        times = [
            x.begin if now < x.begin else x.early if now < x.early else 0
            for joint in self._joints.values() for x in joint.windows]
        return min(times, default=None)

    # -- windows -------------------------------------------------------------------------------

    def follow(self, now: int) -> None:
        """Watch the setpoints that have begun by a time in ns, as planned by now."""
        for name, planner in self._group.planners.items():
            joint, plan = self._joints[name], planner.plan
            if plan is not joint.plan:
                self._change(joint, plan, now)
            elif joint.place >= len(plan.segments) or plan.segments[joint.place].since > now:
                continue
            last = plan.under_way(now)
            for place in range(max(joint.place, last - _OPEN, plan.kept), last + 1):
                joint.windows += self._windows(name, plan, place)
            joint.place = max(joint.place, last + 1)

    def _change(self, joint: _Joint, plan: Plan, now: int) -> None:
        """Go over to another plan; what it leaves out is not judged."""
        if plan.number != joint.number:
            joint.number, joint.newest, joint.worst = plan.number, None, None
            joint.place = plan.kept
        joint.plan = plan
        current = plan.segments[plan.kept:]
        judged = [x.segment for x in joint.windows]
        joint.windows = [x for x in joint.windows if x.segment in current]
        if len(judged) > len(joint.windows):
            joint.place = min(joint.place, max(plan.under_way(now), plan.kept))

    def _windows(self, name: str, plan: Plan, place: int) -> Iterator[_Window]:
        segment = plan.segments[place]
        if segment.arrival is None:
            return
        end = plan.segments[place + 1].begin if place + 1 < len(plan.segments) else None
        model = plan.level(segment.arrival).model
        omega = model.frequency(segment.stretch) / model.units.time
        ratio = model.material.zeta / critical_zeta(segment.stretch, model.material.packed)
        start = plan.segments[place - 1].stretch if place > plan.kept else (
            plan.level(segment.begin).stretch)
        expected = Expected(
            segment.stretch, start, omega, ratio * omega,
            name if len(self._joints) > 1 else '', place - plan.kept + 1,
            len(plan.segments) - plan.kept)
        period = round(2 * math.pi / omega * NANOSECONDS)
        length = max(_PERIODS * period, _RARE)
        begins = [segment.arrival]
        if end is not None and end - segment.arrival > 3 * length:
            # Whether it has stayed there.
            begins.append(end - length)
        for begin in begins:
            last = begin + length if end is None else min(begin + length, end)
            yield _Window(
                segment, expected, begin, min(begin + _PERIODS * period, last), last,
                max(period // _KEPT, length // 1000, 1))

    # -- samples -------------------------------------------------------------------------------

    def wants(self, stamp: int) -> bool:
        """Return whether a sample of a time in ns is of use for one of the joints."""
        steady, wanted = self._steady(), False
        for joint in self._joints.values():
            for window in joint.windows:
                wanted |= window.lacks(stamp, steady)
        return wanted

    def add(self, name: str, stamp: int, stretch: float) -> None:
        """Take in a stretch measured at a stamp in ns; samples may come in any order."""
        if name in self._joints:
            for window in self._joints[name].windows:
                window.add(stamp, stretch, self._now)

    def judge(self, now: int, tolerances: Tolerances, *, observable: bool) -> Finding | None:
        """Judge one setpoint, if one can be judged by a time in ns and changes what is known."""
        self._now = now
        for joint in self._joints.values():
            for window in list(joint.windows):
                if not self._over(window, now, observable):
                    continue
                joint.windows.remove(window)
                found = _judged(window, tolerances)
                again = joint.newest is not None and joint.newest.expected == found.expected
                if again and _rank(found) <= _rank(joint.newest):
                    continue
                joint.newest = found
                joint.worst = max(
                    (x for x in (found, joint.worst) if x is not None), key=_rank)
                return found
        return None

    def _over(self, window: _Window, now: int, observable: bool) -> bool:
        """Return whether no samples of a window are to be waited for any more."""
        if now < window.begin:
            return False
        if window.complete() or not observable:
            return True
        if now < window.end:
            return False
        window.heard = window.heard or self._steady()
        return self._steady() - window.heard > _PATIENCE


def _judged(window: _Window, tolerances: Tolerances) -> Finding:
    samples = window.chosen()
    if not samples:
        return unobserved(window.expected)
    stamps, stretches = zip(*samples, strict=True)
    time = (np.array(stamps, dtype=np.int64) - window.begin) / NANOSECONDS
    return judge(time, np.array(stretches), window.expected, tolerances)


def _rank(found: Finding | None) -> int:
    return -1 if found is None else CODES.index(found.code)
