"""Conversion between messages and the records of `hmsa.planning`."""

from collections.abc import Iterable, Mapping, Sequence
import json
from typing import Any, TYPE_CHECKING

from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import MagneticField, Temperature, TimeReference
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hmsa.errors import BadInputError
from hmsa.model.delivery import is_axial_field
from hmsa.model.units import NANOSECONDS

if TYPE_CHECKING:
    # Imported with the planner, which a recorder does not need.
    from hmsa.interfaces.diagnostics import Outcome
    from hmsa_ros.runtime.records import StatusChanged

#: Contents of a receipt while commands from before a cut-off, or all commands, are rejected, and
#: if the newest command was too late and takes no effect.
CUT_OFF, INTERLOCK, LATE = 'cut_off', 'interlock', 'late'


def to_time(nanoseconds: int) -> Time:
    """Return a timestamp as a message."""
    sec, nanosec = divmod(nanoseconds, NANOSECONDS)
    return Time(sec=sec, nanosec=nanosec)


def from_time(stamp: Time | Duration) -> int:
    """Return a timestamp or a duration in ns."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def to_clock(nanoseconds: int) -> Clock:
    """Return simulated time as a message."""
    return Clock(clock=to_time(nanoseconds))


def to_command(stamp: int, flux_density: float, frame: str) -> MagneticField:
    """Return a command from a timestamp in ns on, in T along z; x and y are 0, not NaN."""
    message = MagneticField(header=Header(stamp=to_time(stamp), frame_id=frame))
    message.magnetic_field.z = flux_density
    return message


def to_temperature(stamp: int, celsius: float) -> Temperature:
    """Return the temperature of a block in degrees Celsius at a time in ns."""
    return Temperature(header=Header(stamp=to_time(stamp)), temperature=celsius)


def from_command(message: MagneticField) -> tuple[int, float]:
    """
    Return timestamp in ns (0 for immediately) and flux density in T of a command.

    Raises
    ------
    BadInputError
        If the field is not finite, is not along z, or has a timestamp before the epoch.

    """
    field = message.magnetic_field
    if not is_axial_field(field.x, field.y, field.z):
        raise BadInputError(
            f'flux density command ({field.x:g}, {field.y:g}, {field.z:g}) T: expected a finite '
            'field along z, with x = y = 0')
    stamp = from_time(message.header.stamp)
    if stamp < 0:
        raise BadInputError(f'flux density command has timestamp {stamp} ns: expected at least 0')
    return stamp, float(field.z)


def to_receipt(joint: str, time: int, command: int, refuses: str) -> TimeReference:
    """
    Return a receipt: timestamp of the newest command of a joint, and present time; both in ns.

    ``refuses`` is `CUT_OFF`, `INTERLOCK` or `LATE` if commands are rejected, else empty. For
    `CUT_OFF`, the time of the cut-off takes the place of the timestamp.
    """
    return TimeReference(
        header=Header(stamp=to_time(time), frame_id=refuses),
        time_ref=to_time(command), source=joint)


def to_trajectory(
        setpoints: Iterable[tuple[Any, int]], joints: str | Sequence[str], *,
        stamp: int = 0, frame: str = '', raw: bool = False,
        path: bool = False) -> JointTrajectory:
    """
    Return a request with setpoints: stretches, of all joints or for each, and end times.

    Times are in ns from the start. If raw, setpoints are levels in T with the times from which
    they apply; for a path, they are stretch, rate (1/s) and acceleration (1/s^2) of all joints.
    The timestamp is the start, 0 for now. The planner's verdict repeats the frame.
    """
    names = [joints] if isinstance(joints, str) else list(joints)
    fields = ('positions', 'velocities', 'accelerations') if path else (
        ('effort',) if raw else ('positions',))
    return JointTrajectory(
        header=Header(stamp=to_time(stamp), frame_id=frame), joint_names=names,
        points=[
            JointTrajectoryPoint(
                time_from_start=to_duration(time),
                **{field: np.broadcast_to(value, len(names)).tolist() for field, value in zip(
                    fields, stretch if path else (stretch,), strict=True)})
            for stretch, time in setpoints])


def to_duration(nanoseconds: int) -> Duration:
    """Return a duration as a message."""
    sec, nanosec = divmod(nanoseconds, NANOSECONDS)
    return Duration(sec=sec, nanosec=nanosec)


def to_plan(
        stamps: Sequence[int],
        samples: Mapping[str, Sequence[tuple[float, float, float]]]) -> JointTrajectory:
    """Return stretch, rate in 1/s and level in T of each joint, from timestamps in ns on."""
    start = stamps[0] if stamps else 0
    message = JointTrajectory(
        header=Header(stamp=to_time(start)), joint_names=list(samples))
    for stamp, *point in zip(stamps, *samples.values(), strict=True):
        stretches, rates, flux_densities = zip(*point, strict=True)
        message.points.append(JointTrajectoryPoint(
            positions=stretches, velocities=rates, effort=flux_densities,
            time_from_start=to_duration(stamp - start)))
    return message


def to_planner_status(status: 'StatusChanged') -> DiagnosticStatus:
    """Return a planner's verdict and progress, including those of each of several joints."""
    verdict, progress, each = status.verdict, status.progress, status.each
    values: dict[str, object] = {
        'code': verdict.code, 'request': verdict.request, 'plan': status.plan,
        **vars(progress), 'late': status.late, 'replanned': status.replanned, **verdict.figures,
        'watching': status.watching, 'measuring': status.measuring}
    if status.answers:
        values['answers'] = json.dumps({
            name: (int(x.severity), x.code, x.message, plan)
            for name, (x, plan) in status.answers.items()})
    if status.worst is not None:
        values |= {
            'worst': str(status.worst.verdict), 'worst_message': status.worst.message,
            'finding': json.dumps(status.worst.to_dict())}
    for name, of_joint in each.items():
        prefix = f'{name}.' if len(each) > 1 else ''
        found = status.findings.get(name)
        of_each = {**vars(of_joint), **({} if found is None else found.to_texts())}
        values |= {f'{prefix}{key}': value for key, value in of_each.items()}
    values |= coordinates(status.coordinates)
    severity, message = int(verdict.severity), verdict.message
    for key, trouble in (('unheard', status.unheard), ('unseen', status.unseen)):
        if trouble:
            values[key] = trouble
            severity, message = max(severity, 1), f'{message}; but {trouble}'
    return to_status('planner: request', ', '.join(each), severity, message, values)


def to_outcome(outcome: 'Outcome') -> DiagnosticStatus:
    """Return the outcome of a setpoint."""
    fine = outcome.finding is not None and not outcome.finding.failed
    return to_status(
        'planner: outcome', outcome.joint, int(not fine), outcome.message, outcome.to_texts())


def coordinates(by_joint: Mapping[str, str]) -> dict[str, object]:
    """Return the coordinates of joints by status key, which names one of several joints."""
    several = len(by_joint) > 1
    return {f'{name}.coordinate' if several else 'coordinate': x for name, x in by_joint.items()}


def to_status(
        name: str, joint: str, level: int, message: str,
        values: Mapping[str, object]) -> DiagnosticStatus:
    """Return a diagnostic status; ``hardware_id`` is the joint, values become text."""
    return DiagnosticStatus(
        name=name, hardware_id=joint, level=bytes([level]), message=message,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])


def to_diagnostics(stamp: int, *statuses: DiagnosticStatus) -> DiagnosticArray:
    """Return statuses as a message for /diagnostics, with a timestamp in ns."""
    return DiagnosticArray(header=Header(stamp=to_time(stamp)), status=list(statuses))
