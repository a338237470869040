"""What watch and panel show of running nodes, and the lines of watch."""

from contextlib import suppress
from dataclasses import replace
import json
import random
import signal

import numpy as np
import pytest

from hmsa.interfaces.diagnostics import StatusVerdict
from hmsa_lab.panel.listener import as_json, JointView, line, PeakHistory, Report, Scene, SLOTS

WAIT_SECONDS = 60.0


def history(values, span=10.0):
    """Return a history that ends at time 100 with equally spaced values."""
    result = PeakHistory(span)
    result.put(100.0 - span, 100.0, np.asarray(values, dtype=float))
    return result


def joint(name='actuator', stretch=1.1, target=1.2):
    return JointView(
        name, history(np.linspace(1.0, stretch, 1000)), history(np.full(1000, target)),
        stretch, 0.5, 0.0345, target, 0.065, 'stretch')


def scene(*joints):
    return Scene(
        'domain 42  /', 100.0, stamp=12.5, age=0.01, sample_rate=1000.0,
        joints=joints or (joint(),), progress=0.25,
        request=StatusVerdict(0, 'accepted', 'accepted', '', 'moving', 1, 3),
        reports=[Report('planner', 1, '2 commands sent late', {'sent': 6, 'late': 2}),
                 Report('plant', 0, 'commands in time', {'late': 0}, age=9.0)])


# Charts --------------------------------------------------------------------------------------

def test_a_history_keeps_every_peak():
    values = np.ones(10_000)
    values[3_210], values[7_777] = 5.0, -3.0
    low, high = history(values).ranges(100.0)
    assert (len(low), len(high)) == (SLOTS, SLOTS)
    # The last slot has just begun.
    assert np.flatnonzero(high == 5.0).tolist() == [int(0.3211 * SLOTS) - 1]
    assert np.flatnonzero(low == -3.0).tolist() == [int(0.7778 * SLOTS) - 1]


def test_a_history_forgets_what_has_left_the_chart():
    kept = history(np.full(100, 2.0))
    low, high = kept.ranges(105.0)
    assert np.nanmax(high[:SLOTS // 2 - 5]) == 2.0
    assert np.all(np.isnan(low[SLOTS // 2 + 5:]))
    assert np.all(np.isnan(kept.ranges(1e6)[0]))


def test_a_target_that_holds_is_a_line_without_gaps():
    history = PeakHistory(10.0)
    # Looks are further apart than the slots of a history.
    for i in range(100):
        history.hold(0.1 * i, 0.1 * (i + 1), 1.2)
    assert np.array_equal(history.ranges(10.0), np.full((2, SLOTS), 1.2))
    history.hold(10.0, 1e6, 1.3)
    assert np.array_equal(history.ranges(1e6), np.full((2, SLOTS), 1.3))


def test_a_line_tells_of_trouble_only_where_there_is_some():
    assert line(scene()) == (
        '12.500 s (simulated); actuator 1.10000 (target 1.20000, +34.500 mT); moving 1/3, OK '
        'accepted; planner: 2 commands sent late, late 2; plant: silent for 9 s')
    told = replace(scene().request, finding='setpoint 1 arrived late')
    assert 'OK accepted; setpoint 1 arrived late;' in line(replace(scene(), request=told))
    assert line(Scene('domain 1  /', waiting=['no planner seen'])) == 'no planner seen'


def test_json_has_null_for_what_is_not_known():
    made = json.loads(json.dumps(as_json(scene())))
    assert made['joints'] == [{
        'name': 'actuator', 'stretch': 1.1, 'stretch_rate': 0.5, 'flux_density': 0.0345,
        'target': 1.2, 'flux_density_command': 0.065}]
    assert made['request']['state'] == 'moving'
    made = as_json(Scene('domain 1  /'))
    assert made['stamp'] is None
    assert made['request'] is None


# The command ---------------------------------------------------------------------------------

@pytest.mark.ros
def test_each_joint_has_its_own_target_command_and_history(ros, ros_env, wait_until):
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from geometry_msgs.msg import Vector3
    from sensor_msgs.msg import JointState, MagneticField
    from std_msgs.msg import Header

    from hmsa.interfaces import topics
    from hmsa_lab.panel.listener import Listener
    from hmsa_ros.nodes import ros_entities
    from hmsa_ros.nodes.conversions import to_time

    def status(name, level, joint, **values):
        return DiagnosticStatus(
            name=name, level=level, hardware_id=joint, message='said',
            values=[KeyValue(key=x.replace('__', '.'), value=y) for x, y in values.items()])

    publish = {
        name: ros.node.create_publisher(kind, name, qos).publish for name, kind, qos in (
            ('joint_states', JointState, 100), ('diagnostics', DiagnosticArray, 10),
            ('planner/status', DiagnosticStatus, ros_entities.profile(topics.LATCHED)),
            ('right/flux_density_command', MagneticField, 100))}
    publish['planner/status'](status(
        'planner: request', DiagnosticStatus.OK, 'left, right', state='moving', stretch='',
        left__stretch='1.1', right__stretch='0.9', right__coordinate='deflection', setpoint='1',
        setpoints='2'))
    seen = []
    with Listener(span=10.0) as listener:
        def there():
            number = len(seen)
            stamp = Header(stamp=to_time(10**9 + number))
            publish['joint_states'](JointState(
                header=stamp, name=['left', 'right'],
                position=[1.0 + 0.5 * (number % 9 == 5), 0.95], velocity=[0.5],
                effort=[0.01, -0.04]))
            publish['right/flux_density_command'](MagneticField(
                header=stamp, magnetic_field=Vector3(z=-0.02)))
            publish['diagnostics'](DiagnosticArray(status=[
                status('planner: commands', DiagnosticStatus.OK, 'left', late='1'),
                status('planner: time', DiagnosticStatus.WARN, '', late='2'),
                status('battery: charge', DiagnosticStatus.ERROR, 'pack', cells='7')]))
            seen.append(listener.look())
            return seen[-1].request and seen[-1].reports and all(
                np.isfinite(x.target) for x in seen[-1].joints) and np.isfinite(
                    seen[-1].joints[1].commanded) and seen[-1].joints[0].stretch == 1.0 and (
                    np.nanmax(seen[-1].joints[0].stretches.ranges(seen[-1].now)[1]) == 1.5)
        # A peak that is over when the view is drawn is still in the chart.
        wait_until(there)
        left, right = seen[-1].joints
        assert (left.name, left.target, left.flux_density) == ('left', 1.1, 0.01)
        assert (right.name, right.target, right.stretch, right.coordinate) == (
            'right', 0.9, 0.95, 'deflection')
        assert (left.rate, np.isnan(right.rate)) == (0.5, True)
        assert (np.isnan(left.commanded), right.commanded) == (True, -0.02)
        report, = seen[-1].reports
        assert (report.name, report.level, report.counts) == ('planner', 1, {'late': 3})
        assert seen[-1].request.setpoints == 2


@pytest.mark.ros
def test_garbage_on_its_topics_neither_ends_nor_misleads_it(ros, ros_env, wait_until):
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    from benchmarks.faults import garbage
    from hmsa.interfaces import topics
    from hmsa_lab.panel.listener import Listener
    from hmsa_ros.nodes import ros_entities
    from hmsa_ros.nodes.conversions import to_command

    dice = random.Random(7)
    senders = [
        (kind, ros.node.create_publisher(kind, name, qos)) for name, kind, qos in (
            ('joint_states', JointState, 1000), ('diagnostics', DiagnosticArray, 1000),
            ('planner/status', DiagnosticStatus, ros_entities.profile(topics.LATCHED)),
            ('planner/plan', JointTrajectory, ros_entities.profile(topics.LATCHED)),
            ('flux_density_command', type(to_command(0, 0.0, '')), 1000))]
    with Listener(span=10.0) as listener:
        def aside():
            for kind, publisher in senders:
                for made in (garbage.message, garbage.encoding):
                    # What the middleware itself does not take never arrives.
                    with suppress(Exception):
                        publisher.publish(made(kind, dice))
            # What it is made for, with values that are wild.
            senders[1][1].publish(DiagnosticArray(status=[DiagnosticStatus(
                name='planner: \x1b[2J', message='\x1b]0;mine\x07', level=bytes([255]),
                values=[KeyValue(key='late', value=dice.choice(('²', '9' * 5000, '7')))])]))
            seen = listener.look()
            assert line(seen).isprintable()
            json.dumps(as_json(seen), allow_nan=False)
            return {name for name in ('joint_states', 'diagnostics', 'status', 'plan', 'command')
                    if any(f'{name} ignored' in x for x in seen.waiting)}

        names = wait_until(lambda: len(found := aside()) == 5 and found)
        assert len(names) == 5
        good = JointState(name=['finger'], position=[1.25], velocity=[0.0], effort=[0.01])
        senders[0][1].publish(good)
        wait_until(lambda: {x.name: x for x in listener.look().joints}['finger'].stretch == 1.25)


@pytest.mark.ros
def test_lines_follow_a_real_run_until_a_signal(start, wait_until):
    # In slow motion, whose time stands still with the plant on a busy machine.
    start.hmsa('plant', '--ros-args', '-p', 'publish_clock:=true', '-p', 'real_time_factor:=0.1')
    start.hmsa('planner', '--ros-args', '-p', 'use_sim_time:=true', '-p', 'lead_time:=0.1')
    lines, objects = start.hmsa('watch'), start.hmsa('watch', '--json')
    lines.wait_for_output('actuator 1.00000')
    lines.wait_for_output('no request yet')
    send = start.hmsa('send', '1.1:0.3', '1.2:0.3', '--wait')
    assert send.wait(WAIT_SECONDS) == 0, send.output
    lines.wait_for_output('actuator 1.20000 (target 1.20000, +64.915 mT); at rest 2/2, OK ')
    objects.wait_for_output('"state": "at_rest", "setpoint": 2')

    def arrived():
        # On a busy machine, a status is shown before the samples that came ahead of it.
        newest = json.loads(objects.stdout.rpartition('\n')[0].splitlines()[-1])
        return newest['joints'][0]['stretch'] == pytest.approx(1.2, abs=1e-5)

    wait_until(arrived)
    assert (lines.stop(signal.SIGINT), objects.stop(signal.SIGTERM)) == (0, 0)


@pytest.mark.ros
@pytest.mark.long
def test_once_waits_for_what_is_missing_and_says_so(start, ros_domain_id):
    start.hmsa('plant', '--ros-args', '-p', 'joint:=finger')
    once = start.hmsa('watch', '--once', '--timeout', '10')
    missed = start.hmsa('watch', '--once', '--json', '--joint', 'thumb', '--timeout', '10')
    assert once.wait() == 0
    assert 'waiting up to 10 s for samples and a status ...' in once.stderr
    said, = once.stdout.splitlines()
    assert 'finger 1.00000 (target ?' in said
    assert f'no planner seen on domain {ros_domain_id}: is it running, with the same ' \
        'ROS_DOMAIN_ID' in said
    assert missed.wait() == 1
    assert json.loads(missed.stdout)['request'] is None
    assert 'no joint thumb on /joint_states: it has finger' in missed.stdout


@pytest.mark.parametrize(('words', 'said'), [
    ('--once --timeout -1', 'timeout is -1 s: expected 0 to'),
    ('--once --timeout nan', 'timeout is nan'), ("--namespace '9 bad'", "namespace '9 bad'")])
def test_bad_input_is_answered_in_one_line_with_status_2(words, said, refusal, ros_env):
    assert said in refusal(f'watch {words}')
