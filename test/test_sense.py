"""Stretch from the messages of sensors in other packages."""

import numpy as np
import pytest

from hmsa.errors import BadInputError
from hmsa_lab.nodes.sense import reader, Readings
from hmsa_ros.nodes.ros_entities import interface_class

START, MS = 1_700_000_000 * 10**9, 1_000_000
POSE, STATES = 'geometry_msgs/msg/PoseStamped', 'sensor_msgs/msg/JointState'


def one(x):
    return np.array([float(x)])


def test_readings_are_given_out_in_order_and_those_that_come_later_are_counted():
    readings = Readings(10)
    for now, stamp in enumerate((103, 101, 102)):
        readings.take(stamp, one(stamp), now)
    assert readings.due(9) == []
    # The one that came first, and those before it.
    assert readings.due(10) == [(101, 101.0), (102, 102.0), (103, 103.0)]
    for stamp in (99, 103):
        readings.take(stamp, one(stamp), 11)
    assert (readings.due(100), readings.late, readings.count) == ([], 2, 5)


def test_the_distance_counts_from_the_reference_at_the_same_time():
    readings = Readings(reference=True)
    readings.take(5, one(0), 0)
    # Before the reference is seen there is nothing to report.
    assert readings.due(0) == []
    readings.take_reference(20, np.array([2.0, 0.0, 0.0]))
    readings.take_reference(10, np.array([1.0, 0.0, 0.0]))
    for stamp in (15, 40):
        readings.take(stamp, np.array([1.5, 3.0, 4.0]), 0)
    assert readings.due(0) == [(15, 5.0), (40, pytest.approx(np.sqrt(25.25), rel=1e-15))]


def test_a_reference_may_be_as_long_as_it_likes():
    readings = Readings(reference=True)
    for stamp in range(1, 3000):
        readings.take_reference(stamp, one(stamp))
    readings.take(2500, one(2501), 0)
    assert readings.due(0) == [(2500, 1.0)]


def filled(kind):
    """Return a message whose reading has the fields 1, 2, 3."""
    message = interface_class(kind)()
    if kind == STATES:
        message.name, message.position = ['a', 'b'], [1.0, 2.0]
    else:
        message.header.stamp.nanosec = 5
        for axis, x in zip('xyz', (1.0, 2.0, 3.0), strict=True):
            setattr(message.pose.position, axis, x)
    return message


@pytest.mark.parametrize(('kind', 'path', 'element', 'stamp', 'expected'), [
    (POSE, '', '', 5, (1.0, 2.0, 3.0)), (POSE, 'pose.position.y', '', 5, (2.0,)),
    (STATES, '', 'b', 0, (2.0,)), (STATES, 'position[0]', '', 0, None)])
def test_a_field_is_found_by_its_path(kind, path, element, stamp, expected):
    if expected is None:
        with pytest.raises(BadInputError, match='expected the name of the joint'):
            reader(kind, interface_class(kind), path, element)
        return
    header, found = reader(kind, interface_class(kind), path, element)(filled(kind))
    assert (header.nanosec, tuple(found)) == (stamp, expected)


@pytest.mark.parametrize(('kind', 'path', 'element', 'text'), [
    ('std_msgs/msg/String', '', '', 'field is empty'),
    ('std_msgs/msg/String', 'data', '', 'of a std_msgs/msg/String a str'),
    (POSE, 'pose..z', '', 'expected names of fields'),
    (POSE, 'pose.position.q', '', 'no q there: expected one of x, y, z'),
    (POSE, 'pose.position.z.u', '', 'expected nothing after a number'),
    (POSE, 'pose.orientation', '', 'expected a number, a point or a vector'),
    (POSE, '', 'tip', 'expected none')])
def test_a_field_that_does_not_exist_is_refused(kind, path, element, text):
    with pytest.raises(BadInputError, match=text):
        reader(kind, interface_class(kind), path, element)


@pytest.mark.ros
def test_two_poses_become_the_stretch_between_them(ros, start):
    tip, base = (ros.node.create_publisher(interface_class(POSE), x, 10) for x in ('tip', 'base'))
    got = ros.collect(interface_class(STATES), '/joint_states')
    start.hmsa('sense', '--ros-args', *(word for x in (
        'topic:=tip', 'reference.topic:=base', 'sensor.rest_length:=0.02', 'joint:=left',
        'sensor.latency:=0.002', 'reorder_time:=0.01') for word in ('-p', x)))

    def published():
        for publisher, height in ((base, 0.1), (tip, 0.124)):
            message = interface_class(POSE)()
            message.pose.position.z = height
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(START, 10**9)
            publisher.publish(message)
        return got
    ros.spin_until(published, 'a sample')
    sample = got[0]
    assert list(sample.name) == ['left']
    assert sample.position[0] == pytest.approx(1.2, rel=1e-12)
    assert sample.header.stamp.sec * 10**9 + sample.header.stamp.nanosec == START - 2 * MS
    # Each timestamp counts once.
    assert len(got) == 1


@pytest.mark.ros
def test_millimetres_without_the_length_at_rest_are_no_stretch(ros, start):
    kind = interface_class('std_msgs/msg/Float64')
    publisher = ros.node.create_publisher(kind, 'length', 10)
    sense = start.hmsa('sense', '--ros-args', '-p', 'topic:=length')

    def said():
        publisher.publish(kind(data=21.0))
        return 'as sensor.rest_length' in sense.output
    ros.spin_until(said, 'the warning')
    assert 'a reading on /length becomes a stretch of 21: expected at most 10;' in sense.output
