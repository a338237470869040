"""Publishers of what a bag holds. A bag may come from anybody."""

from collections.abc import Iterable
from typing import Any

from rclpy.node import Node

from hmsa_ros.bag.reader import BagReader, Topic
from hmsa_ros.errors import BadInputError, BagError, listed, printable
from hmsa_ros.interfaces import topics
from hmsa_ros.nodes.endpoints import interface_class
from hmsa_ros.nodes.qos import publisher
from hmsa_ros.nodes.selection import Filter, is_full_name

#: A publisher takes 1.5 ms and 35 kB.
MOST_TOPICS = 1000
#: Topics named in a sentence or in the log; of the others only the number is.
NAMED_AT_MOST = 20


def create_senders(
        node: Node, reader: BagReader, selection: Filter, *, own_clock: bool) -> dict[str, Any]:
    """
    Return a publisher for each wanted topic of a bag; the log says what is left out and why.

    Raises
    ------
    BadInputError
        If more than `MOST_TOPICS` are wanted.

    """
    held = reader.topics
    chosen = [name for name in held if selection.passes(name)]
    if len(chosen) > MOST_TOPICS:
        raise BadInputError(
            f'{reader.path} has {len(chosen)} topics to send: expected at most {MOST_TOPICS}; '
            'name those wanted in play.topics_to_filter')
    result: dict[str, Any] = {}
    told = []
    for name in chosen:
        reason = _left_out(node, selection, name, held[name], own_clock)
        try:
            if not reason:
                result[name] = node.create_publisher(
                    interface_class(held[name].type), name, publisher(held[name].profiles))
        except Exception as error:  # a quality of service that no publisher can have
            reason = f'it cannot be published ({" ".join(str(error).split())})'
        if reason:
            told.append(f'topic {name} is left out: {reason}')
    if len(told) > NAMED_AT_MOST:
        told[NAMED_AT_MOST:] = [f'{len(told) - NAMED_AT_MOST} more topics are left out']
    missing = [x for x in (*selection.topics, *selection.allow_commands) if x not in held]
    if missing:
        told.append(
            f'the bag has no topic {", ".join(missing)}; it has '
            f'{listed(held, NAMED_AT_MOST) or "none"}')
    for sentence in told:
        node.get_logger().warning(printable(sentence))
    return result


def _left_out(
        node: Node, selection: Filter, name: str, info: Topic, own_clock: bool) -> str:
    """Return why a topic that passes the filter is not sent, empty if it is."""
    if not is_full_name(name):
        return 'it cannot be published, its name is not a valid ROS name'
    resolved = node.resolve_topic_name(name)
    if selection.withholds(name, resolved, info.type):
        return ('it carries commands; name it in play.topics_to_filter or '
                'play.allow_commands to send it')
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
    """Return how many messages a late subscriber gets, of those topics that are latched."""
    profiles = {name: reader.topics[name].profiles for name in topics}
    return {name: publisher(x).depth for name, x in profiles.items()
            if any(profile.durability == 'transient_local' for profile in x)}
