"""
Whose commands an actuator obeys: notices a second publisher, and refuses it if told to.

Publishers are distinguished by their identifiers (GIDs): those of the graph, and that of each
message, which rclpy does not provide and `hmsa_ros.nodes.capture` does.
"""

from collections.abc import Callable, Iterable

from rclpy.node import Node
from sensor_msgs.msg import MagneticField

from hmsa_ros.errors import BadInputError
from hmsa_ros.interfaces import topics
from hmsa_ros.nodes import endpoints
from hmsa_ros.nodes.capture import decode, RawSubscription

#: Obey every publisher, or only the one that was seen first, until it is gone.
COMMAND_SOURCES = ('any', 'first')


class Allegiance:
    """
    Decides by identifiers which publisher is obeyed.

    ``source`` is whom it obeys, None before the first command; ``refused`` counts others'
    commands.
    """

    def __init__(self) -> None:
        self.source: bytes | None = None
        self.refused = 0

    def accepts(self, publisher: bytes, present: Callable[[], Iterable[bytes]]) -> bool:
        """Return whether to obey a publisher, of those that are present."""
        if self.source in (None, publisher) or self.source not in present():
            self.source = publisher
            return True
        self.refused += 1
        return False


class CommandInput:
    """
    Commands for one actuator from ``'any'`` or only the ``'first'`` publisher.

    ``take`` gets each message that is obeyed; ``unreadable`` counts those that cannot be decoded.
    What a ``companion`` publishes, a node of that name in the same namespace, is passed over:
    its commands come directly, and first.
    """

    def __init__(
            self, node: Node, topic: topics.Topic, take: Callable[[MagneticField], None],
            source: str, companion: str = '') -> None:
        self._companion = companion
        self._companions: dict[bytes, bool] = {}
        self.unreadable = 0
        self._node = node
        self._topic = topic
        self._take = take
        self._allegiance: Allegiance | None = None
        self._raw: RawSubscription | None = None
        if source == 'first':
            self._allegiance = Allegiance()
        if source == 'first' or companion:
            self._raw = endpoints.listen(node, topic)
        self._subscription = None if self._raw is not None else endpoints.subscribe(
            node, topic, take)

    @property
    def refused(self) -> int:
        """Number of commands of publishers that are not obeyed."""
        return self._allegiance.refused if self._allegiance is not None else 0

    def count(self) -> int:
        """Return how many publishers the topic has."""
        return int(self._node.count_publishers(self._topic.name))

    def _publishers(self) -> dict[bytes, tuple[str, str]]:
        """Return name and namespace of the topic's publishers by identifier, as in the graph."""
        name = self._node.resolve_topic_name(self._topic.name)
        return {bytes(x.endpoint_gid): (x.node_name, x.node_namespace)
                for x in self._node.get_publishers_info_by_topic(name)}

    def poll(self) -> None:
        """Take what has arrived, where the node's executor does not."""
        if self._raw is None:
            return
        for taken in self._raw.take():
            if self._companion and self._is_companion(taken.publisher):
                continue
            if self._allegiance is None or self._allegiance.accepts(
                    taken.publisher, self._publishers):
                self._obey(taken.data)
            else:
                self._node.get_logger().warning(
                    f'command on {self._topic.name} refused: it comes from a publisher other '
                    'than the one obeyed; stop one of them, or set command_source to any',
                    throttle_duration_sec=60.0)

    def _is_companion(self, publisher: bytes) -> bool:
        """Return whether a publisher is the companion; looked up in the graph once."""
        if publisher not in self._companions:
            own = self._companion, self._node.get_namespace()
            found = {x: node == own for x, node in self._publishers().items()}
            if self._allegiance is not None:
                self._allegiance.source = next((x for x in found if found[x]), None)
            self._companions = found
        return self._companions.get(publisher, False)

    def _obey(self, data: bytes) -> None:
        try:
            message = decode(data, MagneticField)
        except BadInputError as error:
            self.unreadable += 1
            self._node.get_logger().error(
                f'message on {self._topic.name} ignored: {error}',
                throttle_duration_sec=60.0)
            return
        self._take(message)

    def close(self) -> None:
        """Receive no more."""
        if self._raw is not None:
            self._raw.destroy()
            self._raw = None
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None
