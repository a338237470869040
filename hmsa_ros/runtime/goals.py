"""
Goals of the action FollowJointTrajectory: validation, progress and result.

Does not depend on ROS. Codes and semantics follow ``control_msgs`` and the
``joint_trajectory_controller`` of ros2_controllers, except that success is decided by samples.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
import math

import numpy as np

from hmsa.errors import excerpt
from hmsa.judge.records import Finding, GoalTolerances
from hmsa.judge.setpoint_samples import AHEAD
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa.planning.path import Path
from hmsa.planning.timeline import Timeline
from hmsa_ros.runtime.records import Severity, StatusChanged, Stop, Trajectory, Verdict
from hmsa_ros.runtime.runtime import Runtime

#: Joint name and its tolerances of stretch and rate (1/s): 0 for the default, -1 for none.
Tolerance = tuple[str, float, float]
#: Stretch and rate in 1/s.
Point = tuple[float, float]

_UNSEEN = (math.nan, math.nan)
# Value that disables a tolerance.
_NONE = -1.0
_REPLACED = 'another request took the place of the goal'
# Verdicts whose figures decide, since they may be those of other tolerances.
_MEASURED = (Code.ARRIVED, Code.OFF_TARGET, Code.VIBRATING)


class ErrorCode(IntEnum):
    """Result of a goal, numbered as in ``control_msgs/action/FollowJointTrajectory``."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5

    @classmethod
    def of(cls, code: Code) -> 'ErrorCode':
        """Return the action's error code for a planner's refusal."""
        return {Code.UNKNOWN_JOINT: cls.INVALID_JOINTS,
                Code.IN_THE_PAST: cls.OLD_HEADER_TIMESTAMP}.get(code, cls.INVALID_GOAL)


@dataclass(frozen=True)
class GoalResult:
    """Result of a goal: ``succeeded``, ``aborted`` or ``canceled``, and the reason."""

    state: str
    code: ErrorCode
    message: str


@dataclass
class _Goal:
    request: Trajectory
    path: Mapping[str, Point]  # tolerances during the motion, by joint
    plan: int | None = None  # number of the plan that carries it out; None until it is made
    canceled: bool = False
    begin: int = 0  # in ns, relative to the begin of the last setpoint: a clock step shifts both
    duration: int = 0  # in ns
    paths: dict[str, Path] = field(default_factory=dict)  # in s from the begin of the goal

    def dropped(self, message: str, code: ErrorCode = ErrorCode.INVALID_GOAL) -> GoalResult:
        """Return the result of a goal that is not completed."""
        if self.canceled:
            return GoalResult('canceled', ErrorCode.SUCCESSFUL, message)
        return GoalResult('aborted', code, message)

    def ended_by(self, verdict: Verdict) -> GoalResult | None:
        """Return the result if a verdict on the goal, or on the stop that cancels it, ends it."""
        if self.canceled and verdict.code is Code.UNHEARD:
            return GoalResult('aborted', ErrorCode.INVALID_GOAL, verdict.message)
        if verdict.severity is Severity.ERROR or verdict.code is Code.SUPERSEDED or (
                self.canceled and verdict.code in (Code.STOPPED, Code.VIBRATING)):
            return self.dropped(verdict.message, ErrorCode.of(verdict.code))
        return None


class Goals:
    """
    The goals of a planner, of which one is carried out.

    The caller passes statuses to `update` and samples to `observe`; ``ended`` is called with the
    name of a goal and its `GoalResult`.
    """

    def __init__(
            self, runtime: Runtime, ended: Callable[[str, GoalResult], None]) -> None:
        self._runtime, self._ended = runtime, ended
        self._goals: dict[str, _Goal] = {}
        self._seen: dict[str, tuple[int, Point]] = {}

    def add(
            self, request: Trajectory, path_tolerance: Sequence[Tolerance] = (),
            goal_tolerance: Sequence[Tolerance] = (), goal_time_tolerance: int = 0) -> Verdict:
        """
        Add a goal, named by its request; a refused goal has no other effect.

        The time tolerance is in ns.
        """
        try:
            if request.raw:
                raise RefusedError(
                    Code.BAD_INPUT,
                    'the points of the goal have effort alone: expected positions')
            if not request.count:
                raise RefusedError(
                    Code.BAD_INPUT,
                    'the goal has no points: expected some; to stop, cancel the goal, or call '
                    '~/stop')
            if goal_time_tolerance < 0:
                raise RefusedError(
                    Code.BAD_INPUT, f'goal_time_tolerance is '
                    f'{goal_time_tolerance / NANOSECONDS:g} s: expected at least 0 s')
            path = _tolerances('path_tolerance', path_tolerance, request.joints)
            end = _tolerances('goal_tolerance', goal_tolerance, request.joints)
        except RefusedError as error:
            return self._runtime.planning.refuse(error, request)
        goals = {}
        for joint in request.joints:
            position, rate = end.get(joint, (0.0, 0.0))
            goals[joint] = GoalTolerances(
                **vars(self._runtime.settings.tolerances), position=position, rate=rate,
                time=goal_time_tolerance)
        request = replace(request, follows=True, goals=goals)
        verdict = self._runtime.request(request)
        if verdict.severity is not Severity.ERROR:
            self._goals[request.name] = _Goal(request, path)
        return verdict

    def cancel(self, name: str) -> None:
        """Come to rest instead of completing a goal."""
        goal = self._goals.get(name)
        if goal is not None:
            goal.canceled = True
            if goal.plan is None:
                # It waits for the plan of the stop, which is still to be made.
                goal.plan = self._runtime.group.number
            self._runtime.request(Stop(name))

    def update(self, status: StatusChanged) -> None:
        """Process a status of the planner."""
        for name, goal in list(self._goals.items()):
            outcome = self._fares(name, goal, status)
            if outcome is not None:
                self._end(name, outcome)

    def _fares(self, name: str, goal: _Goal, status: StatusChanged) -> GoalResult | None:
        verdict, state = status.verdict, status.progress.state
        answered = verdict.request == name and verdict.code is not Code.WAITING
        if answered and (goal.plan is None or goal.canceled):
            if verdict.code is Code.SUPERSEDED and goal.canceled:
                return None
            if (result := goal.ended_by(verdict)) is not None:
                return result
            if not goal.canceled:
                self._begin(name, goal)
            goal.plan = status.plan
        if goal.plan is None:
            # A clock that is set back drops the waiting requests.
            back = verdict.code is Code.CLOCK_JUMPED and state == 'idle'
            return goal.dropped(verdict.message) if back else None
        if status.plan > goal.plan:
            return goal.dropped(_REPLACED)
        if goal.canceled and state != 'idle':
            return None
        if state == 'idle':
            return goal.dropped(verdict.message)
        done = (status.progress.setpoint == status.progress.setpoints
                and state in ('at_rest', 'settling') and not status.watching)
        return _measured(goal.request, status) if done else None

    def _begin(self, name: str, goal: _Goal) -> None:
        """Record that a goal has a plan, which replaces the plans of other goals."""
        for other, one in list(self._goals.items()):
            if one.plan is not None and other != name:
                self._end(other, one.dropped(_REPLACED))
        request = goal.request
        plan = self._plan(goal)
        begin = request.stamp or plan.segments[min(plan.kept, len(plan.segments) - 1)].begin
        last = plan.segments[-1]
        goal.begin, goal.duration = begin - last.since, (last.until or last.begin) - begin
        points = list(request.path or ())
        if points:
            goal.duration = points[-1][1]
        if len(points) > 1:
            times = np.array([x for _, x in points]) / NANOSECONDS
            rows = np.array([x for x, _ in points])
            goal.paths = {
                joint: Path.through(times, x, v, None if np.isnan(a[0]) else a)
                for joint, (x, v, a) in zip(request.joints, rows.transpose(1, 2, 0), strict=True)}

    def _plan(self, goal: _Goal) -> Timeline:
        return self._runtime.group.planners[goal.request.joints[0]].plan

    def _after(self, goal: _Goal, time: int) -> int:
        """Return a time in ns relative to the begin of a goal."""
        segments = self._plan(goal).segments
        return time - goal.begin - (segments[-1].since if segments else 0)

    def _end(self, name: str, outcome: GoalResult) -> None:
        if self._goals.pop(name, None) is not None:
            self._ended(name, outcome)

    # -- samples -------------------------------------------------------------------------------

    @property
    def wants_all(self) -> bool:
        """Whether every sample is needed, not only the newest."""
        return any(x.path for x in self._goals.values())

    def observe(self, joint: str, stamp: int, stretch: float, rate: float, now: int) -> None:
        """Process a sample (ns, stretch, 1/s); one outside the path tolerance ends a goal."""
        if math.isnan(stretch) or stamp > now + AHEAD:
            return
        newest = self._seen.get(joint, (stamp,))[0]
        if stamp >= newest or newest > now + AHEAD:
            self._seen[joint] = stamp, (stretch, rate)
        for name, goal in list(self._goals.items()):
            if goal.plan is None or goal.canceled or joint not in goal.path:
                continue
            after = self._after(goal, stamp)
            errors = zip(
                ('stretch', 'rate'), (stretch, rate), self._desired(goal, joint, stamp),
                goal.path[joint], strict=True)
            for what, got, desired, most in errors:
                if 0 <= after <= goal.duration and most and abs(got - desired) > most:
                    self._end(name, GoalResult(
                        'aborted', ErrorCode.PATH_TOLERANCE_VIOLATED,
                        f'joint {joint} has {what} {got:.6g} at {after / NANOSECONDS:.3f} s: '
                        f'expected {desired:.6g} within {most:.3g}'))
                    self._runtime.request(Stop())
                    break

    def _desired(self, goal: _Goal | None, joint: str, time: int) -> Point:
        """Return the desired point of a joint at a time in ns, on the path or as planned."""
        if goal is not None and joint in goal.paths:
            path, after = goal.paths[joint], self._after(goal, time) / NANOSECONDS
            if path.breaks[0] <= after <= path.breaks[-1]:
                stretch, rate, _ = path.course(np.array(after))
                return float(stretch), float(rate)
        planner = self._runtime.group.planners[joint]
        state = planner.state(time)
        return state.stretch, state.rate / planner.model.units.time

    def elapsed(self, name: str, time: int) -> int | None:
        """Return the time in ns since a goal began; None before it is planned."""
        goal = self._goals.get(name)
        return None if goal is None or goal.plan is None else self._after(goal, time)

    def readings(self, time: int, name: str = '') -> dict[str, tuple[Point, Point]]:
        """Return desired and newest measured points of the joints of a goal, or of all joints."""
        goal = self._goals.get(name)
        joints = self._runtime.group.planners if goal is None else goal.request.joints
        return {x: (self._desired(goal, x, time), self._seen.get(x, (0, _UNSEEN))[1])
                for x in joints}


def _tolerances(
        kind: str, given: Sequence[Tolerance], joints: Sequence[str]) -> dict[str, Point]:
    """Return tolerances by joint, infinite if disabled; raise `RefusedError` if invalid."""
    found = {}
    for joint, *values in given:
        if joint not in joints:
            raise RefusedError(
                Code.UNKNOWN_JOINT, f'{kind} has joint {excerpt(joint)}: expected one of '
                f'joint_names ({", ".join(joints)})')
        for value in values:
            if not (value >= 0.0 or value == _NONE):
                raise RefusedError(
                    Code.BAD_INPUT, f'{kind} of joint {joint} is {value:g}: expected more than 0, '
                    '0 for the default, or -1 for none')
        position, rate = (math.inf if x == _NONE else x for x in values)
        found[joint] = position, rate
    return found


def _measured(request: Trajectory, status: StatusChanged) -> GoalResult:
    """Return the result of a goal whose motion is over, according to the samples."""
    worst, code = status.worst, ErrorCode.GOAL_TOLERANCE_VIOLATED
    if worst is None or worst.verdict is Code.UNOBSERVED:
        known = '' if worst is None else worst.message
        why = '; '.join(filter(None, (known, status.unheard))) or 'nothing was measured'
        return GoalResult(
            'aborted', code, f'{why}: expected samples on joint_states that show the arrival')
    # Another request for the same stretch may have been judged with other tolerances.
    for finding in (worst, *(status.findings.get(x, worst) for x in request.joints)):
        if failure := _failure(request, finding):
            return GoalResult('aborted', code, failure)
    return GoalResult('succeeded', ErrorCode.SUCCESSFUL, worst.message)


def _failure(request: Trajectory, finding: Finding) -> str:
    """Return why a finding is not a success; empty if it is."""
    setpoint = finding.setpoint
    offset, vibration = request.goals[setpoint.joint or request.joints[0]].of(setpoint)
    if setpoint.number < setpoint.count:
        return '' if finding.arrived else finding.message
    if finding.verdict in _MEASURED and (
            abs(finding.offset) <= offset and finding.vibration <= vibration):
        return ''
    return (f'{finding.message}: expected at most {offset:.3g} off, and a vibration of at most '
            f'{vibration:.3g} peak to peak')
