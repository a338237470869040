"""
An experiment: start nodes if requested, send and record a sequence, and end.

In any case, the planner is stopped if a sequence was sent, and the bag is closed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from itertools import pairwise
import math
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np

from hmsa.ending import ENDING
from hmsa.errors import BadInputError, HmsaError
from hmsa.files import make_folder
from hmsa.interfaces import topics
from hmsa.interfaces.actuator import actuator_from
from hmsa.interfaces.diagnostics import StatusVerdict
from hmsa.interfaces.parameters import BLOCK
from hmsa.interfaces.topics import PLANNER, PLANT
from hmsa.runs.parameters import values_of
from hmsa_ros.clients.processes import NodeProcess, Session

if TYPE_CHECKING:
    from hmsa_ros.clients.experiment_client import ExperimentClient

Setpoints = Sequence[tuple[Sequence[float], float]]
ExperimentProgress = Callable[[str, float], None]
#: Time limit in s for the start of nodes, and for time that does not advance.
START_SECONDS = 20.0


def check_stretches(
        setpoints: Sequence[tuple[float | Sequence[float], float]],
        joints: Sequence[str]) -> None:
    """Raise `BadInputError` unless there is one stretch, or one for each joint."""
    for stretch, _ in setpoints:
        if np.size(stretch) not in (1, len(joints)):
            raise BadInputError(
                f'{np.size(stretch)} stretches for {", ".join(joints)}: expected one for all, or '
                'one per joint (--joint names the joints)')


@dataclass(frozen=True)
class Experiment:
    """Description of an experiment."""

    folder: Path  #: existing folder for the bag ``run`` and the logs
    #: stretch, common or for each joint, and duration in s; empty if there are levels
    setpoints: Setpoints
    #: nodes to start besides the recorder, including a paused plant that publishes time, or none
    nodes: tuple[NodeProcess, ...] = ()
    #: namespace of planner and plant
    namespace: str = ''
    joints: tuple[str, ...] = ('actuator',)
    #: parameters of running nodes by ``'node.name'``, from a parameter file
    expected: Mapping[str, object] = field(default_factory=dict)
    levels: Sequence[tuple[float, float]] = ()  #: time in s, and flux density in T from then on
    #: time in s, stretch, rate in 1/s and acceleration in 1/s^2, ending at rest
    path: Sequence[Sequence[float]] = ()

    def __post_init__(self) -> None:
        check_stretches(self.setpoints, self.joints)

    @property
    def duration(self) -> float:
        """Duration of the sequence in s."""
        return sum(x for _, x in self.setpoints) + sum(
            x[-1][0] for x in (self.levels, self.path) if x)

    @property
    def bag(self) -> Path:
        """Folder of the bag."""
        return self.folder / 'run'

    def topics(self) -> list[str]:
        """Return the full names of the topics to record."""
        own = [
            topics.of_joint(topic, joint, self.joints).name for joint in self.joints
            for topic in (topics.FLUX_DENSITY_COMMAND, topics.FLUX_DENSITY_APPLIED)]
        own += [topics.JOINT_STATES.name, *(
            topics.from_outside(x.name, topics.PLANNER)
            for x in (topics.JOINT_TRAJECTORY, topics.PLAN, topics.STATUS,
                      topics.OUTCOMES, topics.ESTIMATE))]
        space = self.namespace.strip('/')
        return [*(f'/{space}/{x}' if space else f'/{x}' for x in own), '/diagnostics', '/clock']


@dataclass(frozen=True)
class Conducted:
    """Result of an experiment."""

    exits: dict[str, int]  #: exit statuses by process
    measured: bool  #: whether there were samples
    notes: tuple[str, ...]
    verdict: StatusVerdict  #: last verdict of the planner
    seconds: dict[str, float]  #: real durations by phase
    pace: float  #: speed of the nodes' time relative to real time


def prepare(folder: Path) -> None:
    """
    Create the output folder, or accept an existing one without a run.

    Raises
    ------
    BadInputError
        If the folder cannot be used.
    ModuleNotFoundError
        If ROS is not available; nothing has imported it before.

    """
    if find_spec('rclpy') is None:
        raise ModuleNotFoundError("No module named 'rclpy'", name='rclpy')
    if (folder / 'run').exists():
        raise BadInputError(
            f'{folder} contains an earlier run: name another folder with --out, or remove '
            'this one')
    make_folder(folder)


def conduct(experiment: Experiment, progress: ExperimentProgress) -> Conducted:
    """
    Carry out an experiment.

    Parameters
    ----------
    experiment : Experiment
        Experiment with a prepared folder.
    progress : callable
        Called with the current activity and the completed fraction of the sequence.

    Returns
    -------
    Conducted
        The bag is closed.

    Raises
    ------
    HmsaError
        If a check or a process fails, or the sequence is not completed.
    KeyboardInterrupt
        If the end was requested. As in all other cases, the planner has come to rest if a sequence
        was sent, the bag is closed, and all processes started have ended.

    """
    times = [monotonic()]
    with Session(experiment.folder) as session:
        progress('starting the nodes' if experiment.nodes else 'looking for the nodes', 0.0)
        if experiment.nodes:
            for node in (*experiment.nodes, recorder_of(experiment, True)):
                ENDING.check()
                session.start(node)
        # ROS is imported here, while the nodes import it too.
        from hmsa_ros.clients.experiment_client import ExperimentClient

        with ExperimentClient(experiment, session.check) as watch:
            try:
                _begin(experiment, session, watch)
                times.append(monotonic())
                begin = watch.now
                verdict = _carry_out(experiment, watch, progress)
                times.append(monotonic())
                pace = (watch.now - begin) / (times[-1] - times[-2])
                measured = watch.measured
                watch.wait_for_parameters()
            except BaseException as error:
                failure = ''
                if watch.requested:
                    progress('coming to rest', 1.0)
                    failure = watch.try_to_stop()
                session.stop()
                if not failure:
                    raise
                raise HmsaError(f'{str(error) or "interrupted"}; {failure}') from error
            progress('closing the bag', 1.0)
            exits = session.stop()
            for name, status in exits.items():
                # A recorder that lost messages has a bag, which is evaluated without them.
                if status and not (name == topics.RECORDER and _closed(experiment.bag)):
                    raise HmsaError(
                        f'the {name} ended with status {status}: {session.last_words(name)}')
    times.append(monotonic())
    seconds = dict(zip(
        ('start', 'sequence', 'end'), (y - x for x, y in pairwise(times)), strict=True))
    return Conducted(exits, measured, tuple(watch.notes), verdict, seconds, pace)


def _closed(bag: Path) -> bool:
    """Return whether a recorder has closed its bag."""
    from hmsa.bag.reader import BagReader

    try:
        return BagReader(bag).closed
    except HmsaError:
        return False


def _begin(experiment: Experiment, session: Session, watch: 'ExperimentClient') -> None:
    """Check the running nodes, and wait for the recorder."""
    watch.find_planner(session.check)
    watch.read_parameters()
    if not experiment.nodes:
        watch.check_alone()
        watch.check()
        session.start(recorder_of(experiment, bool(watch.parameter('planner.use_sim_time'))))
    watch.spin_until(
        lambda: watch.recorder_ready,
        f'the recorder is not ready: {session.last_words(topics.RECORDER)}', session.check)
    if experiment.nodes:
        watch.check_alone(own=True)
        watch.unpause()


def recorder_of(experiment: Experiment, simulated: bool) -> NodeProcess:
    """Return the recorder of an experiment, in simulated time if ``simulated``."""
    return NodeProcess(topics.RECORDER, {
        'use_sim_time': simulated, 'storage.uri': str(experiment.bag),
        'record.topics': experiment.topics()}, experiment.namespace)


def _carry_out(
        experiment: Experiment, watch: 'ExperimentClient', progress: ExperimentProgress
) -> StatusVerdict:
    """Send the sequence, and wait until the duration of the last setpoint is over."""
    verdict = watch.send_sequence(experiment.setpoints, experiment.levels, experiment.path)
    begin = watch.now
    lead = watch.parameter('planner.lead_time')
    total = experiment.duration + (
        float(lead) if isinstance(lead, (int, float)) else 0.0)

    factor = watch.parameter('plant.real_time_factor')
    slow = f' at {factor:.2g} of real time, for about {total / factor:.2g} s' if (
        isinstance(factor, float) and 0.0 < factor < 1.0
        and watch.parameter('plant.publish_clock')) else ''

    def report(*_: object) -> None:
        watch.look(begin + total)
        progress(f'running the sequence{slow}', min((watch.now - begin) / total, 1.0))

    verdict = watch.follow(verdict, each=report, timeout=math.inf)
    watch.spin_until(
        lambda: watch.now - begin > total, 'time does not advance', report, math.inf)
    return verdict


# Samples per period of the actuator, and limit on samples per second of real time for plant and
# recorder, above which simulated time is slowed down.
_SAMPLES_A_PERIOD = 25.0
_SAMPLES_A_SECOND = 4000.0


def simulated_node(
        settings: Mapping[str, object], params_file: str, namespace: str) -> NodeProcess:
    """
    Return a planner and a paused plant that publishes the time.

    They share one process, in which time waits for the planner on a busy machine.
    """
    # Settings of the parameter file take precedence.
    block = actuator_from(values_of(settings, PLANT, BLOCK))
    rate = _number(settings, 'publish_rate', max(1000.0, _SAMPLES_A_PERIOD / block.period))
    factor = _number(settings, 'real_time_factor', min(1.0, _SAMPLES_A_SECOND / rate))
    return NodeProcess('controller', {
        f'{PLANT}:publish_clock': True, f'{PLANT}:use_sim_time': False,
        f'{PLANT}:start_paused': True, f'{PLANT}:publish_rate': rate,
        f'{PLANT}:publish_scalars': 'never',
        f'{PLANT}:real_time_factor': factor, f'{PLANNER}:use_sim_time': True,
        f'{PLANNER}:feedback': settings.get(f'{PLANNER}.feedback', 'off'),
        f'{PLANNER}:trajectory_mode': settings.get(f'{PLANNER}.trajectory_mode', 'rest')},
        namespace, params_file)


def _number(settings: Mapping[str, object], name: str, default: float) -> float:
    """Return the plant's setting in the file, as a number."""
    value = settings.get(f'{PLANT}.{name}')
    return float(value) if isinstance(value, (int, float)) else default
