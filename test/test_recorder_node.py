"""The recorder as a process, with publishers in other processes, over DDS."""

from pathlib import Path
import signal
import subprocess
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from extras import needs
from mcap.reader import make_reader
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from hmsa.bag import metadata
from hmsa.bag.definitions import message_definition, type_hash
from hmsa.bag.info import missing_messages, summarize, to_text
from hmsa.bag.qos import Qos
from hmsa.bag.reader import BagReader, read_messages
from hmsa.bag.records import MAGIC
from hmsa.bag.writer import BagTopic, BagWriter, recover
from hmsa.cli import main
from hmsa.interfaces import topics
from hmsa.model.units import NANOSECONDS
from hmsa_ros.nodes.capture import RawSubscription
from hmsa_ros.nodes.recorder import Recorder as Recording

pytestmark = pytest.mark.ros
TALKER = Path(__file__).parent / 'talker.py'


def send(publisher, *values):
    for value in values:
        publisher.publish(Float64(data=float(value)))


def read_by_rosbags(folder):
    """Return the values of a bag as rosbags reads them."""
    with needs('rosbags.highlevel').AnyReader([folder]) as reader:
        return [reader.deserialize(data, connection.msgtype).data
                for connection, _, data in reader.messages()]


class Recorder:
    """A recorder process with its diagnostics."""

    def __init__(self, start, ros, folder, *parameters, topics='/a'):
        self.folder = folder
        self.ros = ros
        self.diagnostics = ros.collect(DiagnosticArray, '/diagnostics')
        arguments = [f'storage.uri:={folder}', *parameters]
        if topics:
            arguments.append(f'record.topics:={topics}')
        self.process = start.hmsa(
            'recorder', '--ros-args', *(part for argument in arguments
                                        for part in ('-p', argument)))

    def says(self, key):
        """Return the last value of a key in its diagnostics."""
        for message in reversed(self.diagnostics):
            for status in message.status:
                if status.name == 'recorder: bag':
                    return {item.key: item.value for item in status.values}.get(key, '')
        return ''

    def wait_for(self, key, value):
        self.ros.spin_until(lambda: self.says(key) == value, f'{key} = {value} of the recorder')

    def hear(self, publisher, *values, received):
        """Publish values, and wait until so many messages are received."""
        send(publisher, *values)
        self.wait_for('received', str(received))

    def call(self, name):
        return self.ros.call(Trigger, f'recorder/{name}')

    def end(self, number=signal.SIGINT):
        assert self.process.stop(number) == 0, self.process.output
        assert 'Traceback' not in self.process.output
        return BagReader(self.folder)


@pytest.fixture
def record(start, ros, tmp_path):
    return lambda *parameters, **options: Recorder(
        start, ros, tmp_path / 'bag', *parameters, **options)


@pytest.fixture
def talk(start):
    def talk(topic, count, *options):
        process = start.python(TALKER, topic, str(count), *map(str, options))
        process.wait_for_output('done')
        return process
    return talk


def values(reader, topic='/a'):
    return [item.message.data for item in read_messages(reader.path, [topic])]


@pytest.mark.parametrize('ending', [signal.SIGINT, signal.SIGTERM])
def test_everything_sent_is_in_the_bag_after_a_clean_end(record, talk, ending):
    recorder = record()
    talk('/a', 2000, '--rate', 5000)
    reader = recorder.end(ending)
    assert values(reader) == list(range(2000))
    assert reader.complete
    assert not reader.problems
    info = reader.topics['/a']
    assert (info.type, info.type_hash) == ('std_msgs/msg/Float64', type_hash(info.type))
    assert [(profile.reliability, profile.durability) for profile in info.profiles] == [
        ('reliable', 'volatile')]
    for message in reader.messages():
        assert 0 <= message.log_time - message.publish_time < 60e9
    stored = metadata.read(recorder.folder / 'metadata.yaml')
    assert stored.message_count == 2000
    assert missing_messages(stored.custom_data, 'lost') == {'/a': 0}
    assert '2000 messages of 1 topics' in recorder.process.stdout
    assert read_by_rosbags(recorder.folder) == list(range(2000))


@pytest.mark.slow
def test_it_says_when_every_topic_asked_for_is_subscribed_to(record, ros):
    recorder = record(topics='[/a, b]')
    recorder.wait_for('subscribed', '0/2')
    ros.publisher(Float64, '/a')
    recorder.wait_for('subscribed', '1/2')
    assert 'ready' not in recorder.process.output
    ros.publisher(Float64, '/b')
    recorder.wait_for('subscribed', '2/2')
    recorder.process.wait_for_output('ready: subscribed to all 2 topics')


def test_lost_messages_are_counted_to_the_last_one(record, ros):
    recorder = record('record.queue_depth:=5')
    publisher = ros.publisher(Float64, '/a', 2000)
    recorder.hear(publisher, -1.0, received=1)
    # While the recorder does not run, all but the last few are overwritten in its queue.
    recorder.process.popen.send_signal(signal.SIGSTOP)
    send(publisher, *range(1000))
    recorder.process.popen.send_signal(signal.SIGCONT)
    ros.spin_until(lambda: int(recorder.says('received')) + int(recorder.says('lost')) == 1001,
                   'all 1001 messages to be received or counted as lost')
    reader = recorder.end()
    got = values(reader)
    lost = missing_messages(reader.custom_data, 'lost')['/a']
    assert got[0] == -1.0
    assert got[-1] == 999.0
    assert lost > 0
    assert len(got) + lost == 1001
    assert f'{lost} lost' in recorder.process.stdout


def test_what_was_sent_before_it_was_matched_is_counted_apart(record, ros):
    publisher = ros.publisher(Float64, '/a', 100, subscribers=0)
    send(publisher, *range(20))
    recorder = record(topics='[/a, /b]')
    ros.spin_until(lambda: publisher.get_subscription_count() == 1, 'the recorder')
    recorder.hear(publisher, *range(20, 25), received=5)
    recorder.wait_for('sent_before./a', '20')
    reader = recorder.end()
    assert values(reader) == [20.0, 21.0, 22.0, 23.0, 24.0]
    assert missing_messages(reader.custom_data, 'lost') == {'/a': 0}
    assert '0 lost, 20 sent before the recorder was matched' in recorder.process.stdout
    assert 'no message was received on /b' in recorder.process.stdout
    summary = summarize(recorder.folder)
    assert (summary.sent_before, summary.topics[0].sent_before) == (20, 20)
    assert 'complete  yes, except 20 messages' in to_text(summary)


def test_a_topic_of_which_nothing_came_is_named_by_the_recorder_and_by_its_bag(record, ros):
    recorder = record('record.regex:=^/a', topics='')
    publishers = [ros.publisher(Float64, x) for x in ('/a1', '/a2')]
    recorder.hear(publishers[0], 1.0, received=1)
    reader = recorder.end()
    assert reader.counts() == {'/a1': 1, '/a2': 0}
    assert 'no message was received on /a2' in recorder.process.stdout
    assert 'note: no message was received on /a2' in to_text(summarize(recorder.folder))


@pytest.mark.slow
def test_several_publishers_of_one_topic_are_counted_apart(record, start):
    recorder = record()
    talkers = [start.python(TALKER, '/a', '3000', '--rate', '2000', '--first', str(10_000 * i))
               for i in range(2)]
    for talker in talkers:
        talker.wait_for_output('done')
    reader = recorder.end()
    got = values(reader)
    for i in range(2):
        assert [value for value in got if value // 10_000 == i] == list(
            range(10_000 * i, 10_000 * i + 3000))
    assert missing_messages(reader.custom_data, 'lost') == {'/a': 0}


def test_a_bag_is_recovered_after_kill_9(record, ros, tmp_path):
    recorder = record('storage.flush_period:=0.1')
    publisher = ros.publisher(Float64, '/a')
    send(publisher, *range(500))
    recorder.wait_for('written', '500')
    assert recorder.process.stop(signal.SIGKILL) == -signal.SIGKILL
    assert metadata.read(recorder.folder / 'metadata.yaml').version == 9
    result = recover(recorder.folder, tmp_path / 'recovered')
    assert result.message_count == 500
    assert read_by_rosbags(tmp_path / 'recovered') == list(range(500))


@pytest.fixture
def small_disk(tmp_path):
    """Return a file system of three megabytes, mostly filled by the file "filler"."""
    folder = tmp_path / 'disk'
    folder.mkdir()
    command = ['mount', '-t', 'tmpfs', '-o', 'size=3m', 'tmpfs', str(folder)]
    if subprocess.run(command, check=False, capture_output=True).returncode:
        pytest.skip('no permission to mount a small file system')
    (folder / 'filler').write_bytes(bytes(3 * 2**20 // 2))
    yield folder
    subprocess.run(['umount', '--lazy', str(folder)], check=True)


@pytest.mark.slow
def test_a_full_disk_is_told_and_nothing_is_lost_when_there_is_room_again(
        start, ros, small_disk, wait_until):
    recorder = Recorder(start, ros, small_disk / 'bag')
    publisher = ros.publisher(Float64, '/a')
    recorder.wait_for('subscribed', '1/1')
    sent = 0

    def fill(condition):
        nonlocal sent
        if not condition():
            for _ in range(20):
                send(publisher, sent)
                sent += 1
        return condition()

    def failing():
        return any(status.level == DiagnosticStatus.ERROR
                   and 'No space left on device' in status.message
                   for message in recorder.diagnostics for status in message.status)

    ros.spin_until(lambda: fill(failing), 'the disk to be full')
    assert 'No space left on device' in recorder.process.output
    # The file ends after that is said; its reserve may do for the next file until there is room.
    first = small_disk / 'bag' / 'bag_0.mcap'
    wait_until(lambda: first.read_bytes().endswith(MAGIC), 'the end of the file')
    with first.open('rb') as file:
        so_far = [deserialize_message(message.data, Float64).data
                  for *_, message in make_reader(file).iter_messages()]
    assert so_far == list(range(len(so_far)))
    assert len(so_far) > 1000
    (small_disk / 'filler').unlink()
    recorder.process.wait_for_output('recording continues in bag_1.mcap')
    send(publisher, sent)
    recorder.wait_for('written', str(sent + 1))
    reader = recorder.end()
    assert values(reader) == read_by_rosbags(reader.path) == list(range(sent + 1))
    assert missing_messages(reader.custom_data, 'lost') == {'/a': 0}
    assert reader.complete


def test_an_existing_folder_is_refused_in_one_line(ros_env, handlers, tmp_path, capfd):
    assert main(['recorder', '--ros-args', '-p', f'storage.uri:={tmp_path}']) == 2
    assert capfd.readouterr().err == (
        f'hmsa: error: {tmp_path} exists: expected the name of a new bag; choose another name or '
        'remove it\n')


@pytest.mark.parametrize(('parameter', 'expected'), [
    ('storage.uri:=/proc/none/bag', 'cannot be made'),
    ('storage.storage_preset_profile:=best', 'expected one of none, fastwrite'),
    ('storage.custom_data:=[a]', 'expected key=value'),
    ('storage.max_bagfile_size:=10', 'at least 1024'),
    ('record.regex:="("', 'expected a regular expression'),
    ('record.topics:=3', 'expected a list of strings')])
def test_bad_parameters_are_refused_in_one_line(
        ros_env, handlers, tmp_path, capfd, parameter, expected):
    assert main(['recorder', '--ros-args', '-p', f'storage.uri:={tmp_path / "bag"}',
                 '-p', parameter]) == 2
    line, = capfd.readouterr().err.splitlines()
    assert line.startswith('hmsa: error: ')
    assert expected in line
    assert not (tmp_path / 'bag').exists()


def test_latched_and_best_effort_publishers_are_recorded_alike(record, talk):
    talk('/latched', 3, '--latched', '--depth', 3, '--wait', 0)
    recorder = record(topics='[/latched, /fast]')
    talk('/fast', 200, '--best-effort', '--rate', 1000)
    recorder.wait_for('received', '203')
    reader = recorder.end()
    assert values(reader, '/latched') == [0.0, 1.0, 2.0]
    assert values(reader, '/fast') == list(range(200))
    assert reader.topics['/latched'].profiles[0].durability == 'transient_local'
    assert reader.topics['/fast'].profiles[0].reliability == 'best_effort'


@pytest.mark.slow
def test_a_publisher_that_asks_for_less_is_heard_after_one_that_offered_more(
        record, talk, make_ros):
    recorder = record()
    other = make_ros()
    reliable = other.publisher(Float64, '/a')
    recorder.hear(reliable, -1.0, received=1)
    talk('/a', 100, '--best-effort', '--rate', 500)
    recorder.hear(reliable, -2.0, received=102)
    reader = recorder.end()
    assert values(reader) == [-1.0, *range(100), -2.0]
    assert {profile.reliability for profile in reader.topics['/a'].profiles} == {
        'reliable', 'best_effort'}


def test_topics_are_chosen_by_expression_and_exclusion(record, ros):
    recorder = record('record.regex:=^/x', 'record.exclude_topics:=[/x3]', topics='')
    publishers = {name: ros.node.create_publisher(Float64, name, 10)
                  for name in ('/x1', '/y', '/x3')}
    late = ros.publisher(Float64, '/x2')
    ros.spin_until(publishers['/x1'].get_subscription_count, 'a subscriber of /x1')
    for publisher in (*publishers.values(), late):
        send(publisher, 1.0)
    recorder.wait_for('received', '2')
    assert recorder.end().counts() == {'/x1': 1, '/x2': 1}


def test_without_a_selection_every_topic_is_recorded(record, ros):
    recorder = record(topics='')
    ros.publisher(Float64, '/a').publish(Float64(data=1.0))
    recorder.process.wait_for_output('subscribed to /diagnostics')
    ros.spin_until(lambda: int(recorder.says('received') or 0) > 3, 'messages')
    counts = recorder.end().counts()
    assert counts['/a'] == 1
    assert counts['/diagnostics'] > 0


@pytest.mark.slow
def test_pause_and_resume(record, ros):
    recorder = record('record.start_paused:=true')
    publisher = ros.publisher(Float64, '/a')
    send(publisher, 1.0)
    assert recorder.call('is_paused').success
    assert recorder.call('resume').success
    assert not recorder.call('is_paused').success
    recorder.hear(publisher, 2.0, received=1)
    assert recorder.call('pause').message == 'paused'
    send(publisher, 3.0)
    # Several rounds of the diagnostics later it would have been counted.
    before = len(recorder.diagnostics)
    ros.spin_until(lambda: len(recorder.diagnostics) > before + 1, 'diagnostics')
    recorder.call('resume')
    recorder.hear(publisher, 4.0, received=2)
    reader = recorder.end()
    assert values(reader) == [2.0, 4.0]
    assert missing_messages(reader.custom_data, 'lost') == {'/a': 0}


def test_files_are_split_by_service_and_by_size(record, ros):
    recorder = record('storage.max_bagfile_size:=4096')
    publisher = ros.publisher(Float64, '/a')
    assert recorder.call('split_bagfile').message == 'bag_1.mcap'
    recorder.hear(publisher, *range(1000), received=1000)
    reader = recorder.end()
    assert len(reader.files) > 5
    assert values(reader) == list(range(1000))
    stored = metadata.read(recorder.folder / 'metadata.yaml')
    assert sum(file.message_count for file in stored.files) == 1000
    assert read_by_rosbags(recorder.folder) == list(range(1000))


def test_garbage_on_the_clock_is_left_aside(record, ros):
    recorder = record('use_sim_time:=true')
    clock = ros.publisher(topics.CLOCK_TOPIC, subscribers=0)
    message = Clock()
    message.clock.sec = 100

    def ignored(garbage, count):
        clock.publish(garbage)
        return int(recorder.says('clock_ignored') or 0) >= count

    ros.spin_until(lambda: ignored(b'\x00\x01\x00\x00\x07', 1), 'the broken message')
    known = int(recorder.says('clock_ignored'))
    before = Clock()
    before.clock.sec = -5
    ros.spin_until(lambda: ignored(before, known + 100), 'the time before the epoch')
    publisher = ros.node.create_publisher(Float64, '/a', 10)

    def ticks():
        message.clock.nanosec += 1
        clock.publish(message)
        return publisher.get_subscription_count()

    ros.spin_until(ticks, 'the recorder to listen')
    recorder.hear(publisher, 1.0, received=1)
    assert values(recorder.end()) == [1.0]


@pytest.mark.slow
def test_simulated_time_is_waited_for_and_stamped(record, ros):
    recorder = record('use_sim_time:=true')
    clock = ros.publisher(topics.CLOCK_TOPIC, subscribers=0)
    publisher = ros.node.create_publisher(Float64, '/a', QoSProfile(
        depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    send(publisher, 1.0)
    recorder.wait_for('state', 'waiting for /clock')
    message = Clock()
    message.clock.sec = 100

    def tick():
        message.clock.nanosec += 1
        clock.publish(message)
        return recorder.says('received') == '1'

    ros.spin_until(tick, 'the latched message')
    message.clock.sec = 200
    clock.publish(message)
    recorder.hear(publisher, 2.0, received=2)
    message.clock.sec = 50
    clock.publish(message)
    ros.spin_until((recorder.folder / 'bag_1.mcap').exists, 'a new file for the new time')
    recorder.hear(publisher, 3.0, received=3)
    recorder.wait_for('time_jumps', '1')
    reader = recorder.end()
    assert 'simulated time jumped back from 200.000 s to 50.000 s' in recorder.process.output
    assert reader.custom_data['time_jumps'] == '1'
    before, after = (list(BagReader(file).messages()) for file in reader.files)
    first, second = before
    assert first.log_time // 10**9 == 100
    assert second.log_time == 200 * 10**9 + message.clock.nanosec
    assert second.publish_time > 10**18
    assert [item.log_time // 10**9 for item in after] == [50]


def test_a_bag_played_in_a_loop_is_recorded_round_by_round(record, start, ros, tmp_path):
    bag = tmp_path / 'played'
    encoding, text = message_definition('std_msgs/msg/Float64')
    with BagWriter(bag) as writer:
        number = writer.add_topic(BagTopic('/a', 'std_msgs/msg/Float64', text, encoding, (Qos(),)))
        writer.write((number, 10**12 + i * 10**6, 1, i, serialize_message(Float64(data=float(i))))
                     for i in range(200))
    recorder = record('use_sim_time:=true')
    player = start.hmsa(
        'player', '--ros-args', '-p', f'storage.uri:={bag}', '-p', 'play.loop:=true', '-p',
        'play.clock_publish_frequency:=500.0', '-p', 'play.wait_for_subscribers:=[/a]')
    ros.spin_until(lambda: int(recorder.says('time_jumps') or 0) >= 3, 'three rounds')
    player.stop()
    reader = recorder.end()
    assert len(reader.files) >= 4
    for file in reader.files[:3]:
        assert values(BagReader(file)) == list(range(200))


def in_process(folder):
    """Return the arguments of a recorder in this process."""
    return ('-p', f'storage.uri:={folder}', '-p', 'storage.flush_period:=0.1', '-p',
            'record.topics:=[/a]')


def test_a_clock_that_is_set_back_begins_a_file_whose_log_times_rise(
        ros, serve, tmp_path, monkeypatch):
    folder, set_back = tmp_path / 'bag', 0
    recorder = serve(Recording, *in_process(folder)).nodes[0]
    take = RawSubscription.take
    monkeypatch.setattr(RawSubscription, 'take', lambda *limit: [
        x._replace(received_ns=x.received_ns - set_back) for x in take(*limit)])
    publisher = ros.publisher(Float64, '/a')
    send(publisher, 1.0)
    ros.spin_until(lambda: recorder._recorded.topics['/a'].received == 1, 'the first message')
    # As if all readings so far had been ten seconds ahead, or the next ones behind.
    set_back = 10 * NANOSECONDS
    recorder._steps._clock = lambda: time.time_ns() - set_back
    send(publisher, 2.0)
    ros.spin_until(lambda: recorder._recorded.topics['/a'].received == 2, 'the second message')
    recorder.close()
    reader = BagReader(folder)
    assert reader.custom_data['time_jumps'] == '1'
    (first,), (second,) = (list(BagReader(file).messages()) for file in reader.files)
    assert first.log_time - second.log_time > 9 * NANOSECONDS


def test_a_clock_that_is_set_ahead_is_told_in_the_bag(ros, serve, tmp_path, capfd):
    recorder = serve(Recording, *in_process(tmp_path / 'bag')).nodes[0]
    publisher = ros.publisher(Float64, '/a')
    send(publisher, 1.0)
    ros.spin_until(lambda: recorder._recorded.topics['/a'].received == 1, 'the first message')
    recorder._steps._clock = lambda: time.time_ns() + 3600 * NANOSECONDS
    send(publisher, 2.0)
    ros.spin_until(lambda: recorder._recorded.topics['/a'].received == 2, 'the second message')
    recorder.close()
    reader = BagReader(tmp_path / 'bag')
    assert reader.custom_data['time_set_ahead'].startswith('3600.0')
    assert 'time_jumps' not in reader.custom_data
    assert len(reader.files) == 1
    assert 'the clock of this host was set ahead by 3600.0' in capfd.readouterr().err


def test_what_comes_while_messages_are_taken_is_in_the_file_of_its_time(
        ros, serve, tmp_path, monkeypatch):
    folder = tmp_path / 'bag'
    serve(Recording, *in_process(folder), '-p', 'use_sim_time:=true')
    clock = ros.publisher(topics.CLOCK_TOPIC, subscribers=0)
    publisher = ros.publisher(Float64, '/a', subscribers=0)

    def tick(seconds):
        message = Clock()
        message.clock.sec = seconds
        clock.publish(message)

    ros.spin_until(
        lambda: tick(100) or publisher.get_subscription_count(), 'the recorder to listen')
    take, jumped = RawSubscription.take, []

    def late(subscription, *limit):
        # /a has been taken, and /clock is about to be: rounds end with it.
        taken = take(subscription, *limit)
        if subscription.handle.get_topic_name() == '/clock' and not jumped:
            jumped.append(True)
            send(publisher, *range(3000))
            tick(50)
            while not (new := take(subscription)):
                pass
            send(publisher, -1.0)
            taken += new
        return taken

    def recorded():
        return [values(BagReader(x)) for x in sorted(folder.glob('*.mcap'))]

    send(publisher, -2.0)
    ros.spin_until(lambda: recorded() == [[-2.0]], 'the first message')
    monkeypatch.setattr(RawSubscription, 'take', late)
    tick(100)
    ros.spin_until(lambda: sum(map(len, recorded())) == 3002, 'all messages')
    assert recorded() == [[-2.0, *range(3000)], [-1.0]]


@pytest.mark.slow
def test_of_two_clocks_one_is_followed_and_that_is_told(record, ros, make_ros):
    recorder = record('use_sim_time:=true')
    publisher = ros.publisher(Float64, '/a', subscribers=0)
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    first = ros.publisher(Clock, '/clock', best_effort)
    second = make_ros().publisher(Clock, '/clock', best_effort)

    def tick():
        for clock, seconds in ((first, 100), (second, 7)):
            message = Clock()
            message.clock.sec = seconds
            clock.publish(message)
        return recorder.says('clock_ignored') not in ('', '0')

    ros.spin_until(lambda: tick() or recorder.says('subscribed') == '1/1', 'the subscription')
    ros.spin_until(lambda: tick() and publisher.get_subscription_count(), 'the other clock')
    assert any('2 publishers of /clock, the first one is followed' in status.message
               for message in recorder.diagnostics for status in message.status)
    send(publisher, 1.0)
    ros.spin_until(lambda: tick() and recorder.says('received') == '1', 'the message')
    reader = recorder.end()
    assert len(reader.files) == 1
    item, = reader.messages()
    assert item.log_time in (100 * 10**9, 7 * 10**9)


def test_the_experiment_goes_into_the_bag(record, ros, make_ros):
    other = make_ros()
    planners = {}
    for zeta, space in ((0.1, '/left'), (0.2, '/right'), (0.3, '/')):
        planners[space] = Node('planner', context=other.context, namespace=space)
        planners[space].declare_parameter('zeta', zeta)
        other.executor.add_node(planners[space])
    recorder = record('storage.custom_data:=["actuator=A3", "operator=Kim"]')

    def noted():
        other.executor.spin_once(0.02)
        text = (recorder.folder / 'metadata.yaml').read_text()
        return text.count('planner.zeta') == 3

    ros.spin_until((recorder.folder / 'metadata.yaml').exists, 'the bag')
    ros.spin_until(noted, 'the parameters in the bag')
    planners['/left'].set_parameters([Parameter('zeta', value=0.4)])
    ros.spin_until(lambda: "planner.zeta: '0.4'" in (
        recorder.folder / 'metadata.yaml').read_text(), 'the change of a parameter')
    reader = recorder.end()
    assert reader.custom_data['actuator'] == 'A3'
    for stored in (reader.custom_data, reader.records['hmsa_ros']):
        assert [stored[f'{space}planner.zeta'] for space in ('/left/', '/right/', '/')] == [
            '0.4', '0.2', '0.3']
    assert 'version' in reader.records['hmsa_ros']
    assert summarize(recorder.folder).parameters['/right/planner.zeta'] == '0.2'
    for planner in planners.values():
        planner.destroy_node()


@pytest.mark.slow
def test_it_records_while_it_is_active(record, ros):
    recorder = record('autostart:=false')

    assert ros.change('recorder', 'configure')
    publisher = ros.publisher(Float64, '/a')
    recorder.wait_for('state', 'inactive')
    send(publisher, 1.0)
    assert not recorder.call('resume').success
    assert ros.change('recorder', 'activate')
    recorder.hear(publisher, 2.0, received=1)
    assert ros.change('recorder', 'deactivate')
    send(publisher, 3.0)
    recorder.wait_for('state', 'inactive')
    assert ros.change('recorder', 'activate')
    recorder.hear(publisher, 4.0, received=2)
    assert ros.change('recorder', 'deactivate', 'cleanup')
    reader = BagReader(recorder.folder)
    assert reader.complete
    assert values(reader) == [2.0, 4.0]
    # The folder is there now, and is not written to again.
    assert not ros.change('recorder', 'configure')
    assert f'{recorder.folder} exists' in recorder.process.output
    recorder.end()


def test_a_snapshot_holds_what_came_before_it(record, ros):
    recorder = record('record.snapshot_mode:=true')
    publisher = ros.publisher(Float64, '/a')
    recorder.hear(publisher, *range(50), received=50)
    assert recorder.says('written') == '0'
    assert recorder.call('snapshot').message == '50 messages written'
    recorder.hear(publisher, 99.0, received=51)
    assert values(recorder.end()) == list(range(50))
