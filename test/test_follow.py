"""The action FollowJointTrajectory over ROS, with and without its messages."""

import importlib.util

import pytest
from rclpy.action import ActionClient
from rclpy.duration import Duration
from std_srvs.srv import Trigger
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)

from hmsa.interfaces import topics
from hmsa_ros.nodes import ros_entities
from hmsa_ros.runtime.goals import ErrorCode

pytestmark = pytest.mark.ros
INSTALLED = importlib.util.find_spec('control_msgs') is not None
with_messages = pytest.mark.skipif(
    not INSTALLED, reason='control_msgs is not installed: make actions builds it')
# As in action_msgs/msg/GoalStatus.
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
ARRIVED = SUCCEEDED, ErrorCode.SUCCESSFUL
# A second, since a machine under load may deliver a command late.
LEAD = ('-p', 'lead_time:=1.0')
JOINTS = ('left', 'right')
OF_JOINTS = ('-p', f'joints:=[{", ".join(JOINTS)}]')
LONG = ((1.1, 0.0, 0.0), (1.4, 0.0, 5.0))


@pytest.mark.skipif(INSTALLED, reason='control_msgs is installed')
def test_without_its_messages_there_is_no_action_and_one_line_says_so(start, ros):
    planner = start.hmsa('planner')
    planner.wait_for_output('no action ~/follow_joint_trajectory')

    def served():
        return [x for x, _ in ros.node.get_service_names_and_types()]

    ros.spin_until(lambda: '/planner/stop' in served(), 'the planner')
    assert not [x for x in served() if '_action' in x]
    assert not ros.node.count_publishers('/planner/controller_state')
    assert planner.stop() == 0
    assert planner.output.count('control_msgs') == 1


class Client:
    """A client of the action, as MoveIt is one."""

    def __init__(self, ros, space='', joints=('actuator',)):
        self.ros, self.joints = ros, list(joints)
        self.planner = f'{space}/planner'
        self.action = ros_entities.interface_class(topics.FOLLOW.type)
        self._client = ActionClient(
            ros.node, self.action, f'{self.planner}/follow_joint_trajectory')
        ros.spin_until(self._client.server_is_ready, 'the action')
        self.feedback = []

    def answer(self, future):
        return self.ros.spin_until(future.done, 'an answer') and future.result()

    def send(self, *points, joints=None, **others):
        """Send a goal of points: stretch of all joints or of each, rate or None, and time."""
        names = self.joints if joints is None else joints

        def each(value):
            return list(value) if isinstance(value, tuple) else [value] * len(names)

        goal = self.action.Goal(trajectory=JointTrajectory(joint_names=names, points=[
            JointTrajectoryPoint(
                positions=each(x), time_from_start=Duration(seconds=t).to_msg(),
                velocities=[] if v is None else each(v)) for x, v, t in points]), **others)
        return self.answer(self._client.send_goal_async(
            goal, feedback_callback=lambda x: self.feedback.append(x.feedback)))

    def result(self, handle):
        return self.answer(handle.get_result_async())

    def ended(self, handle):
        """Return status and error code of a goal's result."""
        found = self.result(handle)
        print(found.result.error_string)
        return found.status, found.result.error_code

    def tolerance(self, **values):
        return ros_entities.interface_class('control_msgs/msg/JointTolerance')(
            **{'name': self.joints[-1], **values})

    def close(self):
        self._client.destroy()


@pytest.fixture
def client(ros):
    clients = []

    def make(*arguments, **named):
        clients.append(Client(ros, *arguments, **named))
        return clients[-1]

    yield make
    for one in clients:
        one.close()


@pytest.fixture
def nodes(start):
    """Return a starter of planner and plant, which do not wait for each other as threads do."""
    def start_nodes(*arguments):
        # Several plants run at once: at less than the default rate, each needs less of a core.
        start.hmsa('plant', '--ros-args', *LEAD, *arguments, '-p', 'publish_rate:=200.0')
        start.hmsa('planner', '--ros-args', *LEAD, *arguments)
    return start_nodes


@with_messages
def test_a_client_has_goals_carried_out_canceled_preempted_and_rejected(nodes, ros, client):
    nodes()
    client = client()
    states = ros.collect(topics.FOLLOW.state.type, '/planner/controller_state', 10)
    assert client.ended(client.send((1.2, None, 0.5), (1.3, None, 1.0))) == ARRIVED
    newest = client.feedback[-1]
    assert newest.actual.positions[0] == pytest.approx(1.3, abs=1e-3)
    assert newest.error.positions[0] == pytest.approx(0.0, abs=1e-3)
    assert not client.send((1.2, None, 0.5), joints=['elbow']).accepted
    assert not client.send().accepted
    # A path, whatever trajectory_mode is.
    path = (1.3, 0.0, 0.0), (1.2, -0.3, 0.5), (1.1, 0.0, 1.0)
    assert client.ended(client.send(*path)) == ARRIVED
    handle = client.send(*LONG)
    assert len(client.answer(handle.cancel_goal_async()).goals_canceling) == 1
    assert client.ended(handle) == (CANCELED, ErrorCode.SUCCESSFUL)
    first, second = client.send(*LONG), client.send((1.05, None, 0.5))
    assert client.ended(first) == (ABORTED, ErrorCode.INVALID_GOAL)
    assert client.ended(second) == ARRIVED
    ros.spin_until(lambda: states, 'a state')
    assert states[-1].joint_names == ['actuator']


@with_messages
@pytest.mark.parametrize('kind', ['component_path_tolerance', 'component_goal_tolerance'])
def test_what_a_goal_has_for_bodies_in_space_is_rejected_by_name(nodes, ros, client, kind):
    nodes()
    client = client()
    statuses = ros.collect(topics.STATUS.type, '/planner/status', 10)
    one = ros_entities.interface_class('control_msgs/msg/JointComponentTolerance')(
        joint_name='actuator', component=1, position=0.1)
    assert not client.send((1.2, None, 0.5), **{kind: [one]}).accepted
    ros.spin_until(lambda: any(kind in x.message for x in statuses), 'the reason')
    assert not client.send((1.2, None, 0.5), multi_dof_trajectory=MultiDOFJointTrajectory(
        points=[MultiDOFJointTrajectoryPoint()])).accepted
    assert not any(x.message.startswith('accepted') for x in statuses)


@with_messages
def test_each_joint_has_tolerances_of_its_own(nodes, client):
    # The right block is 20 % stiffer than its planner assumes: it stays beside each target.
    nodes(*OF_JOINTS, '-r', '__ns:=/lab', '-p', 'right.mismatch.shear_modulus:=1.2')
    client = client('/lab', joints=JOINTS)
    both = (1.2, 1.1), None, 0.5
    found = client.result(client.send(both))
    assert (found.status, found.result.error_code) == (ABORTED, ErrorCode.GOAL_TOLERANCE_VIOLATED)
    assert 'right' in found.result.error_string
    wide = client.tolerance(position=0.2, velocity=-1.0)
    assert client.ended(client.send(both, goal_tolerance=[wide])) == ARRIVED
    assert sorted(client.feedback[-1].joint_names) == sorted(JOINTS)
    narrow = client.tolerance(position=1e-3)
    found = client.result(client.send(((1.3, 1.25), None, 1.0), path_tolerance=[narrow]))
    assert (found.status, found.result.error_code) == (ABORTED, ErrorCode.PATH_TOLERANCE_VIOLATED)
    assert not client.send((1.2, None, 0.5), joints=['left']).accepted
    assert not client.send(both, goal_tolerance=[client.tolerance(name='elbow')]).accepted
    assert not client.send(both, goal_tolerance=[client.tolerance(position=-0.5)]).accepted


@with_messages
def test_whoever_takes_the_actuator_ends_the_goal(nodes, ros, client):
    nodes()
    client = client()
    handle = client.send(*LONG)
    assert ros.call(Trigger, '/planner/stop', Trigger.Request()).success
    assert client.ended(handle) == (ABORTED, ErrorCode.INVALID_GOAL)
    handle = client.send(*LONG)

    assert ros.change('planner', 'deactivate')
    assert client.ended(handle) == (ABORTED, ErrorCode.INVALID_GOAL)
    assert not client.send((1.2, None, 0.5)).accepted
    assert ros.change('planner', 'activate')
    assert client.ended(client.send((1.2, None, 0.5))) == ARRIVED


@with_messages
def test_a_controller_of_two_joints_serves_it_too(start, client):
    start.hmsa('controller', '--ros-args', *LEAD, *OF_JOINTS, '-r', '__ns:=/lab')
    client = client('/lab', joints=JOINTS)
    assert client.ended(client.send(((1.2, 1.1), None, 0.5), ((1.1, 1.3), None, 1.0))) == ARRIVED
    handle = client.send(*LONG)
    client.answer(handle.cancel_goal_async())
    assert client.ended(handle) == (CANCELED, ErrorCode.SUCCESSFUL)
