"""
The state of running nodes, as a line or JSON, collected by polling a few times a second.

Subscriptions have no executor: messages are taken from the middleware at each look, so that a
thousand samples a second cause no callbacks.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
import math
from time import monotonic
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState

from hmsa.errors import BadInputError, printable
from hmsa.files import finite
from hmsa.interfaces import topics
from hmsa.interfaces.diagnostics import real, StatusVerdict, texts, whole
from hmsa.model.delivery import CommandSchedule
from hmsa.model.equations import Array
from hmsa.model.laws.record import COORDINATES, POSITION
from hmsa.model.units import flux_text, NANOSECONDS
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.capture import decode, RawSubscription, Taken
from hmsa_ros.nodes.conversions import from_time
from hmsa_ros.nodes.duplicate_nodes import DuplicateNodes
from hmsa_ros.nodes.temporary_node import leave, visit

#: Number of slots of a chart.
SLOTS = 480
#: Names of the levels of diagnostics and verdicts.
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
#: Counters of problems, the only ones in a line.
TROUBLES = ('late', 'replanned', 'lost', 'refused', 'failed', 'timeouts')
# Time in s without a report, normally one a second, after which a node is silent.
_SILENT_AFTER = 3.5
# Number of samples kept since the last look: all of them at 1 kHz.
_SAMPLES = 200
_SAMPLE_QOS = topics.Quality(_SAMPLES, reliable=False)
_REPORT_QOS = topics.Quality(100, reliable=False)
# Limit on joints times samples read at one look: all of them for up to ten joints at 1 kHz.
_MOST_READ = 1000
# Interval of looks at the graph, and time for discovery, in s.
_GRAPH_SECONDS = 1.0
_DISCOVERY_SECONDS = 1.5
# Time in s without samples after which they are reported as missing; window of their rate.
_QUIET_SECONDS = 2.0
_RATE_SECONDS = 1.0
# Time in s after which reports of ended nodes and of unreadable messages are dropped.
_FORGET_SECONDS = 30.0


class PeakHistory:
    """Minimum and maximum in each slot of the last ``span`` seconds, so that peaks are kept."""

    def __init__(self, span: float) -> None:
        self._slot = span / SLOTS
        self._low = np.full(SLOTS, np.nan)
        self._high = np.full(SLOTS, np.nan)
        self._newest = 0

    def put(self, before: float, now: float, values: Array) -> None:
        """Add samples from between two looks (times in s), assumed evenly spaced."""
        self._advance(now)
        times = before + (now - before) * np.arange(1, len(values) + 1) / max(len(values), 1)
        slots = np.floor(times / self._slot).astype(np.int64)
        kept = slots > self._newest - SLOTS
        np.fmin.at(self._low, slots[kept] % SLOTS, values[kept])
        np.fmax.at(self._high, slots[kept] % SLOTS, values[kept])

    def hold(self, before: float, now: float, value: float) -> None:
        """Add a value that was constant between two looks (times in s)."""
        before = max(before, now - self._slot * (len(self._low) + 1))
        self.put(before, now, np.full(math.ceil((now - before) / self._slot) + 1, value))

    def _advance(self, now: float) -> None:
        newest = math.floor(now / self._slot)
        begun = np.arange(max(self._newest, newest - SLOTS) + 1, newest + 1) % SLOTS
        self._low[begun] = self._high[begun] = np.nan
        self._newest = max(newest, self._newest)

    def ranges(self, now: float) -> tuple[Array, Array]:
        """Return minima and maxima by slot up to ``now`` in s; NaN if empty."""
        self._advance(now)
        order = np.arange(self._newest - SLOTS + 1, self._newest + 1) % SLOTS
        return self._low[order], self._high[order]


@dataclass
class JointView:
    """
    One actuator: newest sample, target and command (in SI, NaN if unknown), and its charts.

    ``coordinate`` is the name of its position coordinate, as far as known.
    """

    name: str
    stretches: PeakHistory
    targets: PeakHistory
    stretch: float = math.nan
    rate: float = math.nan
    flux_density: float = math.nan
    target: float = math.nan
    commanded: float = math.nan
    coordinate: str = POSITION
    fluxes: PeakHistory = field(default_factory=lambda: PeakHistory(10.0))


@dataclass
class Report:
    """Report of a node's health, with the index in `LEVELS`, and its age in s."""

    name: str
    level: int
    message: str
    counts: dict[str, int]
    age: float = 0.0


@dataclass
class Scene:
    """
    State at one moment; unknown numbers are NaN.

    ``now`` is the steady time of this look in s, ``stamp`` the time of the newest sample, which
    arrived ``age`` s ago. ``progress`` is the completed fraction of the plan, ``waiting`` contains
    a sentence for each missing item.
    """

    where: str
    now: float = 0.0
    stamp: float = math.nan
    age: float = math.nan
    sample_rate: float = math.nan
    joints: Sequence[JointView] = field(default_factory=list)
    request: StatusVerdict | None = None
    progress: float = math.nan
    reports: Sequence[Report] = field(default_factory=list)
    waiting: Sequence[str] = field(default_factory=list)


def line(scene: Scene) -> str:
    """Return a scene as one line of plain text, without a newline."""
    parts = [] if math.isnan(scene.stamp) else [_time(scene.stamp)]
    parts += [
        f'{x.name} {_number(x.stretch)} (target {_number(x.target)}, {_level(x)})'
        for x in scene.joints]
    request = scene.request
    if request is not None:
        count = f' {request.setpoint}/{request.setpoints}' if request.setpoints else ''
        parts.append(
            f'{request.state.replace("_", " ")}{count}, {LEVELS[min(request.level, 3)]} '
            f'{request.message}')
        if request.finding not in request.message:
            parts.append(request.finding)
    for report in scene.reports:
        if report.age > _SILENT_AFTER:
            parts.append(f'{report.name}: silent for {report.age:.0f} s')
            continue
        troubles = [f'{x} {report.counts[x]}' for x in TROUBLES if report.counts.get(x)]
        if troubles or report.level:
            parts.append(f'{report.name}: ' + ', '.join([report.message, *troubles]))
    parts += scene.waiting
    return '; '.join(parts)


def _number(value: float) -> str:
    """Return a number as text; a question mark if unknown."""
    return f'{value:.5f}' if math.isfinite(value) else '?'


def _level(joint: JointView) -> str:
    value = joint.flux_density
    return flux_text(value, '+.3f') if math.isfinite(value) else '?'


def _time(stamp: float) -> str:
    """Return a timestamp as the time of day, or in seconds for simulated time."""
    if stamp < 1e8:
        return f'{stamp:.3f} s (simulated)'
    return datetime.fromtimestamp(stamp).strftime('%H:%M:%S')


def as_json(scene: Scene) -> dict[str, Any]:
    """Return a scene for JSON, with None for unknown values."""
    request = scene.request
    found: dict[str, Any] = finite({
        'where': scene.where, 'stamp': scene.stamp, 'age': scene.age,
        'sample_rate': scene.sample_rate,
        'joints': [{
            'name': x.name, 'stretch': x.stretch, 'stretch_rate': x.rate,
            'flux_density': x.flux_density, 'target': x.target,
            'flux_density_command': x.commanded} for x in scene.joints],
        'request': request and {
            'level': LEVELS[min(request.level, 3)], 'message': request.message,
            'code': request.code, 'state': request.state, 'setpoint': request.setpoint,
            'setpoints': request.setpoints, 'finding': dict(request.figures) or None},
        'progress': scene.progress,
        'reports': [{
            'name': x.name, 'level': LEVELS[min(x.level, 3)], 'message': x.message,
            'counts': x.counts, 'age': x.age} for x in scene.reports],
        'waiting': list(scene.waiting)})
    return found


@dataclass
class _Source:
    """A subscription, with a count of its unreadable messages."""

    topic: str
    kind: type[Any]
    subscription: RawSubscription
    unreadable: int = 0
    complaint: str = ''
    complained: float = -math.inf

    def read(self, taken: Iterable[Taken]) -> Iterator[Any]:
        """Yield the readable messages."""
        for one in taken:
            try:
                yield decode(one.data, self.kind)
            except BadInputError as error:
                self.unreadable += 1
                self.complaint = str(error)
                self.complained = monotonic()

    def new(self) -> Iterator[Any]:
        """Yield the readable messages that have arrived."""
        return self.read(self.subscription.take())


class Listener:
    """
    Monitor the nodes of one namespace; a context manager.

    All joints are shown by default; the charts cover the last ``span`` seconds.
    """

    def __init__(
            self, *, namespace: str = '', joints: Sequence[str] = (),
            span: float = 10.0) -> None:
        self._wanted = tuple(joints)
        self._span = span
        self._node = visit(
            'watch', namespace, enable_rosout=False, start_parameter_services=False)
        self._domain = int(self._node.context.get_domain_id())
        self._sources: list[_Source] = []
        self._samples = self._subscribe(topics.JOINT_STATES, _SAMPLE_QOS)
        self._status = self._subscribe(topics.STATUS)
        self._plan = self._subscribe(topics.PLAN)
        self._diagnostics = self._subscribe(topics.DIAGNOSTICS, _REPORT_QOS)
        self._commands: dict[str, tuple[_Source, CommandSchedule]] = {}
        self._joints: dict[str, JointView] = {}
        self._heard: dict[tuple[str, str, str], tuple[float, Report]] = {}
        self._request: StatusVerdict | None = None
        self._targets: dict[str, float] = {}
        self._coordinates: dict[str, str] = {}
        self._planned_joints: tuple[str, ...] = ()
        self._plan_span: tuple[int, int] | None = None
        self._begin = self._looked = monotonic()
        self._graph_at = -math.inf
        self._senders = {'samples': 0, 'planner': 0}
        self._duplicates, self._crowd = DuplicateNodes(self._node), list[str]()
        self._stamp: int | None = None
        self._arrived = -math.inf
        self._rate = math.nan
        self._counted: tuple[float, int] | None = None

    def __enter__(self) -> 'Listener':
        return self

    def __exit__(self, *_: object) -> None:
        for source in self._sources:
            source.subscription.destroy()
        self._duplicates.close()
        leave(self._node)

    def _subscribe(self, topic: topics.Topic, qos: topics.Quality | None = None) -> _Source:
        source = _Source(
            self._node.resolve_topic_name(topics.from_outside(topic.name, topics.PLANNER)),
            ros_entities.interface_class(topic.type), ros_entities.listen(
                self._node, replace(topic, qos=qos or topic.qos), topics.PLANNER))
        self._sources.append(source)
        return source

    def look(self) -> Scene:
        """Return the present scene, including messages since the last look."""
        now = monotonic()
        if now - self._graph_at >= _GRAPH_SECONDS:
            self._graph_at = now
            self._look_at_graph()
        self._take_planner()
        self._take_samples(now)
        self._take_commands()
        self._take_reports(now)
        for name, joint in self._joints.items():
            joint.target = self._targets.get(name, math.nan)
            joint.coordinate = self._coordinates.get(name, joint.coordinate)
            if math.isfinite(joint.target):
                joint.targets.hold(self._looked, now, joint.target)
        self._looked = now
        shown = [x for x in self._joints.values() if not self._wanted or x.name in self._wanted]
        return Scene(
            where=f'domain {self._domain}  {self._node.get_namespace()}', now=now,
            stamp=math.nan if self._stamp is None else self._stamp / NANOSECONDS,
            age=now - self._arrived if self._stamp is not None else math.nan,
            sample_rate=self._rate, joints=shown, request=self._request,
            progress=self._progress(), waiting=self._waiting(now, len(shown)),
            reports=self._reports(now))

    # -- messages ------------------------------------------------------------------------------

    def _look_at_graph(self) -> None:
        node = self._node
        self._duplicates.look()
        self._crowd = [x for x in (
            self._duplicates.planners(topics.PLANNER),
            self._duplicates.devices(self._planned_joints or tuple(self._joints))) if x]
        self._senders = {
            'samples': node.count_publishers(self._samples.topic),
            'planner': node.count_publishers(self._status.topic)}
        space = node.get_namespace().rstrip('/')
        end = f'/{topics.FLUX_DENSITY_COMMAND.name}'
        for name, _ in node.get_topic_names_and_types():
            if name.startswith(f'{space}/') and name.endswith(end):
                joint = name[len(space):-len(end)].strip('/')
                if '/' not in joint and joint not in self._commands:
                    self._commands[joint] = self._subscribe(
                        replace(topics.FLUX_DENSITY_COMMAND, name=name),
                        _REPORT_QOS), CommandSchedule(math.nan)

    def _take_planner(self) -> None:
        for message in self._plan.new():
            self._planned_joints = tuple(printable(x) for x in message.joint_names)
            start = from_time(message.header.stamp)
            times = [from_time(x.time_from_start) for x in message.points]
            self._plan_span = (start, start + max(times)) if times else None
        for message in self._status.new():
            values = texts(message)
            # Keys of a single joint have no joint name; those of several have.
            self._name_coordinates(message.hardware_id, values)
            self._targets = {
                key.rpartition('.')[0] or printable(message.hardware_id): real(value)
                for key, value in values.items() if key.rpartition('.')[2] == 'stretch'}
            self._request = StatusVerdict.read(message)

    def _take_samples(self, now: float) -> None:
        arrived = self._samples.subscription.take()
        if not arrived:
            if now - self._arrived > _QUIET_SECONDS:
                self._rate, self._counted = math.nan, None
            return
        # With many joints, not every sample can be read in time.
        every = max(1, math.ceil(len(arrived) * len(self._joints) / _MOST_READ))
        taken: dict[tuple[str, ...], list[JointState]] = {}
        for message in self._samples.read(arrived[::-1][::every][::-1]):
            taken.setdefault(tuple(printable(x) for x in message.name), []).append(message)
            self._stamp = from_time(message.header.stamp)
        if not taken:
            return
        self._arrived = now
        number = arrived[-1].sequence
        if self._counted is None or number < self._counted[1]:
            self._counted = now, number
        elif now - self._counted[0] >= _RATE_SECONDS:
            self._rate = (number - self._counted[1]) / (now - self._counted[0])
            self._counted = now, number
        for names, messages in taken.items():
            self._put(now, names, messages)

    def _put(self, now: float, names: tuple[str, ...], messages: list[JointState]) -> None:
        newest = messages[-1]
        messages = [x for x in messages if len(x.position) == len(names)]
        if not messages:
            return
        stretches = np.array([x.position for x in messages], dtype=np.float64)
        for i, name in enumerate(names):
            joint = self._joints.get(name)
            if joint is None:
                joint = self._joints[name] = JointView(
                    name, PeakHistory(self._span), PeakHistory(self._span),
                    fluxes=PeakHistory(self._span))
            joint.stretch = float(stretches[-1, i])
            joint.rate = newest.velocity[i] if i < len(newest.velocity) else math.nan
            joint.flux_density = newest.effort[i] if i < len(newest.effort) else math.nan
            finite = stretches[np.isfinite(stretches[:, i]), i]
            if len(finite):
                joint.stretches.put(self._looked, now, finite)
            fluxes = np.array([x.effort[i] for x in messages if i < len(x.effort)])
            joint.fluxes.put(self._looked, now, fluxes[np.isfinite(fluxes)])

    def _take_commands(self) -> None:
        for name, (source, schedule) in self._commands.items():
            for message in source.new():
                schedule.insert(from_time(message.header.stamp), message.magnetic_field.z)
            # Without the time of a sample, the newest command applies.
            value = schedule.apply_until(math.inf if self._stamp is None else self._stamp)
            joint = self._joints.get(name or self._only_joint())
            if joint is not None:
                joint.commanded = value

    def _only_joint(self) -> str:
        """Return the joint of topics without a joint name."""
        for names in (self._planned_joints, tuple(self._joints)):
            if len(names) == 1:
                return names[0]
        return ''

    def _take_reports(self, now: float) -> None:
        for message in self._diagnostics.new():
            for status in message.status:
                name = printable(status.name.partition(':')[0].strip().rpartition('/')[2])
                # Diagnostics of a robot cover many other components.
                if name not in topics.NODES and status.hardware_id not in self._joints:
                    continue
                values = texts(status)
                self._name_coordinates(status.hardware_id, values)
                counts = {key: whole(value) for key, value in values.items()
                          if '.' not in key and value.isdigit()}
                self._heard[name, status.name, status.hardware_id] = now, Report(
                    name, status.level[0], printable(status.message), counts)
        self._heard = {
            key: (when, report) for key, (when, report) in self._heard.items()
            if now - when <= _FORGET_SECONDS}

    def _name_coordinates(self, joint: str, values: Mapping[str, str]) -> None:
        """Record coordinate names from a status, whose keys have no joint name for one joint."""
        for key, value in values.items():
            name, _, last = key.rpartition('.')
            if last == 'coordinate' and value in COORDINATES:
                self._coordinates[name or printable(joint)] = value

    def _reports(self, now: float) -> list[Report]:
        """Return the worst report of each node, with all of its counters."""
        by_node: dict[str, list[tuple[float, Report]]] = {}
        for (name, _, _), said in sorted(self._heard.items(), key=lambda x: x[0]):
            by_node.setdefault(name, []).append(said)
        reports = []
        for name, heard in by_node.items():
            worst = max((x for _, x in heard), key=lambda x: x.level)
            counts: Counter[str] = Counter()
            for _, report in heard:
                counts.update(report.counts)
            reports.append(Report(
                name, worst.level, worst.message, dict(counts),
                now - max(when for when, _ in heard)))
        return reports

    # -- derived values ------------------------------------------------------------------------

    def _progress(self) -> float:
        if self._plan_span is None or self._stamp is None:
            return math.nan
        begin, end = self._plan_span
        if end <= begin:
            return float(self._stamp >= end)
        return min(max((self._stamp - begin) / (end - begin), 0.0), 1.0)

    def _waiting(self, now: float, shown: int) -> list[str]:
        """Return what is missing, with the possible reason."""
        if now - self._begin < _DISCOVERY_SECONDS:
            return self._crowd or ([] if shown or self._request else ['looking around'])
        where = f'on domain {self._domain}'
        if self._node.get_namespace() != '/':
            where += f' in namespace {self._node.get_namespace()}'
        mend = ('is it running, with the same ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE '
                'as here?')
        sentences = self._crowd.copy()
        if not self._senders['samples']:
            sentences.append(f'no plant or driver that sends joint states seen {where}: {mend}')
        elif now - self._arrived > _QUIET_SECONDS:
            quiet = now - max(self._arrived, self._begin)
            sentences.append(
                f'nothing on {self._samples.topic} for {quiet:.0f} s: is the plant paused?')
        elif not shown:
            sentences.append(
                f'no joint {" or ".join(self._wanted)} on {self._samples.topic}: it has '
                + ', '.join(list(self._joints)[:8]))
        if not self._senders['planner']:
            sentences.append(f'no planner seen {where}: {mend}')
        sentences += [
            f'{x.unreadable} messages on {x.topic} ignored ({x.complaint}): end the program '
            'that publishes them, or remap its topic'
            for x in self._sources if now - x.complained < _FORGET_SECONDS]
        return sentences
