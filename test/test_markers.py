"""The actuators as markers: geometry, signs, places and identifiers."""

from itertools import pairwise
import math

from hypothesis import given, strategies
import numpy as np
import pytest
from std_msgs.msg import Float64
from visualization_msgs.msg import Marker, MarkerArray

from hmsa.errors import BadInputError
from hmsa.interfaces import parameters as declared
from hmsa.interfaces import topics
from hmsa.interfaces.actuator import actuator_from
from hmsa.model.parameters import paper_actuator
from hmsa_ros.nodes.markers import (
    BLOCK,
    FIELD,
    LABEL,
    MAGNETISATION,
    MarkerBlock,
    MarkerLayout,
    MarkerState,
    TARGET,
)

ACTUATOR = paper_actuator()
STRETCHES = strategies.floats(0.3, 3.0)
# Floating-point rounding of a few operations.
ROUNDING = 1e-12


def scene(*joints: str, **options: object) -> MarkerLayout:
    """Return a scene of blocks as in the paper."""
    return MarkerLayout(
        tuple(MarkerBlock.of(joint, ACTUATOR) for joint in joints), 'coil', **options)


def of(markers: MarkerArray, number: int, joint: str = 'actuator') -> Marker:
    """Return a joint's only marker with an identifier."""
    found = [x for x in markers.markers if (x.ns, x.id) == (joint, number)]
    assert len(found) == 1
    return found[0]


def length(marker: Marker) -> float:
    """Return the signed length of an arrow, which must be parallel to z."""
    start, end = marker.points
    assert (start.x, start.y) == (end.x, end.y)
    return float(end.z - start.z)


@given(STRETCHES, strategies.floats(1e-3, 1e3))
def test_block_keeps_its_volume_and_is_the_stretch_times_as_thick(stretch, scale):
    block = of(scene('actuator', scale=scale).states(0, [MarkerState(stretch, 0.0)]), BLOCK)
    rest = (2 * ACTUATOR.half_length) ** 2 * 2 * ACTUATOR.half_thickness
    assert block.scale.x * block.scale.y * block.scale.z == pytest.approx(
        rest * scale ** 3, rel=ROUNDING)
    assert block.scale.x == block.scale.y
    assert block.scale.z == pytest.approx(
        2 * ACTUATOR.half_thickness * stretch * scale, rel=ROUNDING)


def test_block_is_true_to_size_unless_told_otherwise():
    block = of(scene('actuator').states(0, [MarkerState(1.0, 0.0)]), BLOCK)
    assert block.type == Marker.CUBE
    assert (block.scale.x, block.scale.y, block.scale.z) == (0.02, 0.02, 0.02)


@pytest.mark.parametrize('flux_density', [0.12, -0.12])
def test_field_points_where_its_sign_says_and_magnetisation_always_up(flux_density):
    markers = scene('actuator').states(0, [MarkerState(1.1, flux_density)])
    field, magnetisation = of(markers, FIELD), of(markers, MAGNETISATION)
    assert math.copysign(1.0, length(field)) == math.copysign(1.0, flux_density)
    assert length(magnetisation) > 0.0


def test_field_and_magnetisation_are_drawn_to_one_scale():
    stretch, flux_density = 1.3, -0.25
    markers = scene('actuator').states(0, [MarkerState(stretch, flux_density)])
    # The remanence moves with the material: Br times the stretch.
    assert length(of(markers, FIELD)) / flux_density == pytest.approx(
        length(of(markers, MAGNETISATION)) / (ACTUATOR.remanence * stretch), rel=ROUNDING)


def test_field_stands_beside_the_block_and_magnetisation_inside_it():
    markers = scene('actuator').states(0, [MarkerState(0.6, -0.2)])
    side = of(markers, BLOCK).scale.x
    assert of(markers, FIELD).points[0].x > side / 2
    assert of(markers, MAGNETISATION).points[0].x == 0.0
    assert length(of(markers, MAGNETISATION)) < of(markers, BLOCK).scale.z


def test_without_a_field_its_arrow_is_deleted_not_drawn_without_a_direction():
    markers = scene('actuator').states(0, [MarkerState(1.0, 0.0)])
    assert of(markers, FIELD).action == Marker.DELETE
    assert of(markers, MAGNETISATION).action == Marker.ADD


def test_head_of_a_short_arrow_is_no_longer_than_half_of_it():
    field = of(scene('actuator').states(0, [MarkerState(1.0, 1e-5)]), FIELD)
    assert 0.0 < field.scale.z <= length(field) / 2 * (1 + ROUNDING)


def test_target_has_the_size_of_the_block_that_reaches_it():
    targets = scene('actuator').targets(0, [1.4])
    block = of(scene('actuator').states(0, [MarkerState(1.4, 0.1)]), BLOCK)
    assert of(targets, TARGET).scale == block.scale
    assert of(targets, TARGET).pose == block.pose
    assert of(targets, TARGET).color.a < block.color.a


def test_no_target_deletes_the_one_before():
    assert of(scene('actuator').targets(0, [None]), TARGET).action == Marker.DELETE


def test_label_names_the_joint_and_its_stretch():
    label = of(scene('left').states(0, [MarkerState(1.1, 0.0)]), LABEL, 'left')
    assert label.type == Marker.TEXT_VIEW_FACING
    assert label.text == 'left 1.1000'


def test_joints_stand_side_by_side_without_touching_about_the_origin():
    joints = [f'joint_{i}' for i in range(20)]
    places = scene(*joints).places()
    assert len(set(places)) == len(joints)
    widest = MarkerBlock.of('x', ACTUATOR).size(0.5)[0]
    for row in range(0, 20, 8):
        for (x, y), (next_x, next_y) in pairwise(places[row:row + 8]):
            assert y == next_y
            assert next_x - x > widest
    assert sum(x for x, _ in places[:8]) == pytest.approx(0.0, abs=ROUNDING)
    assert places[0][1] == -places[-1][1] > 0.0


def test_each_joint_has_a_namespace_and_identifiers_that_stay():
    two = scene('left', 'right', scale=10.0)
    first = two.states(1, [MarkerState(1.0, 0.1), MarkerState(1.1, 0.2)])
    second = two.states(2, [MarkerState(1.2, 0.0), MarkerState(0.9, -0.2)])
    keys = [(x.ns, x.id) for x in first.markers]
    assert keys == [(x.ns, x.id) for x in second.markers]
    assert len(set(keys)) == len(keys) == 8
    targets = {(x.ns, x.id) for x in two.targets(1, [1.0, 1.0]).markers}
    assert not targets & set(keys)


def test_markers_are_stamped_in_the_frame_and_live_as_long_as_told():
    for marker in scene('actuator', lifetime=1.5).states(
            2_500_000_000, [MarkerState(1.0, 0.1)]).markers:
        assert marker.header.frame_id == 'coil'
        assert (marker.header.stamp.sec, marker.header.stamp.nanosec) == (2, 500_000_000)
        assert (marker.lifetime.sec, marker.lifetime.nanosec) == (1, 500_000_000)
        assert abs(marker.pose.orientation.w) == 1.0


def test_block_without_a_name_is_refused():
    with pytest.raises(BadInputError, match='joint is empty'):
        MarkerBlock('', 0.01, 0.01, 0.1, ACTUATOR.side)


def collected(ros, node):
    """Return the list that a node's marker messages are appended to."""
    return ros.collect(MarkerArray, f'/{node}/markers', topics.MARKERS.qos)


@pytest.mark.ros
def test_plant_shows_its_state_only_while_somebody_looks(ros, serve):
    from hmsa_ros.nodes.plant import PlantNode
    plant = serve(
        PlantNode, '-p', 'marker_rate:=100.0', '-p', 'marker_scale:=10.0', '-p',
        'frame_id:=here', '-p', 'initial_stretch:=1.2').nodes[0]
    (publisher,) = (x for x in plant.publishers if x.topic_name.endswith('markers'))
    sent = []
    publish = publisher.publish
    publisher.publish = lambda message: (sent.append(1), publish(message))
    states = ros.collect(topics.JOINT_STATES, 'joint_states')
    ros.spin_until(lambda: len(states) > 200, 'time to run')
    assert not sent
    arrays = collected(ros, 'plant')
    ros.spin_until(lambda: len(arrays) > 3, 'markers')
    block = of(arrays[-1], BLOCK)
    assert block.header.frame_id == 'here'
    assert block.scale.z == pytest.approx(10 * 0.02 * 1.2, rel=1e-6)
    assert block.lifetime.sec == 2
    assert length(of(arrays[-1], FIELD)) > 0.0


@pytest.mark.ros
def test_planner_shows_its_target_and_plant_reaches_it_each_joint_in_its_place(ros, serve):
    from hmsa_ros.nodes.planner import PlannerNode
    from hmsa_ros.nodes.plant import PlantNode
    serve(PlantNode, PlannerNode, '-p', 'joints:=[left, right]', '-p',
          'right.actuator.half_length:=0.005')
    shown, targets = collected(ros, 'plant'), collected(ros, 'planner')
    setpoint = ros.publisher(topics.SETPOINT, '/planner/right/setpoint')
    setpoint.publish(Float64(data=1.1))

    def reached():
        if not shown or not targets or of(targets[-1], TARGET, 'right').action != Marker.ADD:
            return False
        target, block = of(targets[-1], TARGET, 'right'), of(shown[-1], BLOCK, 'right')
        return block.scale.z == pytest.approx(target.scale.z, rel=1e-4)

    ros.spin_until(reached, 'the block to fill its target')
    target, block = of(targets[-1], TARGET, 'right'), of(shown[-1], BLOCK, 'right')
    assert target.pose == block.pose
    assert target.scale.z == pytest.approx(0.02 * 1.1)
    assert target.scale.x == pytest.approx(0.01 / math.sqrt(1.1))
    assert of(targets[-1], TARGET, 'left').action == Marker.DELETE
    assert of(shown[-1], BLOCK, 'left').pose.position.x < block.pose.position.x


@pytest.mark.ros
def test_rate_zero_shows_nothing(ros, serve):
    from hmsa_ros.nodes.plant import PlantNode
    serve(PlantNode, '-p', 'marker_rate:=0.0')
    arrays = collected(ros, 'plant')
    states = ros.collect(topics.JOINT_STATES, 'joint_states')
    ros.spin_until(lambda: len(states) > 300, 'time to run')
    assert not arrays


@pytest.mark.parametrize('deflection', [0.0, 0.4, -0.7])
def test_a_bent_beam_is_closed_keeps_its_volume_and_ends_where_its_tip_is(deflection):
    beam = actuator_from({x.name: x.default for x in declared.BLOCK} | {
        'law.name': 'beam', 'law.youngs_modulus': 1e6, 'law.width': 0.005,
        'actuator.half_length': 0.0125, 'actuator.half_thickness': 0.0005})
    markers = MarkerLayout((MarkerBlock.of('actuator', beam),), 'coil').states(
        0, [MarkerState(deflection, 0.001)])
    body = of(markers, BLOCK)
    assert body.type == Marker.TRIANGLE_LIST
    points = np.array([(p.x, p.y, p.z) for p in body.points])
    triangles = points.reshape(-1, 3, 3)
    edges = [(tuple(a), tuple(b)) for t in triangles.tolist()
             for a, b in zip(t, t[1:] + t[:1], strict=True)]
    # Each edge is passed once in both directions: nothing is open, all faces look outwards.
    assert sorted(edges) == sorted((b, a) for a, b in edges)
    volume = np.linalg.det(triangles).sum() / 6.0
    assert volume == pytest.approx(0.025 * 0.005 * 0.001, rel=0.02)
    tip = points[points[:, 0] == points[:, 0].max()] if not deflection else points
    assert np.abs(tip[:, 2]).max() == pytest.approx(abs(deflection) * 0.025, abs=0.0006)
    arrow = of(markers, MAGNETISATION)
    begin, end = arrow.points
    assert math.hypot(end.x - begin.x, end.z - begin.z) == pytest.approx(0.0125)
    assert length(of(markers, FIELD)) > 0.0
    assert of(
        MarkerLayout((MarkerBlock.of('actuator', beam),), 'coil').targets(0, [0.1]), TARGET).points
