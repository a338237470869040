"""
An experiment: nodes started where they are wanted, a sequence sent and recorded, and the end.

However it ends, the planner has been asked to come to rest if anything was sent, and the bag is
closed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
import json
from pathlib import Path
from time import monotonic, time

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from hmsa_ros.ending import ENDING
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.interfaces import topics
from hmsa_ros.interfaces.parameters import BLOCK, WORDS
from hmsa_ros.interfaces.status import Verdict, whole
from hmsa_ros.lab.client import PlannerClient
from hmsa_ros.lab.processes import NodeProcess, Session
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.nodes import endpoints
from hmsa_ros.nodes.conversions import from_time
from hmsa_ros.nodes.remote_parameters import RemoteParameters

Setpoints = Sequence[tuple[Sequence[float], float]]
Tell = Callable[[str, float], None]
_START_SECONDS = 20.0
# How long the end of a sequence may keep us waiting after its time is over.
_GRACE_SECONDS = 20.0
# Between two looks at who is there.
_LOOK_SECONDS = 0.5
_SAME = 1e-9


@dataclass(frozen=True)
class Experiment:
    """What is done."""

    folder: Path  #: existing folder for the bag ``run`` and the logs
    #: stretch of all joints, or one a joint, and span in s; empty where there are levels
    setpoints: Setpoints
    #: to start besides the recorder, among them a paused plant that leads time, or none
    nodes: tuple[NodeProcess, ...] = ()
    #: of planner and plant
    namespace: str = ''
    joints: tuple[str, ...] = ('actuator',)
    #: parameters of running nodes by ``'node.name'``, from a parameter file
    expected: Mapping[str, object] = field(default_factory=dict)
    levels: Sequence[tuple[float, float]] = ()  #: time in s, and flux density in T from then on

    @property
    def duration(self) -> float:
        """Length in s of the sequence."""
        return sum(x for _, x in self.setpoints) + (self.levels[-1][0] if self.levels else 0.0)

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
                      topics.ESTIMATE))]
        if self.nodes:
            own += [topics.STRETCH.name, topics.STRETCH_RATE.name]
        space = self.namespace.strip('/')
        return [*(f'/{space}/{x}' if space else f'/{x}' for x in own), '/diagnostics', '/clock']


@dataclass(frozen=True)
class Conducted:
    """What became of an experiment."""

    exits: dict[str, int]  #: by process
    measured: bool  #: whether samples came
    notes: tuple[str, ...]
    verdict: Verdict  #: what the planner said last
    seconds: dict[str, float]  #: what took how long, of our time
    pace: float  #: of the nodes' time, as a share of ours


def prepare(folder: Path) -> None:
    """
    Make the output folder, or take one that does not hold an earlier run.

    Raises
    ------
    BadInputError
        If it cannot be used.

    """
    if (folder / 'run').exists():
        raise BadInputError(
            f'{folder} holds an earlier run: expected another folder (--out), or this one '
            'removed')
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / '.writable'
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise BadInputError(
            f'cannot write to {folder}: {error.strerror}; expected a folder with write '
            'permission (--out)') from error


def conduct(
        experiment: Experiment, environment: Mapping[str, str], progress: Tell) -> Conducted:
    """
    Carry out an experiment.

    Parameters
    ----------
    experiment : Experiment
        In a prepared folder.
    environment : mapping of str to str
        Of the processes; this process must live in the same ROS domain.
    progress : callable
        Called with what is going on and the share of the sequence that is done.

    Returns
    -------
    Conducted
        The bag is closed.

    Raises
    ------
    HmsaError
        If a check or a process fails, or the sequence does not come to its end.
    KeyboardInterrupt
        If the end was asked for. As in every other case, the planner has come to rest if a
        sequence was sent, the bag is closed, and all processes that were started have ended.

    """
    with Session(experiment.folder, environment) as session, PlannerClient(
            namespace=experiment.namespace, joints=experiment.joints,
            timeout=_START_SECONDS) as client:
        watch = _Watch(client, experiment, session.check)
        times = [monotonic()]
        try:
            progress('starting the nodes' if experiment.nodes else 'looking for the nodes', 0.0)
            _begin(experiment, session, watch)
            times.append(monotonic())
            begin = watch.now
            verdict = _carry_out(experiment, watch, progress)
            times.append(monotonic())
            pace = (watch.now - begin) / (times[-1] - times[-2])
            measured = watch.measured
        except BaseException as error:
            resting = True
            if watch.sent:
                progress('coming to rest', 1.0)
                resting = client.stop()
            session.stop()
            if resting:
                raise
            raise HmsaError(
                f'{str(error) or "interrupted"}; the planner does not say that the actuator '
                'rests: look after the coil') from error
        progress('closing the bag', 1.0)
        exits = session.stop()
        for name, status in exits.items():
            if status:
                raise HmsaError(
                    f'the {name} ended with status {status}: {session.last_words(name)}')
    times.append(monotonic())
    seconds = dict(zip(('start', 'sequence', 'end'), np.diff(times).tolist(), strict=True))
    return Conducted(exits, measured, tuple(watch.notes), verdict, seconds, pace)


def _begin(experiment: Experiment, session: Session, watch: '_Watch') -> None:
    """Start what is to be started, check what runs, and wait for the recorder."""
    for node in experiment.nodes:
        ENDING.check()
        session.start(node)
    if experiment.nodes:
        session.start(_recorder(experiment, True))
    watch.client.find_planner(session.check)
    watch.client.check_alone()
    watch.read_parameters()
    if not experiment.nodes:
        watch.check()
        session.start(_recorder(experiment, bool(watch.parameter('planner.use_sim_time'))))
    watch.client.spin_until(
        lambda: watch.recorder_ready,
        f'the recorder is not ready: {session.last_words(topics.RECORDER)}', session.check)
    if experiment.nodes:
        watch.unpause()


def _recorder(experiment: Experiment, simulated: bool) -> NodeProcess:
    return NodeProcess(topics.RECORDER, {
        'use_sim_time': simulated, 'storage.uri': str(experiment.bag),
        'record.topics': experiment.topics()}, experiment.namespace)


def _carry_out(experiment: Experiment, watch: '_Watch', progress: Tell) -> Verdict:
    """Send the sequence, and wait until the last setpoint has been watched for its span."""
    watch.sent = True
    verdict = watch.client.send(experiment.setpoints, experiment.levels)
    begin = watch.now
    lead = watch.parameter('planner.lead_time')
    total = experiment.duration + (
        float(lead) if isinstance(lead, (int, float)) else 0.0)

    factor = watch.parameter('plant.real_time_factor') if experiment.nodes else None
    slow = f' at {factor:.2g} of real time' if isinstance(factor, float) and (
        0.0 < factor < 1.0) else ''

    def report() -> None:
        watch.look(begin + total)
        progress(f'running the sequence{slow}', min((watch.now - begin) / total, 1.0))

    verdict = watch.client.follow(verdict, each=lambda _: report(), timeout=float('inf'))
    watch.client.spin_until(
        lambda: watch.now - begin > total, 'time does not advance', report, float('inf'))
    return verdict


class _Watch:
    """What an experiment looks at: who is there, the recorder's readiness, and the time."""

    def __init__(
            self, client: PlannerClient, experiment: Experiment,
            check: Callable[[], None]) -> None:
        self.client = client
        # That what was started runs.
        self._check = check
        self.sent = False
        self.notes: list[str] = []
        self._experiment = experiment
        # Topics that the recorder has subscribed to, by what it says.
        self._subscribed = 0
        self._clock: float | None = None
        self._looked = 0.0
        # The time, and when it last went on.
        self._seen = 0.0, monotonic()
        self._over: float | None = None
        self._parameters: dict[str, str] = {}
        node = client.node
        endpoints.subscribe(node, topics.DIAGNOSTICS, self._on_diagnostics)
        endpoints.subscribe(node, topics.CLOCK_TOPIC, self._on_clock)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {x.key: x.value for x in status.values}
            # Others may record too.
            if values.get('bag') == str(self._experiment.bag):
                self._subscribed = whole(values.get('subscribed', '').partition('/')[0])

    def _on_clock(self, message: Clock) -> None:
        self._clock = from_time(message.clock) / NANOSECONDS

    @property
    def now(self) -> float:
        """Time of the nodes in s."""
        if self._experiment.nodes or self.parameter('planner.use_sim_time'):
            return self._clock or 0.0
        return time()

    @property
    def recorder_ready(self) -> bool:
        """Whether the recorder hears everything that somebody sends."""
        sent = [x for x in self._experiment.topics() if self.client.node.count_publishers(x)]
        return self._subscribed >= len(sent)

    @property
    def measured(self) -> bool:
        """Whether somebody publishes samples."""
        return bool(self.client.node.count_publishers(topics.JOINT_STATES.name))

    # -- checks --------------------------------------------------------------------------------

    def read_parameters(self) -> None:
        """Ask planner and plant for their parameters; a driver of hardware may have none."""
        space = f'/{self._experiment.namespace.strip("/")}'.rstrip('/')
        asked = {x: RemoteParameters(self.client.node, f'{space}/{x}')
                 for x in (topics.PLANNER, topics.PLANT)}

        def poll() -> None:
            self._check()
            for node, remote in asked.items():
                if not self._known(node):
                    remote.poll(partial(self._note, node))

        def known() -> bool:
            there = {x for x, own in self.client.node.get_node_names_and_namespaces()
                     if own == (space or '/')}
            return all(
                self._known(node) for node in asked if node == topics.PLANNER or node in there)

        self.client.spin_until(known, 'the nodes do not give their parameters', poll)

    def _known(self, node: str) -> bool:
        return any(x.startswith(f'{node}.') for x in self._parameters)

    def _note(self, node: str, found: Mapping[str, str]) -> None:
        self._parameters |= {f'{node}.{x.partition(f"{node}.")[2]}': found[x] for x in found}

    def parameter(self, name: str) -> object:
        """Return a parameter of a node by ``'node.name'``; None if it has none."""
        return json.loads(self._parameters.get(name, 'null'))

    def check(self) -> None:
        """
        Make sure that what runs can do what is asked.

        Raises
        ------
        BadInputError
            If a node's parameters are not those of the parameter file.
        HmsaError
            If nobody takes the commands.

        """
        wrong = [
            f'{name} is {self.parameter(name)} and not {value}'
            for name, value in self._experiment.expected.items()
            if name in self._parameters and not _same(self.parameter(name), value)]
        if wrong:
            raise BadInputError(
                f'the nodes run with other parameters than the file has ({"; ".join(wrong[:3])}'
                '): expected the same; start them with --params-file and that file')
        for spec in BLOCK:
            own, other = (self.parameter(f'{x}.{spec.name}')
                          for x in (topics.PLANT, topics.PLANNER))
            if own is not None and not _same(own, other):
                self.notes.append(
                    f'{spec.name} is {other} for the planner and {own} for the plant')
        self.client.spin_until(
            lambda: not self.client.unheard(),
            'no node receives the commands on '
            f'{", ".join(self.client.unheard()) or "their topics"}: '
            'expected a plant or a driver of the coil (hmsa plant)')
        joints = self._experiment.joints
        if not self.client.node.count_publishers(
                topics.of_joint(topics.FLUX_DENSITY_APPLIED, joints[0], joints).name):
            self.notes.append(
                'no node reports the applied levels (flux_density_applied)')
            if not self.measured:
                raise HmsaError(
                    'no node reports applied levels (flux_density_applied) or samples '
                    '(joint_states): expected a plant or a driver that does')

    def look(self, end: float) -> None:
        """
        Make sure that the nodes are there and time goes on; the sequence is over at ``end`` s.

        Raises
        ------
        HmsaError
            If something has gone.

        """
        self._check()
        moment, now = monotonic(), self.now
        if moment - self._looked < _LOOK_SECONDS:
            return
        self._looked = moment
        if now > self._seen[0]:
            self._seen = now, moment
        elif moment - self._seen[1] > _START_SECONDS:
            raise HmsaError(f'time does not advance beyond {now:g} s: expected messages on /clock')
        if not self.client.node.count_publishers(
                topics.from_outside(topics.STATUS.name, topics.PLANNER)):
            raise HmsaError('the planner has gone: expected it to run until the end')
        if unheard := self.client.unheard():
            raise HmsaError(
                f'no node receives the commands on {", ".join(unheard)} any more: expected plant '
                'or driver to run until the end')
        if now > end:
            self._over = self._over or moment
            if moment - self._over > _GRACE_SECONDS:
                raise HmsaError(
                    f'the sequence has not come to its end {_GRACE_SECONDS:g} s after its time')

    def unpause(self) -> None:
        """Let simulated time run."""
        call = endpoints.call(
            self.client.node, topics.SET_PAUSED, topics.PLANT, SetBool.Request(data=False))
        for condition, failure in (
                (lambda: call.ready, 'the plant offers no service to unpause it'),
                (lambda: call.answer() is not None, 'the plant did not answer'),
                (lambda: self.now > 0.0, 'time does not begin to advance')):
            self.client.spin_until(condition, failure, self._check)


def _same(own: object, other: object) -> bool:
    if isinstance(own, (int, float)) and isinstance(other, (int, float)):
        return own == other or abs(own - other) <= _SAME * max(abs(own), abs(other))
    return own == other or isinstance(other, bool) and own in WORDS[other]
