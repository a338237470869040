"""Late, lost and foreign commands, and the new plans that they call for."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
import math

import numpy as np

from hmsa_ros.control.lateness import Lateness
from hmsa_ros.control.receipts import Receipts
from hmsa_ros.control.records import Settings, Severity, Verdict
from hmsa_ros.control.seldom import Seldom
from hmsa_ros.control.slices import anew, Clock, Work
from hmsa_ros.control.weighing import (
    aims,
    compared,
    expected,
    SHARE,
    step_of,
    worthwhile,
)
from hmsa_ros.errors import HmsaError
from hmsa_ros.model.status import Code
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.drafting import Steps
from hmsa_ros.planning.group import PlannerGroup, Resumption
from hmsa_ros.planning.timeline import Draft, Options

# Share of a period by which commands may be sent late that are not left out.
_PART = 0.25
# How long samples may stay away, in ns, before nothing follows from their times.
_SILENT = 10 * NANOSECONDS
# Least time in ns between two looks at a plan that is left as it is.
_PAUSE = 20_000_000


class Following:
    """Holds what takes effect against the plans."""

    def __init__(
            self, group: PlannerGroup, receipts: Receipts, note: Callable[[str], None]) -> None:
        self._group, self._receipts, self._note = group, receipts, note
        self.lateness = Lateness()
        # Stamp in ns and level in T of the newest change that took effect.
        self.newest: dict[str, tuple[int, float]] = {}
        self.astray: set[str] = set()  # joints whose plan reality has left
        self._unsent: set[str] = set()  # those of them whose plan has lost levels never sent
        self.verdicts: list[Verdict] = []  # to be given
        self.replanned = 0  # plans made anew
        # By joint, vibration that is not planned for, and from when on to look at it again, in ns.
        self._strayed: dict[str, float] = {}
        self._again: dict[str, int] = {}
        # What amplifiers that saturate do, and their limits as they are given.
        self._saturated: dict[str, tuple[str, Options]] = {}
        # Joints that may have left their plan, and the stamp of what was not heard of.
        self._suspected: dict[str, int] = {}
        # Time in ns of the newest report, the same at the last look, and when that was new. By
        # joint, how old the newest change was when it was heard of, in ns.
        self._newest_seen = 0
        self._looked = 0, 0
        self._ages: dict[str, int] = {}
        self._found: dict[str, Resumption] = {}
        self._tell_late, self._tell_foreign, self.tell_replanned = Seldom(), Seldom(), Seldom()

    def restart(self) -> None:
        """Forget what belongs to plans that are dropped."""
        self.newest.clear()
        self._suspected.clear()
        self._ages.clear()
        self._newest_seen = 0
        self.dropped(list(self._group.planners))

    def dropped(self, joints: Iterable[str]) -> None:
        """Forget what belongs to plans of joints that others take the place of."""
        for name in joints:
            self.astray.discard(name)
            self._unsent.discard(name)
            self._strayed.pop(name, None)
            self._again.pop(name, None)

    def asked(self, joints: Iterable[str]) -> None:
        """Try again what an amplifier can do, since somebody asks for something."""
        for name in joints:
            if name in self._saturated:
                _, options = self._saturated.pop(name)
                self._limit(name, options.flux_density_min, options.flux_density_max)

    def _limit(self, name: str, least: float, most: float) -> None:
        planner = self._group.planners[name]
        planner.take_model(replace(planner.model, options=replace(
            planner.options, flux_density_min=least, flux_density_max=most)))

    # -- commands and their effects -------------------------------------------------------------

    def sent(self, joint: str, stamp: int, now: int) -> None:
        """Take in that a command was handed out."""
        self.lateness.sent(joint, stamp, now)
        if stamp < now:
            self.lateness.missed(now - stamp)
            self._tell_advice()

    def applied(
            self, joint: str, stamp: int, flux_density: float, settings: Settings,
            now: int) -> None:
        """Hold a change of level that has taken effect against the plan; times in ns."""
        self.newest[joint] = stamp, flux_density
        self._ages[joint] = max(now - stamp, 0)
        tolerance, planner = settings.lateness_tolerance, self._group.planners[joint]
        found = self._group.applied(joint, stamp, flux_density, tolerance)
        if found is None:
            return
        step = step_of(planner.plan, planner.plan.under_way(stamp))
        cost = 2.0 * found.effect / step
        if not found.foreign:
            self.lateness.note(
                found.late, joint, stamp - found.late, tolerance,
                2.0 * planner.vibration(1, found.change) / step)
            for other in self._group.planners.values():
                other.delay = self.lateness.expected
        self._strayed[joint] = self._strayed.get(joint, 0.0) + cost
        if (settings.replan_late and self._strayed[joint] > SHARE
                and not planner.as_sent(stamp - max(found.late, 0) - 1)
                and (stamp >= self._again.get(joint, 0) or not planner.awaiting)):
            self.astray.add(joint)
        if found.asked is not None:
            self._saturates(joint, found.asked, flux_density)
        elif found.foreign and self._tell_foreign():
            self._note(f'joint {joint}: {flux_density:g} T took effect but was not commanded')
        elif found.late > tolerance:
            self._tell_advice()

    def _saturates(self, joint: str, asked: float, reached: float) -> None:
        """Plan with what an amplifier gives until somebody asks for something."""
        options = self._group.planners[joint].options
        name = 'flux_density_max' if asked > 0.0 else 'flux_density_min'
        words = (
            f'amplifier of joint {joint} saturated: {reached:.4g} T took effect where {asked:.4g} '
            'T was commanded; nothing beyond that is commanded until the next request; set '
            f'{name} to what the amplifier gives')
        given = self._saturated.get(joint, (words, options))[1]
        self._saturated[joint] = words, given
        self._limit(
            joint, max(options.flux_density_min, reached if asked < 0.0 else -math.inf),
            min(options.flux_density_max, reached if asked > 0.0 else math.inf))
        self.verdicts.append(Verdict(Severity.WARN, Code.SATURATED, words, figures={
            'commanded': asked, 'reached': reached}))
        self._note(words)

    def drop_missed(self, now: int, tolerance: int) -> None:
        """Take out of the plans what is too late to be sent, as after a jump of the clock."""
        for name, planner in self._group.planners.items():
            stamp = planner.next_stamp
            if name in self._receipts.silent or stamp is None or stamp >= now - tolerance or (
                    planner.as_sent(stamp)):
                continue
            model = planner.model
            late = max(tolerance, model.ns(_PART * 2.0 * math.pi / model.frequency(
                planner.last_sent.stretch)))
            if stamp >= now - late or not self._group.may_resume(name):
                continue
            for _ in range(planner.drop_missed(now, tolerance)):
                self.lateness.missed(now - stamp)
            self._tell_advice()
            self._leaves(name)
            self._unsent.add(name)

    def _leaves(self, name: str) -> None:
        """Note that a joint has left its plan, whatever is expected of commands."""
        self._strayed[name] = math.inf
        self.astray.add(name)

    def seen(self, stamp: int) -> None:
        """Take in that plant or driver has reported something of a time in ns."""
        self._newest_seen = max(self._newest_seen, stamp)

    def look_for_unheard(self, now: int) -> None:
        """Find plans that reality has left without a word; news may be as late as commands."""
        before, self._suspected = self._suspected, {}
        for name, planner in self._group.planners.items():
            if name not in self.newest:
                # Nobody reports what took effect.
                continue
            stamp = planner.unheard(self._reported(name, now) - planner.options.lead_time)
            if stamp is None:
                continue
            if before.get(name) != stamp:
                # It may wait to be read.
                self._suspected[name] = stamp
                continue
            planner.drop_unheard(stamp)
            self._leaves(name)

    def _reported(self, name: str, now: int) -> int:
        """Return up to which time in ns a joint's reports have come."""
        # A plant that is busy reports later, and simulated time may be slower.
        if self._newest_seen != self._looked[0]:
            self._looked = self._newest_seen, now
        sampled = self._newest_seen and now - self._looked[1] < _SILENT
        return min(now, self._newest_seen) if sampled else now - self._ages.get(name, 0)

    def _tell_advice(self) -> None:
        if self._tell_late():
            self._note(self.advice)

    @property
    def clocks(self) -> str:
        """How the clocks differ, where that alone makes commands late; empty where it does not."""
        offset = self._receipts.offset
        return '' if offset is None or offset.ahead - offset.error <= 0.5 * self._lead_time else (
            offset.words)

    @property
    def _lead_time(self) -> int:
        """How far ahead of their stamps commands are sent in ns, those of all joints."""
        return next(iter(self._group.planners.values())).options.lead_time

    @property
    def advice(self) -> str:
        """What happens to commands, and what helps."""
        return f'{self.lateness.words()}; ' + (
            self.clocks or self.lateness.advice(self._lead_time))

    # -- plans made anew -----------------------------------------------------------------------

    def to_resume(self) -> list[str]:
        """Return joints whose plan is perhaps to be made anew."""
        vain = [x for x in self.astray if not self._group.may_resume(x)]
        if vain:
            self.dropped(vain)
            self._tell_kept()
        return sorted(self.astray)

    def resumption(self, name: str, clock: Clock) -> Work:
        """Return the work of planning a joint's rest anew, where that leaves less."""
        return anew(
            name, self._group.planners[name], partial(self._resumed, name), clock)

    def _resumed(self, name: str, now: int) -> Steps[Draft | None]:
        planner = self._group.planners[name]
        self._found.pop(name, None)
        plan, (start, levels) = planner.plan, planner.unknown(now)
        soonest = planner.soonest(now)
        # What was to be reached before now is looked at now: it may not have been held.
        wanted = [replace(x, arrival=max(x.arrival, soonest)) for x in aims(plan, soonest)]
        left = expected(start, levels, wanted, self.lateness) if wanted else np.zeros(1)
        if left.mean() <= SHARE:
            return None
        # Whether there will be news before the move under way ends.
        news = bool(levels) and levels[0].due <= aims(plan, now)[0].arrival
        unsure = self.lateness.unsure
        if news and unsure and left.min() <= SHARE:
            self._found[name] = Resumption(None)
            return None
        yield
        found = yield from self._group.draft_resumption(name, now)
        if found.draft is None:
            return None
        before, after = compared(plan, start, levels, found.draft, self.lateness)
        # Without its levels the plan is no alternative: kept, it left 1.3 of the step after
        # a stall of 1 s (row planner_stopped of the fault table).
        if name not in self._unsent and not worthwhile(before, after, news=news, unsure=unsure):
            found = Resumption(None, left=float(before.mean()))
            self._again[name] = 0 if unsure else now + max(_PAUSE, planner.model.ns(1.0))
        self._found[name] = found
        return found.draft

    def take(self, work: Work, drafts: Mapping[str, Draft], now: int) -> Verdict | None:
        """Take a plan made anew for a time in ns; None if nothing was left to do."""
        name, = work.joints
        found = self._found.pop(name, None)
        planner = self._group.planners[name]
        self.astray.discard(name)
        if found is not None and found.draft is None:
            # To be looked at again when there is news.
            if found.left and not planner.awaiting:
                self._tell_kept()
            return None
        self.dropped([name])
        if found is None:
            return None
        self._group.resume(name, found, now)
        why = self._saturated[name][0] if name in self._saturated else ''
        if found.refusal:
            return Verdict(
                Severity.ERROR, Code.SATURATED if why else Code.STOPPED, f'{why}; ' * bool(why) +
                f'joint {name} comes to rest, since its sequence cannot be resumed: '
                f'{found.refusal}')
        self.replanned += 1
        missed = drafts[name].missed
        return Verdict(
            Severity.WARN, Code.SATURATED if why else Code.REPLANNED,
            (why or 'commands did not take effect as planned') + ': the rest is replanned' + (
                f', without {missed} setpoints whose time has passed' if missed else ''))

    def abandon(self, work: Work, error: HmsaError) -> Verdict:
        """Leave a plan as it is that cannot even be stopped."""
        name, = work.joints
        self.dropped([name])
        return Verdict(
            Severity.ERROR, Code.NOT_CONVERGED, f'joint {name} cannot be replanned: {error}')

    def _tell_kept(self) -> None:
        """Give the verdict where a new plan does not help."""
        self.verdicts.append(Verdict(
            Severity.WARN, Code.LATE, f'{self.advice}; a new plan would not leave less',
            figures={'largest_lateness': self.lateness.largest / NANOSECONDS}))
