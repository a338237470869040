"""
Files for viewers in config/, compared with the package's topics, and Rerun.

The viewers are not Python packages, so their files are compared with the requirements of their
readers. Rerun shows a bag if rerun-sdk is installed.
"""

from collections.abc import Iterator, Mapping
import json
from pathlib import Path
import re
import subprocess
import sys
from typing import Any
from xml.etree import ElementTree

from beam_oracle import silicone
import numpy as np
import pytest
from std_msgs.msg import Float64
import yaml

from hmsa_ros import rerun_view
from hmsa_ros.interfaces import topics
from hmsa_ros.interfaces.actuator import parameters_of
from hmsa_ros.model.parameters import paper_actuator
from hmsa_ros.nodes.endpoints import interface_class
from hmsa_ros.nodes.markers import Block, Scene, State

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / 'config'
RVIZ = yaml.safe_load((CONFIG / 'rviz' / 'hmsa.rviz').read_text())
FOXGLOVE = json.loads((CONFIG / 'foxglove.json').read_text())
PLOTJUGGLER = ElementTree.parse(CONFIG / 'plotjuggler.xml').getroot()
JOINT = 'actuator'

# What plugins of rviz_common and rviz_default_plugins are called, as far as they are used.
RVIZ_CLASSES = {
    'rviz_common': {'Displays', 'Views', 'Time'},
    'rviz_default_plugins': {
        'Axes', 'FocusCamera', 'Grid', 'MarkerArray', 'Measure', 'MoveCamera', 'Orbit', 'Select',
        'TF'}}
# Panels of Foxglove, and the keys by which each is told what to show.
FOXGLOVE_PANELS = {
    '3D': {'cameraState', 'topics', 'layers', 'followTf', 'scene', 'transforms'},
    'Plot': {'paths', 'xAxisVal', 'showLegend', 'isSynced'},
    'RawMessages': {'topicPath'},
    'DiagnosticSummary': {'topicToRender', 'minLevel', 'pinnedIds', 'hardwareIdFilter'},
    'Publish': {'topicName', 'datatype', 'value', 'advancedView'},
    'CallService': {'serviceName', 'requestPayload', 'layout'}}
PLOT_STYLES = {'Lines', 'Dots', 'LinesAndDots', 'Sticks', 'Steps', 'StepsInv'}


def by_name() -> Mapping[str, topics.Topic]:
    """Return the topics by full name, for one joint without namespace."""
    found = {}
    for topic in vars(topics).values():
        if isinstance(topic, topics.Topic):
            for node in (*topic.publishers, *topic.subscribers):
                name = topics.from_outside(topic.name, node)
                found[name if name.startswith('/') else f'/{name}'] = topic
    return found


def services() -> Mapping[str, topics.Service]:
    """Return the services by full name."""
    return {f'/{topics.from_outside(service.name, node)}': service
            for service in vars(topics).values()
            if isinstance(service, topics.Service) for node in service.meaning}


def field(type_name: str, path: str) -> None:
    """Follow a path of fields, such as ``points[:].positions[0]``, through a message type."""
    kind = interface_class(type_name)
    message: Any = kind()
    for part in path.split('.'):
        name, index = re.fullmatch(r'(\w+)((?:\[[\d:]*\])?)', part).groups()  # type: ignore[union-attr]
        assert name in message.get_fields_and_field_types(), f'{path} of {kind.__name__}'
        element = message.get_fields_and_field_types()[name]
        message = getattr(message, name)
        assert bool(index) == element.startswith('sequence<')
        if index and '/' in element:
            package, element_name = element.removeprefix('sequence<').rstrip('>').split('/')
            module = __import__(f'{package}.msg', fromlist=[element_name])
            message = getattr(module, element_name)()


def classes(value: Any) -> Iterator[str]:
    """Yield every class named in an RViz file."""
    if isinstance(value, dict):
        if value.get('Class'):
            yield value['Class']
        for part in value.values():
            yield from classes(part)
    elif isinstance(value, list):
        for part in value:
            yield from classes(part)


def test_rviz_file_has_what_rviz_reads():
    assert set(RVIZ) == {'Panels', 'Visualization Manager', 'Window Geometry'}
    manager = RVIZ['Visualization Manager']
    assert {'Displays', 'Global Options', 'Tools', 'Views', 'Transformation'} <= set(manager)
    for name in classes(RVIZ):
        package, _, plugin = name.partition('/')
        assert plugin in RVIZ_CLASSES[package]
    names = [x['Name'] for x in manager['Displays']]
    assert len(set(names)) == len(names)


def test_rviz_shows_the_markers_of_plant_and_planner_as_they_are_offered():
    displays = [x for x in RVIZ['Visualization Manager']['Displays']
                if x['Class'] == 'rviz_default_plugins/MarkerArray']
    # Relative, so that RViz in the nodes' namespace finds them.
    assert {x['Topic']['Value'] for x in displays} == {
        topics.from_outside(topics.MARKERS.name, node)
        for node in topics.MARKERS.publishers}
    for display in displays:
        assert display['Enabled'] is True
        assert display['Topic']['Reliability Policy'] == 'Reliable'
        assert topics.MARKERS.qos.latched
        assert display['Topic']['Durability Policy'] == 'Transient Local'


def test_rviz_stands_in_the_frame_of_the_coil_near_enough_to_see_a_centimetre():
    from hmsa_ros.nodes import planner, plant
    manager = RVIZ['Visualization Manager']
    for node in (plant, planner):
        frame = next(spec for spec in node.PARAMETERS if spec.name == 'frame_id')
        assert manager['Global Options']['Fixed Frame'] == frame.default
    view = manager['Views']['Current']
    assert view['Near Clip Distance'] < view['Distance'] / 10 < 0.05


def test_foxglove_layout_has_each_panel_once_in_its_place():
    assert set(FOXGLOVE) == {
        'configById', 'globalVariables', 'userNodes', 'playbackConfig', 'layout'}

    def leaves(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
            return
        assert set(node) == {'direction', 'first', 'second', 'splitPercentage'}
        assert node['direction'] in ('row', 'column')
        assert 0 < node['splitPercentage'] < 100
        yield from leaves(node['first'])
        yield from leaves(node['second'])

    placed = list(leaves(FOXGLOVE['layout']))
    assert sorted(placed) == sorted(FOXGLOVE['configById'])
    for name, config in FOXGLOVE['configById'].items():
        kind, mark, identifier = name.partition('!')
        assert mark
        assert identifier
        assert set(config) >= FOXGLOVE_PANELS[kind]


def test_foxglove_shows_topics_and_fields_that_there_are():
    known = by_name()
    for name, config in FOXGLOVE['configById'].items():
        kind = name.partition('!')[0]
        if kind == '3D':
            assert config['topics']
            for topic in config['topics']:
                assert known[topic] is topics.MARKERS
        elif kind == 'Plot':
            for path in config['paths']:
                topic, _, fields = path['value'].partition('.')
                field(known[topic].type, fields)
                assert path['timestampMethod'] in ('headerStamp', 'receiveTime')
                assert re.fullmatch(r'#[0-9A-F]{6}', path['color'])
        elif kind == 'RawMessages':
            assert config['topicPath'] in known
        elif kind == 'DiagnosticSummary':
            assert config['topicToRender'] == topics.DIAGNOSTICS.name


def test_foxglove_publishes_and_calls_what_the_planner_takes():
    publish = FOXGLOVE['configById']['Publish!setpoint']
    assert publish['topicName'] == '/planner/setpoint'
    topic = by_name()[publish['topicName']]
    assert publish['datatype'] == topic.type
    assert interface_class(topic.type)(**json.loads(publish['value'])).data > 0.0
    call = FOXGLOVE['configById']['CallService!stop']
    request = interface_class(services()[call['serviceName']].type).Request
    assert json.loads(call['requestPayload']) == {}
    assert request.get_fields_and_field_types() == {}


def test_plotjuggler_file_has_what_plotjuggler_reads():
    assert PLOTJUGGLER.tag == 'root'
    assert {x.tag for x in PLOTJUGGLER} >= {'tabbed_widget', 'Plugins'}
    for splitter in PLOTJUGGLER.iter('DockSplitter'):
        assert splitter.get('orientation') in ('-', '|')
        sizes = [float(x) for x in splitter.attrib['sizes'].split(';')]
        assert len(sizes) == len(splitter) == int(splitter.attrib['count'])
        assert sum(sizes) == pytest.approx(1.0)
    plots = list(PLOTJUGGLER.iter('plot'))
    assert plots
    for plot in plots:
        assert plot.get('mode') in ('TimeSeries', 'XYPlot')
        assert plot.get('style') in PLOT_STYLES
        found = plot.find('range')
        assert found is not None
        edges = {key: float(value) for key, value in found.attrib.items()}
        assert edges['left'] < edges['right']
        assert edges['bottom'] < edges['top']
        for curve in plot.findall('curve'):
            assert ('curve_x' in curve.attrib) == (plot.get('mode') == 'XYPlot')


def test_plotjuggler_shows_topics_and_fields_that_there_are():
    known = by_name()
    names = []
    for curve in PLOTJUGGLER.iter('curve'):
        names += [curve.attrib['curve_x'], curve.attrib['curve_y']] \
            if 'curve_x' in curve.attrib else [curve.attrib['name']]
    for name in names:
        topic = next(x for x in known if name.startswith(f'{x}/'))
        fields = name.removeprefix(f'{topic}/')
        if topic == '/joint_states':
            # Of these PlotJuggler makes a curve a joint.
            joint, _, fields = fields.partition('/')
            assert joint == JOINT
            assert fields in ('position', 'velocity', 'effort')
        else:
            field(known[topic].type, fields.replace('/', '.'))


def test_rerun_view_names_topics_that_there_are():
    known = by_name()
    assert f'/{rerun_view.JOINT_STATES}' in known
    assert all(known[f'/{name}'] is topics.MARKERS for name in rerun_view.MARKERS)
    for path in list(rerun_view.views().values())[:-1]:
        topic, _, fields = path.rpartition('/')
        field(known[topic].type, f'{fields}[0]')
    assert rerun_view.views('left')['Stretch'] == '/left/joint_states/position'
    assert list(rerun_view.views(coordinate='deflection'))[:2] == [
        'Deflection', 'Deflection rate (1/s)']


def test_rerun_names_the_position_as_the_recorded_law_does():
    def named(*actuators, space='', joints=''):
        told = {f'{space}/plant.use_sim_time': 'false', f'{space}/plant.joints': joints} | {
            f'{space}/plant.{joint}{name}': json.dumps(value)
            for joint, actuator in zip(('one.', 'two.') if joints else ('',), actuators,
                                       strict=True)
            for name, value in parameters_of(actuator).items()}
        return rerun_view._coordinate(told, space)

    assert (named(paper_actuator()), rerun_view._coordinate({}, '')) == ('stretch', 'stretch')
    assert named(silicone(), space='/left') == 'deflection'
    both = '["one", "two"]'
    assert named(silicone(), silicone(), joints=both) == 'deflection'
    assert named(paper_actuator(), silicone(), joints=both) == 'position'


def test_without_rerun_it_is_asked_for_in_one_line(tmp_path, capfd, monkeypatch):
    monkeypatch.setitem(sys.modules, 'rerun', None)
    assert rerun_view.main([str(tmp_path)]) == 2
    assert 'expected it installed' in capfd.readouterr().err


@pytest.fixture
def rerun_program() -> list[str]:
    """Return the executable of Rerun in rerun-sdk."""
    pytest.importorskip('rerun', reason='rerun-sdk is not installed')
    return [sys.executable, '-m', 'rerun']


@pytest.mark.ros
def test_rerun_has_data_under_every_path_that_its_views_show(
        rerun_program, tmp_path, start, ros, capfd):
    bag = tmp_path / 'run'
    recorder = start.hmsa('recorder', '--ros-args', '-p', f'storage.uri:={bag}')
    start.hmsa('plant')
    start.hmsa('planner')
    # The test itself and the recorder.
    setpoint = ros.publisher(
        topics.SETPOINT.type, '/planner/setpoint', topics.SETPOINT.qos, subscribers=2)
    states, targets = (
        ros.collect(topics.MARKERS.type, f'/{node}/markers', topics.MARKERS.qos)
        for node in topics.MARKERS.publishers)
    for text in ('/plant/markers', '/planner/markers', '/joint_states'):
        recorder.wait_for_output(f'subscribed to {text}')
    setpoint.publish(Float64(data=1.1))
    # Until it has set out: its field is there.
    ros.spin_until(
        lambda: targets and targets[-1].markers[0].action == 0
        and states and states[-1].markers[2].action == 0, 'the block to set out')
    assert recorder.stop() == 0, recorder.output
    saved = tmp_path / 'run.rrd'
    assert rerun_view.main([str(bag), '--save', str(saved)]) == 0
    stats = subprocess.run(
        [*rerun_program, 'rrd', 'stats', saved], check=True, capture_output=True, text=True)
    chunks = {path: int(count) for path, count in re.findall(
        r'^(/\S*): (\d+)$', stats.stdout + stats.stderr, re.M)}
    for path in rerun_view.views().values():
        assert any(x == path or x.startswith(f'{path}/') for x in chunks), path
    assert sum(path.startswith('/view/') and path.count('/') == 2 for path in chunks) == len(
        rerun_view.views())
    # The block, its magnetisation, the field, the name and the target.
    assert {f'/markers/{JOINT}/{number}' for number in range(5)} <= set(chunks)
    verified = subprocess.run(
        [*rerun_program, 'rrd', 'verify', saved], check=False, capture_output=True, text=True)
    assert verified.returncode == 0, verified.stderr


def test_bag_without_samples_is_refused_in_one_line(rerun_program, tmp_path, capfd):
    assert rerun_view.main([str(tmp_path), '--save', str(tmp_path / 'x.rrd')]) == 2
    assert capfd.readouterr().err.count('\n') == 1


def test_a_bent_beam_is_a_shaded_mesh_in_rerun_at_its_place(tmp_path):
    rerun = pytest.importorskip('rerun', reason='rerun-sdk is not installed')
    from rerun.chunk import RrdReader

    blocks = (Block.of(JOINT, silicone()), Block.of('other', paper_actuator()))
    scene = Scene(blocks, 'coil', 2.0)
    saved = tmp_path / 'beam.rrd'
    recording = rerun.RecordingStream('test')
    recording.save(saved)
    shown = scene.states(0, [State(0.4, 0.001), State(1.0, 0.0)])
    for marker in shown.markers:
        rerun_view._log_marker(recording, '/markers', marker)
    recording.disconnect()
    found = {}
    for chunk in RrdReader(saved).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if str(chunk.entity_path) == f'/markers/{JOINT}/0' and 'Mesh3D' in name:
                found[name.split(':')[1]] = np.array(batch.column(name).to_pylist()[0])
    corners, normals = found['vertex_positions'], found['vertex_normals']
    body = shown.markers[0]
    wanted = np.array([(p.x, p.y, p.z) for p in body.points]) + [body.pose.position.x, 0.0, 0.0]
    assert corners == pytest.approx(wanted, abs=1e-7)
    # Half of the mesh from the pose on, the tip up by 0.4 of the length, at twice the size.
    assert corners[:, 2].max() == pytest.approx(2.0 * 0.4 * 0.025, abs=2e-3)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-6)
    # Outwards: they and the corners agree on the volume.
    faces = corners.reshape(-1, 3, 3)
    areas = np.linalg.norm(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]), axis=1)
    volume = np.sum(areas * np.einsum('ij,ij->i', normals[::3], faces.mean(axis=1))) / 6.0
    assert volume == pytest.approx(8.0 * 0.025 * 0.005 * 0.001, rel=0.02)
