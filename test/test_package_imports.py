"""Permitted imports: walls between packages and rooms, no ROS in physics, and quick help."""

import ast
from functools import cache
from pathlib import Path
import re
import subprocess
import sys

from conftest import without_progress
from extras import needs
import pytest

from hmsa import plugins
from hmsa.plugins import registered

ROOT = Path(__file__).resolve().parent.parent
NODES = registered(plugins.NODES)
ROS = ('rclpy', 'rcl_interfaces', 'ament_index_python', 'builtin_interfaces', 'diagnostic_msgs',
       'geometry_msgs', 'rosgraph_msgs', 'rosidl_runtime_py', 'sensor_msgs', 'std_msgs',
       'std_srvs', 'trajectory_msgs')
SLOW = ('rclpy', 'matplotlib', 'scipy', 'numpy')
# Refuses some modules, as if they were not installed, then runs the rest of the arguments.
BLOCKED = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in {blocked!r}:
            raise ModuleNotFoundError('blocked: ' + name, name=name)
        return None

sys.meta_path.insert(0, Blocker())
"""


def run(code: str) -> 'subprocess.CompletedProcess[str]':
    """Run code in a fresh Python at the root of the repository."""
    done = subprocess.run(
        [sys.executable, '-W', 'error', '-c', code], cwd=ROOT, capture_output=True, text=True,
        check=False)
    done.stderr = without_progress(done.stderr)
    return done


def modules(package: str) -> list[str]:
    """Return the names of all modules of a package."""
    folder = ROOT / package.replace('.', '/')
    return [f'{package}.{path.stem}' for path in sorted(folder.glob('*.py'))
            if path.stem not in {'__init__', '__main__'}]


# Each imports those before it, and none after it.
PACKAGES = ('hmsa', 'hmsa_ros', 'hmsa_lab', 'hmsa_studies')
# Rooms that import ROS.
WITH_ROS = {
    'hmsa_ros.nodes', 'hmsa_ros.clients', 'hmsa_lab.nodes', 'hmsa_lab.experiments',
    'hmsa_lab.panel'}


def rooms(package: str) -> list[str]:
    """Return the names of the rooms of a package, the folders with modules."""
    return sorted(f'{package}.{x.parent.name}' for x in (ROOT / package).glob('*/__init__.py'))


WITHOUT_ROS = [
    *PACKAGES, *(x for package in PACKAGES for x in rooms(package) if x not in WITH_ROS)]


def test_physics_runtime_bags_and_studies_import_without_ros():
    names = [name for place in WITHOUT_ROS for name in modules(place)]
    result = run(BLOCKED.format(blocked=ROS) + f"""
import importlib
for name in {names!r}:
    importlib.import_module(name)
# Nodes do not, so the blocking works.
try:
    import hmsa_ros.nodes.ros_entities
except ModuleNotFoundError as error:
    sys.exit(not str(error).startswith('blocked: '))
sys.exit('imported')
""")
    assert (result.returncode, result.stderr) == (0, '')


@cache
def imports(path: Path) -> set[str]:
    """Return the modules, or names in modules, of this project that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {f'{node.module}.{x.name}' for x in node.names}
        elif isinstance(node, ast.Import):
            found |= {x.name for x in node.names}
    return {x for x in found if x.partition('.')[0] in PACKAGES}


def imported(place: str) -> set[str]:
    """Return what the modules of a package or room import of this project."""
    return set().union(*map(imports, (ROOT / place.replace('.', '/')).rglob('*.py')))


@pytest.mark.parametrize('package', PACKAGES)
def test_packages_import_only_those_before_them(package):
    allowed = PACKAGES[:PACKAGES.index(package) + 1]
    assert {x.partition('.')[0] for x in imported(package)} <= {*allowed}


@pytest.mark.parametrize('package', PACKAGES[:3])
def test_table_of_a_package_has_every_room_with_what_it_imports_and_goes_downhill(package):
    text = (ROOT / 'CONTRIBUTING.md').read_text().partition('## Where to add')[0]
    rows = re.findall(rf'^\| `{package}\.(\w+)` \| [^|]+ \| ([^|]+) \|$', text, re.M)
    names = {x.rpartition('.')[2] for x in rooms(package)}
    assert {x for x, _ in rows} == names
    above: set[str] = set()
    for name, said in rows:
        listed = set(re.findall(r'`(\w+)`', said))
        found = {x.split('.')[1] for x in imported(f'{package}.{name}')
                 if x.startswith(f'{package}.')} & names - {name}
        assert not found & listed if said.startswith('all but') else found == listed, name
        assert found <= above, f'{name} imports {found - above}: expected rooms above it'
        above.add(name)


@pytest.mark.slow
@pytest.mark.parametrize('place', WITHOUT_ROS)
def test_each_module_imports_by_itself(place):
    result = run(f"""
import importlib, sys
for name in {modules(place)!r}:
    for loaded in [x for x in sys.modules if x.startswith('hmsa')]:
        del sys.modules[loaded]
    importlib.import_module(name)
""")
    assert (result.returncode, result.stderr) == (0, '')


def test_commands_that_need_ros_say_how_to_get_it_where_there_is_none(tmp_path):
    needs('tornado')
    commands = [
        *([x] for x in NODES),
        ['demo'], ['run', '1.1:0.1'], ['run', '1.1:0.1', '--simulate'], ['send', '1.1:0.1'],
        ['watch', '--once'], ['panel']]
    result = run(BLOCKED.format(blocked=ROS) + f"""
import os
os.chdir({str(tmp_path)!r})
from hmsa.entry import main
for arguments in {commands!r}:
    # Each is a process, but Python starts once.
    if not os.fork():
        sys.exit(main(arguments))
    print(os.waitstatus_to_exitcode(os.wait()[1]), flush=True)
""")
    assert result.returncode == 0
    assert result.stdout.split() == ['1'] * len(commands)
    for arguments, line in zip(commands, result.stderr.splitlines(), strict=True):
        assert re.fullmatch(
            f'hmsa: error: hmsa {arguments[0]} needs ROS 2, Jazzy or Kilted .*/opt/ros/jazzy.*'
            r'pip install "\.\[ros\]"\)', line)
    assert not [*tmp_path.iterdir()]


def test_command_that_needs_no_ros_works_without_it(tmp_path):
    result = run(BLOCKED.format(blocked=ROS) + f"""
import os
os.chdir({str(tmp_path)!r})
from hmsa.cli import main
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation
plant, rows = ActuatorSimulation(paper_actuator()), ['time,stretch,flux_density']
for i in range(300):
    level = 0.01 * (i // 60 % 3)
    plant.command(i * 10**6, level)
    plant.advance(i * 10**6)
    rows.append(f'{{0.001 * i}},{{plant.stretch + 1e-4 * (i * 7919 % 13 - 6)}},{{level}}')
from pathlib import Path
Path('run.csv').write_text('\\n'.join(rows))
for words in (
        ['plan', '1.1:10'], ['identify', 'run.csv', '--free', 'shear_modulus'],
        ['sweep', '--target', '1.1', '--out', 'sweep.csv']):
    assert main(words) == 0, words
# As far as the file, which is no bag.
assert main(['report', 'run.csv']) == 2
""")
    assert result.returncode == 0, result.stderr
    assert re.search(r'\nhmsa: error: run.csv is a table: expected a bag;.*\n', result.stderr)


def test_nodes_start_without_scipy_which_takes_longer_to_load_than_all_else():
    needs('rclpy')
    result = run(BLOCKED.format(blocked=('scipy',)) + ''.join(
        f'import {x.module}\n' for x in NODES.values())
        # What `hmsa run` evaluates its bag with.
        + 'import hmsa.report.comparison, hmsa.report.evaluation')
    assert (result.returncode, result.stderr) == (0, '')


def test_a_planner_without_feedback_imports_none_of_it():
    needs('rclpy')
    result = run(BLOCKED.format(blocked=('hmsa_lab',)) + """
from hmsa.model.actuators import Setup
from hmsa.model.parameters import paper_actuator
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import Settings, StretchRequest
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
import hmsa_ros.nodes.planner
group = PlannerGroup({'a': Planner(paper_actuator(), Options())})
loop = Loop(group, Settings(takeover_timeout=0), SimulatedDevice(
    [SimulatedJoint(Setup(paper_actuator()))], period=10**6, time=10**9))
assert loop.runtime.request(StretchRequest('a', 1.2)).code == 'accepted'
loop.run(11 * 10**8)
assert abs(loop.device.stretch[0] - 1.2) < 1e-6
""")
    assert (result.returncode, result.stderr) == (0, '')


def test_a_plan_without_a_file_imports_no_reader_of_files():
    result = run(BLOCKED.format(blocked=('scipy', 'mcap', 'yaml')) + """
from hmsa.cli import main
sys.exit(main(['plan', '1.1:10']))
""")
    assert (result.returncode, result.stderr) == (0, '')


@pytest.mark.parametrize('arguments', [['--help'], ['--version'], ['demo', '--help']])
def test_help_imports_nothing_slow(arguments):
    result = run(BLOCKED.format(blocked=SLOW) + f"""
sys.argv[1:] = {arguments!r}
from hmsa.cli import main
sys.exit(main())
""")
    assert (result.returncode, result.stderr) == (0, '')
    assert 'hmsa' in result.stdout


def test_every_command_of_the_interface_answers_help():
    commands = (
        'demo', 'plan', 'send', 'run', 'planner', 'plant', 'recorder', 'player', 'bag', 'figures',
        'report', 'robustness', 'sweep', 'identify', 'excite', 'panel')
    result = run(f"""
import os, sys
from hmsa.cli import main
for command in {commands!r}:
    if not os.fork():
        sys.argv[1:] = [command, '--help']
        sys.exit(main())
    print('status', os.waitstatus_to_exitcode(os.wait()[1]), flush=True)
""")
    assert (result.returncode, result.stderr) == (0, '')
    *texts, end = result.stdout.split('status 0\n')
    assert end == ''
    for command, text in zip(commands, texts, strict=True):
        assert f'hmsa {command}' in text


def test_module_and_console_script_are_the_same_command():
    result = subprocess.run(
        [sys.executable, '-m', 'hmsa_ros', 'nonsense'], cwd=ROOT, capture_output=True,
        text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.count('\n') == 1
    assert 'nonsense' in result.stderr
    assert 'Traceback' not in result.stderr
