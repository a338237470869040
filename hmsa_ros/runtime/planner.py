"""
A planner at work: requests and what really happened in, commands and verdicts out.

Knows no ROS. Whoever drives it calls `PlannerRuntime.tick` with the time of its clock often
enough, at the latest when `PlannerRuntime.wake` says so, and passes on what that returns: a node
to topics, a loop that has the coil at hand to the coil.
"""

from collections import deque
from collections.abc import Callable, Mapping
from time import monotonic_ns

from hmsa_ros.core.group import PlannerGroup, Progress
from hmsa_ros.core.status import Code, RefusedError
from hmsa_ros.core.timeline import Draft, Model
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.runtime.checks import check_joints
from hmsa_ros.runtime.following import Following
from hmsa_ros.runtime.records import (
    Note,
    Output,
    PlanChanged,
    Request,
    Send,
    Settings,
    Severity,
    StatusChanged,
    Stop,
    Trajectory,
    Verdict,
)
from hmsa_ros.runtime.slices import Clock, Work, work_on
from hmsa_ros.runtime.takeover import Observations, Sample

# How long planning goes on before commands and requests are served again, in ns.
_SLICE = 4_000_000
# Changes of level in one preview.
_PREVIEW = 500
# Clock jumps nearer to each other than this make one verdict.
_STORM = NANOSECONDS
# So far ahead that all there is gets sent.
_FAR = 2**62
_WAITING = Verdict(
    Severity.OK, 'waiting', 'accepted: starts as soon as the current state is known')


class PlannerRuntime:
    """
    Plans requests in slices, sends commands in time and follows their effects.

    Parameters
    ----------
    group : PlannerGroup
        The joints.
    settings : Settings
        How to deal with time.
    clock : callable
        Returns the present time in ns: the clock of the stamps and of `tick`.
    steady : callable
        Returns a steady time in ns, by which patience and the length of a slice are measured.
    observable : callable
        Returns whether somebody may give samples: the first request waits for them then.

    Attributes
    ----------
    active : bool
        Whether requests are taken.
    verdict : Verdict
        On the last request.
    following : Following
        What really happened, and the counters of it.
    sent, heartbeats, refused, clock_jumps : int
        Counters.

    """

    def __init__(
            self, group: PlannerGroup, settings: Settings, *, clock: Clock,
            steady: Clock = monotonic_ns,
            observable: Callable[[], bool] = lambda: True) -> None:
        """Begin at rest, inactive, and report it."""
        self.group = group
        self.settings = settings
        self.active = False
        self.verdict = Verdict(Severity.OK, 'none', 'no request yet')
        self.following = Following(group)
        self.sent = self.heartbeats = self.refused = self.clock_jumps = 0
        self._clock, self._steady, self._observable = clock, steady, observable
        self._outputs: list[Output] = []
        self._queue: deque[Work] = deque()
        # Whether it is known where the joints are, or until when that is waited for.
        self._engaged = False
        self._patience: int | None = None
        self._samples = Observations(group.planners)
        self._next_beat = 0
        # Time from which the next part of a long plan is shown, and the last jump of the clock.
        self._preview_again: int | None = None
        self._last_jump: int | None = None
        self._progress: tuple[Progress, Mapping[str, Progress]] | None = None
        self._tell()

    # -- in ------------------------------------------------------------------------------------

    def request(self, request: Request) -> Verdict:
        """
        Take a request.

        One that replaces everything from now on is planned before those that wait, and they
        are dropped if it can be carried out.

        Parameters
        ----------
        request : Request
            Worked out at once as far as a slice goes.

        Returns
        -------
        Verdict
            The latest one; the code is ``waiting`` if it is not this request's yet.

        """
        try:
            self._check(request)
        except RefusedError as error:
            return self.refuse(error, request)
        work = work_on(request, self.group, self._clock)
        if self._engaged and work.replaces(self._queue):
            self._queue.appendleft(work)
        else:
            self._queue.append(work)
        self._begin_to_wait()
        self._work_on()
        while self._engaged and work in self._queue and not isinstance(request, Trajectory):
            # Short work, which whoever asks wants to be done.
            self._work_on()
        return _WAITING if work in self._queue else self.verdict

    def applied(self, joint: str, stamp: int, flux_density: float) -> None:
        """Take in that a joint's level in T has really been in force from a stamp in ns on."""
        if self._engaged:
            self._outputs += self.following.applied(joint, stamp, flux_density, self.settings)
        else:
            self.following.newest[joint] = stamp, flux_density

    def observed(
            self, joint: str, stamp: int, stretch: float, rate: float,
            flux_density: float) -> None:
        """Take in a sample: stamp in ns, stretch, rate in 1/s and flux density in T."""
        self._samples.add(joint, Sample(stamp, stretch, rate, flux_density))

    def clock_set_back(self, back: int) -> None:
        """Begin anew where the clock was set back by some ns; the state in force is read again."""
        self.clock_jumps += 1
        self.group.restart()
        self.following.restart()
        self._queue.clear()
        self._samples.clear()
        self._engaged, self._patience = False, None
        last, self._last_jump = self._last_jump, self._steady()
        if last is not None and self._last_jump - last < _STORM:
            return
        self._give(Verdict(
            Severity.WARN, 'clock_jumped',
            f'the clock jumped back by {back / NANOSECONDS:.3f} s: the plan is dropped, and the '
            'actuator is assumed at its initial stretch unless joint_states shows otherwise'),
            log=True)

    def deactivate(self) -> None:
        """Come to rest, for which all commands are sent now, and take no more requests."""
        self.active = False
        self._patience = None
        # What is seen before the joints have come to rest is not where they are later.
        self._samples.clear()
        self._queue.clear()
        now = self._clock()
        if self._engaged and now:
            work = work_on(Stop(), self.group, self._clock)
            while not self._advance(work):
                pass
            self._send_until(now, _FAR)
            self._give(Verdict(Severity.OK, 'stopped', 'deactivated: coming to rest'))
        self._engaged = False

    def change(
            self, settings: Settings, models: Mapping[str, Model], *,
            simultaneous: bool) -> None:
        """Take other settings now, and other models by joint from the next request on."""
        if settings.heartbeat_period != self.settings.heartbeat_period:
            self._next_beat = self._clock() + settings.heartbeat_period
        self.settings = settings
        for name, model in models.items():
            self.group.planners[name].take_model(model)
        self.group.simultaneous = simultaneous

    # -- out -----------------------------------------------------------------------------------

    @property
    def wants_samples(self) -> bool:
        """Whether samples are waited for."""
        return self._patience is not None

    @property
    def wake(self) -> int | None:
        """Time in ns at which there is something to do next; None for never, 0 for now."""
        if self._queue or self._patience is not None or self._outputs:
            return 0
        if not self._engaged:
            return None
        now = self._clock()
        times = [self.group.next_event(now), self._preview_again]
        if self.settings.heartbeat_period:
            times.append(self._next_beat)
        if self.following.astray:
            times.append(0)
        return min((x for x in times if x is not None), default=None)

    def tick(self, now: int) -> list[Output]:
        """
        Do what is due, for a few milliseconds at the most.

        Parameters
        ----------
        now : int
            Time in ns.

        Returns
        -------
        list of Output
            To be passed on in this order.

        """
        self._wait()
        if self._engaged and self.active:
            if self.settings.replan_late:
                self._outputs += self.following.drop_missed(
                    now, self.settings.lateness_tolerance)
            if self.following.astray:
                # Before more of a plan is sent that does not hold.
                self._work_on()
            self._send_until(now)
            self._beat(now)
        self._work_on()
        if self._preview_again is not None and now >= self._preview_again:
            self._show()
        if self.group.progress(self._clock()) != self._progress:
            self._tell()
        outputs, self._outputs = self._outputs, []
        return outputs

    # -- the state in force --------------------------------------------------------------------

    def _begin_to_wait(self) -> None:
        """Wait for samples of where the joints are, if there is somebody to give them."""
        if self._engaged or self._patience is not None:
            return
        patience = self.settings.takeover_timeout
        if patience and self._observable():
            self._patience = self._steady() + patience
            self._wait()
        else:
            self._engage()

    def _wait(self) -> None:
        """Go on from the samples there are, once there is nothing more to wait for."""
        if self._patience is None:
            return
        samples = self._samples.fresh(self._clock(), self.settings.takeover_max_age)
        if len(samples) < len(self.group.planners) and self._steady() <= self._patience:
            return
        self._patience = None
        for name, planner in self.group.planners.items():
            if name not in samples:
                self._note(
                    f'no sample of joint {name} on joint_states: it is assumed at rest at its '
                    'initial stretch')
                continue
            x = samples[name]
            level = self.following.newest.get(name)
            try:
                planner.take_over(
                    x.stamp, x.stretch, x.rate, x.flux_density,
                    level[1] if level is not None and level[0] <= x.stamp else None)
            except BadInputError as error:
                self._note(f'sample of joint {name} ignored: {error}')
        self._engage()

    def _engage(self) -> None:
        self._engaged = True
        self._next_beat = self._clock() + self.settings.heartbeat_period

    # -- planning ------------------------------------------------------------------------------

    def _check(self, request: Request) -> None:
        if not self.active:
            raise RefusedError(
                Code.INACTIVE, 'the planner is inactive: expected it active (ros2 lifecycle set '
                'NODE activate)')
        if self._clock() == 0:
            raise RefusedError(
                Code.NO_TIME,
                'simulated time has not started: expected messages on /clock (start the '
                'simulator, or set use_sim_time to false)')
        check_joints(request, tuple(self.group.planners), self.settings)

    def _supersede(self, work: Work) -> None:
        """Drop what came before and would be replaced as soon as it is planned."""
        for old in list(self._queue):
            if old.number < work.number and old.joints <= work.joints and not work.postponed:
                self._queue.remove(old)
                if old.request is not None:
                    self._give(Verdict(
                        Severity.WARN, 'superseded', 'another request came before this one was '
                        'planned', old.request.name))

    def _work_on(self) -> None:
        """Plan what waits, for the length of a slice."""
        if not self._engaged:
            return
        for name in self.following.to_resume():
            if not any(x.request is None and name in x.joints for x in self._queue):
                self._queue.appendleft(self.following.resumption(name, self._clock))
        end = self._steady() + _SLICE
        while self._queue and self._steady() < end:
            work = self._queue[0]
            if self._advance(work) and work in self._queue:
                self._queue.remove(work)
        if self.following.given_up:
            self._give_up()

    def _advance(self, work: Work) -> bool:
        """Go on with one piece of work; say whether it is done."""
        try:
            next(work.steps)
        except StopIteration as end:
            drafts, now = end.value
            if work.request is None:
                self._resume(work, drafts, now)
            else:
                self._supersede(work)
                self._answer(work.request, drafts, now)
        except HmsaError as error:
            if work.request is None:
                self._give(self.following.abandon(work, error, self.verdict.request), log=True)
            else:
                self.refuse(error, work.request)
        else:
            return False
        return True

    def _answer(self, request: Request, drafts: Mapping[str, Draft], now: int) -> None:
        """Begin to carry out a request."""
        self.following.astray -= drafts.keys()
        changed = self.group.take(drafts, now)
        # First, since reporting takes time.
        self._send_until(self._clock())
        warnings = [x.warning for x in drafts.values() if x.warning is not None]
        if changed:
            self._show()
        if warnings:
            self._give(Verdict(
                Severity.WARN, str(warnings[0].code), warnings[0].reason, request.name), log=True)
        elif changed:
            self._give(Verdict(Severity.OK, 'accepted', 'accepted', request.name))
        else:
            self._give(Verdict(
                Severity.OK, 'unchanged', 'already on the way there: the plan is unchanged',
                request.name))

    def refuse(self, error: HmsaError, request: Request) -> Verdict:
        """Answer a request that cannot be read or carried out."""
        code = Code.BAD_INPUT if isinstance(error, BadInputError) else Code.NOT_CONVERGED
        if isinstance(error, RefusedError):
            code = error.code
        self.refused += 1
        self._give(Verdict(Severity.ERROR, str(code), str(error), request.name))
        self._outputs.append(Note(Severity.ERROR, f'request refused ({code}): {error}'))
        return self.verdict

    # -- what comes of it ----------------------------------------------------------------------

    def _resume(self, work: Work, drafts: Mapping[str, Draft], now: int) -> None:
        """Go on with a plan that was made anew."""
        verdict = self.following.resume(work, drafts, now, self.verdict.request)
        self._send_until(self._clock())
        if verdict is not None:
            self._show()
            self._give(verdict, log=self.following.tell_replanned())

    def _give_up(self) -> None:
        verdict = self.following.give_up(self._lead_time, self.verdict.request)
        self._give(verdict, log=self.following.tell_replanned())

    @property
    def _lead_time(self) -> int:
        return next(iter(self.group.planners.values())).options.lead_time

    def _send_until(self, now: int, until: int | None = None) -> None:
        for name, planner in self.group.planners.items():
            for level in planner.due(now if until is None else until):
                self._outputs.append(Send(name, level.stamp, level.flux_density))
                self.sent += 1
                self._outputs += self.following.sent(name, level.stamp, now)

    def _beat(self, now: int) -> None:
        """Send the level in force again: who listens learns that somebody is there."""
        period = self.settings.heartbeat_period
        if not period or now < self._next_beat:
            return
        self._next_beat = now + period
        if self.settings.replan_late:
            self.following.look_for_unheard(now)
        for name, planner in self.group.planners.items():
            level = planner.last_sent
            stamp = planner.beat_stamp(now)
            following = planner.next_stamp
            if following is None or stamp < following:
                self._outputs.append(Send(name, stamp, level.flux_density))
                self.heartbeats += 1

    # -- reports -------------------------------------------------------------------------------

    def report(self) -> tuple[Severity, str, dict[str, object]]:
        """Return how commands fare: severity, a sentence and counters."""
        late = self.following.lateness
        message = 'commands sent in time'
        if late.count:
            message = f'{late.count} commands late: {late.advice(self._lead_time)}'
        return Severity.WARN if late.count else Severity.OK, message, {
            'sent': self.sent, 'late': late.count, 'refused': self.refused,
            'replanned': self.following.replanned, 'heartbeats': self.heartbeats,
            'largest_lateness_ms': f'{late.largest / 1e6:.3f}',
            'clock_jumps': self.clock_jumps}

    def _give(self, verdict: Verdict, *, log: bool = False) -> None:
        self.verdict = verdict
        if log:
            self._note(verdict.message)
        self._tell()

    def _note(self, message: str) -> None:
        self._outputs.append(Note(Severity.WARN, message))

    def _tell(self) -> None:
        self._progress = self.group.progress(self._clock())
        self._outputs.append(StatusChanged(
            self.verdict, *self._progress, self.group.number, self.following.lateness.count,
            self.following.replanned))

    def _show(self) -> None:
        """Show what is planned; of a long plan the beginning, and the rest in time."""
        stamps, samples = self.group.preview(self._clock(), _PREVIEW)
        self._preview_again = stamps[_PREVIEW // 2] if len(stamps) == _PREVIEW else None
        self._outputs.append(PlanChanged(tuple(stamps), samples))
