"""Publishes markers: the plant's of the present state, the planner's of the target."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rclpy.node import Node

from hmsa_ros.interfaces import topics
from hmsa_ros.interfaces.actuator import actuator_from
from hmsa_ros.interfaces.parameters import ParameterSpec
from hmsa_ros.nodes import endpoints
from hmsa_ros.nodes.joints import JointParameters
from hmsa_ros.nodes.managed import ManagedNode
from hmsa_ros.nodes.markers import Block, Scene, State

MARKER_SCALE = ParameterSpec(
    'marker_scale', 1.0,
    'Scale of ~/markers: metres shown per metre; 1 is true to size.', '', 1e-6, 1e9)
MARKER_RATE = ParameterSpec(
    'marker_rate', 30.0,
    'Rate of ~/markers while there is a subscriber; 0 for never.', 'Hz',
    0.0, 1e3)
MARKER_FRAME = ParameterSpec('frame_id', 'coil', 'Frame of the markers.')

# A viewer drops what was not sent for this long, or for so many periods.
_LIFETIME_SECONDS = 2.0
_LIFETIME_PERIODS = 10.0


def scene_from(values: JointParameters, lifetime: float = 0.0) -> Scene:
    """Return the scene of a node's joints, one block each; lifetime in s, 0 for ever."""
    return Scene(
        tuple(Block.of(name, actuator_from(values.of(name))) for name in values.names),
        values[MARKER_FRAME.name], values[MARKER_SCALE.name], lifetime)


class StateMarkers:
    """
    Publishes the joints as they are, at ``marker_rate``, while somebody looks.

    ``pace`` is how many seconds of the node's time, in which lifetimes are counted, pass in a
    second; 0 if it has no bound.
    """

    def __init__(
            self, node: ManagedNode, values: JointParameters, pace: float,
            states: Callable[[], tuple[int, Sequence[State]]]) -> None:
        self._publisher = endpoints.publisher(node, topics.MARKERS)
        self._states = states
        rate: float = values[MARKER_RATE.name]
        lifetime = 0.0
        if rate > 0.0:
            lifetime = max(1.0, pace) * max(_LIFETIME_SECONDS, _LIFETIME_PERIODS / rate)
            # The eye's time, whatever pace simulated time has.
            node.every(1.0 / rate, self._show)
        self._scene = scene_from(values, lifetime if pace > 0.0 else 0.0)

    def _show(self) -> None:
        if self._publisher.get_subscription_count():
            stamp, states = self._states()
            self._publisher.publish(self._scene.states(stamp, states))


class TargetMarkers:
    """Publishes where the joints are to go, whenever that changes."""

    def __init__(self, node: Node, values: JointParameters) -> None:
        self._publisher = endpoints.publisher(node, topics.MARKERS)
        self._scene = scene_from(values)
        self._shown: Any = None

    def show(self, stamp: int, stretches: Mapping[str, float | None]) -> None:
        """Show targets (stamp in ns, stretches by joint, None for none) if they have changed."""
        wanted = tuple(stretches.get(block.joint) for block in self._scene.blocks)
        if wanted != self._shown:
            self._shown = wanted
            self._publisher.publish(self._scene.targets(stamp, wanted))
