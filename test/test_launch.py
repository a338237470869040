"""
Launch files, executed and held against the package they start.

ROS 2's launch is not on the package index: what the files use of it is in `launch_api`, with the
signatures of Jazzy, and the processes they describe are started for real.
"""

from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
import inspect
from pathlib import Path
import re
import sys

from launch_api import (
    DeclareLaunchArgument,
    description,
    evaluate,
    LaunchError,
    MODULES,
    Started,
)
import pytest

ROOT = Path(__file__).resolve().parent.parent
FILES = sorted((ROOT / 'launch').glob('*.launch.py'))
# What must be given.
NEEDED: Mapping[str, Mapping[str, str]] = {
    'demo.launch.py': {}, 'replay.launch.py': {'bag': 'some_bag'}}
COMMON = {'namespace', 'params_file', 'record', 'rviz', 'rviz_config', 'log_level'}
# Declared by rclpy on every node.
EVERY_NODE = {'use_sim_time'}


@pytest.fixture(params=FILES, ids=lambda path: path.name)
def launch_file(request: pytest.FixtureRequest) -> Path:
    """Return each launch file."""
    path: Path = request.param
    return path


@pytest.fixture
def started(launch_file, tmp_path):
    """Return an evaluator of a launch file: what it starts, by executable."""
    def start(**arguments: str) -> dict[str, Started]:
        processes = evaluate(
            launch_file, {**NEEDED[launch_file.name], **arguments}, tmp_path)
        assert len({x.executable for x in processes}) == len(processes)
        return {x.executable: x for x in processes}

    return start


def demo(folder: Path, **arguments: str) -> dict[str, Started]:
    """Return what the demonstration starts, by executable."""
    return {x.executable: x
            for x in evaluate(ROOT / 'launch' / 'demo.launch.py', arguments, folder)}


def arguments_of(path: Path) -> dict[str, DeclareLaunchArgument]:
    """Return the declared arguments by name."""
    return {x.name: x for x in description(path).entities
            if isinstance(x, DeclareLaunchArgument)}


def test_there_is_a_launch_file_for_the_demonstration_and_for_replaying():
    assert [path.name for path in FILES] == ['demo.launch.py', 'replay.launch.py']


@pytest.mark.skipif(
    getattr(find_spec('launch'), 'origin', None) is None,
    reason='the real launch is not on the package index')
def test_signatures_are_those_of_the_installed_launch():
    for name, contents in MODULES.items():
        for ours in contents:
            real = inspect.signature(getattr(import_module(name), ours.__name__).__init__)
            for parameter in inspect.signature(ours.__init__).parameters.values():
                assert real.parameters[parameter.name].kind == parameter.kind


def test_every_argument_is_described_and_those_of_every_launch_file_are_there(launch_file):
    arguments = arguments_of(launch_file)
    assert set(arguments) > COMMON
    for argument in arguments.values():
        assert argument.description
    assert {name for name, x in arguments.items() if x.default_value is None} == set(
        NEEDED[launch_file.name])


def test_every_argument_is_used(launch_file):
    used = re.findall(r"LaunchConfiguration\('(\w+)'\)", launch_file.read_text())
    assert set(used) == set(arguments_of(launch_file))


def test_arguments_that_are_yes_or_no_take_nothing_else(launch_file, started):
    for name, argument in arguments_of(launch_file).items():
        if argument.choices is not None:
            assert argument.choices == ['true', 'false']
            with pytest.raises(LaunchError, match=f"'perhaps' is no valid choice for {name}"):
                started(**{name: 'perhaps'})


def test_bag_to_replay_must_be_given(tmp_path):
    with pytest.raises(LaunchError, match='required launch argument bag'):
        evaluate(ROOT / 'launch' / 'replay.launch.py', {}, tmp_path)


def test_nodes_are_executables_of_this_package_under_their_own_names(started):
    for process in started().values():
        assert process.package == 'hmsa_ros'
        assert f'__node:={process.executable}' in process.arguments
        assert callable(import_module(f'hmsa_ros.nodes.{process.executable}').main)


def test_only_parameters_that_the_nodes_declare_are_set(started):
    for process in started().values():
        module = import_module(f'hmsa_ros.nodes.{process.executable}')
        declared = {spec.name: spec for spec in module.PARAMETERS}
        assert process.parameters
        assert set(process.parameters) <= set(declared) | EVERY_NODE
        for name, value in process.parameters.items():
            if name in declared:
                assert type(value) is type(declared[name].default)
                declared[name].check(value)


def test_every_node_gets_the_parameter_file_the_namespace_and_the_log_level(
        launch_file, started):
    processes = started(namespace='left', params_file='mine.yaml', log_level='warn')
    for process in processes.values():
        assert process.files == ['mine.yaml']
        assert '__ns:=/left' in process.arguments
        index = process.arguments.index('--log-level')
        assert process.arguments[index + 1] == 'warn'


def test_files_named_by_default_are_installed(started):
    processes = started(rviz='true')
    for process in processes.values():
        for file in process.files:
            assert Path(file).is_file()
    rviz = processes['rviz2']
    assert rviz.arguments[:2] == ['-d', str(ROOT / 'config' / 'rviz' / 'hmsa.rviz')]
    assert Path(rviz.arguments[1]).is_file()


def test_rviz_starts_only_when_asked_for_in_the_namespace_of_the_nodes(started):
    assert 'rviz2' not in started()
    assert '__ns:=/left' in started(rviz='true', namespace='left')['rviz2'].arguments


def test_recorder_can_be_left_out_and_told_where_to_write(launch_file, started):
    assert 'recorder' not in started(record='false')
    name = 'bag' if launch_file.name == 'demo.launch.py' else 'record_to'
    # A name that looks like a number stays a name.
    recorder = started(**{name: '2026'})['recorder']
    assert recorder.parameters['storage.uri'] == '2026'


def test_plant_can_be_left_to_a_driver_of_hardware(tmp_path):
    assert set(demo(tmp_path, plant='false')) == {'planner', 'recorder'}


@pytest.mark.parametrize('simulated', [True, False])
def test_under_simulated_time_the_plant_leads_and_the_others_follow(tmp_path, simulated):
    processes = demo(tmp_path, use_sim_time=str(simulated).lower())
    assert processes['plant'].parameters == {
        'use_sim_time': False, 'publish_clock': simulated}
    for follower in ('planner', 'recorder'):
        assert processes[follower].parameters['use_sim_time'] is simulated


def test_in_a_replay_the_player_leads_sends_commands_alone_and_ends_it_all(tmp_path):
    processes = {x.executable: x for x in evaluate(
        ROOT / 'launch' / 'replay.launch.py', {'bag': 'b', 'rate': '0.5'}, tmp_path)}
    player = processes['player']
    assert player.parameters['use_sim_time'] is False
    assert player.parameters['play.rate'] == 0.5
    assert player.parameters['play.topics_to_filter'] == ['flux_density_command']
    assert player.ends_all
    for follower in ('plant', 'recorder'):
        assert processes[follower].parameters['use_sim_time'] is True
        assert not processes[follower].ends_all


@pytest.mark.ros
def test_demonstration_starts_as_described(tmp_path, start, ros, wait_until):
    from rcl_interfaces.srv import GetParameters
    bag = tmp_path / 'run'
    processes = demo(tmp_path, namespace='left', use_sim_time='true', bag=str(bag))
    for executable, process in processes.items():
        start(sys.executable, '-m', 'hmsa_ros', executable, *process.arguments)
    expected = {
        'plant': {'use_sim_time': False, 'publish_clock': True, 'publish_rate': 20000.0},
        'planner': {'use_sim_time': True, 'lead_time': 0.01},
        'recorder': {'use_sim_time': True, 'storage.uri': str(bag)}}
    for node, values in expected.items():
        response = ros.call(
            GetParameters, f'/left/{node}/get_parameters',
            GetParameters.Request(names=list(values)))
        for value, found in zip(values.values(), response.values, strict=True):
            kind = {bool: 'bool_value', float: 'double_value', str: 'string_value'}[type(value)]
            assert getattr(found, kind) == value
    wait_until((bag / 'metadata.yaml').exists, f'a bag in {bag}')
