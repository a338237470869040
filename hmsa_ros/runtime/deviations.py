"""Late, lost and foreign commands, and the new plans that they require."""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
import math

import numpy as np

from hmsa.errors import HmsaError
from hmsa.model.status import Code
from hmsa.model.units import NANOSECONDS
from hmsa.planning.group import PlannerGroup, resumed, Resumption
from hmsa.planning.lateness import (
    aims,
    better_than_keeping,
    compared,
    expected,
    Lateness,
    SHARE,
    step_of,
)
from hmsa.planning.planner import Planner
from hmsa.planning.timeline import Draft, Options
from hmsa_ros.runtime.planning_task import PlanningTask, Replanning, replanning
from hmsa_ros.runtime.receipts import Receipts
from hmsa_ros.runtime.records import Settings, Severity, Verdict
from hmsa_ros.timekeeping import Throttle

# Fraction of a period by which commands may be late and are still sent.
_PART = 0.25
# Longest gap between samples, and between receipts, in ns, for their times to be used.
_UNSEEN, _SILENT = 2 * NANOSECONDS, 10 * NANOSECONDS
# Shortest time in ns between two evaluations of a plan that is kept.
_PAUSE = 20_000_000
# Time in ns until receipts show why commands are late; there are five a second.
_CAUSE = 400_000_000
# Number of commands per joint whose sending time is stored, and of those whose level is: a second
# of a path at 1 kHz.
_REMEMBERED, _COMMANDED = 64, 1000


@dataclass
class _Newest:
    """The newest report of a kind; times in ns."""

    stamp: int = 0  # its timestamp; 0 for none
    _looked: int = 0  # that at the last look
    _since: int = 0  # time of the look that found it changed

    def is_recent(self, now: int, silence: int) -> bool:
        """Return whether there was a new one within a time; to be called at each look."""
        if self.stamp != self._looked:
            self._looked, self._since = self.stamp, now
        return self.stamp != 0 and now - self._since < silence


class Deviations:
    """Compare levels that took effect with the plans."""

    def __init__(
            self, group: PlannerGroup, receipts: Receipts, note: Callable[[str], None]) -> None:
        self._group, self._receipts, self._note = group, receipts, note
        self.lateness = Lateness()
        # Timestamp in ns and level in T of the newest change that took effect.
        self.newest: dict[str, tuple[int, float]] = {}
        self.astray: set[str] = set()  # joints that deviate from their plan
        self._unsent: set[str] = set()  # those whose plan has lost unsent levels
        self.verdicts: list[Verdict] = []  # verdicts to be reported
        self.replanned = 0  # number of replannings
        # By joint: accumulated unplanned vibration, and time in ns of the next evaluation.
        self._strayed: dict[str, float] = {}
        self._again: dict[str, int] = {}
        # By joint and timestamp in ns: when a command was sent.
        self._sent: dict[str, dict[int, int]] = {}
        # By joint: commanded levels in T, from the last one that took effect on.
        self._commanded: dict[str, deque[float]] = {}
        # Messages about saturated amplifiers, and the limits as given.
        self._saturated: dict[str, tuple[str, Options]] = {}
        # Joints that may deviate, and the timestamp of the unconfirmed command.
        self._suspected: dict[str, int] = {}
        self._sampled, self._received = _Newest(), _Newest()  # sample and receipt
        # Age in ns of each joint's newest change when it was reported.
        self._ages: dict[str, int] = {}
        self._found: dict[str, Resumption] = {}
        self._advise_at: int | None = None  # steady time in ns at which to advise on lateness
        self._late_due, self._foreign_due, self.replanned_due = Throttle(), Throttle(), Throttle()

    def restart(self, *, levels: bool = False) -> None:
        """Discard the state of plans that are dropped, and all times; optionally keep levels."""
        if not levels:
            # With levels, a cut-off can be acknowledged before the next report.
            self.newest.clear()
        for name in self._group.planners:
            self.forget_times(name)

    def forget_times(self, joint: str) -> None:
        """Discard the times of a device whose clock was set, and keep its level."""
        if joint in self.newest:
            self.newest[joint] = 0, self.newest[joint][1]
        self._suspected.pop(joint, None)
        self._ages.pop(joint, None)
        self._sampled, self._received = _Newest(), _Newest()
        self.dropped([joint])

    def dropped(self, joints: Iterable[str]) -> None:
        """Discard the state of joints whose plans are replaced."""
        for name in joints:
            self.astray.discard(name)
            self._unsent.discard(name)
            self._strayed.pop(name, None)
            self._again.pop(name, None)

    def asked(self, joints: Iterable[str]) -> None:
        """Restore the limits of saturated amplifiers, since there is a new request."""
        for name in joints:
            if name in self._saturated:
                _, options = self._saturated.pop(name)
                self._limit(name, options.flux_density_min, options.flux_density_max)

    def _limit(self, name: str, least: float, most: float) -> None:
        planner = self._group.planners[name]
        planner.take_model(replace(planner.base, options=replace(
            planner.base.options, flux_density_min=least, flux_density_max=most)))

    # -- commands and their effects -------------------------------------------------------------

    def sent(
            self, joint: str, stamp: int, flux_density: float, now: int, *, level: bool) -> None:
        """Record that a command was sent: a new ``level``, or one again."""
        commanded = self._commanded.setdefault(joint, deque(maxlen=_COMMANDED))
        if not commanded or commanded[-1] != flux_density:
            commanded.append(flux_density)
        if not level:
            return
        sent = self._sent.setdefault(joint, {})
        sent.pop(stamp, None)
        sent[stamp] = now
        if len(sent) > _REMEMBERED:
            del sent[next(iter(sent))]
        if stamp < now:
            self.lateness.missed(now - stamp, self._receipts.steady())
            self._report_advice()

    def applied(
            self, joint: str, stamp: int, flux_density: float, settings: Settings,
            now: int) -> None:
        """Compare a change of level that has taken effect with the plan; times in ns."""
        self.newest[joint] = stamp, flux_density
        self._ages[joint] = max(now - stamp, 0)
        tolerance, planner = settings.lateness_tolerance, self._group.planners[joint]
        own = self._commands(joint, flux_density)
        found = self._group.applied(joint, stamp, flux_density, tolerance)
        if found is None:
            return
        step = step_of(planner.plan, planner.plan.under_way(stamp))
        cost = 2.0 * found.effect / step
        if not found.foreign:
            due = stamp - found.late
            sent = self._sent.get(joint, {}).get(due)
            self.lateness.note(
                found.late, joint, due, tolerance,
                2.0 * planner.vibration(1, found.change) / step, self._receipts.steady(),
                None if sent is None else due - sent)
            expected, uneven = self.lateness.expected, self.lateness.uneven
            for other in self._group.planners.values():
                other.delay, other.uneven = expected, uneven
        self._strayed[joint] = self._strayed.get(joint, 0.0) + cost
        if (settings.replan_late and self._strayed[joint] > SHARE
                and not planner.as_sent(stamp - max(found.late, 0) - 1)
                and (stamp >= self._again.get(joint, 0) or not planner.awaiting)):
            self.astray.add(joint)
        if found.asked is not None:
            self._saturates(joint, found.asked, flux_density)
        elif found.foreign and not own and self._foreign_due():
            self._note(f'joint {joint}: {flux_density:g} T took effect but was not commanded')
        elif found.late > tolerance:
            self._report_advice()

    def _commands(self, joint: str, flux_density: float) -> bool:
        """Return whether a level in T that took effect was commanded, since the last one did."""
        # Its command may have been found lost, or replaced, before its effect was reported.
        commanded, near = self._commanded.get(joint, deque()), self._group.planners[joint].near
        place = next((i for i, x in enumerate(commanded) if near(x, flux_density)), None)
        for _ in range(place or 0):
            commanded.popleft()
        return place is not None

    def _saturates(self, joint: str, asked: float, reached: float) -> None:
        """Plan within the amplifier's actual limit until the next request."""
        options = self._group.planners[joint].options
        name = 'flux_density_max' if asked > 0.0 else 'flux_density_min'
        words = (
            f'amplifier of joint {joint} saturated: {reached:.4g} T took effect where {asked:.4g} '
            'T was commanded; until the next request, no level beyond the reached one is '
            'commanded; set '
            f'{name} to the limit of the amplifier')
        given = self._saturated.get(joint, (words, options))[1]
        self._saturated[joint] = words, given
        self._limit(
            joint, max(options.flux_density_min, reached if asked < 0.0 else -math.inf),
            min(options.flux_density_max, reached if asked > 0.0 else math.inf))
        self.verdicts.append(Verdict(Severity.WARN, Code.SATURATED, words, figures={
            'commanded': asked, 'reached': reached}))
        self._note(words)

    def drop_missed(self, now: int, tolerance: int) -> None:
        """Remove levels from the plans that are too late to be sent, e.g. after a clock jump."""
        for name, planner in self._group.planners.items():
            stamp = planner.next_stamp
            if name in self._receipts.silent or stamp is None or stamp >= now - tolerance or (
                    planner.as_sent(stamp)):
                continue
            late = max(tolerance, self._quarter(planner))
            if stamp >= now - late or not self._group.may_resume(name):
                continue
            for _ in range(planner.drop_missed(now, tolerance)):
                self.lateness.missed(now - stamp, self._receipts.steady())
            self._report_advice()
            self.replan(name)

    @staticmethod
    def _quarter(planner: Planner) -> int:
        """Return a quarter of a natural period in ns."""
        model = planner.model
        return model.ns(_PART * 2.0 * math.pi / model.frequency(planner.last_sent.stretch))

    def doubts(self, name: str) -> bool:
        """Return whether a level of a joint may be lost, as the next look will show."""
        return name in self._suspected

    def lost(self, name: str) -> bool:
        """Return whether levels of a joint are lost, until the rest is planned anew."""
        return name in self._unsent and name in self.astray

    def replan(self, name: str) -> None:
        """Have the rest planned anew for a joint, since its levels do not take effect."""
        self._strayed[name] = math.inf  # whatever lateness is expected
        self.astray.add(name)
        self._unsent.add(name)

    def seen(self, stamp: int, *, sampled: bool = False) -> None:
        """Record a receipt, or a sample, of a timestamp in ns."""
        newest = self._sampled if sampled else self._received
        newest.stamp = max(newest.stamp, stamp)

    def look_for_unheard(self, now: int) -> None:
        """Find commands that took no effect; reports may be as late as commands."""
        before, self._suspected = self._suspected, {}
        for name, planner in self._group.planners.items():
            if name not in self.newest or name in self._receipts.silent:
                # There are no reports of applied levels, or they do not arrive either.
                continue
            reported = self._reported(name, now) - planner.options.lead_time
            stamp = planner.unheard(
                reported, reported - planner.delay - self._quarter(planner))
            if stamp is None:
                continue
            if before.get(name) != stamp or not self._receipts.since(name, stamp):
                # The report may still wait to be read, as may a receipt from after it.
                self._suspected[name] = stamp
                continue
            planner.drop_unheard(stamp)
            self.replan(name)

    def _reported(self, name: str, now: int) -> int:
        """Return the time in ns up to which a joint's reports have arrived."""
        # Reports of a busy plant are delayed, and simulated time may run slower. A plant that
        # stood still gives receipts at once, but its samples show the time it has reached.
        recent = [
            newest.stamp for newest, silence in (
                (self._sampled, _UNSEEN), (self._received, _SILENT))
            if newest.is_recent(now, silence)]
        return min(now, recent[0]) if recent else now - self._ages.get(name, 0)

    def _report_advice(self) -> None:
        if self._late_due():
            # The receipts that show the cause may still be under way.
            self._advise_at = self._receipts.steady() + (_CAUSE if self._receipts else 0)

    @property
    def advises(self) -> bool:
        """Whether advice on late commands is to be given."""
        return self._advise_at is not None

    def advise(self) -> None:
        """Give advice on late commands, if it is due."""
        if self._advise_at is not None and self._receipts.steady() >= self._advise_at:
            self._advise_at = None
            self._note(self.advice)

    @property
    def clocks(self) -> str:
        """The clock offset, if it alone makes commands late; else empty."""
        offset = self._receipts.offset
        return '' if offset is None or offset.ahead - offset.error <= 0.5 * self._lead_time else (
            offset.words)

    @property
    def _lead_time(self) -> int:
        """Lead time in ns, common to all joints."""
        return next(iter(self._group.planners.values())).options.lead_time

    @property
    def advice(self) -> str:
        """What happens to commands, and the remedy."""
        self.lateness.disturbed(self._receipts.take_disturbances())
        return f'{self.lateness.words()}; ' + (
            self.clocks or self.lateness.advice(self._lead_time))

    # -- replanning ----------------------------------------------------------------------------

    def to_resume(self) -> list[str]:
        """Return the joints whose plan may have to be replanned, once their devices report."""
        vain = [x for x in self.astray if not self._group.may_resume(x)]
        if vain:
            self.dropped(vain)
            self._report_kept()
        return sorted(self.astray - self._receipts.silent)

    def resumption(self, name: str) -> PlanningTask:
        """Return the work of replanning the rest for a joint if that reduces the error."""
        return replanning(name, self._group.planners[name], partial(self._resumed, name))

    def _resumed(self, name: str, now: int) -> Replanning | None:
        planner = self._group.planners[name]
        self._found.pop(name, None)
        plan, (start, levels) = planner.plan, planner.unknown(now)
        soonest = planner.soonest(now)
        # Setpoints that should have been reached are evaluated now: they may not have been held.
        wanted = [replace(x, arrival=max(x.arrival, soonest)) for x in aims(plan, soonest)]
        left = expected(start, levels, wanted, self.lateness) if wanted else np.zeros(1)
        if left.mean() <= SHARE:
            return None
        # Whether further reports will arrive before the move under way ends.
        news = bool(levels) and levels[0].due <= aims(plan, now)[0].arrival
        unsure = self.lateness.unsure
        if news and unsure and left.min() <= SHARE:
            self._found[name] = Resumption(None)
            return None
        found = Resumption(None)

        def draft(planner: Planner) -> Draft | None:
            nonlocal found
            found = resumed(planner, now)
            return found.draft

        def adopt(draft: Draft | None) -> Draft | None:
            if draft is None:
                return None
            before, after = compared(plan, start, levels, draft, self.lateness)
            # A plan without its lost levels is no alternative: kept, it left 1.3 of the step after
            # a stall of 1 s (row planner_stopped of the fault table).
            if name not in self._unsent and not better_than_keeping(
                    before, after, news=news, unsure=unsure):
                self._found[name] = Resumption(None, left=float(before.mean()))
                self._again[name] = 0 if unsure else now + max(_PAUSE, planner.model.ns(1.0))
                return None
            self._found[name] = found
            return draft

        return Replanning(draft, adopt)

    def take(self, work: PlanningTask, drafts: Mapping[str, Draft], now: int) -> Verdict | None:
        """Adopt a new plan made for a time in ns; None if there is nothing to report."""
        name, = work.joints
        found = self._found.pop(name, None)
        planner = self._group.planners[name]
        self.astray.discard(name)
        if found is not None and found.draft is None:
            # To be evaluated again after further reports.
            if found.left and not planner.awaiting:
                self._report_kept()
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

    def abandon(self, work: PlanningTask, error: HmsaError) -> Verdict:
        """Keep a plan that cannot even be stopped."""
        name, = work.joints
        self.dropped([name])
        return Verdict(
            Severity.ERROR, Code.NOT_CONVERGED, f'joint {name} cannot be replanned: {error}')

    def _report_kept(self) -> None:
        """Report that a new plan would not reduce the error."""
        self.verdicts.append(Verdict(
            Severity.WARN, Code.LATE, f'{self.advice}; a new plan would not leave less',
            figures={'largest_lateness': self.lateness.largest / NANOSECONDS}))
