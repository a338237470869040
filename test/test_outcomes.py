"""The outcomes that a planner publishes of its setpoints, without ROS."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from hmsa.interfaces.diagnostics import newest, Outcome
from hmsa.model.actuators import Setup
from hmsa.model.parameters import paper_actuator
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import Settings, Stop, StretchRequest, Trajectory

MS = 1_000_000
START = 1000 * MS
BLOCK = paper_actuator()


class Bench:
    """A planner and a simulated device, and the outcomes so far."""

    def __init__(self, joints=('a',), shear_modulus=1.0, **settings):
        real = replace(BLOCK, shear_modulus=BLOCK.shear_modulus * shear_modulus)
        options = Options(flux_density_min=-0.5, flux_density_max=0.5)
        self.joints = joints
        self.loop = Loop(
            PlannerGroup({x: Planner(BLOCK, options) for x in joints}),
            Settings(takeover_timeout=0, allow_partial_joints=True, **settings),
            SimulatedDevice(
                [SimulatedJoint(Setup(real, real.rest)) for _ in joints], period=MS, time=START))
        self.all = []
        self.loop.deliver = lambda x: self.all.append(x) if isinstance(x, Outcome) else None

    def send(self, *points, **more):
        """Request (stretch, end in ms) of all joints."""
        self.loop.runtime.request(Trajectory(
            self.joints, [((x,) * len(self.joints), end * MS) for x, end in points],
            len(points), **more))

    def wait(self, ms):
        self.loop.run(self.loop.now + ms * MS)
        return self

    @property
    def told(self):
        """Request, setpoint, verdict, and why it ended early."""
        return [(x.request, x.setpoint.number, x.finding and str(x.finding.verdict), x.ended)
                for x in newest(self.all)]


def test_each_setpoint_of_each_joint_has_one_outcome_with_what_was_asked_and_planned():
    bench = Bench(('a', 'b'))
    bench.send((1.1, 300), (1.2, 600), name='x')
    bench.wait(1200)
    assert len(newest(bench.all)) == len(bench.all) == 4
    for joint in 'a', 'b':
        first, second = (x for x in newest(bench.all) if x.joint == joint)
        asked = first.setpoint
        assert (asked.joint, asked.target, asked.start, asked.end - asked.begins) == (
            joint, 1.1, 1.0, 300 * MS)
        plan = bench.loop.runtime.group.planners[joint].plan.segments
        assert first.moves == ((plan[0].begin, plan[0].arrival),)
        assert (second.setpoint.begins, second.arrival) == (asked.end, plan[1].arrival)
        assert (asked.held, second.setpoint.held) == (False, True)
        assert [str(x.finding.verdict) for x in (first, second)] == ['arrived'] * 2
        assert first.decided <= asked.end + 20 * MS


def test_a_request_that_is_replaced_tells_what_was_reached_and_what_was_not():
    bench = Bench()
    bench.send((1.1, 300), (1.2, 600), (1.3, 900), (1.0, 1200), name='x')
    bench.wait(400)
    bench.loop.runtime.request(StretchRequest('a', 1.05))
    bench.wait(600)
    assert bench.told == [
        ('x', 1, 'arrived', ''), ('x', 2, 'arrived', 'replaced'), ('', 1, 'arrived', ''),
        ('x', 3, None, 'replaced')]
    second, after, rest = newest(bench.all)[1:]
    assert second.until == rest.until == after.setpoint.begins
    # Setpoints that never began share one.
    assert (rest.setpoint.number, rest.through) == (3, 4)
    assert rest.message == 'setpoint 3 to 4 of 4: replaced before arrival'
    # What is held without end is over once it is replaced.
    bench.send((1.1, 300), name='y')
    bench.wait(600)
    assert bench.told[2:] == [
        ('', 1, 'arrived', 'replaced'), ('x', 3, None, 'replaced'), ('y', 1, 'arrived', '')]


def test_a_request_for_later_leaves_the_running_one_its_setpoints_until_then():
    bench = Bench()
    bench.send((1.1, 300), (1.2, 600), (1.3, 900), name='x')
    bench.wait(100)
    bench.send((1.0, 300), name='y', stamp=bench.loop.now + 400 * MS)
    bench.wait(1200)
    assert bench.told == [
        ('x', 1, 'arrived', ''), ('x', 2, 'arrived', 'replaced'), ('y', 1, 'arrived', ''),
        ('x', 3, None, 'replaced')]


def test_a_stop_ends_setpoints_and_has_no_outcome_itself():
    bench = Bench()
    bench.send((1.1, 300), (1.2, 600), name='x')
    bench.wait(200)
    bench.loop.runtime.request(Stop('y'))
    bench.wait(600)
    assert bench.told == [('x', 1, 'arrived', 'stopped'), ('x', 2, None, 'stopped')]


def test_a_planner_that_ends_tells_of_each_setpoint_that_it_has_not_told_of():
    bench = Bench()
    bench.send((1.1, 300), (1.2, 600), (1.3, 900), (1.0, 1200), name='x')
    bench.wait(400)
    for outcome in bench.loop.runtime.close():
        bench.loop.deliver(outcome)
    assert bench.told == [
        ('x', 1, 'arrived', ''), ('x', 2, None, 'inactive'), ('x', 3, None, 'inactive')]
    last = newest(bench.all)[-1]
    assert (last.setpoint.number, last.through) == (3, 4)
    assert len(bench.all) == 3


def test_a_planner_that_ends_after_a_request_repeats_no_outcome():
    bench = Bench()
    bench.send((1.1, 300), (1.2, 600), name='x')
    bench.wait(900)
    assert bench.loop.runtime.close() == []
    assert bench.told == [('x', 1, 'arrived', ''), ('x', 2, 'arrived', '')]


def test_a_cut_off_names_itself_as_the_reason():
    bench = Bench()
    bench.send((1.1, 300), (1.2, 600), (1.3, 900), name='x')
    bench.wait(450)
    bench.loop.runtime.cut_off('a', in_force=True, time=bench.loop.now)
    bench.wait(300)
    assert bench.told == [
        ('x', 1, 'arrived', ''), ('x', 2, 'missed', 'cut_off'), ('x', 3, 'missed', 'cut_off')]
    assert newest(bench.all)[1].message.endswith('missed: the coil was cut off')


def test_a_cut_off_after_the_end_of_a_request_takes_no_arrival_back():
    bench = Bench()
    bench.send((1.1, 300), (1.2, 600), name='x')
    bench.wait(900)
    bench.loop.runtime.cut_off('a', in_force=True, time=bench.loop.now)
    bench.wait(300)
    assert bench.told == [('x', 1, 'arrived', ''), ('x', 2, 'arrived', '')]


def test_a_correction_from_samples_is_told_with_its_arrival():
    bench = Bench(shear_modulus=1.05, feedback='adapt')
    bench.send((1.3, 500), (1.1, 1000), name='x')
    bench.wait(2000)
    found = [x for x in newest(bench.all) if len(x.moves) > 1]
    assert found
    for x in found:
        assert x.corrected
        assert x.moves[0][1] == x.setpoint.arrival
        assert x.moves[-1][1] == x.setpoint.moved != x.setpoint.arrival


def test_raw_levels_and_setpoints_are_told_apart():
    bench = Bench()
    bench.send((0.0, 0), (0.01, 100), raw=True, name='x')
    bench.wait(800)
    bench.send((1.1, 300), name='y')
    bench.wait(800)
    assert [(x.request, x.asked) for x in newest(bench.all)] == [
        ('x', 'levels'), ('y', 'setpoint')]


def test_an_outcome_is_read_as_it_was_published():
    bench = Bench(('a', 'b'), shear_modulus=1.1)
    bench.send((1.1, 300), (1.3, 600), (1.0, 900), name='x')
    bench.wait(450)
    bench.loop.runtime.request(StretchRequest('a', 1.05))
    bench.wait(800)
    assert {x.ended for x in bench.all} == {'', 'replaced'}
    for told in bench.all:
        message = SimpleNamespace(message=told.message, hardware_id=told.joint, values=[
            SimpleNamespace(key=key, value=x) for key, x in told.to_texts().items()])
        read = Outcome.read(message)
        assert read.to_texts() == told.to_texts()
        assert (read.moves, read.until, read.arrival, read.missed, read.message) == (
            told.moves, told.until, told.arrival, told.missed, told.message)
        assert read.setpoint == told.setpoint
        assert str(read.finding) == str(told.finding and replace(
            told.finding, setpoint=read.setpoint))


@pytest.mark.parametrize('values', [{}, {'code': 'accepted'}])
def test_a_status_is_no_outcome(values):
    with pytest.raises(ValueError, match='no usable value'):
        Outcome.read(SimpleNamespace(message='', hardware_id='a', values=[
            SimpleNamespace(key=key, value=x) for key, x in values.items()]))
