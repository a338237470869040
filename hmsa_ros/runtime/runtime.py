"""
A planner at work: takes requests, receipts and samples, and returns commands and verdicts.

Does not depend on ROS. The caller calls `Runtime.tick` with the time of its clock, at the
latest at `Runtime.wake`, and delivers the returned outputs: a node to topics, a loop
directly to the coil.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
import math
import re

from hmsa.model.sensor import Sample
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa.planning import path
from hmsa.planning.group import PlannerGroup
from hmsa.planning.timeline import JointModel
from hmsa_ros.runtime.arrival_monitor import ArrivalMonitor
from hmsa_ros.runtime.command_link import CommandLink
from hmsa_ros.runtime.deviations import Deviations
from hmsa_ros.runtime.follower import Follower, import_feedback
from hmsa_ros.runtime.receipts import Receipts
from hmsa_ros.runtime.records import (
    accepted,
    by_joint,
    Environment,
    Note,
    ObservedSample,
    Output,
    Request,
    Samples,
    Settings,
    Severity,
    Stop,
    StretchRequest,
    Trajectory,
    Verdict,
)
from hmsa_ros.runtime.reporting import LOOK, Reporting
from hmsa_ros.runtime.request_queue import RequestQueue, SLICE
from hmsa_ros.runtime.stops import Stops
from hmsa_ros.runtime.takeover import SampleTimeout, Takeover
from hmsa_ros.runtime.temperatures import Temperatures
from hmsa_ros.runtime.worker import Job
from hmsa_ros.timekeeping import clock_set_words, Throttle

# In ns by the steady clock: delay of a service that is a stall of this process; time that the
# middleware then takes to deliver what has arrived; and time within which a device that is within
# reach gives a receipt, of which there are five a second.
_STALL, _SETTLE, _OWED = 200_000_000, 50_000_000, 800_000_000
# Heartbeats without which a watchdog is not expected to trip.
_LOST = 2
# Clock jumps that follow each other within this time are reported once.
_STORM = NANOSECONDS
# A name that no other request has: 128 random bits.
_UNIQUE = re.compile('[0-9a-f]{32}')
_WAITING = Verdict(
    Severity.OK, Code.WAITING,
    'accepted: starts as soon as the current state is known, and feedback has started')


class Runtime:
    """Plan requests in slices, send commands in time and track their effects."""

    def __init__(
            self, group: PlannerGroup, settings: Settings, environment: Environment) -> None:
        self.group = group
        self.settings = settings
        if settings.trajectory_mode == 'path':
            path.prepare()
        self.active = False
        #: Refuses requests except stops, while several planners or devices are running.
        self.crowded: RefusedError | None = None
        self.clock_jumps = 0
        # Time in ns by which the clock was set ahead since `tick` last processed that.
        self._stepped = 0

        def clock() -> int:
            # A clock that is set continues unchanged until that is processed.
            return environment.clock() - self._stepped
        around = self.environment = replace(environment, clock=clock)
        self._clock, self._steady = clock, around.steady
        self._outputs: list[Output] = []
        receipts = Receipts(around.steady)
        self.deviations = Deviations(group, receipts, self._note)
        self.follower = Follower(group, settings)
        self._takeover = Takeover(
            group.planners, around, receipts, self.deviations.newest,
            self.follower, self._note)
        self._silence = SampleTimeout(around)
        self._watch = ArrivalMonitor(group, around, self.follower, self._outputs.append)
        self.devices = CommandLink(
            group.planners, receipts, self.deviations, self._takeover, around, self._outputs)
        self._reporting = Reporting(
            group, self.deviations, self._watch, around, self._outputs, self._note,
            lambda: around.unheard() or receipts.words, self._unseen)
        self._stops = Stops(
            group, self.devices, self.deviations.newest, self._watch, around,
            lambda: self.settings.tolerances)
        self.devices.stops = lambda: self._stops.judges
        self.temperatures = Temperatures(group, lambda: self.settings, clock, self._note)
        self.planning = RequestQueue(
            group, self.deviations, self.follower, self.temperatures, self._reporting, around,
            self.devices.send, self._stops.begin)
        self._importing: Job | None = None  # import of feedback
        self._follow()
        self._next_beat = 0  # time in ns of the next heartbeat
        # Time by the steady clock, in ns, by which the caller serves this again; None for any.
        self._next_service: int | None = None
        # Time until which reports are read after a stall, and joints that owe a receipt.
        self._listens_until: tuple[int, int] | None = None
        self._unheard: set[str] = set()
        self._last_jump: int | None = None
        self._set_back = 0
        self._differ = False  # whether a clock offset was reported
        self._put_off = False  # whether the last tick left plans and judging to the next one
        self._impossible_due = Throttle()

    def _follow(self) -> None:
        """Begin feedback from samples, once it is wanted and imported."""
        if self._importing is not None:
            if not self._importing.done():
                return
            self._importing.result()
            self._importing = None
        if self.settings.feedback != 'off' and self.follower.open_loop:
            self.follower = import_feedback()(
                self.group, self.settings, self._outputs, self._clock, self._report_ended,
                self.follower.doing)
            self.planning.follower = self._watch.follower = self._takeover.follower = (
                self.follower)

    def _note(self, words: str) -> None:
        self._outputs.append(Note(Severity.WARN, words))

    # -- in ------------------------------------------------------------------------------------

    def request(self, request: Request) -> Verdict:
        """
        Accept a request, and plan it immediately for the duration of a slice.

        A request that replaces all others from now on is planned before those that wait, which are
        dropped if it can be carried out. The verdict is ``waiting`` until there is one for this
        request. A trajectory without points is a stop. A trajectory with a unique name is carried
        out once, since a client that has just been discovered may have to send it again.
        """
        if isinstance(request, Trajectory) and _UNIQUE.fullmatch(request.name) and (
                self._reporting.answered(request.name)
                or any(x.name == request.name for x in self.planning.requests)):
            self._reporting.report()
            return self._reporting.verdict
        try:
            request = accepted(
                request, tuple(self.group.planners), self.settings, self._clock(),
                active=self.active)
            if not isinstance(request, Stop):
                if self.crowded is not None:
                    raise self.crowded
                self.devices.check(request.joints)
        except RefusedError as error:
            return self.planning.refuse(error, request)
        self._process_clock()
        self.devices.since = None
        if not isinstance(request, Stop):
            if self._takeover.engaged:
                self._compare_samples(request)
            self.deviations.asked(request.joints)
        work = self.planning.add(request, engaged=self._takeover.engaged)
        self._engage(begin=True)
        while self._may_plan():
            self.planning.work_on()
            if work not in self.planning.tasks or isinstance(request, Trajectory):
                # Else, it is short work, and the caller waits for it.
                break
        if self._set_back:
            # The clock was set back during planning, so the planned times are invalid.
            return self.request(request)
        if isinstance(request, Stop) and self.devices.apart:
            # What was to stop is dropped already, and no command reaches the device in time.
            return self.planning.refuse(self.devices.differs(min(self.devices.apart)), request)
        return _WAITING if work in self.planning.tasks else self._reporting.verdict

    def _compare_samples(self, request: Trajectory | StretchRequest) -> None:
        """Have joints that are to move now compared with their samples."""
        later = isinstance(request, Trajectory) and request.stamp is not None
        now = self._clock()
        self._look_at_samples()
        self._takeover.check(
            x for x in request.joints if not (later and self.group.planners[x].moves(now)))

    def _look_at_samples(self) -> None:
        for joint, seen in self.environment.glance():
            self._takeover.observe(joint, seen)
            self._silence.record(joint, seen.stamp)

    def _unseen(self) -> str:
        self._look_at_samples()
        return self._silence.words

    def received(
            self, joint: str, time: int, command: int, *, cut_off: bool,
            locked: bool = False, late: bool = False) -> None:
        """
        Process a receipt: by its time in ns, a device has received the command of a timestamp.

        A device that was cut off rejects commands until that is acknowledged, and ``command`` is
        the time of the cut-off; one that is locked by an interlock rejects all. It has rejected
        this command if it was too ``late``.
        """
        self.deviations.seen(time)
        self._unheard.discard(joint)
        self._drop(self.devices.received(
            joint, time, None if cut_off else command, late=late))
        self._check_clock(joint)
        self.cut_off(joint, in_force=cut_off or locked, locked=locked,
                     time=command if cut_off else 0)

    def cut_off(
            self, joint: str, *, in_force: bool, locked: bool = False, time: int = 0) -> None:
        """
        Record whether a joint's device is cut off, or locked, and rejects commands.

        ``time`` in ns names the cut-off.
        """
        if locked and joint not in self.devices.open:
            self.planning.refuse_all(self.devices.interlock(joint))
            self.planning.clear()
        self._drop(self.devices.cut_off(
            joint, self.settings, in_force=in_force, locked=locked, time=time))
        if in_force and self.active and self._takeover.engaged:
            # Before the first request there are no heartbeats: released, the device would be cut
            # off again.
            self.devices.acknowledge(joint)

    def _check_clock(self, joint: str) -> None:
        """Drop the plan of a joint whose device has another time."""
        before = joint in self.devices.apart
        verdict = self.devices.check_clock(joint, self.settings)
        now = joint in self.devices.apart
        if before is not now or verdict is not None:
            # Samples from before and after do not belong to one motion.
            self.follower.restart()
            self._silence.restart()
        if now and not before:
            self.planning.refuse_all(self.devices.differs(joint))
        self._drop(verdict)

    def _drop(self, verdict: Verdict | None) -> None:
        """Report that a plan was dropped, if there is a verdict."""
        if verdict is not None:
            self._reporting.dropped(verdict)

    def applied(self, joint: str, stamp: int, flux_density: float) -> None:
        """Record that a joint's level in T was in force from a timestamp in ns on."""
        if math.isnan(flux_density):
            # The applied level is unknown.
            return
        if not self.group.planners[joint].follows(flux_density):
            if self._impossible_due():
                self._note(
                    f'joint {joint}: a report that {flux_density:g} T took effect is ignored, '
                    'since no motion can be predicted from there; see what publishes it')
            return
        now = self._clock()
        if self._stepped:
            # The timestamp is of the clock after it was set.
            self._process_clock()
            now = self._clock()
        if joint in self.devices.apart or not (
                self.devices.receipts.clock(joint).is_past(stamp, now)):
            # The clock of the device was set, and the time is unknown.
            self.deviations.newest[joint] = 0, flux_density
            if joint in self.devices.apart and self._takeover.engaged:
                # Its plan is dropped. The level applies by now, until a request replaces it.
                self.group.applied(
                    joint, now, flux_density, self.settings.lateness_tolerance)
            return
        self.follower.applied(joint, stamp, flux_density)
        if self._takeover.engaged:
            self.deviations.applied(joint, stamp, flux_density, self.settings, now)
        else:
            self.deviations.newest[joint] = stamp, flux_density

    def sampled(self, joints: Sequence[str], samples: Sequence[Sample]) -> None:
        """Process samples of all joints that have just been measured, as far as needed."""
        if samples and self.looks_at(samples[-1].time):
            now = self._clock() + self._stepped
            rows = [(time, *(x.tolist() for x in measured), now) for time, *measured in samples]
            for name, of_joint in by_joint(joints, rows):
                self.observed(name, of_joint)

    def observed(self, joint: str, samples: Samples) -> None:
        """Process samples of a joint."""
        now = self._clock()
        if self._stepped:
            samples = samples._replace(came=[x - self._stepped for x in samples.came])
        if self._takeover.waiting or not self._takeover.engaged:
            steady, one_clock = self._steady(), self.environment.one_clock()
            for stamp, stretch, rate, flux_density, came in zip(*samples, strict=True):
                self._takeover.observe(joint, ObservedSample(
                    stamp, stretch, rate, flux_density, None if one_clock else came - stamp,
                    steady - max(now - came, 0)))
        if joint in self.devices.apart:
            return
        self._watch.add(joint, samples.stamps, samples.stretch, now)
        self.follower.observed(joint, samples)

    def temperature(self, joint: str, stamp: int, celsius: float) -> None:
        """Process the temperature of a joint in degrees Celsius, of a time in ns; 0 for now."""
        self._process_clock()
        self.temperatures.measured(joint, stamp, celsius)

    def clock_set(self, by: int) -> None:
        """Record that the clock was set ahead by some ns; plans continue."""
        self.clock_jumps += 1
        self._stepped += by

    def clock_set_back(self, back: int) -> None:
        """
        Record that simulated time restarted, some ns back: the actual state is read again.

        The clock may detect this when it is read during planning, so the plans are dropped
        afterwards.
        """
        self.clock_jumps += 1
        self._set_back = max(self._set_back, back)

    def _process_clock(self) -> None:
        """Process a clock that was set, and report it."""
        back, self._set_back = self._set_back, 0
        by, self._stepped = self._stepped, 0
        if not (back or by):
            return
        requests = [] if back else self.planning.requests
        self.planning.clear()
        self.deviations.restart(levels=not back)
        self.follower.restart()
        self.devices.receipts.clock_set()
        self._silence.restart()
        self.temperatures.restart()
        if back:
            self.group.restart()
            self._watch.restart()
            self._takeover.drop()
            self._stops.drop()
            self._takeover.engaged = False
        else:
            # All plans continue as if the clock had not been set.
            self.group.clock_set(by)
            self._watch.clock_set(by)
            self._takeover.clock_set(by)
            self._next_beat += by
            for request in requests:
                # It was being planned for times that are now invalid.
                self.planning.add(request, engaged=self._takeover.engaged)
            self._reporting.show()
        last, self._last_jump = self._last_jump, self._steady()
        if last is not None and self._last_jump - last < _STORM:
            return
        self._reporting.go_on(Verdict(
            Severity.WARN, Code.CLOCK_JUMPED,
            f'the clock jumped back by {back / NANOSECONDS:.3f} s: the plan is dropped, and the '
            'actuator is assumed where it began, at initial_stretch, unless joint_states shows '
            'otherwise' if back else
            clock_set_words(by, 'planned levels apply')), log=True)

    def deactivate(self) -> None:
        """Come to rest, sending all commands for that now, and accept no more requests."""
        self._process_clock()
        self.active = False
        self.planning.clear()
        now = self._clock()
        if self._takeover.engaged and now:
            work = self.planning.add(Stop(), engaged=True)
            while not self.planning.advance(work):
                pass
            self.planning.clear()
            self.devices.send(now, everything=True)
            self._watch.restart()
            self._reporting.give(Verdict(
                Severity.OK, Code.INACTIVE, 'deactivated: coming to rest, if its commands arrive'))
        self._stops.drop()
        self._leave(now)

    def close(self) -> list[Output]:
        """End, and return the outcomes of setpoints that have none."""
        self._watch.close()
        return self._taken()

    def _leave(self, now: int) -> None:
        """Once inactive, forget where the joints are when the last level that was sent applies."""
        if not self.active and all(
                x.last_sent.stamp <= now for x in self.group.planners.values()):
            # Samples from before the joints come to rest do not show their later position.
            self._takeover.drop()
            self._takeover.engaged = False

    def change(
            self, settings: Settings, models: Mapping[str, JointModel], *,
            simultaneous: bool) -> None:
        """Adopt new settings now, and new models by joint from the next request on."""
        if settings.heartbeat_period != self.settings.heartbeat_period:
            self._next_beat = self._clock() + settings.heartbeat_period
        before, self.settings = self.settings, settings
        # Beside the loop: here, these imports would delay commands by up to some seconds.
        if settings.trajectory_mode == 'path' != before.trajectory_mode:
            self.environment.worker.submit(lambda _: path.prepare())
        if settings.feedback != 'off' and self.follower.open_loop and self._importing is None:
            self._importing = self.environment.worker.submit(lambda _: import_feedback())
        self._follow()
        for name, model in self.follower.change(settings, models).items():
            self.group.planners[name].take_model(model)
        self.temperatures.change()
        self.group.simultaneous = simultaneous

    # -- out -----------------------------------------------------------------------------------

    @property
    def wants_samples(self) -> bool:
        """Whether samples are needed now or soon."""
        return self._takeover.waiting or self.active and (
            self._watch.open or self.follower.on)

    def looks_at(self, stamp: int) -> bool:
        """Record that samples up to a timestamp in ns came; return whether to read them."""
        self.deviations.seen(stamp, sampled=True)
        return self._watch.hear(stamp) or self._takeover.waiting or self.follower.on

    @property
    def urgent(self) -> bool:
        """Whether there is work that waits for no time."""
        return bool(
            self._set_back or self._stepped or self.planning or self._takeover.waiting
            or self._outputs or self._listens_until is not None
            or self._takeover.engaged and (
                self.deviations.verdicts
                or self.deviations.astray - self.devices.receipts.silent))

    @property
    def wake(self) -> int | None:
        """Time in ns of the next work; None for never, 0 for now."""
        if self.urgent:
            return 0
        now = self._clock()
        if not self._takeover.engaged:
            return self._reporting.pending if self._importing is None else now + LOOK
        times = [
            None if self.devices.all_silent else self.group.next_command(),
            self._reporting.pending, self._reporting.next_change, self._reporting.preview_again,
            self._watch.wake(now),
            self.follower.wake]
        if not self.active:
            times.append(now)
        if self.settings.heartbeat_period:
            times.append(self._next_beat)
        if self.deviations.advises:
            times.append(now + LOOK)
        if self.devices.receipts or self._stops.open or self._importing is not None:
            times.append(now + LOOK)
        return min((x for x in times if x is not None), default=None)

    def send(self, now: int) -> list[Output]:
        """Return the commands due at a time in ns: the urgent part of `tick`."""
        self._process_clock()
        if not self._listens():
            self._send(now)
        return self._taken()

    def serve_by(self, steady: int | None) -> None:
        """Record that the caller serves this again by a steady time in ns; None for any time."""
        self._listens()
        self._next_service = steady

    def _listens(self) -> bool:
        """
        Return whether reports must be read before anything is sent or planned.

        After a stall of this process, such as a suspended computer, the coil may be off, and
        reports that say so wait to be read.
        """
        # A stall in the middle of a service is found at its end.
        steady, due = self._steady(), self._next_service
        stall = 0 if due is None else steady - due
        if stall > _STALL:
            self._next_service = None
        if stall > _STALL and self._takeover.engaged and (
                stall > _LOST * (self.settings.heartbeat_period or math.inf) or self._overdue):
            self._unheard = {*self.devices.receipts.joints}
            self._listens_until = steady + _SETTLE, steady + _OWED
            self._note(
                f'the planner stood still for {stall / NANOSECONDS:.3f} s: it reads what plant '
                'or driver report before it sends anything')
        if self._listens_until is not None:
            least, most = self._listens_until
            if steady >= (most if self._unheard else least):
                self._listens_until = None
                if self._unheard:
                    # The coil may be off. The stall itself is not a silence of the device.
                    self.devices.look()
                    self.devices.receipts.miss(self._unheard)
        return self._listens_until is not None

    def tick(self, now: int) -> list[Output]:
        """Do the work due at a time in ns, for a few ms at most; return the outputs."""
        self._process_clock()
        self._reporting.flush()
        if self._listens():
            return self._taken()
        self._follow()
        if self._takeover.engaged:
            self._leave(now)
        self._engage()
        estimated = False
        if self._send(now):
            self._beat(now)
            estimated = self.follower.update(now)
        # Where a tick takes as long as an update, updates end in every tick.
        self._put_off = estimated and not self._put_off
        if not self._put_off and self._may_plan():
            self.planning.work_on()
        if self._reporting.preview_again is not None and now >= self._reporting.preview_again:
            self._reporting.show()
        self._reporting.report_progress(now)
        self.deviations.advise()
        if self.active and (
                self._watch.open or self._reporting.unheard or self._reporting.unseen
                or self.devices.receipts or self._reporting.next_change is not None):
            self._reporting.look_for_listeners()
            if not self._put_off:
                self._judge(now)
        if (verdict := self._stops.look(now)) is not None:
            self._reporting.give(verdict, log=verdict.severity > Severity.OK)
        self._process_clock()
        self._reporting.flush()
        return self._taken()

    def _send(self, now: int) -> bool:
        """Send the commands that are due; return whether commands are sent at all."""
        if not (self._takeover.engaged and self.active):
            return False
        self.devices.look()
        if self.settings.replan_late:
            self.deviations.drop_missed(now, self.settings.lateness_tolerance)
        if self.deviations.astray and self._may_plan():
            # Replan before more of a plan is sent that no longer applies.
            self.planning.work_on()
        late = self.deviations.lateness.count
        self.devices.send(now)
        if self.deviations.lateness.count > late:
            self.follower.give_way(now)
        return True

    def _beat(self, now: int) -> None:
        """Send heartbeats if they are due, and look which devices report."""
        if self.settings.heartbeat_period and now >= self._next_beat:
            self._next_beat = now + self.settings.heartbeat_period
            if self.settings.replan_late:
                self.deviations.look_for_unheard(now)
            self._drop(self.devices.look_for_newcomers())
            self.devices.beat(now, finds_lost=self.settings.replan_late)

    def _taken(self) -> list[Output]:
        outputs = self._outputs.copy()
        self._outputs.clear()
        return outputs

    def _engage(self, *, begin: bool = False) -> None:
        """Start from the actual state of the joints, as soon as it is known."""
        if self._takeover.engaged:
            return
        engaged = begin and self._takeover.begin(self.settings)
        if not engaged and self._takeover.waiting:
            self._look_at_samples()
            try:
                engaged = self._takeover.go_on(self.settings)
            except RefusedError as error:
                self._takeover.drop()
                self.planning.refuse_all(error)
                return
        if engaged:
            self._next_beat = self._clock() + self.settings.heartbeat_period

    @property
    def _overdue(self) -> bool:
        """Whether a level that has not been sent should be in force by now."""
        now = self._clock()
        return any(x.next_stamp is not None and x.next_stamp < now
                   for x in self.group.planners.values())

    def _may_plan(self) -> bool:
        """Return whether the joints are where predicted, or measured, as far as that matters."""
        if self._listens() or not self._takeover.engaged:
            return False
        request = self.planning.upcoming
        if isinstance(request, Stop) or request is None and not self.deviations.astray:
            # A stop does not wait.
            return True
        if request is not None and not (self._importing is None and self.follower.ready):
            # Feedback that is still starting would miss the first moves.
            return False
        try:
            if self.devices.must_wait(self.settings):
                return False
        except RefusedError as error:
            # What is to be planned anew waits: sent now, its levels could arrive in part.
            self.planning.refuse_all(error)
            return False
        try:
            self._look_at_samples()
            return self._takeover.look(self.settings, keep=request is None)
        except RefusedError as error:
            self.planning.refuse_all(error)
            return request is None

    def _judge(self, now: int) -> None:
        """Judge arrivals from samples."""
        if not self._watch.open:
            return
        end, observable = self._steady() + SLICE, self.environment.observable()
        while self._steady() < end:
            finding = self._watch.judge(
                now, self.settings.tolerances, end, observable=observable)
            if finding is not None or not self._watch.open:
                # A rest beside the predicted one is no failure of a stop.
                self._reporting.found(finding, judged=self._stops.judges)
            if finding is None:
                break

    def _report_ended(self, words: str) -> None:
        """Report why feedback of a joint has ended."""
        self._reporting.go_on(Verdict(Severity.WARN, Code.FEEDBACK_ENDED, words), log=True)

    def report(self) -> tuple[Severity, str, dict[str, object]]:
        """Return the state of the commands: severity, message and counters."""
        late, severity, message = self.deviations.lateness, Severity.OK, 'commands sent in time'
        receipts, clocks = self.devices.receipts, self.devices.clocks
        if cold := self.temperatures.look():
            severity, message = Severity.WARN, cold
        if late.count:
            severity = Severity.WARN if late.harms or self.deviations.clocks else Severity.OK
            message = f'{late.count} commands late: {self.deviations.advice}'
        elif clocks:
            severity, message = Severity.WARN, clocks
        if self.active:
            self._reporting.look_for_listeners()
        if self._reporting.unseen:
            severity, message = Severity.WARN, self._reporting.unseen
        if receipts.words:
            severity, message = Severity.ERROR, receipts.words
        if clocks and not self._differ:
            self._note(clocks)
        self._differ = bool(clocks)
        return severity, message, {
            'sent': self.devices.sent, 'late': late.count, 'replanned': self.deviations.replanned,
            'heartbeats': self.devices.heartbeats,
            'largest_lateness_ms': f'{late.largest / 1e6:.3f}',
            'refused': self.planning.refused, 'clock_jumps': self.clock_jumps,
            **self.temperatures.figures(), **receipts.figures()}
