"""Raw messages taken from subscriptions, and their simulated timestamps."""

from ctypes import memmove
from pathlib import Path

import pytest
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from std_msgs.msg import Float64

from hmsa.bag.writer_thread import RecordedTopic
from hmsa_ros.nodes import recorder
from hmsa_ros.nodes.capture import _Taker, Buffer, Capture, RawSubscription, SimulatedTime
from hmsa_ros.nodes.selection import Selection

TALKER = Path(__file__).parent / 'talker.py'


@pytest.mark.ros
def test_messages_are_taken_with_stamps_and_numbers(ros, start, wait_until):
    got = []
    capture = Capture(lambda taken: got.extend(
        message for key, messages in taken for message in messages if key == 'a'))
    capture.add('a', RawSubscription(ros.node, Float64, '/a', QoSProfile(depth=1000)))
    capture.start()
    start.python(TALKER, '/a', '300', '--rate', '2000').wait_for_output('done')
    wait_until(lambda: len(got) == 300, '300 messages')
    capture.stop()
    assert capture.error is None
    assert [deserialize_message(message.data, Float64).data for message in got] == list(
        range(300))
    assert [message.sequence for message in got] == list(
        range(got[0].sequence, got[0].sequence + 300))
    assert all(0 <= message.received_ns - message.source_ns < 60e9 for message in got)
    assert {len(message.publisher) for message in got} == {16}
    assert len({message.publisher for message in got}) == 1


def test_what_comes_without_a_payload_is_no_message():
    taker, whole = _Taker(), b'\0\1\0\0message'
    payloads = [b'', whole]

    def take(pointer, array, info, allocation):
        if not payloads:
            return 1
        data = payloads.pop(0)
        buffer = Buffer.from_address(array)
        memmove(buffer.buffer, data, len(data))
        buffer.length = len(data)
        return 0
    taker._take = take
    assert [x.data for x in taker.take(0, 10)] == [whole]


@pytest.mark.ros
def test_an_error_in_the_thread_is_kept(ros, start, wait_until):
    def fail(taken):
        raise ValueError('no')

    capture = Capture(fail)
    capture.add('a', RawSubscription(ros.node, Float64, '/a', QoSProfile(depth=10)))
    capture.start()
    start.python(TALKER, '/a', '1').wait_for_output('done')
    wait_until(lambda: capture.error is not None, 'the error')
    capture.stop()
    assert isinstance(capture.error, ValueError)


@pytest.mark.ros
def test_a_subscription_is_replaced_without_a_loss(ros, start, wait_until):
    topic = RecordedTopic('/a', 'std_msgs/msg/Float64', 0, None, ())
    got = []
    capture = Capture(lambda taken: [
        got.extend(topic.take(messages, None, paused=False)[0]) for _, messages in taken])
    capture.add(topic, RawSubscription(ros.node, Float64, '/a', QoSProfile(depth=1000)))
    capture.start()
    talker = start.python(TALKER, '/a', '1500', '--rate', '1000')
    for count in (200, 700):
        wait_until(lambda count=count: len(got) > count, f'{count} messages')
        capture.replace(topic, RawSubscription(
            ros.node, Float64, '/a', QoSProfile(depth=1000)))
    talker.wait_for_output('done')
    wait_until(lambda: len(got) >= 1500, 'all messages')
    capture.stop()
    assert capture.error is None
    assert topic.missed == 0
    assert [sequence for *_, sequence, _ in got] == list(range(got[0][3], got[0][3] + 1500))


def test_messages_of_a_publisher_keep_their_order_when_one_had_to_be_sent_again():
    topic = RecordedTopic('/a', 'std_msgs/msg/Float64', 0, None, ())

    def log_times(*messages):
        batch, _ = topic.take([(0, *message, b'') for message in messages], None, paused=False)
        return [log_time for _, log_time, *_ in batch]

    # The second message of 'a' was received last, and held back its third.
    assert log_times((10, 1, b'a'), (40, 2, b'a'), (20, 3, b'a'), (30, 1, b'b')) == [
        10, 40, 40, 30]
    assert log_times((30, 4, b'a'), (50, 5, b'a')) == [40, 50]
    topic.begin_anew()
    assert log_times((5, 6, b'a')) == [5]


@pytest.mark.parametrize('largest', [
    (100,) * 50, (60_000,) * 6, (60_000,) * 200, (100, 3_000, 10**7)])
def test_the_queues_of_all_topics_stay_within_their_share_of_the_memory(largest, monkeypatch):
    monkeypatch.setattr(recorder, 'RawSubscription', lambda *_: None)
    replaced = []
    capture = Capture(lambda taken: None)
    monkeypatch.setattr(capture, 'replace', lambda topic, _: replaced.append(topic))
    found = recorder.Subscriptions(
        None, Selection(), None, capture, 10_000, 100 * 2**20)
    for i in range(len(largest)):
        qos = QoSProfile(depth=10_000)
        found.topics[str(i)] = RecordedTopic(str(i), 'std_msgs/msg/String', i, qos, ())
    for share in (0, 0.1, 0.4, 1, 1):
        for topic, size in zip(found.topics.values(), largest, strict=True):
            topic.largest = round(size * share)
        found.look(())
    depths = [x.qos.depth for x in found.topics.values()]
    assert sum(x * y for x, y in zip(largest, depths, strict=True)) <= 50 * 2**20
    assert all(depth == 10_000 for x, depth in zip(largest, depths, strict=True) if x == 100)
    assert len(replaced) <= 4 * len(largest)


class _Held:
    """A subscription that holds some numbers, one a round; ``meanwhile`` happens at the first."""

    def __init__(self, *numbers, meanwhile=lambda: None):
        self._numbers = list(numbers)
        self._meanwhile = [meanwhile]

    def take(self, limit):
        if self._meanwhile:
            self._meanwhile.pop()()
        return [self._numbers.pop(0)] if self._numbers else []

    def destroy(self):
        pass


def test_what_a_subscription_holds_that_is_replaced_meanwhile_comes_first():
    got = []
    capture = Capture(lambda taken: got.extend(x for _, numbers in taken for x in numbers))
    capture.add('a', _Held(1, 2, meanwhile=lambda: capture.replace('a', _Held(3))))
    capture.start()
    capture.stop()
    assert got == [1, 2, 3]


def test_simulated_time_is_that_of_the_last_tick_before():
    clock = SimulatedTime()
    assert not clock.started
    assert [clock.add(received, time)
            for received, time in ((100, 1000), (200, 2000), (300, 500))] == [None, None, 2000]
    assert clock.started
    assert [clock.at(moment) for moment in (50, 100, 199, 200, 299, 300, 400)] == [
        1000, 1000, 1000, 2000, 2000, 500, 500]
    assert clock.jumps == 1


def test_of_two_clocks_the_first_is_followed_until_it_falls_silent():
    clock, second = SimulatedTime(), 10**9
    for i in range(5):
        clock.add(i * second // 10, 1000 + i, b'first')
        assert clock.add(i * second // 10 + 1, 5, b'second') is None
    assert (clock.ignored, clock.jumps) == (5, 0)
    assert clock.at(second) == 1004
    assert clock.add(2 * second, 7, b'second') == 1004
    assert clock.at(2 * second) == 7
    clock.add(2 * second + 1, 1006, b'first')
    assert clock.at(2 * second + 1) == 7


def test_old_ticks_are_forgotten():
    clock = SimulatedTime()
    for i in range(100_001):
        clock.add(i, 10 * i)
    assert clock.at(100_000) == 1_000_000
    assert clock.at(0) == 500_000
