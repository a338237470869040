"""
Hosts of their own on one machine: network namespaces that a bridge joins, which can be cut off.

Traffic stays inside the namespaces made here. Each has its own shared memory, so that nothing but
the network joins them. They end with the processes that hold them.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
import os
import shutil
import subprocess

#: Environment of processes that are to find each other across hosts.
ACROSS = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}
_TOOLS = ('ip', 'nsenter', 'unshare')
# An address of Ethernet that no host has.
_NOBODY = '02:00:00:00:00:99'
_HOLD = 'mount -t tmpfs shm /dev/shm && ip link set lo up && echo ready && exec sleep infinity'


def unavailable() -> str:
    """Return why there can be no hosts here; empty where there can be."""
    if missing := [x for x in _TOOLS if shutil.which(x) is None]:
        return f'{missing[0]} is not installed (iproute2, util-linux)'
    if os.geteuid() != 0:
        return 'network namespaces need root'
    tried = subprocess.run(
        ['unshare', '-n', '-m', 'sh', '-c',
         'mount -t tmpfs shm /dev/shm && ip link add one type veth peer name two'],
        capture_output=True, text=True, check=False)
    return f'no network namespaces here: {tried.stderr.strip()}' if tried.returncode else ''


class Hosts:
    """
    Hosts with names, joined by a switch.

    Each is found by the others at `address`, and can be cut off from them and joined again.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._holders: dict[str, subprocess.Popen[str]] = {}
        for name in ('switch', *names):
            self._holders[name] = subprocess.Popen(
                ['unshare', '-n', '-m', 'sh', '-c', _HOLD], stdout=subprocess.PIPE, text=True)
        for holder in self._holders.values():
            assert holder.stdout is not None
            if holder.stdout.readline() != 'ready\n':
                raise OSError('a network namespace does not start')
        self._ip('switch', 'link add bridge type bridge')
        self._ip('switch', 'link set bridge up')
        for name in names:
            self._ip('switch', f'link add {name} type veth peer name eth0 netns '
                     f'{self._holders[name].pid}')
            self._ip('switch', f'link set {name} master bridge')
            self._ip('switch', f'link set {name} up')
            self._ip(name, f'addr add {self.address(name)}/24 dev eth0')
            self._ip(name, 'link set eth0 up')
            # Multicast finds its way by it.
            self._ip(name, 'route add default dev eth0')

    def address(self, name: str) -> str:
        """Return the address of a host."""
        return f'10.99.0.{1 + self._names.index(name)}'

    def on(self, name: str, *command: str) -> list[str]:
        """Return a command that runs another one on a host."""
        return ['nsenter', '-t', str(self._holders[name].pid), '-n', '-m',
                f'--wd={os.getcwd()}', *command]

    def _ip(self, name: str, words: str) -> None:
        subprocess.run(self.on(name, 'ip', *words.split()), check=True, capture_output=True)

    def cut(self, name: str) -> None:
        """Cut a host off from all others, who forget where it was, as after some minutes."""
        self._ip('switch', f'link set {name} down')
        for other in self._names:
            if other != name:
                self._ip(other, 'neigh flush all')

    def join(self, name: str) -> None:
        """Join a host to the others again."""
        self._ip('switch', f'link set {name} up')

    def lose(self, sender: str, receiver: str) -> None:
        """Lose what a host sends to another one alone; what comes back arrives."""
        self._ip(sender, f'neigh replace {self.address(receiver)} lladdr {_NOBODY} nud permanent '
                 'dev eth0')

    def find(self, sender: str, receiver: str) -> None:
        """Have what a host sends to another one arrive again."""
        self._ip(sender, f'neigh del {self.address(receiver)} dev eth0')

    def close(self) -> None:
        """End the hosts."""
        for holder in self._holders.values():
            holder.kill()
            holder.wait()
            assert holder.stdout is not None
            holder.stdout.close()


@contextmanager
def hosts(*names: str) -> Iterator[Hosts]:
    """Make hosts, and end them in the end."""
    made = Hosts(names)
    try:
        yield made
    finally:
        made.close()


def environment(given: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a process that others on other hosts are to find."""
    return {**given, **ACROSS}
