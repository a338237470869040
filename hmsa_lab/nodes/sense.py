"""Sense node: publishes stretch measured by sensors of other packages as joint_states."""

from bisect import bisect_right, insort
from collections.abc import Callable, Iterable
import dataclasses
from functools import partial
import heapq
import math
from time import monotonic_ns
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
import numpy as np
from rclpy.expand_topic_name import expand_topic_name
from sensor_msgs.msg import JointState

from hmsa.errors import BadInputError, HmsaError
from hmsa.interfaces import topics
from hmsa.interfaces.parameters import JOINT, ParameterSpec
from hmsa.model.equations import Array
from hmsa.model.units import NANOSECONDS
from hmsa_lab.bench.assembly import SensorScale
from hmsa_lab.nodes import fields
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.conversions import from_time, to_status, to_time
from hmsa_ros.nodes.managed import ManagedNode, run
from hmsa_ros.nodes.parameters import declare

# Number of reference readings stored for interpolation.
_KEPT = 1000


class Readings:
    """
    Sort readings by their timestamps, and subtract those of a reference.

    A reading is a number or a vector. The result for a vector, or a difference of vectors, is its
    length.

    Parameters
    ----------
    window : int
        Time to wait for an earlier reading, in ns; one that arrives later is discarded.
    reference : bool
        Whether there is a reference. It is interpolated between its readings; readings before the
        first one are discarded.

    """

    def __init__(self, window: int = 0, *, reference: bool = False) -> None:
        self._window, self._needs_reference = window, reference
        # By timestamp: waiting readings, each with the end of its wait and its number.
        self._waiting: list[tuple[int, int, int, Array]] = []
        self._reference: list[tuple[int, Array]] = []
        self._last = 0
        self.count = 0  # number of readings
        self.late = 0  # number discarded since a later one was returned before

    def take(self, stamp: int, reading: Array, now: int) -> None:
        """Add a reading with a timestamp in ns; ``now`` is a steady time in ns."""
        self.count += 1
        if stamp <= self._last:
            self.late += 1
        else:
            heapq.heappush(self._waiting, (stamp, now + self._window, self.count, reading))

    def take_reference(self, stamp: int, reading: Array) -> None:
        """Add a reading of the reference."""
        insort(self._reference, (stamp, reading), key=lambda x: x[0])
        del self._reference[:-_KEPT]

    def due(self, now: int) -> list[tuple[int, float]]:
        """Return timestamps and values of the readings whose wait is over."""
        until = max((x[0] for x in self._waiting if x[1] <= now), default=0)
        found = []
        while self._waiting and self._waiting[0][0] <= until:
            stamp, _, _, reading = heapq.heappop(self._waiting)
            if self._needs_reference:
                if not self._reference or self._reference[0][0] > stamp:
                    continue
                reading = reading - self._at(stamp)
            self._last = stamp
            number = reading[0] if len(reading) == 1 else np.linalg.norm(reading)
            found.append((stamp, float(number)))
        return found

    def _at(self, stamp: int) -> Array:
        """Interpolate the reference at a time; after its last reading, that reading applies."""
        place = bisect_right(self._reference, stamp, key=lambda x: x[0])
        before, reading = self._reference[place - 1]
        if place == len(self._reference):
            return reading
        after, next_reading = self._reference[place]
        return reading + (next_reading - reading) * ((stamp - before) / (after - before))


def reader(type_name: str, kind: type[Any], path: str, element: str) -> Callable[[Any], Any]:
    """
    Return a function that extracts timestamp and reading from a message.

    Parameters
    ----------
    type_name : str
        Such as ``'geometry_msgs/msg/PoseStamped'``.
    kind : type
        Class of the messages.
    path : str
        Path of the field, such as ``'pose.position.z'`` or ``'data[2]'``; a point or a vector is
        read as a whole. Empty for the default in `fields.USUAL`.
    element : str
        Name of the joint or frame, for messages that contain several.

    Returns
    -------
    callable
        Returns the header's timestamp (None without a header) and the reading as an array of one
        or three numbers; None if the message does not contain the element.

    Raises
    ------
    BadInputError
        If the field does not exist or is not a number, or if an element is missing or superfluous.

    """
    find = _FIND.get(type_name)
    path, steps, end = fields.located(
        type_name, TransformStamped() if find is _of_frame else kind(), path)
    if (find is None) is bool(element):
        raise BadInputError(f'parameter element is {element!r}: expected ' + (
            f'none, since a {type_name} has one reading' if element else
            f'the name of the joint or frame to read in a {type_name}'))
    if isinstance(end, (bool, str)) or not (
            isinstance(end, (int, float)) or hasattr(end, '__len__') or fields.is_point(end)):
        raise BadInputError(
            f'parameter field is {path!r}, of a {type_name} a {type(end).__name__}: expected a '
            'number, a point or a vector')

    def read(message: Any) -> tuple[Any, Array] | None:
        part, place = (message, None) if find is None else find(message, element)
        if part is None:
            return None
        value = part
        for step in steps:
            value = value[step] if isinstance(step, int) else getattr(value, step)
        header = getattr(part, 'header', None)
        return None if header is None else header.stamp, fields.numbers(
            value if place is None else value[place])

    return read


def _of_joint(message: Any, element: str) -> tuple[Any, int | None]:
    names = list(message.name)
    return (message, names.index(element)) if element in names else (None, None)


def _of_frame(message: Any, element: str) -> tuple[Any, None]:
    # The newest of several transforms.
    found = [x for x in message.transforms if x.child_frame_id == element]
    return found[-1] if found else None, None


# Functions that find an element in messages that contain several.
_FIND: dict[str, Callable[[Any, str], tuple[Any, int | None]]] = {
    'sensor_msgs/msg/JointState': _of_joint, 'tf2_msgs/msg/TFMessage': _of_frame}


# Interval in s at which a publisher of unknown type is looked up, and time in ns without a reading
# after which that is reported.
_LOOK_SECONDS, _SILENT = 0.2, 2 * NANOSECONDS
# Largest stretch or deflection of any actuator; beyond it, the length at rest is missing.
_LARGEST = 10.0
# A best-effort subscription matches any sensor.
_QUALITY = topics.Quality(1000, reliable=False)

_DEFAULT = SensorScale()
SCALE = (
    ParameterSpec(
        'sensor.gain', _DEFAULT.gain,
        'Length per unit of the reading; negative where the reading falls as the actuator '
        'extends.', '', -1e12, 1e12),
    ParameterSpec(
        'sensor.offset', _DEFAULT.offset,
        'Length at reading 0, in the same unit.', '', -1e12, 1e12),
    ParameterSpec(
        'sensor.rest_length', _DEFAULT.rest_length,
        'Length of the actuator without a field, in the same unit.', '', 1e-12, 1e12),
    ParameterSpec(
        'sensor.latency', _DEFAULT.latency,
        'Time by which the timestamps of the readings are too late.', 's', -10.0, 10.0),
)

PARAMETERS = (
    JOINT,
    ParameterSpec('topic', '', 'Topic of the sensor.'),
    ParameterSpec(
        'type', '', 'Type of its messages, such as geometry_msgs/msg/PoseStamped; empty: that of '
        'its publisher.'),
    ParameterSpec(
        'field', '', 'Field to read, such as pose.position.z or data[2]. Of a point or a vector '
        'the length counts. Empty: the usual one of the type.'),
    ParameterSpec('element', '', 'Joint of a JointState, or child frame of a TFMessage.'),
    ParameterSpec(
        'reference.topic', '', 'Topic with the same type and field whose readings, interpolated, '
        'are subtracted: the stretch is the distance of two poses, for example.'),
    ParameterSpec(
        'reference.element', '', 'Joint or child frame of the reference; with an empty '
        'reference.topic one of the same topic.'),
    ParameterSpec(
        'reorder_time', 0.0, 'How long to wait for readings of an earlier timestamp; later ones '
        'are left out, and counted.', 's', 0.0, 10.0),
    *SCALE,
)


class SenseNode(ManagedNode):
    """Convert readings in messages of any type into stretch."""

    def __init__(self) -> None:
        super().__init__(topics.SENSE)
        self._values = declare(self, PARAMETERS)
        self.autostart()

    def configure(self) -> None:
        """
        Look for the sensor.

        Raises
        ------
        HmsaError
            If a parameter is invalid.

        """
        values = self._values
        if not values['topic']:
            raise BadInputError(
                'parameter topic is empty: expected the topic of a sensor, for example -p '
                'topic:=/block/pose')
        self._scale = SensorScale(**{
            x.name: values[f'sensor.{x.name}'] for x in dataclasses.fields(SensorScale)})
        has_reference = bool(values['reference.topic'] or values['reference.element'])
        self._readings = Readings(
            round(values['reorder_time'] * NANOSECONDS), reference=has_reference)
        self._topic = self._full(values['topic'])
        self._reference = self._full(values['reference.topic'] or values['topic'])
        self._published = self._useless = 0
        self._newest = self._heard = 0
        self._trouble = ''
        self._publisher = ros_entities.publisher(self, topics.JOINT_STATES)
        self._type = values['type']
        if self._type:
            self._subscribe()
        self.every(_LOOK_SECONDS, self._look)
        if wait := values['reorder_time']:
            self.every(max(wait / 10.0, 1e-3), self._publish)
        self.diagnose(self._report)

    def _full(self, name: str) -> str:
        return str(expand_topic_name(name, self.get_name(), self.get_namespace()))

    def _look(self) -> None:
        """Adopt the type of the sensor's publisher."""
        if self._type or self._trouble:
            return
        types = dict(self.get_topic_names_and_types()).get(self._topic)
        if not types:
            return
        self._type = types[0]
        try:
            self._subscribe()
        except HmsaError as error:
            self._trouble = str(error)
            self.get_logger().error(self._trouble)

    def _subscribe(self) -> None:
        values, take = self._values, self._readings.take_reference
        kind = ros_entities.interface_class(self._type)
        makes = partial(reader, self._type, kind, values['field'])
        each: dict[str, list[Callable[[Any], None]]] = {self._topic: [
            partial(self._take, makes(values['element']))]}
        if values['reference.topic'] or values['reference.element']:
            read = makes(values['reference.element'] or values['element'])
            # If one message contains both, the reference is processed first.
            each.setdefault(self._reference, []).insert(0, partial(
                self._pass_on, read, lambda stamp, reading, now: take(stamp, reading)))
        for name, takes in each.items():
            ros_entities.subscribe(
                self, topics.Topic(name, self._type, _QUALITY),
                lambda message, takes=takes: [take(message) for take in takes])

    def _take(self, read: Callable[[Any], Any], message: Any) -> None:
        self._pass_on(read, self._readings.take, message)
        self._publish()

    def _pass_on(
            self, read: Callable[[Any], Any], take: Callable[[int, Array, int], None],
            message: Any) -> None:
        """Process a message with the time of its header, or now."""
        try:
            found = read(message)
        except (IndexError, TypeError, ValueError) as error:
            self._useless += 1
            self.get_logger().warning(
                f'{self._topic}: {error}: look at the parameter field', throttle_duration_sec=1.0)
            return
        if found is None:
            return
        header, reading = found
        stamp = from_time(header) if header is not None else 0
        take(stamp or self.now(), reading, monotonic_ns())

    def _publish(self) -> None:
        scale, now = self._scale, monotonic_ns()
        for stamp, reading in self._readings.due(now):
            self._heard = now
            stretch = scale.stretch(reading)
            if not math.isfinite(stretch):
                self._useless += 1
                continue
            if abs(stretch) > _LARGEST:
                self.get_logger().warning(
                    f'a reading on {self._topic} becomes a stretch of {stretch:.4g}: expected at '
                    f'most {_LARGEST:g}; give the length at rest, in the unit of the readings, as '
                    'sensor.rest_length', throttle_duration_sec=10.0)
            self._newest = stamp
            if not self.active:
                continue
            self._published += 1
            message = JointState(name=[self._values['joint']], position=[stretch])
            message.header.stamp = to_time(max(stamp - scale.latency_ns, 0))
            self._publisher.publish(message)

    def _report(self) -> Iterable[DiagnosticStatus]:
        silent = monotonic_ns() - self._heard > _SILENT
        message = self._trouble or (
            f'no node publishes {self._topic}' if not self._type else
            f'no reading on {self._topic} ({self._type})' if silent else 'readings come')
        yield to_status(
            f'{self.get_name()}: readings', self._values['joint'],
            2 if self._trouble else int(silent), message, {
                'topic': self._topic, 'type': self._type, 'received': self._readings.count,
                'published': self._published, 'late': self._readings.late,
                'useless': self._useless,
                'age_ms': f'{(self.now() - self._newest) / 1e6:.1f}' if self._newest else ''})


#: Run by ``hmsa sense`` with the command line's arguments; returns the exit status.
main = partial(run, SenseNode)
