"""The player as a process, with subscribers in this one, over DDS."""

import itertools
import signal
import time

from extras import needs
from mcap.writer import Writer
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, MagneticField
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from hmsa.bag.definitions import message_definition, type_hash
from hmsa.bag.info import summarize
from hmsa.bag.playback import PlaybackClock
from hmsa.bag.qos import Qos
from hmsa.bag.writer import BagTopic, BagWriter
from hmsa.cli import main
from hmsa.interfaces import topics
from hmsa_ros.clients.launching import REPLAY

pytestmark = pytest.mark.ros
FLOAT = 'std_msgs/msg/Float64'
FIELD = 'sensor_msgs/msg/MagneticField'
START = 1_700_000_000 * 10**9
MS = 10**6
RELIABLE = (Qos(),)


def write_bag(folder, entries, profiles=RELIABLE):
    """Write (topic, milliseconds, value) entries; topics with 'command' contain fields."""
    with BagWriter(folder) as writer:
        numbers = {}
        for i, (name, milliseconds, value) in enumerate(entries):
            if name not in numbers:
                type_name = FIELD if 'command' in name else FLOAT
                encoding, text = message_definition(type_name)
                numbers[name] = writer.add_topic(BagTopic(
                    name, type_name, text, encoding, profiles, type_hash(type_name)))
            if 'command' in name:
                message = MagneticField()
                message.magnetic_field.z = value
            else:
                message = Float64(data=float(value))
            writer.write([(numbers[name], START + round(milliseconds * MS), 1, i,
                           serialize_message(message))])
    return folder


@pytest.fixture
def play(start):
    def play(bag, *parameters):
        arguments = [f'storage.uri:={bag}', *parameters]
        return start.hmsa('player', '--ros-args', *(
            part for argument in arguments
            for part in ('-r' if argument.startswith('__') else '-p', argument)))
    return play


def finish(ros, process, messages, count):
    ros.spin_until(lambda: len(messages) >= count, f'{count} messages')
    assert process.wait() == 0, process.output
    assert 'Traceback' not in process.output


def test_every_message_is_sent_in_order_and_the_process_ends(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', i, i) for i in range(500)])
    got = ros.collect(Float64, '/a')
    process = play(bag)
    finish(ros, process, got, 500)
    assert [message.data for message in got] == list(range(500))
    assert '500 messages sent' in process.stdout


def test_messages_of_equal_stamp_keep_their_order_over_topics(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [
        ('/a' if i % 3 else '/b', i // 100, i) for i in range(600)])
    got = []
    for topic in ('/a', '/b'):
        ros.node.create_subscription(
            Float64, topic, lambda message, topic=topic: got.append((topic, message.data)), 1000)
    process = play(bag, 'play.rate:=10.0')
    finish(ros, process, got, 600)
    for topic in ('/a', '/b'):
        assert [value for name, value in got if name == topic] == [
            i for i in range(600) if (i % 3 != 0) == (topic == '/a')]


@pytest.mark.slow
def test_commands_are_only_sent_if_asked_for_by_name(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [
        entry for i in range(20)
        for entry in (('/left/flux_density_command', i, 0.5), ('/a', i, i))])
    commands = ros.collect(MagneticField, '/left/flux_density_command')
    got = ros.collect(Float64, '/a')
    process = play(bag)
    finish(ros, process, got, 20)
    assert not commands
    assert 'it carries commands; name it in play.topics_to_filter' in process.output
    process = play(bag, 'play.regex_to_filter:=.*')
    finish(ros, process, got, 40)
    assert not commands
    process = play(bag, 'play.topics_to_filter:=[/left/flux_density_command]')
    finish(ros, process, commands, 20)
    assert {message.magnetic_field.z for message in commands} == {0.5}
    process = play(bag, 'play.topics_to_filter:=[/left/flux_density_command]',
                   'play.regex_to_filter:=.*')
    finish(ros, process, commands, 40)
    ros.spin_until(lambda: len(got) == 60, 'the other topic')


def test_a_topic_remapped_to_a_command_is_a_command(ros, start, tmp_path):
    bag = write_bag(tmp_path / 'bag', [
        entry for i in range(20) for entry in (('/a', i, i), ('/b', i, i))])
    commands = ros.collect(Float64, '/planner/setpoint')
    got = ros.collect(Float64, '/b')
    process = start.hmsa('player', '--ros-args', '-p', f'storage.uri:={bag}',
                         '-r', '/a:=/planner/setpoint')
    finish(ros, process, got, 20)
    assert not commands
    assert 'topic /a is left out: it carries commands' in process.output


def test_the_clock_runs_before_and_with_the_messages(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', i, i) for i in range(100)])
    events = []
    ros.node.create_subscription(
        Clock, '/clock', lambda message: events.append(
            message.clock.sec * 10**9 + message.clock.nanosec),
        QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT))
    got = ros.collect(Float64, '/a')
    process = play(bag, 'play.clock_publish_frequency:=1000.0', 'play.start_paused:=true')
    ros.spin_until(lambda: events, 'the first /clock')
    assert set(events) == {START}
    assert not got
    assert ros.call(Trigger, 'player/resume').success
    finish(ros, process, got, 100)
    ros.spin_until(lambda: events[-1] == START + 99 * MS, 'the last /clock')
    assert events == sorted(events)
    assert len(set(events)) >= 99


def test_the_clock_can_go_with_each_message(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', 3 * i, i) for i in range(50)])
    times = []
    ros.node.create_subscription(
        Clock, '/clock', lambda message: times.append(
            message.clock.sec * 10**9 + message.clock.nanosec),
        QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT))
    got = ros.collect(Float64, '/a')
    process = play(bag, 'play.clock_publish_on_topic_publish:=true')
    finish(ros, process, got, 50)
    ros.spin_until(lambda: times[-1] == START + 147 * MS, 'the last time')
    assert [key for key, _ in itertools.groupby(times)] == [
        START + 3 * i * MS for i in range(50)]


def test_pause_next_resume_and_stop(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', 200 * i, i) for i in range(1000)])
    got = ros.collect(Float64, '/a')
    process = play(bag, 'play.start_paused:=true')
    assert ros.call(Trigger, 'player/is_paused').success
    for i in range(3):
        assert ros.call(Trigger, 'player/play_next').success
        ros.spin_until(lambda i=i: len(got) == i + 1, f'message {i}')
    assert ros.call(Trigger, 'player/toggle_paused').message == 'playing'
    ros.spin_until(lambda: len(got) > 4, 'messages after resuming')
    assert not ros.call(Trigger, 'player/play_next').success
    assert ros.call(Trigger, 'player/pause').message == 'paused'
    assert ros.call(Trigger, 'player/stop').success
    assert process.wait() == 0, process.output
    assert [message.data for message in got] == list(range(len(got)))


def test_a_step_that_was_not_possible_is_not_made_later():
    transport = PlaybackClock(7, 1.0)
    assert not transport.step(0.01)
    assert transport.wait(8, message=True, timeout=0.01) == 7


def test_latched_messages_before_the_offset_are_sent_first(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/latched', i, i) for i in range(10)],
                    (Qos(durability='transient_local'),))
    got = ros.collect(Float64, '/latched', QoSProfile(
        depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    process = play(bag, 'play.start_offset.nsec:=7000000')
    finish(ros, process, got, 4)
    assert [message.data for message in got] == [6.0, 7.0, 8.0, 9.0]


def test_offset_and_duration_cut_out_a_piece(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', i, i) for i in range(100)])
    got = ros.collect(Float64, '/a')
    process = play(bag, 'play.start_offset.nsec:=20000000',
                   'play.playback_duration.sec:=0', 'play.playback_duration.nsec:=30000000')
    finish(ros, process, got, 31)
    assert [message.data for message in got] == list(range(20, 51))


def test_a_loop_begins_again_until_it_is_stopped(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', i, i) for i in range(10)])
    got = ros.collect(Float64, '/a')
    process = play(bag, 'play.loop:=true')
    ros.spin_until(lambda: len(got) > 35, 'the fourth round')
    assert process.stop(signal.SIGINT) == 0, process.output
    assert [message.data for message in got[:30]] == [*range(10)] * 3


def test_rate_and_position_change_while_playing(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', 1000 * i, i) for i in range(1000)])
    got = ros.collect(Float64, '/a')
    process = play(bag)
    ros.spin_until(lambda: got, 'the first message')
    results = ros.set_parameters('player', [
        Parameter('play.rate', value=500.0), Parameter('play.seek', value=900.0)])
    assert all(result.successful for result in results)
    # How many were sent before is not known.
    ros.spin_until(lambda: got[-1].data == 999.0, 'the last message')
    finish(ros, process, got, 101)
    values = [message.data for message in got]
    assert values[-100:] == list(range(900, 1000))
    assert len(values) < 200


def test_a_rate_or_a_position_out_of_range_is_refused(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', 1000 * i, i) for i in range(1000)])
    process = play(bag)
    result, = ros.set_parameters('player', [Parameter('play.rate', value=-1.0)])
    assert not result.successful
    result, = ros.set_parameters('player', [Parameter('play.seek', value=1000.0)])
    assert not result.successful
    assert 'expected at most 999 s, where playing ends' in result.reason
    assert process.stop() == 0


def test_it_plays_while_it_is_active(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', 10 * i, i) for i in range(10_000)])
    got = ros.collect(Float64, '/a')
    process = play(bag, 'autostart:=false')

    assert ros.change('player', 'configure')
    ros.spin_until(lambda: ros.node.count_publishers('/a'), 'the publisher')
    for name in ('resume', 'play_next'):
        answer = ros.call(Trigger, f'player/{name}')
        assert not answer.success
        assert answer.message == 'the player is inactive: expected an active one'
    assert not got
    assert ros.change('player', 'activate')
    ros.spin_until(lambda: len(got) > 10, 'messages')
    assert ros.change('player', 'deactivate')
    assert ros.call(Trigger, 'player/is_paused').success
    count = len(got)
    assert ros.change('player', 'activate')
    ros.spin_until(lambda: len(got) > count + 10, 'more messages')
    assert ros.change('player', 'deactivate', 'cleanup')
    ros.spin_until(lambda: not ros.node.count_publishers('/a'), 'the end of the publisher')
    assert [message.data for message in got] == list(range(len(got)))
    # From the start again.
    del got[:]
    assert ros.change('player', 'configure', 'activate')
    ros.spin_until(lambda: len(got) > 3, 'messages from the start')
    assert got[0].data == 0.0
    assert process.stop() == 0, process.output


def test_a_bag_of_one_moment_is_played_in_a_loop_without_haste(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', 0, 0), ('/a', 0, 1)])
    got = ros.collect(Float64, '/a')
    process = play(bag, 'play.loop:=true')
    begin = time.monotonic()
    ros.spin_until(lambda: len(got) >= 20, 'ten rounds')
    # Nine pauses of a tenth of a second: it cannot be faster, however fast the machine is.
    assert time.monotonic() - begin > 0.5
    assert process.stop() == 0, process.output
    assert [message.data for message in got[:20]] == [0.0, 1.0] * 10


def test_what_cannot_be_published_is_left_out_and_told(ros, play, tmp_path):
    path = tmp_path / 'bag.mcap'
    encoding, text = message_definition(FLOAT)
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start('ros2', 'test')
        schemas = [writer.register_schema(name, encoding, text.encode())
                   for name in (FLOAT, 'antigravity/msg/A', FIELD)]
        for schema, name in ((0, '/a'), (0, '/not a name\x1b'), (0, '//'), (1, '/other'),
                             (2, '/flux_density_command\0'), (2, '/coil/b')):
            channel = writer.register_channel(name, 'cdr', schemas[schema], {})
            for i in range(50):
                writer.add_message(channel, START + i * MS, serialize_message(
                    Float64(data=float(i))), START)
        writer.finish()
    got = ros.collect(Float64, '/a')
    driven = [ros.collect(MagneticField, x) for x in ('/flux_density_command', '/coil/b')]
    process = play(path)
    finish(ros, process, got, 50)
    assert driven == [[], []]
    assert 'topic /flux_density_command\\x00 is left out: it cannot be' in process.output
    assert 'topic /coil/b is left out: it carries commands' in process.output
    assert 'topic /not a name\\x1b is left out: it cannot be published' in process.output
    assert 'topic // is left out: it cannot be published' in process.output
    assert 'topic /other is left out: message type antigravity/msg/A is not installed' in (
        process.output)


def test_it_waits_for_the_subscribers_it_is_told_to(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', i, i) for i in range(50)])
    process = play(bag, 'play.wait_for_subscribers:=[a]')
    process.wait_for_output('waiting up to 60 s: no subscriber of /a')
    ros.spin_until(lambda: ros.node.count_publishers('/a'), 'the publisher')
    got = ros.collect(Float64, '/a')
    finish(ros, process, got, 50)


def test_a_subscriber_that_does_not_come_fails_the_run(play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', i, i) for i in range(5)])
    process = play(bag, 'play.wait_for_subscribers:=[/a]',
                   'play.wait_for_subscribers_timeout:=0.3')
    assert process.wait() == 1
    assert process.stderr.strip().splitlines()[-1].startswith(
        'hmsa: error: no subscriber of /a within 0.3 s')


@pytest.mark.slow
def test_it_waits_for_the_node_that_obeys_and_not_for_a_listener(ros, start, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [
        ('/flux_density_command', i, 0.1) for i in range(50)])
    got = ros.collect(MagneticField, '/flux_density_command')
    process = play(
        bag, 'play.wait_for_nodes:=[plant]', 'play.wait_for_subscribers:=[flux_density_command]',
        'play.topics_to_filter:=[flux_density_command]')
    ros.spin_until(lambda: ros.node.count_publishers('/flux_density_command'), 'the publisher')
    # Latched: the plant may find this subscription after the player.
    applied = ros.collect(MagneticField, '/flux_density_applied', topics.FLUX_DENSITY_APPLIED.qos)
    start.hmsa('plant')
    finish(ros, process, got, 50)
    ros.spin_until(lambda: applied, 'the level in force')


def test_a_replay_begins_when_the_recorder_has_found_what_the_plant_sends(start, tmp_path):
    bag = write_bag(tmp_path / 'bag', [
        ('/flux_density_command', i, 1e-3 * i) for i in range(100)])
    file = tmp_path / 'slow.yaml'
    file.write_text(
        'recorder:\n  ros__parameters:\n    record.topic_polling_interval.sec: 4\n')
    processes = {x.name: start(*x.command()) for x in REPLAY.evaluate({
        'bag': str(bag), 'record_to': str(tmp_path / 'again'), 'params_file': str(file)},
        tmp_path).nodes}
    assert processes['player'].wait() == 0, processes['player'].output
    assert processes['recorder'].stop() == 0, processes['recorder'].output
    summary = summarize(tmp_path / 'again')
    samples, = (x for x in summary.topics if x.name == '/joint_states')
    # The first one shows the plant at rest, whenever it is there.
    assert (samples.sent_before <= 1, samples.lost) == (True, 0), summary
    assert samples.count > 1


def test_it_ends_when_samples_have_come_up_to_the_end(ros, play, tmp_path):
    bag = write_bag(tmp_path / 'bag', [('/a', i, i) for i in range(50)])
    end, samples = START + 49 * MS, ros.node.create_publisher(JointState, '/joint_states', 100)
    seen = []
    ros.node.create_subscription(
        Clock, '/clock', lambda x: seen.append(x.clock.sec * 10**9 + x.clock.nanosec),
        QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT))
    process = play(
        bag, 'play.clock_publish_frequency:=1000.0', 'play.wait_for_samples:=[joint_states]')
    ros.spin_until(samples.get_subscription_count, 'a player that listens')

    def publish(*stamps):
        for stamp in stamps:
            sample = JointState()
            sample.header.stamp.sec, sample.header.stamp.nanosec = divmod(stamp, 10**9)
            samples.publish(sample)

    publish(end - 30 * MS, end - 29 * MS)
    # It repeats the time of the end while it waits.
    ros.spin_until(lambda: seen.count(end) > 5, 'the end')
    assert process.popen.poll() is None
    publish(end - MS, end)
    assert process.wait() == 0, process.output


@pytest.mark.slow
def test_topics_without_end_are_refused_and_those_named_are_played(ros, play, tmp_path):
    path = tmp_path / 'bag.mcap'
    encoding, text = message_definition(FLOAT)
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start('ros2', 'test')
        schema = writer.register_schema(FLOAT, encoding, text.encode())
        for i in range(65_000):
            channel = writer.register_channel(f'/t{i}', 'cdr', schema, {})
            writer.add_message(channel, START + i, serialize_message(Float64(data=1.0)), START)
        writer.finish()
    process = play(path)
    assert process.wait() == 2
    assert 'topics to send: expected at most 1000; name those wanted' in process.stderr
    got = ros.collect(Float64, '/t7')
    finish(ros, play(path, 'play.topics_to_filter:=[/t7]'), got, 1)


def test_a_database_is_played(ros, play, tmp_path):
    rosbag2, typesys = needs('rosbags.rosbag2'), needs('rosbags.typesys')
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    with rosbag2.Writer(
            tmp_path / 'bag', version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection('/a', FLOAT, typestore=store)
        for i in range(50):
            writer.write(connection, START + i * MS, store.serialize_cdr(
                store.types[FLOAT](data=float(i)), FLOAT))
    got = ros.collect(Float64, '/a')
    finish(ros, play(tmp_path / 'bag' / 'bag.db3'), got, 50)
    assert [message.data for message in got] == list(range(50))


@pytest.mark.parametrize(('entries', 'parameters', 'why'), [
    ([], (), 'the bag has none'),
    ([('/coil/command', 0, 1)], (), 'no topic is sent, as said above; its topics are /coil/comma'),
    ([('/a', 0, 1), ('/b', 900, 1)], ('play.topics_to_filter:=[/b]',
                                      'play.playback_duration.nsec:=500000',
                                      'play.playback_duration.sec:=0'),
     '/b has none in the part that is played')])
def test_a_player_that_sends_nothing_says_why_and_fails(play, tmp_path, entries, parameters, why):
    process = play(write_bag(tmp_path / 'bag', entries), *parameters)
    assert process.wait() == 1, process.output
    assert '0 messages sent' in process.stdout
    assert why in process.stderr


@pytest.mark.parametrize(('name', 'heard'), [
    ('chatter', '/left/chatter'), ('~/b', '/left/player/b')])
def test_a_relative_topic_is_sent_in_the_namespace_of_the_player(
        ros, play, tmp_path, name, heard):
    got = ros.collect(Float64, heard)
    path = write_bag(tmp_path / 'bag', [(name, i, i) for i in range(20)])
    finish(ros, play(path, '__ns:=/left', f'play.wait_for_subscribers:=[{heard}]'), got, 20)
    assert [x.data for x in got] == list(range(20))


@pytest.mark.parametrize(('parameters', 'expected'), [
    (('storage.uri:={bag}', 'play.wait_for_samples:=[joint_states]'), 'needs a /clock'),
    ((), 'parameter storage.uri is empty'),
    (('storage.uri:=/none',), 'does not exist: expected the folder of a bag'),
    (('storage.uri:={bag}', 'play.rate:=0.0'), 'play.rate'),
    (('storage.uri:={bag}', 'play.start_offset.sec:=5'),
     'play.start_offset is 5 s: expected at most 0 s'),
    (('storage.uri:={bag}', 'play.regex_to_filter:="("'), 'expected a regular expression'),
    (('storage.uri:={bag}', 'play.wait_for_subscribers:=[/b]'), 'expected topics that are sent')])
def test_bad_input_is_refused_in_one_line(
        ros_env, handlers, tmp_path, capfd, parameters, expected):
    bag = write_bag(tmp_path / 'bag', [('/a', 0, 0)])
    assert main(['player', '--ros-args', *(
        part for parameter in parameters for part in ('-p', parameter.format(bag=bag)))]) == 2
    line, = capfd.readouterr().err.splitlines()
    assert line.startswith('hmsa: error: ')
    assert expected in line
