"""Who may find our nodes: those on this host, unless somebody asks for more."""

import os

#: What ROS 2 reads; its own default is SUBNET.
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# With any of these set, somebody has decided already.
_DECIDED = (RANGE, 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY')


def keep_to_host() -> None:
    """
    Have nodes of this process be found on this host only, where nothing else is said.

    To be called before rclpy starts. A coil is not for everybody in the network to command; who
    wants several machines sets ``ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET``.
    """
    if not any(os.environ.get(name) for name in _DECIDED):
        os.environ[RANGE] = 'LOCALHOST'
