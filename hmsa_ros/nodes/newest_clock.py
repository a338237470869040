"""Simulated time of which only the newest message counts."""

from time import time_ns

from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from hmsa_ros.errors import BadInputError
from hmsa_ros.interfaces import topics
from hmsa_ros.nodes import endpoints
from hmsa_ros.nodes.capture import decode, RawSubscription


class NewestClock:
    """
    Sets a node's clock from /clock when it is read, instead of its own subscription.

    The executor would keep an event for each message, without limit where the node cannot keep
    up with them. A subscription that is read here keeps the newest message alone. It is not for a
    node that has to take commands in before the time that was published after them.
    """

    def __init__(self, node: Node) -> None:
        """Subscribe, if the node follows simulated time already."""
        self._node = node
        self._source = node._time_source
        self._subscription: RawSubscription | None = None
        self._source._subscribe_to_clock_topic = self._subscribe
        if self._source._clock_sub is not None:
            node.destroy_subscription(self._source._clock_sub)
            self._source._clock_sub = None
            self._subscribe()

    def _subscribe(self) -> None:
        if self._subscription is None:
            self._subscription = endpoints.listen(self._node, topics.CLOCK_TOPIC)

    def read(self) -> int:
        """Return the node's time in ns, by the newest message if it is simulated."""
        if not self._source.ros_time_is_active:
            # What rclpy's clock reads then, without its objects.
            return time_ns()
        if self._subscription is not None:
            for taken in self._subscription.take()[-1:]:
                try:
                    self._source.clock_callback(decode(taken.data, Clock))
                except BadInputError as error:
                    self._node.get_logger().error(
                        f'message on /clock skipped: {error}', throttle_duration_sec=1.0)
        return int(self._node.get_clock().now().nanoseconds)
