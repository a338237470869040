"""Topics of one joint of the planner: commands out, setpoints and news of the commands in."""

from collections.abc import Callable, Sequence

from rclpy.node import Node
from sensor_msgs.msg import MagneticField
from std_msgs.msg import Float64

from hmsa_ros.core.planner import PlannedLevel
from hmsa_ros.errors import BadInputError
from hmsa_ros.nodes import conversions, interface
from hmsa_ros.nodes.timekeeping import Seldom


class JointChannel:
    """
    What belongs to one joint on the wire.

    Parameters
    ----------
    node : rclpy.node.Node
        The planner.
    joint : str
        Its name.
    joints : sequence of str
        All joints of the planner.
    on_setpoint : callable
        Called with the joint and a stretch.
    on_applied : callable
        Called with the joint, a stamp in ns and the flux density in T that is in force from
        then on.

    Attributes
    ----------
    applied : tuple of int and float, or None
        The newest such news.

    """

    def __init__(
            self, node: Node, joint: str, joints: Sequence[str],
            on_setpoint: Callable[[str, float], None],
            on_applied: Callable[[str, int, float], None]) -> None:
        """Create publisher and subscriptions."""
        self._node = node
        self._joint = joint
        self._on_setpoint_of = on_setpoint
        self._on_applied_of = on_applied
        self.applied: tuple[int, float] | None = None
        self._tell_ignored = Seldom()
        topic = interface.of_joint(interface.FLUX_DENSITY_COMMAND, joint, joints)
        self._command = node.create_publisher(topic.type, topic.name, topic.qos)
        topic = interface.of_joint(interface.SETPOINT, joint, joints)
        node.create_subscription(topic.type, topic.name, self._on_setpoint, topic.qos)
        topic = interface.of_joint(interface.FLUX_DENSITY_APPLIED, joint, joints)
        node.create_subscription(topic.type, topic.name, self._on_applied, topic.qos)

    def send(self, stamp: int, level: PlannedLevel, frame: str) -> None:
        """
        Send a command.

        Parameters
        ----------
        stamp : int
            Time in ns from which it applies.
        level : PlannedLevel
            Which flux density.
        frame : str
            Of the coil.

        """
        self._command.publish(conversions.to_command(stamp, level.flux_density, frame))

    def _on_setpoint(self, message: Float64) -> None:
        self._on_setpoint_of(self._joint, message.data)

    def _on_applied(self, message: MagneticField) -> None:
        try:
            stamp, flux_density = conversions.from_command(message)
        except BadInputError as error:
            if self._tell_ignored():
                self._node.get_logger().error(f'news of joint {self._joint} ignored: {error}')
            return
        self.applied = stamp, flux_density
        self._on_applied_of(self._joint, stamp, flux_density)
