"""
Processes of ``hmsa`` forked from one that has imported everything.

Most of the time of a process that a test starts is its imports. The rest is as in a new process:
arguments, environment, working directory, streams, signals and the end.
"""

from collections.abc import Mapping, Sequence
import gc
import json
import os
from pathlib import Path
import select
import signal
import socket
import subprocess
import sys
import time
from typing import Any

from hmsa import plugins
from hmsa.plugins import NODES, registered
from hmsa_ros.middleware import fast_dds

ROOT = Path(__file__).resolve().parent.parent
# Those that start no processes: a demo in a fork, interrupted, ends with a segmentation fault.
COMMANDS = (*registered(NODES), 'send', 'stop', 'interlock', 'param', 'watch')
# With Fast DDS 3 a fork that has two contexts ends with a segmentation fault.
SAFE = fast_dds() == 2
# Variables that a process reads while it starts and imports: with others it is no fork.
EARLY = ('PYTHON', 'LC_', 'LANG', 'LD_', 'OMP_')
# A fork can look for modules in further places.
PATH = 'PYTHONPATH'


class Forked:
    """A process with the part of `subprocess.Popen` that tests use."""

    def __init__(self, server: 'ForkServer', args: Sequence[str], pid: int) -> None:
        self.args, self.pid, self.returncode = args, pid, None
        self._server, self._end = server, os.pidfd_open(pid)

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit status as `subprocess.Popen.wait` does."""
        if self.returncode is None:
            end = select.poll()
            end.register(self._end, select.POLLIN)
            if not end.poll(None if timeout is None else 1e3 * timeout):
                raise subprocess.TimeoutExpired(self.args, timeout)
            self.returncode = self._server.ask(reap=self.pid)
            os.close(self._end)
        return self.returncode

    def poll(self) -> int | None:
        """Return the exit status if it has ended."""
        try:
            return self.wait(0.0)
        except subprocess.TimeoutExpired:
            return None

    def send_signal(self, number: int) -> None:
        """Send a signal unless it has ended."""
        if self.poll() is None:
            signal.pidfd_send_signal(self._end, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


class ForkServer:
    """
    The process that forks others: it has imported nodes, commands and message types.

    The first worker that needs it starts it for all of them; it ends with the last one.
    """

    def __init__(self, env: Mapping[str, str]) -> None:
        self._env = dict(env)
        self._process: subprocess.Popen[bytes] | None = None
        # In no file system.
        address = '\0hmsa_forks_' + os.environ.get('PYTEST_XDIST_TESTRUNUID', str(os.getpid()))
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as its:
            try:
                its.bind(address)
            except OSError:
                pass  # of another worker
            else:
                its.listen()
                self._process = subprocess.Popen(
                    [sys.executable, __file__, str(its.fileno())], env=self._env,
                    pass_fds=[its.fileno()], cwd=ROOT)
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        while self._line.connect_ex(address):
            time.sleep(0.01)  # until the other worker listens

    def ask(self, **request: Any) -> int:
        """Return the answer to a request."""
        self._line.send(json.dumps(request).encode())
        return int(self._line.recv(100))

    def suits(self, arguments: Sequence[str], env: Mapping[str, str]) -> bool:
        """Return whether a process with arguments and an environment may be a fork."""
        if not arguments or arguments[0] not in COMMANDS or not SAFE:
            return False
        names = {x for x in {*env, *self._env} if x.startswith(EARLY)} - {PATH}
        return all(env.get(x) == self._env.get(x) for x in names)

    def start(
            self, arguments: Sequence[str], env: Mapping[str, str], stdout: Path,
            stderr: Path) -> Forked:
        """Start ``hmsa`` with arguments, without input."""
        return Forked(self, ('hmsa', *arguments), self.ask(
            arguments=arguments, env=dict(env), folder=os.getcwd(), stdout=str(stdout),
            stderr=str(stderr)))

    def close(self) -> None:
        """End it; processes that it has started go on."""
        self._line.close()
        if self._process is not None:
            self._process.wait()


def become(
        arguments: Sequence[str], env: Mapping[str, str], folder: str, stdout: str,
        stderr: str) -> None:
    """Take on what distinguishes one process from another."""
    os.environ.clear()
    os.environ.update(env)
    os.chdir(folder)
    further = env.get(PATH, '').split(os.pathsep)
    sys.path[:1] = [folder, *(x for x in further if x and x not in sys.path)]
    sys.argv[1:] = arguments
    for number, (path, flags) in enumerate((
            (os.devnull, os.O_RDONLY), (stdout, os.O_WRONLY), (stderr, os.O_WRONLY))):
        file = os.open(path, flags)
        os.dup2(file, number)
        os.close(file)


def serve(its: socket.socket) -> None:
    """Fork a process or reap one at each request, and end after the last; return in each fork."""
    lines = [its.accept()[0]]
    while lines:
        line = select.select([its, *lines], [], [])[0][0]
        if line is its:
            lines.append(its.accept()[0])
        elif text := line.recv(2**20):
            request = json.loads(text)
            if 'reap' in request:
                answer = os.waitstatus_to_exitcode(os.waitpid(request['reap'], 0)[1])
            elif not (answer := os.fork()):
                for each in (its, *lines):
                    each.close()
                become(**request)
                return
            line.send(str(answer).encode())
        else:
            lines.remove(line)
            line.close()
    # Without the cleaning up of what was only imported.
    os._exit(0)


if __name__ == '__main__':
    from rclpy.type_support import check_for_type_support

    from hmsa.entry import main
    from hmsa.interfaces import topics
    from hmsa_ros.nodes.ros_entities import interface_class

    for group in (NODES, plugins.COMMANDS):
        for entry in registered(group).values():
            if not entry.value.startswith('hmsa_studies'):
                entry.load()
    for interface in vars(topics).values():
        if isinstance(interface, topics.Topic | topics.Service):
            check_for_type_support(interface_class(interface.type))
    gc.freeze()
    serve(socket.socket(fileno=int(sys.argv[1])))
    sys.exit(main())
