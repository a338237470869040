"""
Coils served by another node: levels as numbers, array elements or vectors on its topic.

The joints of a driver may share a message. Vectors in the same field are added.
"""

from array import array
import math
from time import monotonic, sleep
from typing import Any
from uuid import uuid4

import numpy as np
from rclpy.duration import Duration

from hmsa.errors import BadInputError, excerpt, HmsaError
from hmsa.interfaces import topics
from hmsa_lab.bench.assembly import Assembly, parts
from hmsa_lab.nodes import fields
from hmsa_ros.device.hardware import is_number
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.conversions import to_time
from hmsa_ros.nodes.temporary_node import leave, visit

# In s: wait for a subscriber at the start, interval of checks then and later (each takes 0.1 ms),
# wait for the last acknowledgement.
_PATIENCE, _LOOK, _AGAIN, _LAST = 8.0, 0.02, 0.25, 0.3
# Times in s for which a subscriber counts before the coil is used, if a service of its node is
# discovered, as by those a recorder is known, and if not: a node need not have any.
_KNOWN, _BARE = 0.2, 1.0
# Tolerance of the length of a direction, and maximum length of an array.
_ROUNDED, _LONGEST = 1e-3, 4096


class TopicError(HmsaError):
    """A topic without subscriber."""


class _SharedTopic:
    """A topic whose subscriber is awaited, and the fields of its joints in one message."""

    def __init__(self, name: str, type_name: str) -> None:
        own = f'topic_coil_{uuid4().hex[:8]}'
        # Without the remapping, a name given to the process would apply to this node too.
        self._node = visit(
            own, '', start_parameter_services=False, enable_rosout=False,
            cli_args=['--ros-args', '-r', f'__node:={own}'])
        self.fields: dict[str, Field] = {}
        self._publisher: Any = None
        self._count, self._looked = 0, -math.inf  # subscribers, and time in s, at the last check
        try:
            self.name = self._node.resolve_topic_name(name)
            since = monotonic()
            until = since + _PATIENCE
            while monotonic() < until:
                if not self.matched:
                    since = monotonic()
                elif self._discovered(monotonic() - since):
                    break
                sleep(_LOOK)
                if not type_name:
                    found = self._node.get_subscriptions_info_by_topic(self.name)
                    type_name = found[0].topic_type if found else ''
                if type_name and self._publisher is None:
                    self.kind = ros_entities.interface_class(type_name)
                    self._publisher = ros_entities.publisher(
                        self._node, topics.Topic(self.name, type_name, topics.RELIABLE))
            self.type = type_name
            self._require_subscriber()
        except BaseException:
            leave(self._node)
            raise

    @property
    def matched(self) -> bool:
        """Whether there is a subscriber other than recorders."""
        return self._publisher is not None and ros_entities.heard(self._node, self._publisher)

    def _discovered(self, seconds: float) -> bool:
        """Return whether the nodes that have subscribed for some s are discovered as a whole."""
        return seconds >= _BARE or seconds >= _KNOWN and ros_entities.servers(
            self._node).issuperset(
                ros_entities.subscribers_of(self._node, self._publisher.topic_name).values())

    def _require_subscriber(self) -> None:
        if not self.matched:
            raise TopicError(
                f'no node subscribes to {self.name}{f" ({self.type})" if self.type else ""}: '
                'start the node that serves the coil, or compare hardware.topic and hardware.type '
                'with ros2 topic info --verbose')

    def publish(self, now: int) -> None:
        """Publish the levels of all joints at a time in ns."""
        message = self.kind()
        for field in self.fields.values():
            field.put(message)
        if hasattr(message, 'header'):
            message.header.stamp = to_time(now)
        self._publisher.publish(message)
        # After the level, which this would delay.
        count, time = self._publisher.get_subscription_count(), monotonic()
        if count != self._count or time - self._looked >= _AGAIN:
            self._require_subscriber()
            self._count, self._looked = count, time

    def close(self) -> None:
        """Close after the last message is acknowledged."""
        if self._publisher.get_subscription_count():
            self._publisher.wait_for_all_acked(Duration(seconds=_LAST))
        leave(self._node)


# Topics in use, by name and type as given.
_SHARED: dict[tuple[str, str], _SharedTopic] = {}


class Field:
    """
    A field in the messages of a topic, as the source of a coil.

    Parameters
    ----------
    joint : str
        Joint of the coil.
    topic, type_name : str
        The topic, and the type of its messages; empty for that of its subscriber.
    path : str
        Path of a number, an array element or a vector; empty for the default in `fields.USUAL`.
    direction : sequence of float
        x, y and z of a unit vector, for a vector; empty for z.
    size : int
        Length of an array, 0 to 4096; extended to include the elements of all joints.

    Raises
    ------
    BadInputError
        If a value is out of range, or the messages have no such field.
    TopicError
        If no node subscribes.

    """

    def __init__(
            self, joint: str, topic: Any, type_name: Any, path: Any, direction: Any,
            size: Any) -> None:
        for name, text in (('topic', topic), ('type', type_name), ('field', path)):
            if not isinstance(text, str) or not (text or name != 'topic'):
                raise BadInputError(
                    f'hardware.{name} is {excerpt(text)}: expected text, as in '
                    'hardware.topic:=/coils')
        if not is_number(size) or not 0 <= size <= _LONGEST or size % 1:
            raise BadInputError(
                f'hardware.size is {excerpt(size)}: expected a whole number, 0 to {_LONGEST}')
        self._joint, self._key = joint, (topic, type_name)
        self._level, self._size = 0.0, int(size)
        shared = _SHARED.get(self._key)
        self._topic = _SharedTopic(topic, type_name) if shared is None else shared
        try:
            self._find(path, direction)
        except BaseException:
            if shared is None:
                self._topic.close()
            raise
        _SHARED[self._key] = self._topic
        self._topic.fields[joint] = self

    def _find(self, path: str, direction: Any) -> None:
        """Find the field, a number or a vector, in messages of the topic."""
        type_name = self._topic.type
        path, way, end = fields.located(type_name, self._topic.kind(), path)
        self.way, last = way, way[-1]
        number = isinstance(end, float) or (
            isinstance(last, int) and last < _LONGEST and not any(
                isinstance(x, int) for x in way[:-1])
            and (isinstance(end, array) and end.typecode in 'df' or isinstance(
                end, np.ndarray) and end.dtype.kind == 'f' and last < len(end)))
        if not number and not fields.is_point(end):
            raise BadInputError(
                f'hardware.field is {path!r}, of a {type_name} no field that takes a level: '
                'expected a floating-point number, an element of an array of those, or a vector')
        if number and (other := next(
                (x for x, field in self._topic.fields.items() if field.way == way), None)):
            raise BadInputError(
                f'hardware.field is {path!r} for joints {other} and {self._joint}: expected '
                f'a field for each, as in {self._joint}.hardware.field')
        # Empty for a number.
        self._direction = _unit(direction, number=number)
        self.description = f'{path} of {self._topic.name} ({type_name})'

    def put(self, message: Any) -> None:
        """Add the level to a message."""
        *inner, last = self.way
        holder = message
        for step in inner:
            holder = getattr(holder, str(step))
        if isinstance(last, int):
            if isinstance(holder, array):
                holder.extend([0.0] * (max(self._size, last + 1) - len(holder)))
            holder[last] += self._level
            return
        point = getattr(holder, last) if self._direction else holder
        for name, x in zip(
                fields.AXES if self._direction else [last], self._direction or [1.0], strict=True):
            setattr(point, name, getattr(point, name) + self._level * x)

    def write(self, level: float, now: int) -> None:
        """Publish a level in the unit of the topic, with all others, at a time in ns."""
        self._level = level
        self._topic.publish(now)

    def close(self) -> None:
        """Remove the field; close a topic without fields."""
        if self._topic.fields.pop(self._joint, None) is not None and not self._topic.fields:
            del _SHARED[self._key]
            self._topic.close()


def _unit(direction: Any, *, number: bool) -> tuple[float, ...]:
    """Return the direction of a vector, normalised, or an empty tuple for a number."""
    try:
        given = [*direction]
    except TypeError:
        given = [direction]
    if not given:
        return () if number else (0.0, 0.0, 1.0)
    if number:
        raise BadInputError(
            f'hardware.direction is {excerpt(given)}, and hardware.field is a number: expected a '
            'direction only for a vector')
    length = math.hypot(*given) if all(map(is_number, given)) else 0.0
    if len(given) != len(fields.AXES) or not abs(length - 1.0) <= _ROUNDED:
        mend = f', such as {[round(x / length, 6) for x in given]}' if (
            len(given) == len(fields.AXES) and 0.0 < length < math.inf) else ''
        raise BadInputError(
            f'hardware.direction is {excerpt(given)}: expected x, y and z of a vector of length '
            f'1{mend}')
    return tuple(x / length for x in given)


class TopicCoil(Assembly):
    """A coil driven through a field of a topic, for ``hardware:=topic``."""

    def __init__(
            self, joint: str, topic: Any = '', field: Any = '', direction: Any = (),
            size: Any = 0, **settings: Any) -> None:
        kind = settings.pop('type', '')
        if not settings.get('coil.file'):
            # Levels on the topic are in tesla.
            settings.setdefault('coil.tesla_per_ampere', 1.0)
        coil, scale = parts(settings)
        super().__init__(Field(joint, topic, kind, field, direction, size), coil, scale)
