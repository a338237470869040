"""Node processes: started together, ended in order, never left behind."""

from collections.abc import Mapping
import ctypes
from dataclasses import dataclass
from datetime import datetime
import os
from pathlib import Path
import signal
import subprocess
import sys

from hmsa_ros.errors import HmsaError
from hmsa_ros.files import yaml_text
from hmsa_ros.interfaces.topics import RECORDER
from hmsa_ros.middleware import RANGE

_PR_SET_PDEATHSIG = 1
# Long enough for a recorder to write what it holds on a slow disk.
_PATIENCE_SECONDS = 15.0


@dataclass(frozen=True)
class NodeProcess:
    """A node to start: a ``hmsa`` command, or the executable of another package."""

    name: str
    parameters: Mapping[str, object]
    namespace: str = ''
    params_file: str = ''
    log_level: str = ''
    options: tuple[str, ...] = ()

    def ros_arguments(self) -> list[str]:
        """Return what follows ``--ros-args``; parameters take precedence over the file."""
        words = []
        if self.namespace:
            words += ['-r', f'__ns:=/{self.namespace.lstrip("/")}']
        if self.log_level:
            words += ['--log-level', self.log_level]
        if self.params_file:
            words += ['--params-file', self.params_file]
        for key, value in self.parameters.items():
            words += ['-p', f'{key}:={yaml_text(value)}']
        return words

    def command(self) -> list[str]:
        """Return the command line, with this Python."""
        return [sys.executable, '-m', 'hmsa_ros', self.name, *self.options, '--ros-args',
                *self.ros_arguments()]


class Session:
    """
    Node processes, each with its log in a folder; a context manager that ends them.

    Their environment is that of this process, which must live in the same ROS domain.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> 'Session':
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, node: NodeProcess) -> None:
        """Start a node whose name is not in use yet."""
        with open(self.log(node.name), 'wb') as log:
            # A session of its own: Ctrl-C in the terminal reaches only us, and we end the
            # nodes in order. Should we be killed, the kernel ends them.
            self._processes[node.name] = subprocess.Popen(
                node.command(), stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True,
                preexec_fn=_die_with_parent)  # noqa: PLW1509 - only calls the kernel

    def log(self, name: str) -> Path:
        """Return the file of a node's output, in the session's folder."""
        return self._folder / f'{name}.log'

    def check(self) -> None:
        """
        Make sure that all started nodes run.

        Raises
        ------
        HmsaError
            If one has ended; with its last words.

        """
        for name, process in self._processes.items():
            if process.poll() is not None:
                raise HmsaError(
                    f'the {name} ended early with status {process.returncode}: '
                    f'{self.last_words(name)}')

    def last_words(self, name: str) -> str:
        """Return the last line of a node's log with the log's place."""
        lines = self.log(name).read_text(errors='replace').strip().splitlines()
        return f'{lines[-1] if lines else "it printed nothing"} (log: {self.log(name)})'

    def stop(self) -> dict[str, int]:
        """End the recorder, then all other nodes together; return exit status by node."""
        names = sorted(self._processes, key=lambda x: x != RECORDER)
        first = [x for x in names if x == RECORDER]
        for group in (first, names[len(first):]):
            processes = [self._processes[x] for x in group]
            for process in processes:
                if process.poll() is None:
                    process.send_signal(signal.SIGINT)
            for process in processes:
                try:
                    process.wait(_PATIENCE_SECONDS)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
        return {name: self._processes[name].returncode for name in names}


def _die_with_parent() -> None:
    """Ask the kernel to interrupt this process when its parent is gone."""
    # The shell of a background job may have told its children to ignore SIGINT.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGINT)


def stay_local() -> None:
    """Have this process and its nodes talk to this host only; before anything of ROS is there."""
    # The ROS domain is the caller's where ROS_DOMAIN_ID is set, and otherwise one that other runs
    # on this host are unlikely to use.
    os.environ[RANGE] = 'LOCALHOST'
    # Domains above 101 collide with the ephemeral ports of Linux.
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 101))


def dated(base: Path | str) -> Path:
    """Return a folder in another one, named by date and time."""
    return Path(base) / datetime.now().strftime('%Y-%m-%d_%H-%M-%S')
