"""Planner and plant as processes, with G of the plant 20 % higher."""

from dataclasses import replace
import math

from extras import needs
import numpy as np
import pytest
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
import yaml

from benchmarks.bench_feedback import GRAPHS, judge, run
from hmsa.interfaces import topics

pytestmark = pytest.mark.ros
# On a busy machine the start of the nodes takes a while.
RUN_SECONDS = 300.0
PLANT = ('--ros-args', '-p', 'mismatch.shear_modulus:=1.2', '-p', 'stretch_noise:=0.0005')


def begin(start, ros, mode, *more):
    """Start both and wait for them; return a function of the newest message and its values."""
    statuses = ros.collect(topics.STATUS, 'planner/status')
    samples = ros.collect(topics.JOINT_STATES, 'joint_states')
    # In slow motion, with commands far enough ahead for a busy machine.
    start.hmsa('plant', *PLANT, '-p', 'publish_clock:=true', '-p', 'real_time_factor:=0.15')
    start.hmsa(
        'planner', '--ros-args', '-p', f'feedback:={mode}', '-p', 'use_sim_time:=true', '-p',
        'lead_time:=0.3', *more)
    ros.spin_until(lambda: statuses and samples, 'planner and plant', RUN_SECONDS)
    found = ros.collect(topics.ESTIMATE, 'planner/estimate')

    def read():
        if not found:
            return '', {}
        status, = found[-1].status
        return status.message, {x.key: x.value for x in status.values}
    return read


@pytest.mark.slow
def test_a_planner_that_observes_says_what_is_wrong_with_the_actuator(start, ros):
    estimate = begin(start, ros, 'observe')
    send = start.hmsa('send', '1.4:2', '--wait')
    assert send.wait(RUN_SECONDS) == 1, send.output
    assert '%) short of 1.4 and rings at' in send.output
    ros.spin_until(lambda: 'G about +20 %' in estimate()[0], 'the estimate')
    message, values = estimate()
    assert 'rests 18 % short' in message
    assert 'feedback: adapt corrects it' in message
    assert float(values['shear_modulus']) == pytest.approx(1.2e4, rel=0.01)
    assert float(values['shear_modulus.nominal']) == 1e4
    assert (values['used_by_plans'], values['corrections']) == ('False', '0')


@pytest.mark.slow
def test_a_planner_that_adapts_arrives_with_the_second_move_and_saves_what_it_learnt(
        start, ros, tmp_path):
    file = tmp_path / 'learnt.yaml'
    estimate = begin(start, ros, 'adapt', '-p', f'feedback_file:={file}')
    assert start.hmsa('send', '1.4:2', '--wait').wait(RUN_SECONDS) in (0, 1)
    ros.spin_until(lambda: int(estimate()[1].get('corrections', 0)), 'a correction')
    assert 'plans use it' in estimate()[0]
    second = start.hmsa('send', '1.1:2', '--wait')
    assert second.wait(RUN_SECONDS) == 0, second.output
    assert 'measured' in second.output
    answer = ros.call(Trigger, 'planner/save_estimate')
    assert answer.success, answer.message
    saved = yaml.safe_load(file.read_text())['/**']['ros__parameters']
    assert saved['actuator.shear_modulus'] == pytest.approx(1.2e4, rel=5e-3)
    assert ros.call(Trigger, 'planner/reset_estimate').success
    result, = ros.set_parameters('planner', [Parameter('feedback', value='off')])
    assert result.successful
    answer = ros.call(Trigger, 'planner/save_estimate')
    assert not answer.success
    assert 'feedback is off' in answer.message


def test_moves_in_a_bag_are_judged_from_samples_and_levels_alone():
    time = np.arange(0.0, 2.0, 1e-3)
    # It rings at 50 Hz by 0.01 about 1.39.
    omega = 100.0 * math.pi
    samples = np.column_stack([
        time, 1.391 + 0.005 * np.sin(omega * time), 0.005 * omega * np.cos(omega * time)])
    levels = np.array([(1.1, 0.001), (1.25, 0.03), (1.256, 0.05)])
    requests, late = np.array([(1.0, 1.4), (1.9, 1.0)]), np.array([(0.5, 2.0), (1.5, 5.0)])
    found, = judge(dict(zip(
        ('/joint_states', '/flux_density_applied', '/planner/setpoint', '/planner/status'),
        (samples, levels, requests, late), strict=True)), 0.02)
    assert found.vibration == pytest.approx(0.01 / 0.4, rel=0.03)
    assert found.offset == pytest.approx(-0.01 / 0.4, rel=0.03)
    assert (found.target, found.late) == (1.4, 3)


@pytest.mark.slow
def test_from_a_bag_the_move_after_a_correction_rests_where_open_loop_misses(
        ros_domain_id, tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', str(ros_domain_id))
    # In slow motion, with commands far enough ahead for a busy machine.
    needs('rosbags')
    found = run(replace(GRAPHS[1], lead=0.3, hold=1.2, factor=0.15), 0.2, tmp_path, 1)
    first, second = found['off']
    assert first.offset == pytest.approx(-0.18, abs=0.01)
    assert second.vibration > 0.1
    first, second = found['adapt']
    assert abs(first.offset) < 0.01
    assert max(second.vibration, abs(second.offset)) < 0.01
