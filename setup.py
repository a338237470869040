"""Build of the package, by pip and by colcon alike."""

from glob import glob
import os
import re
import shutil

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

PACKAGE = 'hmsa_ros'
# colcon build --symlink-install runs a link to this file.
HERE = os.path.dirname(os.path.realpath(__file__))


def read(*parts):
    """Return the text of a file of this repository."""
    with open(os.path.join(HERE, *parts), encoding='utf-8') as file:
        return file.read()


# Read, not imported: the package need not be importable where it is built.
VERSION = re.search(r"^__version__ = '([^']+)'$", read('hmsa', '__init__.py'), re.M).group(1)
README = 'README.md' if os.path.exists(os.path.join(HERE, 'README.md')) else None

INSTALL_REQUIRES = [
    'setuptools',
    'PyYAML>=6.0',
    'jinja2>=3.0',
    'lz4>=4.0',
    'matplotlib>=3.6',
    'mcap>=1.6',
    'mcap-ros2-support>=0.5',
    'numpy>=1.26',
    'rich>=13.0',
    'rosbags>=0.11',
    'scipy>=1.11',
    'zstandard>=0.18',
]

# Sweeps and studies in chunks, on the cores of this machine or on a cluster, and Parquet.
SWEEP = [
    'dask>=2024.1',
    'distributed>=2024.1',
    'pyarrow>=14.0',
]


def ros(distro):
    """Return what a ROS 2 distribution brings: rclpy and the messages."""
    return [f'ros-{distro}-common-interfaces', f'ros-{distro}-rclpy[fastrtps]']


# rclpy and the messages are no plain requirement: where ROS is installed they are there
# already, and a second copy from wheels would shadow them. An environment holds one distribution.
EXTRAS_REQUIRE = {
    'ros': ros('jazzy'),
    'jazzy': ros('jazzy'),
    'kilted': ros('kilted'),
    'test': [
        'hypothesis>=6.98',
        'pyserial>=3.5',
        # From 9.2 on, groups of pytest-xdist 3.8 are lost: it writes to a private attribute.
        'pytest>=7.4,<9.2',
        'pytest-timeout>=2.2',
        'pytest-xdist>=3.7',
        'sympy>=1.12',
    ],
    # Style and types, which no test depends on.
    'lint': [
        'mypy>=1.9',
        'ruff>=0.5',
        'types-PyYAML',
    ],
    'sweep': SWEEP,
    # Earlier names of the same.
    'studies': SWEEP,
    'cluster': SWEEP,
    # The page that hmsa panel serves.
    'panel': [
        'tornado>=6.2',
    ],
    # DataFrames, Datasets, and quantities with units in Python.
    'pandas': [
        'pandas>=1.5',
    ],
    'xarray': [
        'xarray>=2023.1',
    ],
    'units': [
        'pint>=0.20',
    ],
    # Boards on a serial port.
    'serial': [
        'pyserial>=3.5',
    ],
    'bench': [
        'casadi>=3.6',
    ],
    'release': [
        'build>=1.0',
    ],
    'docs': [
        'furo>=2024.8',
        'myst-parser>=4.0',
        'numpydoc>=1.6',
        'sphinx>=8.1',
    ],
}

# The same bits on every x86-64: no instructions beyond the baseline, nothing fused or reordered.
COMPILED = [
    '-std=c++17', '-O2', '-ftree-vectorize', '-ffp-contract=off', '-fno-math-errno',
    '-fno-trapping-math', '-fvisibility=hidden', '-fno-exceptions', '-fno-rtti', '-Wno-psabi',
    '-g0']
MOTION, DERIVATIVES, RINGING = (Extension(
    name, [source], include_dirs=['hmsa/motion'],
    depends=sorted(glob('hmsa/motion/**/*.hpp', recursive=True)), language='c++',
    extra_compile_args=COMPILED) for name, source in (
        ('hmsa.motion._motion', 'hmsa/motion/motion.cpp'),
        ('hmsa.motion._derivatives', 'hmsa/motion/derivatives.cpp'),
        ('hmsa.judge._ringing', 'hmsa/judge/_ringing.cpp')))
BOARD = Extension(
    'hmsa_lab.bench._board', ['hmsa_lab/bench/_board.cpp'],
    include_dirs=['hmsa_lab/bench'], depends=['hmsa_lab/bench/hmsa_board/board.hpp'],
    language='c++', extra_compile_args=[
        '-std=c++11', '-O2', '-fno-exceptions', '-fno-rtti', '-g0'])
DEADLINE = Extension('hmsa._deadline', ['hmsa/_deadline.c'], extra_compile_args=['-g0'])


class BuildMotion(build_ext):
    """Compiles from wherever setup.py runs, and says what is missing where it cannot."""

    def finalize_options(self):
        """Compile motion and derivatives at the same time, where there is more than one core."""
        super().finalize_options()
        self.parallel = True

    def build_extension(self, ext):
        """Build with absolute paths: colcon links to this file from a folder without sources."""
        ext.sources = [os.path.join(HERE, x) for x in ext.sources]
        ext.include_dirs = [os.path.join(HERE, x) for x in ext.include_dirs]
        command = (getattr(self.compiler, 'compiler_so_cxx', None) or self.compiler.compiler_so)[0]
        if shutil.which(command) is None or shutil.which('c++') is None:
            raise SystemExit(
                'hmsa_ros: no C++ compiler (c++): install one; on Debian and Ubuntu: apt install '
                'g++')
        super().build_extension(ext)


NODES = {
    **dict.fromkeys(
        ('planner', 'plant', 'driver', 'recorder', 'player', 'controller'), 'hmsa_ros'),
    'sense': 'hmsa_lab'}
# Commands of ``hmsa`` by package, with their modules if those have another name.
COMMANDS = {
    'hmsa.cli': {
        **{x: x for x in (
            'bag', 'compare', 'completion', 'export', 'identify', 'init', 'plan', 'report',
            'simulate')}, 'wave': 'waves'},
    'hmsa_ros.cli': {
        **{x: x for x in ('demo', 'interlock', 'param', 'run', 'send', 'stop')},
        **{node: 'node' for node, package in NODES.items() if package == 'hmsa_ros'}},
    'hmsa_lab.cli': {
        **{x: x for x in ('calibrate', 'excite', 'learn', 'panel', 'sense', 'tune', 'watch')},
        'check-driver': 'check_driver'},
    'hmsa_studies.commands': {x: x for x in ('figures', 'robustness', 'sweep')},
}

setup(
    name=PACKAGE,
    version=VERSION,
    packages=find_packages(include=['hmsa*']),
    package_data={
        'hmsa': [
            'py.typed', '*.pyi', 'cli/completion.[bfz]*', 'judge/*.pyi', 'motion/*.pyi',
            'motion/*.hpp', 'motion/hmsa/*.hpp', 'report/*.css', 'report/*.html', 'report/*.js',
            'report/*.mplstyle'],
        'hmsa_ros': ['py.typed', '*.xml'],
        'hmsa_lab': [
            'py.typed', 'bench/*.html', 'bench/*.pyi', 'bench/hmsa_board/*', 'panel/index.html',
            'panel/panel.*']},
    ext_modules=[MOTION, DERIVATIVES, RINGING, BOARD, DEADLINE],
    cmdclass={'build_ext': BuildMotion},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + PACKAGE]),
        ('share/' + PACKAGE, ['package.xml']),
        ('share/' + PACKAGE + '/launch', sorted(glob('launch/*.launch.py'))),
        *(('share/' + PACKAGE + '/' + folder,
           sorted(path for path in glob(folder + '/*') if os.path.isfile(path)))
          for folder in ('config', 'config/rviz', 'config/security')),
    ],
    zip_safe=False,
    python_requires='>=3.10,<3.15',
    install_requires=INSTALL_REQUIRES,
    extras_require=EXTRAS_REQUIRE,
    entry_points={
        'console_scripts': [
            'hmsa = hmsa.entry:main', *(f'{x} = hmsa_ros.entry:{x}' for x in NODES)],
        'hmsa.commands': [
            f'{name} = {package}.{module}'
            for package, modules in COMMANDS.items() for name, module in modules.items()],
        'hmsa_ros.nodes': [f'{name} = {package}.nodes.{name}' for name, package in NODES.items()],
        'hmsa_ros.follower': ['adapt = hmsa_lab.adapt.feedback:Feedback'],
        'hmsa_ros.hardware': [
            'scpi_supply = hmsa_lab.bench.scpi_supply:ScpiSupply',
            'serial_board = hmsa_lab.bench.serial_board:SerialBoard',
            'topic = hmsa_lab.nodes.topic_coil:TopicCoil'],
    },
    author='hmsa_ros maintainers',
    maintainer='hmsa_ros maintainers',
    maintainer_email='maintainers@users.noreply.h-seed-1ded8aa1.example',
    description='Vibration-free motion of hard-magnetic soft actuators: planner, simulated '
                'plant, recorder and player for ROS 2',
    long_description=read(README) if README else '',
    long_description_content_type='text/markdown',
    license='Apache-2.0',
    classifiers=[
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: C++',
        *(f'Programming Language :: Python :: 3.{minor}' for minor in range(10, 15)),
        'Topic :: Scientific/Engineering',
    ],
    keywords=['ROS', 'soft robotics', 'command shaping', 'magnetic actuators'],
)
