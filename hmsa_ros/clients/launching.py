"""
Contents of the launch files: processes and their arguments, without the package ``launch``.

The files in ``launch/`` wrap `DEMO` and `REPLAY` through `hmsa_ros.clients.ros_launch`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
import signal

from hmsa.errors import BadInputError, check_choice
from hmsa.interfaces.parameters import number_of
from hmsa.interfaces.topics import PLANT
from hmsa.runs.parameters import entries_of
from hmsa_ros.clients.processes import NodeProcess

_YES_OR_NO = ('true', 'false')
# Time limit for discovery and start of the nodes; a failing plant ends all processes.
_START_SECONDS = 600.0
# Time for the recorder to find the topics of a plant that has just become active.
_RECORDER_NANOSECONDS = 500_000_000


@dataclass(frozen=True)
class Argument:
    """An argument of a launch file; required if it has no default."""

    name: str
    description: str
    default: str | None = ''
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class Started:
    """Processes of a launch, which end together if one fails or ``last`` ends normally."""

    nodes: tuple[NodeProcess, ...]
    rviz: NodeProcess | None
    last: str = ''
    note: str = ''  #: sentence to log, if any


@dataclass(frozen=True)
class LaunchFile:
    """A launch file; ``start`` is called with argument values and the installed folder."""

    arguments: tuple[Argument, ...]
    start: Callable[[Mapping[str, str], Path], Started]

    def evaluate(self, given: Mapping[str, str], share: Path) -> Started:
        """
        Return the processes for the given arguments; ``share`` is the package's installed folder.

        Raises
        ------
        BadInputError
            If an argument is missing or not one of its choices, or a file does not exist.

        """
        values = {}
        for argument in self.arguments:
            value = given.get(argument.name, argument.default)
            if value is None:
                raise BadInputError(
                    f'launch argument {argument.name} is missing: expected '
                    f'{argument.name}:=..., {argument.description}')
            if argument.choices:
                check_choice(f'launch argument {argument.name}', value, argument.choices)
            values[argument.name] = value
        for name in ('params_file', 'rviz_config'):
            if values[name] and not Path(values[name]).is_file():
                raise BadInputError(
                    f'launch argument {name} is {values[name]!r}: expected an existing file')
        return self.start(values, share)


def _flag(name: str, description: str, default: str) -> Argument:
    return Argument(name, description, default, _YES_OR_NO)


_COMMON = (
    _flag('record', 'Whether to record', 'true'),
    Argument('namespace', 'Namespace of the nodes'),
    _flag('rviz', 'Whether to start RViz, which must be installed', 'false'),
    Argument('rviz_config', "Configuration of RViz; default this package's"),
    Argument('log_level', 'Lowest severity to log: debug, info, warn, error or fatal',
             'info'))


def _nodes(values: Mapping[str, str], file: str, parameters: Mapping[str, Mapping[str, object]]) \
        -> tuple[NodeProcess, ...]:
    """Return the nodes with their common settings."""
    return tuple(
        NodeProcess(name, given, values['namespace'], file, values['log_level'])
        for name, given in parameters.items() if name != 'recorder' or values['record'] == 'true')


def _rviz(values: Mapping[str, str], share: Path, simulated: bool) -> NodeProcess | None:
    if values['rviz'] == 'false':
        return None
    config = values['rviz_config'] or str(share / 'config' / 'rviz' / 'hmsa.rviz')
    return NodeProcess('rviz2', {'use_sim_time': simulated}, values['namespace'],
                       options=('-d', config))


def _bag_name(prefix: str) -> str:
    return f'{prefix}_{datetime.now():%Y%m%d_%H%M%S}'


def _start_demo(values: Mapping[str, str], share: Path) -> Started:
    hardware = values['hardware']
    plant = values['plant'] == 'true' and not hardware
    simulated = plant if values['use_sim_time'] == 'auto' else values['use_sim_time'] == 'true'
    # In real time, the defaults of the nodes apply; the file is for slow motion.
    file = values['params_file'] or (
        str(share / 'config' / 'demo.yaml') if simulated and plant else '')
    parameters: dict[str, Mapping[str, object]] = {'recorder': {
        'use_sim_time': simulated, 'storage.uri': values['bag'] or _bag_name('hmsa')}}
    if plant:
        parameters['plant'] = {'use_sim_time': False, 'publish_clock': simulated}
    if hardware:
        parameters['driver'] = {'hardware': hardware}
    parameters['planner'] = {'use_sim_time': simulated}
    return Started(
        _nodes(values, file, parameters), _rviz(values, share, simulated),
        note=_slow_motion(file) if simulated and plant and file else '')


_FACTOR = 'real_time_factor'


def _slow_motion(file: str) -> str:
    """Return how slowly simulated time passes by a parameter file; empty in real time."""
    try:
        factor = next((number_of(value) for node, name, value in reversed(entries_of(Path(file)))
                       if node in ('', PLANT) and name == _FACTOR), None)
    except BadInputError:
        return ''  # the plant says what is wrong with it
    return '' if factor is None or not 0.0 < factor < 1.0 else (
        f'simulated time runs at {factor:g} of real time ({_FACTOR} in {file}): 1 s of a '
        f'sequence takes {1.0 / factor:.3g} s')


def _start_replay(values: Mapping[str, str], share: Path) -> Started:
    try:
        rate = float(values['rate'])
    except ValueError as error:
        raise BadInputError(
            f'launch argument rate is {values["rate"]!r}: expected a number') from error
    command = ['flux_density_command']
    parameters: dict[str, Mapping[str, object]] = {
        'recorder': {
            'use_sim_time': True, 'storage.uri': values['record_to'] or _bag_name('hmsa_replay')},
        'plant': {'use_sim_time': True, 'publish_clock': False},
        'player': {
            'use_sim_time': False, 'storage.uri': values['bag'], 'play.rate': rate,
            # Shorter than the planner's lead_time, so that commands arrive in time.
            'play.clock_publish_frequency': 4000.0,
            'play.topics_to_filter': command,
            # Not any subscriber, since a recorder subscribes to the commands too.
            'play.wait_for_subscribers': command,
            'play.wait_for_nodes': ['plant'],
            'play.wait_for_recorder': 'recorder' if values['record'] == 'true' else '',
            'play.wait_for_subscribers_timeout': _START_SECONDS,
            # On a busy machine, the plant lags behind the clock when the last command is sent.
            'play.wait_for_samples': ['joint_states'],
            'play.delay.nsec': _RECORDER_NANOSECONDS}}
    return Started(
        _nodes(values, values['params_file'], parameters), _rviz(values, share, True), 'player')


#: Planner, simulated plant or driver, and recorder.
DEMO = LaunchFile((
    _flag('plant', 'Whether to simulate the plant; false for a driver of your own', 'true'),
    Argument(
        'hardware', 'Real hardware in the place of the plant, as MODULE:NAME (parameter hardware '
        'of the driver)'),
    Argument(
        'use_sim_time', 'Whether to use simulated time from /clock, which the plant publishes; '
        'auto: if the plant is simulated', 'auto', ('auto', *_YES_OR_NO)),
    Argument(
        'params_file', 'Parameters of the nodes; default config/demo.yaml for a simulated plant '
        "in simulated time, otherwise the nodes' own defaults"),
    Argument(
        'bag', 'Folder of the bag, which must not exist yet; default hmsa_ plus date and time'),
    *_COMMON), _start_demo)

#: Play the commands of a bag to a new plant. The player publishes ``/clock`` from the bag.
REPLAY = LaunchFile((
    Argument('bag', 'Folder of the bag to play', None),
    Argument(
        'record_to', 'Folder of the new bag, which must not exist yet; default hmsa_replay_ '
        'plus date and time'),
    Argument('rate', 'Playback speed', '1.0'),
    Argument('params_file', "Parameters of the nodes; default the nodes' own defaults"),
    *_COMMON), _start_replay)


def failure(name: str, status: int, ending: bool) -> str:
    """Return a message about a failed process, else empty; signals are normal while ending."""
    # A process that had to be killed has failed.
    if not status or (ending and status in (-signal.SIGINT, -signal.SIGTERM)):
        return ''
    return (f'the {name} ended with status {status}: expected 0; the reason is in its output '
            'above')
