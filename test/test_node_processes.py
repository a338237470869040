"""Planner and plant as processes: end, refused start, and joint operation."""

import re
import signal
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool, Trigger

from hmsa.cli import main
from hmsa.interfaces import topics
from hmsa.model.simulation import residual_vibration
from hmsa_ros.nodes.conversions import from_time, to_trajectory

pytestmark = pytest.mark.ros

MS = 1_000_000
SPELL = 44 * MS
# Residual vibration after arrival, as a share of the step.
NO_VIBRATION = 1e-6
NODES = ('planner', 'plant')

# Arguments that refuse the start, and what the line on standard error says of them.
BAD = {
    'out_of_range': (
        ['--ros-args', '-p', 'actuator.density:=-1.0'],
        'parameter actuator.density is -1.0: expected float, 0.001 to 1e+06 kg/m^3'),
    'not_finite': (
        ['--ros-args', '-p', 'actuator.density:=.nan'],
        'parameter actuator.density is nan: expected'),
    'wrong_type': (
        ['--ros-args', '-p', 'joint:=3'], 'parameter joint is 3: expected str'),
    'beyond_the_limits': (
        ['--ros-args', '-p', 'initial_stretch:=5.0'],
        'initial stretch is 5: expected a stretch between the limits 0.2520 and 2.6940'),
    'mistyped_name': (
        ['--ros-args', '-p', 'actuator.remanance:=0.1'],
        'parameter actuator.remanance does not exist: expected one of the '),
    'former_name': (
        ['--ros-args', '-p', 'law:=yeoh', '-p', 'law.c10:=5000.0'],
        'parameter law has been renamed: expected law.name'),
    'unknown_argument': (['--speed', '3'], '--speed'),
    'unknown_ros_argument': (['--ros-args', '--speed'], "'--ros-args --speed'"),
    'malformed_remapping': (['--ros-args', '-r', 'nonsense'], "'-r nonsense'"),
    'missing_parameter_file': (
        ['--ros-args', '--params-file', '/nowhere/planner.yaml'], '/nowhere/planner.yaml'),
}
BAD_OF_A_NODE = {
    'planner': {
        'unknown_choice': (
            ['--ros-args', '-p', 'shaper:=zigzag'],
            "parameter shaper is 'zigzag': expected one of two_step"),
        'nothing_to_estimate': (
            ['--ros-args', '-p', 'feedback_parameters:=[]'],
            'parameter feedback_parameters: free parameter missing: expected some of'),
        'feedback_of_a_beam_with_modes': (
            ['--ros-args', '-p', 'feedback:=adapt', '-p', 'law.name:=beam', '-p',
             'law.youngs_modulus:=1e6', '-p', 'law.width:=0.005', '-p',
             'actuator.half_thickness:=0.001', '-p', 'modes.frequency_ratio:=[6.2]', '-p',
             'modes.share:=[0.03]', '-p', 'modes.damping_ratio:=[0.1]'],
            'parameter feedback is adapt and actuator is a beam with modes.*: expected observe '
            'or off'),
        'limits_out_of_order': (
            ['--ros-args', '-p', 'flux_density_max:=-0.6'],
            'flux_density_min is -0.5 T: expected less than flux_density_max'),
    },
    'plant': {
        'two_clocks': (
            ['--ros-args', '-p', 'publish_clock:=true', '-p', 'use_sim_time:=true'],
            'publish_clock and use_sim_time are both true'),
        'no_rate': (
            ['--ros-args', '-p', 'publish_rate:=0.0'],
            'parameter publish_rate is 0.0: expected float, 0.001 to 1e+06 Hz'),
    },
}


@pytest.mark.parametrize(('node', 'name'), [
    (node, name) for node in NODES for name in (*BAD, *BAD_OF_A_NODE[node])])
def test_bad_arguments_refuse_the_start_in_one_line_with_status_2(
        ros_env, handlers, capfd, node, name):
    arguments, fragment = {**BAD, **BAD_OF_A_NODE[node]}[name]
    try:
        status = main([node, *arguments])
    except SystemExit as end:  # from the command line's own parser
        status = end.code
    out, err = capfd.readouterr()
    assert status == 2
    assert re.fullmatch(r'hmsa: error: .+\n', err)
    assert fragment in err
    assert out == ''


@pytest.mark.parametrize('words', [
    ['planner'], pytest.param(['send', '1.1:1'], marks=pytest.mark.slow)])
@pytest.mark.parametrize(('name', 'value', 'said'), [
    ('ROS_LOG_DIR', '/dev/null/log',
     r'ROS cannot write its log \(.*/dev/null/log.*\): set ROS_LOG_DIR .*'),
    ('ROS_DOMAIN_ID', 'abc', "ROS_DOMAIN_ID is 'abc': expected a whole number of 0 to 232"),
    ('ROS_DOMAIN_ID', '233', "ROS_DOMAIN_ID is '233': expected a whole number of 0 to 232")])
def test_an_environment_in_which_ros_cannot_start_is_named(start, words, name, value, said):
    # A process writes to one log.
    process = start.hmsa(*words, **{name: value})
    assert process.wait() == 2
    assert re.fullmatch(f'hmsa: error: {said}\n', process.stderr)


@pytest.mark.parametrize('node', NODES)
def test_process_that_refuses_to_start_says_why_and_has_no_traceback(start, node):
    arguments, fragment = BAD['missing_parameter_file']
    process = start.hmsa(node, *arguments)
    assert process.wait() == 2
    assert re.fullmatch(r'hmsa: error: .+\n', process.stderr)
    assert fragment in process.stderr


@pytest.mark.parametrize('number', [
    pytest.param(signal.SIGINT, id='SIGINT'),
    pytest.param(signal.SIGTERM, id='SIGTERM', marks=pytest.mark.slow)])
def test_signal_ends_planner_and_plant_at_work_with_status_0_and_no_word(ros, start, number):
    # At work: samples flow, and a plan is being sent.
    processes = [start.hmsa(node) for node in NODES]
    samples = ros.collect(topics.JOINT_STATES.type, topics.JOINT_STATES.name)
    commands = ros.collect(
        topics.FLUX_DENSITY_COMMAND.type, topics.FLUX_DENSITY_COMMAND.name)
    setpoints = ros.publisher(
        topics.JOINT_TRAJECTORY.type,
        topics.from_outside(topics.JOINT_TRAJECTORY.name, topics.PLANNER))
    ros.spin_until(
        lambda: ros.node.count_publishers(topics.FLUX_DENSITY_COMMAND.name), 'the planner')
    setpoints.publish(to_trajectory(
        [(1.1 + 0.1 * (k % 2), (k + 1) * SPELL) for k in range(1000)], 'actuator'))
    ros.spin_until(lambda: samples and commands, 'samples and commands')
    for process in processes:
        process.popen.send_signal(number)
    for process in processes:
        assert process.wait() == 0
        # A busy machine may make a command late, and a setpoint missed, or the plant later than
        # the request, which is said as a warning; of the end there is no word.
        told = (r'\[WARN].* (lead_time|late|replanned|was missed|start a plant|no sample)|'
                r'\[INFO].* no action ~/follow_joint_trajectory')
        assert all(re.match(told, x) for x in process.stderr.splitlines()), process.stderr


def test_a_collection_of_garbage_does_not_look_at_all_libraries_again(ros_env):
    code = """
import gc
from rclpy.node import Node
from hmsa_ros.nodes.managed import run
class Still(Node):
    @property
    def finished(self):
        print(len(gc.get_objects()), gc.get_freeze_count())
        return True
run(lambda: Still('still'), [])
"""
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True, timeout=60)
    looked_at, left_alone = map(int, done.stdout.split())
    assert looked_at < 0.01 * left_alone


# Runs hmsa, and prints each module that a node looks for in its loop.
LATE_IMPORTS = """
import sys
import threading
from hmsa.cli import main
from hmsa_ros.nodes import managed

class Told:
    def find_spec(self, name, *_):
        if threading.current_thread() is threading.main_thread():
            print('late import:', name)

def spin(*arguments, served=managed.spin):
    sys.meta_path.insert(0, Told())
    served(*arguments)

managed.spin = spin
sys.exit(main(sys.argv[1:]))
"""


def test_nodes_import_nothing_while_they_move_an_actuator_and_judge(ros, start):
    # No command is sent during an import, which takes 20 ms and more.
    controller = start.python(
        '-c', LATE_IMPORTS, 'controller', '--ros-args', '-p', 'feedback:=cautious',
        '-p', 'publish_rate:=1000.0', '-p', 'mismatch.shear_modulus:=0.95')
    markers = ros.collect(topics.MARKERS, topics.from_outside(topics.MARKERS.name, 'plant'))
    send = start.hmsa('send', '1.1:0.3', '1.2:0.3', '1.0:0.3', '--wait', '--timeout', '60')
    send.wait()
    assert 'accepted' in send.output
    ros.spin_until(lambda: markers, 'markers of the plant')
    assert controller.stop() == 0
    assert 'late import' not in controller.stdout


def test_a_planner_imports_what_new_settings_need_beside_its_loop(ros, start):
    points = [(1.0 + 0.1 * k, 0.03 * k) for k in range(-3, 5)]
    stretch, flux_density = (list(x) for x in zip(*points, strict=True))
    planner = start.python(
        '-c', LATE_IMPORTS, 'planner', '--ros-args', '-p', f'law.stretch:={stretch}',
        '-p', f'law.flux_density:={flux_density}')
    for name, value in (
            ('trajectory_mode', 'path'), ('feedback', 'observe'), ('law.name', 'table')):
        result, = ros.set_parameters('planner', [Parameter(name, value=value)])
        assert result.successful, result.reason
    ros.spin_until(lambda: ros.call(Trigger, 'planner/reset_estimate').success, 'feedback')
    assert planner.stop() == 0
    assert 'late import' not in planner.stdout


def test_a_planner_refuses_a_law_without_its_table_before_it_imports_anything(ros, start):
    planner = start.python('-c', LATE_IMPORTS, 'planner')
    result, = ros.set_parameters('planner', [Parameter('law.name', value='table')])
    assert 'has neither law.file nor points' in result.reason
    assert planner.stop() == 0
    assert 'late import' not in planner.stdout


@pytest.mark.slow
@pytest.mark.xdist_group('loops')
def test_loop_leaves_no_residual_vibration_beside_a_process_that_takes_a_core(
        ros, start):
    start.python('-c', 'while True: pass')
    start.hmsa(
        'plant', '--ros-args', '-p', 'publish_clock:=true', '-p', 'real_time_factor:=0.1',
        '-p', 'start_paused:=true')
    start.hmsa(
        'planner', '--ros-args', '-p', 'use_sim_time:=true', '-p', 'lead_time:=0.1')

    def collect(topic: topics.Topic, qos: QoSProfile | None = None) -> list[Any]:
        messages: list[Any] = ros.collect(
            topic.type, topics.from_outside(topic.name, 'planner'), qos or topic.qos)
        return messages

    samples = collect(topics.JOINT_STATES, QoSProfile(depth=100_000))
    statuses = collect(topics.STATUS)
    plans = collect(topics.PLAN)
    reports = collect(topics.DIAGNOSTICS)
    command = topics.FLUX_DENSITY_COMMAND.name
    ros.spin_until(
        lambda: ros.node.count_publishers(command) and ros.node.count_subscribers(command)
        and ros.node.count_publishers(topics.JOINT_STATES.name), 'both nodes')
    targets = (1.1, 1.2, 0.9, 1.4)
    request = to_trajectory(
        [(x, (k + 1) * SPELL) for k, x in enumerate(targets)], 'actuator', frame='a loop')
    trajectories = ros.publisher(
        topics.JOINT_TRAJECTORY.type, 'planner/joint_trajectory')

    def values(status: Any) -> dict[str, str]:
        return {x.key: x.value for x in status.values}

    # Until the planner has heard the time it refuses, and says so.
    ros.spin_until(lambda: statuses, 'the first status')
    while True:
        known = len(statuses)
        trajectories.publish(request)
        ros.spin_until(lambda known=known: len(statuses) > known, 'the verdict')
        if values(statuses[-1])['code'] != 'no_time':
            break
    assert values(statuses[-1])['code'] == 'accepted'
    ros.spin_until(lambda: plans, 'the plan')
    ros.call(SetBool, 'plant/set_paused', SetBool.Request(data=False))
    ros.spin_until(lambda: values(statuses[-1])['state'] == 'at_rest', 'rest')
    begin = from_time(plans[-1].header.stamp)
    end = begin + len(targets) * SPELL
    ros.spin_until(lambda: from_time(samples[-1].header.stamp) >= end, 'the end of the sequence')

    stamps = np.array([from_time(x.header.stamp) for x in samples])
    np.testing.assert_array_equal(np.diff(stamps), MS)
    stretches = [x.position[0] for x in samples]
    # Two levels a setpoint: the second one holds it, from arrival on.
    changes = [begin + from_time(x.time_from_start) for x in plans[-1].points]
    assert len(changes) == 2 * len(targets)
    previous = 1.0
    for target, arrival, until in zip(
            targets, changes[1::2], [*changes[2::2], end], strict=True):
        assert residual_vibration(
            stamps, stretches, arrival=arrival, end=until, step=target - previous
        ) <= NO_VIBRATION
        inside = (stamps >= arrival) & (stamps <= until)
        assert np.array(stretches)[inside] == pytest.approx(
            target, abs=NO_VIBRATION * abs(target - previous))
        previous = target

    def counts() -> dict[str, int]:
        return {
            status.name: int(values(status)['late']) for report in reports
            for status in report.status
            if 'late' in values(status) and values(status).get('sent', '') != '0'}

    ros.spin_until(lambda: len(counts()) == 2, 'diagnostics of both')
    assert set(counts().values()) == {0}
