"""A recorded run, simulated from the bag, and played to a second plant."""

from dataclasses import replace
import json
import math
import re
import time

from mcap.opcode import Opcode
from mcap_bytes import pieces
import pytest
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState, MagneticField
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

import hmsa
from hmsa.bag.definitions import message_definition
from hmsa.bag.reader import read_messages
from hmsa.bag.writer import BagTopic, BagWriter
from hmsa.cli import main
from hmsa.errors import BadInputError, MissingWarning
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation
from hmsa.model.units import NANOSECONDS
from hmsa.runs.verify import verify
from hmsa_ros.nodes.conversions import from_time, to_command

SAME = 1e-9
BEGIN = 1_000_000_000


def samples(bag):
    """Return the recorded stretch by timestamp."""
    return {item.message.header.stamp.sec * 10**9 + item.message.header.stamp.nanosec:
            item.message.position[0]
            for item in read_messages(bag, ['/joint_states'])}


@pytest.fixture
def recorded_run(start, ros, tmp_path):
    """Return the bag of a plant that followed five commands."""
    bag = tmp_path / 'run'
    start.hmsa('plant', '--ros-args', '-p', 'initial_stretch:=1.05')
    recorder = start.hmsa(
        'recorder', '--ros-args', '-p', f'storage.uri:={bag}', '-p',
        'record.topics:=[joint_states, flux_density_command]')
    publisher = ros.publisher(MagneticField, 'flux_density_command', QoSProfile(depth=100), 2)
    recorder.wait_for_output('ready: subscribed to all 2 topics')
    ros.spin_until(lambda: 'plant.actuator.remanence' in (bag / 'metadata.yaml').read_text(),
                   "the plant's parameters in the bag")
    # So far ahead that a busy machine holds none up until it is late, here and when it is played.
    begin = time.time_ns() + 2_000_000_000
    for i, flux_density in enumerate((0.010, 0.012, 0.008, 0.011, 0.0)):
        publisher.publish(to_command(begin + i * 20_000_000, flux_density, 'coil'))
    ros.spin_until(lambda: time.time_ns() > begin + 200_000_000, 'the end of the motion')
    assert recorder.stop() == 0, recorder.output
    return bag


@pytest.mark.slow
@pytest.mark.ros
def test_a_recorded_run_comes_out_again(recorded_run, start, tmp_path):
    result, = verify(recorded_run)
    assert result.command_count == 5
    assert result.late_count == 0
    assert result.sample_count > 200
    stretches = samples(recorded_run).values()
    assert max(stretches) - min(stretches) > 1e-3
    assert result.largest_difference < SAME

    process = start.hmsa('bag', 'verify', recorded_run, '--json')
    assert process.wait() == 0, process.output
    report = json.loads(process.stdout)
    assert report['passed']
    assert report['actuators'][0]['sample_count'] == result.sample_count
    # Another actuator would have moved otherwise.
    metadata = (recorded_run / 'metadata.yaml').read_text()
    (recorded_run / 'metadata.yaml').write_text(re.sub(
        r"(plant.actuator.density: )'([\d.e+]+)'", r"\1'900.0'", metadata))
    process = start.hmsa('bag', 'verify', recorded_run)
    assert process.wait() == 1, process.output
    assert 'largest difference of the stretch' in process.stdout


@pytest.mark.slow
@pytest.mark.ros
def test_a_second_plant_moves_the_same_when_the_bag_is_played(
        recorded_run, start, ros, tmp_path):
    plant = start.hmsa('plant', '--ros-args', '-p', 'use_sim_time:=true', '-p',
                       'initial_stretch:=1.05', '-r', '__ns:=/again')
    again = tmp_path / 'again'
    recorder = start.hmsa(
        'recorder', '--ros-args', '-p', f'storage.uri:={again}', '-p', 'use_sim_time:=true',
        '-p', 'record.topics:=[/again/joint_states]')
    player = start.hmsa(
        'player', '--ros-args', '-p', f'storage.uri:={recorded_run}', '-p',
        'play.topics_to_filter:=[/flux_density_command]', '-p',
        'play.wait_for_subscribers:=[/flux_density_command]', '-p',
        'play.clock_publish_frequency:=1000.0', '-p', 'play.start_paused:=true',
        '-r', '/flux_density_command:=/again/flux_density_command')
    recorder.wait_for_output('ready: subscribed to all 1 topics')
    seen = ros.collect(JointState, '/again/joint_states')
    ros.call(Trigger, 'player/resume')
    assert player.wait() == 0, player.output
    first = samples(recorded_run)
    # The plant may be behind on a busy machine; at its end the motion is long over.
    ros.spin_until(
        lambda: seen and from_time(seen[-1].header.stamp) > max(first) - 100_000_000,
        'the end of the motion')
    assert recorder.stop() == 0, recorder.output
    result, = verify(recorded_run)
    # None of its own commands was late.
    assert result.largest_difference < SAME
    second = {
        item.message.header.stamp.sec * 10**9 + item.message.header.stamp.nanosec:
        item.message.position[0] for item in read_messages(again, ['/again/joint_states'])}
    common = sorted(first.keys() & second.keys())
    assert len(common) > 200
    assert max(abs(first[stamp] - second[stamp]) for stamp in common) < SAME, plant.output
    moved = [first[stamp] for stamp in common]
    assert max(moved) - min(moved) > 1e-3


def write_joints(
        folder, densities, *, told=None, space='', lost=None, strange=(), close=True,
        **options):
    """
    Write a run of several joints of one plant with different densities.

    ``strange`` contains further messages: nanoseconds from the begin, topic, payload. Without
    ``close``, the bag stays as a killed recorder leaves it.
    """
    actuators = {joint: replace(paper_actuator(), density=density)
                 for joint, density in densities.items()}
    told = told or densities
    custom_data = {f'{space}/plant.use_sim_time': 'false', f'{space}/plant.slew_limit': '0.0'} | {
        f'{space}/plant.actuator.{name}': json.dumps(value)
        for name, value in paper_actuator().numbers.items()} | {
        f'{space}/plant.{joint}.actuator.density': json.dumps(density)
        for joint, density in told.items()} | {f'{space}/plant.one.slew_limit': 'null'} | (
        {'lost': json.dumps(lost)} if lost else {})
    simulations = {joint: ActuatorSimulation(actuator, time=BEGIN)
                   for joint, actuator in actuators.items()}
    with BagWriter(folder, custom_data=custom_data, **options) as writer:
        def topic(name, kind):
            encoding, text = message_definition(kind)
            return writer.add_topic(BagTopic(f'{space}/{name}', kind, text, encoding))

        states = topic('joint_states', 'sensor_msgs/msg/JointState')
        for i, (joint, simulation) in enumerate(simulations.items()):
            stamp = BEGIN + 10_000_000 * (i + 1)
            simulation.command(stamp, 0.01)
            writer.write([(
                topic(f'{joint}/flux_density_command', 'sensor_msgs/msg/MagneticField'),
                BEGIN + 1, 0, 0, serialize_message(to_command(stamp, 0.01, 'coil')))])
        for k in range(200):
            time = BEGIN + k * 1_000_000
            message = JointState(name=list(simulations))
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(time, 10**9)
            for simulation in simulations.values():
                simulation.advance(time)
                message.position.append(simulation.stretch)
                message.velocity.append(simulation.rate)
                message.effort.append(simulation.flux_density)
            writer.write([(states, time, 0, k, serialize_message(message))])
        for after, name, payload in strange:
            number = states if name == 'joint_states' else topic(
                name, 'sensor_msgs/msg/MagneticField')
            writer.write([(number, BEGIN + after, 0, 0, payload)])
        if not close:
            writer.flush()
            writer.abort()
    return folder


def sample(stretch=1.0, *, seconds=0, joint='one', effort=0.0):
    """Return a sample of a joint as a payload, with a timestamp in s from the begin."""
    message = JointState(name=[joint], position=[stretch], velocity=[0.0], effort=[effort])
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(
        BEGIN + int(seconds * 10**9), 10**9)
    return serialize_message(message)


def test_several_joints_of_several_namespaces_are_told_apart(tmp_path):
    results = verify(write_joints(
        tmp_path / 'a', {'one': 900.0, 'two': 2000.0}, space='/left'))
    assert [result.commands for result in results] == [
        '/left/one/flux_density_command', '/left/two/flux_density_command']
    assert all(result.largest_difference < SAME for result in results)
    assert [result.sample_count for result in results] == [200, 200]
    # Swapped, they would not fit.
    results = verify(write_joints(
        tmp_path / 'b', {'one': 900.0, 'two': 2000.0}, told={'one': 2000.0, 'two': 900.0}))
    assert all(result.largest_difference > 1e-4 for result in results)


def test_lost_commands_are_named_beside_the_difference(tmp_path):
    with pytest.warns(MissingWarning, match='its recorder lost 7 of /joint_states, 3 of /one'):
        one, two = verify(write_joints(tmp_path / 'a', {'one': 900.0, 'two': 2000.0}, lost={
            '/joint_states': 7, '/one/flux_density_command': 3, '/two/flux_density_command': 0}))
    assert one.note == ('the recorder lost messages, 3 of /one/flux_density_command: expected '
                        'differences from there on')
    assert two.note == ''


@pytest.mark.parametrize(('modulus', 'words'), [
    (10000.0, 'expected differences of that size, from the first sample on'),
    (8000.0, 'expected at most 0.00011 from that; the rest is from parameters or commands other '
             'than the real ones')])
def test_errors_of_the_sensor_are_no_reason_for_larger_differences(
        tmp_path, capsys, modulus, words):
    bag = write_joints(tmp_path / 'a', {'one': 1900.0})
    file = tmp_path / 'it.yaml'
    file.write_text('/**: {ros__parameters: {stretch_bias: 5.7e-05, '
                    f'actuator.shear_modulus: {modulus}, actuator.density: 1900.0}}}}')
    main(['bag', 'verify', str(bag), '--params-file', str(file)])
    assert f'measured with stretch_bias 5.7e-05: {words}\n' in capsys.readouterr().out


def test_every_reader_says_what_is_missing_from_a_damaged_bag(tmp_path, capsys):
    folder = write_joints(tmp_path / 'a', {'one': 900.0}, chunk_size=4_000)
    path = folder / 'a_0.mcap'
    data = bytearray(path.read_bytes())
    places = [x for code, x, _ in pieces(bytes(data)) if code == Opcode.CHUNK]
    data[places[len(places) // 2] + 200] ^= 1
    path.write_bytes(data)
    said = re.compile(
        r'/a: (\d+) of 201 messages cannot be read; a has no samples for (0\.\d+) s from')
    with pytest.warns(hmsa.MissingWarning) as found:
        motion = hmsa.read(folder)
    count, gap = said.search(str(found[0].message)).groups()
    assert len(motion.times) == 200 - int(count)
    assert float(gap) == pytest.approx((int(count) + 1) * 1e-3)
    for command, status in (
            (['export', folder, '--out', tmp_path / 'a.csv'], 0),
            (['compare', folder, folder], 0), (['identify', folder], 0),
            (['report', folder, '--out', tmp_path / 'a.html'], 0), (['bag', 'verify', folder], 1)):
        assert main([*map(str, command)]) == status
        shown = capsys.readouterr().err
        assert said.search(shown), (command, shown)
        assert shown.count('cannot be read') == 1, (command, shown)
    assert f'{count} of 201 messages cannot be read' in (tmp_path / 'a.html').read_text()
    # So is a bag whose recorder was killed.
    write_joints(tmp_path / 'b', {'one': 900.0}, close=False)
    assert main(['export', str(tmp_path / 'b'), '--out', str(tmp_path / 'b.csv')]) == 0
    assert 'the last messages may be missing' in capsys.readouterr().err


def test_messages_of_something_else_are_left_out_and_counted(tmp_path):
    not_along_z = to_command(BEGIN + 100, 0.1, 'coil')
    not_along_z.magnetic_field.x = 1.0
    strange = [
        (50, 'joint_states', sample()[:-5]),
        (51, 'joint_states', sample(joint='somebody')),
        (52, 'joint_states', sample(seconds=2 * 10**8)),
        (53, 'joint_states', sample(seconds=-10**9)),
        (0, 'one/flux_density_command', serialize_message(to_command(0, math.nan, ''))),
        (0, 'one/flux_density_command', serialize_message(to_command(BEGIN + 9, 1e300, ''))),
        (90, 'one/flux_density_command', serialize_message(not_along_z)),
        (91, 'one/flux_density_command', serialize_message(to_command(0, -1e300, '')))]
    found, = verify(write_joints(tmp_path / 'a', {'one': 900.0}, strange=strange))
    assert found.largest_difference < SAME
    assert (found.sample_count, found.left_out) == (200, len(strange))
    assert found.note.startswith(f'left out: {len(strange)} of the messages, since ')
    # What may be a sample of the joint is held against the motion.
    found, = verify(write_joints(
        tmp_path / 'b', {'one': 900.0},
        strange=[(50, 'joint_states', sample(1.5, seconds=0.0005))]))
    assert (found.largest_difference, found.left_out) == (pytest.approx(0.5), 0)


def test_a_first_sample_of_another_time_is_left_out(tmp_path):
    found, = verify(write_joints(
        tmp_path / 'a', {'one': 900.0}, strange=[(-1, 'joint_states', sample(seconds=10**5))]))
    assert (found.sample_count, found.left_out) == (200, 1)
    assert found.largest_difference < SAME


def test_several_rounds_in_one_bag_are_refused_with_a_way_out(tmp_path):
    encoding, text = message_definition('sensor_msgs/msg/JointState')
    with BagWriter(tmp_path / 'bag', custom_data={'time_jumps': '1'}) as writer:
        states = writer.add_topic(
            BagTopic('/joint_states', 'sensor_msgs/msg/JointState', text, encoding))
        for _ in range(2):
            writer.write([(states, BEGIN, 0, 0, sample())])
            writer.split()
    with pytest.raises(BadInputError, match=r'time jumped back 1 times: .* name one of its files'):
        verify(tmp_path / 'bag')


def test_topics_that_are_no_run_are_refused(tmp_path):
    encoding, text = message_definition('std_msgs/msg/Float64')
    with BagWriter(tmp_path / 'bag') as writer:
        for name in ('/joint_states', '/flux_density_command'):
            number = writer.add_topic(BagTopic(name, 'std_msgs/msg/Float64', text, encoding))
            writer.write([(number, 1, 1, 1, serialize_message(Float64(data=1.0)))])
    with pytest.raises(BadInputError, match='has no topic .../joint_states'):
        verify(tmp_path / 'bag')


def test_a_bag_without_a_run_is_refused(tmp_path):
    BagWriter(tmp_path / 'bag').close()
    with pytest.raises(BadInputError, match='has no topic'):
        verify(tmp_path / 'bag')


@pytest.mark.slow
@pytest.mark.ros
def test_late_commands_a_slow_coil_creep_and_the_watchdog_come_out_again(start, ros, tmp_path):
    bag = tmp_path / 'run'
    start.hmsa(
        'plant', '--ros-args', '-p', 'mismatch.density:=1.1', '-p', 'coil_time_constant:=0.002',
        '-p', 'viscoelastic.ratio:=[0.1, 0.2]', '-p', 'viscoelastic.time:=[0.005, 0.05]',
        '-p', 'slew_limit:=20.0', '-p', 'command_timeout:=0.1', '-p', 'safe_flux:=ramp', '-p',
        'safe_ramp_rate:=0.1', '-p', 'lateness_limit:=100.0')
    recorder = start.hmsa(
        'recorder', '--ros-args', '-p', f'storage.uri:={bag}', '-p',
        'record.topics:=[joint_states, flux_density_command, flux_density_applied]')
    publisher = ros.publisher(MagneticField, 'flux_density_command', QoSProfile(depth=100), 2)
    recorder.wait_for_output('ready: subscribed to all 3 topics')
    ros.spin_until(lambda: 'plant.mismatch.density' in (bag / 'metadata.yaml').read_text(),
                   "the plant's parameters in the bag")
    applied = ros.collect(MagneticField, 'flux_density_applied')
    for flux_density in (0.01, 0.02):
        # A minute late, by the same clock.
        late = ros.node.get_clock().now().nanoseconds - 60 * NANOSECONDS
        publisher.publish(to_command(late, flux_density, ''))
        ros.spin_until(
            lambda flux_density=flux_density: applied
            and applied[-1].magnetic_field.z == flux_density, 'the level')
    ros.spin_until(lambda: applied[-1].magnetic_field.z == 0.0, 'the end of the ramp')
    assert recorder.stop() == 0, recorder.output
    result, = verify(bag)
    assert (result.command_count, result.late_count, result.note) == (2, 2, '')
    assert result.largest_difference < SAME
    stretches = samples(bag).values()
    assert max(stretches) - min(stretches) > 1e-3
