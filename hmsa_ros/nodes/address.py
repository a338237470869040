"""
Detect that this host has another address.

The middleware announces the addresses that the host had when a node started. Nodes on other hosts
do not find the node at another address, however long both run.
"""

import os
import socket
import struct
import sys

if sys.platform == 'linux':
    import fcntl

# Request of ioctl for the IPv4 address of an interface, and its place in the answer.
_SIOCGIFADDR, _PLACE = 0x8915, slice(20, 24)
# Values of ROS_AUTOMATIC_DISCOVERY_RANGE with which no node of another host is found.
_ALONE = ('LOCALHOST', 'OFF')


def addresses() -> frozenset[str]:
    """Return the IPv4 addresses of this host to others; empty for none, or if unknown."""
    if sys.platform != 'linux':
        return frozenset()
    found = set()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
        for _, name in socket.if_nameindex():
            try:
                answer = fcntl.ioctl(
                    channel.fileno(), _SIOCGIFADDR, struct.pack('256s', name.encode()[:15]))
            except OSError:
                # It has no address.
                continue
            found.add(socket.inet_ntoa(answer[_PLACE]))
    return frozenset(x for x in found if not x.startswith('127.'))


class AddressWatch:
    """Compare the addresses of this host with those at the start of a node."""

    def __init__(self) -> None:
        self._begun = addresses()

    @property
    def words(self) -> str:
        """What a change of address leads to, and the remedy; empty for none."""
        if os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper() in _ALONE:
            return ''
        now = addresses()
        gone, new = self._begun - now, now - self._begun
        if not new or self._begun and not gone:
            # During an outage there may be none, and further ones do no harm.
            return ''
        before = ', '.join(sorted(gone)) or 'none'
        return (
            f'the address of this host was {before} when this node started, and is '
            f'{", ".join(sorted(new))} now: nodes on other hosts do not find this one any more; '
            'restart the nodes on this host')
