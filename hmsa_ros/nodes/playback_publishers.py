"""Publishers for the contents of a bag, which may be of unknown origin."""

from collections.abc import Iterable
from typing import Any

from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node

from hmsa.bag.reader import BagReader, BagTopic
from hmsa.errors import BadInputError, BagError, listed, printable
from hmsa.interfaces import topics
from hmsa_ros.nodes.qos import publisher
from hmsa_ros.nodes.ros_entities import interface_class
from hmsa_ros.nodes.selection import Filter, is_full_name

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
    chosen = [name for name in held if selection.passes(full[name])]
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
                    interface_class(held[name].type), full[name], publisher(held[name].profiles))
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
        interface_class(info.type)
    except BagError as error:
        return str(error)
    return ''


def latched(reader: BagReader, topics: Iterable[str]) -> dict[str, int]:
    """Return the number of messages that a late subscriber receives from each latched topic."""
    profiles = {name: reader.topics[name].profiles for name in topics}
    return {name: publisher(x).depth for name, x in profiles.items()
            if any(profile.durability == 'transient_local' for profile in x)}
