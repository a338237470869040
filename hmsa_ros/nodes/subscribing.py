"""Subscriptions of the recorder, with a quality of service that matches the publishers."""

from collections import Counter
from collections.abc import Iterable, Sequence

from rclpy.node import Node
from rclpy.qos import QoSProfile

from hmsa.bag.definitions import message_definition, type_hash
from hmsa.bag.qos import Qos
from hmsa.bag.writer import BagTopic
from hmsa.bag.writer_thread import RecordedTopic, WriterThread
from hmsa.errors import BagError
from hmsa_ros.nodes.capture import Capture, RawSubscription
from hmsa_ros.nodes.ros_entities import interface_class
from hmsa_ros.nodes.selection import Selection, stored_profile, subscription_profile

# Share of the memory for waiting messages that the queues of the middleware may take: these serve
# while the recorder gets no processor, its own queue while the disk is slow.
_QUEUES = 1 / 4
# Smallest queue of a subscription.
_MIN_DEPTH = 2
# Every so many looks, all publishers are looked up, even if their number has not changed.
_FULL_LOOK = 10


class Subscriptions:
    """
    Subscribe to the selected topics, and list them in ``topics``.

    ``depth`` is the largest number of messages in the queue of a subscription, and ``cache_size``
    the memory in bytes for waiting messages. The middleware limits a queue by messages only, and
    keeps the memory of a queue that was full: large messages get shorter queues.
    """

    def __init__(
            self, node: Node, selection: Selection, recording: WriterThread, capture: Capture,
            depth: int, cache_size: int) -> None:
        self.topics: dict[str, RecordedTopic] = {}
        self._node = node
        self._selection = selection
        self._recording = recording
        self._capture = capture
        self._depth = depth
        self._queue_size = cache_size * _QUEUES
        self._refused: set[str] = set()
        self._reported_ready = False
        self._looks = 0

    @property
    def wanted_count(self) -> int:
        """Return the number of topics to record, as far as it is known."""
        missing = [name for name in self._selection.topics if name not in self.topics]
        return len(self.topics) + len(missing)

    def silent(self) -> list[str]:
        """Return the topics, subscribed to or selected by name, without any message so far."""
        heard = {name for name, topic in self.topics.items() if topic.received}
        return sorted({*self._selection.topics, *self.topics} - heard)

    def look(self, found: Iterable[tuple[str, Sequence[str]]]) -> None:
        """Subscribe to the new topics among those found, given with their types."""
        self._looks += 1
        for name, types in found:
            if self._selection.wants(name):
                self._look_at(name, types)
        self._shorten()
        if not self._reported_ready and self._selection.topics \
                and self.wanted_count == len(self.topics):
            self._reported_ready = True
            self._node.get_logger().info(
                f'ready: subscribed to all {len(self._selection.topics)} topics')

    def _look_at(self, name: str, types: Sequence[str]) -> None:
        """Subscribe to a topic, or again if its publishers require it."""
        known = self.topics.get(name)
        # Looking up the publishers takes five times as long as counting them.
        count = self._node.count_publishers(name)
        if known is not None and count == known.publishers and self._looks % _FULL_LOOK:
            return
        infos = [info for info in self._node.get_publishers_info_by_topic(name)
                 if known is None or info.topic_type == known.type]
        if known is not None:
            known.publishers = count
        if not infos:
            return
        offered = tuple(sorted((stored_profile(info.qos_profile) for info in infos), key=repr))
        if known is not None and not Counter(offered) - Counter(known.offered):
            return  # no new publisher; one that left changes nothing
        type_name = known.type if known is not None else infos[0].topic_type
        if len(types) > 1 and known is None:
            self._warn(f'topic {name} has the types {", ".join(types)}: {type_name} is recorded')
        hashes = {str(info.topic_type_hash) for info in infos if info.topic_type == type_name}
        self._subscribe(known, name, type_name, offered, hashes)

    def _subscribe(
            self, known: RecordedTopic | None, name: str, type_name: str,
            offered: tuple[Qos, ...], hashes: Iterable[str]) -> None:
        try:
            message_type = interface_class(type_name)
        except BagError as error:
            self._warn(f'topic {name} is not recorded: {error}')
            return
        number = self._recording.add_topic(self._describe(name, type_name, offered, hashes))
        qos = subscription_profile(offered, self._depth if known is None else known.qos.depth)
        logger = self._node.get_logger()
        if known is None:
            recorded = RecordedTopic(name, type_name, number, qos, offered)
            self.topics[name] = recorded
            self._capture.add(recorded, RawSubscription(self._node, message_type, name, qos))
            logger.info(f'subscribed to {name} ({type_name})')
            return
        known.offered = offered
        if (qos.reliability, qos.durability) != (known.qos.reliability, known.qos.durability):
            self._replace(known, qos)
            logger.info(
                f'subscribed to {name} again, as its publishers offer another quality of service')

    def _shorten(self) -> None:
        """Shorten the queues that could take more than their share of the memory."""
        left, count = self._queue_size, len(self.topics)
        for topic in sorted(self.topics.values(), key=lambda x: x.largest):
            # What small messages leave is for the large ones.
            share = min(left / count, self._depth * topic.largest)
            left, count = left - share, count - 1
            depth = max(_MIN_DEPTH, int(share / max(topic.largest, 1)))
            # By half at least, since messages may grow little by little.
            if topic.largest and depth <= topic.qos.depth // 2:
                self._replace(topic, subscription_profile(topic.offered, depth))

    def _replace(self, topic: RecordedTopic, qos: QoSProfile) -> None:
        """Subscribe to a topic again."""
        topic.qos = qos
        self._capture.replace(topic, RawSubscription(
            self._node, interface_class(topic.type), topic.name, qos))

    def _describe(
            self, name: str, type_name: str, offered: tuple[Qos, ...],
            hashes: Iterable[str]) -> BagTopic:
        """Return the description of a topic for the bag."""
        try:
            encoding, definition = message_definition(type_name)
        except BagError as error:
            self._warn(f'topic {name} is recorded without definition: {error}')
            encoding, definition = '', ''
        known = {text for text in hashes if text.startswith('RIHS01_')}
        return BagTopic(
            name, type_name, definition, encoding, offered,
            known.pop() if len(known) == 1 else '' if known else type_hash(type_name))

    def _warn(self, sentence: str) -> None:
        if sentence not in self._refused:
            self._refused.add(sentence)
            self._node.get_logger().warning(sentence)
