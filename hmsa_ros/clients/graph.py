"""Subscribers of a planner's commands in the ROS graph."""

from collections.abc import Sequence

from rclpy.node import Node

from hmsa.interfaces import topics
from hmsa_ros.nodes.ros_entities import publishers_of, recorders, subscribers_of


def unheard(node: Node, namespace: str, joints: Sequence[str]) -> list[str]:
    """Return a planner's command topics without subscribers other than recorders."""
    leave_out = recorders(node)
    return [x for x in _commands(node, namespace, joints)
            if leave_out.issuperset(subscribers_of(node, x).values())]


def _commands(node: Node, namespace: str, joints: Sequence[str]) -> list[str]:
    """Return the topics on which the planner commands joints, including remapped ones."""
    planner = f'/{namespace.strip("/")}/{topics.PLANNER}'.replace('//', '/')
    named = [
        topic for topic, types in node.get_topic_names_and_types()
        if topics.FLUX_DENSITY_COMMAND.type in types
        and planner in publishers_of(node, topic).values()]
    return [x for x in named if x.split('/')[-2] in joints] or named or [
        node.resolve_topic_name(
            topics.of_joint(topics.FLUX_DENSITY_COMMAND, x, joints).name) for x in joints]
