"""Goals of FollowJointTrajectory without ROS: accepted, executed, judged by samples, ended."""

from dataclasses import replace
import math

from at_work import AtWork, MS, planner, START
import numpy as np
import pytest

from hmsa.model.actuators import Setup
from hmsa.model.parameters import paper_actuator
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.runtime.goals import ErrorCode, Goals
from hmsa_ros.runtime.records import StatusChanged, Stop, StretchRequest, Trajectory

NAN = math.nan


class Bench(AtWork):
    """A runtime, its goals and simulated actuators with samples at 1 kHz."""

    def __init__(self, joints=('a',), shear_modulus=1.0, *, measured=True, **block):
        block = replace(paper_actuator(), **block)
        real = replace(block, shear_modulus=block.shear_modulus * shear_modulus)
        self.measured = measured
        self.device = SimulatedDevice(
            [SimulatedJoint(Setup(real, real.rest)) for _ in joints], period=MS, time=START)
        super().__init__(
            {x: planner(block) for x in joints}, observable=lambda: self.measured)
        self.joints, self.truth, self.outcomes = list(joints), [], {}
        self.goals = Goals(self.runtime, self.outcomes.__setitem__)
        self.spoil = lambda stamp, stretch: (stamp, stretch)

    def add(self, points, name='x', *, stamp=None, joints=None, **tolerances):
        """Send a goal of stretches, or of (stretch, rate), each until a time in ms."""
        joints = tuple(self.joints if joints is None else joints)
        path = None
        if np.size(points[0][0]) > 1:
            path = [([(*x, NAN)] * len(joints), t * MS) for x, t in points]
        rows = [([np.ravel(x)[0]] * len(joints), t * MS) for x, t in points]
        return self.goals.add(Trajectory(
            joints, rows, len(rows), stamp, name, path=path), **tolerances)

    def tick(self):
        begin = len(self.outputs)
        for x in super().tick():
            self.device.receive(self.joints.index(x.joint), x.stamp, x.flux_density)
        for x in self.outputs[begin:]:
            if isinstance(x, StatusChanged):
                self.goals.update(x)

    def run(self, ms):
        for _ in range(ms):
            self.tick()
            self.now += MS
            self.device.advance(self.now)
            for x in self.device.changes():
                self.runtime.applied(self.joints[x.joint], x.stamp, x.level)
            self.truth.append(self.device.stretch[0])
            for x in self.device.samples():
                if self.measured:
                    for joint, true in zip(self.joints, x.stretch.tolist(), strict=True):
                        stamp, stretch = self.spoil(x.time, true)
                        self.show(stamp, stretch, joint)
                        self.goals.observe(joint, stamp, stretch, NAN, self.now)
        self.tick()

    def ended(self, name='x'):
        return self.outcomes[name].state, self.outcomes[name].code


def dense(goal=1.3, duration=100, count=21):
    """Return a smooth path as sent by MoveIt."""
    s = np.linspace(0.0, 1.0, count)
    x = 1.0 + (goal - 1.0) * s * s * (3.0 - 2.0 * s)
    v = (goal - 1.0) / (duration * 1e-3) * 6.0 * s * (1.0 - s)
    return [((float(a), float(b)), round(duration * c)) for a, b, c in zip(x, v, s, strict=True)]


SUCCESS = 'succeeded', ErrorCode.SUCCESSFUL


@pytest.mark.parametrize('points', [[(1.2, 100), (1.3, 300)], dense()], ids=['rests', 'path'])
def test_a_goal_succeeds_when_samples_have_shown_the_arrival(points):
    bench = Bench()
    bench.add(points, path_tolerance=[('a', 1e-4, 0.0)], goal_tolerance=[('a', 1e-4, 1e-2)])
    bench.run(points[-1][1])
    assert not bench.outcomes
    assert bench.goals.elapsed('x', bench.now) == pytest.approx(points[-1][1] * MS - 50 * MS)
    (desired, _), (measured, _) = bench.goals.readings(bench.now, 'x')['a']
    assert desired == pytest.approx(measured, abs=1e-3)
    bench.run(600)
    assert bench.ended() == SUCCESS
    assert bench.outcomes['x'].message.startswith('setpoint ')
    if len(points) > 2:
        # Its points are passed, and not rests.
        assert bench.runtime.group.planners['a'].plan.segments[-1].code == 'path'
        assert bench.truth[50 + 50] == pytest.approx(1.15, abs=0.02)


@pytest.mark.parametrize('joints', [('b', 'a'), ('a',), ('a', 'b', 'c'), ('a', 'a'), ()])
def test_joints_come_in_any_order_but_all_of_them(joints):
    bench = Bench(joints=('a', 'b'))
    verdict = bench.add([(1.2, 100)], joints=joints)
    assert (verdict.code == 'unknown_joint') is (joints != ('b', 'a'))
    if joints == ('b', 'a'):
        bench.run(700)
        assert bench.ended() == SUCCESS


@pytest.mark.parametrize(('wish', 'text'), [
    ({'path_tolerance': [('b', 0.1, 0.0)]}, r"path_tolerance has joint 'b': expected one of"),
    ({'goal_tolerance': [('a', -0.5, 0.0)]}, 'goal_tolerance of joint a is -0.5: expected more'),
    ({'goal_tolerance': [('a', 0.1, NAN)]}, 'goal_tolerance of joint a is nan: expected more'),
    ({'goal_time_tolerance': -1}, 'goal_time_tolerance is -1e-09 s: expected at least 0 s')])
def test_a_tolerance_that_is_none_is_refused_and_the_goal_before_goes_on(wish, text):
    bench = Bench()
    bench.add([(1.2, 100)])
    bench.run(80)
    verdict = bench.add([(1.3, 100)], 'y', **wish)
    assert verdict.severity == 2
    assert text in verdict.message
    bench.run(600)
    assert bench.ended() == SUCCESS
    assert 'y' not in bench.outcomes
    assert bench.truth[-1] == pytest.approx(1.2, abs=1e-6)


def refused(bench, points, code, state='aborted', **more):
    verdict = bench.add(points, **more)
    bench.run(100)
    if verdict.severity == 2:
        return ErrorCode.of(verdict.code) == code and not bench.outcomes
    return bench.ended() == (state, code)


def test_what_cannot_be_planned_is_refused_with_a_code_of_the_action():
    old = ErrorCode.OLD_HEADER_TIMESTAMP
    assert refused(Bench(), [(1.2, 100)], old, stamp=START - 200 * MS)
    for points in (
            [(1.2, 100), (1.3, 100)], [(1.2, -1)], [(1.2, 0)], [(NAN, 100)], [(-1.0, 100)],
            [(9.0, 100)], [((1.2, NAN), 100)], [((1.2, 0.5), 100)], [((1.2, 0.0), 0)]):
        assert refused(Bench(), points, ErrorCode.INVALID_GOAL), points
    assert Bench().goals.add(Trajectory(('a',), [], 0)).code == 'bad_input'


def test_without_samples_it_does_not_succeed_and_says_that_nothing_was_measured():
    bench = Bench(measured=False)
    bench.add([(1.2, 100)])
    bench.run(700)
    assert bench.ended() == ('aborted', ErrorCode.GOAL_TOLERANCE_VIOLATED)
    assert 'predicted, not measured' in bench.outcomes['x'].message
    assert 'expected samples on joint_states' in bench.outcomes['x'].message


def test_a_plant_that_stays_beside_the_goal_violates_its_tolerance_or_one_that_allows_it():
    for tolerance, expected in (
            (0.0, ('aborted', ErrorCode.GOAL_TOLERANCE_VIOLATED)),
            (0.1, SUCCESS), (-1.0, SUCCESS)):
        bench = Bench(shear_modulus=1.1)
        bench.add([(1.3, 100)], goal_tolerance=[('a', tolerance, 0.0)])
        bench.run(700)
        assert bench.ended() == expected
    assert 'short of 1.3' in bench.outcomes['x'].message


@pytest.mark.parametrize(('time', 'expected'), [
    (1, ('aborted', ErrorCode.GOAL_TOLERANCE_VIOLATED)), (1200, SUCCESS)])
def test_vibration_may_fade_within_the_goal_time_tolerance(time, expected):
    bench = Bench(shear_modulus=1.1)
    bench.add([(1.3, 100)], goal_tolerance=[('a', 0.1, 0.02)], goal_time_tolerance=time * MS)
    bench.run(120)
    assert np.ptp(bench.truth[-40:]) > 5e-3
    bench.run(1500)
    assert bench.ended() == expected


def test_a_goal_already_reached_is_held_against_its_own_tolerance():
    bench = Bench(shear_modulus=1.01)
    bench.add([(1.3, 100)])
    bench.run(700)
    assert bench.ended() == SUCCESS
    bench.add([(1.3, 100)], 'y', goal_tolerance=[('a', 1e-5, 0.0)])
    bench.run(700)
    assert bench.ended('y') == ('aborted', ErrorCode.GOAL_TOLERANCE_VIOLATED)
    assert 'expected at most 1e-05 off' in bench.outcomes['y'].message


def test_a_goal_already_reached_arrives_within_a_tolerance_that_the_one_before_had_not():
    bench = Bench(shear_modulus=1.1)
    bench.add([(1.3, 100)])
    bench.run(700)
    assert bench.ended() == ('aborted', ErrorCode.GOAL_TOLERANCE_VIOLATED)
    bench.add([(1.3, 100)], 'y', goal_tolerance=[('a', 0.1, -1.0)])
    bench.run(700)
    assert bench.ended('y') == SUCCESS


@pytest.mark.parametrize('points', [[(1.3, 300)], dense(duration=300)], ids=['rests', 'path'])
def test_a_sample_off_the_path_aborts_the_goal_and_the_actuator_comes_to_rest(points):
    bench = Bench()
    bench.add(points, path_tolerance=[('a', 0.01, 0.0)])
    bench.run(150)
    bench.spoil = lambda stamp, stretch: (stamp, stretch + 0.02)
    bench.run(2)
    assert bench.ended() == ('aborted', ErrorCode.PATH_TOLERANCE_VIOLATED)
    assert 'within 0.01' in bench.outcomes['x'].message
    bench.run(400)
    assert np.ptp(bench.truth[-100:]) < 1e-5
    assert bench.truth[-1] != pytest.approx(1.3, abs=1e-3) or len(points) == 1


def test_samples_of_another_time_or_no_number_abort_nothing():
    bench = Bench()
    bench.add([(1.3, 100)], path_tolerance=[('a', 1e-3, 0.0)])
    bench.run(60)
    for stamp in (0, -5, bench.now + 10_000 * MS, 2**62):
        bench.goals.observe('a', stamp, 1.7, 0.0, bench.now)
    bench.goals.observe('a', bench.now, NAN, NAN, bench.now)
    bench.goals.observe('stranger', bench.now, 1.7, 0.0, bench.now)
    assert not bench.outcomes
    bench.run(700)
    assert bench.ended() == SUCCESS


def test_a_new_goal_preempts_without_a_jump_and_a_refused_one_does_not():
    bench = Bench()
    bench.add(dense(duration=300))
    bench.run(150)
    bench.add([(9.0, 100)], 'bad')
    bench.run(10)
    assert 'x' not in bench.outcomes
    bench.add([(1.1, 200)], 'y')
    bench.run(5)
    assert bench.ended() == ('aborted', ErrorCode.INVALID_GOAL)
    bench.run(800)
    assert bench.ended('y') == SUCCESS
    assert np.ptp(bench.truth[-500:]) < 1e-6


@pytest.mark.parametrize('request_', [StretchRequest('a', 1.1), Stop()])
def test_any_other_request_takes_its_place(request_):
    bench = Bench()
    bench.add(dense(duration=300))
    bench.run(150)
    bench.runtime.request(request_)
    bench.run(5)
    assert bench.ended() == ('aborted', ErrorCode.INVALID_GOAL)
    assert 'another request' in bench.outcomes['x'].message


def test_a_canceled_goal_comes_to_rest_before_it_ends():
    bench = Bench()
    bench.add(dense(duration=300))
    bench.run(150)
    bench.goals.cancel('x')
    bench.run(5)
    assert not bench.outcomes
    bench.run(300)
    assert bench.ended() == ('canceled', ErrorCode.SUCCESSFUL)
    assert np.ptp(bench.truth[-100:]) < 1e-5
    assert bench.truth[-1] < 1.29
    bench.goals.cancel('x')
    bench.goals.cancel('nobody')
    bench.add([(1.2, 100)], 'y')
    bench.run(700)
    assert bench.ended('y') == SUCCESS


def test_a_goal_canceled_before_it_is_planned_comes_to_rest_with_what_runs():
    bench = Bench()
    bench.add(dense(duration=300))
    bench.run(150)
    bench.add([(1.0 + 0.1 * (i % 2), 20 * (i + 1)) for i in range(2000)], 'y')
    bench.goals.cancel('y')
    bench.run(300)
    assert bench.ended('y') == ('canceled', ErrorCode.SUCCESSFUL)
    assert bench.ended() == ('aborted', ErrorCode.INVALID_GOAL)
    assert np.ptp(bench.truth[-100:]) < 1e-5


def test_a_goal_whose_plan_is_dropped_ends():
    for drop in (
            lambda bench: bench.runtime.clock_set_back(500 * MS),
            lambda bench: bench.runtime.deactivate()):
        bench = Bench()
        bench.add(dense(duration=300))
        bench.run(100)
        drop(bench)
        bench.run(5)
        assert bench.ended() == ('aborted', ErrorCode.INVALID_GOAL)


def test_a_clock_that_is_set_ahead_changes_nothing_of_a_goal():
    bench = Bench()
    bench.add(dense(duration=300), path_tolerance=[('a', 1e-3, 0.0)])
    bench.run(150)
    bench.now += 5000 * MS
    bench.runtime.clock_set(5000 * MS)
    bench.tick()
    assert bench.goals.elapsed('x', bench.now) == pytest.approx(100 * MS, abs=MS)
    (desired, _), _ = bench.goals.readings(bench.now, 'x')['a']
    assert desired == pytest.approx(1.0 + 0.3 * 7 / 27, abs=0.01)
