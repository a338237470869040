"""A rig of real node processes in a ROS domain of its own, and an observing node."""

from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
import os
from pathlib import Path
import signal
import subprocess
import sys
from time import monotonic
from typing import Any, TextIO

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import numpy as np
import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState, MagneticField
from std_msgs.msg import Float64

from hmsa.errors import HmsaError
from hmsa.interfaces import topics
from hmsa.model.units import NANOSECONDS
from hmsa_ros.clients.processes import die_with_parent
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.conversions import from_time, to_trajectory

ROOT = Path(__file__).resolve().parent.parent.parent
#: Maximum wait for a process to start, or for a condition, in s.
PATIENCE = 40.0
_SLICE = 0.02
# Time a server needs to discover a new client, in s.
_ACQUAINTANCE = 0.2
_TRACE = 'Traceback (most recent call last)'
# Number of log lines quoted for a failure.
_LAST = 4


class Child:
    """A process with its output appended to a file."""

    def __init__(
            self, command: Sequence[str], log: Path, environment: Mapping[str, str]) -> None:
        """Start the process."""
        self.log = log
        with open(log, 'ab') as file:
            self.popen = subprocess.Popen(
                command, cwd=ROOT, env=dict(environment), stdin=subprocess.DEVNULL,
                stdout=file, stderr=file,
                preexec_fn=partial(  # noqa: PLW1509 - only calls the kernel
                    die_with_parent, signal.SIGKILL))

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        return self.popen.poll() is None

    @property
    def said(self) -> str:
        """Its output so far."""
        return self.log.read_text(errors='replace')

    def send(self, number: int) -> None:
        """Send a signal."""
        self.popen.send_signal(number)

    def end(self, number: int = signal.SIGINT, patience: float = PATIENCE) -> int:
        """Send a signal, wait for the end and return the status; kill an unresponsive process."""
        if self.alive:
            self.popen.send_signal(number)
        try:
            return self.popen.wait(patience)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            return self.popen.wait()


class Rig:
    """
    Start nodes, observe, send requests and measure; a context manager that ends them.

    Parameters
    ----------
    folder : Path
        Existing folder for logs and bags.
    domain : int
        ROS domain for this rig alone.
    watch : bool
        Whether to keep samples, commands and the changes they cause.

    Attributes
    ----------
    folder : Path
        As given.
    node : rclpy.node.Node
        The rig's own node.
    children : list of Child
        All processes that were started.
    commands, applied : list of (int, float)
        Timestamp in ns and flux density in T, as received.
    verdicts : list of dict
        Of ``planner/status``, with ``level`` and ``message``.
    diagnostics : dict of dict
        Newest of each name on ``/diagnostics``, with ``level`` and ``message``.
    deaf : bool
        Whether to ignore messages, while garbage is sent to watched topics.

    """

    def __init__(self, folder: Path, domain: int, *, watch: bool = True) -> None:
        """Join the domain."""
        self.folder = folder
        self.environment = {
            **os.environ, 'ROS_DOMAIN_ID': str(domain), 'PYTHONUNBUFFERED': '1',
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_LOG_DIR': str(folder),
            'RCUTILS_COLORIZED_OUTPUT': '0',
            'PYTHONPATH': os.pathsep.join(
                [str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])])}
        self.children: list[Child] = []
        self.context = rclpy.Context()
        # Discovery's range is read from the environment of the process that starts a context.
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        rclpy.init(
            args=[], context=self.context, domain_id=domain,
            signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
        self.node: Node = rclpy.create_node('rig', context=self.context, enable_rosout=False)
        self._executor = EventsExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._stamps = array('q')
        self._values = array('d')
        self.commands: list[tuple[int, float]] = []
        self.applied: list[tuple[int, float]] = []
        self.verdicts: list[dict[str, str]] = []
        self.diagnostics: dict[str, dict[str, str]] = {}
        self.deaf = False
        self._clients: dict[str, Any] = {}
        self._seen: dict[str, int] = {}
        self._watch = watch
        if watch:
            self._subscribe(topics.JOINT_STATES, '', self._on_sample)
            self._subscribe(topics.FLUX_DENSITY_COMMAND, '', lambda x: self.commands.append(
                (from_time(x.header.stamp), x.magnetic_field.z)))
            self._subscribe(topics.FLUX_DENSITY_APPLIED, '', self._on_applied)
        self._subscribe(topics.STATUS, topics.PLANNER, self._on_verdict)
        self._subscribe(topics.DIAGNOSTICS, '', self._on_diagnostics)
        self._setpoint = self.publisher(topics.SETPOINT, topics.PLANNER)
        self._trajectory = self.publisher(topics.JOINT_TRAJECTORY, topics.PLANNER)

    def __enter__(self) -> 'Rig':
        """Return the rig."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the processes and leave the domain."""
        for child in self.children:
            if child.alive:
                # A stopped process responds to this signal only.
                child.send(signal.SIGCONT)
                child.send(signal.SIGINT)
        for child in self.children:
            child.end(patience=10.0)
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

    # -- processes -----------------------------------------------------------------------------

    def start(
            self, name: str, parameters: Mapping[str, object] | None = None,
            remap: Mapping[str, str] | None = None) -> Child:
        """Start a node of the package."""
        words = []
        for key, value in (parameters or {}).items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            words += ['-p', f'{key}:={text}']
        for key, value in (remap or {}).items():
            words += ['-r', f'{key}:={value}']
        return self.run(name, '-m', 'hmsa_ros', name, '--ros-args', *words)

    def run(self, name: str, *words: str) -> Child:
        """Start this Python interpreter with arguments."""
        child = Child(
            [sys.executable, *words], self.folder / f'{name}.log', self.environment)
        self.children.append(child)
        return child

    def relay(self, *options: str) -> dict[str, str]:
        """Start a relay and return the remapping with which the planner sends through it."""
        name = topics.FLUX_DENSITY_COMMAND.name
        self.run('relay', '-m', 'benchmarks.faults.relay', f'{name}_sent', name, *options)
        self.spin_until(
            lambda: self.node.count_subscribers(f'{name}_sent') > 0
            and self.node.count_publishers(name) > 0, 'the relay')
        return {name: f'{name}_sent'}

    def load(self, count: int) -> list[Child]:
        """Keep processors busy."""
        return [self.run('load', '-c', 'while True: pass') for _ in range(count)]

    def ready(self, *names: str) -> None:
        """Wait until nodes are running and have discovered each other."""
        if topics.PLANT in names and self._watch:
            self.spin_until(lambda: len(self._stamps) > 0, 'the first sample')
        if topics.PLANNER in names:
            self.spin_until(
                lambda: self.verdicts and self._setpoint.get_subscription_count() > 0,
                'the planner')
        # Messages sent before two nodes have discovered each other are lost. They have discovered
        # this node; two rounds of diagnostics later, at least a second, also each other. A relay
        # that starts on a busy machine discovers them later.
        relays = [x for x in self.children if x.log.stem == 'relay']
        self.spin_until(
            lambda: all('joined' in x.said for x in relays),
            'the relay to find planner and plant')
        self._await_diagnostics(names)

    def traces(self) -> list[str]:
        """Return the last line of each traceback in the logs of the package's nodes."""
        found = []
        for log in {x.log for x in self.children}:
            if log.stem.split('_')[0] not in topics.NODES:
                continue
            for part in log.read_text(errors='replace').split(_TRACE)[1:]:
                # Frames are indented; the first unindented line names the exception.
                last = next((x for x in part.splitlines()[1:] if x[:1].strip()), '')
                found.append(f'{log.stem}: {last.strip()}')
        return found

    def last_words(self) -> str:
        """Return the last log lines of each node of the package, for a failure."""
        logs = {x.log: x for x in self.children if x.log.stem.split('_')[0] in topics.NODES}
        return ''.join(
            f'; {log.stem} said last: {" / ".join(child.said.split(chr(10))[-_LAST - 1:-1])}'
            for log, child in logs.items())

    # -- observations --------------------------------------------------------------------------

    def _subscribe(
            self, topic: topics.Topic, owner: str, callback: Callable[[Any], None]) -> None:
        ros_entities.subscribe(
            self.node, topic, lambda x: None if self.deaf else callback(x), owner)

    def publisher(self, topic: topics.Topic, owner: str = '') -> Any:
        """Return a publisher of the rig's node."""
        return ros_entities.publisher(self.node, topic, owner)

    def _on_sample(self, message: JointState) -> None:
        self._stamps.append(from_time(message.header.stamp))
        self._values.extend((message.position[0], message.velocity[0], message.effort[0]))

    def _on_applied(self, message: MagneticField) -> None:
        self.applied.append((from_time(message.header.stamp), message.magnetic_field.z))

    def _on_verdict(self, message: DiagnosticStatus) -> None:
        self.verdicts.append(_plain(message))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name] = _plain(status)
            node = status.name.partition(':')[0].rpartition('/')[2]
            self._seen[node] = self._seen.get(node, 0) + 1

    def _rounds(self, node: str) -> int:
        return self._seen.get(node, 0)

    def count(self) -> int:
        """Return the number of samples so far, a mark for `samples`."""
        return len(self._stamps)

    def samples(self, first: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return timestamps in ns; stretch, rate in 1/s, flux density in T; from a mark on."""
        return (np.array(self._stamps[first:], np.int64),
                np.array(self._values[3 * first:]).reshape(-1, 3))

    @property
    def time(self) -> int:
        """Time of the newest sample in ns."""
        return self._stamps[-1]

    def value(self, node: str, key: str) -> float:
        """Return a number from the newest diagnostics of a node; NaN if there is none."""
        for name, status in self.diagnostics.items():
            if name.startswith(node) and key in status:
                return float(status[key])
        return float('nan')

    def level(self, node: str) -> int:
        """Return the worst level in a node's newest diagnostics; -1 if there are none."""
        return max((int(x['level']) for name, x in self.diagnostics.items()
                    if name.startswith(node)), default=-1)

    def fresh(self, *nodes: str) -> None:
        """Wait for diagnostics newer than now."""
        self._await_diagnostics(nodes)

    def _await_diagnostics(self, nodes: Sequence[str]) -> None:
        """Wait for two rounds of diagnostics: the first may already have been on its way."""
        ends = {x: self._rounds(x) + 2 for x in nodes}
        self.spin_until(
            lambda: all(self._rounds(x) >= y for x, y in ends.items()),
            f'diagnostics of {", ".join(nodes)}')

    # -- requests ------------------------------------------------------------------------------

    def spin_until(
            self, condition: Callable[[], Any], what: str, patience: float = PATIENCE) -> None:
        """Serve callbacks until a condition holds."""
        end = monotonic() + patience
        while not condition():
            if monotonic() > end:
                last = f'; the last status: {self.verdicts[-1]}' if self.verdicts else ''
                raise HmsaError(f'waited {patience:g} s for {what}{last}')
            self._executor.spin_once(timeout_sec=_SLICE)

    def spin(self, seconds: float) -> None:
        """Serve callbacks for a period of wall time."""
        end = monotonic() + seconds
        self.spin_until(lambda: monotonic() >= end, 'the time to pass', seconds + 1.0)

    def let_pass(self, seconds: float, patience: float = PATIENCE) -> None:
        """Serve callbacks until the plant's samples have advanced by ``seconds``."""
        end = self.time + round(seconds * NANOSECONDS)
        self.spin_until(lambda: self.time >= end, f'{seconds:g} s of the plant', patience)

    def setpoint(self, stretch: float) -> dict[str, str]:
        """Request a stretch and wait for the verdict."""
        return self.ask(lambda: self.publish_setpoint(stretch))

    def publish_setpoint(self, stretch: float) -> None:
        """Request a stretch without waiting."""
        self._setpoint.publish(Float64(data=float(stretch)))

    def publish_trajectory(self, message: Any) -> None:
        """Send a sequence without waiting."""
        self._trajectory.publish(message)

    def sequence(self, setpoints: Sequence[tuple[float, float]]) -> dict[str, str]:
        """Send a sequence that starts now and wait for the verdict."""
        ends = np.cumsum([x for _, x in setpoints])
        message = to_trajectory(
            [(x, round(end * NANOSECONDS))
             for (x, _), end in zip(setpoints, ends, strict=True)], 'actuator')
        return self.ask(lambda: self.publish_trajectory(message))

    def ask(self, send: Callable[[], None]) -> dict[str, str]:
        """Send a request and wait for the planner's next verdict."""
        self.spin_until(self._setpoint.get_subscription_count, 'a planner that listens')
        before = len(self.verdicts)
        send()
        self.spin_until(lambda: len(self.verdicts) > before, 'a verdict')
        return self.verdicts[-1]

    def call(self, service: topics.Service, owner: str, request: Any = None) -> Any:
        """Call a service of a node."""
        return self.call_by_name(
            ros_entities.interface_class(service.type),
            topics.from_outside(service.name, owner), request)

    def call_by_name(self, kind: type[Any], name: str, request: Any = None) -> Any:
        """Call a service by its name."""
        client = self._clients.get(name)
        if client is None:
            client = self._clients[name] = self.node.create_client(kind, name)
            self.spin_until(client.service_is_ready, f'service {name}')
            # A ready client may be unknown to the server, whose response would then be lost.
            self.spin(_ACQUAINTANCE)
        self.spin_until(client.service_is_ready, f'service {name}')
        future = client.call_async(kind.Request() if request is None else request)
        self.spin_until(future.done, f'the answer of {name}')
        return future.result()

    def set_parameters(self, owner: str, **values: object) -> list[str]:
        """Set parameters individually, ``__`` for a dot; return the reasons of rejections."""
        from rcl_interfaces.srv import SetParameters

        response = self.call_by_name(SetParameters, f'{owner}/set_parameters', (
            SetParameters.Request(parameters=[
                Parameter(name.replace('__', '.'), value=value).to_parameter_msg()
                for name, value in values.items()])))
        return [x.reason or 'no reason' for x in response.results if not x.successful]


def _plain(status: DiagnosticStatus) -> dict[str, str]:
    """Return a status as plain text by key."""
    return {**{x.key: x.value for x in status.values}, 'level': str(status.level[0]),
            'message': status.message}


@contextmanager
def hushed(log: Path) -> Iterator[TextIO]:
    """
    Redirect the middleware's standard error to a file; yield the original stream.

    The middleware complains there of every broken message that this process sends or receives.
    """
    sys.stderr.flush()
    with open(os.dup(2), 'w', encoding='utf-8') as before, open(log, 'ab') as file:
        os.dup2(file.fileno(), 2)
        try:
            yield before
        finally:
            sys.stderr.flush()
            before.flush()
            os.dup2(before.fileno(), 2)


def settled(
        stamps: np.ndarray, values: np.ndarray, applied: Sequence[tuple[int, float]],
        target: float, step: float) -> tuple[float, float]:
    """
    Measure the residual of a move after the last change of the flux density in force.

    Parameters
    ----------
    stamps, values : ndarray, shape (n,) and (n, 3)
        Samples from before the move until long after it, timestamped in ns.
    applied : sequence of (int, float)
        Changes reported by the plant: timestamp in ns and level. Samples do not show a level
        that is superseded within a sample.
    target : float
        Requested stretch.
    step : float
        Requested difference of stretch.

    Returns
    -------
    residual : float
        Peak-to-peak stretch since the last change, as a fraction of the step.
    error : float
        Distance of the last sample from the target, as a fraction of the step.

    Raises
    ------
    HmsaError
        If there are too few samples since.

    """
    last = max((stamp for stamp, _ in applied if stamp <= stamps[-1]), default=0)
    rest = values[stamps > last, 0]
    if rest.size < 10:
        raise HmsaError(f'{rest.size} samples since the last change: expected some more')
    return float(np.ptp(rest)) / abs(step), abs(float(rest[-1]) - target) / abs(step)
