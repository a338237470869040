"""The state in force, read before a planner sends its first command."""

from collections.abc import Sequence
import math
from time import monotonic_ns

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from hmsa_ros.nodes import interface
from hmsa_ros.nodes.conversions import from_time

# Whoever publishes it, reliably or not, is understood; only the newest counts.
_NEWEST = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class TakeOver:
    """
    Listens to joint_states until there is a sample of each joint, or for long enough.

    Parameters
    ----------
    node : rclpy.node.Node
        The planner.
    joints : sequence of str
        Whose samples are wanted.
    patience : int
        In ns of a steady clock.
    max_age : int
        In ns of the node's clock: older samples do not count.

    Attributes
    ----------
    samples : dict of str to (int, float, float, float)
        By joint: stamp in ns, stretch, rate in 1/s, flux density in force in T.

    """

    def __init__(
            self, node: Node, joints: Sequence[str], patience: int, max_age: int) -> None:
        """Subscribe."""
        self._node = node
        self._joints = frozenset(joints)
        self._end = monotonic_ns() + patience
        self._max_age = max_age
        self.samples: dict[str, tuple[int, float, float, float]] = {}
        topic = interface.JOINT_STATES
        self._subscription = node.create_subscription(
            topic.type, topic.name, self._on_sample, _NEWEST)

    @staticmethod
    def possible(node: Node) -> bool:
        """Return whether somebody publishes samples."""
        return bool(node.count_publishers(interface.JOINT_STATES.name))

    @property
    def over(self) -> bool:
        """Whether there is nothing more to wait for."""
        return len(self.samples) == len(self._joints) or monotonic_ns() > self._end

    def close(self) -> None:
        """Drop the subscription; not to be called from its callback."""
        self._node.destroy_subscription(self._subscription)

    def _on_sample(self, message: JointState) -> None:
        stamp = from_time(message.header.stamp)
        now = int(self._node.get_clock().now().nanoseconds)
        if abs(now - stamp) > self._max_age:
            return
        # A field that is not measured is empty; all three are needed.
        for name, *values in zip(
                message.name, message.position, message.velocity, message.effort, strict=False):
            if name in self._joints and all(math.isfinite(x) for x in values):
                stretch, rate, flux_density = map(float, values)
                self.samples[name] = stamp, stretch, rate, flux_density
