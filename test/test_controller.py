"""Planner and plant in one process: the same interface, and no middleware between them."""

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest
from std_msgs.msg import Float64

from hmsa.interfaces import topics
from hmsa.interfaces.diagnostics import texts
from hmsa_ros.nodes import conversions
from hmsa_ros.nodes.controller import Cycles

MS = 1_000_000
# In slow motion, so that a busy machine is no matter; commands come just in time.
PARAMETERS = """\
/**:
  ros__parameters:
    actuator.shear_modulus: 10000.0
/**/planner:
  ros__parameters:
    use_sim_time: true
    lead_time: 0.002
/**/plant:
  ros__parameters:
    publish_clock: true
    real_time_factor: 0.2
    mismatch.shear_modulus: {mismatch}
"""


def test_cycles_that_begin_late_are_counted_and_the_work_is_measured():
    now, used = 0, 0
    cycles = Cycles(MS, steady=lambda: now, cpu=lambda: used)
    for begin, work in ((0, 10_000), (1.2, 10_000), (2.0, 10_000), (4.5, 90_000), (5, 10_000)):
        now = round(begin * MS)
        with cycles:
            used += work
        used += 3 * work
        cycles.note_rest()
    severity, message, values = cycles.report()
    assert (severity, message) == (1, '1 of 5 cycles late')
    assert values['largest_lateness_ms'] == '1.500'
    assert (values['work_p50_us'], values['work_largest_us']) == ('10.0', '90.0')
    assert (values['rest_p50_us'], values['rest_largest_us']) == ('30.0', '270.0')
    assert cycles.report()[:2] == (0, 'cycles in time')


def messages(bag, topic):
    """Return (log time, message), read with the mcap package."""
    file, = bag.glob('*.mcap')
    with file.open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [(x.log_time, found) for _, _, x, found in reader.iter_decoded_messages([topic])]


@pytest.mark.ros
def test_a_sequence_arrives_commanded_a_few_cycles_ahead_and_the_bag_shows_it(
        start, ros, tmp_path):
    file = tmp_path / 'own.yaml'
    file.write_text(PARAMETERS.format(mismatch=1.0))
    controller = start.hmsa('controller', '--ros-args', '--params-file', str(file))
    # On a busy machine its start takes a while.
    ros.spin_until(lambda: ros.node.count_publishers('planner/plan'), 'the planner', 300.0)
    recorder = start.hmsa(
        'recorder', '--ros-args', '-p', f'storage.uri:={tmp_path / "bag"}',
        '-p', 'record.all_topics:=true')
    for topic in ('/planner/plan', '/joint_states', '/flux_density_command'):
        recorder.wait_for_output(topic)
    send = start.hmsa('send', '1.1:0.1', '1.3:0.2', '--wait')
    assert send.wait(60.0) == 0, send.output
    assert 'done: at_rest, measured' in send.stdout
    assert recorder.stop() == 0, recorder.output
    assert controller.stop() == 0, controller.output

    samples = messages(tmp_path / 'bag', '/joint_states')
    stretch = np.array([x.position[0] for _, x in samples])
    assert abs(stretch[-1] - 1.3) < 1e-6
    assert np.ptp(stretch[-100:]) < 1e-6
    # What was commanded took effect at its stamp, once, although it is heard of in both ways.
    commands, applied = ([
        (conversions.from_time(x.header.stamp), x.magnetic_field.z)
        for _, x in messages(tmp_path / 'bag', topic)]
        for topic in ('/flux_density_command', '/flux_density_applied'))
    changes = [x for k, x in enumerate(commands) if not k or x[1] != commands[k - 1][1]]
    assert applied[-4:] == changes
    assert len(changes) == 4


@pytest.mark.slow
@pytest.mark.ros
def test_a_plant_that_is_not_as_planned_fails_and_commands_of_others_are_obeyed(
        start, ros, tmp_path):
    file = tmp_path / 'own.yaml'
    file.write_text(PARAMETERS.format(mismatch=1.1))
    diagnostics = ros.collect(topics.DIAGNOSTICS, '/diagnostics')
    applied = ros.collect(topics.FLUX_DENSITY_APPLIED, 'flux_density_applied')
    start.hmsa('controller', '--ros-args', '--params-file', str(file))
    send = start.hmsa('send', '1.4:0.3', '--wait')
    assert send.wait(60.0) == 1, send.output
    assert 'short of 1.4 and rings at' in send.stderr

    def newest(name):
        return next(({y.key: y.value for y in x.values} for message in reversed(diagnostics)
                     for x in message.status if x.name == name), {})

    # Each command once: what comes over the middleware from its own planner is passed over.
    diagnostics.clear()
    ros.spin_until(
        lambda: all(map(newest, ('plant: commands', 'planner: commands', 'controller: loop'))),
        'the counters')
    sent = newest('planner: commands')
    received = int(newest('plant: commands')['received'])
    assert abs(received - int(sent['sent']) - int(sent['heartbeats'])) <= 10
    assert int(newest('controller: loop')['cycles']) > 0
    topic = topics.FLUX_DENSITY_COMMAND
    ros.publisher(topic.type, 'flux_density_command', topic.qos).publish(
        conversions.to_command(0, -0.0125, ''))
    ros.spin_until(
        lambda: any(x.magnetic_field.z == -0.0125 for x in applied), 'the command of ours')


@pytest.mark.slow
@pytest.mark.ros
def test_a_plant_that_is_taken_away_is_missed_and_comes_back(start, ros):
    statuses = ros.collect(topics.STATUS, 'planner/status')
    start.hmsa('controller', '--ros-args', '-p', 'lead_time:=0.5')
    setpoint = ros.publisher(topics.SETPOINT, 'planner/setpoint')

    assert ros.change('plant', 'deactivate', 'cleanup')
    setpoint.publish(Float64(data=1.1))
    ros.spin_until(
        lambda: statuses and 'not active' in statuses[-1].message, 'that nobody carries it out')
    assert ros.change('plant', 'configure', 'activate')
    ros.spin_until(lambda: 'not active' not in statuses[-1].message, 'the plant')
    setpoint.publish(Float64(data=1.2))
    ros.spin_until(
        lambda: texts(statuses[-1]).get('worst') in ('arrived', 'off_target', 'vibrating'),
        'a verdict on what is measured')
