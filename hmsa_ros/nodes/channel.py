"""Topics of one joint of the planner: outgoing commands, incoming setpoints and reports."""

from collections.abc import Callable, Sequence
from time import monotonic_ns

from rclpy.node import Node
from sensor_msgs.msg import MagneticField, Temperature, TimeReference
from std_msgs.msg import Float64

from hmsa.errors import BadInputError
from hmsa.interfaces import topics
from hmsa.model.units import NANOSECONDS
from hmsa_ros.nodes import conversions, ros_entities
from hmsa_ros.runtime.records import Send, StretchRequest
from hmsa_ros.runtime.runtime import Runtime
from hmsa_ros.timekeeping import Throttle

# Time in ns after which all topics of a device that runs are discovered.
_DISCOVERY = 2 * NANOSECONDS


class JointChannel:
    """Publishers and subscriptions of one joint; ``serve`` is called after each message."""

    def __init__(
            self, node: Node, joint: str, joints: Sequence[str], runtime: Runtime,
            serve: Callable[[], None], *, linked: bool = False) -> None:
        """Create them; a linked device passes its reports on directly."""
        self._node, self._joint, self._runtime, self._serve = node, joint, runtime, serve
        self._ignored_due = Throttle()
        self._command = ros_entities.publisher(
            node, topics.of_joint(topics.FLUX_DENSITY_COMMAND, joint, joints))
        ros_entities.subscribe(
            node, topics.of_joint(topics.SETPOINT, joint, joints), self._on_setpoint)
        self._applied = self._received = ''
        self._discovered = monotonic_ns() + _DISCOVERY
        if not linked:
            self._applied, self._received = (
                ros_entities.subscribe(
                    node, topics.of_joint(topic, joint, joints), take).topic_name
                for topic, take in (
                    (topics.FLUX_DENSITY_APPLIED, self._on_applied),
                    (topics.FLUX_DENSITY_RECEIVED, self._on_received)))

        self._temperature: object = None
        self._names = tuple(joints)
        self.look_at_temperature()

    def look_at_temperature(self) -> None:
        """Subscribe to the temperature once it matters."""
        if self._temperature is None and self._joint in self._runtime.temperatures.joints:
            self._temperature = ros_entities.subscribe(
                self._node, topics.of_joint(topics.TEMPERATURE, self._joint, self._names),
                self._on_temperature)

    def publish_command(self, command: Send, frame: str) -> None:
        """Publish a command in the frame of the coil."""
        self._command.publish(
            conversions.to_command(command.stamp, command.flux_density, frame))

    @property
    def found(self) -> bool:
        """Whether a device subscribes to the commands and reports applied levels."""
        return not self._applied or bool(
            ros_entities.heard(self._node, self._command) and (
                self._node.count_publishers(self._applied)
                or self._node.count_publishers(topics.JOINT_STATES.name)))

    @property
    def reports(self) -> bool:
        """Whether a device gives receipts, or may, as long as discovery is not complete."""
        return bool(self._received) and (
            monotonic_ns() < self._discovered or bool(
                self._node.count_publishers(self._received)))

    @property
    def reporters(self) -> frozenset[bytes]:
        """Identifiers of the publishers of applied levels."""
        return frozenset(
            ros_entities.publishers_of(self._node, self._applied) if self._applied else ())

    def unheard(self) -> str:
        """Return why commands are not carried out; empty if they are."""
        if not self._applied:
            return ''
        if not ros_entities.heard(self._node, self._command):
            return f'no node subscribes to {self._command.topic_name}: start a plant or a driver'
        if not self._node.count_publishers(self._received):
            # The present subscriber gives no receipts.
            self._runtime.devices.receipts.forget(self._joint)
        if not self._node.count_publishers(self._applied) and not self._node.count_publishers(
                topics.JOINT_STATES.name):
            return (
                f'no node reports applied levels ({self._applied}) or samples '
                '(joint_states): start a plant, or a driver that does')
        return ''

    def _on_setpoint(self, message: Float64) -> None:
        self._runtime.request(StretchRequest(self._joint, message.data))
        self._serve()

    def _on_temperature(self, message: Temperature) -> None:
        self._runtime.temperature(
            self._joint, conversions.from_time(message.header.stamp), message.temperature)
        self._serve()

    def _on_received(self, message: TimeReference) -> None:
        self._runtime.received(
            self._joint, conversions.from_time(message.header.stamp),
            conversions.from_time(message.time_ref),
            cut_off=message.header.frame_id == conversions.CUT_OFF,
            locked=message.header.frame_id == conversions.INTERLOCK,
            late=message.header.frame_id == conversions.LATE)
        if message.header.frame_id:
            self._serve()

    def _on_applied(self, message: MagneticField) -> None:
        try:
            self._runtime.applied(self._joint, *conversions.from_command(message))
        except BadInputError as error:
            if self._ignored_due():
                self._node.get_logger().error(f'update of joint {self._joint} ignored: {error}')
        self._serve()
