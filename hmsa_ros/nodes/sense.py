"""Sense node: publishes the stretch that sensors of other packages see, as joint_states."""

from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import partial
import math
from time import monotonic_ns
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.expand_topic_name import expand_topic_name
from sensor_msgs.msg import JointState

from hmsa_ros.device.assembly import SensorScale
from hmsa_ros.device.readings import Readings
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.interfaces import topics
from hmsa_ros.interfaces.parameters import JOINT, ParameterSpec
from hmsa_ros.model.equations import Array
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.nodes import endpoints
from hmsa_ros.nodes.conversions import from_time, to_status, to_time
from hmsa_ros.nodes.fields import reader
from hmsa_ros.nodes.managed import ManagedNode
from hmsa_ros.nodes.parameters import declare
from hmsa_ros.nodes.runner import run

# How often publishers of an unknown type are looked for, in s, and without a reading from when on
# that is reported, in ns.
_LOOK_SECONDS, _SILENT = 0.2, 2 * NANOSECONDS
# Whatever a sensor offers is taken: a best-effort subscription fits both.
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
    """Converts readings of any message into stretch."""

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
            If a parameter is wrong.

        """
        values = self._values
        if not values['topic']:
            raise BadInputError(
                'parameter topic is empty: expected the topic of a sensor, for example -p '
                'topic:=/block/pose')
        self._scale = SensorScale(**{
            x.name: values[f'sensor.{x.name}'] for x in fields(SensorScale)})
        has_reference = bool(values['reference.topic'] or values['reference.element'])
        self._readings = Readings(
            round(values['reorder_time'] * NANOSECONDS), reference=has_reference)
        self._topic = self._full(values['topic'])
        self._reference = self._full(values['reference.topic'] or values['topic'])
        self._published = self._useless = 0
        self._newest = self._heard = 0
        self._trouble = ''
        self._publisher = endpoints.publisher(self, topics.JOINT_STATES)
        self._type = values['type']
        if self._type:
            self._subscribe()
        self.every(_LOOK_SECONDS, self._look)
        if values['reorder_time']:
            self.every(1e-3, self._publish)
        self.diagnose(self._report)

    def _full(self, name: str) -> str:
        return str(expand_topic_name(name, self.get_name(), self.get_namespace()))

    def _look(self) -> None:
        """Take the type of the sensor from who publishes it."""
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
        kind = endpoints.interface_class(self._type)
        makes = partial(reader, self._type, kind, values['field'])
        each: dict[str, list[Callable[[Any], None]]] = {self._topic: [
            partial(self._take, makes(values['element']))]}
        if values['reference.topic'] or values['reference.element']:
            read = makes(values['reference.element'] or values['element'])
            # Of one message the reference comes first.
            each.setdefault(self._reference, []).insert(0, partial(
                self._pass_on, read, lambda stamp, reading, now: take(stamp, reading)))
        for name, takes in each.items():
            endpoints.subscribe(
                self, topics.Topic(name, self._type, _QUALITY),
                lambda message, takes=takes: [take(message) for take in takes])

    def _take(self, read: Callable[[Any], Any], message: Any) -> None:
        self._pass_on(read, self._readings.take, message)
        self._publish()

    def _pass_on(
            self, read: Callable[[Any], Any], take: Callable[[int, Array, int], None],
            message: Any) -> None:
        """Take a message in, at the time in its header or now."""
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
            f'nobody publishes {self._topic}' if not self._type else
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
