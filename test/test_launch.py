"""
Launch files, held against the package they start.

ROS 2's launch is not on the package index, so they are read here, not run.
"""

import ast
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FILES = sorted((ROOT / 'launch').glob('*.launch.py'))
NODES = ('planner', 'plant', 'player', 'recorder')
# Declared by rclpy on every node.
EVERY_NODE = {'use_sim_time'}


def calls(path: Path, name: str) -> list[ast.Call]:
    """Return the calls of a function or class in a file."""
    return [
        node for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        and node.func.id == name]


def keyword(call: ast.Call, name: str) -> ast.expr:
    """Return the value of a keyword of a call."""
    return next(entry.value for entry in call.keywords if entry.arg == name)


def constant(expression: ast.expr) -> object:
    """Return the value of a literal."""
    return ast.literal_eval(expression)


@pytest.fixture(params=FILES, ids=lambda path: path.name)
def launch_file(request: pytest.FixtureRequest) -> Path:
    """Return each launch file."""
    path: Path = request.param
    return path


def test_there_is_a_launch_file_for_the_demonstration_and_for_replaying():
    assert [path.name for path in FILES] == ['demo.launch.py', 'replay.launch.py']


def test_launch_file_compiles_and_has_the_function_that_launch_calls(launch_file):
    compile(launch_file.read_text(), launch_file, 'exec')
    functions = [node.name for node in ast.parse(launch_file.read_text()).body
                 if isinstance(node, ast.FunctionDef)]
    assert functions == ['generate_launch_description']


def test_launch_file_starts_executables_of_this_package_under_their_own_names(launch_file):
    nodes = calls(launch_file, 'Node')
    assert len(nodes) == 3
    for node in nodes:
        assert constant(keyword(node, 'package')) == 'hmsa_ros'
        assert constant(keyword(node, 'executable')) in NODES
        assert constant(keyword(node, 'name')) == constant(keyword(node, 'executable'))


def test_launch_file_sets_only_parameters_that_its_nodes_declare(launch_file):
    for node in calls(launch_file, 'Node'):
        module = import_module(f'hmsa_ros.nodes.{constant(keyword(node, "executable"))}')
        declared = {spec.name for spec in module.PARAMETERS} | EVERY_NODE
        parameters = keyword(node, 'parameters')
        assert isinstance(parameters, ast.List)
        dictionaries = [part for part in parameters.elts if isinstance(part, ast.Dict)]
        names = {constant(key) for part in dictionaries for key in part.keys if key is not None}
        assert names
        assert names <= declared


def test_launch_file_declares_each_argument_it_uses_and_describes_it(launch_file):
    declarations = calls(launch_file, 'DeclareLaunchArgument')
    declared = {constant(call.args[0]) for call in declarations}
    used = {constant(call.args[0]) for call in calls(launch_file, 'LaunchConfiguration')}
    assert declared == used
    assert all(constant(keyword(call, 'description')) for call in declarations)


def test_launch_file_names_parameter_files_that_the_package_installs(launch_file):
    paths = calls(launch_file, 'PathJoinSubstitution')
    assert paths
    for call in paths:
        parts = call.args[0]
        assert isinstance(parts, ast.List)
        share, *rest = parts.elts
        assert isinstance(share, ast.Call)
        assert constant(share.args[0]) == 'hmsa_ros'
        path = Path(*(str(constant(part)) for part in rest))
        assert path.parent == Path('config')
        assert (ROOT / path).is_file()


def test_launch_file_gives_every_node_the_parameter_file_and_the_namespace(launch_file):
    for node in calls(launch_file, 'Node'):
        parameters = keyword(node, 'parameters')
        assert isinstance(parameters, ast.List)
        assert ast.unparse(parameters.elts[0]) == 'params_file'
        assert ast.unparse(keyword(node, 'namespace')) == 'namespace'


def test_under_simulated_time_the_plant_of_the_demonstration_leads_and_the_others_follow():
    parameters = {
        constant(keyword(node, 'executable')): ast.unparse(keyword(node, 'parameters'))
        for node in calls(ROOT / 'launch' / 'demo.launch.py', 'Node')}
    assert "'use_sim_time': False" in parameters['plant']
    assert "'publish_clock': use_sim_time" in parameters['plant']
    for follower in ('planner', 'recorder'):
        assert "'use_sim_time': use_sim_time" in parameters[follower]
