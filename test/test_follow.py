"""The action FollowJointTrajectory over ROS, with and without its messages."""

import importlib.util

import pytest
from rclpy.action import ActionClient
from rclpy.duration import Duration
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hmsa.interfaces import topics
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.planner import PlannerNode
from hmsa_ros.nodes.plant import PlantNode
from hmsa_ros.runtime.goals import ErrorCode

pytestmark = pytest.mark.ros
INSTALLED = importlib.util.find_spec('control_msgs') is not None
# As in action_msgs/msg/GoalStatus.
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6


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


@pytest.mark.skipif(not INSTALLED, reason='control_msgs is not installed')
def test_a_client_has_goals_carried_out_canceled_preempted_and_rejected(serve, ros):
    serve(PlannerNode, PlantNode, '-p', 'lead_time:=1.0')
    action = ros_entities.interface_class(topics.FOLLOW.type)
    client = ActionClient(ros.node, action, '/planner/follow_joint_trajectory')
    ros.spin_until(client.server_is_ready, 'the action')
    states = ros.collect(topics.FOLLOW.state.type, '/planner/controller_state', 10)
    feedback = []

    def answer(future):
        return ros.spin_until(future.done, 'an answer') and future.result()

    def send(*points, joint='actuator'):
        return answer(client.send_goal_async(
            action.Goal(trajectory=JointTrajectory(joint_names=[joint], points=[
                JointTrajectoryPoint(
                    positions=[x], time_from_start=Duration(seconds=t).to_msg(),
                    velocities=[] if v is None else [v]) for x, v, t in points])),
            feedback_callback=lambda x: feedback.append(x.feedback)))

    def ended(handle):
        found = answer(handle.get_result_async())
        return found.status, found.result.error_code

    assert ended(send((1.2, None, 0.5), (1.3, None, 1.0))) == (SUCCEEDED, ErrorCode.SUCCESSFUL)
    assert feedback[-1].actual.positions[0] == pytest.approx(1.3, abs=1e-3)
    assert feedback[-1].error.positions[0] == pytest.approx(0.0, abs=1e-3)
    assert not send((1.2, None, 0.5), joint='elbow').accepted
    # A path, whatever trajectory_mode is.
    path = (1.3, 0.0, 0.0), (1.2, -0.3, 0.5), (1.1, 0.0, 1.0)
    assert ended(send(*path)) == (SUCCEEDED, ErrorCode.SUCCESSFUL)
    handle = send((1.1, 0.0, 0.0), (1.4, 0.0, 5.0))
    assert len(answer(handle.cancel_goal_async()).goals_canceling) == 1
    assert ended(handle) == (CANCELED, ErrorCode.SUCCESSFUL)
    first, second = send((1.1, 0.0, 0.0), (1.4, 0.0, 5.0)), send((1.05, None, 0.5))
    assert ended(first) == (ABORTED, ErrorCode.INVALID_GOAL)
    assert ended(second) == (SUCCEEDED, ErrorCode.SUCCESSFUL)
    ros.spin_until(lambda: states, 'a state')
    assert states[-1].joint_names == ['actuator']
    client.destroy()
