"""Publishers for the contents of a bag, which may be of unknown origin, and their subscribers."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.parameter import parameter_value_to_python

from hmsa.bag.reader import BagReader, BagTopic
from hmsa.errors import BadInputError, BagError, listed, printable
from hmsa.interfaces import topics
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.cdr import stamp_of
from hmsa_ros.nodes.selection import Filter, is_full_name, publisher_profile, Selection
from hmsa_ros.nodes.temporary_node import ServiceCall

#: Limit on the number of publishers, each of which takes 1.5 ms and 35 kB.
MOST_TOPICS = 1000
#: Number of topics named in a message; the others are only counted.
NAMED_AT_MOST = 20


def create_senders(
        node: Node, reader: BagReader, selection: Filter, *, own_clock: bool) -> dict[str, Any]:
    """
    Return a publisher for each selected topic of a bag; log omitted topics with the reason.

    Topics are selected by full names. A name without a leading slash is relative to the node's
    namespace, as for rosbag2.

    Raises
    ------
    BadInputError
        If more than `MOST_TOPICS` are selected.

    """
    held = reader.topics
    full = {name: full_name(node, name) for name in held}
    chosen = [name for name in held if selection.selects(full[name])]
    if len(chosen) > MOST_TOPICS:
        raise BadInputError(
            f'{reader.path} has {len(chosen)} topics to send: expected at most {MOST_TOPICS}; '
            'name those wanted in play.topics_to_filter')
    result: dict[str, Any] = {}
    reports = []
    for name in chosen:
        reason = _left_out(node, selection, full[name], held[name], own_clock)
        try:
            if not reason:
                result[name] = node.create_publisher(
                    ros_entities.interface_class(held[name].type), full[name],
                    publisher_profile(held[name].profiles))
        except Exception as error:  # an invalid quality of service
            reason = f'it cannot be published ({" ".join(str(error).split())})'
        if reason:
            reports.append(f'topic {name} is left out: {reason}')
    if len(reports) > NAMED_AT_MOST:
        reports[NAMED_AT_MOST:] = [f'{len(reports) - NAMED_AT_MOST} more topics are left out']
    missing = [x for x in selection.topics if x not in full.values()]
    if missing:
        reports.append(
            f'the bag has no topic {", ".join(missing)}; it has '
            f'{listed(held, NAMED_AT_MOST) or "none"}')
    for sentence in reports:
        node.get_logger().warning(printable(sentence))
    return result


def full_name(node: Node, name: str) -> str:
    """Return the full name of a topic of a bag, or the name itself if it is invalid."""
    relative = name.removeprefix('~/')
    if name.startswith('/') or not is_full_name(f'/{relative}'):
        return name
    return str(expand_topic_name(name, node.get_name(), node.get_namespace()))


def _left_out(
        node: Node, selection: Filter, name: str, info: BagTopic, own_clock: bool) -> str:
    """Return why a topic that passes the filter is not played; empty if it is."""
    if not is_full_name(name):
        return 'it cannot be published, its name is not a valid ROS name'
    resolved = node.resolve_topic_name(name)
    if selection.withholds(name, resolved, info.type):
        return 'it carries commands; name it in play.topics_to_filter to send it'
    if resolved == topics.CLOCK_TOPIC.name and own_clock:
        return 'the player publishes the clock itself'
    if info.encoding != 'cdr':
        return f'its messages are encoded as {info.encoding!r}, expected cdr'
    try:
        ros_entities.interface_class(info.type)
    except BagError as error:
        return str(error)
    return ''


def latched(reader: BagReader, topics: Iterable[str]) -> dict[str, int]:
    """Return the number of messages that a late subscriber receives from each latched topic."""
    profiles = {name: reader.topics[name].profiles for name in topics}
    return {name: publisher_profile(x).depth for name, x in profiles.items()
            if any(profile.durability == 'transient_local' for profile in x)}


class RequiredSubscribers:
    """
    Subscribers of a node's topics; the node must be spun while `missing` is polled.

    Each of ``topics`` needs a subscriber. If ``nodes`` (full names) are given, the subscriber must
    be one of these managed nodes, and active. A topic that is not published raises
    `BadInputError`. A ``recorder`` must be active too, and subscribe to the topics of the nodes
    that it is to record.
    """

    def __init__(
            self, node: Node, senders: Mapping[str, Any], topics: Sequence[str],
            nodes: Sequence[str], recorder: str = '') -> None:
        unsent = [name for name in topics if name not in senders]
        if unsent:
            raise BadInputError(
                f'parameter play.wait_for_subscribers names {", ".join(unsent)}: expected topics '
                f'that are sent, {listed(senders, NAMED_AT_MOST) or "of which there is none"}')
        self._node = node
        self._senders = senders
        self._topics = topics
        # Managed nodes that are not known to be active yet.
        self._inactive = {
            x: ServiceCall(node, GetState, f'{x}/get_state', GetState.Request())
            for x in (*nodes, *filter(None, [recorder]))}
        self._demands = bool(topics or self._inactive)
        self._nodes = nodes
        self._recorder = recorder
        self._selects: Selection | None = None
        self._selection = ServiceCall(
            node, GetParameters, f'{recorder}/get_parameters',
            GetParameters.Request(names=Selection.parameters)) if recorder else None

    def missing(self) -> list[str]:
        """Return descriptions of the required nodes and subscribers that are missing."""
        for name, call in [*self._inactive.items()]:
            answer = call.answer()
            if answer is not None and answer.current_state.id == State.PRIMARY_STATE_ACTIVE:
                del self._inactive[name]
        return [
            *(f'active node {name}' for name in self._inactive),
            *(f'subscriber of {name}' for name in self._topics if not self._subscribed(name)),
            *(f'recorder of {name}' for name in self._unrecorded())]

    def _unrecorded(self) -> list[str]:
        """Return topics of the nodes that the recorder selects but does not subscribe to."""
        if self._selection is None:
            return []
        if self._selects is None:
            answer = self._selection.answer()
            if answer is None:
                return ['anything']
            space, _, name = self._recorder.rpartition('/')
            self._selects = Selection.of(
                dict(zip(Selection.parameters, map(parameter_value_to_python, answer.values),
                         strict=True)),
                partial(expand_topic_name, node_name=name, node_namespace=space or '/'))
        names: set[str] = set()
        for node in self._nodes:
            space, _, name = node.rpartition('/')
            try:
                names |= {x for x, _ in self._node.get_publisher_names_and_types_by_node(
                    name, space or '/')}
            except NodeNameNonExistentError:
                return [f'topics of {node}']
        return [
            x for x in sorted(names) if self._selects.wants(x)
            and self._recorder not in ros_entities.subscribers_of(self._node, x).values()]

    def _subscribed(self, topic: str) -> bool:
        """Return whether a required node, or any node, subscribes to a topic."""
        sender = self._senders[topic]
        if not self._nodes:
            return bool(sender.get_subscription_count() > 0)
        return any(
            x in self._nodes
            for x in ros_entities.subscribers_of(self._node, sender.topic_name).values())

    def found(self, also: Any) -> bool:
        """Return whether all known subscribers are matched; ``also`` is one more publisher."""
        senders = [*self._senders.values(), *([] if also is None else [also])]
        if any(x.get_subscription_count() < self._node.count_subscribers(x.topic_name)
               for x in senders):
            return False
        return self._demands or all(
            x.get_subscription_count() for x in self._senders.values())


class Followers:
    """
    Progress of samples on topics (full names).

    Messages are read only on request, so that they do not delay the player.
    """

    def __init__(self, node: Node, names: Sequence[str]) -> None:
        self._subscriptions = {
            name: ros_entities.listen(node, replace(topics.JOINT_STATES, name=name))
            for name in names}
        # Timestamps in ns of the last two samples.
        self._stamps = dict.fromkeys(names, (0, 0))

    def behind(self, end: int) -> dict[str, int]:
        """Return by topic the time in ns that its samples are behind ``end``, if they are."""
        for name, subscription in self._subscriptions.items():
            while taken := subscription.take():
                for x in taken[-2:]:
                    self._stamps[name] = self._stamps[name][1], stamp_of(x.data)
        # The next sample may be due only after the end.
        return {name: end - last for name, (before, last) in self._stamps.items()
                if not before or 2 * last - before <= end}

    @staticmethod
    def in_words(behind: Mapping[str, int]) -> str:
        """Return the result of `behind` in words."""
        return ', '.join(f'those of {name} end {lack * 1e-9:.3f} s too early'
                         for name, lack in behind.items())
