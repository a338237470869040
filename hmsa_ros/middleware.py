"""Middleware settings of this package's processes, unless the user has set others."""

import os
from pathlib import Path
import re
import sys
import sysconfig

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
