"""
Reading of runs from a bag.

Topics are found by the end of their name and their type, so that any namespace is possible. The
bag may be recorded by this package or rosbag2, from a simulated plant or a coil.
"""

from array import array
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from hmsa.bag import limits
from hmsa.bag.info import BagSummary, summarize
from hmsa.bag.reader import BagReader, Message
from hmsa.errors import assume, BadInputError, BagError, meant, MissingWarning
from hmsa.interfaces.diagnostics import newest, Outcome
from hmsa.interfaces.parameters import JOINT
from hmsa.judge.records import SensorModel
from hmsa.model.delivery import is_axial_field
from hmsa.model.thermal import COLDEST, HOTTEST
from hmsa.model.units import NANOSECONDS
from hmsa.runs import topics as roles
from hmsa.runs.parameters import actuators, named_joint, recorded
from hmsa.runs.record import LearntSensor, RecordedLevel, RecordedVerdict, Run
from hmsa.runs.topics import topics_by_joint, unanswered

#: Maximum step back in time, in ns, due to samples that overtake one another; more is a clock.
CLOCK_JUMP = 100_000_000
# Distance of a timestamp from the others, in ns, above which the sample is invalid.
_FAR = 30 * 86_400 * NANOSECONDS
# Larger values are not a motion of a block and cannot be plotted; the rate is in 1/s.
_LARGEST_STRETCH, _LARGEST_RATE = 1e6, 1e12

#: Columns of a run by name, of shape (n,); see `hmsa.runs.record.Run`.
Columns = dict[str, Any]
_COLUMNS = ('logged', 'time', 'stretch', 'rate', 'flux_density')
# Time between samples that is a gap in a bag with missing messages, relative to the median.
_UNUSUAL_STEP = 10
# Messages between two calls of the progress callback.
_PROGRESS_MESSAGES = 20_000
_MOST_NOTES = 20
# Longest time in ns from the last sample to a decision: far longer than samples are waited for.
_LATEST = 10 * NANOSECONDS
_LEVELS = ('ok', 'warning', 'error')


def nanoseconds_of(stamp: Any) -> int:
    """Return a timestamp or a duration in ns."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


# Names, and numbers of positions, velocities and efforts.
_Shape = tuple[tuple[str, ...], int, int, int]


class SampleColumns:
    """Columns of joint states with any joints and shapes."""

    def __init__(self) -> None:
        # Recording times and timestamps, and the values, row by row.
        self._columns: defaultdict[_Shape, tuple[array[int], array[float]]] = defaultdict(
            lambda: (array('q'), array('d')))

    def take(self, logged: int, message: Any) -> None:
        """Add a sample."""
        numbers = [tuple(x) for x in (message.position, message.velocity, message.effort)]
        position, velocity, effort = map(len, numbers)
        # Convert both first, so that an error leaves no partial row.
        times = array('q', (logged, nanoseconds_of(message.header.stamp)))
        row = array('d', chain.from_iterable(numbers))
        kept = self._columns[tuple(message.name), position, velocity, effort]
        kept[0].extend(times)
        kept[1].extend(row)

    @property
    def names(self) -> set[str]:
        """Names of joints in the samples."""
        return {x for shape in self._columns for x in shape[0]}

    def columns(
            self, where: str, joint: str, *, required: bool) -> tuple[Columns, list[str], int]:
        """
        Return a joint's sorted samples, notes for the reader, and the number of rejected samples.

        Unless ``required``, another joint may be used. Raise `BadInputError` if there is no such
        joint, or none of its samples can be used; ``where`` names the source.
        """
        if not self._columns:
            raise BadInputError(
                f'{where} contains no usable message: expected samples of the actuator')
        joint = self._joint(where, joint, required)
        parts = []
        total = 0
        for (names, *widths), (stamps, rows) in self._columns.items():
            place = names.index(joint) if joint in names else 0
            times = np.array(stamps).reshape(-1, 2)
            total += len(times)
            if names and joint not in names or place >= widths[0]:
                continue
            numbers = np.array(rows).reshape(len(times), -1)
            picked = [
                numbers[:, sum(widths[:i]) + place] if place < width
                else np.full(len(times), np.nan) for i, width in enumerate(widths)]
            parts.append((times[:, 0], times[:, 1], *picked))
        if not parts:
            raise BadInputError(
                f'{where} contains no position of joint {joint!r}: expected the stretch, '
                'or the deflection of a beam')
        found = dict(zip(
            _COLUMNS, map(np.concatenate, zip(*parts, strict=True)), strict=True))
        left_out = total - len(found['logged'])
        found, notes, more = _tidy(
            where, _rows(found, np.argsort(found['logged'], kind='stable')))
        return found, notes, left_out + more

    def _joint(self, where: str, joint: str, required: bool) -> str:
        names = self.names
        if joint in names or not names:
            return joint
        if required:
            raise BadInputError(
                f'{where} has no joint {joint!r}: expected one of {", ".join(sorted(names))}'
                + meant(joint, names))
        if JOINT.default in names:
            return str(JOINT.default)
        if len(names) == 1:
            return names.pop()
        raise BadInputError(
            f'{where} has the joints {", ".join(sorted(names))}: expected one; name it with '
            '--joint')


def _rows(columns: Columns, rows: Any) -> Columns:
    """Return some rows of all columns."""
    return {name: x[rows] for name, x in columns.items()}


def _tidy(where: str, columns: Columns) -> tuple[Columns, list[str], int]:
    """Reject impossible samples, sort by timestamp and complete the rate; see `columns`."""
    notes = []
    if not columns['time'].any():
        columns['time'] = columns['logged'].copy()
        notes.append('The samples have no timestamps: the receive times are used.')
    stamps = columns['time']
    near = np.abs(stamps - np.sort(stamps)[len(stamps) // 2]) < _FAR
    good = near & (np.abs(columns['stretch']) < _LARGEST_STRETCH)
    far, odd = len(near) - int(np.count_nonzero(near)), int(np.count_nonzero(near & ~good))
    if far:
        notes.append(
            f'{far} samples are stamped more than 30 days away from the others: left out.')
    if odd:
        notes.append(
            f'{odd} samples are not finite numbers, or beyond {_LARGEST_STRETCH:g}: left out.')
    if not np.any(good):
        raise BadInputError(
            f'{where} contains no finite position: expected the stretch as a number')
    columns = _rows(columns, good)
    if np.any(np.diff(columns['time']) < -CLOCK_JUMP):
        notes.append(
            'The timestamps of the samples jump back: the samples are sorted by timestamp. Was '
            'the clock reset in the run?')
    # Of samples with equal timestamps use the first, so that time increases.
    _, first, places = np.unique(columns['time'], return_index=True, return_inverse=True)
    same = int(np.count_nonzero(columns['stretch'] != columns['stretch'][first][places]))
    if same:
        notes.append(
            f'{same} samples have the timestamp of an earlier one, and another value: left out. '
            'Are the timestamps rounded, or of two runs?')
    columns = _rows(columns, first)
    stamps, stretch, rate = columns['time'], columns['stretch'], columns['rate']
    missing = ~(np.abs(rate) < _LARGEST_RATE)
    if np.any(missing):
        which = 'Stretch rates' if np.all(missing) \
            else f'{np.count_nonzero(missing)} stretch rates'
        notes.append(f'{which} were not recorded: they are differences of the stretch.')
        slope = np.gradient(stretch, (stamps - stamps[0]) / NANOSECONDS) \
            if len(stamps) > 1 else np.zeros_like(stretch)
        columns['rate'] = np.where(missing, slope, rate)
    return columns, notes, far + odd + same


def read_runs(
        path: str | Path, *, parameters: Mapping[str, object] | None = None,
        joints: Sequence[str] = (), max_chunk_size: int = limits.CHUNK_SIZE,
        progress: Callable[[str, float], None] = lambda what, share: None) -> list[Run]:
    """
    Read a bag: one run for each actuator with joint states.

    Parameters
    ----------
    path : str or Path
        Folder of a bag, or an ``.mcap`` file.
    parameters : mapping of str to object, optional
        True parameters of the block and its coil, from `read_parameter_file`; default those in
        the bag.
    joints : sequence of str
        Names of the actuators in the joint states; default all that have their own commands, or
        the one that the nodes name.
    max_chunk_size : int
        As for `BagReader`.
    progress : callable
        Called with a description of the work and the completed fraction.

    Returns
    -------
    list of Run
        At least one, ordered by namespace and joint. A `MissingWarning` reports messages that are
        missing from them.

    Raises
    ------
    BadInputError
        If there is no bag, or it has no samples of an actuator.

    """
    path = Path(path)
    reader = BagReader(path, max_chunk_size=max_chunk_size)
    spaces = topics_by_joint(reader)
    collected = _collect(reader, spaces, progress)
    summary = summarize(reader)
    for one in collected.values():
        one.notes += unanswered(reader)
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
                        f'{name} {wanted}' if several else name, reader, summary, topics,
                        parameters or {}, joint, wanted))
                except BadInputError as error:
                    reasons.append(error)
    if not runs:
        # Skipped messages may be the reason.
        notes = [x for each in collected.values() for x in each.notes]
        raise BadInputError('; '.join([str(reasons[0]), *notes[:1]]))
    if missing := summary.missing({x for run in runs for x in run.topics.values()}):
        assume('; '.join([f'{path}: {missing}', *filter(None, map(_gap, runs))]), MissingWarning)
    return runs


def _gap(run: Run) -> str:
    """Return the longest time without samples as a part of a sentence; empty if it is usual."""
    steps = np.diff(run.time)
    if not len(steps) or (longest := int(steps.max())) < _UNUSUAL_STEP * np.median(steps):
        return ''
    begin = run.time[int(steps.argmax())] - run.time[0]
    return (f'{run.label} has no samples for {longest / NANOSECONDS:.3g} s from '
            f'{begin / NANOSECONDS:.3g} s on')


def read_run(
        path: Path, *, joint: str = '',
        progress: Callable[[str, float], None] = lambda what, share: None) -> Run:
    """Read the single run of a bag, as `read_runs`; raise `BadInputError` if there are several."""
    runs = read_runs(path, joints=[joint] if joint else [], progress=progress)
    if len(runs) > 1:
        raise BadInputError(
            f'{path} has the runs {", ".join(x.label for x in runs)}: expected one; ' + (
                f'name its actuator, as in --joint {runs[0].joint} or joint={runs[0].joint!r}'
                if len({x.joint for x in runs}) == len(runs)
                else 'record the topics of one namespace in a bag'))
    return runs[0]


def _collect(
        reader: BagReader, spaces: Mapping[str, Mapping[str, Mapping[str, str]]],
        progress: Callable[[str, float], None]) -> 'dict[str, _Collected]':
    """Read all messages of some topics, by namespace."""
    # The topics of a namespace, and those of each joint in it.
    found = {topic: (space, role, joint) for space, by_joint in spaces.items()
             for joint, topics in by_joint.items() for role, topic in topics.items()}
    decoders: dict[str, Callable[[bytes], Any]] = {}
    for topic in found:
        try:
            decoders[topic] = reader.decoder(topic)
        except BagError as error:
            raise BadInputError(f'{reader.path} cannot be evaluated: {error}') from error
    collected = {space: _Collected() for space in spaces}
    begin, end = reader.start_time or 0, reader.end_time or 0
    for i, message in enumerate(reader.messages(list(found))):
        if i % _PROGRESS_MESSAGES == 0:
            progress(
                f'reading {reader.path.name}', (message.log_time - begin) / max(end - begin, 1))
        space, role, joint = found[message.topic]
        collected[space].take(role, joint, message, decoders[message.topic])
    for one in collected.values():
        one.order()
    return collected


@dataclass(frozen=True)
class _Point:
    """A change of level in a plan: time from its start in ns, and values by joint."""

    time: int
    positions: tuple[float, ...]
    velocities: tuple[float, ...]
    effort: tuple[float, ...]


@dataclass(frozen=True)
class _SentPlan:
    """A plan as received, with its timestamp in ns."""

    sent: int
    joints: tuple[str, ...]
    stamp: int
    points: tuple[_Point, ...]

    @classmethod
    def of(cls, sent: int, message: Any) -> '_SentPlan':
        """Return the plan in a message."""
        return cls(sent, tuple(message.joint_names), nanoseconds_of(message.header.stamp), tuple(
            _Point(nanoseconds_of(x.time_from_start), *(
                tuple(map(float, y)) for y in (x.positions, x.velocities, x.effort)))
            for x in message.points))


class _Collected:
    """Data read so far for the actuators of one namespace; dictionaries are by joint."""

    def __init__(self) -> None:
        self.samples = SampleColumns()
        self.commands: defaultdict[str, list[RecordedLevel]] = defaultdict(list)
        self.applied: defaultdict[str, list[RecordedLevel]] = defaultdict(list)
        self.forces: defaultdict[str, list[tuple[int, int, float]]] = defaultdict(list)
        self.temperatures: defaultdict[str, list[tuple[int, int, float]]] = defaultdict(list)
        self.refused = Counter[str]()
        # Of all joints, with the time of publishing by the planner's clock: all are latched, and
        # a new subscriber receives old ones, perhaps after newer ones.
        self.plans: list[tuple[int, _SentPlan]] = []
        self.verdicts: list[tuple[int, RecordedVerdict]] = []
        self.outcomes: list[tuple[int, Outcome]] = []
        # With the joint of each.
        self.sensors: list[tuple[str, LearntSensor]] = []
        self.notes: list[str] = []
        self.left_out = 0

    def take(
            self, role: str, joint: str, message: Message,
            decode: Callable[[bytes], Any]) -> None:
        """Add a message, or count and note it if it does not fit its topic."""
        try:
            self._take(role, joint, message, decode(message.data))
        except (AttributeError, TypeError, ValueError, OverflowError, BagError) as error:
            # The bag contains the definition, which may be anything.
            reason = str(error) if isinstance(error, BagError) else (
                f'a message of topic {message.topic} is not as {roles.TYPES[role]} is defined in '
                f'ROS 2: {error}')
            self.left_out += 1
            if len(self.notes) < _MOST_NOTES:
                self.notes.append(f'{reason}: left out')

    def _take(self, role: str, joint: str, message: Message, content: Any) -> None:
        sent = message.log_time
        if role == roles.JOINT_STATES:
            self.samples.take(sent, content)
        elif role in (roles.COMMAND, roles.APPLIED):
            vector = content.magnetic_field
            if is_axial_field(vector.x, vector.y, vector.z):
                stamp = nanoseconds_of(content.header.stamp)
                kept = self.commands if role == roles.COMMAND else self.applied
                kept[joint].append(RecordedLevel(
                    stamp or (sent if role == roles.COMMAND else 0), float(vector.z), sent))
            else:
                self.refused[joint] += 1
        elif role == roles.FORCE:
            self.forces[joint].append((
                sent, nanoseconds_of(content.header.stamp) or sent,
                float(content.wrench.force.z)))
        elif role == roles.TEMPERATURE:
            if COLDEST <= content.temperature <= HOTTEST:
                self.temperatures[joint].append((
                    sent, nanoseconds_of(content.header.stamp) or sent,
                    float(content.temperature)))
            else:
                self.left_out += 1
        elif role == roles.PLAN:
            self.plans.append((message.publish_time, _SentPlan.of(sent, content)))
        elif role == roles.OUTCOMES:
            self.outcomes.append((message.publish_time, Outcome.read(content)))
        elif role == roles.ESTIMATE:
            self.sensors += (
                (x.hardware_id, LearntSensor(
                    sent, SensorModel.of({y.key: y.value for y in x.values})))
                for x in content.status)
        else:
            level = content.level[0] if isinstance(content.level, bytes) else int(content.level)
            values = {x.key: x.value for x in content.values}
            self.verdicts.append((message.publish_time, RecordedVerdict(
                sent, _LEVELS[min(level, 2)], values.get('code', ''), content.message)))

    def order(self) -> None:
        """Sort the messages of the planner by the order of publishing."""
        for kept in (self.plans, self.verdicts, self.outcomes):
            kept.sort(key=lambda x: x[0])

    def _plans(self, joint: str) -> Iterator[tuple[RecordedLevel, ...]]:
        """Yield the plans of a joint, and those without joint names."""
        for _, plan in self.plans:
            place = _place(plan.joints, joint)
            if place is None:
                continue
            levels = [
                RecordedLevel(
                    plan.stamp + x.time, x.effort[place], plan.sent, x.positions[place],
                      x.velocities[place])
                for x in plan.points
                if min(len(x.positions), len(x.velocities), len(x.effort)) > place]
            if len(plan.joints) > 1:
                # The plan has a point for each change of any joint, from the present levels on.
                first = bisect_right(levels, plan.sent, key=lambda x: x.stamp)
                levels = levels[max(first - 1, 0):]
                levels = [x for i, x in enumerate(levels) if i == 0
                          or x.flux_density != levels[i - 1].flux_density]
            yield tuple(levels)

    def _outcomes(self, joint: str, begin: int, end: int) -> Iterator[Outcome]:
        """Yield the outcomes of a joint that were decided in a recording, of times in ns."""
        several = len({x.joint for _, x in self.outcomes}) > 1
        for outcome in newest(x for _, x in self.outcomes):
            # What is latched may be of before, also by a clock that was set back.
            if begin < outcome.decided < end + _LATEST and (
                    outcome.joint == joint or not several):
                yield outcome

    def finish(
            self, label: str, reader: BagReader, summary: BagSummary, topics: Mapping[str, str],
            given: Mapping[str, object], key: str, joint: str) -> Run:
        """Return the run of one joint, with or without the joint's name in the topics."""
        states = topics[roles.JOINT_STATES]
        parameters = recorded(reader.custom_data, states[:-len(roles.JOINT_STATES)])
        planned = [x for _, plan in self.plans for x in plan.joints]
        beside = topics.get(roles.COMMAND, '').split('/')[-2:-1]
        named = joint or next(
            (x for x in (*planned, named_joint(parameters), *beside) if x in self.samples.names),
            '')
        samples, sample_notes, lost_samples = self.samples.columns(
            f'{reader.path}: {states}', named, required=bool(joint))
        plant, planner, known, more = actuators(parameters, given, named)
        if warm := self.temperatures[key]:
            # The parameters are those at the temperature of the run.
            mean = sum(x for _, _, x in warm) / len(warm)
            plant, planner = plant.at_temperature(mean), planner.at_temperature(mean)
        refused = self.refused[key]
        notes = [*self.notes, *summary.problems]
        if roles.COMMAND not in topics:
            notes.append(
                f'The recording has no {roles.COMMAND}: unshaped steps and lateness are unknown, '
                'and so are setpoints that were not requested.')
        elif not self.commands[key]:
            notes.append(
                f'{topics[roles.COMMAND]} contains no command: there is no setpoint to evaluate.')
        if refused:
            notes.append(
                f'{refused} commands are not finite or not along z: left out, as the plant '
                'does.')
        time = samples['time']
        outcomes = tuple(self._outcomes(named, int(time[0]), int(time[-1])))
        notes += _undecided(outcomes, topics)
        run = Run(
            label, named, reader.path, **samples, commands=tuple(self.commands[key]),
            applied=_begun(self.applied[key], int(samples['time'][0])),
            forces=tuple(self.forces[key]), temperatures=tuple(warm),
            plans=tuple(self._plans(joint)),
            verdicts=tuple(x for _, x in self.verdicts), outcomes=outcomes, sensors=tuple(
                x for of, x in self.sensors
                if of == joint or len({y for y, _ in self.sensors}) == 1),
            parameters={**parameters, **given}, plant=plant, planner=planner,
            parameters_known=known, left_out=self.left_out + refused + lost_samples,
            notes=(*notes, *sample_notes, *more), topics=topics, summary=summary,
            origin='simulated' if any(x.startswith('plant.') for x in parameters) else 'recorded')
        if not (lost := run.lost(roles.COMMAND, roles.APPLIED)):
            return run
        return replace(run, notes=(
            *run.notes, f'The recorder lost {" and ".join(lost)}: levels may be missing; record '
            'on a machine that is less busy.'))


def _undecided(outcomes: Sequence[Outcome], topics: Mapping[str, str]) -> Iterator[str]:
    """Yield what is not known of the setpoints of a recording, as a sentence."""
    if roles.OUTCOMES not in topics:
        if roles.COMMAND in topics:
            yield (f'The run was recorded without outcomes ({roles.OUTCOMES}): its setpoints are '
                   'the levels that lasted, not what was requested.')
        return
    last = max(outcomes, key=lambda x: (x.setpoint.begins, x.through), default=None)
    if last is not None and (count := last.setpoint.count) > (
            known := max(last.through, last.setpoint.number)):
        which = f's {known + 1} to {count} were' if known + 1 < count else f' {count} was'
        yield f'The recording ended before setpoint{which} decided: not evaluated.'


def _begun(levels: Sequence[RecordedLevel], first: int) -> tuple[RecordedLevel, ...]:
    """Return the changes that took effect; time 0 means before the first sample."""
    known = any(0 < x.stamp <= first for x in levels)
    return tuple(
        x if x.stamp else replace(x, stamp=min(x.sent, first)) for x in levels
        if x.stamp or not known)


def _place(names: Sequence[str], joint: str) -> int | None:
    """Return the index of a joint among names; the first if there are no names or no joint."""
    if joint in names:
        return list(names).index(joint)
    return 0 if not joint or not names else None
