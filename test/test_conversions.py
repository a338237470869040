"""Conversion of messages to records and back, without loss."""

from contextlib import suppress
from dataclasses import replace
import math

from builtin_interfaces.msg import Duration, Time
from hypothesis import example, given
from hypothesis import strategies as st
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hmsa.errors import BadInputError
from hmsa.interfaces.diagnostics import StatusVerdict, whole
from hmsa.judge.records import Finding, missed, RequestedSetpoint, unobserved
from hmsa.model.parameters import paper_actuator
from hmsa.model.status import Code, RefusedError
from hmsa.planning.group import PlannerGroup, Progress
from hmsa.planning.planner import Options, Planner
from hmsa_ros.nodes import conversions
from hmsa_ros.nodes.cdr import read_trajectory
from hmsa_ros.runtime import records

SECOND = 10**9
# What the fields of a stamp can hold, in ns.
STAMPS = st.integers(-2**31 * SECOND, 2**31 * SECOND - 1)
FROM_THE_EPOCH = st.integers(0, 2**31 * SECOND - 1)
FINITE = st.floats(allow_nan=False, allow_infinity=False)
NAMES = st.text(st.characters(codec='utf-8', exclude_characters='\0'))
POINTS = st.lists(st.tuples(FINITE, STAMPS), max_size=5)


def sent(message):
    """Return a message as received."""
    return deserialize_message(serialize_message(message), type(message))


@pytest.mark.parametrize(('text', 'number'), [
    ('12', 12), ('0', 0), ('', 0), (None, 0), ('-1', 0), ('1.5', 0), ('one', 0), ('\u00b2', 0),
    ('9' * 5000, 0)])
def test_a_status_of_anybody_tells_a_whole_number_or_none(text, number):
    assert whole(text) == number


@given(STAMPS)
def test_stamp_survives_the_round_trip(stamp):
    message = sent(conversions.to_time(stamp))
    assert isinstance(message, Time)
    assert 0 <= message.nanosec < SECOND
    assert conversions.from_time(message) == stamp


@given(st.integers(-2**31, 2**31 - 1), st.integers(0, SECOND - 1))
def test_duration_is_read_in_nanoseconds(sec, nanosec):
    assert conversions.from_time(Duration(sec=sec, nanosec=nanosec)) == sec * SECOND + nanosec


@given(FROM_THE_EPOCH)
def test_clock_message_has_the_time(stamp):
    assert conversions.from_time(sent(conversions.to_clock(stamp)).clock) == stamp


@given(FROM_THE_EPOCH, FINITE, NAMES)
def test_command_survives_the_round_trip(stamp, flux_density, frame):
    message = sent(conversions.to_command(stamp, flux_density, frame))
    assert message.header.frame_id == frame
    assert (message.magnetic_field.x, message.magnetic_field.y) == (0.0, 0.0)
    assert not any(message.magnetic_field_covariance)
    assert conversions.from_command(message) == (stamp, flux_density)


@given(st.floats(), st.floats(), st.floats(), STAMPS)
def test_command_is_read_only_if_finite_along_z_and_after_the_epoch(x, y, z, stamp):
    message = conversions.to_command(stamp, 0.0, '')
    field = message.magnetic_field
    field.x, field.y, field.z = x, y, z
    if math.isfinite(z) and x == y == 0.0 and stamp >= 0:
        assert conversions.from_command(message) == (stamp, z)
    else:
        with pytest.raises(BadInputError, match='^flux density command .*: expected'):
            conversions.from_command(message)


def read(message):
    """Return a received trajectory as read, and its points."""
    request = read_trajectory(serialize_message(message))
    found = list(request.points)
    # Anew, as where they are planned again.
    assert str(list(request.points)) == str(found)  # NaN included
    return request, found


@given(POINTS, NAMES, STAMPS, NAMES)
def test_trajectory_survives_the_round_trip(points, joint, stamp, frame):
    request, found = read(conversions.to_trajectory(points, joint, stamp=stamp, frame=frame))
    assert (request.name, request.joints, request.count) == (frame, (joint,), len(points))
    assert request.stamp == (stamp or None)
    assert found == [((stretch,), time) for stretch, time in points]


@given(POINTS, st.lists(NAMES, min_size=2, max_size=4, unique=True))
def test_a_stretch_is_that_of_all_joints_unless_there_is_one_for_each(points, joints):
    request, found = read(conversions.to_trajectory(points, joints))
    assert request.joints == tuple(joints)
    assert found == [((stretch,) * len(joints), time) for stretch, time in points]
    each = [([x + i for i in range(len(joints))], time) for x, time in points]
    assert read(conversions.to_trajectory(each, joints))[1] == [(tuple(x), t) for x, t in each]


@given(st.lists(st.floats(), max_size=3))
@example([math.nan])
def test_point_has_one_position_for_each_joint(positions):
    message = JointTrajectory(
        joint_names=['a'], points=[JointTrajectoryPoint(positions=positions)])
    if len(positions) == 1:
        # Whether it is finite and in range is the planner's to say.
        (stretch,), time = read(message)[1][0]
        assert time == 0
        assert stretch == positions[0] or math.isnan(stretch)
    else:
        with pytest.raises(RefusedError, match=f'has {len(positions)} positions') as caught:
            read(message)
        assert caught.value.code is Code.BAD_INPUT


@pytest.mark.parametrize('name', ['velocities', 'accelerations', 'effort'])
@given(values=st.lists(st.floats(), max_size=3))
def test_point_asks_for_neither_motion_nor_effort(name, values):
    message = conversions.to_trajectory([(1.1, SECOND), (1.2, 2 * SECOND)], 'a')
    setattr(message.points[1], name, values)
    if values in ([], [0.0]):
        assert len(read(message)[1]) == 2
    else:
        with pytest.raises(RefusedError, match=f'point 1 has {name}') as caught:
            read(message)
        assert caught.value.code is Code.BAD_INPUT


def test_points_of_a_path_have_rates_and_perhaps_accelerations():
    message = conversions.to_trajectory(
        [((1.1, 1.2), SECOND), ((1.2, 1.3), 2 * SECOND)], ['a', 'b'])
    assert read(message)[0].path is None
    for point in message.points:
        point.velocities = [0.1, 0.2]
    (first, time), _ = read_trajectory(serialize_message(message)).path
    assert [x[:2] for x in first] == [(1.1, 0.1), (1.2, 0.2)]
    assert (time, [math.isnan(x[2]) for x in first]) == (SECOND, [True, True])
    message.points[1].accelerations = [1.0, 2.0]
    _, (last, _) = read_trajectory(serialize_message(message)).path
    assert last == [(1.2, 0.1, 1.0), (1.3, 0.2, 2.0)]
    for name, values, words in (
            ('velocities', [0.1], 'point 1 has 1 velocities: expected 2'),
            ('accelerations', [1.0], 'accelerations of all joints or none'),
            ('effort', [1.0, 0.0], 'and no effort')):
        broken = deserialize_message(serialize_message(message), type(message))
        setattr(broken.points[1], name, values)
        with pytest.raises(RefusedError, match=words):
            list(read_trajectory(serialize_message(broken)).path)
        # At rest, all of it says what would follow it.
        with pytest.raises(RefusedError, match='trajectory_mode set to path'):
            read(broken)


@given(st.integers(0, 200), st.binary(min_size=1, max_size=8))
def test_trajectory_that_is_damaged_is_read_or_refused(place, damage):
    data = bytearray(serialize_message(conversions.to_trajectory(
        [(1.1, SECOND), (1.2, 2 * SECOND)], ['left', 'right'])))
    for broken in (data[:place], data[:place] + damage + data[place + len(damage):]):
        # Whatever it is: no other error, and not for long.
        with suppress(BadInputError):
            assert len(list(read_trajectory(bytes(broken)).points)) <= 2


def test_points_are_read_no_sooner_than_they_are_asked_for():
    message = conversions.to_trajectory([(1.1, k * SECOND) for k in range(1000)], 'a')
    data = serialize_message(message)
    request = read_trajectory(data)
    assert request.count == 1000
    assert next(iter(request.points)) == ((1.1,), 0)
    # The number of points is believed only as far as the message is long enough for it.
    with pytest.raises(BadInputError, match='ends too early'):
        read_trajectory(data[:len(data) // 2])


@given(st.lists(
    st.tuples(st.floats(0.6, 1.8), st.integers(60_000_000, 10 * SECOND)), min_size=1,
    max_size=4), st.integers(SECOND, 2**30 * SECOND))
def test_plan_shows_each_change_of_level_that_is_ahead(setpoints, now):
    planner = Planner(paper_actuator(), Options())
    points = []
    end = 0
    for stretch, span in setpoints:
        end += span
        points.append((stretch, end))
    plan = planner.request(points, None, now)
    group = PlannerGroup({'knee': planner})
    message = sent(conversions.to_plan(*group.preview(now, 100)))
    ahead = [x for x in plan.levels if x.stamp >= 0]
    start = conversions.from_time(message.header.stamp)
    assert message.joint_names == ['knee']
    assert start == ahead[0].stamp == now + 50_000_000
    assert [
        (start + conversions.from_time(x.time_from_start), *x.positions, *x.velocities, *x.effort)
        for x in message.points] == [
        (x.stamp, x.stretch, x.rate, x.flux_density) for x in ahead]


def test_plan_without_requests_is_empty():
    group = PlannerGroup({'knee': Planner(paper_actuator(), Options())})
    message = conversions.to_plan(*group.preview(0, 100))
    assert (message.joint_names, message.points) == (['knee'], [])


@given(
    NAMES, NAMES, st.integers(0, 2), NAMES,
    st.dictionaries(NAMES, st.one_of(st.integers(), FINITE, NAMES), max_size=4))
def test_status_has_name_joint_level_message_and_values(name, joint, level, message, values):
    status = sent(conversions.to_status(name, joint, level, message, values))
    assert (status.name, status.hardware_id, status.message) == (name, joint, message)
    assert status.level[0] == level
    assert {x.key: x.value for x in status.values} == {x: str(y) for x, y in values.items()}


@given(STAMPS, st.integers(0, 3))
def test_diagnostics_have_their_statuses_and_stamp(stamp, count):
    statuses = [
        conversions.to_status(f'status {k}', '', 0, '', {})
        for k in range(count)]
    message = sent(conversions.to_diagnostics(stamp, *statuses))
    assert conversions.from_time(message.header.stamp) == stamp
    assert message.status == statuses


SETPOINT = RequestedSetpoint(1.4, 1.2, 0, SECOND, 2 * SECOND, 500.0, number=2, count=3)
ARRIVED = Finding(Code.ARRIVED, 'rests', SETPOINT, 100, 1e-3, 1e-5, 2e-3, 1e-5, 80.0, 1e-4)


@pytest.mark.parametrize(('code', 'severity', 'finding', 'measuring', 'failure'), [
    ('arrived', 0, ARRIVED, True, ''), ('replanned', 1, ARRIVED, True, ''),
    ('accepted', 0, None, False, ''), ('unobserved', 0, unobserved(SETPOINT), False, ''),
    ('too_damped', 1, unobserved(SETPOINT), False, ''),
    ('unobserved', 1, unobserved(SETPOINT), True, 'setpoint 2 of 3: 1.4 is predicted'),
    ('replanned', 1, unobserved(SETPOINT), False, 'a sentence; the result is not measured'),
    ('late', 1, None, False, 'a sentence; the result is not measured'),
    ('stopped', 2, ARRIVED, True, 'a sentence'),
    ('missed', 1, missed(SETPOINT, 'left out'), True, 'setpoint 2 of 3: 1.4 was missed: left')])
def test_only_what_arrived_or_nobody_measures_is_no_failure(
        code, severity, finding, measuring, failure):
    progress = Progress('at_rest', 3, 3, '1.4')
    status = sent(conversions.to_planner_status(records.StatusChanged(
        records.Verdict(records.Severity(severity), code, 'a sentence', 'x'), progress,
        {'a': progress}, 1, 0, 0, {} if finding is None else {'a': finding}, finding,
        measuring=measuring)))
    read = StatusVerdict.read(status)
    assert read.failure.startswith(failure)
    assert bool(read.failure) == bool(failure)
    values = {x.key: x.value for x in status.values}
    if finding is ARRIVED:
        assert (values['measured'], values['measured_setpoint'], values['worst']) == (
            'arrived', '2', 'arrived')
        assert (values['offset'], values['offset_percent']) == ('0.001', '0.5')
        assert (values['vibration'], values['vibration_percent']) == ('0.002', '1')
        assert read.basis == 'measured'
        assert read.figures == ARRIVED.to_dict()


@pytest.mark.parametrize(('newest', 'failure'), [
    (replace(ARRIVED, setpoint=replace(SETPOINT, number=3)), ''),
    (missed(replace(SETPOINT, number=3), 'left out'), 'setpoint 3 of 3: missed')])
def test_an_unchanged_plan_is_judged_by_its_last_setpoint(newest, failure):
    progress, worst = Progress('at_rest', 3, 3, '1.4'), missed(SETPOINT, 'left out')
    read = StatusVerdict.read(sent(conversions.to_planner_status(records.StatusChanged(
        records.Verdict(records.Severity.WARN, worst.verdict, 'a sentence', 'x'), progress,
        {'a': progress, 'b': progress}, 1, 0, 0, {'a': newest, 'b': worst}, worst,
        measuring=True))))
    assert 'setpoint 2 of 3' in read.failure
    assert read.of_last(['a']).failure == failure
    assert read.of_last(['b']).failure == 'setpoint 2 of 3: missed'
