"""
Shared fixtures: a separate ROS domain for each test, processes, and waiting on a condition.

Tests without these fixtures need no ROS.
"""

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
import fcntl
import gc
import itertools
import os
from pathlib import Path
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any, ClassVar

from extras import has, needs
from forks import Forked, ForkServer
from hypothesis import HealthCheck, Phase, settings
import pytest

from hmsa.cli import main, terminal
from hmsa.interfaces.topics import CLOCK_TOPIC, Topic
from hmsa_ros.middleware import fast_dds, PROFILES, profiles

ROOT = Path(__file__).resolve().parent.parent
# Limit of every wait: generous, since only failing tests reach it.
WAIT_SECONDS = 60.0
POLL_SECONDS = 0.02
# Interval of checks of a condition while callbacks are served.
SPIN_SECONDS = 0.01
DOMAINS = range(1, 102)
ROS_PACKAGE = re.compile(r'rclpy|\w+_(msgs|interfaces|srvs)')
_turns = itertools.count(os.getpid())


class SkipWithoutRos:
    """Skips what needs ROS where there is none: a module of tests, or a test."""

    @staticmethod
    def find_spec(name: str, *_: Any) -> None:
        """Skip if a package that no other finder has found is one of ROS."""
        if ROS_PACKAGE.fullmatch(name):
            pytest.skip("rclpy is not installed: pip install '.[ros]'", allow_module_level=True)

    @classmethod
    def install(cls) -> None:
        """Skip by what is imported, and by messages whose definitions are looked for."""
        from hmsa.bag import definitions
        find = definitions._find

        def find_or_skip(type_name: str, suffix: str) -> Path | None:
            return find(type_name, suffix) or cls.find_spec(type_name.partition('/')[0])

        definitions._find = find_or_skip
        sys.meta_path.append(cls)


def pytest_configure(config: pytest.Config) -> None:
    """Ignore warnings that cannot be fixed here, and start processes alike."""
    # As `hmsa` does, before NumPy is imported.
    os.environ.setdefault('OMP_NUM_THREADS', '1')
    # What a command prints must not depend on how busy the machine is.
    terminal.PATIENCE = 1e6
    if not has('rclpy'):
        SkipWithoutRos.install()
    for number in (signal.SIGINT, signal.SIGHUP):
        # As nohup and the background of a shell leave them. Processes inherit what is ignored,
        # not what is handled.
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)
    for warning in (
            'ignore:module .sre_:DeprecationWarning',  # lark, imported by rosidl_parser
            # A client that has gone, or that the server has not discovered yet and that retries.
            'ignore:failed to send response:RuntimeWarning',
            # On Python 3.14 hypothesis does not find what holds its generator: it is exempt from
            # garbage collection (below).
            'ignore:It looks like .register_random.:hypothesis.errors.HypothesisWarning',
    ):
        config.addinivalue_line('filterwarnings', warning)
    # The gate uses the same examples in each run, so that a failure is due to the change;
    # `make full` draws new ones.
    for name, same in (('gate', True), ('full', False)):
        settings.register_profile(
            name, derandomize=same,
            # A deadline for an example would measure the speed of this machine.
            deadline=None, suppress_health_check=[HealthCheck.too_slow],
            # Explaining an example traces the lines of Python: integrations then take minutes.
            phases=[x for x in Phase if x is not Phase.explain])
    profile = config.getoption('--hypothesis-profile') or 'gate'
    settings.load_profile(profile)
    if profile == 'gate':
        leave_out_constants()


def leave_out_constants() -> None:
    """
    Keep constants in the modules that a worker happens to have imported out of its examples.

    Each worker would parse all of them: 2.4 s of processor time.
    """
    try:  # no setting does it; with a version that has neither of them, it takes that time
        from hypothesis.internal.conjecture import providers
        from hypothesis.internal.constants_ast import Constants
    except ImportError:
        return
    if hasattr(providers, '_get_local_constants'):
        providers._get_local_constants = Constants


def pytest_report_header() -> str | None:
    """Say so where bags are not compared with an independent reader after each test."""
    return None if has('rosbags') else 'rosbags is not installed: bags are NOT compared with it'


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
        item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Show the output of the processes of a failed test."""
    report = yield
    starter = getattr(item, 'funcargs', {}).get('start')
    if report.failed and isinstance(starter, Starter):
        report.sections += [
            (f'{" ".join(map(str, x.popen.args))}: {x.popen.poll()}', x.output)
            for x in starter.processes]
    return report


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return five workers for two cores, since a test with nodes mostly waits for them."""
    return 5 * (os.cpu_count() or 1) // 2


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
        collector: pytest.Collector
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Let each worker begin with other modules, so that each is compiled only once."""
    report = yield
    worker = os.environ.get('PYTEST_XDIST_WORKER', 'gw0')
    if isinstance(collector, pytest.Directory):
        count = int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
        first = len(report.result) * int(worker[2:]) // count
        report.result = report.result[first:] + report.result[:first]
    return report


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Disable garbage collection during collection, and exempt its objects from later ones."""
    gc.disable()
    result = yield
    gc.enable()
    gc.freeze()
    return result


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """
    Assign tests to workers in groups: a test that runs nodes, or all others of a module.

    Long tests begin first. The others alternate, so that computations run while nodes are waited
    for. Short tests with nodes come last.
    """
    items.sort(key=lambda item: item.path)
    for item in items:
        if 'ros_domain_id' in getattr(item, 'fixturenames', ()):
            item.add_marker(pytest.mark.ros)
        if item.get_closest_marker('ros') or item.get_closest_marker('xdist_group'):
            continue
        item.add_marker(pytest.mark.xdist_group(item.path.stem))
    if 'PYTEST_XDIST_WORKER' in os.environ:
        with_nodes = [x for x in items if x.get_closest_marker('ros')]
        modules = list(dict.fromkeys(x.path for x in items if not x.get_closest_marker('ros')))
        place = {x: i / len(with_nodes) for i, x in enumerate(with_nodes)} | {
            x: 0.9 * i / len(modules) for i, x in enumerate(modules)}
        items.sort(key=lambda item: (
            not any(item.get_closest_marker(x) for x in ('long', 'slow', 'thorough')),
            place.get(item, place.get(item.path, 0.0))))


def bound(kind: Any, name: str = '', qos: Any = None) -> tuple[Any, str, Any]:
    """Return message class, name and profile, from rclpy objects or those of `hmsa.interfaces`."""
    from hmsa_ros.nodes import ros_entities
    from hmsa_ros.nodes.ros_entities import interface_class
    if isinstance(kind, Topic):
        kind, name, qos = kind.type, name or kind.name, qos or kind.qos
    qos = 1000 if qos is None else qos
    return (interface_class(kind) if isinstance(kind, str) else kind, name,
            ros_entities.profile(qos) if isinstance(qos, ros_entities.Quality) else qos)


def wait_until(
        condition: Callable[[], Any], what: str = 'the condition',
        seconds: float = WAIT_SECONDS) -> Any:
    """Wait until a condition is true, and return its value."""
    end = time.monotonic() + seconds
    while not (result := condition()):
        if time.monotonic() > end:
            pytest.fail(f'waited {seconds:g} s for {what}')
        time.sleep(POLL_SECONDS)
    return result


def without_progress(told: str) -> str:
    """Return what a command told, except that it was at work, as it says on a busy machine."""
    return re.sub(r'^.* \.\.\.\n', '', told, flags=re.M)


@pytest.fixture(autouse=True)
def bags_are_whole_for_rosbags(request: pytest.FixtureRequest) -> Iterator[None]:
    """Compare every complete bag of a test with rosbags, which drops topics silently."""
    folder = None
    if 'tmp_path' in request.fixturenames and has('rosbags'):
        folder = request.getfixturevalue('tmp_path')
    yield
    if folder is not None:
        from bags import hold_against_rosbags
        hold_against_rosbags(folder)


@pytest.fixture(name='wait_until')
def wait_until_fixture() -> Callable[..., Any]:
    """Return `wait_until`, for test modules that cannot import this one."""
    return wait_until


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs ``hmsa`` with a line and more words: status and both outputs."""
    def run(line: str, *words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            status = main([*shlex.split(line), *map(str, words)])
        except SystemExit as end:
            status = end.code
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def refusal(command: Callable[..., tuple[int, str, str]]) -> Callable[..., str]:
    """Return a function that expects bad input of ``hmsa``, and returns the one line about it."""
    def refused(line: str, *words: object) -> str:
        status, out, err = command(line, *words)
        assert (status, out) == (2, '')
        assert re.fullmatch(r'hmsa: error: [^\n]+\n', err)
        return err

    return refused


@contextmanager
def own_domain() -> Iterator[int]:
    """Reserve a domain id that nobody else on this machine uses."""
    folder = Path(tempfile.gettempdir()) / f'hmsa_ros_domains_{os.getuid()}'
    folder.mkdir(exist_ok=True)
    # In sequence, so that late packets of an ended test have no receiver; starting at a random
    # id, so that simultaneous sessions rarely try the same ones.
    first = next(_turns)
    for i in range(len(DOMAINS)):
        domain = DOMAINS[(first + i) % len(DOMAINS)]
        with (folder / str(domain)).open('w') as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Nodes that no test started: the port on which the first one of DDS listens.
                with socket.socket(type=socket.SOCK_DGRAM) as probe:
                    probe.bind(('', 7410 + 250 * domain))
            except OSError:
                continue
            yield domain
            return
    pytest.fail('all ROS domain ids are taken')


@pytest.fixture(name='own_domain', scope='session')
def own_domain_fixture() -> Callable[[], AbstractContextManager[int]]:
    """Return `own_domain`, for tests that need several domains at once."""
    return own_domain


@pytest.fixture
def ros_domain_id() -> Iterator[int]:
    """Return a domain id that no other test on this machine uses at the same time."""
    needs('rclpy')
    with own_domain() as domain:
        # Existing objects stay; only those of the test are searched for garbage at its end.
        gc.freeze()
        yield domain
        # Destroyed nodes stay in the domain until Python has collected them, and would be
        # discovered by the next test in it.
        gc.collect()


def own_profiles() -> dict[str, str]:
    """Return the environment that selects this package's profiles for nodes of this host."""
    return {**dict.fromkeys(PROFILES, ''), PROFILES[fast_dds() - 2]: str(
        profiles(fast_dds(), local=True))}


@pytest.fixture
def ros_env(
        ros_domain_id: int, tmp_path_factory: pytest.TempPathFactory,
        monkeypatch: pytest.MonkeyPatch) -> Mapping[str, str]:
    """Return the environment of ROS processes, which is also set in this process."""
    settings = {
        'ROS_DOMAIN_ID': str(ros_domain_id),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        # Messages lost before discovery are sent again at once, also by the test's nodes.
        **own_profiles(),
        'ROS_LOG_DIR': str(tmp_path_factory.mktemp('ros_log')),
        'PYTHONPATH': os.pathsep.join(
            [str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])]),
        'PYTHONUNBUFFERED': '1',
        'RCUTILS_COLORIZED_OUTPUT': '0',
    }
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    return dict(os.environ)


@dataclass
class Process:
    """
    A running child process whose output is written to files.

    Attributes
    ----------
    popen : subprocess.Popen or forks.Forked
        The process.
    stdout_path, stderr_path : pathlib.Path
        Files of its output.

    """

    popen: 'subprocess.Popen[bytes] | Forked'
    stdout_path: Path
    stderr_path: Path

    @property
    def stdout(self) -> str:
        """Return its standard output so far."""
        return self.stdout_path.read_text(errors='replace')

    @property
    def stderr(self) -> str:
        """Return its standard error so far."""
        return self.stderr_path.read_text(errors='replace')

    @property
    def output(self) -> str:
        """Return both outputs so far."""
        return self.stdout + self.stderr

    def alive(self) -> bool:
        """Return whether it is still running."""
        return self.popen.poll() is None

    def wait(self, seconds: float = WAIT_SECONDS) -> int:
        """Wait for its end, with a time limit; return the status, negative for a signal."""
        try:
            return self.popen.wait(seconds)
        except subprocess.TimeoutExpired:
            pytest.fail(f'{self.popen.args!r} did not end within {seconds:g} s: {self.output}')

    def stop(self, number: int = signal.SIGINT, seconds: float = WAIT_SECONDS) -> int:
        """Send a signal, and wait for the end."""
        self.popen.send_signal(number)
        return self.wait(seconds)

    def wait_for_output(self, text: str, seconds: float = WAIT_SECONDS) -> str:
        """Wait until the process has printed a text on either output; return both outputs."""
        def found() -> bool:
            if text in self.output:
                return True
            if not self.alive() and text not in self.output:
                pytest.fail(
                    f'ended with {self.popen.returncode} before {text!r}: {self.output}')
            return False

        wait_until(found, f'{text!r} in the output of {self.popen.args!r}', seconds)
        return self.output


@dataclass
class Starter:
    """Starts child processes, and ends those still running after the test."""

    env: Mapping[str, str]
    folder: Path
    fork_server: Callable[[Mapping[str, str]], ForkServer]
    processes: list[Process] = field(default_factory=list)

    def __call__(self, *command: str | os.PathLike[str], **extra_env: str) -> Process:
        """Start a command."""
        number = len(self.processes)
        stdout_path = self.folder / f'{number}.out'
        stderr_path = self.folder / f'{number}.err'
        words, env = [os.fspath(x) for x in command], {**self.env, **extra_env}
        with stdout_path.open('wb') as stdout, stderr_path.open('wb') as stderr:
            if (words[:3] == [sys.executable, '-m', 'hmsa_ros']
                    and (server := self.fork_server(self.env)).suits(words[3:], env)):
                popen = server.start(words[3:], env, stdout_path, stderr_path)
            else:
                popen = subprocess.Popen(
                    words, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr, env=env)
        process = Process(popen, stdout_path, stderr_path)
        self.processes.append(process)
        return process

    def python(self, *arguments: str | os.PathLike[str], **extra_env: str) -> Process:
        """Start this Python."""
        return self(sys.executable, *arguments, **extra_env)

    def hmsa(self, *arguments: str | os.PathLike[str], **extra_env: str) -> Process:
        """Start ``hmsa`` with arguments."""
        return self.python('-m', 'hmsa_ros', *arguments, **extra_env)

    def stop_all(self) -> None:
        """End every running process, by force if needed."""
        for process in self.processes:
            if process.alive():
                process.popen.terminate()
        for process in self.processes:
            try:
                process.popen.wait(10.0)
            except subprocess.TimeoutExpired:
                process.popen.kill()
                process.popen.wait()


@pytest.fixture
def handlers() -> Iterator[None]:
    """Restore the signal handlers that a node replaces."""
    kept = {x: signal.getsignal(x) for x in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


@pytest.fixture(scope='session')
def fork_server() -> Iterator[Callable[[Mapping[str, str]], ForkServer]]:
    """Return a function that returns the server, which all workers use."""
    servers: list[ForkServer] = []

    def server(env: Mapping[str, str]) -> ForkServer:
        if not servers:
            servers.append(ForkServer(env))
        return servers[0]

    yield server
    for each in servers:
        each.close()


@pytest.fixture
def start(
        ros_env: Mapping[str, str], fork_server: Callable[[Mapping[str, str]], ForkServer],
        tmp_path_factory: pytest.TempPathFactory) -> Iterator[Starter]:
    """Return a starter of child processes in the test's ROS domain."""
    starter = Starter(ros_env, tmp_path_factory.mktemp('processes'), fork_server)
    yield starter
    starter.stop_all()


class RosSide:
    """
    The test's own node: publishes, subscribes, calls services, spins on demand.

    Attributes
    ----------
    node : rclpy.node.Node
        The node.
    executor : rclpy.executors.Executor
        Serves the node, only while one of the methods below waits.

    """

    def __init__(self, domain_id: int, **node_options: Any) -> None:
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from rclpy.parameter import Parameter
        self.context = Context()
        self.context.init(args=[], domain_id=domain_id)
        # Nobody asks it for parameters or types, and others need not discover these services.
        self.node = Node('test', context=self.context, **{
            'start_parameter_services': False, 'parameter_overrides': [
                Parameter('start_type_description_service', value=False)], **node_options})
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def close(self) -> None:
        """Destroy the node and its context."""
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()
        del self.executor, self.node, self.context

    def spin_until(
            self, condition: Callable[[], Any], what: str = 'the condition',
            seconds: float = WAIT_SECONDS) -> Any:
        """Serve callbacks until a condition is true, and return its value."""
        end = time.monotonic() + seconds
        while not (result := condition()):
            if time.monotonic() > end:
                pytest.fail(f'waited {seconds:g} s for {what}')
            self.executor.spin_once(SPIN_SECONDS)
        return result

    def ask(self, publisher: Any, status: list[Any], stretch: float, *expected: str) -> None:
        """Publish a setpoint repeatedly until a status with an expected value arrives."""
        from std_msgs.msg import Float64
        begin = len(status)
        again = self.node.create_timer(0.5, lambda: publisher.publish(Float64(data=stretch)))
        self.spin_until(lambda: any(
            x.value in expected for y in status[begin:] for x in y.values), str(expected))
        again.cancel()

    def collect(
            self, kind: type[Any] | str | Topic, topic: str = '', qos: Any = None) -> list[Any]:
        """
        Subscribe to a type, or a topic of `hmsa.interfaces`; return the list of what comes.

        Nodes of `Served` have discovered the subscription then, so that every later message
        arrives.
        """
        message_type, topic, qos = bound(kind, topic, qos)
        messages: list[Any] = []
        before = {x: x.get_subscription_count() for x in Served.publishers()}
        name = self.node.create_subscription(
            message_type, topic, messages.append, qos).topic_name
        self.spin_until(
            lambda: all(x.get_subscription_count() > count for x, count in before.items()
                        if x.topic_name == name), f'the publishers of {name}')
        return messages

    def publisher(
            self, kind: type[Any] | str | Topic, topic: str = '', qos: Any = None,
            subscribers: int = 1) -> Any:
        """
        Return a publisher with a number of matched subscribers.

        Nodes of `Served` have discovered the publisher then, so that its messages arrive.
        """
        message_type, topic, qos = bound(kind, topic, qos)
        before = {x: x.get_publisher_count() for x in Served.subscriptions()}
        publisher = self.node.create_publisher(message_type, topic, qos)
        self.spin_until(
            lambda: publisher.get_subscription_count() >= subscribers
            and all(x.get_publisher_count() > count for x, count in before.items()
                    if x.topic_name == publisher.topic_name),
            f'{subscribers} subscribers of {topic}')
        return publisher

    def call(self, service_type: type[Any] | str, name: str, request: Any = None) -> Any:
        """Call a service once its nodes have discovered the client; return its response."""
        from hmsa_ros.nodes.temporary_node import ServiceCall
        service_type, *_ = bound(service_type)
        full = self.node.resolve_service_name(name)
        before = {x: x.count_clients(full) for x in Served.views()}
        call = ServiceCall(
            self.node, service_type, name,
            service_type.Request() if request is None else request, timeout=10.0)
        self.spin_until(
            lambda: call.ready and all(x.count_clients(full) > n for x, n in before.items()),
            f'service {name}')
        response = self.spin_until(call.answer, f'the answer of {name}')
        call.close()
        self.spin_until(
            lambda: all(x.count_clients(full) <= n for x, n in before.items()),
            f'the end of the client of {name}')
        return response

    def change(self, node: str, *transitions: str) -> bool:
        """Have a node make transitions, and return whether it has made all of them."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState
        return all(self.call(
            ChangeState, f'{node}/change_state', ChangeState.Request(
                transition=Transition(label=x))).success for x in transitions)

    def set_parameters(self, node: str, values: Sequence[Any]) -> Any:
        """Set parameters of another node."""
        from rcl_interfaces.srv import SetParameters
        request = SetParameters.Request(
            parameters=[value.to_parameter_msg() for value in values])
        return self.call(SetParameters, f'{node}/set_parameters', request).results


@pytest.fixture
def ros(ros_env: Mapping[str, str], ros_domain_id: int) -> Iterator[RosSide]:
    """Return the test's own ROS node in the test's domain."""
    side = RosSide(ros_domain_id)
    yield side
    side.close()


@pytest.fixture
def make_ros(
        ros_env: Mapping[str, str],
        ros_domain_id: int) -> Iterator[Callable[..., RosSide]]:
    """Return a factory of further test nodes in the test's domain, with node options."""
    sides: list[RosSide] = []

    def make(**node_options: Any) -> RosSide:
        sides.append(RosSide(ros_domain_id, **node_options))
        return sides[-1]

    yield make
    for side in sides:
        side.close()


class Served:
    """
    Nodes of this package that run in a thread of this process, as in their own processes.

    They use rclpy's default context, apart from the test's own node.

    Attributes
    ----------
    nodes : list of rclpy.node.Node
        The nodes.
    running : list of Served
        All instances that are not closed yet.

    """

    running: ClassVar[list['Served']] = []

    def __init__(
            self, domain_id: int, factories: Sequence[Callable[[], Any]],
            arguments: Sequence[str]) -> None:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
        rclpy.init(
            args=['test', *(['--ros-args', *arguments] if arguments else [])],
            domain_id=domain_id, signal_handler_options=SignalHandlerOptions.NO)
        self.nodes: list[Any] = []
        self._threads: list[threading.Thread] = []
        self._failures: list[BaseException] = []
        self._ending = False
        Served.running.append(self)
        try:
            for factory in factories:
                self.nodes.append(factory())
        except BaseException:
            self.close()
            raise
        for node in self.nodes:
            self._threads.append(threading.Thread(target=self._run, args=(node,)))
            self._threads[-1].start()

    def _run(self, node: Any) -> None:
        from hmsa_ros.nodes.managed import spin
        try:
            spin((node,), lambda: self._ending)
        except BaseException as error:  # any error would have ended the process
            self._failures.append(error)

    @classmethod
    def publishers(cls) -> list[Any]:
        """Return the publishers of all running nodes."""
        return [x for served in cls.running for node in served.nodes for x in node.publishers]

    @classmethod
    def subscriptions(cls) -> list[Any]:
        """Return the subscriptions of all running nodes."""
        return [x for served in cls.running for node in served.nodes for x in node.subscriptions]

    @classmethod
    def views(cls) -> list[Any]:
        """Return one node of each running context, whose nodes share a graph."""
        return [served.nodes[0] for served in cls.running]

    def now(self) -> int:
        """Return the time in ns on the clock of the first node."""
        return int(self.nodes[0].get_clock().now().nanoseconds)

    def close(self) -> None:
        """End the nodes, and raise the failure of any of them."""
        import rclpy
        Served.running.remove(self)
        self._ending = True
        for thread in self._threads:
            thread.join(WAIT_SECONDS)
        for node in self.nodes:
            getattr(node, 'close', lambda: None)()
            node.destroy_node()
        self.nodes.clear()
        rclpy.try_shutdown()
        if self._failures:
            raise self._failures[0]


@pytest.fixture
def serve(
        ros_env: Mapping[str, str], ros_domain_id: int) -> Iterator[Callable[..., Served]]:
    """Return a starter, once a test, of nodes in threads: ``serve(PlantNode, '-p', ...)``."""
    running: list[Served] = []

    def serve_nodes(*arguments: Any) -> Served:
        factories = [x for x in arguments if not isinstance(x, str)]
        running.append(Served(
            ros_domain_id, factories, [x for x in arguments if isinstance(x, str)]))
        return running[-1]

    yield serve_nodes
    for served in running:
        served.close()


class SimulatedClock:
    """
    Simulated time published by the test.

    Parameters
    ----------
    side : RosSide
        Publishes /clock.
    served : Served
        Nodes that follow it.

    """

    def __init__(self, side: RosSide, served: Served) -> None:
        self._side = side
        self._served = served
        self._publisher = side.publisher(CLOCK_TOPIC, subscribers=len(served.nodes))

    def set(self, time_ns: int) -> None:
        """Set the time in ns, perhaps back, and return when all nodes have received it."""
        from builtin_interfaces.msg import Time
        from rosgraph_msgs.msg import Clock
        seconds, nanoseconds = divmod(time_ns, 10**9)
        message = Clock(clock=Time(sec=seconds, nanosec=nanoseconds))
        ends = [0.0]

        def there() -> bool:
            if all(x.get_clock().now().nanoseconds == time_ns for x in self._served.nodes):
                return True
            # Best effort, so a lost message is sent again.
            if time.monotonic() > ends[0]:
                self._publisher.publish(message)
                ends[0] = time.monotonic() + 0.1
            return False

        self._side.spin_until(there, f'{time_ns} ns on the clocks')


@pytest.fixture
def make_clock() -> Callable[[RosSide, Served], SimulatedClock]:
    """Return a factory of `SimulatedClock`."""
    return SimulatedClock
