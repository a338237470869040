"""
Separate hosts on one machine: network namespaces joined by a bridge, which can be cut off.

Traffic stays inside the namespaces created here. Each has its own shared memory, so only the
network connects them. They end with the processes that hold them.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
import os
import shutil
import subprocess

#: Environment of processes that must discover each other across hosts.
ACROSS = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}
_TOOLS = ('ip', 'nsenter', 'unshare')
# An Ethernet address that no host has.
_NOBODY = '02:00:00:00:00:99'
# Difference between a host's first address and another one.
_ANOTHER = 100
_HOLD = 'mount -t tmpfs shm /dev/shm && ip link set lo up && echo ready && exec sleep infinity'


def unavailable() -> str:
    """Return why hosts are unavailable here; empty if they are available."""
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
    Named hosts, joined by a switch.

    Each has its `address` and can be cut off from the others and joined again.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._moved: set[str] = set()  # hosts that have another address
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
            # Multicast is routed by it.
            self._ip(name, 'route add default dev eth0')

    def address(self, name: str) -> str:
        """Return the address of a host."""
        more = _ANOTHER if name in self._moved else 0
        return f'10.99.0.{1 + self._names.index(name) + more}'

    def on(self, name: str, *command: str) -> list[str]:
        """Return a command that runs another command on a host."""
        return ['nsenter', '-t', str(self._holders[name].pid), '-n', '-m',
                f'--wd={os.getcwd()}', *command]

    def _ip(self, name: str, words: str) -> None:
        subprocess.run(self.on(name, 'ip', *words.split()), check=True, capture_output=True)

    def cut(self, name: str) -> None:
        """Cut a host off; the others lose its link-layer address, as after some minutes."""
        self._ip('switch', f'link set {name} down')
        for other in self._names:
            if other != name:
                self._ip(other, 'neigh flush all')

    def join(self, name: str) -> None:
        """Join a host to the others again."""
        self._ip('switch', f'link set {name} up')

    def move(self, name: str) -> None:
        """Give a host another address, as DHCP may after an outage."""
        self._ip(name, f'addr del {self.address(name)}/24 dev eth0')
        self._moved.add(name)
        self._ip(name, f'addr add {self.address(name)}/24 dev eth0')
        self._ip(name, 'route replace default dev eth0')

    def lose(self, sender: str, receiver: str) -> None:
        """Lose packets from one host to another; the opposite direction works."""
        self._ip(sender, f'neigh replace {self.address(receiver)} lladdr {_NOBODY} nud permanent '
                 'dev eth0')

    def find(self, sender: str, receiver: str) -> None:
        """Restore packets from one host to another."""
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
    """Create hosts; end them on exit."""
    made = Hosts(names)
    try:
        yield made
    finally:
        made.close()


def environment(given: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a process that processes on other hosts must discover."""
    return {**given, **ACROSS}
