"""Messages become records and records messages, and nothing is lost on the way."""

import math

from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticStatus
from hypothesis import given
from hypothesis import strategies as st
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hmsa_ros.core.parameters import paper_actuator
from hmsa_ros.core.planner import Options, Planner
from hmsa_ros.core.status import Code, RefusedError
from hmsa_ros.errors import BadInputError
from hmsa_ros.nodes import conversions

SECOND = 10**9
# What the fields of a stamp can hold, in ns.
STAMPS = st.integers(-2**31 * SECOND, 2**31 * SECOND - 1)
FROM_THE_EPOCH = st.integers(0, 2**31 * SECOND - 1)
FINITE = st.floats(allow_nan=False, allow_infinity=False)
NAMES = st.text(st.characters(codec='utf-8', exclude_characters='\0'))
POINTS = st.lists(st.tuples(FINITE, STAMPS), max_size=5)


def sent(message):
    """Return a message as it arrives."""
    return deserialize_message(serialize_message(message), type(message))


@pytest.mark.parametrize(('text', 'number'), [
    ('12', 12), ('0', 0), ('', 0), (None, 0), ('-1', 0), ('1.5', 0), ('one', 0), ('\u00b2', 0),
    ('9' * 5000, 0)])
def test_a_status_of_anybody_tells_a_whole_number_or_none(text, number):
    assert conversions.whole(text) == number


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


@given(POINTS, NAMES, STAMPS, NAMES)
def test_trajectory_survives_the_round_trip(points, joint, stamp, frame):
    message = sent(conversions.to_trajectory(points, joint, stamp=stamp, frame=frame))
    assert message.header.frame_id == frame
    assert conversions.from_trajectory(message, joint) == (points, stamp or None)


@given(POINTS, st.lists(NAMES, min_size=2, max_size=4, unique=True))
def test_a_stretch_is_that_of_all_joints_unless_there_is_one_for_each(points, joints):
    found, _ = conversions.from_trajectories(
        sent(conversions.to_trajectory(points, joints)), joints)
    assert found == dict.fromkeys(joints, points)
    own = {x: [(stretch + i, time) for stretch, time in points] for i, x in enumerate(joints)}
    each = [([own[x][k][0] for x in joints], time) for k, (_, time) in enumerate(points)]
    found, _ = conversions.from_trajectories(
        sent(conversions.to_trajectory(each, joints)), joints)
    assert found == own


@given(st.lists(NAMES, max_size=3), NAMES)
def test_trajectory_is_read_only_for_the_one_joint(names, joint):
    message = JointTrajectory(
        joint_names=names, points=[JointTrajectoryPoint(positions=[1.1])])
    if names == [joint]:
        assert conversions.from_trajectory(message, joint) == ([(1.1, 0)], None)
    else:
        with pytest.raises(RefusedError, match='joint_names is') as caught:
            conversions.from_trajectory(message, joint)
        assert caught.value.code is Code.UNKNOWN_JOINT


@pytest.mark.parametrize('joints', [('actuator',), ('left', 'right')])
@pytest.mark.parametrize('message', [
    JointTrajectory(joint_names=['a' * 4096] * 50),
    JointTrajectory(joint_names=['actuator'], points=[
        JointTrajectoryPoint(positions=[1.1], velocities=[0.1] * 5000)]),
    JointTrajectory(joint_names=['left', 'right'], points=[
        JointTrajectoryPoint(positions=[1.1, 1.1], effort=[0.1] * 5000)])])
def test_a_refusal_does_not_repeat_all_that_was_sent(message, joints):
    with pytest.raises(RefusedError) as caught:
        conversions.from_trajectories(message, joints)
    assert len(str(caught.value)) < 500


@given(st.lists(st.floats(), max_size=3))
def test_point_has_one_position(positions):
    message = JointTrajectory(
        joint_names=['a'], points=[JointTrajectoryPoint(positions=positions)])
    if len(positions) == 1:
        # Whether it is finite and in range is the planner's to say.
        (stretch, time), = conversions.from_trajectory(message, 'a')[0]
        assert time == 0
        assert stretch == positions[0] or math.isnan(stretch)
    else:
        with pytest.raises(RefusedError, match=f'has {len(positions)} positions') as caught:
            conversions.from_trajectory(message, 'a')
        assert caught.value.code is Code.BAD_INPUT


@pytest.mark.parametrize('name', ['velocities', 'accelerations', 'effort'])
@given(values=st.lists(st.floats(), max_size=3))
def test_point_asks_for_neither_motion_nor_effort(name, values):
    message = conversions.to_trajectory([(1.1, SECOND), (1.2, 2 * SECOND)], 'a')
    setattr(message.points[1], name, values)
    if values in ([], [0.0]):
        assert len(conversions.from_trajectory(message, 'a')[0]) == 2
    else:
        with pytest.raises(RefusedError, match=f'point 1 has {name}') as caught:
            conversions.from_trajectory(message, 'a')
        assert caught.value.code is Code.BAD_INPUT


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
    message = sent(conversions.to_plan(plan, 'knee'))
    ahead = [x for x in plan.levels if x.stamp >= 0]
    start = conversions.from_time(message.header.stamp)
    assert message.joint_names == ['knee']
    assert start == ahead[0].stamp == now + 50_000_000
    assert [
        (start + conversions.from_time(x.time_from_start), *x.positions, *x.velocities, *x.effort)
        for x in message.points] == [
        (x.stamp, x.stretch, x.rate, x.flux_density) for x in ahead]


def test_plan_without_requests_is_empty():
    message = conversions.to_plan(Planner(paper_actuator(), Options()).plan, 'knee')
    assert (message.joint_names, message.points) == (['knee'], [])


@given(
    NAMES, NAMES, st.sampled_from([b'\0', b'\1', b'\2']), NAMES,
    st.dictionaries(NAMES, st.one_of(st.integers(), FINITE, NAMES), max_size=4))
def test_status_has_name_joint_level_message_and_values(name, joint, level, message, values):
    status = sent(conversions.to_status(name, joint, level, message, values))
    assert (status.name, status.hardware_id, status.message) == (name, joint, message)
    assert status.level == level
    assert {x.key: x.value for x in status.values} == {x: str(y) for x, y in values.items()}


@given(STAMPS, st.integers(0, 3))
def test_diagnostics_have_their_statuses_and_stamp(stamp, count):
    statuses = [
        conversions.to_status(f'status {k}', '', DiagnosticStatus.OK, '', {})
        for k in range(count)]
    message = sent(conversions.to_diagnostics(stamp, *statuses))
    assert conversions.from_time(message.header.stamp) == stamp
    assert message.status == statuses
