"""Conversion between messages and the records of `hmsa_ros.core`."""

from collections.abc import Iterable, Mapping, Sequence
import re
from typing import TYPE_CHECKING

from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import MagneticField
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hmsa_ros.core.schedule import obeyed
from hmsa_ros.core.status import Code, RefusedError
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.errors import BadInputError, excerpt

if TYPE_CHECKING:
    # Numba comes along with the planner, which a recorder has no use for.
    from hmsa_ros.core.planner import Plan

# Anybody may send a status; Python refuses to read numbers of thousands of digits.
_WHOLE = re.compile('[0-9]{1,18}')


def to_time(nanoseconds: int) -> Time:
    """Return a stamp as a message."""
    sec, nanosec = divmod(nanoseconds, NANOSECONDS)
    return Time(sec=sec, nanosec=nanosec)


def from_time(stamp: Time | Duration) -> int:
    """Return a stamp or a duration in ns."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def to_clock(nanoseconds: int) -> Clock:
    """Return simulated time as a message."""
    return Clock(clock=to_time(nanoseconds))


def to_command(stamp: int, flux_density: float, frame: str) -> MagneticField:
    """
    Return a flux density command.

    Parameters
    ----------
    stamp : int
        Time in ns from which it applies.
    flux_density : float
        Along z, in T.
    frame : str
        Frame of the coil.

    Returns
    -------
    sensor_msgs.msg.MagneticField
        With x and y zero: these axes are commanded to zero, not unknown.

    """
    message = MagneticField(header=Header(stamp=to_time(stamp), frame_id=frame))
    message.magnetic_field.z = flux_density
    return message


def from_command(message: MagneticField) -> tuple[int, float]:
    """
    Return stamp in ns and flux density in T of a command.

    Parameters
    ----------
    message : sensor_msgs.msg.MagneticField
        As `to_command` makes them.

    Returns
    -------
    tuple of int and float
        Stamp 0 means at once.

    Raises
    ------
    BadInputError
        If the field is not finite, not along z, or stamped before the epoch.

    """
    field = message.magnetic_field
    if not obeyed(field.x, field.y, field.z):
        raise BadInputError(
            f'flux density command ({field.x:g}, {field.y:g}, {field.z:g}) T: expected a finite '
            'field along z, with x = y = 0')
    stamp = from_time(message.header.stamp)
    if stamp < 0:
        raise BadInputError(f'flux density command stamped {stamp} ns: expected at least 0')
    return stamp, float(field.z)


def from_trajectory(
        message: JointTrajectory, joint: str) -> tuple[list[tuple[float, int]], int | None]:
    """
    Return the setpoints of a trajectory and its stamp.

    Parameters
    ----------
    message : trajectory_msgs.msg.JointTrajectory
        For one joint.
    joint : str
        Name that it must have.

    Returns
    -------
    points : list of (float, int)
        Stretch, and time from the start in ns.
    stamp : int or None
        In ns; None for stamp 0, which means now.

    Raises
    ------
    RefusedError
        If the joint is another one, sizes do not fit, or a point asks for motion or effort.

    """
    names = list(message.joint_names)
    if names != [joint]:
        raise RefusedError(
            Code.UNKNOWN_JOINT, f'joint_names is {excerpt(names)}: expected [{joint!r}]')
    points = []
    for number, point in enumerate(message.points):
        if len(point.positions) != 1:
            raise RefusedError(
                Code.BAD_INPUT,
                f'point {number} has {len(point.positions)} positions: expected 1, the stretch')
        for name in ('velocities', 'accelerations', 'effort'):
            values = list(getattr(point, name))
            if values not in ([], [0.0]):
                raise RefusedError(
                    Code.BAD_INPUT,
                    f'point {number} has {name} {excerpt(values)}: expected none, the actuator '
                    'comes to rest at each setpoint')
        points.append((float(point.positions[0]), from_time(point.time_from_start)))
    stamp = from_time(message.header.stamp)
    return points, (None if stamp == 0 else stamp)


def from_trajectories(
        message: JointTrajectory, joints: Sequence[str], *, partial: bool = False
) -> tuple[dict[str, list[tuple[float, int]]], int | None]:
    """
    Return the setpoints of a trajectory for several joints and its stamp.

    Parameters
    ----------
    message : trajectory_msgs.msg.JointTrajectory
        For all joints, in any order.
    joints : sequence of str
        Names of the joints there are; with a single one, `from_trajectory` says more.
    partial : bool
        Whether it may be for some of them only.

    Returns
    -------
    points : dict of str to list of (float, int)
        By joint: stretch, and time from the start in ns.
    stamp : int or None
        In ns; None for stamp 0, which means now.

    Raises
    ------
    RefusedError
        If the joints are others, sizes do not fit, or a point asks for motion or effort.

    """
    if len(joints) == 1:
        single, start = from_trajectory(message, joints[0])
        return {joints[0]: single}, start
    names = list(message.joint_names)
    if twice := sorted({x for x in names if names.count(x) > 1}):
        raise RefusedError(
            Code.UNKNOWN_JOINT,
            f'joint_names has {excerpt(twice[0])} twice: expected each joint once')
    if unknown := [x for x in names if x not in joints]:
        raise RefusedError(
            Code.UNKNOWN_JOINT,
            f'joint_names has {excerpt(unknown[0])}: expected names among {", ".join(joints)}')
    missing = [x for x in joints if x not in names]
    if not names or missing and not partial:
        raise RefusedError(
            Code.UNKNOWN_JOINT,
            f'joint_names lacks {missing[0]!r}: expected all of {", ".join(joints)} (the '
            'parameter allow_partial_joints lets a message be for some of them)')
    points: dict[str, list[tuple[float, int]]] = {name: [] for name in names}
    for number, point in enumerate(message.points):
        if len(point.positions) != len(names):
            raise RefusedError(
                Code.BAD_INPUT,
                f'point {number} has {len(point.positions)} positions: expected {len(names)}, '
                'one for each of joint_names')
        for field in ('velocities', 'accelerations', 'effort'):
            values = list(getattr(point, field))
            if values and values != [0.0] * len(names):
                raise RefusedError(
                    Code.BAD_INPUT,
                    f'point {number} has {field} {excerpt(values)}: expected none, the '
                    'actuators come to rest at each setpoint')
        time = from_time(point.time_from_start)
        for name, position in zip(names, point.positions, strict=True):
            points[name].append((float(position), time))
    stamp = from_time(message.header.stamp)
    return points, (None if stamp == 0 else stamp)


def to_trajectory(
        setpoints: Iterable[tuple[float | Sequence[float], int]], joints: str | Sequence[str], *,
        stamp: int = 0, frame: str = '') -> JointTrajectory:
    """
    Return setpoints as a trajectory message.

    Parameters
    ----------
    setpoints : iterable of (float or sequence of float, int)
        Stretch, of all joints or one a joint, and time from the start in ns until which it lasts.
    joints : str or sequence of str
        Name or names.
    stamp : int
        Start in ns; 0 for now.
    frame : str
        Identifies the request: the planner's verdict repeats it.

    Returns
    -------
    trajectory_msgs.msg.JointTrajectory
        One point a setpoint.

    """
    names = [joints] if isinstance(joints, str) else list(joints)
    return JointTrajectory(
        header=Header(stamp=to_time(stamp), frame_id=frame), joint_names=names,
        points=[
            JointTrajectoryPoint(
                positions=np.broadcast_to(stretch, len(names)).tolist(),
                time_from_start=_to_duration(time))
            for stretch, time in setpoints])


def _to_duration(nanoseconds: int) -> Duration:
    sec, nanosec = divmod(nanoseconds, NANOSECONDS)
    return Duration(sec=sec, nanosec=nanosec)


def to_plan(plan: 'Plan', joint: str) -> JointTrajectory:
    """
    Return a plan's preview: one point at each change of level still ahead of its start.

    Parameters
    ----------
    plan : Plan
        At least one request old.
    joint : str
        Its name.

    Returns
    -------
    trajectory_msgs.msg.JointTrajectory
        Stamped with the first change; positions, velocities and effort are the predicted
        stretch, stretch rate and the flux density from then on.

    """
    levels = plan.ahead
    start = levels[0].stamp if levels else 0
    return JointTrajectory(
        header=Header(stamp=to_time(start)), joint_names=[joint],
        points=[
            JointTrajectoryPoint(
                positions=[level.stretch], velocities=[level.rate],
                effort=[level.flux_density],
                time_from_start=_to_duration(level.stamp - start))
            for level in levels])


def to_plans(
        stamps: Sequence[int],
        samples: Mapping[str, Sequence[tuple[float, float, float]]]) -> JointTrajectory:
    """
    Return the preview of several joints' plans: a point at each change of level of any.

    Parameters
    ----------
    stamps : sequence of int
        In ns, increasing.
    samples : mapping of str to sequence of (float, float, float)
        By joint, one for each stamp: stretch, rate in 1/s and flux density in T from then on.

    Returns
    -------
    trajectory_msgs.msg.JointTrajectory
        As `to_plan` makes it for one joint.

    """
    start = stamps[0] if stamps else 0
    message = JointTrajectory(
        header=Header(stamp=to_time(start)), joint_names=list(samples))
    for stamp, *point in zip(stamps, *samples.values(), strict=True):
        stretches, rates, flux_densities = zip(*point, strict=True)
        message.points.append(JointTrajectoryPoint(
            positions=stretches, velocities=rates, effort=flux_densities,
            time_from_start=_to_duration(stamp - start)))
    return message


def to_status(
        name: str, joint: str, level: bytes, message: str,
        values: Mapping[str, object]) -> DiagnosticStatus:
    """
    Return a diagnostic status.

    Parameters
    ----------
    name, joint, message : str
        What it is about, for which joint, and the sentence.
    level : bytes
        One of DiagnosticStatus.OK, WARN, ERROR.
    values : mapping of str to object
        Written with `str`.

    Returns
    -------
    diagnostic_msgs.msg.DiagnosticStatus
        Ready to publish.

    """
    return DiagnosticStatus(
        name=name, hardware_id=joint, level=level, message=message,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])


def whole(text: str | None) -> int:
    """Return the whole number that a status tells, 0 where it tells none."""
    return int(text) if text and _WHOLE.fullmatch(text) else 0


def to_diagnostics(stamp: int, *statuses: DiagnosticStatus) -> DiagnosticArray:
    """Return statuses as the message of /diagnostics, stamped in ns."""
    return DiagnosticArray(header=Header(stamp=to_time(stamp)), status=list(statuses))
