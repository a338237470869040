"""
The launch files: the processes that they start, and a run of these processes.

ROS 2's launch is not on the package index. The decisions of the files are in a module of the
package; if launch is installed, it also runs the files.
"""

from importlib.util import find_spec
from pathlib import Path
import re
import signal
import sys

import pytest

from hmsa.bag.reader import BagReader
from hmsa.errors import BadInputError
from hmsa.plugins import NODES, registered
from hmsa.runs.verify import verify
from hmsa_ros.clients.launching import DEMO, failure, REPLAY

ROOT = Path(__file__).resolve().parent.parent
FILES = {'demo': (DEMO, {}), 'replay': (REPLAY, {'bag': 'some_bag'})}
COMMON = {'namespace', 'params_file', 'record', 'rviz', 'rviz_config', 'log_level'}
# Declared by rclpy on every node.
EVERY_NODE = {'use_sim_time'}
SECONDS = 120.0
NOTHING = 1e-9
# Not the folder launch/ beside this one, which has no file __init__.py.
REAL = getattr(find_spec('launch'), 'origin', None) is not None


@pytest.fixture(params=FILES)
def started(request):
    """Return the processes of each launch file for some arguments."""
    file, needed = FILES[request.param]
    return lambda **given: file.evaluate({**needed, **given}, ROOT)


def nodes(started):
    """Return the processes by name."""
    return {x.name: x for x in started.nodes}


def demo(**given):
    return nodes(DEMO.evaluate(given, ROOT))


@pytest.mark.parametrize('name', FILES)
def test_there_is_a_file_for_each_and_every_argument_is_described(name):
    file, needed = FILES[name]
    text = (ROOT / 'launch' / f'{name}.launch.py').read_text()
    assert f'description({name.upper()})' in text
    assert {x.name for x in file.arguments} > COMMON
    assert all(x.description for x in file.arguments)
    assert {x.name for x in file.arguments if x.default is None} == set(needed)


def test_what_cannot_be_is_refused(started):
    with pytest.raises(BadInputError, match="record is 'perhaps': expected one of true, false"):
        started(record='perhaps')
    with pytest.raises(BadInputError, match="params_file is '/nowhere': expected an existing"):
        started(params_file='/nowhere')


def test_bag_to_replay_must_be_given_and_the_rate_be_a_number():
    with pytest.raises(BadInputError, match='launch argument bag is missing'):
        REPLAY.evaluate({}, ROOT)
    with pytest.raises(BadInputError, match="rate is 'fast': expected a number"):
        REPLAY.evaluate({'bag': 'x', 'rate': 'fast'}, ROOT)


def test_only_parameters_that_the_nodes_declare_are_set(started):
    for process in started().nodes:
        module = registered(NODES)[process.name].load()
        declared = {spec.name: spec for spec in module.PARAMETERS}
        assert set(process.parameters) <= set(declared) | EVERY_NODE
        for name, value in process.parameters.items():
            if name in declared:
                assert type(value) is type(declared[name].default)
                declared[name].check(value)


def test_every_node_gets_the_parameter_file_the_namespace_and_the_log_level(started, tmp_path):
    file = tmp_path / 'mine.yaml'
    file.touch()
    for process in started(
            namespace='left', params_file=str(file), log_level='warn').nodes:
        words = process.ros_arguments()
        assert words[:6] == [
            '-r', '__ns:=/left', '--log-level', 'warn', '--params-file', str(file)]


def test_rviz_starts_only_when_asked_for_in_the_namespace_of_the_nodes(started):
    assert started().rviz is None
    rviz = started(rviz='true', namespace='left').rviz
    assert rviz.options == ('-d', str(ROOT / 'config' / 'rviz' / 'hmsa.rviz'))
    assert Path(rviz.options[1]).is_file()
    assert '__ns:=/left' in rviz.ros_arguments()


def test_recorder_can_be_left_out_and_a_bag_be_called_like_a_number(started):
    assert 'recorder' not in nodes(started(record='false'))
    assert "-p storage.uri:='2026'" in ' '.join(demo(bag='2026')['recorder'].ros_arguments())


def test_time_is_simulated_if_the_plant_is():
    followers = {name: x.parameters['use_sim_time'] for name, x in demo().items()}
    assert followers == {'recorder': True, 'plant': False, 'planner': True}
    assert demo()['plant'].parameters['publish_clock']
    assert Path(demo()['plant'].params_file) == ROOT / 'config' / 'demo.yaml'
    driver = demo(plant='false')
    assert {name: x.parameters['use_sim_time'] for name, x in driver.items()} == {
        'recorder': False, 'planner': False}
    # 20,000 samples a second are for slow motion.
    real = demo(hardware='my_lab:Coil')
    assert set(real) == {'planner', 'driver', 'recorder'}
    assert real['driver'].parameters == {'hardware': 'my_lab:Coil'}
    assert not real['planner'].parameters['use_sim_time']
    wall = demo(use_sim_time='false')['plant']
    assert not wall.parameters['publish_clock']
    assert not wall.params_file


def test_slow_motion_is_said_with_the_time_that_a_sequence_takes(tmp_path):
    note = DEMO.evaluate({}, ROOT).note
    assert note == (
        f'simulated time runs at 0.0125 of real time (real_time_factor in '
        f'{ROOT / "config" / "demo.yaml"}): 1 s of a sequence takes 80 s')
    for real in ({'hardware': 'my_lab:Coil'}, {'plant': 'false'}, {'use_sim_time': 'false'}):
        assert DEMO.evaluate(real, ROOT).note == ''
    own = tmp_path / 'own.yaml'
    for text, said in (
            ('/**:\n  ros__parameters:\n    real_time_factor: 0.5\n', 'a sequence takes 2 s'),
            ('plant:\n  ros__parameters:\n    real_time_factor: 1.0\n', ''),
            ('planner:\n  ros__parameters:\n    real_time_factor: 0.5\n', ''), ('[', '')):
        own.write_text(text)
        found = DEMO.evaluate({'params_file': str(own)}, ROOT).note
        assert said in found
        assert bool(said) == bool(found)


@pytest.mark.ros
def test_who_sends_to_a_slow_simulation_learns_how_long_it_takes(start):
    started = DEMO.evaluate({'record': 'false'}, ROOT)
    for node in started.nodes:
        start(*node.command())
    send = start.hmsa('send', '1.1:0.05', '1.0:0.05', '--timeout', str(SECONDS))
    assert send.wait(SECONDS) == 0, send.output
    factor, seconds = re.search(
        r'simulated time runs at (\S+) of real time: the sequence of 0.1 s takes about (\S+) s',
        send.stderr).groups()
    # A busy machine is slower still.
    assert 0.0 < float(factor) <= 0.014
    assert float(seconds) == pytest.approx(0.1 / float(factor), rel=0.05)


def test_a_process_that_fails_ends_everything_and_one_that_is_ended_does_not_fail():
    assert not failure('recorder', 0, ending=False)
    assert not failure('recorder', -signal.SIGINT, ending=True)
    assert failure('recorder', -signal.SIGINT, ending=False)
    assert failure('recorder', 1, ending=True).startswith('the recorder ended with status 1')
    assert failure('recorder', -signal.SIGKILL, ending=True)


class ByHand:
    """Starts the processes of a launch file, and ends them."""

    def __init__(self, start):
        self._start = start

    def run(self, name, **given):
        started = FILES[name][0].evaluate(given, ROOT)
        self._processes = {x.name: self._start(*x.command()) for x in started.nodes}
        self._last = started.last

    def wait(self):
        assert self._processes[self._last].wait(SECONDS) == 0
        self.end()

    def end(self):
        for process in self._processes.values():
            if process.alive():
                assert process.stop(signal.SIGINT, SECONDS) == 0, process.output


class ByLaunch:
    """Runs the files with ROS 2's launch."""

    def __init__(self, start):
        self._start = start

    def run(self, name, **given):
        self._process = self._start(
            sys.executable, '-c', 'import sys; from ros2cli.cli import main; sys.exit(main())',
            'launch', str(ROOT / 'launch' / f'{name}.launch.py'),
            *(f'{key}:={value}' for key, value in given.items()))

    def wait(self, status=0):
        assert self._process.wait(SECONDS) == status, self._process.output
        return self._process.output

    def end(self):
        assert self._process.stop(signal.SIGINT, SECONDS) == 0, self._process.output


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.parametrize('way', [ByHand, *([ByLaunch] if REAL else [])])
def test_a_demonstration_is_recorded_and_its_replay_is_the_same(start, tmp_path, way):
    bags = [tmp_path / 'first', tmp_path / 'second']
    launch = way(start)
    launch.run('demo', namespace='left', bag=str(bags[0]))
    send = start.hmsa('send', '1.1:0.05', '0.9:0.05', '--wait', '--recorded', '--namespace',
                      'left', '--timeout', str(SECONDS))
    assert send.wait(SECONDS) == 0, send.output
    launch.end()
    # In slow motion: a busy machine may hold a command up for longer than it came ahead.
    launch.run(
        'replay', namespace='left', bag=str(bags[0]), record_to=str(bags[1]), rate='0.02')
    launch.wait()
    assert list(BagReader(bags[0]).messages(['/left/planner/joint_trajectory']))
    first, second = (verify(bag)[0] for bag in bags)
    assert second.command_count == first.command_count > 3
    assert second.largest_difference < NOTHING


if REAL:
    @pytest.mark.ros
    @pytest.mark.parametrize(('given', 'expected'), [
        ({'params_file': '/nowhere'}, 'expected an existing file'),
        ({'bag': '{there}'}, 'the recorder ended with status'),
        ({'rviz': 'true', 'rviz_config': str(ROOT / 'nowhere')}, 'expected an existing file'),
    ])
    def test_launch_fails_when_a_node_does(start, tmp_path, given, expected):
        (tmp_path / 'run').mkdir()
        launch = ByLaunch(start)
        launch.run('demo', **{
            key: value.format(there=tmp_path / 'run') for key, value in given.items()})
        assert expected in launch.wait(1)


def test_page_has_the_arguments_of_each_file():
    page = (ROOT / 'docs' / 'guides' / 'viewers.md').read_text()
    table = page.partition('| argument | of |')[2].partition('\n\n')[0]
    rows = re.findall(r'^\| ([^|]+) \| (both|demo|replay) \|', table, re.M)
    for file, name in ((DEMO, 'demo'), (REPLAY, 'replay')):
        found = [x for cell, of in rows if of in ('both', name)
                 for x in re.findall(r'`(\w+)`', cell)]
        assert sorted(found) == sorted(x.name for x in file.arguments)
