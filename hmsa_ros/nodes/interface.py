"""
The contract's topics and services with rclpy's message classes and quality of service.

Names, types and meanings come from `hmsa_ros.contract.topics`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from hmsa_ros.contract import topics
from hmsa_ros.contract.topics import (
    DRIVER,
    from_outside,
    NODES,
    PLANNER,
    PLANT,
    PLAYER,
    RECORDER,
)
from hmsa_ros.nodes.message_types import interface_class

__all__ = [
    'DRIVER', 'from_outside', 'LATCHED', 'NODES', 'of_joint', 'PLANNER', 'PLANT', 'PLAYER',
    'publisher', 'RECORDER', 'Service', 'Topic']


@dataclass(frozen=True)
class Topic:
    """A topic as in `hmsa_ros.contract.topics.Topic`, with rclpy's class and profile."""

    name: str
    type: type[Any]
    qos: QoSProfile
    meaning: str = ''
    publishers: tuple[str, ...] = ()
    subscribers: tuple[str, ...] = ()


@dataclass(frozen=True)
class Service:
    """A service as in `hmsa_ros.contract.topics.Service`, with rclpy's class."""

    name: str
    type: type[Any]
    meaning: Mapping[str, str] = field(default_factory=dict)


def profile(quality: topics.Quality) -> QoSProfile:
    """Return a quality of service as rclpy has it."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=quality.depth,
        reliability=ReliabilityPolicy.RELIABLE if quality.reliable
        else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if quality.latched
        else DurabilityPolicy.VOLATILE)


def _topic(topic: topics.Topic) -> Topic:
    return Topic(
        topic.name, interface_class(topic.type), profile(topic.qos), topic.meaning,
        topic.publishers, topic.subscribers)


def _service(service: topics.Service) -> Service:
    return Service(service.name, interface_class(service.type), service.meaning)


LATCHED = profile(topics.LATCHED)

JOINT_TRAJECTORY = _topic(topics.JOINT_TRAJECTORY)
SETPOINT = _topic(topics.SETPOINT)
PLAN = _topic(topics.PLAN)
STATUS = _topic(topics.STATUS)
ESTIMATE = _topic(topics.ESTIMATE)
FLUX_DENSITY_COMMAND = _topic(topics.FLUX_DENSITY_COMMAND)
FLUX_DENSITY_APPLIED = _topic(topics.FLUX_DENSITY_APPLIED)
DISTURBANCE_FORCE = _topic(topics.DISTURBANCE_FORCE)
JOINT_STATES = _topic(topics.JOINT_STATES)
STRETCH = _topic(topics.STRETCH)
STRETCH_RATE = _topic(topics.STRETCH_RATE)
MARKERS = _topic(topics.MARKERS)
CLOCK_TOPIC = _topic(topics.CLOCK_TOPIC)
DIAGNOSTICS = _topic(topics.DIAGNOSTICS)

STOP = _service(topics.STOP)
RESET_ESTIMATE = _service(topics.RESET_ESTIMATE)
SAVE_ESTIMATE = _service(topics.SAVE_ESTIMATE)
RESET = _service(topics.RESET)
STEP = _service(topics.STEP)
SET_PAUSED = _service(topics.SET_PAUSED)
PAUSE = _service(topics.PAUSE)
RESUME = _service(topics.RESUME)
TOGGLE_PAUSED = _service(topics.TOGGLE_PAUSED)
IS_PAUSED = _service(topics.IS_PAUSED)
PLAY_NEXT = _service(topics.PLAY_NEXT)
SNAPSHOT = _service(topics.SNAPSHOT)
SPLIT_BAGFILE = _service(topics.SPLIT_BAGFILE)


def publisher(node: Node, topic: Topic) -> Publisher:
    """Return a node's publisher of a topic."""
    return node.create_publisher(topic.type, topic.name, topic.qos)


def of_joint(topic: Topic, joint: str, joints: Sequence[str]) -> Topic:
    """Return the topic of one joint, named as `hmsa_ros.contract.topics.of_joint` says."""
    name = topics.of_joint(topic.name, joint, joints)
    return topic if name == topic.name else replace(topic, name=name)
