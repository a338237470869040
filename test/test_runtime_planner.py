"""A planner at work without ROS: late commands, take-over, heartbeats, long trajectories."""

from contextlib import contextmanager
from dataclasses import replace
from threading import Semaphore, Thread

from at_work import AtWork, MS, planner, sample, START
import numpy as np
from plants import Plant
import pytest

from hmsa.errors import HmsaError
from hmsa.model.parameters import paper_actuator
from hmsa.model.status import Code, RefusedError
from hmsa.planning import proceed
from hmsa.planning.planner import Options, Planner
from hmsa_ros.runtime.records import (
    PlanChanged,
    Settings,
    Severity,
    StatusChanged,
    Stop,
    StretchRequest,
    Trajectory,
)
from hmsa_ros.runtime.worker import Job

LEAD = 50 * MS
HOLD = 44 * MS
SEQUENCE = ((1.1, HOLD), (1.2, 2 * HOLD), (1.4, 3 * HOLD))
RESIDUAL = 1e-6
# A block that vibrates for long.
SLENDER = replace(paper_actuator(), damping_coefficient=1e-3)
QUIET = Settings(heartbeat_period=0, takeover_timeout=0)


def trajectory(*points, joints=('a',), stamp=None, name=''):
    """Return a request of the same stretches for all joints."""
    return Trajectory(
        tuple(joints), [((x,) * len(joints), t) for x, t in points], len(points), stamp, name)


class Sliced(Job):
    """Work in a thread that goes on only while the loop waits for it, by the clock of a rig."""

    def __init__(self, work, look):
        super().__init__(work)
        self._look, self._goes, self._pauses = look, Semaphore(0), Semaphore(0)
        Thread(target=self._begin, daemon=True).start()

    def _begin(self):
        self._goes.acquire()
        self.run(self._pause)
        self._pauses.release()

    def _pause(self):
        self._pauses.release()
        self._goes.acquire()
        self.check()

    def done(self, seconds=0.0):
        end = self._look() + seconds * 1e9
        while not super().done() and self._look() < end:
            self._goes.release()
            self._pauses.acquire()
        return super().done()


class SlicedWorker:
    """A worker whose work takes the time of a rig."""

    def __init__(self, look):
        self._look = look

    def submit(self, work):
        return Sliced(work, self._look)


class Rig(AtWork):
    """A runtime and actuators that obey it, with transport delay of commands."""

    def __init__(self, *, settings=QUIET, joints=('a',), blocks=None, **options):
        self.options = Options(flux_density_min=-0.5, flux_density_max=0.5, **options)
        self.blocks = blocks or dict.fromkeys(joints, paper_actuator())
        self.steady = 0
        # What each look at a clock takes.
        self.effort = 0
        # Before which reading the clock is set back, and by how much.
        self.set_back_at = None
        self.observable = True
        self.unheard = ''
        self.found = True
        super().__init__(
            {x: Planner(block, self.options) for x, block in self.blocks.items()}, settings,
            clock=self.clock, steady=self.look, worker=SlicedWorker(self.look),
            observable=lambda: self.observable, unheard=lambda: self.unheard,
            found=lambda joint: self.found)
        self.plants = {
            x: Plant(block, time=START) for x, block in self.blocks.items()}
        self.sent = []
        self.wire = []
        self.transport = 0
        self.driver = lambda: 0
        self.hold_back = False
        # How far the clock was set ahead, which actuators take no notice of.
        self.set_by = 0

    def clock(self):
        if self.set_back_at is not None:
            readings, back = self.set_back_at
            self.set_back_at = readings - 1, back
            if readings == 0:
                self.set_back_at = None
                self.now -= back
                self.runtime.clock_set_back(back)
        return self.now

    def look(self):
        self.steady += self.effort
        self.now += self.effort
        return self.steady

    @property
    def plant(self):
        return next(iter(self.plants.values()))

    def tick(self):
        begin, before = self.now, len(self.outputs)
        for x in super().tick():
            # A tick sends first; what takes time comes after it.
            self.sent.append((begin, x))
            self.wire.append((begin + self.transport, x))
        return self.outputs[before:]

    def deliver(self):
        """Deliver the commands that are no longer in transit."""
        if self.hold_back:
            return
        arrived = [x for x in self.wire if x[0] <= self.now]
        self.wire = [x for x in self.wire if x[0] > self.now]
        for _, x in arrived:
            plant = self.plants[x.joint]
            stamp = max(x.stamp - self.set_by, plant.time)
            delay = self.driver() if x.flux_density != plant.schedule.current else 0
            plant.command(stamp + delay, x.flux_density)

    def advance(self):
        """Advance the actuators, and report levels that take effect."""
        for name, plant in self.plants.items():
            for stamp, level in plant.go_on(self.now - self.set_by):
                self.runtime.applied(name, stamp + self.set_by, level)

    def run(self, end, step=2 * MS):
        while self.now < end:
            self.tick()
            self.now = min(self.now + step, end)
            self.deliver()
            self.advance()
        self.tick()

    def go(self, request, end, step=2 * MS):
        """Request something, and run until a time; return the verdict on it."""
        verdict = self.runtime.request(request)
        self.run(end, step)
        return verdict

    def arrive(self, stretch, end):
        """Request a stretch, and rest there by a time."""
        self.go(StretchRequest('a', stretch), end)
        assert self.residual(stretch) < RESIDUAL

    def hold(self, end):
        """Run until a time while commands are held up."""
        self.hold_back = True
        self.run(end)
        self.hold_back = False

    def plan(self):
        """Tick until the loop has nothing left to compute; return how often."""
        ticks = 0
        while self.runtime.wake == 0:
            self.tick()
            ticks += 1
        return ticks

    @contextmanager
    def unreported(self):
        """Hold reports of levels up, and yield their list."""
        reports, applied = [], self.runtime.applied
        self.runtime.applied = lambda *report: reports.append(report)
        yield reports
        self.runtime.applied = applied
        for report in reports:
            applied(*report)

    def noted(self, text):
        """Return how many notes contain a text."""
        return sum(text in x for x in self.notes())

    def observe(self, age=0):
        for name, plant in self.plants.items():
            self.runtime.observed(name, sample(
                self.now - age, plant.stretch, plant.rate, plant.flux_density, came=self.now))

    def residual(self, stretch, joint='a'):
        return self.plants[joint].residual(stretch)


# -- requests -----------------------------------------------------------------------------------


def test_sequence_is_sent_in_time_and_ends_at_rest():
    rig = Rig()
    rig.observable = False
    assert rig.go(trajectory(*SEQUENCE, name='x'), START + LEAD + 3 * HOLD).code == 'accepted'
    alone = Planner(paper_actuator(), rig.options)
    alone.request(SEQUENCE, None, START)
    assert [(x.stamp, x.flux_density) for _, x in rig.sent] == [
        (x.stamp, x.flux_density) for x in alone.due(START + 10**9)]
    assert all(0 <= x.stamp - now <= LEAD for now, x in rig.sent)
    status = rig.status
    assert (status.verdict.request, status.plan, status.late) == ('x', 1, 0)
    assert (status.progress.state, status.progress.setpoint) == ('at_rest', 3)
    assert rig.residual(1.4) < 0.2 * RESIDUAL
    assert rig.runtime.wake is None


def test_request_while_inactive_or_without_time_is_refused():
    rig = Rig()
    rig.runtime.active = False
    assert rig.runtime.request(Stop()).code == 'inactive'
    rig.runtime.active = True
    rig.now = 0
    verdict = rig.runtime.request(trajectory(*SEQUENCE, name='x'))
    assert (verdict.code, verdict.request, verdict.severity) == ('no_time', 'x', Severity.ERROR)
    assert 'expected messages on /clock' in verdict.message
    assert rig.runtime.report()[2]['refused'] == 2


def test_plan_that_cannot_be_computed_is_a_refusal_too(monkeypatch):
    def fails(*_):
        raise HmsaError('the integration ran out of steps')

    rig = Rig()
    rig.runtime.request(trajectory(*SEQUENCE))
    plan = rig.planner.plan
    monkeypatch.setattr(Planner, 'draft_setpoint', fails)
    verdict = rig.runtime.request(StretchRequest('a', 1.2))
    assert (verdict.code, verdict.message) == ('not_converged', 'the integration ran out of steps')
    assert rig.planner.plan is plan


@pytest.mark.parametrize(('joints', 'text'), [
    (('a', 'c'), "lacks 'b': expected all of a, b, c"), ((), "lacks 'a'"),
    (('a', 'b', 'c', 'a'), "'a' twice"), (('a', 'b', 'knee'), "has 'knee': expected names among")])
def test_trajectory_that_one_joint_cannot_take_none_takes(joints, text):
    weak = replace(paper_actuator(), remanence=0.01)
    rig = Rig(blocks={'a': paper_actuator(), 'b': paper_actuator(), 'c': weak})
    assert text in rig.runtime.request(trajectory(*SEQUENCE, joints=joints)).message
    verdict = rig.runtime.request(trajectory((1.5, HOLD), joints=('a', 'b', 'c')))
    assert verdict.code == 'flux_limit'
    assert 'joint c: stretch 1.5 needs a flux density of' in verdict.message
    assert rig.group.number == 0
    assert 'joint' in rig.runtime.request(StretchRequest('knee', 1.1)).message


def test_some_joints_only_if_allowed_and_one_by_its_own_target():
    rig = Rig(joints=('a', 'b', 'c'))
    rig.runtime.change(
        replace(QUIET, allow_partial_joints=True), {}, simultaneous=True)
    assert rig.runtime.request(trajectory(*SEQUENCE, joints=('b', 'c'))).code == 'accepted'
    assert not rig.group.planners['a'].plan.segments
    assert rig.runtime.request(StretchRequest('a', 1.3)).code == 'accepted'
    assert rig.runtime.request(StretchRequest('a', 1.3)).code == 'unchanged'
    assert rig.group.number == 2
    rig.run(START + LEAD + 3 * HOLD)
    assert max(rig.residual(1.3), rig.residual(1.4, 'b')) < 0.3 * RESIDUAL


def test_what_is_done_with_a_plan_before_it_is_taken_makes_no_command_late(monkeypatch):
    def cautious(drafts):
        rig.now += 2 * LEAD
        return drafts

    rig = Rig()
    monkeypatch.setattr(rig.runtime.follower, 'cautious', cautious)
    rig.go(trajectory(*SEQUENCE), rig.now + 20 * LEAD)
    assert len(rig.sent) >= 2 * len(SEQUENCE)
    assert all(command.stamp >= now for now, command in rig.sent)


# -- long trajectories --------------------------------------------------------------------------


def zigzag(count, name='long', hold=HOLD, **more):
    """Return a long request that generates its points one by one."""
    return Trajectory(
        ('a',), (((1.1 + 0.1 * (k % 2),), (k + 1) * hold) for k in range(count)), count,
        name=name, **more)


def test_long_trajectory_is_planned_beside_the_loop_with_signs_of_life_in_between():
    rig = Rig(settings=replace(QUIET, heartbeat_period=20 * MS))
    rig.go(StretchRequest('a', 1.05), START + LEAD + HOLD)
    rig.effort = MS // 10
    plan = rig.planner.plan
    assert rig.runtime.request(zigzag(1000)).code == 'waiting'
    spent = []
    while rig.planner.plan is plan:
        before = rig.now
        rig.tick()
        spent.append(rig.now - before)
        assert rig.runtime.wake == 0 or rig.planner.plan is not plan
        rig.now += MS
    assert max(spent) < 6 * MS
    assert max(np.diff([
        now for now, x in rig.sent if x.flux_density == plan.levels[-1].flux_density])) < 30 * MS
    rig.effort = 0
    # It begins when it can, and the first setpoint lasts as long as the others.
    segments = rig.planner.plan.segments[-1000:]
    assert rig.now < segments[0].since < rig.now + 10**9
    assert set(np.diff([x.since for x in segments])) == {HOLD}
    rig.run(segments[2].since)
    assert rig.residual(segments[1].stretch) < 0.1 * RESIDUAL
    assert rig.runtime.deviations.lateness.count == 0


def test_a_pause_of_the_machine_hardly_delays_what_is_being_planned(monkeypatch):
    rig = Rig()
    checks = []

    def pause(job):
        checks.append(job)
        # Once the request has been read.
        if len(checks) == 12:
            rig.now += LEAD
            rig.steady += LEAD
        usual(job)
    usual = Sliced._pause
    monkeypatch.setattr(Sliced, '_pause', pause)
    plan = rig.planner.plan
    rig.effort = MS // 100
    rig.runtime.request(zigzag(1000))
    while rig.planner.plan is plan:
        rig.tick()
        rig.now += MS
    begin = rig.planner.plan.segments[-1000].since
    assert rig.now < begin < START + 5_000 * MS
    assert f'accepted; begins {(begin - rig.now) / 1e9:.1f} s later' in rig.status.verdict.message


def test_stop_is_answered_at_once_whatever_is_planned():
    rig = Rig()
    rig.go(trajectory(*SEQUENCE), START + LEAD + 3 * MS)
    rig.effort = MS // 5
    rig.runtime.request(zigzag(10_000))
    rig.tick()
    before = rig.now
    assert rig.runtime.request(Stop()).code == 'accepted'
    assert rig.now - before < 10 * MS
    rig.tick()
    assert ('superseded', 'long') in [
        (x.verdict.code, x.verdict.request) for x in rig.outputs if isinstance(x, StatusChanged)]
    assert rig.runtime.wake != 0
    assert rig.status.verdict.code == 'accepted'


def test_of_several_planners_each_takes_no_request_but_to_stop():
    rig = Rig()
    rig.go(trajectory(*SEQUENCE), START + LEAD + 3 * MS)
    rig.runtime.crowded = RefusedError(Code.SEVERAL_PLANNERS, '2 planners (/a and /b): stop one')
    assert rig.runtime.request(StretchRequest('a', 1.1)).code == 'several_planners'
    assert rig.runtime.request(Stop()).code == 'accepted'


def test_refused_request_leaves_the_one_alone_that_is_being_planned():
    rig = Rig()
    rig.runtime.request(trajectory(*SEQUENCE))
    rig.effort = MS // 5
    rig.runtime.request(zigzag(200))
    assert rig.runtime.request(StretchRequest('a', 9.0)).code == 'out_of_range'
    while rig.runtime.planning:
        rig.tick()
    assert rig.status.verdict.code == 'accepted'
    assert rig.status.progress.setpoints == 200


def test_trajectory_beyond_the_limit_is_refused_before_a_point_is_read():
    rig = Rig(settings=replace(QUIET, max_points=100))

    def unreadable():
        raise AssertionError
        yield

    verdict = rig.runtime.request(Trajectory(('a',), unreadable(), 101))
    assert verdict.code == 'too_long'
    assert 'has 101 setpoints: expected at most 100, the parameter max_points' in verdict.message
    assert rig.runtime.request(zigzag(100)).code == 'accepted'


def test_late_command_in_a_long_plan_makes_only_the_next_setpoints_anew():
    rig = Rig(blocks={'a': SLENDER})
    rig.runtime.request(zigzag(300, hold=3 * HOLD))
    rig.plan()
    before = rig.planner.plan
    rig.run(before.segments[2].since + MS)
    rig.hold(before.segments[3].since + 9 * MS)
    rig.run(before.segments[5].since)
    after = rig.planner.plan
    assert rig.status.replanned >= 1
    assert len(after.segments) == 300
    assert all(x is y for x, y in zip(after.segments[5:], before.segments[5:], strict=True))
    assert rig.residual(after.segments[4].stretch) < 0.1 * RESIDUAL
    state = rig.planner.state(rig.now)
    assert state.stretch == pytest.approx(rig.plant.stretch, abs=1e-7)


@pytest.mark.slow
def test_preview_of_a_long_plan_comes_in_parts():
    rig = Rig()
    rig.runtime.request(zigzag(400))
    rig.plan()
    levels = {x.stamp: x for x in rig.planner.plan.levels}
    rig.run(START + LEAD + 400 * HOLD, step=HOLD)
    parts = [x for x in rig.outputs if isinstance(x, PlanChanged)]
    assert len(parts) == 3
    shown = {}
    for part in parts:
        assert len(part.stamps) <= 500
        shown |= dict(zip(part.stamps, part.samples['a'], strict=True))
    assert sorted(shown) == sorted(x for x in levels if x > 0)
    assert all(shown[x][2] == levels[x].flux_density for x in shown)


# -- signs of life ------------------------------------------------------------------------------


def test_heartbeat_repeats_the_last_level_and_changes_nothing():
    rig = Rig(settings=replace(QUIET, heartbeat_period=20 * MS))
    rig.observable = False
    rig.run(START + 100 * MS)
    # Nothing before the first command.
    assert rig.sent == []
    rig.go(trajectory((1.1, HOLD)), START + 400 * MS)
    sent = [(x.stamp, x.flux_density) for _, x in rig.sent]
    assert sent == sorted(sent, key=lambda x: x[0])
    changes = [x for k, x in enumerate(sent) if k == 0 or x[1] != sent[k - 1][1]]
    assert changes == [
        (x.stamp, x.flux_density) for x in rig.planner.plan.levels if x.stamp > 0]
    assert 12 <= rig.runtime.devices.heartbeats == len(sent) - len(changes)
    assert rig.residual(1.1) < 0.1 * RESIDUAL
    rig.runtime.change(QUIET, {}, simultaneous=False)
    rig.run(START + 500 * MS)
    assert len(rig.sent) == len(sent)
    assert rig.runtime.wake is None


def test_a_long_plan_that_was_replaced_is_freed_bit_by_bit():
    rig = Rig()
    rig.runtime.request(trajectory(*((1.1 + 0.1 * (i % 2), i * HOLD) for i in range(1, 3001))))
    rig.plan()
    rig.runtime.request(Stop())
    # 6,000 levels and 3,000 setpoints.
    assert 3 <= rig.plan() <= 9


# -- taking over --------------------------------------------------------------------------------

PATIENT = replace(QUIET, takeover_timeout=500 * MS)


def test_first_request_waits_for_the_state_in_force():
    rig = Rig(settings=PATIENT)
    rig.plant.set_state(1.15, 3.0, 0.06)
    assert rig.runtime.request(trajectory((1.3, HOLD))).code == 'waiting'
    assert rig.runtime.wants_samples
    rig.runtime.request(StretchRequest('a', 1.25, name='second'))
    rig.observe(age=600 * MS)
    rig.runtime.observed('knee', sample(rig.now, 1.0, 0.0, 0.0))
    rig.runtime.observed('a', sample(rig.now, 1.0, flux_density=0.0))
    rig.tick()
    assert rig.runtime.wants_samples
    assert rig.codes() == ['none']
    rig.observe()
    rig.observable = False
    rig.run(START + 150 * MS)
    assert not rig.runtime.wants_samples
    assert rig.status.plan == 2
    assert rig.residual(1.25) < 0.1 * RESIDUAL


def test_patience_with_samples_of_others_has_an_end():
    rig = Rig(settings=PATIENT)
    rig.runtime.request(Stop())
    rig.tick()
    assert rig.runtime.wants_samples
    rig.steady += 501 * MS
    rig.tick()
    assert rig.status.verdict.code == 'accepted'
    assert 'no sample of joint a on joint_states' in rig.notes()[0]


def test_nobody_is_waited_for_where_nobody_gives_samples():
    rig = Rig(settings=PATIENT)
    rig.observable = False
    assert rig.runtime.request(StretchRequest('a', 1.1)).code == 'accepted'


@pytest.mark.parametrize('comes', [True, False])
def test_first_request_waits_a_while_for_a_plant(comes):
    rig = Rig(settings=PATIENT)
    rig.observable, rig.unheard = False, 'nobody subscribes'
    assert rig.runtime.request(StretchRequest('a', 1.1)).code == 'waiting'
    rig.tick()
    rig.observable = comes
    rig.observe()
    rig.tick()
    assert rig.codes() == ['none']
    if comes:
        rig.unheard = ''
    else:
        rig.steady += 501 * MS
    rig.tick()
    assert rig.status.verdict.code == 'accepted'
    assert rig.notes() == ([] if comes else ['nobody subscribes'])


def test_first_request_waits_for_feedback_that_is_starting_but_a_stop_does_not(monkeypatch):
    rig = Rig(settings=QUIET)
    follower = type(rig.runtime.follower)
    monkeypatch.setattr(follower, 'ready', False)
    assert rig.runtime.request(StretchRequest('a', 1.1)).code == 'waiting'
    rig.tick()
    assert rig.codes() == ['none']
    monkeypatch.setattr(follower, 'ready', True)
    rig.tick()
    assert rig.status.verdict.code == 'accepted'
    monkeypatch.setattr(follower, 'ready', False)
    assert rig.runtime.request(Stop()).code == 'accepted'


@pytest.mark.parametrize(('feedback', 'code'), [('observe', 'accepted'), ('adapt', 'waiting')])
def test_a_request_waits_for_processes_that_start_only_where_plans_use_estimates(
        monkeypatch, feedback, code):
    monkeypatch.setattr('hmsa_lab.adapt.feedback.is_ready', lambda _: False)
    rig = Rig(settings=replace(QUIET, feedback=feedback))
    assert rig.runtime.request(StretchRequest('a', 1.1)).code == code


def test_what_a_change_of_settings_needs_is_imported_beside_the_loop(monkeypatch):
    class Later:
        def __init__(self):
            self.jobs = []

        def submit(self, work):
            self.jobs.append(Job(work))
            return self.jobs[-1]

    worker, imported = Later(), []
    monkeypatch.setattr('hmsa.planning.path.prepare', lambda: imported.append('path'))
    work = AtWork({'a': planner()}, QUIET, worker=worker)
    settings = replace(QUIET, trajectory_mode='path')
    for _ in range(2):
        work.runtime.change(settings, {}, simultaneous=False)
    job, = worker.jobs
    assert not imported
    job.run(proceed)
    assert imported == ['path']

    for _ in range(2):
        work.runtime.change(replace(settings, feedback='adapt'), {}, simultaneous=False)
    _, job = worker.jobs
    assert not work.runtime.follower.on
    # A move waits, and a stop does not.
    assert work.runtime.request(StretchRequest('a', 1.1)).code == 'waiting'
    assert work.runtime.wake == 0
    job.run(proceed)
    work.tick()
    assert work.runtime.follower.on
    assert work.status.verdict.code == 'accepted'


def test_impossible_sample_is_ignored_with_a_note():
    rig = Rig(settings=PATIENT)
    rig.runtime.request(StretchRequest('a', 1.1))
    rig.runtime.observed('a', sample(rig.now, 9.0, 0.0, 0.0))
    rig.tick()
    assert rig.status.verdict.code == 'accepted'
    assert 'sample of joint a ignored: stretch in force is 9' in rig.notes()[0]


# -- late commands ------------------------------------------------------------------------------


def test_late_command_is_noticed_and_the_rest_planned_anew():
    rig = Rig(blocks={'a': SLENDER})
    rig.go(trajectory(*((x, 4 * t) for x, t in SEQUENCE), name='x'), START + 20 * MS)
    rig.hold(START + LEAD + 4 * HOLD + 9 * MS)
    rig.run(START + LEAD + 13 * HOLD)
    status = rig.status
    assert (status.verdict.code, status.verdict.request) == ('replanned', 'x')
    assert status.verdict.severity is Severity.WARN
    assert (status.late >= 1, status.replanned) == (True, 1)
    assert (status.progress.state, status.progress.setpoint, status.plan) == ('at_rest', 3, 1)
    assert rig.residual(1.4) < 0.2 * RESIDUAL


def test_commands_that_come_late_together_change_nothing_and_are_found_out():
    rig = Rig(blocks={'a': SLENDER})
    rig.go(trajectory((1.2, HOLD)), START + 3 * MS)
    rig.hold(START + LEAD + 20 * MS)
    rig.deliver()
    rig.advance()
    rig.tick()
    assert rig.status.replanned == 1
    # Both commands of the new plan, which ends at the level in force.
    rig.hold(rig.now + LEAD + 30 * MS)
    rig.deliver()
    rig.advance()
    assert rig.residual(1.2) > 0.01
    rig.runtime.change(replace(QUIET, heartbeat_period=20 * MS), {}, simultaneous=False)
    rig.run(rig.now + 3 * LEAD + 40 * MS)
    assert rig.residual(1.2) < 0.2 * RESIDUAL
    assert rig.status.replanned == 2


def test_lead_time_too_short_is_told_and_not_planned_for_again_and_again():
    rig = Rig(lead_time=2 * MS)
    rig.transport = 5 * MS
    rig.go(trajectory((1.2, HOLD)), START + 120 * MS, step=MS // 2)
    severity, message, _ = rig.runtime.report()
    assert severity is Severity.WARN
    assert 'raise lead_time to more than 0.00' in message
    assert rig.status.replanned <= 3
    assert len(rig.sent) < 20


@pytest.mark.parametrize(('transport', 'driver', 'advice'), [
    (0, 500_000, 'however early they are sent'),
    (54_000_000, 0, 'raise lead_time to more than 0.05')])
def test_slow_driver_and_slow_transport_are_told_apart(transport, driver, advice):
    rig = Rig(settings=replace(QUIET, replan_late=False))
    jitter = iter(range(0, 10**9, 7919))
    rig.transport = transport
    rig.driver = lambda: driver + next(jitter) % 20_000 if driver else 0
    rig.go(zigzag(12), START + LEAD + 12 * HOLD)
    severity, message, counts = rig.runtime.report()
    assert severity is Severity.WARN
    assert counts['late'] >= 12
    assert advice in message
    assert 'lateness_tolerance' not in message


def test_driver_that_rounds_to_its_own_steps_is_early_and_not_foreign():
    rig = Rig()
    rig.driver = lambda: -40_000
    rig.go(trajectory(*SEQUENCE), START + LEAD + 4 * HOLD)
    assert not rig.noted('not commanded')
    assert (rig.status.verdict.message, rig.status.replanned) == ('accepted', 0)
    assert rig.residual(1.4) < 0.2 * RESIDUAL


def test_jump_ahead_while_a_plan_runs_is_planned_anew():
    rig = Rig()
    rig.go(trajectory(*SEQUENCE), START + 30 * MS)
    rig.now = START + LEAD + 2 * HOLD
    rig.deliver()
    rig.advance()
    rig.tick()
    assert rig.codes()[-2:] == ['replanned', 'missed']
    assert rig.status.replanned == 1
    assert rig.noted('raise lead_time')
    rig.run(START + 2 * LEAD + 4 * HOLD)
    assert rig.residual(1.4) < 0.2 * RESIDUAL


def test_own_level_whose_report_comes_after_it_was_found_lost_is_no_foreign_one():
    rig = Rig(settings=replace(QUIET, heartbeat_period=20 * MS))
    rig.go(trajectory((1.2, 4 * HOLD), (1.3, 20 * HOLD)), START + LEAD + 3 * HOLD)
    with rig.unreported():
        rig.run(START + LEAD + 7 * HOLD)
        assert rig.status.replanned > 0
    rig.run(START + LEAD + 20 * HOLD)
    assert not rig.noted('not commanded')
    assert rig.residual(1.3) < 0.2 * RESIDUAL


def test_level_is_not_lost_while_receipts_wait_to_be_read_as_its_report_may():
    rig = Rig(settings=replace(QUIET, heartbeat_period=20 * MS))
    rig.runtime.received('a', START, 0, cut_off=False)
    rig.go(trajectory((1.2, 4 * HOLD), (1.3, 20 * HOLD)), START + LEAD + 3 * HOLD)
    rig.runtime.received('a', rig.now, rig.sent[-1][1].stamp, cut_off=False)
    with rig.unreported() as reports:
        while rig.now < START + LEAD + 7 * HOLD:
            rig.run(rig.now + 10 * MS)
            rig.show(rig.now, rig.plant.stretch)
        assert reports
        rig.runtime.received('a', rig.now, rig.sent[-1][1].stamp, cut_off=False)
    rig.run(START + LEAD + 20 * HOLD)
    assert rig.status.replanned == 0
    assert rig.residual(1.3) < 0.2 * RESIDUAL


def test_foreign_level_is_noted_and_planned_for():
    rig = Rig()
    rig.go(trajectory((1.2, HOLD)), START + 150 * MS)
    rig.plant.command(rig.now + MS, 0.0)
    rig.run(START + 300 * MS)
    assert rig.noted('0 T took effect but was not commanded')
    assert rig.residual(1.2) < 0.2 * RESIDUAL


# -- states and time ----------------------------------------------------------------------------


def test_deactivated_it_comes_to_rest_and_then_sends_nothing():
    rig = Rig(settings=replace(QUIET, heartbeat_period=10 * MS))
    rig.go(trajectory(*SEQUENCE), START + 3 * MS)
    rig.runtime.deactivate()
    rig.tick()
    assert rig.status.verdict.code == 'inactive'
    sent = len(rig.sent)
    rig.run(START + 500 * MS)
    assert len(rig.sent) == sent
    assert 1.0 < rig.plant.stretch < 1.1
    assert rig.residual(rig.plant.stretch) < 0.1 * RESIDUAL
    assert rig.runtime.request(StretchRequest('a', 1.1)).code == 'inactive'


def test_activated_again_it_does_not_go_on_from_what_was_seen_before():
    rig = Rig(settings=PATIENT)
    rig.observe()
    assert rig.runtime.request(StretchRequest('a', 1.3)).code == 'accepted'
    rig.run(START + LEAD + 3 * MS)
    rig.runtime.deactivate()
    rig.run(START + 200 * MS)
    rig.runtime.active = True
    assert rig.runtime.request(StretchRequest('a', 1.1)).code == 'waiting'
    rig.observe()
    rig.run(START + 400 * MS)
    assert rig.residual(1.1) < RESIDUAL


@pytest.mark.parametrize('observed', [False, True])
@pytest.mark.parametrize('after', [0, 1, 10, 30, 60])
def test_activated_again_it_counts_on_the_levels_that_it_has_sent_ahead(after, observed):
    rig = Rig(settings=PATIENT if observed else QUIET)
    rig.observable = observed

    def run(end):
        while rig.now < end:
            rig.run(rig.now + MS, step=MS)
            if observed:
                rig.observe()
    rig.observe()
    assert rig.runtime.request(trajectory(
        (1.3, HOLD), (1.1, 2 * HOLD), (1.4, 3 * HOLD))).severity is Severity.OK
    run(START + LEAD + 50 * MS)
    rig.runtime.deactivate()
    run(rig.now + after * MS)
    rig.runtime.active = True
    rig.runtime.request(StretchRequest('a', 1.2))
    run(rig.now + 400 * MS)
    assert rig.residual(1.2) < RESIDUAL
    assert 'replanned' not in rig.codes()


def test_clock_that_is_set_back_drops_the_plan_and_tells_so_once():
    rig = Rig()
    rig.go(trajectory(*SEQUENCE), START + 20 * MS)
    for _ in range(5):
        rig.runtime.clock_set_back(10 * MS)
    rig.tick()
    assert rig.codes().count('clock_jumped') == 1
    assert 'the clock jumped back by 0.010 s' in rig.status.verdict.message
    assert (rig.status.progress.state, rig.runtime.clock_jumps) == ('idle', 5)
    assert rig.runtime.wake is None
    assert rig.runtime.request(StretchRequest('a', 1.1)).code == 'accepted'
    assert rig.planner.plan.levels[0].stretch == 1.0


@pytest.mark.parametrize('receipts', [False, True])
def test_a_device_that_takes_over_from_another_is_sent_no_level_of_before(receipts):
    rig = Rig(settings=replace(QUIET, heartbeat_period=10 * MS))
    if receipts:
        rig.runtime.received('a', rig.now, 0, cut_off=False)
    reporters = {b'old'}
    rig.runtime.environment.reporters = lambda joint: frozenset(reporters)
    rig.go(trajectory(*SEQUENCE), START + LEAD + 20 * MS)
    assert rig.status.progress.state != 'idle'
    # Both for a moment, as at no time there is none.
    reporters.add(b'new')
    rig.run(rig.now + 10 * MS)
    sent = len(rig.sent)
    rig.run(rig.now + 10 * MS)
    reporters.remove(b'old')
    rig.run(rig.now + 20 * MS)
    assert len(rig.sent) == sent
    assert rig.noted('plant or driver of joint a started after the commands were sent') == 1


@pytest.mark.parametrize('by', [240_000 * MS, -5_000 * MS])
def test_the_plan_goes_on_when_the_clock_is_set(by):
    rig = Rig(settings=replace(QUIET, heartbeat_period=10 * MS))
    rig.runtime.request(trajectory(*SEQUENCE))
    planned = [(x.stamp, x.flux_density) for x in rig.planner.plan.levels[1:]]
    rig.run(START + LEAD + 20 * MS)
    rig.deliver()
    rig.runtime.clock_set(by)
    rig.now += by
    rig.set_by = by
    known = len(rig.sent)
    rig.run(START + by + LEAD + 3 * HOLD)
    later = [x for x in planned if x[0] > START + 2 * LEAD + 20 * MS]
    assert later
    sent = [(x.stamp - by, x.flux_density) for _, x in rig.sent[known:]]
    assert [x for x in sent if x in planned] == later
    assert max(np.diff([now for now, _ in rig.sent[known:]])) <= 20 * MS
    words = f'{"ahead" if by > 0 else "back"} by {abs(by) / 1e9:.3f} s: planned levels apply'
    assert [words in x for x in rig.notes()] == [True]
    assert rig.residual(1.4) < RESIDUAL
    assert rig.status.progress.state == 'at_rest'
    assert rig.runtime.request(StretchRequest('a', 1.3)).code == 'accepted'
    assert rig.planner.plan.segments[-1].since - rig.now == LEAD


@pytest.mark.parametrize('again', [StretchRequest('a', 1.2), trajectory((1.2, HOLD))])
@pytest.mark.parametrize('reading', range(4))
def test_a_request_is_planned_again_where_the_clock_is_set_back_meanwhile(reading, again):
    rig = Rig()
    rig.go(StretchRequest('a', 1.1), START + 300 * MS)
    before = len(rig.sent)
    rig.set_back_at = reading, START
    assert rig.runtime.request(again).code == 'accepted'
    assert rig.set_back_at is None
    rig.run(rig.now + 100 * MS)
    assert rig.codes()[-4:].count('clock_jumped') == 1
    # Of the old plan nothing is left, and the new one is for the time that has begun.
    assert rig.planner.plan.levels[0].stretch == 1.0
    assert all(x.stamp < START for _, x in rig.sent[before:])
