"""Required subscribers of published messages, and their presence."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.parameter import parameter_value_to_python

from hmsa.errors import BadInputError, listed
from hmsa.interfaces import topics
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.cdr import stamp_of
from hmsa_ros.nodes.playback_publishers import NAMED_AT_MOST
from hmsa_ros.nodes.selection import Selection
from hmsa_ros.nodes.service_call import ServiceCall


class Audience:
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
