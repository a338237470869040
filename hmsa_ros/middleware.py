"""What our processes ask of the middleware, unless somebody has asked for something else."""

import os
from pathlib import Path

#: What ROS 2 reads; its own default is SUBNET.
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# With any of these set, somebody has decided already who may find our nodes.
_DECIDED = (RANGE, 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY')
#: What Fast DDS reads, in the version of ROS 2 Jazzy.
PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_HERE = Path(__file__).parent


def prepare_middleware() -> None:
    """
    Set up the middleware of this process; to be called before rclpy starts.

    Nodes are found on this host only, where nothing else is said: a coil is not for everybody in
    the network to command. Who wants several machines sets
    ``ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET``.

    Where no other profiles are given to Fast DDS, what a subscriber has missed is sent to it again
    within 0.03 s, and a newcomer is found within 0.5 s. By default either may take 3 s, long
    after a command was to apply. Where other hosts take part, a send never waits for one of them.
    """
    if not any(os.environ.get(name) for name in _DECIDED):
        os.environ[RANGE] = 'LOCALHOST'
    if not os.environ.get(PROFILES):
        local = os.environ.get(RANGE) == 'LOCALHOST' or os.environ.get('ROS_LOCALHOST_ONLY') == '1'
        os.environ[PROFILES] = str(_HERE / f'fastdds{"_localhost" if local else ""}.xml')
