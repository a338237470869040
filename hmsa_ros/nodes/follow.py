"""
The action FollowJointTrajectory, and the state that clients of a controller read.

Requires the package control_msgs. The logic is in `hmsa_ros.runtime.goals`.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any
from uuid import uuid4

import numpy as np
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import serialize_message
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectoryPoint

from hmsa.errors import BadInputError, excerpt
from hmsa.interfaces import topics
from hmsa.planning import path
from hmsa_ros.nodes import conversions, ros_entities
from hmsa_ros.nodes.capture import RawSubscription
from hmsa_ros.nodes.cdr import JointStateReader, read_trajectory
from hmsa_ros.nodes.managed import ManagedNode
from hmsa_ros.runtime.goals import ErrorCode, GoalResult, Goals
from hmsa_ros.runtime.records import Severity, StatusChanged, Trajectory
from hmsa_ros.runtime.runtime import Runtime

# Rate of feedback and states in Hz, as for a joint_trajectory_controller.
_RATE = 20.0
# Tolerances of a multi_dof_trajectory.
_OF_COMPONENTS = ('component_path_tolerance', 'component_goal_tolerance')
# Queue length for the newest samples of several joints, each with its own publisher.
_NEWEST = 20


class FollowJointTrajectory:
    """
    Serve the action for a planner's node; ``serve`` publishes the outputs of the runtime.

    A goal is executed until the planner has judged it. No coroutine waits for that, since the
    executors of rclpy would poll it continuously.
    """

    def __init__(
            self, node: ManagedNode, runtime: Runtime, serve: Callable[[], None],
            action: Any, state: Any) -> None:
        """Create the server, which exists as long as the node and rejects goals meanwhile."""
        self._node, self._serve, self._action, self._state = node, serve, action, state
        self._reader = JointStateReader()
        self._samples: RawSubscription | None = None
        self._accepted = ''
        self._handles: dict[str, ServerGoalHandle] = {}
        # Results of goals that their clients have not received yet.
        self._outcomes: dict[str, GoalResult] = {}
        self.begin(runtime)
        path.prepare()
        self._publisher = ros_entities.publisher(node, topics.FOLLOW.state)
        node.keep(self._publisher, node.every(1.0 / _RATE, self._tick))
        self._server = ActionServer(
            node, action, topics.FOLLOW.name, lambda handle: action.Result(),
            goal_callback=self._on_goal, handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel)

    def begin(self, runtime: Runtime) -> None:
        """Serve goals for a runtime from now on."""
        self._runtime, self._goals = runtime, Goals(runtime, self._outcomes.__setitem__)

    def update(self, status: StatusChanged) -> None:
        """Process a status of the planner."""
        self._goals.update(status)

    # -- goals ---------------------------------------------------------------------------------

    def _on_goal(self, goal: Any) -> GoalResponse:
        self._accepted = name = uuid4().hex
        try:
            if goal.multi_dof_trajectory.points:
                raise BadInputError('the goal has a multi_dof_trajectory: expected a trajectory')
            for kind in _OF_COMPONENTS:
                if given := getattr(goal, kind):
                    raise BadInputError(
                        f'the goal has {kind}, of {excerpt(given[0].joint_name)}: expected none, '
                        'as a joint has a stretch and no components; use path_tolerance and '
                        'goal_tolerance')
            request = replace(read_trajectory(serialize_message(goal.trajectory)), name=name)
        except BadInputError as error:
            verdict = self._runtime.planning.refuse(error, Trajectory((), (), 0, name=name))
        else:
            path_tolerance, goal_tolerance = (
                [(x.name, x.position, x.velocity) for x in tolerances]
                for tolerances in (goal.path_tolerance, goal.goal_tolerance))
            verdict = self._goals.add(
                request, path_tolerance, goal_tolerance,
                conversions.from_time(goal.goal_time_tolerance))
        self._serve()
        return GoalResponse.REJECT if verdict.severity is Severity.ERROR else GoalResponse.ACCEPT

    def _on_accepted(self, handle: ServerGoalHandle) -> None:
        self._handles[self._accepted] = handle
        handle._update_state(rclpy_implementation.GoalEvent.EXECUTE)

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        for name, known in self._handles.items():
            if known == handle:
                self._goals.cancel(name)
        self._serve()
        return CancelResponse.ACCEPT

    # -- out -----------------------------------------------------------------------------------

    def _tick(self) -> None:
        watched = bool(self._publisher.get_subscription_count())
        if not self._runtime.active:
            for name in self._handles:
                self._outcomes.setdefault(name, GoalResult(
                    'aborted', ErrorCode.INVALID_GOAL, 'the planner was deactivated'))
            self.begin(self._runtime)
        self._listen(wanted=watched or bool(self._handles))
        now = self._node.now()
        for name, handle in self._handles.items():
            elapsed = self._goals.elapsed(name, now)
            if elapsed is not None:
                self._publish_feedback(handle, name, now, elapsed)
        if watched and self._runtime.active:
            self._publish_state(now)
        self._pass_on()

    def _listen(self, *, wanted: bool) -> None:
        """Process samples while they are needed."""
        if wanted and self._samples is None:
            self._samples = ros_entities.listen(self._node, topics.JOINT_STATES)
        if self._samples is None:
            return
        taken = self._samples.take()
        for x in taken if self._goals.wants_all else taken[-_NEWEST:]:
            with suppress(BadInputError):
                names, stamp, (stretches, rates, _) = self._reader.read(x.data)
                for name, stretch, rate in zip(names, stretches, rates, strict=True):
                    self._goals.observe(name, stamp, stretch, rate, self._node.now())
        self._serve()
        if not wanted:
            self._samples.destroy()
            self._samples = None

    def _publish_feedback(
            self, handle: ServerGoalHandle, name: str, now: int, elapsed: int) -> None:
        joints, desired, actual, error = self._points(now, name)
        for point in (desired, actual, error):
            point.time_from_start = conversions.to_duration(elapsed)
        handle.publish_feedback(self._action.Feedback(
            header=Header(stamp=conversions.to_time(now)), joint_names=joints, desired=desired,
            actual=actual, error=error))

    def _publish_state(self, now: int) -> None:
        joints, desired, actual, error = self._points(now)
        levels = [self._runtime.group.planners[x].plan.level(now).flux_density for x in joints]
        self._publisher.publish(self._state(
            header=Header(stamp=conversions.to_time(now)), joint_names=joints, reference=desired,
            feedback=actual, error=error, output=JointTrajectoryPoint(effort=levels),
            speed_scaling_factor=1.0))

    def _points(self, now: int, name: str = '') -> tuple[Any, ...]:
        """Return joint names, and desired, actual and error points."""
        found = self._goals.readings(now, name)
        desired, actual = np.moveaxis(np.array([*found.values()]), 1, 0)
        return [*found], *(
            JointTrajectoryPoint(positions=x[:, 0].tolist(), velocities=x[:, 1].tolist())
            for x in (desired, actual, desired - actual))

    def _pass_on(self) -> None:
        """Send clients the results of their goals."""
        for name, outcome in self._outcomes.items():
            handle = self._handles.pop(name, None)
            if handle is None:
                # The client had disappeared before the goal was accepted.
                continue
            if outcome.state == 'succeeded':
                handle.succeed()
            elif outcome.state == 'canceled' and handle.is_cancel_requested:
                handle.canceled()
            else:
                handle.abort()
            result = self._action.Result(
                error_code=int(outcome.code), error_string=outcome.message)
            self._server.notify_execute(handle, lambda _, result=result: result)
        self._outcomes.clear()
