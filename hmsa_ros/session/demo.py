"""
The paper's sequence on real ROS 2 processes, recorded and evaluated.

Planner, plant and recorder run as processes of their own and talk over DDS on this host. The
plant is the authority on time and runs in slow motion: the whole sequence lasts 0.13 s for the
silicone block of `paper_actuator`.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from hmsa_ros.core.parameters import paper_actuator
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.ending import ENDING
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.nodes import interface
from hmsa_ros.nodes.conversions import from_time
from hmsa_ros.report.evaluation import evaluate, Move, MoveResult
from hmsa_ros.runs.bags import read_runs
from hmsa_ros.runs.levels import without_repeats
from hmsa_ros.session.client import PlannerClient
from hmsa_ros.session.processes import NodeProcess, Session

#: The paper's first expansion sequence, (stretch, span) in nondimensional time (Figs. 4, 5).
SEQUENCE = ((1.10, 10.0), (1.20, 10.0), (1.40, 10.0))
REAL_TIME_FACTOR = 0.0125
PUBLISH_RATE = 20_000.0
LEAD_TIME = 0.01
#: Largest residual vibration, as a share of the step, of a setpoint that counts as held.
LARGEST_RESIDUAL = 1e-6
_START_SECONDS = 20.0
_TOPICS = (
    interface.FLUX_DENSITY_COMMAND.name, interface.JOINT_STATES.name, interface.STRETCH.name,
    interface.STRETCH_RATE.name, 'planner/joint_trajectory', 'planner/plan', 'planner/status',
    '/diagnostics', '/clock')


@dataclass(frozen=True)
class SetpointResult(MoveResult):
    """
    The result of one setpoint, from the bag.

    Attributes
    ----------
    reached : bool
        Whether error and residual are within `LARGEST_RESIDUAL`.

    """

    reached: bool


@dataclass(frozen=True)
class DemoResult:
    """
    What the demo found.

    Attributes
    ----------
    setpoints : tuple of SetpointResult
        In order.
    exits : dict of str to int
        Exit status of each process.
    bag, picture : Path
        What was written.

    """

    setpoints: tuple[SetpointResult, ...]
    exits: dict[str, int]
    bag: Path
    picture: Path

    @property
    def succeeded(self) -> bool:
        """Whether every setpoint was reached and held and every process ended cleanly."""
        return all(x.reached for x in self.setpoints) and not any(self.exits.values())

    def as_json(self) -> dict[str, object]:
        """
        Return the result for JSON.

        Returns
        -------
        dict
            With plain types.

        """
        return {
            'succeeded': self.succeeded, 'setpoints': [asdict(x) for x in self.setpoints],
            'exits': self.exits, 'bag': str(self.bag), 'picture': str(self.picture)}


def prepare(folder: Path) -> None:
    """
    Make the output folder.

    Parameters
    ----------
    folder : Path
        May exist, but not hold an earlier run.

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


def run_demo(
        folder: Path, environment: dict[str, str],
        progress: Callable[[str, float], None]) -> DemoResult:
    """
    Run the paper's sequence and evaluate the bag.

    Parameters
    ----------
    folder : Path
        Prepared output folder.
    environment : dict of str to str
        Environment of the processes; this process must live in the same ROS domain.
    progress : callable
        Called with what is going on and the share of the sequence that is done.

    Returns
    -------
    DemoResult
        Read back from the bag.

    Raises
    ------
    HmsaError
        If a process fails or the bag does not hold the run.
    KeyboardInterrupt
        If the end was requested; the processes are ended whatever happens.

    """
    bag = folder / 'run'
    with Session(folder, environment) as session:
        _start(session, bag)
        with PlannerClient(timeout=_START_SECONDS) as client:
            watch = _Watch(client)
            progress('starting the nodes', 0.0)
            client.find_planner(session.check)
            client.spin_until(
                lambda: watch.recorder_ready,
                f'the recorder is not ready: {session.last_words("recorder")}', session.check)
            watch.unpause(session.check)
            spans = [span * paper_actuator().time_unit for _, span in SEQUENCE]
            verdict = client.send(
                [(x, s) for (x, _), s in zip(SEQUENCE, spans, strict=True)], time_begins=True)
            begin = watch.time
            total = sum(spans) + LEAD_TIME

            def report() -> None:
                session.check()
                progress('running the sequence', min((watch.time - begin) / total, 1.0))

            # Not only carried out: the last setpoint is watched for its whole span.
            limit = 3.0 * total / REAL_TIME_FACTOR + _START_SECONDS
            client.follow(verdict, each=lambda _: report(), timeout=limit)
            client.spin_until(
                lambda: watch.time - begin > total, 'simulated time does not advance', report,
                limit)
        progress('closing the bag', 1.0)
        exits = session.stop(('recorder',))
        for name, status in exits.items():
            if status:
                raise HmsaError(
                    f'the {name} ended with status {status}: {session.last_words(name)}')
    progress('evaluating the bag', 1.0)
    return _evaluate(bag, folder / 'run.png', exits)


def _start(session: Session, bag: Path) -> None:
    """Start the three nodes; time is paused until all are ready."""
    for node in (
            NodeProcess('plant', {
                'publish_clock': True, 'start_paused': True,
                'real_time_factor': REAL_TIME_FACTOR, 'publish_rate': PUBLISH_RATE}),
            NodeProcess('planner', {'use_sim_time': True, 'lead_time': LEAD_TIME}),
            NodeProcess('recorder', {
                'use_sim_time': True, 'storage.uri': str(bag), 'record.topics': _TOPICS})):
        ENDING.check()
        session.start(node)


class _Watch:
    """What the demo looks at while it runs: the recorder's readiness and the plant's time."""

    def __init__(self, client: PlannerClient) -> None:
        self._client = client
        self.recorder_ready = False
        self.time = 0.0
        node = client.node
        topic = interface.DIAGNOSTICS
        node.create_subscription(topic.type, topic.name, self._on_diagnostics, topic.qos)
        topic = interface.JOINT_STATES
        node.create_subscription(topic.type, topic.name, self._on_joint_state, topic.qos)
        self._set_paused = node.create_client(
            interface.SET_PAUSED.type,
            interface.from_outside(interface.SET_PAUSED.name, interface.PLANT))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith('recorder'):
                for item in status.values:
                    if item.key == 'subscribed':
                        done, _, wanted = item.value.partition('/')
                        self.recorder_ready = done.strip() == wanted.strip()

    def _on_joint_state(self, message: JointState) -> None:
        self.time = from_time(message.header.stamp) / NANOSECONDS

    def unpause(self, each: Callable[[], None]) -> None:
        """Let time run."""
        self._client.spin_until(
            self._set_paused.service_is_ready, 'the plant offers no service to unpause it',
            each)
        future = self._set_paused.call_async(SetBool.Request(data=False))
        self._client.spin_until(future.done, 'the plant did not answer', each)
        begin = monotonic()
        self._client.spin_until(
            lambda: self.time > 0.0, f'no sample of the plant since {begin:.1f} s', each)


def _evaluate(bag: Path, picture: Path, exits: dict[str, int]) -> DemoResult:
    """Read the run back from the bag, measure it and draw it."""
    from hmsa_ros.figures.run import draw_run

    run, = read_runs(bag)
    levels = without_repeats(run.commands)[0]
    if len(levels) != 2 * len(SEQUENCE):
        raise HmsaError(
            f'the bag holds {len(levels)} commands: expected {2 * len(SEQUENCE)}')
    begins = [x.stamp for x in levels[::2]]
    last = begins[-1] + SEQUENCE[-1][1] * paper_actuator().time_unit * NANOSECONDS
    moves = [
        Move(target, levels[2 * i].stamp, levels[2 * i + 1].stamp, end,
             (levels[2 * i].flux_density, levels[2 * i + 1].flux_density))
        for i, ((target, _), end) in enumerate(
            zip(SEQUENCE, [*begins[1:], round(last)], strict=True))]
    evaluation = evaluate(run, moves)
    results = tuple(
        SetpointResult(**asdict(x), reached=max(x.error, x.residual) <= LARGEST_RESIDUAL)
        for x in evaluation.results)
    draw_run(
        picture, time=evaluation.time, stretch=run.stretch, rate=run.rate,
        command_time=np.array([evaluation.seconds(x.stamp) for x in levels]),
        command=np.array([x.flux_density for x in levels]), unshaped=evaluation.unshaped,
        targets=[(x.stretch, x.begin, x.arrival, x.end) for x in results])
    return DemoResult(results, exits, bag, picture)
