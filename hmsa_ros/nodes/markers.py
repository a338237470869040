"""
Markers of the actuators for a 3-D view.

Each joint has a separate namespace with fixed identifiers, so that a message replaces the previous
one. The plant shows the present state, the planner the targets. Both use the same layout: rows
along x, a new row along y after `ROW` joints, the origin in the middle.

Along the field, which is z, a block measures 2 H times the stretch; across the field, 2 L times
the transverse stretch at rest, one over the square root of the stretch at constant volume.
The magnetisation moves with the material, so that the remanence of the deformed block is Br times
the stretch. Remanence and applied field are arrows of the same scale: length H for a flux density
of Br, upwards if positive.

A beam lies along x, is clamped at the end of smaller x, and bends towards z. The arrow of its
magnetisation lies along its middle and is half as long as the beam. The arrow of the field is as
long as the deflection of a beam without stiffening.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
import math
from typing import Any, NamedTuple

from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
import numpy as np
from rclpy.node import Node
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from hmsa.errors import BadInputError
from hmsa.interfaces import topics
from hmsa.interfaces.actuator import actuator_from
from hmsa.interfaces.parameters import ParameterSpec
from hmsa.model.laws.bending import centreline, tangent
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import NANOSECONDS
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.conversions import to_duration, to_time
from hmsa_ros.nodes.managed import ManagedNode
from hmsa_ros.nodes.parameters import JointParameters

#: Identifiers of a joint's markers, the same in every message.
BLOCK, MAGNETISATION, FIELD, LABEL, TARGET = range(5)
#: Number of joints in a row.
ROW = 8
#: Distance of blocks in half lengths of the largest: a block compressed to half its thickness is
#: 2.83 half lengths wide, and its field is drawn beside it.
PITCH = 6.0
#: Distance from the middle of a block to its field, in half lengths.
BESIDE = 2.0
# Number of cross-sections along a beam.
_STATIONS = 17

# Shape and colour by identifier, from the palette of Okabe and Ito: orange, blue, vermilion, grey,
# sky blue. Transparent shapes are the material.
_LOOKS = {
    BLOCK: (Marker.CUBE, (0.90, 0.62, 0.00, 0.55)),
    MAGNETISATION: (Marker.ARROW, (0.00, 0.45, 0.70, 1.0)),
    FIELD: (Marker.ARROW, (0.84, 0.37, 0.00, 1.0)),
    LABEL: (Marker.TEXT_VIEW_FACING, (0.75, 0.75, 0.75, 1.0)),
    TARGET: (Marker.CUBE, (0.34, 0.71, 0.91, 0.25))}


@dataclass(frozen=True)
class MarkerBlock:
    """
    Constant properties of a joint.

    Raises
    ------
    BadInputError
        If the name is empty.

    """

    joint: str  #: name of the joint and namespace of its markers
    #: L and H in m, greater than 0
    half_length: float
    half_thickness: float
    remanence: float  #: Br in T, greater than 0
    side: Callable[[float], float]  #: returns the transverse stretch at rest under a stretch
    per_tesla: float = 1.0  #: arrow length of the field in m/T
    width: float = 0.0  #: width of a beam in m; 0 for a block

    def __post_init__(self) -> None:
        if not self.joint:
            raise BadInputError('joint is empty: expected a name')

    @classmethod
    def of(cls, joint: str, actuator: ActuatorParameters) -> 'MarkerBlock':
        """Return the block of a joint's parameters."""
        length, thickness = actuator.half_length, actuator.half_thickness
        section = 0.0 if actuator.law is None else actuator.law.section
        return cls(
            joint, length, thickness, actuator.remanence, actuator.side,
            per_tesla=2.0 * length / (3.0 * actuator.flux_density_unit)
            if section else thickness / actuator.remanence,
            width=2.0 * section * length ** 2 / thickness)

    def bent(self, deflection: float) -> list[tuple[float, float, float]]:
        """
        Return triangle corners in m of a beam, given its tip deflection over its length.

        The origin is the middle of the straight beam.
        """
        along, across = (2.0 * self.half_length * x for x in centreline(deflection, _STATIONS))
        angle = tangent(deflection, np.linspace(0.0, 1.0, _STATIONS))
        x, z = along - self.half_length, across
        normal = self.half_thickness * np.stack([-np.sin(angle), np.cos(angle)])
        # Four corners of the cross-section at each station.
        rings = [[(float(x[i] + s * normal[0, i]), t * self.width / 2,
                   float(z[i] + s * normal[1, i]))
                  for s, t in ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))]
                 for i in range(_STATIONS)]
        points = []
        for a, b in pairwise(rings):
            for i in range(4):
                j = (i + 1) % 4
                points += [a[i], b[i], b[j], a[i], b[j], a[j]]
        for ring in (rings[0], rings[-1][::-1]):
            points += [ring[0], ring[1], ring[2], ring[0], ring[2], ring[3]]
        return points

    def size(self, stretch: float) -> tuple[float, float, float]:
        """Return 2 l, 2 l and 2 h in m at a stretch."""
        side = 2.0 * self.half_length * self.side(stretch)
        return side, side, 2.0 * self.half_thickness * stretch


class MarkerState(NamedTuple):
    """Stretch, or deflection of a beam, and flux density along z in T of a joint."""

    stretch: float
    flux_density: float


@dataclass(frozen=True)
class MarkerLayout:
    """Layout and scale of the joints."""

    blocks: tuple[MarkerBlock, ...]  #: one for each joint, in the order of ``joints``
    frame: str  #: frame of the markers
    scale: float = 1.0  #: metres shown per metre, greater than 0; 1 is true to size
    #: seconds after which a viewer removes a marker that was not sent again, 0 for never
    lifetime: float = 0.0

    def places(self) -> list[tuple[float, float]]:
        """Return x and y of the blocks in m before scaling, centred at the origin."""
        pitch = PITCH * max((block.half_length for block in self.blocks), default=0.0)
        count = len(self.blocks)
        columns, rows = min(count, ROW), -(-count // ROW)
        return [
            (pitch * (number % ROW - (columns - 1) / 2),
             pitch * ((rows - 1) / 2 - number // ROW))
            for number in range(count)]

    def states(self, stamp: int, states: Sequence[MarkerState]) -> MarkerArray:
        """Return block, arrows and label of each joint; an unknown field deletes its arrow."""
        return MarkerArray(markers=[
            marker for drawing, state in zip(self._drawings(stamp), states, strict=True)
            for marker in drawing.state(state)])

    def targets(self, stamp: int, stretches: Sequence[float | None]) -> MarkerArray:
        """Return transparent blocks at the targets; None deletes a joint's marker."""
        return MarkerArray(markers=[
            drawing.deleted(TARGET) if stretch is None else drawing.body(TARGET, stretch)
            for drawing, stretch in zip(self._drawings(stamp), stretches, strict=True)])

    def _drawings(self, stamp: int) -> Iterable['_Drawing']:
        return (_Drawing(self, stamp, block, place) for block, place in zip(
            self.blocks, self.places(), strict=True))


@dataclass(frozen=True)
class _Drawing:
    """Markers of one joint of a scene at a timestamp in ns; x and y of its middle in m."""

    scene: MarkerLayout
    stamp: int
    block: MarkerBlock
    place: tuple[float, float]

    def state(self, state: MarkerState) -> Iterable[Marker]:
        """Yield block, arrows and label."""
        block = self.block
        yield self.body(BLOCK, state.stretch)
        if block.width:
            height = block.half_length
            yield self._along(state.stretch)
        else:
            height = block.half_thickness * state.stretch
            yield self._arrow(
                MAGNETISATION, block.per_tesla * block.remanence * state.stretch)
        yield self._arrow(FIELD, block.per_tesla * state.flux_density, BESIDE * block.half_length)
        yield self._marker(
            LABEL, pose=self._pose(height + 0.8 * block.half_thickness),
            scale=Vector3(z=0.4 * block.half_length * self.scene.scale),
            text=f'{block.joint} {state.stretch:.4f}')

    def body(self, number: int, stretch: float) -> Marker:
        """Return a block at a stretch, or a beam at a deflection."""
        if self.block.width:
            return self._marker(
                number, type=Marker.TRIANGLE_LIST, pose=self._pose(0.0),
                scale=Vector3(x=1.0, y=1.0, z=1.0),
                points=[self._point(*corner) for corner in self.block.bent(stretch)])
        size = self._point(*self.block.size(stretch))
        return self._marker(
            number, pose=self._pose(0.0), scale=Vector3(x=size.x, y=size.y, z=size.z))

    def deleted(self, number: int) -> Marker:
        """Return a message that deletes a marker."""
        return self._marker(number, action=Marker.DELETE)

    def _along(self, deflection: float) -> Marker:
        """Return the arrow of a beam's magnetisation, along its middle."""
        marker = self._arrow(MAGNETISATION, self.block.half_length)
        angle = float(tangent(deflection, 0.5))
        x, z = math.cos(angle), math.sin(angle)
        along, across = centreline(deflection, 3)
        marker.points = [self._point(
            self.place[0] + (2.0 * along[1] - 1.0 + share * x) * self.block.half_length,
            self.place[1], (2.0 * across[1] + share * z) * self.block.half_length)
            for share in (-0.5, 0.5)]
        return marker

    def _arrow(self, number: int, length: float, beside: float = 0.0) -> Marker:
        """Return an arrow along z around the block's middle, downwards for a negative length."""
        if length == 0.0:
            # An arrow of zero length has no direction, which viewers report as an error.
            return self.deleted(number)
        # Diameters of shaft and head, and length of the head, at most half the arrow.
        thickness = 0.12 * self.block.half_length * self.scene.scale
        return self._marker(
            number, pose=Pose(orientation=Quaternion(w=1.0)),
            points=[self._point(self.place[0] + beside, self.place[1], z)
                    for z in (-length / 2, length / 2)],
            scale=Vector3(x=thickness, y=2.5 * thickness, z=min(
                3.0 * thickness, abs(length) / 2 * self.scene.scale)))

    def _marker(self, number: int, **fields: Any) -> Marker:
        kind, (red, green, blue, alpha) = _LOOKS[number]
        return Marker(**{
            'header': Header(stamp=to_time(self.stamp), frame_id=self.scene.frame),
            'ns': self.block.joint, 'id': number, 'type': kind, 'action': Marker.ADD,
            'color': ColorRGBA(r=red, g=green, b=blue, a=alpha),
            'lifetime': to_duration(round(self.scene.lifetime * NANOSECONDS)), **fields})

    def _pose(self, height: float) -> Pose:
        return Pose(
            position=self._point(*self.place, height), orientation=Quaternion(w=1.0))

    def _point(self, x: float, y: float, z: float) -> Point:
        return Point(x=x * self.scene.scale, y=y * self.scene.scale, z=z * self.scene.scale)


MARKER_SCALE = ParameterSpec(
    'marker_scale', 1.0,
    'Scale of ~/markers: metres shown per metre; 1 is true to size.', '', 1e-6, 1e9)
MARKER_RATE = ParameterSpec(
    'marker_rate', 30.0,
    'Rate of ~/markers while there is a subscriber; 0 for never.', 'Hz', 0.0, 1e3)
MARKER_FRAME = ParameterSpec('frame_id', 'coil', 'Frame of the markers.')

# A viewer removes a marker that was not sent for this time, or for this number of periods.
_LIFETIME_SECONDS = 2.0
_LIFETIME_PERIODS = 10.0


def scene_from(values: JointParameters, lifetime: float = 0.0) -> MarkerLayout:
    """Return the scene of a node's joints, one block each; lifetime in s, 0 for unlimited."""
    return MarkerLayout(
        tuple(MarkerBlock.of(name, actuator_from(values.of(name))) for name in values.names),
        values[MARKER_FRAME.name], values[MARKER_SCALE.name], lifetime)


def show_states(
        node: ManagedNode, values: JointParameters, pace: float,
        states: Callable[[], tuple[int, Sequence[MarkerState]]]) -> None:
    """
    Publish the state of the joints at ``marker_rate``, with a timestamp in ns, if subscribed to.

    ``pace`` is the node's time, which lifetimes refer to, per second of real time; 0 if unlimited.
    """
    publisher = ros_entities.publisher(node, topics.MARKERS)
    rate: float = values[MARKER_RATE.name]
    if rate == 0.0:
        return
    lifetime = max(1.0, pace) * max(_LIFETIME_SECONDS, _LIFETIME_PERIODS / rate)
    scene = scene_from(values, lifetime if pace > 0.0 else 0.0)

    def show() -> None:
        if publisher.get_subscription_count():
            publisher.publish(scene.states(*states()))

    # The period is in real time, whatever the pace of simulated time.
    node.every(1.0 / rate, show)


class TargetMarkers:
    """Publish the targets of the joints whenever they change."""

    def __init__(self, node: Node, values: JointParameters) -> None:
        self._publisher = ros_entities.publisher(node, topics.MARKERS)
        self._scene = scene_from(values)
        self._shown: Any = None

    def show(self, stamp: int, stretches: Mapping[str, float | None]) -> None:
        """Publish targets (timestamp in ns, stretches by joint, None for none) if they changed."""
        wanted = tuple(stretches.get(block.joint) for block in self._scene.blocks)
        if wanted != self._shown:
            self._shown = wanted
            self._publisher.publish(self._scene.targets(stamp, wanted))
