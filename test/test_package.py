"""Consistency of the package's descriptions: setup.py, package.xml, constraints and files."""

import ast
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
import json
from pathlib import Path
import re
import runpy
import subprocess
import sys
from typing import Any
from xml.etree import ElementTree

from extras import EXTRAS
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
import pytest
import yaml

import hmsa

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ('hmsa', 'hmsa_ros', 'hmsa_lab', 'hmsa_studies')
SOURCES = [x for y in PACKAGES for x in (ROOT / y).rglob('*.py')]
PYTHONS = ('3.10', '3.11', '3.12', '3.13', '3.14')
DISTROS = ('jazzy', 'kilted')
# Where the key of a requirement is not python3- and its name in lower case.
# mcap, lz4 and zstandard come along with mcap-ros2-support.
KEYS = {
    'lz4': 'mcap-ros2-support', 'mcap': 'mcap-ros2-support',
    'mcap-ros2-support': 'mcap-ros2-support', 'zstandard': 'mcap-ros2-support',
    'PyYAML': 'python3-yaml', 'pyserial': 'python3-serial', 'rosbags': 'python3-rosbags-pip'}
# Requirements whose module has another name.
MODULES = {'PyYAML': 'yaml', 'mcap-ros2-support': 'mcap_ros2'}
# What only a part of the package needs.
OPTIONAL = {'dask', 'distributed', 'pyarrow', 'tornado'}
# What the package asks for in one line where it is missing: the user's choice.
BESIDE = {'pandas', 'xarray'}
# Needed to install, or to be launched, not to be imported.
NOT_IMPORTED = {'setuptools', 'ros2launch'}
# What setup() was called with, without building anything.
READ_SETUP = """
import json, setuptools
from distutils.core import run_setup
given = run_setup('setup.py', stop_after='init')
print(json.dumps({
    'name': given.get_name(), 'version': given.get_version(), 'license': given.get_license(),
    'description': given.get_description(), 'email': given.get_maintainer_email(),
    'maintainer': given.get_maintainer(), 'packages': given.packages,
    'package_data': given.package_data, 'data_files': given.data_files,
    'install_requires': given.install_requires,
    'extras_require': given.extras_require, 'scripts': given.entry_points['console_scripts'],
    'classifiers': given.get_classifiers(), 'python_requires': str(given.python_requires)}))
"""


@pytest.fixture(scope='module')
def setup() -> dict[str, Any]:
    """Return the arguments of setup.py."""
    output = subprocess.run(
        [sys.executable, '-c', READ_SETUP], cwd=ROOT, check=True, capture_output=True,
        text=True).stdout
    given: dict[str, Any] = json.loads(output.splitlines()[-1])
    return given


@pytest.fixture(scope='module')
def manifest() -> ElementTree.Element:
    """Return package.xml."""
    return ElementTree.parse(ROOT / 'package.xml').getroot()


def texts(manifest: ElementTree.Element, tag: str) -> list[str]:
    """Return the texts of all elements of a kind, on one line each."""
    return [' '.join((element.text or '').split()) for element in manifest.findall(tag)]


def names(requirements: list[str]) -> set[str]:
    """Return the names in a list of requirements."""
    return {Requirement(requirement).name for requirement in requirements}


def keys(requirements: list[str]) -> set[str]:
    """Return the rosdep keys of a list of requirements."""
    return {KEYS.get(name, f'python3-{name.lower()}')
            for name in names(requirements)}


def imported() -> set[str]:
    """Return the top-level modules that the package imports, without the standard library."""
    modules = set()
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                modules |= {alias.name.partition('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                modules.add(node.module.partition('.')[0])
    return modules - set(sys.stdlib_module_names) - {*PACKAGES}


def test_package_xml_and_setup_py_describe_the_same_package(setup, manifest):
    assert [setup['name']] == texts(manifest, 'name')
    assert [setup['version']] == texts(manifest, 'version')
    assert [setup['description']] == texts(manifest, 'description')
    assert [setup['license']] == texts(manifest, 'license')
    assert [setup['maintainer']] == texts(manifest, 'maintainer')
    assert [setup['email']] == [
        element.get('email') for element in manifest.findall('maintainer')]


def test_version_is_the_same_in_the_package_the_citation_and_the_changelog(setup):
    assert setup['version'] == hmsa.__version__
    released = re.findall(
        r'^(\d+\.\d+\.\d+) \((\d{4}-\d\d-\d\d)\)\n-+$', (ROOT / 'CHANGELOG.rst').read_text(), re.M)
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text(encoding='utf-8'))
    assert (citation['version'], str(citation['date-released'])) == released[0]
    assert released[0][0] == hmsa.__version__


def test_licence_is_the_one_in_the_licence_file(setup, manifest):
    assert setup['license'] == 'Apache-2.0'
    licence = manifest.find('license')
    assert licence is not None
    text = (ROOT / licence.attrib['file']).read_text()
    assert 'Apache License\n                           Version 2.0' in text
    assert 'END OF TERMS AND CONDITIONS' in text


def test_package_xml_asks_for_ament_python_in_format_3(manifest):
    assert manifest.get('format') == '3'
    assert texts(manifest, 'export/build_type') == ['ament_python']
    # rosdep has no key for a compiler, and build farms always have one.
    assert texts(manifest, 'build_depend') == ['python3-dev']


def test_package_xml_and_setup_py_require_the_same_python_packages(setup, manifest):
    depends = {key for key in texts(manifest, 'exec_depend')
               if key.startswith('python3-') or key in KEYS.values()}
    assert depends == keys(setup['install_requires'])
    assert set(texts(manifest, 'test_depend')) == keys(setup['extras_require']['test'])


def test_everything_imported_is_required_and_everything_required_is_imported(setup, manifest):
    python = {MODULES.get(name, name.lower()) for name in names(setup['install_requires'])}
    ros = {key for key in texts(manifest, 'exec_depend')
           if not key.startswith('python3-') and key not in KEYS.values()}
    extras = setup['extras_require']
    assert names(extras['sweep']) | names(extras['panel']) == OPTIONAL
    # Earlier names still work.
    assert extras['studies'] == extras['cluster'] == extras['sweep']
    assert imported() == (python | ros | OPTIONAL | BESIDE) - NOT_IMPORTED


def test_rclpy_and_messages_come_only_with_the_extra_for_machines_without_ros(setup):
    assert not any('ros-' in name for name in names(setup['install_requires']))
    for extra, distro in (('ros', 'jazzy'), *((x, x) for x in DISTROS)):
        assert names(setup['extras_require'][extra]) == {
            f'ros-{distro}-rclpy', f'ros-{distro}-common-interfaces'}


def test_whatever_is_private_in_rclpy_is_listed():
    trees = [ast.parse(x.read_text(encoding='utf-8'))
             for y in ('hmsa_ros', 'hmsa_lab') for x in (ROOT / y).rglob('*.py')]
    nodes = [x for tree in trees for x in ast.walk(tree)]
    own = {x.name for x in nodes if isinstance(x, (ast.FunctionDef, ast.ClassDef))} | {
        x.attr for x in nodes if isinstance(x, ast.Attribute) and isinstance(x.ctx, ast.Store)
        and isinstance(x.value, ast.Name)} | {
        x.id for x in nodes if isinstance(x, ast.Name) and isinstance(x.ctx, ast.Store)}
    used = {x.attr for x in nodes if isinstance(x, ast.Attribute)
            and re.fullmatch('_[a-z]\\w+', x.attr)} - own
    text = (ROOT / 'CONTRIBUTING.md').read_text(encoding='utf-8')
    listed = set(re.findall(r'`(_\w+)`', text.partition('### What is private in rclpy')[2]))
    # Fields of other libraries.
    assert used - {'_asdict', '_exit'} <= listed


def test_every_module_of_the_package_is_installed(setup):
    found = {'.'.join(path.parent.relative_to(ROOT).parts) for path in SOURCES}
    assert set(setup['packages']) == found


def test_every_other_file_of_the_packages_is_installed(setup):
    for package in PACKAGES:
        folder = ROOT / package
        found = {path for path in folder.rglob('*')
                 if path.is_file() and path.suffix not in ('.py', '.pyc', '.so', '.c', '.cpp')
                 and '__pycache__' not in path.parts}
        patterns = setup['package_data'].get(package, ())
        assert all([*folder.glob(x)] for x in patterns)
        assert {path for x in patterns for path in folder.glob(x)} == found


def test_every_launch_and_parameter_file_is_installed_where_ros_looks(setup):
    installed = {(target, file) for target, files in setup['data_files'] for file in files}
    expected = {('share/ament_index/resource_index/packages', 'resource/hmsa_ros'),
                ('share/hmsa_ros', 'package.xml')}
    for kind in ('launch', 'config'):
        files = [path.relative_to(ROOT) for path in (ROOT / kind).rglob('*')
                 if path.is_file() and '__pycache__' not in path.parts]
        assert files
        expected |= {(f'share/hmsa_ros/{path.parent}', str(path)) for path in files}
    assert installed == expected
    assert all((ROOT / file).is_file() for _, file in installed)


def test_every_script_names_a_function_that_exists(setup):
    scripts = dict(script.split(' = ') for script in setup['scripts'])
    assert set(scripts) == {
        'hmsa', 'planner', 'plant', 'driver', 'recorder', 'player', 'sense', 'controller'}
    for target in scripts.values():
        module, function = target.split(':')
        assert callable(getattr(import_module(module), function))


def test_setup_cfg_puts_scripts_where_ros2_run_looks():
    assert re.findall(r'^\w+=(.*)$', (ROOT / 'setup.cfg').read_text(), re.M) == [
        '$base/lib/hmsa_ros', '$base/lib/hmsa_ros']


def constraints_of(distro):
    end = '' if distro == 'jazzy' else f'-{distro}'
    return (ROOT / f'constraints{end}.txt').read_text(encoding='utf-8')


@pytest.mark.parametrize('distro', DISTROS)
@pytest.mark.parametrize('python', PYTHONS)
def test_constraints_pin_every_requirement_once_for_each_python(setup, python, distro):
    pins: dict[str, str] = {}
    for line in constraints_of(distro).splitlines():
        if line.startswith('#'):
            continue
        pin = Requirement(line)
        if pin.marker is None or pin.marker.evaluate({'python_version': python}):
            assert pin.name not in pins
            pins[pin.name] = str(pin.specifier)
    requirements = [Requirement(text) for text in sum(
        setup['extras_require'].values(), setup['install_requires'])]
    for requirement in requirements:
        if requirement.name != 'setuptools' and not requirement.name.startswith(
                tuple(f'ros-{x}-' for x in DISTROS if x != distro)):
            version = pins[requirement.name.lower()].removeprefix('==')
            assert requirement.specifier.contains(version)


def test_supported_pythons_are_the_ones_that_the_constraints_were_made_for(setup):
    supported = SpecifierSet(setup['python_requires'])
    assert [f'3.{minor}' for minor in range(20) if f'3.{minor}' in supported] == list(PYTHONS)
    assert re.findall(r'Python :: ([\d.]+)', ' '.join(setup['classifiers'])) == list(PYTHONS)
    for distro in DISTROS:
        header = constraints_of(distro).partition('\n')[0]
        assert f'for Python {PYTHONS[0]} to {PYTHONS[-1]}' in header


def test_every_file_that_names_the_supported_pythons_names_the_same():
    span = f'Python {PYTHONS[0]} to {PYTHONS[-1]}'
    for name in ('README.md', 'CONTRIBUTING.md', 'docs/tutorials/first-run.md', 'Makefile'):
        spans = re.findall(r'Python 3\.\d+ to 3\.\d+', (ROOT / name).read_text(encoding='utf-8'))
        assert set(spans) == {span}, name
    commands = ' '.join(f'python{x}' for x in PYTHONS)
    for name in ('Makefile', 'constraints.txt'):
        assert commands in (ROOT / name).read_text(encoding='utf-8'), name
    low, high = (x.replace('.', ', ') for x in (PYTHONS[0], PYTHONS[-1]))
    assert f'({low}) <= sys.version_info[:2] <= ({high})' in (ROOT / 'Makefile').read_text()
    workflow = yaml.safe_load((ROOT / '.github' / 'workflows' / 'ci.yml').read_text())
    matrix = workflow['jobs']['gate']['strategy']['matrix']
    assert matrix['python'] == list(PYTHONS)


def test_an_installation_says_what_it_does_and_ends_as_its_command_does(
        tmp_path, capfd, wait_until):
    narrate = runpy.run_path(str(ROOT / 'scripts' / 'narrate.py'))['main']
    goes_on, said = tmp_path / 'goes_on', []
    command = (
        'import pathlib, sys, time\n'
        "print('Collecting numpy', flush=True)\n"
        f'while not pathlib.Path({str(goes_on)!r}).exists(): time.sleep(0.01)\n'
        'sys.exit(3)')
    with ThreadPoolExecutor() as threads:
        ended = threads.submit(narrate, [sys.executable, '-c', command], 0.05)

        def heard():
            said.extend(capfd.readouterr().out.splitlines())
            return any(re.fullmatch(r'  Collecting numpy, \d+ s', x) for x in said)

        wait_until(heard)
        goes_on.touch()
        assert ended.result() == 3
    assert 'Collecting numpy\n' in capfd.readouterr().err


def test_the_workflow_runs_the_gate_and_the_gate_runs_what_the_readme_types():
    workflow = yaml.safe_load((ROOT / '.github' / 'workflows' / 'ci.yml').read_text())
    assert workflow['jobs']['gate']['steps'][-1]['run'] == '.ci/run'
    typed = re.findall(r'^(make \w+) +#', (ROOT / 'README.md').read_text(encoding='utf-8'), re.M)
    lines = (ROOT / '.ci' / 'run').read_text().splitlines()
    assert typed == ['make demo', 'make test']
    assert [x for x in lines if x in typed] == typed
    # Last, so that its closing lines end the output.
    assert lines[-1] == 'make test'


def test_a_skipped_test_names_the_extra_that_brings_what_it_needs(setup):
    for module, extra in EXTRAS.items():
        wanted = 'ros-jazzy-rclpy' if module == 'rclpy' else module
        assert wanted in names(setup['extras_require'][extra])
        assert wanted not in names(setup['extras_require']['test'])


@pytest.mark.parametrize(
    'path', sorted((ROOT / 'config').glob('*.yaml')), ids=lambda path: path.name)
def test_parameter_file_is_well_formed(path):
    document = yaml.safe_load(path.read_text(encoding='utf-8'))
    assert isinstance(document, dict)
    for pattern, entry in document.items():
        assert re.fullmatch(r'(/\*\*/?)?\w*', pattern)
        assert set(entry) == {'ros__parameters'}
        assert isinstance(entry['ros__parameters'], dict)
