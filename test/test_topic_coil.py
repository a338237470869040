"""Coils behind topics of other packages: arrays, numbers and vectors, and their closing."""

import signal

import pytest
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from hmsa.errors import BadInputError, HmsaError
from hmsa.interfaces import topics
from hmsa_ros.device.hardware import load
from hmsa_ros.nodes.conversions import from_time, to_command

ARRAY, VECTOR, FIELD = (
    'std_msgs/msg/Float64MultiArray', 'geometry_msgs/msg/Vector3Stamped',
    'sensor_msgs/msg/MagneticField')
MS = 1_000_000


def given(*parameters):
    return ['--ros-args', *(word for x in parameters for word in ('-p', x))]


def command(ros, joint=''):
    topic = topics.FLUX_DENSITY_COMMAND
    return ros.publisher(topic.type, f'{joint}/{topic.name}' if joint else topic.name, topic.qos)


def xyz(vector):
    return vector.x, vector.y, vector.z


@pytest.mark.ros
def test_joints_share_an_array_that_is_zero_while_locked_and_in_the_end(start, ros):
    got = ros.collect(ARRAY, '/lab/coils')
    driver = start.hmsa(
        'driver', *given(
            'hardware:=topic', 'hardware.topic:=coils', 'joints:=[left, right]',
            'left.hardware.field:=data[1]', 'right.hardware.field:=data[2]', 'hardware.size:=4',
            'left.hardware.coil.tesla_per_ampere:=0.05', 'publish_rate:=0.0',
            'command_timeout:=0.0'),
        # As a launch file names it.
        '-r', '__node:=driver', '-r', '__ns:=/lab')
    ros.spin_until(lambda: got, 'the levels at the start')
    levels = [command(ros, f'/lab/{x}') for x in ('left', 'right')]
    for publisher, level in zip(levels, (0.1, -0.3), strict=True):
        publisher.publish(to_command(0, level, ''))
    # One in A, the other in T.
    ros.spin_until(lambda: [*got[-1].data] == [0.0, 2.0, -0.3, 0.0], 'both levels')
    assert {len(x.data) for x in got} == {4}
    assert not any(got[0].data)
    lock = ros.publisher(topics.INTERLOCK.type, '/lab/driver/interlock')
    lock.publish(Bool(data=False))
    ros.spin_until(lambda: not any(got[-1].data), 'the coils off')
    lock.publish(Bool(data=True))
    driver.wait_for_output('interlock closed')
    levels[1].publish(to_command(0, 0.0, ''))
    levels[1].publish(to_command(ros.node.get_clock().now().nanoseconds + 300 * MS, 0.2, ''))
    ros.spin_until(lambda: [*got[-1].data] == [0.0, 0.0, 0.2, 0.0], 'a new level')
    assert driver.stop(signal.SIGTERM) == 0
    ros.spin_until(lambda: not any(got[-1].data), 'the end')


@pytest.mark.ros
def test_vectors_along_the_directions_of_joints_add_up_at_the_times_of_their_levels(start, ros):
    got = ros.collect(FIELD, '/field')
    start.hmsa('driver', *given(
        'hardware:=topic', 'hardware.topic:=/field', 'joints:=[left, right]',
        'left.hardware.direction:=[0.6, 0.0, -0.8]', 'right.hardware.direction:=[0, 1, 0]',
        'publish_rate:=0.0', 'command_timeout:=0.0'))
    ros.spin_until(lambda: got, 'the levels at the start')
    left, right = (command(ros, x) for x in ('left', 'right'))
    stamp = ros.node.get_clock().now().nanoseconds + 500 * MS
    left.publish(to_command(stamp, 0.1, ''))
    right.publish(to_command(stamp + 100 * MS, -0.2, ''))
    ros.spin_until(lambda: xyz(got[-1].magnetic_field)[1], 'both levels')
    news = [x for x in got if any(xyz(x.magnetic_field))]
    assert xyz(news[0].magnetic_field) == pytest.approx((0.06, 0.0, -0.08), abs=1e-15)
    assert xyz(got[-1].magnetic_field) == pytest.approx((0.06, -0.2, -0.08), abs=1e-15)
    assert stamp <= from_time(news[0].header.stamp)
    assert stamp + 100 * MS <= from_time(next(
        x for x in news if x.magnetic_field.y).header.stamp)


@pytest.mark.ros
def test_a_coil_whose_node_has_gone_may_be_on_until_it_is_back(start, ros, make_ros):
    other = make_ros()
    got = other.collect('std_msgs/msg/Float64', '/volts')
    driver = start.hmsa('driver', *given(
        'hardware:=topic', 'hardware.topic:=/volts', 'publish_rate:=0.0'))
    other.spin_until(lambda: got, 'the level at the start')
    send = command(ros)
    send.publish(to_command(0, 0.1, ''))
    other.spin_until(lambda: got[-1].data == 0.1, 'the level')
    other.node.destroy_subscription([*other.node.subscriptions][0])
    ros.spin_until(lambda: send.publish(to_command(0, 0.2, '')) or (
        'could NOT be switched off and may be on' in driver.output), 'the report')
    assert 'no node subscribes to /volts (std_msgs/msg/Float64)' in driver.output
    again = other.collect('std_msgs/msg/Float64', '/volts')
    other.spin_until(lambda: again, 'the level 0')
    assert again[0].data == 0.0
    assert driver.wait() == 1
    assert 'the coil is switched off at last' in driver.output


@pytest.mark.ros
def test_a_recorder_of_the_topic_is_no_node_that_serves_the_coil(ros, make_ros, monkeypatch):
    ros.node.create_service(Trigger, '~/split_bagfile', lambda _, response: response)
    ros.collect(FIELD, '/field')
    with monkeypatch.context() as patched:
        patched.setattr('hmsa_lab.nodes.topic_coil._PATIENCE', 1.5)
        with pytest.raises(BadInputError, match='no node subscribes to /field'):
            load('topic', 'left', {'topic': '/field'})
    server = make_ros(namespace='/bench')
    server.collect(FIELD, '/field')
    coil = load('topic', 'left', {'topic': '/field'})
    coil.write(0.1, 0)
    server.node.destroy_subscription([*server.node.subscriptions][0])
    with pytest.raises(HmsaError, match='no node subscribes to /field'):
        ros.spin_until(lambda: coil.write(0.1, 0) and None, 'the loss')
    coil.close()


BAD = (
    ({'topic': ''}, "hardware.topic is '': expected text"),
    ({'topic': 5}, 'hardware.topic is 5: expected text'),
    ({'topic': '/poses', 'field': 'header'}, 'no field that takes a level'),
    ({'topic': '/poses', 'field': 'header.stamp.sec'}, 'no field that takes a level'),
    ({'topic': '/poses', 'field': 'vector.w'}, 'no w there: expected one of x, y, z'),
    ({'topic': '/coils', 'field': 'layout.data_offset'}, 'no field that takes a level'),
    ({'topic': '/coils', 'field': 'data'}, 'no field that takes a level'),
    ({'topic': '/coils', 'field': 'data[99999]'}, 'no field that takes a level'),
    ({'topic': '/coils', 'field': 'data[0][1]'}, 'no field that takes a level'),
    ({'topic': '/coils', 'field': 'data['}, 'expected names of fields'),
    ({'topic': '/coils', 'direction': [0, 0, 1]}, 'hardware.field is a number'),
    ({'topic': '/coils', 'size': -1}, 'hardware.size is -1: expected a whole number'),
    ({'topic': '/coils', 'size': float('nan')}, 'hardware.size is nan'),
    ({'topic': '/poses', 'direction': [1, 1, 0]}, r'such as \[0.707107, 0.707107, 0.0\]'),
    ({'topic': '/poses', 'direction': [0, 0, 0]}, 'of a vector of length 1$'),
    ({'topic': '/poses', 'direction': [0, 1]}, 'of a vector of length 1$'),
    ({'topic': '/poses', 'direction': [float('nan'), 0, 1]}, 'of a vector of length 1$'),
    ({'topic': '/poses', 'direction': 'z'}, 'of a vector of length 1$'),
    ({'topic': '/poses', 'type': 'no_msgs/msg/None'}, 'no_msgs/msg/None is not installed'),
    ({'topic': '/poses', 'gain': 2}, 'gain is no setting'))


@pytest.mark.ros
def test_a_field_that_takes_no_level_is_refused(ros, monkeypatch):
    monkeypatch.setattr('hmsa_lab.nodes.topic_coil._BARE', 0.2)
    ros.collect(VECTOR, '/poses')
    ros.collect(ARRAY, '/coils')
    for settings, text in BAD:
        with pytest.raises(BadInputError, match=text):
            load('topic', 'left', settings)


@pytest.mark.ros
def test_a_topic_that_nobody_subscribes_to_and_a_field_of_two_joints_are_refused(
        ros, monkeypatch):
    ros.collect(ARRAY, '/coils')
    left = load('topic', 'left', {'topic': '/coils'})
    with pytest.raises(BadInputError, match="'data.0.' for joints left and right"):
        load('topic', 'right', {'topic': '/coils'})
    left.close()
    monkeypatch.setattr('hmsa_lab.nodes.topic_coil._PATIENCE', 0.2)
    # Another type under the same name reaches nobody.
    for settings in ({'topic': '/nowhere'}, {'topic': '/coils', 'type': VECTOR}):
        with pytest.raises(BadInputError, match='no node subscribes to'):
            load('topic', 'left', settings)
