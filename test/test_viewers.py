"""
Files for viewers in config/, compared with the package's topics.

The viewers are not Python packages, so their files are compared with the requirements of their
readers.
"""

from collections.abc import Iterator
import json
from pathlib import Path
import re
from typing import Any
from xml.etree import ElementTree

from documents import services_by_name, topics_by_name
import pytest
import yaml

from hmsa.interfaces import topics
from hmsa_ros.nodes.ros_entities import interface_class

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
    known = topics_by_name()
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
    topic = topics_by_name()[publish['topicName']]
    assert publish['datatype'] == topic.type
    assert interface_class(topic.type)(**json.loads(publish['value'])).data > 0.0
    call = FOXGLOVE['configById']['CallService!stop']
    request = interface_class(services_by_name()[call['serviceName']].type).Request
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
    known = topics_by_name()
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
