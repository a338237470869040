"""Middleware settings of this package's processes, unless the user has set others."""

import os
from pathlib import Path

#: Environment variable of ROS 2, whose own default is SUBNET.
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# If any of these is set, the user has chosen which hosts can discover the nodes.
_DECIDED = (RANGE, 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY')
#: Environment variable of Fast DDS, in the version of ROS 2 Jazzy.
PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_HERE = Path(__file__).parent


def prepare_middleware() -> None:
    """
    Configure the middleware of this process; to be called before rclpy starts.

    By default, nodes are only discovered on this host, so that other participants in the network
    cannot command a coil. Set ``ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET`` to use several machines.

    Unless other Fast DDS profiles are set, lost messages are sent again within 0.03 s, and new
    participants are discovered within 0.5 s. With the defaults of Fast DDS, either may take 3 s,
    long after a command was to apply. If other hosts take part, a send never waits for one.
    """
    if not any(os.environ.get(name) for name in _DECIDED):
        os.environ[RANGE] = 'LOCALHOST'
    if not os.environ.get(PROFILES):
        local = os.environ.get(RANGE) == 'LOCALHOST' or os.environ.get('ROS_LOCALHOST_ONLY') == '1'
        os.environ[PROFILES] = str(_HERE / f'fastdds{"_localhost" if local else ""}.xml')
