"""
Middleware settings of this package's processes, unless the user has set others; addresses.

The middleware announces the addresses that the host had when a node started. Nodes on other hosts
do not find the node at another address, however long both run.
"""

import os
from pathlib import Path
import re
import socket
import struct
import sys
import sysconfig

if sys.platform == 'linux':
    import fcntl

#: Environment variable of ROS 2, whose own default is SUBNET.
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# If any of these is set, the user has chosen which hosts can discover the nodes.
_DECIDED = (RANGE, 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY')
#: Environment variables of profiles: of Fast DDS 2, in ROS 2 Jazzy, and of Fast DDS 3. The
#: middleware of later distributions reads the first one too, and warns.
PROFILES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
_WHEEL = re.compile(r'ros_([a-z]+)_rclpy-.*\.dist-info')
_HERE = Path(__file__).parent
# Each message module imports the package that generates such modules, for one function of it. The
# generator itself, without which the package works, brings parsers: a fifth of the start of
# `hmsa stop`.
_GENERATOR = 'rosidl_generator_py.generate_py_impl'
# Request of ioctl for the IPv4 address of an interface, and its place in the answer.
_SIOCGIFADDR, _PLACE = 0x8915, slice(20, 24)
# Values of RANGE with which no node of another host is found.
_ALONE = ('LOCALHOST', 'OFF')


def ros_distro() -> str:
    """Return the ROS distribution that is sourced, or else installed from wheels; '' for none."""
    if sourced := os.environ.get('ROS_DISTRO'):
        return sourced
    folder = Path(sysconfig.get_path('purelib'))
    names = sorted(
        match[1] for x in folder.glob('ros_*_rclpy-*') if (match := _WHEEL.fullmatch(x.name)))
    return names[-1] if names else ''


def prepare_middleware() -> None:
    """
    Configure the middleware of this process; to be called before rclpy starts.

    By default, nodes are only discovered on this host, so that other participants in the network
    cannot command a coil. Set ``ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET`` to use several machines.

    Unless other Fast DDS profiles are set, lost messages are sent again within 0.03 s, and new
    participants are discovered within 0.5 s. With the defaults of Fast DDS, either may take 3 s,
    long after a command was to apply. If other hosts take part, a send never waits for one.

    The generator of messages, which no node needs, is not imported.
    """
    sys.modules.setdefault(_GENERATOR, None)  # type: ignore[arg-type]
    if not any(os.environ.get(name) for name in _DECIDED):
        os.environ[RANGE] = 'LOCALHOST'
    if not any(os.environ.get(name) for name in PROFILES):
        local = os.environ.get(RANGE) == 'LOCALHOST' or os.environ.get('ROS_LOCALHOST_ONLY') == '1'
        os.environ[PROFILES[fast_dds() - 2]] = str(profiles(fast_dds(), local=local))


def fast_dds() -> int:
    """Return the major version of Fast DDS in the distribution that is there."""
    return 2 if ros_distro() == 'jazzy' else 3


def profiles(version: int, *, local: bool) -> Path:
    """Return the profiles of a major version of Fast DDS, for nodes of this host or of several."""
    return _HERE / f'fastdds{version if version > 2 else ""}{"_localhost" if local else ""}.xml'


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
        if os.environ.get(RANGE, '').upper() in _ALONE:
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
