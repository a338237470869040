"""Topics and services of `hmsa.interfaces.topics` on an rclpy node."""

from collections.abc import Callable, Iterable
from importlib import import_module
from time import monotonic_ns
from typing import Any
from weakref import WeakKeyDictionary

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    qos_check_compatible,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.subscription import Subscription

from hmsa.bag.definitions import is_interface_package
from hmsa.errors import BagError
from hmsa.interfaces.topics import from_outside, Quality, Topic
from hmsa_ros.nodes.capture import RawSubscription

# Name of a node that has not been discovered yet, or not any more.
_UNKNOWN = '_NODE_NAME_UNKNOWN_'
# Recorders by the node that asked for them, with the time in ns; and how long they are kept.
_RECORDERS: WeakKeyDictionary[Node, tuple[int, set[str]]] = WeakKeyDictionary()
_REMEMBERED = 100_000_000


def interface_class(type_name: str) -> type[Any]:
    """
    Return the class of a message, service or action type like ``'std_msgs/msg/Float64'``.

    Raises
    ------
    BagError
        If its package is not installed.

    """
    parts = type_name.split('/')
    try:
        package, folder, name = parts
        # The name may come from an untrusted bag: only interfaces are imported.
        if folder not in ('msg', 'srv', 'action') or not is_interface_package(package):
            raise ImportError(type_name)
        found: type[Any] = getattr(import_module(f'{package}.{folder}'), name)
    except (ValueError, ImportError, AttributeError) as error:
        raise BagError(
            f'message type {type_name} is not installed: expected its Python package; source '
            'its workspace') from error
    return found


def profile(quality: Quality) -> QoSProfile:
    """Return a quality of service as a profile of rclpy."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=quality.depth,
        reliability=ReliabilityPolicy.RELIABLE if quality.reliable
        else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if quality.latched
        else DurabilityPolicy.VOLATILE)


def full_name(name: str, namespace: str) -> str:
    """Return the full name of a node."""
    return f'/{namespace.strip("/")}/{name}'.replace('//', '/')


def publishers_of(node: Node, topic: str) -> dict[bytes, str]:
    """
    Return the publishers of a topic in the graph: full node names by identifier.

    The name is empty as long as the node of a publisher has not been discovered.
    """
    return _names(node.get_publishers_info_by_topic(node.resolve_topic_name(topic)))


def subscribers_of(node: Node, topic: str) -> dict[bytes, str]:
    """Return the subscribers of a topic, in the form of `publishers_of`."""
    return _names(node.get_subscriptions_info_by_topic(node.resolve_topic_name(topic)))


def servers(node: Node, service: str = '') -> set[str]:
    """Return the full names of nodes with a private service, or with any."""
    return {x.rpartition('/')[0] for x, _ in node.get_service_names_and_types()
            if x.endswith(service)}


def recorders(node: Node) -> set[str]:
    """
    Return the full names of recorders, including those of rosbag2, which also split bags.

    The answer may be as old as 0.1 s.
    """
    # A planner of 64 joints asks 600 times a second, for 0.1 ms each.
    now = monotonic_ns()
    asked, found = _RECORDERS.get(node, (0, set()))
    if now - asked > _REMEMBERED:
        found = servers(node, '/split_bagfile')
        _RECORDERS[node] = now, found
    return found


def heard(node: Node, publisher: Publisher) -> bool:
    """Return whether a publisher has a subscriber other than recorders."""
    if not publisher.get_subscription_count():
        return False
    found = recorders(node)
    return not found or not found.issuperset(
        subscribers_of(node, publisher.topic_name).values())


def matched(node: Node, publisher: Publisher, *owners: str) -> bool:
    """
    Return whether a publisher reaches all its subscribers in the graph, those of the owners too.

    Owners are full node names. A publisher only counts its subscribers, so that it may have
    matched a recorder and not the node that is meant. Those that its quality of service excludes
    do not count.
    """
    types = {
        x.topic_type for x in node.get_publishers_info_by_topic(publisher.topic_name)
        if (x.node_name, x.node_namespace) == (node.get_name(), node.get_namespace())}
    found = [
        x for x in node.get_subscriptions_info_by_topic(publisher.topic_name)
        if x.topic_type in types and qos_check_compatible(
            publisher.qos_profile, x.qos_profile)[0] is not QoSCompatibility.ERROR]
    return {*owners} <= {*_names(found).values()} and (
        0 < len(found) <= publisher.get_subscription_count())


def _names(endpoints: Iterable[Any]) -> dict[bytes, str]:
    return {
        bytes(x.endpoint_gid): '' if x.node_name == _UNKNOWN else full_name(
            x.node_name, x.node_namespace) for x in endpoints}


def publisher(node: Node, topic: Topic, owner: str = '') -> Publisher:
    """Return a publisher of a topic, or of the private topic of an owner."""
    return node.create_publisher(
        interface_class(topic.type), from_outside(topic.name, owner), profile(topic.qos))


def subscribe(
        node: Node, topic: Topic, take: Callable[..., Any], owner: str = '', *,
        raw: bool = False) -> Subscription:
    """Call ``take`` with each message of a topic (see `publisher`), serialized if raw."""
    return node.create_subscription(
        interface_class(topic.type), from_outside(topic.name, owner), take, profile(topic.qos),
        raw=raw)


def listen(node: Node, topic: Topic, owner: str = '') -> RawSubscription:
    """Return a subscription to a topic (see `publisher`) whose messages are polled."""
    return RawSubscription(
        node, interface_class(topic.type), from_outside(topic.name, owner), profile(topic.qos))
