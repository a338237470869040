"""Check whether a planner can accept a request: its state, the joints, the setpoint count."""

from collections.abc import Sequence

from hmsa.errors import excerpt
from hmsa.model.status import Code, RefusedError
from hmsa_ros.runtime.records import Request, Settings, StretchRequest, Trajectory


def check_ready(now: int, *, active: bool) -> None:
    """Raise `RefusedError` if no request can be accepted at a time in ns."""
    if not active:
        raise RefusedError(
            Code.INACTIVE, 'the planner is inactive: expected it active (ros2 lifecycle set NODE '
            'activate)')
    if now == 0:
        raise RefusedError(
            Code.NO_TIME,
            'simulated time has not started: expected messages on /clock (start the simulator, or '
            'set use_sim_time to false)')


def check_joints(request: Request, joints: Sequence[str], settings: Settings) -> None:
    """
    Check the joints of a request and its number of setpoints.

    Raises `RefusedError` if a joint is unknown, repeated or missing, or if there are too many
    setpoints.
    """
    if isinstance(request, StretchRequest) and request.joint not in joints:
        raise RefusedError(
            Code.UNKNOWN_JOINT, f'joint {request.joint!r}: expected one of {", ".join(joints)}')
    if not isinstance(request, Trajectory):
        return
    names = request.joints
    if not request.count:
        # A stop of all joints.
        if unknown := [x for x in names if x not in joints]:
            raise _unknown(f'has {excerpt(unknown[0])}: expected names among {", ".join(joints)}')
        return
    if len(joints) == 1 and names != tuple(joints):
        raise _unknown(f'is {excerpt(list(names))}: expected {list(joints)}')
    if twice := sorted({x for x in names if names.count(x) > 1}):
        raise _unknown(f'has {excerpt(twice[0])} twice: expected each joint once')
    if unknown := [x for x in names if x not in joints]:
        raise _unknown(f'has {excerpt(unknown[0])}: expected names among {", ".join(joints)}')
    missing = [x for x in joints if x not in names]
    if not names or missing and not settings.allow_partial_joints:
        raise _unknown(
            f'lacks {missing[0]!r}: expected all of {", ".join(joints)} (set '
            'allow_partial_joints to let a message name only some of them)')
    count = request.count * len(names)
    if count > settings.max_points:
        raise RefusedError(
            Code.TOO_LONG,
            f'the trajectory has {count} setpoints: expected at most {settings.max_points}, the '
            'parameter max_points; send it in parts, each with its start as timestamp')


def _unknown(reason: str) -> RefusedError:
    return RefusedError(Code.UNKNOWN_JOINT, f'joint_names {reason}')
