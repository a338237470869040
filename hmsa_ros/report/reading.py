"""
A run, read from a bag.

Topics are found by the end of their name and their type, so that any namespace will do; the
bag may come from this package's recorder, from rosbag2, from a simulated plant or from a coil.
"""

from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
import json
import math
from pathlib import Path
import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.bag.experiment import parameters_of
from hmsa_ros.bag.info import BagSummary, summarize
from hmsa_ros.bag.reader import BagReader, Message
from hmsa_ros.core.model import Array
from hmsa_ros.core.parameters import ActuatorParameters, paper_actuator
from hmsa_ros.core.schedule import obeyed
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.errors import BadInputError, BagError

Times = NDArray[np.int64]

JOINT_STATES = 'joint_states'
COMMAND = 'flux_density_command'
APPLIED = 'flux_density_applied'
PLAN = 'planner/plan'
TRAJECTORY = 'planner/joint_trajectory'
SETPOINT = 'planner/setpoint'
STATUS = 'planner/status'
TYPES = {
    JOINT_STATES: 'sensor_msgs/msg/JointState',
    COMMAND: 'sensor_msgs/msg/MagneticField',
    APPLIED: 'sensor_msgs/msg/MagneticField',
    PLAN: 'trajectory_msgs/msg/JointTrajectory',
    TRAJECTORY: 'trajectory_msgs/msg/JointTrajectory',
    SETPOINT: 'std_msgs/msg/Float64',
    STATUS: 'diagnostic_msgs/msg/DiagnosticStatus',
}
#: Fields of `ActuatorParameters`, as the nodes' parameters name them.
ACTUATOR_FIELDS = (
    'shear_modulus', 'density', 'half_length', 'half_thickness', 'remanence', 'chain_limit',
    'damping_coefficient')
_DEFAULT_JOINT = 'actuator'
# Roles whose topics are one for each joint where there are several.
_OF_A_JOINT = (COMMAND, APPLIED, SETPOINT)
# Samples may overtake one another on their way; further back goes only a clock, in ns.
_CLOCK_JUMP = 100_000_000
# A sample whose stamp is this far from the others' is of another sender, or garbage; in ns.
_FAR = 30 * 86_400 * NANOSECONDS
# What lies beyond is no motion of a block, and nothing could be drawn beside it; the rate in 1/s.
_LARGEST_STRETCH, _LARGEST_RATE = 1e6, 1e12
# Between two calls of the progress.
_PROGRESS_MESSAGES = 20_000
_LITTLE_ENDIAN = b'\x00\x01'
_LEVELS = ('ok', 'warning', 'error')


@dataclass(frozen=True)
class Level:
    """
    A command, or a change of level in a plan.

    Attributes
    ----------
    stamp : int
        Time in ns from which it applies.
    flux_density : float
        In T.
    sent : int
        Time in ns at which it was recorded.
    stretch, rate : float
        Predicted at the stamp, the rate in 1/s; NaN for a command.

    """

    stamp: int
    flux_density: float
    sent: int
    stretch: float = math.nan
    rate: float = math.nan


@dataclass(frozen=True)
class Request:
    """
    What the planner was asked for.

    Attributes
    ----------
    sent : int
        Time in ns at which it was recorded.
    stamp : int
        Start of the sequence in ns; 0 for at once.
    points : tuple of (float, int or None)
        Stretch, and time in ns from the start until which it lasts; None for a setpoint that
        is held until the next.

    """

    sent: int
    stamp: int
    points: tuple[tuple[float, int | None], ...]


@dataclass(frozen=True)
class Verdict:
    """
    What the planner said of a request.

    Attributes
    ----------
    sent : int
        Time in ns at which it was recorded.
    level : str
        ``'ok'``, ``'warning'`` or ``'error'``.
    code, message : str
        As published.
    stretch : float
        Target of the setpoint under way; NaN if there is none.

    """

    sent: int
    level: str
    code: str
    message: str
    stretch: float


@dataclass(frozen=True)
class Run:
    """
    What a bag holds of one actuator.

    Attributes
    ----------
    label : str
        Name for people.
    joint : str
        Name of the actuator in the joint states, as far as it is known.
    path : Path
        The bag.
    summary : BagSummary
        The bag in figures.
    topics : dict of str to str
        Topic of each role (`JOINT_STATES`, `COMMAND`, ...) that the bag has.
    time : ndarray of int64, shape (n,)
        Stamps of the samples in ns, increasing.
    logged : ndarray of int64, shape (n,)
        When they were recorded, in ns.
    stretch, rate, flux_density : ndarray, shape (n,)
        Samples; the rate in 1/s, from the stretch if it was not recorded; the flux density in
        T, NaN if it was not recorded.
    commands : tuple of Level
        In the order they were recorded.
    applied : tuple of Level
        Changes of the field that took effect, as the plant or the driver told them; empty if it
        does not.
    plans : tuple of tuple of Level
        Plans in the order they were recorded.
    requests : tuple of Request
        In the order they were recorded.
    verdicts : tuple of Verdict
        In the order they were recorded, each once.
    parameters : dict of str to object
        Parameters of the nodes as recorded, by ``'node.name'``.
    plant, planner : ActuatorParameters
        The block as it was, and as the planner took it to be.
    parameters_known : bool
        Whether the bag, or the caller, told of the block.
    notes : tuple of str
        What a reader should know, one sentence each.

    """

    label: str
    joint: str
    path: Path
    summary: BagSummary
    topics: dict[str, str]
    time: Times
    logged: Times
    stretch: Array
    rate: Array
    flux_density: Array
    commands: tuple[Level, ...]
    applied: tuple[Level, ...]
    plans: tuple[tuple[Level, ...], ...]
    requests: tuple[Request, ...]
    verdicts: tuple[Verdict, ...]
    parameters: dict[str, object]
    plant: ActuatorParameters
    planner: ActuatorParameters
    parameters_known: bool
    notes: tuple[str, ...]

    def number(self, name: str) -> float:
        """
        Return a recorded parameter that is a number.

        Parameters
        ----------
        name : str
            For example ``'planner.slew_limit'``.

        Returns
        -------
        float
            0 if it was not recorded, or as what it cannot be.

        """
        value = _of_joint(self.parameters, self.joint, name)
        return float(value) if isinstance(value, (int, float)) and 0.0 <= value < math.inf \
            else 0.0


def read_runs(
        path: str | Path, *, actuator: ActuatorParameters | None = None,
        joints: Sequence[str] = (),
        progress: Callable[[str, float], None] = lambda what, share: None) -> list[Run]:
    """
    Read a bag: one run for each actuator with joint states and commands.

    Parameters
    ----------
    path : str or Path
        Folder of a bag, or an ``.mcap`` file.
    actuator : ActuatorParameters, optional
        The block, where the bag does not tell.
    joints : sequence of str
        Names of the actuators in the joint states; default all that have commands of their own,
        or the one that the planner names.
    progress : callable
        Called with what is going on and the share that is done.

    Returns
    -------
    list of Run
        At least one, in order of namespace and joint.

    Raises
    ------
    BadInputError
        If there is no bag, or it has no samples of an actuator.

    """
    path = Path(path)
    reader = BagReader(path)
    spaces = _namespaces(reader)
    # A namespace's own topics, and in it those of each joint.
    found = {topic: (space, role, joint) for space, by_joint in spaces.items()
             for joint, topics in by_joint.items() for role, topic in topics.items()}
    collected: dict[str, _Collected] = {space: _Collected() for space in spaces}
    notes: list[str] = []
    decoders: dict[str, Callable[[bytes], Any]] = {}
    for topic, (space, role, _) in found.items():
        try:
            decoders[topic] = reader.decoder(topic)
        except BagError as error:
            raise BadInputError(f'{path} cannot be evaluated: {error}') from error
        if role == JOINT_STATES:
            collected[space].samples = _SampleReader(decoders[topic])
    begin, end = reader.start_time or 0, reader.end_time or 0
    for i, message in enumerate(reader.messages(list(found))):
        if i % _PROGRESS_MESSAGES == 0:
            progress(f'reading {path.name}', (message.log_time - begin) / max(end - begin, 1))
        space, role, joint = found[message.topic]
        try:
            collected[space].take(role, joint, message, decoders[message.topic])
        except BagError as error:
            if len(notes) < 20:
                notes.append(f'{error}: left out')
    summary = summarize(path)
    notes += [*summary.problems]
    label = path.resolve().stem if path.is_file() else path.resolve().name
    runs, reasons = [], []
    for space, by_joint in sorted(spaces.items()):
        name = label if len(spaces) == 1 else f'{label} {space or "/"}'
        for joint, topics in sorted(by_joint.items()):
            if joint and joints and joint not in joints:
                reasons.append(BadInputError(
                    f'{path} has no joint {" or ".join(joints)}: expected one of '
                    f'{", ".join(sorted(by_joint))}'))
                continue
            for wanted in ([joint] if joint else joints or ['']):
                several = len(by_joint) > 1 or len(joints) > 1
                try:
                    runs.append(collected[space].finish(
                        f'{name} {wanted}' if several else name, path, summary, topics, notes,
                        reader.custom_data, actuator, joint, wanted))
                except BadInputError as error:
                    reasons.append(error)
    if not runs:
        # What was left out may be the reason.
        raise BadInputError('; '.join([str(reasons[0]), *notes[:1]]))
    return runs


def _namespaces(reader: BagReader) -> dict[str, dict[str, dict[str, str]]]:
    """Return the topics of each actuator, by namespace, joint ('' for the only one) and role."""
    names: dict[str, list[tuple[str, str]]] = {role: [] for role in TYPES}
    for topic in reader.topics.values():
        for role, kind in TYPES.items():
            node, _, last = role.rpartition('/')
            if topic.type != kind:
                continue
            if f'/{topic.name}'.endswith(f'/{role}'):
                names[role].append((topic.name[:-len(role)].rstrip('/'), topic.name))
            elif role == SETPOINT and re.search(rf'/{node}/[^/]+/{last}$', f'/{topic.name}'):
                # .../planner/JOINT/setpoint stands beside .../JOINT/flux_density_command.
                space, _, joint = topic.name[:-len(last) - 1].rpartition('/')
                names[role].append((f'{space[:-len(node)]}{joint}', topic.name))
    missing = [f'.../{role} ({TYPES[role]})' for role in (JOINT_STATES, COMMAND)
               if not names[role]]
    if missing:
        has = ', '.join(sorted(reader.topics)) or 'none: the bag is empty'
        raise BadInputError(
            f'{reader.path} has no topic {" and no topic ".join(missing)}: expected a bag of a '
            f'run; its topics are {has}')
    spaces: dict[str, dict[str, dict[str, str]]] = {}
    for space, name in names[JOINT_STATES]:
        own = _topics_in(names, space, name)
        if COMMAND in own:
            spaces[space] = {'': own}
            continue
        by_joint = {
            where[len(space) + 1:]: where for where, _ in names[COMMAND]
            if where.startswith(f'{space}/') and '/' not in where[len(space) + 1:]}
        if by_joint:
            spaces[space] = {joint: {
                **own, **{role: topic for role in _OF_A_JOINT
                          for at, topic in names[role] if at == where}}
                for joint, where in by_joint.items()}
    if not spaces:
        raise BadInputError(
            f'{reader.path} has joint states and commands in different namespaces: expected '
            f'{COMMAND} beside one of '
            + ', '.join(name for _, name in names[JOINT_STATES]))
    return spaces


def _topics_in(
        names: Mapping[str, Sequence[tuple[str, str]]], space: str, states: str
) -> dict[str, str]:
    """Return the topics of a namespace, by role."""
    topics = {JOINT_STATES: states}
    for role in TYPES:
        same = [x for where, x in names[role] if where == space]
        if same:
            topics[role] = same[0]
        elif len(names[role]) == 1 and len(names[JOINT_STATES]) == 1 and (
                role not in _OF_A_JOINT or len(names[COMMAND]) == 1):
            # Planner and plant in namespaces of their own, remapped to each other.
            topics[role] = names[role][0][1]
    return topics


@dataclass(frozen=True)
class _Point:
    """A point of a trajectory: time from its start in ns, and values by joint."""

    time: int
    positions: tuple[float, ...]
    velocities: tuple[float, ...]
    effort: tuple[float, ...]


@dataclass(frozen=True)
class _Trajectory:
    """A request or a plan as it was received, with its stamp in ns."""

    sent: int
    joints: tuple[str, ...]
    stamp: int
    points: tuple[_Point, ...]

    @classmethod
    def of(cls, sent: int, message: Any) -> '_Trajectory':
        """Take it from a message."""
        return cls(sent, tuple(message.joint_names), _ns(message.header.stamp), tuple(
            _Point(_ns(x.time_from_start), *(
                tuple(map(float, y)) for y in (x.positions, x.velocities, x.effort)))
            for x in message.points))


@dataclass(frozen=True)
class _Status:
    """What the planner said, as it was received."""

    sent: int
    level: int
    message: str
    values: dict[str, str]

    @classmethod
    def of(cls, sent: int, message: Any) -> '_Status':
        """Take it from a message."""
        level = message.level[0] if isinstance(message.level, bytes) else int(message.level)
        return cls(sent, level, message.message, {x.key: x.value for x in message.values})


class _Collected:
    """What has been read of the actuators of one namespace so far."""

    samples: '_SampleReader'

    def __init__(self) -> None:
        self.commands: dict[str, list[Level]] = {}
        self.applied: dict[str, list[Level]] = {}
        self.refused: dict[str, int] = {}
        # Of all joints, as they were received.
        self.plans: list[_Trajectory] = []
        self.trajectories: list[_Trajectory] = []
        self.setpoints: dict[str, list[Request]] = {}
        self.statuses: list[_Status] = []

    def take(
            self, role: str, joint: str, message: Message,
            decode: Callable[[bytes], Any]) -> None:
        """
        Take in a message.

        Parameters
        ----------
        role, joint : str
            Which topic it is from.
        message : Message
            As stored.
        decode : callable
            Of the topic.

        Raises
        ------
        BagError
            If it is not what its topic is for.

        """
        try:
            self._take(role, joint, message, decode)
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            # The bag brings the definition along, and may call anything by that name.
            raise BagError(
                f'a message of topic {message.topic} is not as {TYPES[role]} is defined in ROS '
                f'2: {error}') from error

    def _take(
            self, role: str, joint: str, message: Message,
            decode: Callable[[bytes], Any]) -> None:
        if role == JOINT_STATES:
            self.samples.take(message.log_time, message.data)
            return
        content, sent = decode(message.data), message.log_time
        if role in (COMMAND, APPLIED):
            field = content.magnetic_field
            kept = self.commands if role == COMMAND else self.applied
            if obeyed(field.x, field.y, field.z):
                kept.setdefault(joint, []).append(
                    Level(_ns(content.header.stamp) or sent, float(field.z), sent))
            elif role == COMMAND:
                self.refused[joint] = self.refused.get(joint, 0) + 1
        elif role == PLAN:
            self.plans.append(_Trajectory.of(sent, content))
        elif role == TRAJECTORY:
            self.trajectories.append(_Trajectory.of(sent, content))
        elif role == SETPOINT:
            self.setpoints.setdefault(joint, []).append(
                Request(sent, 0, ((float(content.data), None),)))
        else:
            self.statuses.append(_Status.of(sent, content))

    def _plans(self, joint: str) -> Iterable[tuple[Level, ...]]:
        """Return the plans of a joint, or of the one that they are of."""
        for plan in self.plans:
            place = _place(plan.joints, joint)
            if place is None:
                continue
            levels = [
                Level(plan.stamp + x.time, x.effort[place], plan.sent, x.positions[place],
                      x.velocities[place])
                for x in plan.points
                if min(len(x.positions), len(x.velocities), len(x.effort)) > place]
            # Of several joints there is a point wherever one of them changes.
            yield tuple(
                x for i, x in enumerate(levels) if i == 0 or len(plan.joints) == 1
                or x.flux_density != levels[i - 1].flux_density)

    def _requests(self, joint: str, key: str) -> list[Request]:
        """Return what was asked of a joint, by time."""
        requests = list(self.setpoints.get(key, ()))
        for asked in self.trajectories:
            place = _place(asked.joints, joint)
            if place is not None:
                requests.append(Request(asked.sent, asked.stamp, tuple(
                    (x.positions[place], x.time) for x in asked.points
                    if len(x.positions) == max(len(asked.joints), 1))))
        return sorted(requests, key=lambda x: x.sent)

    def _verdicts(self, joint: str, joints: Sequence[str]) -> Iterable[Verdict]:
        """Return what the planner said, with the target of a joint."""
        for status in self.statuses:
            # Of several joints each has its own.
            target = status.values.get(f'{joint}.stretch') if joint in joints and len(joints) > 1 \
                else status.values.get('stretch')
            yield Verdict(
                status.sent, _LEVELS[min(status.level, 2)], status.values.get('code', ''),
                status.message, _number(target))

    def finish(
            self, label: str, path: Path, summary: BagSummary, topics: dict[str, str],
            notes: Iterable[str], custom_data: Mapping[str, str],
            actuator: ActuatorParameters | None, key: str, joint: str) -> Run:
        """Return the run of one joint, whose topics have its name in them or not."""
        notes = list(notes)
        parameters = _parameters(custom_data, topics[JOINT_STATES][:-len(JOINT_STATES)])
        planned = [x for plan in self.plans for x in plan.joints]
        named = joint or next(iter(planned), '') or str(parameters.get('planner.joint', ''))
        time, logged, stretch, rate, flux_density = self.samples.arrays(
            f'{path}: {topics[JOINT_STATES]}', named, required=bool(joint))
        commands = self.commands.get(key, [])
        if not commands:
            notes.append(
                f'{topics[COMMAND]} holds no command: there is no setpoint to evaluate.')
        if self.refused.get(key):
            notes.append(
                f'{self.refused[key]} commands are not finite or not along z: left out, as the '
                'plant does.')
        notes += self.samples.notes
        plant, planner, known, more = _actuators(parameters, actuator, named)
        return Run(
            label, named, path, summary, topics, time, logged, stretch, rate, flux_density,
            tuple(commands), tuple(self.applied.get(key, ())), tuple(self._plans(joint)),
            tuple(self._requests(joint, key)),
            tuple(self._verdicts(joint, list(dict.fromkeys(planned)))), parameters, plant,
            planner, known, (*notes, *more))


def _number(text: str | None) -> float:
    """Return a number from a status; NaN for what is none."""
    try:
        return float(text or 'nan')
    except ValueError:
        return math.nan


def _place(names: Sequence[str], joint: str) -> int | None:
    """Return a joint's place among some names: the first if it does not matter."""
    if joint in names:
        return list(names).index(joint)
    return 0 if not joint or len(names) <= 1 else None


def _parameters(custom_data: Mapping[str, str], space: str) -> dict[str, object]:
    """Return the parameters of the nodes in a namespace that the recorder stored."""
    parameters: dict[str, object] = {}
    for node in ('planner', 'plant'):
        for name, text in parameters_of(custom_data, node, space).items():
            try:
                parameters[f'{node}.{name}'] = json.loads(text)
            except ValueError:
                parameters[f'{node}.{name}'] = text
    return parameters


def _of_joint(parameters: Mapping[str, object], joint: str, name: str) -> object:
    """Return what is set for one joint, or else for all."""
    node, _, parameter = name.partition('.')
    own = parameters.get(f'{node}.{joint}.{parameter}')
    return parameters.get(name) if own is None else own


def _actuators(
        parameters: Mapping[str, object], given: ActuatorParameters | None, joint: str
) -> tuple[ActuatorParameters, ActuatorParameters, bool, list[str]]:
    """Return the block of the plant and of the planner, whether they are known, and notes."""
    found: dict[str, ActuatorParameters] = {}
    notes = []
    for node in ('plant', 'planner'):
        values = {
            x: _of_joint(parameters, joint, f'{node}.actuator.{x}') for x in ACTUATOR_FIELDS}
        if all(isinstance(x, (int, float)) for x in values.values()):
            for name, value in values.items():
                # What a simulated block has more or less of than it says.
                factor = _of_joint(parameters, joint, f'{node}.mismatch.{name}')
                if isinstance(factor, (int, float)):
                    values[name] = value * factor  # type: ignore[operator]
            try:
                found[node] = ActuatorParameters(**values)  # type: ignore[arg-type]
            except BadInputError as error:
                notes.append(f'The parameters of the {node} in the bag cannot be used: {error}.')
    known = given is not None or bool(found)
    if not known:
        notes.append(
            "The bag does not tell the actuator's parameters: those of the paper's example "
            'block are taken, so that what is simulated here (plain steps, prediction, '
            'equilibria, b and tau) may not be your actuator; name a parameter file with '
            '--params.')
    plant = given or found.get('plant') or found.get('planner') or paper_actuator()
    planner = found.get('planner') or plant
    if plant != planner:
        notes.append(
            'The planner took other parameters for the actuator than the plant has: see the '
            'table of parameters.')
    return plant, planner, known, notes


# Names, and how many positions, velocities and efforts.
_Shape = tuple[tuple[str, ...], int, int, int]


class _Columns:
    """Samples of one shape: log time and stamp, and the numbers, row after row."""

    def __init__(self) -> None:
        self.times = array('q')
        self.numbers = array('d')


class _SampleReader:
    """
    Reads joint states, quickly where they all have one layout.

    Decoding field by field takes longer than everything else together. Joint states of one
    sender differ in their numbers only, so that the places of these are worked out once for
    each length and the rest is compared.
    """

    def __init__(self, decode: Callable[[bytes], Any]) -> None:
        self._decode = decode
        self._layouts: dict[int, _Layout | None] = {}
        self._columns: dict[_Shape, _Columns] = {}
        self.notes: list[str] = []

    def take(self, logged: int, data: bytes) -> None:
        """Take in a sample."""
        length = len(data)
        if length not in self._layouts:
            self._layouts[length] = _Layout.find(data, self._decode)
        layout = self._layouts[length]
        if layout is not None and layout.fits(data):
            sec, nanosec = layout.stamp.unpack_from(data, 4)
            self._put(logged, sec * NANOSECONDS + nanosec, layout.names, [
                x.unpack_from(data, offset) for x, offset in layout.numbers])
            return
        message = self._decode(data)
        self._put(logged, _ns(message.header.stamp), tuple(message.name), [
            tuple(x) for x in (message.position, message.velocity, message.effort)])

    def _put(
            self, logged: int, stamp: int, names: tuple[str, ...],
            numbers: list[tuple[float, ...]]) -> None:
        position, velocity, effort = map(len, numbers)
        shape = (names, position, velocity, effort)
        columns = self._columns.get(shape)
        if columns is None:
            columns = self._columns[shape] = _Columns()
        # Both are made first: what cannot be kept leaves no half of it behind.
        times, row = array('q', (logged, stamp)), array('d', chain.from_iterable(numbers))
        columns.times.extend(times)
        columns.numbers.extend(row)

    def arrays(
            self, where: str, joint: str, *, required: bool
    ) -> tuple[Times, Times, Array, Array, Array]:
        """
        Return stamps, log times, stretch, rate and flux density of one joint.

        Parameters
        ----------
        where : str
            What is read, for the messages.
        joint : str
            Its name; empty if it is not known.
        required : bool
            Whether another joint will not do.

        Returns
        -------
        tuple of ndarray
            Increasing in their stamps.

        Raises
        ------
        BadInputError
            If there is no such joint, or none of its samples can be used.

        """
        self.notes = []
        if not self._columns:
            raise BadInputError(f'{where} holds no message: expected samples of the actuator')
        joint = self._joint(where, joint, required)
        parts = []
        for (names, *widths), columns in self._columns.items():
            place = names.index(joint) if joint in names else 0
            if names and joint not in names or place >= widths[0]:
                continue
            times = np.array(columns.times).reshape(-1, 2)
            numbers = np.array(columns.numbers).reshape(len(times), -1)
            picked = [
                numbers[:, sum(widths[:i]) + place] if place < width
                else np.full(len(times), np.nan) for i, width in enumerate(widths)]
            parts.append((times[:, 0], times[:, 1], *picked))
        if not parts:
            raise BadInputError(
                f'{where} holds no position of joint {joint!r}: expected the stretch')
        logged, stamps, stretch, rate, flux_density = (
            np.concatenate(x) for x in zip(*parts, strict=True))
        order = np.argsort(logged, kind='stable')
        return self._tidy(
            where, *(x[order] for x in (stamps, logged, stretch, rate, flux_density)))

    def _joint(self, where: str, joint: str, required: bool) -> str:
        names = {x for shape in self._columns for x in shape[0]}
        if joint in names or not names:
            return joint
        if required:
            raise BadInputError(
                f'{where} has no joint {joint!r}: expected one of {", ".join(sorted(names))}')
        if _DEFAULT_JOINT in names:
            return _DEFAULT_JOINT
        if len(names) == 1:
            return names.pop()
        raise BadInputError(
            f'{where} has the joints {", ".join(sorted(names))}: expected one; name it with '
            '--joint')

    def _tidy(
            self, where: str, stamps: Times, logged: Times, stretch: Array, rate: Array,
            flux_density: Array) -> tuple[Times, Times, Array, Array, Array]:
        """Leave out what cannot be drawn, sort by stamp and complete the rate."""
        if not stamps.any():
            stamps = logged.copy()
            self.notes.append(
                'The samples carry no stamps: the times at which they were recorded are taken.')
        near = np.abs(stamps - np.sort(stamps)[len(stamps) // 2]) < _FAR
        if not np.all(near):
            self.notes.append(
                f'{np.count_nonzero(~near)} samples are stamped more than 30 days away from the '
                'others: left out.')
            stamps, logged = stamps[near], logged[near]
            stretch, rate, flux_density = stretch[near], rate[near], flux_density[near]
        if np.any(np.diff(stamps) < -_CLOCK_JUMP):
            self.notes.append(
                'The stamps of the samples jump back: the samples are sorted by stamp. Was the '
                'clock reset in the run?')
        order = np.argsort(stamps, kind='stable')
        # Of samples with one stamp the first counts, so that time increases.
        order = order[np.append(True, np.diff(stamps[order]) > 0)]
        good = order[np.abs(stretch[order]) < _LARGEST_STRETCH]
        if len(good) < len(order):
            self.notes.append(
                f'{len(order) - len(good)} samples are not finite numbers, or beyond '
                f'{_LARGEST_STRETCH:g}: left out.')
        if not len(good):
            raise BadInputError(
                f'{where} holds no finite position: expected the stretch as a number')
        stamps, logged, stretch, rate, flux_density = (
            x[good] for x in (stamps, logged, stretch, rate, flux_density))
        missing = ~(np.abs(rate) < _LARGEST_RATE)
        if np.any(missing):
            which = 'Stretch rates' if np.all(missing) \
                else f'{np.count_nonzero(missing)} stretch rates'
            self.notes.append(
                f'{which} were not recorded: they are differences of the stretch.')
            slope = np.gradient(stretch, (stamps - stamps[0]) / NANOSECONDS) \
                if len(stamps) > 1 else np.zeros_like(stretch)
            rate = np.where(missing, slope, rate)
        return stamps, logged, stretch, rate, flux_density


@dataclass(frozen=True)
class _Layout:
    """Where the numbers of a joint state lie, and the bytes between them."""

    stamp: struct.Struct
    numbers: tuple[tuple[struct.Struct, int], ...]
    constant: tuple[tuple[int, int, bytes], ...]
    names: tuple[str, ...]

    def fits(self, data: bytes) -> bool:
        """Return whether a payload of the same length has this layout."""
        return all(data[i:j] == x for i, j, x in self.constant)

    @classmethod
    def find(cls, data: bytes, decode: Callable[[bytes], Any]) -> '_Layout | None':
        """Return the layout of a payload, None if it is not the usual one."""
        if data[:2] != _LITTLE_ENDIAN:
            return None
        message = decode(data)
        place = 12

        def count() -> int:
            nonlocal place
            place += -place % 4
            number: int = struct.unpack_from('<I', data, place)[0]
            place += 4
            return number

        numbers, constant, begin = [], [(0, 4, data[:4])], 12
        try:
            place += count()
            for _ in range(count()):
                length = count()
                place += length
            for values in (message.position, message.velocity, message.effort):
                number = count()
                # Doubles are aligned to 8 from the end of the encapsulation on.
                start = place + (4 - place) % 8 if number else place
                constant.append((begin, place, data[begin:place]))
                numbers.append((struct.Struct(f'<{number}d'), start))
                place = begin = start + 8 * number
                if list(numbers[-1][0].unpack_from(data, start)) != list(values):
                    return None
        except struct.error:
            return None
        return cls(struct.Struct('<iI'), tuple(numbers), tuple(constant), tuple(message.name))


def _ns(stamp: Any) -> int:
    """Return a stamp or a duration in ns."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def read_actuator(path: Path) -> ActuatorParameters:
    """
    Read the block from a parameter file of the nodes.

    Parameters
    ----------
    path : Path
        YAML as ROS 2 has it.

    Returns
    -------
    ActuatorParameters
        What the file leaves out is taken from the paper's example block, as the nodes do.

    Raises
    ------
    BadInputError
        If the file cannot be read or sets no parameter of the actuator.

    """
    import yaml

    try:
        document = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = getattr(error, 'strerror', None) or ' '.join(str(error).split())
        raise BadInputError(
            f'{path} cannot be read ({reason}): expected a parameter file (YAML)') from error
    found: dict[str, Any] = {}
    _flatten(document, '', found)
    values = {field: found[key] for field in ACTUATOR_FIELDS for key in found
              if key.endswith(f'actuator.{field}')}
    if not values:
        raise BadInputError(
            f'{path} sets no parameter of the actuator: expected some of '
            + ', '.join(f'actuator.{x}' for x in ACTUATOR_FIELDS))
    default = paper_actuator()
    return ActuatorParameters(**{
        x: values.get(x, getattr(default, x)) for x in ACTUATOR_FIELDS})


def _flatten(value: object, name: str, found: dict[str, Any]) -> None:
    """Collect the values of nested mappings by dotted name."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _flatten(inner, f'{name}.{key}' if name else str(key), found)
    else:
        found[name] = value
