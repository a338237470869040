"""Node processes that are started together and ended in order."""

from collections.abc import Mapping
import ctypes
from dataclasses import dataclass
from datetime import datetime
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys

from hmsa.errors import HmsaError
from hmsa.files import yaml_text
from hmsa.interfaces.topics import RECORDER
from hmsa_ros.middleware import RANGE

_PR_SET_PDEATHSIG = 1
# Enough for a recorder to write its messages to a slow disk.
_PATIENCE_SECONDS = 15.0
# Free bytes of a disk below which a node cannot write its log: a block.
_ROOM = 4096


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
        """Return the words after ``--ros-args``; parameters take precedence over the file."""
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
    Node processes with log files in a folder; a context manager that ends them.

    They inherit the environment, and so the ROS domain, of this process.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> 'Session':
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, node: NodeProcess) -> None:
        """Start a node with a new name."""
        with open(self.log(node.name), 'wb') as log:
            # A separate session: Ctrl-C in the terminal only reaches this process, which ends the
            # nodes in order. If this process is killed, the kernel ends them.
            self._processes[node.name] = subprocess.Popen(
                node.command(), stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True,
                preexec_fn=die_with_parent)  # noqa: PLW1509 - only calls the kernel

    def log(self, name: str) -> Path:
        """Return the log file of a node."""
        return self._folder / f'{name}.log'

    def check(self) -> None:
        """
        Check that all started nodes are running.

        Raises
        ------
        HmsaError
            If one has ended, with the last line of its log.

        """
        for name, process in self._processes.items():
            if process.poll() is not None:
                raise HmsaError(
                    f'the {name} ended early with status {process.returncode}: '
                    f'{self.last_words(name)}')

    def last_words(self, name: str) -> str:
        """Return the last line of a node's log, with the path of the log."""
        lines = self.log(name).read_text(errors='replace').strip().splitlines()
        full = shutil.disk_usage(self._folder).free < _ROOM
        said = f'the disk of {self._folder} is full' if full else 'it printed nothing'
        return f'{lines[-1] if lines else said} (log: {self.log(name)})'

    def stop(self) -> dict[str, int]:
        """End the recorder, then all other nodes together; return exit statuses by node."""
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


def die_with_parent(number: int = signal.SIGINT) -> None:
    """Have the kernel send this process a signal when its parent has ended."""
    # A shell may start background jobs with SIGINT ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


def stay_local() -> None:
    """Restrict this process and its nodes to this host; to be called before ROS is imported."""
    # The ROS domain is that of ROS_DOMAIN_ID if set, otherwise one that other runs on this host
    # are unlikely to use.
    os.environ[RANGE] = 'LOCALHOST'
    # Domains above 101 collide with the ephemeral ports of Linux.
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 101))


def dated(base: Path | str) -> Path:
    """Return a subfolder of ``base`` named by date and time."""
    return Path(base) / datetime.now().strftime('%Y-%m-%d_%H-%M-%S')
