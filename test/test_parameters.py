"""Parameters: declared once, described, and consistent with the files under config/."""

from dataclasses import replace
import math
from pathlib import Path
import re
import subprocess
import sys
from typing import Any

import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import get_parameter_value, Parameter, parameter_value_to_python
import yaml

from hmsa import Actuator, plugins
from hmsa.cli.options import _PLANNING
from hmsa.errors import BadInputError
from hmsa.interfaces.actuator import actuator_from
from hmsa.interfaces.parameters import (
    ACTUATOR,
    BLOCK,
    FOREIGN,
    is_for,
    MISMATCH,
    ParameterSpec,
    PLAIN_NAMES,
    sections_of,
    SENSOR_LATENCY,
    VISCOELASTIC,
)
from hmsa.interfaces.topics import NODES
from hmsa.model.parameters import ActuatorParameters, paper_actuator
from hmsa.plugins import registered
from hmsa_ros.nodes import planning, plant
from hmsa_ros.nodes.parameters import check_names, declare, declare_joints, type_of, unread_files
from hmsa_ros.nodes.planner import PlannerNode
from hmsa_ros.nodes.plant import PlantNode

CONFIG = Path(__file__).resolve().parent.parent / 'config'
DECLARED: dict[str, tuple[ParameterSpec, ...]] = {
    name: node.load().PARAMETERS for name, node in registered(plugins.NODES).items()
    if name in NODES}
# Numbers that are a ratio or a count.
DIMENSIONLESS = {
    'creep_tolerance', 'marker_scale', 'max_points', 'minimax_errors', 'path_tolerance',
    'actuator.chain_limit', 'initial_stretch', 'real_time_factor', 'robust_order', 'play.rate',
    'play.read_ahead_queue_size', 'record.queue_depth',
    'reset_stretch', 'seed', 'law.alpha', 'law.beta', 'law.delta', 'law.lambda_m', 'law.stretch',
    'step_count',
    # In one unit of length, whichever.
    'sensor.gain', 'sensor.offset', 'sensor.rest_length',
    'smooth_periods', 'stretch_bias', 'stretch_gain', 'stretch_noise', 'viscoelastic.ratio',
    'viscoelastic.exponent', 'viscoelastic.stress',
    'actuator.bulk_ratio', 'actuator.mass_factor', 'actuator.transverse_mass_factor',
    'actuator.transverse_mass_exponent', 'modes.frequency_ratio', 'modes.share',
    'modes.damping_ratio', 'modes.ratio_exponent', 'modes.share_exponent',
    # Each number of them has its own unit.
    'identification.values', 'identification.covariance',
    'arrival_tolerance', 'feedback_tolerance', 'stretch_tolerance', 'vibration_tolerance',
    *(f'mismatch.{x.name.partition(".")[2]}' for x in ACTUATOR)}

OWN = {'planner': planning.OWN, 'plant': plant.OWN}

every_node = pytest.mark.parametrize('node', DECLARED)


def is_number(spec: ParameterSpec) -> bool:
    """Return whether a parameter is a number."""
    return isinstance(spec.default, (int, float)) and not isinstance(spec.default, bool)


def in_file(node: str) -> dict[str, Any]:
    """Return the parameters of a file under config/, groups joined by dots."""
    def flat(values: dict[str, Any], prefix: str = '') -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, value in values.items():
            found |= flat(value, f'{prefix}{key}.') if isinstance(value, dict) else {
                prefix + key: value}
        return found

    content = yaml.safe_load((CONFIG / f'{node}.yaml').read_text())
    assert list(content) == ['/**']
    assert list(content['/**']) == ['ros__parameters']
    return flat(content['/**']['ros__parameters'])


def comments(node: str) -> dict[str, str]:
    """Return the comment above each parameter of a file, on one line."""
    found: dict[str, str] = {}
    words: list[str] = []
    for line in (CONFIG / f'{node}.yaml').read_text().splitlines():
        if (text := line.strip()).startswith('#'):
            words.append(text[1:].strip())
        else:
            found[text.partition(':')[0]] = ' '.join(words)
            words = []
    return found


def test_all_nodes_declare_parameters():
    assert set(DECLARED) == set(NODES)


@every_node
def test_names_are_in_snake_case_and_each_is_there_once(node):
    names = [x.name for x in DECLARED[node]]
    assert len(set(names)) == len(names)
    for name in names:
        assert re.fullmatch(r'[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)*', name)


@every_node
def test_each_parameter_is_described_in_a_sentence_and_has_its_unit(node):
    for spec in DECLARED[node]:
        assert re.fullmatch(r'[A-Z].*[^.]\.', spec.description), spec.name
        number = is_number(spec) or spec.items is float
        assert bool(spec.unit) == (number and spec.name not in DIMENSIONLESS), spec.name


@every_node
def test_each_number_has_a_range_and_each_default_passes_its_own_check(node):
    for spec in DECLARED[node]:
        assert not is_number(spec) or spec.minimum is not None, spec.name
        assert not isinstance(spec.default, float) or spec.maximum is not None, spec.name
        spec.check(spec.default)


@every_node
def test_file_has_exactly_the_declared_parameters_with_their_defaults(node):
    expected = {x.name: x.default for x in DECLARED[node]}
    found = in_file(node)
    assert found == expected
    assert list(found) == list(expected)
    assert {x: type(y) for x, y in found.items()} == {
        x: type(y) for x, y in expected.items()}


@every_node
def test_file_says_of_each_parameter_what_it_is_and_in_which_unit(node):
    text = comments(node)
    for spec in DECLARED[node]:
        assert spec.description in text[spec.name]
        assert spec.unit in text[spec.name]


@pytest.mark.parametrize('node', ['planner', 'plant'])
def test_file_says_of_each_parameter_which_values_it_can_have(node):
    text = comments(node)
    for spec in DECLARED[node]:
        if is_number(spec):
            assert f'Range: {spec.range_text()}.' in text[spec.name]
        if spec.choices:
            assert f'One of: {", ".join(spec.choices)}.' in text[spec.name]
        assert ('Can be set while running.' in text[spec.name]) is not spec.read_only


@pytest.mark.ros
@every_node
def test_node_takes_its_file(make_ros, node):
    side = make_ros(cli_args=['--ros-args', '--params-file', str(CONFIG / f'{node}.yaml')])
    overrides = side.node._parameter_overrides
    for spec in DECLARED[node]:
        # A list that is empty in a file is no override at all.
        assert spec.name in overrides or spec.default == []
    assert declare(side.node, DECLARED[node]) == {x.name: x.default for x in DECLARED[node]}


@pytest.mark.ros
@every_node
def test_descriptors_say_what_the_declaration_does(ros, serve, node):
    def made() -> Node:
        described = Node('described')
        declare(described, DECLARED[node])
        return described

    serve(made)
    specs = DECLARED[node]
    answer = ros.call(
        DescribeParameters, 'described/describe_parameters',
        DescribeParameters.Request(names=[x.name for x in specs]))
    for spec, descriptor in zip(specs, answer.descriptors, strict=True):
        assert descriptor.name == spec.name
        assert descriptor.read_only == spec.read_only
        assert descriptor.description == (
            f'{spec.description} [{spec.unit}]' if spec.unit else spec.description)
        assert bool(descriptor.additional_constraints) == bool(spec.choices)
        assert all(x in descriptor.additional_constraints for x in spec.choices)
        assert descriptor.type == type_of(spec).value
        assert not descriptor.dynamic_typing
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        assert len(ranges) == is_number(spec)
        for found in ranges:
            assert spec.minimum in (None, found.from_value)
            assert spec.maximum in (None, found.to_value)
            assert found.from_value < found.to_value


@pytest.mark.ros
@pytest.mark.parametrize(('factory', 'node'), [(PlannerNode, 'planner'), (PlantNode, 'plant')])
def test_node_offers_what_is_declared_and_nothing_else_of_its_own(ros, serve, factory, node):
    serve(factory)
    answer = ros.call(ListParameters, f'{node}/list_parameters')
    of_ros = {'use_sim_time', 'start_type_description_service'}
    assert set(answer.result.names) - of_ros == {x.name for x in DECLARED[node]}


def dumped(ros: Any, node: str) -> str:
    """Return the parameters of a node as ``ros2 param dump`` writes them."""
    names = sorted(ros.call(ListParameters, f'{node}/list_parameters').result.names)
    values = ros.call(
        GetParameters, f'{node}/get_parameters', GetParameters.Request(names=names)).values
    tree: dict[str, Any] = {}
    for name, value in zip(names, values, strict=True):
        place = tree
        *groups, last = name.split('.')
        for group in groups:
            place = place.setdefault(group, {})
            assert isinstance(place, dict), f'{name}: {group} is a value and a group'
        assert last not in place
        place[last] = parameter_value_to_python(value)
    return yaml.dump({f'/{node}': {'ros__parameters': tree}})


@pytest.mark.ros
@pytest.mark.parametrize('joints', [
    (), ('-p', 'joints:=[left, right]', '-p', 'left.actuator.remanence:=0.2')])
def test_dump_of_a_node_is_a_file_that_it_takes_again(ros, serve, make_ros, tmp_path, joints):
    nodes = serve(
        PlannerNode, PlantNode, *joints, '-p', 'law.name:=ogden', '-p', 'law.mu:=[1e4]', '-p',
        'law.alpha:=[2.0]', '-p', 'feedback:=off').nodes
    for node in nodes:
        name = node.get_name()
        file = tmp_path / f'{name}.yaml'
        file.write_text(dumped(ros, name))
        side = make_ros(
            cli_args=['--ros-args', '-r', f'__node:={name}', '--params-file', str(file)])
        again = declare_joints(side.node, DECLARED[name], OWN[name])
        before = node._settings if name == 'planner' else node.values
        assert again.values == {**before.values, 'autostart': True}
        check_names(side.node)
        for spec in DECLARED[name]:
            assert node.get_parameter(spec.name).type_ == type_of(spec)


@pytest.mark.ros
def test_a_section_is_for_the_nodes_that_ros_gives_it_to(make_ros, tmp_path):
    file = tmp_path / 'it.yaml'
    keys = ('/**', '/*', 'planner', '/planner', 'left/planner', '/left/planner', '/*/planner',
            '/**/planner', '/left/*', '/left/**', '/plan', '/right/planner', '/left/plant')
    file.write_text(''.join(
        f'{x}:\n  ros__parameters:\n    it_{i}: 1\n' for i, x in enumerate(keys)))
    for node, space in (('planner', ''), ('planner', '/left')):
        side = make_ros(cli_args=[
            '--ros-args', '-r', f'__node:={node}', '-r', f'__ns:={space or "/"}',
            '--params-file', str(file)])
        given = {x: f'it_{i}' in side.node._parameter_overrides for i, x in enumerate(keys)}
        assert {x: is_for(y, f'{space}/{node}') for x in keys
                for y, _ in sections_of({x: {'ros__parameters': {'it': 1}}})} == given


def test_a_file_without_anything_for_a_node_is_told_with_what_to_write(tmp_path):
    file = tmp_path / 'it.yaml'
    file.write_text('left: {planner: {ros__parameters: {lead_time: 0.1}}}\n'
                    'plant: {ros__parameters: {}}\n', encoding='utf-8')
    words = ['--ros-args', '--params-file', str(file)]
    sentence, = unread_files(words, ['/planner'])
    assert sentence == (
        f'{file} has no parameters for /planner, which keeps its defaults: its sections are '
        '/left/planner, /plant, expected /planner: or /**:')
    assert not [*unread_files(words, ['/left/planner'])]
    sentence, = unread_files(words, ['/right/planner', '/right/plant'])
    assert 'for /right/planner and /right/plant, which keep their defaults: its' in sentence
    # Planner and plant of one process share a file.
    assert not [*unread_files(words, ['/planner', '/plant'])]
    for text in ('/**: {ros__parameters: {lead_time: 0.1}}', ': : :', 'a: &a {b: *a}'):
        file.write_text(text, encoding='utf-8')
        assert not [*unread_files(words, ['/planner'])]
    assert not [*unread_files(['--params-file', str(tmp_path)], ['/planner'])]


@pytest.mark.ros
def test_unquoted_word_that_yaml_reads_as_a_truth_value_is_the_choice(ros, serve, tmp_path):
    file = tmp_path / 'off.yaml'
    file.write_text('/**:\n  ros__parameters:\n    feedback: off\n    viscoelastic.ratio: []\n')
    node, = serve(PlannerNode, '--params-file', str(file)).nodes
    assert node.get_parameter('feedback').value == 'off'
    # As ros2 param set reads its argument.
    for text, expected in (('observe', 'observe'), ('off', 'off'), ('"off"', 'off')):
        parameter = Parameter.from_parameter_msg(
            ParameterMessage(name='feedback', value=get_parameter_value(text)))
        result, = ros.set_parameters('planner', [parameter])
        assert result.successful, result.reason
        assert node.get_parameter('feedback').value == expected
    assert not ros.set_parameters('planner', [Parameter('feedback', value=True)])[0].successful


@pytest.mark.ros
def test_whole_numbers_and_those_that_ros2_param_load_reads_as_words_are_numbers(
        ros, serve, make_ros):
    node, = serve(PlannerNode).nodes
    for given, number in ((1, 1.0), ('5e-05', 5e-5)):
        result, = ros.set_parameters('planner', [Parameter('lateness_tolerance', value=given)])
        assert result.successful, result.reason
        assert node.get_parameter('lateness_tolerance').value == number
    side = make_ros(cli_args=['--ros-args', *(
        x for y in ('actuator.shear_modulus:=30000', 'lead_time:=1', 'slew_limit:=1e3')
        for x in ('-p', y))])
    values = declare(side.node, DECLARED['planner'])
    found = [values[x] for x in ('actuator.shear_modulus', 'lead_time', 'slew_limit')]
    assert found == [30000.0, 1.0, 1000.0]
    assert {type(x) for x in found} == {float}


@pytest.mark.parametrize('text', ['30000', '3e4', '3E+4', '3.0e4', '.3e5', '30_000'])
def test_a_file_of_a_command_has_numbers_as_ros_reads_them(tmp_path, text):
    file = tmp_path / 'it.yaml'
    file.write_text(
        f'/**: {{ros__parameters: {{actuator.shear_modulus: {text}}}}}', encoding='utf-8')
    assert Actuator.from_yaml(file).shear_modulus == 30000.0


@pytest.mark.ros
@pytest.mark.parametrize(('given', 'message'), [
    ('length:=-1.0', 'parameter length is -1.0: expected float, 0 to 10 m'),
    ('length:=11.0', 'parameter length is 11.0: expected float, 0 to 10 m'),
    ('length:=.nan', 'parameter length is nan: expected float, 0 to 10 m'),
    ('length:=11', 'parameter length is 11: expected float, 0 to 10 m'),
    ('length:=long', "parameter length is 'long': expected float, 0 to 10 m"),
    ('count:=-1', 'parameter count is -1: expected int, at least 0'),
    ('count:=1.5', 'parameter count is 1.5: expected int, at least 0'),
    ('mode:=fast', "parameter mode is 'fast': expected one of slow, slower"),
    ('mode:=[slow]', "parameter mode is ['slow']: expected str"),
    ('offset:=.inf', 'parameter offset is inf: expected a finite number'),
    ('names:=[1, 2]', 'parameter names is'),
    ('names:=3', 'parameter names is 3: expected a list of strings')])
def test_bad_value_is_refused_with_what_was_got_and_expected(make_ros, given, message):
    specs = (
        ParameterSpec('length', 1.0, 'Length.', 'm', 0.0, 10.0),
        ParameterSpec('count', 1, 'Count.', '', 0), ParameterSpec('offset', 0.0, 'Offset.'),
        ParameterSpec('mode', 'slow', 'Mode.', choices=('slow', 'slower')),
        ParameterSpec('names', [], 'Names.'))
    side = make_ros(cli_args=['--ros-args', '-p', given])
    with pytest.raises(BadInputError, match=re.escape(message)):
        declare(side.node, specs)


@pytest.mark.ros
@pytest.mark.parametrize(('given', 'expected'), [
    ([], []), (['-p', 'names:=[a, b]'], ['a', 'b']), (['-p', 'names:=a'], ['a']),
    (['-p', 'names:=[]'], [])])
def test_list_of_strings_can_be_empty_or_one(make_ros, given, expected):
    side = make_ros(cli_args=['--ros-args', *given])
    assert declare(side.node, [ParameterSpec('names', [], 'Names.')]) == {'names': expected}


@pytest.mark.ros
@pytest.mark.parametrize(('name', 'suggested'), [
    ('lenght', 'length'), ('left.actuator.remanance', 'left.actuator.remanence'),
    ('third.actuator.density', None), ('shaper', ''), ('play.rate', ''), ('left.shaper', ''),
    ('qos_overrides.x', ''), ('sensor_latency', '')])
def test_unknown_name_is_refused_unless_another_node_has_it(make_ros, name, suggested):
    node = make_ros(cli_args=[
        '--ros-args', '-p', f'{name}:=1.0', '-p', 'joints:=[left, right]']).node
    declare(node, [
        ParameterSpec('length', 1.0, 'Length.'), ParameterSpec('joints', [], 'Joints.'),
        ParameterSpec('left.actuator.remanence', 1.0, 'Remanence.')])
    if suggested == '':
        check_names(node)
        return
    with pytest.raises(BadInputError, match=f'{name} does not exist.* {suggested or ""}'):
        check_names(node)


def test_commands_without_ros_know_the_defaults_of_the_planner_for_how_to_plan():
    defaults = {x.name: x.default for x in DECLARED['planner']}
    for name, (_, *usual) in _PLANNING.items():
        assert defaults[name] in usual, name


def test_names_of_all_nodes_are_known_without_importing_them():
    names = {x.name for specs in DECLARED.values() for x in specs}
    assert {x for x in names if '.' not in x} == PLAIN_NAMES - {SENSOR_LATENCY}
    of_blocks = {x.name.partition('.')[0] for x in (*BLOCK, *MISMATCH, *VISCOELASTIC)}
    assert {x.partition('.')[0] for x in names - PLAIN_NAMES} - of_blocks < FOREIGN


@pytest.mark.parametrize(('minimum', 'maximum', 'text'), [
    (None, None, 'any value'), (0.0, None, 'at least 0 s'), (None, 2.5, 'at most 2.5 s'),
    (0.0, 1e6, '0 to 1e+06 s')])
def test_range_is_worded_with_its_unit(minimum, maximum, text):
    assert ParameterSpec('x', 1.0, 'X.', 's', minimum, maximum).range_text() == text


def test_check_takes_the_range_with_its_ends_and_refuses_what_lies_outside():
    spec = ParameterSpec('x', 1.0, 'X.', '', 0.0, 1.0)
    for value in (0.0, 0.5, 1.0):
        spec.check(value)
    for value in (-0.1, 1.1, math.nan, math.inf):
        with pytest.raises(BadInputError, match='^parameter x is .*: expected'):
            spec.check(value)


def test_actuator_of_the_defaults_is_that_of_the_paper():
    assert actuator_from({x.name: x.default for x in BLOCK}) == paper_actuator()


def test_actuator_has_each_parameter_where_it_belongs():
    values = {x.name: float(k + 1) for k, x in enumerate(ACTUATOR)}
    assert actuator_from(values) == ActuatorParameters(
        shear_modulus=1.0, density=2.0, half_length=3.0, half_thickness=4.0, remanence=5.0,
        chain_limit=6.0, damping_coefficient=7.0)
    assert [x.name for x in ACTUATOR] == [
        f'actuator.{x}' for x in paper_actuator().numbers]


def test_planner_and_plant_describe_the_same_block():
    planner, plant = (
        {x.name: replace(x, read_only=True) for x in DECLARED[node]}
        for node in ('planner', 'plant'))
    common = {*(x.name for x in BLOCK), 'joint', 'initial_stretch', 'slew_limit',
              'coil_time_constant'}
    assert common <= planner.keys() & plant.keys()
    assert all(planner[x] == plant[x] for x in common)


@pytest.mark.ros
def test_the_process_of_a_node_warns_of_a_file_for_others(ros_env, tmp_path):
    file = tmp_path / 'it.yaml'
    file.write_text('/left/planner: {ros__parameters: {lead_time: 0.1}}\n', encoding='utf-8')
    code = (
        'from rclpy.node import Node\n'
        'from hmsa_ros.nodes.managed import run\n'
        "Node.finished = True\nrun(lambda: Node('planner'))\n")
    for space, warnings in (('/', 1), ('/left', 0)):
        done = subprocess.run(
            [sys.executable, '-c', code, '--ros-args', '-r', f'__ns:={space}', '--params-file',
             str(file)], env=ros_env, capture_output=True, text=True, timeout=60, check=True)
        assert done.stderr.count('[WARN]') == warnings, done.stderr
        assert done.stderr.count('has no parameters for /planner, which keeps') == warnings
