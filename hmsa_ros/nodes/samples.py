"""Samples on the wire: messages that differ in a few numbers only, serialized once."""

from collections.abc import Sequence
import math
from struct import Struct

from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from hmsa_ros.device.protocol import Sample
from hmsa_ros.interfaces import topics
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.nodes import endpoints
from hmsa_ros.nodes.outlet import Outlet

_STAMP = Struct('<iI')
_NUMBER = Struct('<d')
# Numbers to find the place of each field by: no name has their bytes.
_MARKS = {'position': math.pi, 'velocity': math.e, 'effort': math.tau}
# Encapsulation, before the stamp of the header: plain CDR, little-endian.
_PLAIN = b'\x00\x01\x00\x00'


class SamplePublisher:
    """
    Publishes joint_states, and stretch and stretch rate of each joint where that is wanted.

    rclpy converts a message at each publishing, which takes three times as long as to put the
    numbers of a sample into one that is serialized already.
    """

    def __init__(self, node: Node, names: Sequence[str], *, scalars: bool) -> None:
        self._states = Outlet(endpoints.publisher(node, topics.JOINT_STATES))
        self._scalars = [
            tuple(Outlet(endpoints.publisher(node, topics.of_joint(x, name, names)))
                  for x in (topics.STRETCH, topics.STRETCH_RATE))
            for name in names] if scalars else []
        count = len(names)
        message = JointState(name=list(names), **{
            field: [mark] * count for field, mark in _MARKS.items()})
        self._data = bytearray(serialize_message(message))
        self._places = [
            slice(x, x + _NUMBER.size * count)
            for x in (self._data.index(_NUMBER.pack(mark) * count) for mark in _MARKS.values())]

    def publish(self, sample: Sample) -> None:
        """Publish a sample of all joints."""
        _STAMP.pack_into(self._data, len(_PLAIN), *divmod(sample.time, NANOSECONDS))
        for place, values in zip(
                self._places, (sample.stretch, sample.rate, sample.flux_density), strict=True):
            self._data[place] = values.tobytes()
        self._states.publish(bytes(self._data))
        # None where only joint_states are wanted.
        for (of_stretch, of_rate), stretch, rate in zip(
                self._scalars, sample.stretch.tolist(), sample.rate.tolist(), strict=False):
            of_stretch.publish(_PLAIN + _NUMBER.pack(stretch))
            of_rate.publish(_PLAIN + _NUMBER.pack(rate))
