"""Faults between hosts: outages between planner and plant, a recorder that disappears."""

from collections.abc import Callable
import os
import signal
import sys
from time import monotonic, sleep

import numpy as np

from benchmarks.faults.common import Register
from benchmarks.faults.hosts import ACROSS, Hosts, hosts, unavailable
from benchmarks.faults.rig import Child, PATIENCE, Rig, ROOT
from benchmarks.faults.table import Seen
from hmsa.errors import HmsaError
from hmsa_ros.middleware import PROFILES

FAULTS = Register(unavailable)
_ONLOOKER = ROOT / 'test' / 'onlooker.py'


class _Apart:
    """Nodes on separate hosts; the rig keeps their logs and ends them."""

    def __init__(self, rig: Rig, made: Hosts) -> None:
        self._rig, self.hosts = rig, made
        self._seen = rig.folder / 'seen.npy'
        rig.environment |= {**ACROSS, **dict.fromkeys(PROFILES, '')}

    def run(self, host: str, name: str, *words: str) -> Child:
        """Start this Python interpreter with arguments on a host."""
        child = Child(
            self.hosts.on(host, sys.executable, *words), self._rig.folder / f'{name}.log',
            self._rig.environment)
        self._rig.children.append(child)
        return child

    def node(self, host: str, name: str, *words: str) -> Child:
        """Start a node or a command of the package on a host."""
        return self.run(host, name, '-m', 'hmsa_ros', name, *words)

    def look_on(self, host: str, name: str = 'onlooker') -> Child:
        """Start an observer that writes down samples on a host."""
        child = self.run(
            host, name, str(_ONLOOKER), str(self._seen if name == 'onlooker' else os.devnull))
        wait(lambda: 'sees' in child.said, 'a sample')
        return child

    def seen(self, onlooker: Child) -> np.ndarray:
        """Return rows of timestamps and arrival times in s, stretches, and fields in T."""
        onlooker.end(15)
        found: np.ndarray = np.load(self._seen).T
        return found

    def send(self, host: str, *words: str) -> int:
        """Send setpoints; return the exit status."""
        return self.node(host, 'send', *words).popen.wait(PATIENCE)


def wait(condition: Callable[[], bool], what: str) -> None:
    """Wait until a condition holds."""
    end = monotonic() + PATIENCE
    while not condition():
        if monotonic() > end:
            raise HmsaError(f'waited {PATIENCE:g} s for {what}')
        sleep(0.05)


def _outage(rig: Rig, seconds: float) -> Seen:
    with hosts('bench', 'desk') as made:
        apart = _Apart(rig, made)
        plant = apart.node('bench', 'plant', '--ros-args', '-p', 'safe_flux:=zero')
        planner = apart.node('desk', 'planner')
        onlooker = apart.look_on('bench')
        apart.send('desk', '1.1:1', '--wait')
        apart.send('desk', '1.1:1', '1.35:600')
        sleep(3.0)
        made.cut('desk')
        begin = monotonic()
        wait(lambda: 'the field goes to zero' in plant.said, 'the watchdog')
        sleep(max(begin + seconds - monotonic(), 0.0))
        reported = 'no receipt' in planner.said
        made.join('desk')
        wait(lambda: 'was cut off by the plant or driver' in planner.said, 'the planner')
        sleep(1.0)
        status = apart.send('desk', '1.2:1', '--wait')
        _, _, stretches, fields = apart.seen(onlooker)
        off = int(np.flatnonzero(fields[1:] == 0.0)[-1])
        back = int(np.flatnonzero(fields[:off])[-1]) + 1
        still = stretches[(back + off) // 2:off]
        peak = float(stretches[off:].max())
    return Seen(
        f'{"reported" if reported else "not reported"}; at rest at {still[-1]:.4f}, then at most '
        f'{peak:.4f}, exit {status}',
        f'{float(np.ptp(still)):.1e}',
        reported and status == 0 and 1.199 < peak < 1.202 and float(np.ptp(still)) < 1e-3)


for _seconds in (2.0, 25.0):
    FAULTS.add(
        f'hosts_outage_{_seconds:g}', f'hosts apart for {_seconds:g} s',
        'network namespaces; link down at 1.35, safe_flux zero; later a request of 1.2',
        'no field until the request; outage and cut-off reported; next move shaped',
        _outage, _seconds)


@FAULTS.fault(
    'hosts_stop', '`hmsa stop` while commands do not arrive',
    'network namespaces; commands lost in mid-sequence, from before the stop until after it',
    'exit 1, which names the missing acknowledgement; at rest once commands arrive')
def _stop(rig: Rig) -> Seen:
    with hosts('bench', 'desk') as made:
        apart = _Apart(rig, made)
        apart.node('bench', 'plant')
        apart.node('desk', 'planner')
        onlooker = apart.look_on('bench')
        apart.send('desk', '1.1:1', '--wait')
        apart.send('desk', *('1.2:0.4', '1.35:0.4') * 20)
        sleep(1.0)
        made.lose('desk', 'bench')
        stop = apart.node('desk', 'stop')
        status = stop.popen.wait(PATIENCE)
        made.find('desk', 'bench')
        sleep(3.0)
        still = apart.seen(onlooker)[2][-500:]
    named = 'has not acknowledged' in stop.said
    vibration = float(np.ptp(still)) / 0.15
    return Seen(
        f'exit {status}, {"named" if named else "not named"}; then at {still[-1]:.4f}',
        f'{vibration:.1e}', status == 1 and named and vibration < 1e-3)


@FAULTS.fault(
    'hosts_address', 'host of the plant comes back with another address',
    'network namespaces; link down at 1.35, safe_flux zero; a request of 1.2, again after a '
    'restart of the plant',
    'both nodes name it; the first request is rejected (`unheard`), the second one arrives')
def _address(rig: Rig) -> Seen:
    options = 'plant', '--ros-args', '-p', 'safe_flux:=zero'
    with hosts('bench', 'desk') as made:
        apart = _Apart(rig, made)
        plant, planner = apart.node('bench', *options), apart.node('desk', 'planner')
        onlooker = apart.look_on('bench')
        apart.send('desk', '1.1:1', '--wait')
        apart.send('desk', '1.1:1', '1.35:600')
        sleep(3.0)
        made.cut('bench')
        made.move('bench')
        made.join('bench')
        wait(lambda: 'the field goes to zero' in plant.said, 'the watchdog')
        wait(lambda: 'restart the nodes on this host' in plant.said, 'the plant')
        wait(lambda: 'another address now (then restart it)' in planner.said, 'the planner')
        refused = apart.send('desk', '1.2:1', '--wait')
        _, _, stretches, fields = apart.seen(onlooker)
        plant.end(signal.SIGINT)
        apart.run('bench', 'restarted', '-m', 'hmsa_ros', *options)
        onlooker = apart.look_on('bench')
        status = apart.send('desk', '1.2:1', '--wait')
        after, peak = fields[-1], float(apart.seen(onlooker)[2].max())
    return Seen(
        f'named; exit {refused}, {after:g} T, at {stretches[-1]:.4f}; after a restart exit '
        f'{status}, at most {peak:.4f}', '-',
        refused != 0 and after == 0.0 and status == 0 and 1.199 < peak < 1.202)


def _recorder(rig: Rig, where: str) -> Seen:
    with hosts('bench', 'desk', 'third') as made:
        apart = _Apart(rig, made)
        plant = apart.node('bench', 'plant')
        planner = apart.node(where, 'planner')
        apart.look_on('third', 'recorder')
        onlooker = apart.look_on('bench')
        made.cut('third')
        status = apart.send(
            where, *(f'{x}:1' for x in (1.2, 1.4, 1.1, 1.3, 1.0)), '--wait')
        sleep(5.0)
        gap = float(np.diff(apart.seen(onlooker)[1]).max())
        unheard = 'no receipt' in planner.said or 'heartbeat' in plant.said
        jumped = 'clock' in plant.said
    return Seen(
        f'exit {status}, longest gap {gap:.2f} s, receipts {"lost" if unheard else "received"}',
        '-',
        status == 0 and gap < 1.0 and not unheard and not jumped)


for _where, _name in (('bench', 'one host'), ('desk', 'two hosts')):
    FAULTS.add(
        f'hosts_recorder_{_where}', f"a subscriber's host goes away, the others on {_name}",
        'its link down, five moves',
        'all moves arrive; no gap of 1 s in the samples; receipts continue', _recorder, _where)
