"""
Play the commands of a bag to a fresh plant and record what it does.

    ros2 launch hmsa_ros replay.launch.py bag:=/tmp/left record_to:=/tmp/again namespace:=left

The player is the authority on time: it publishes ``/clock`` from the stamps of the bag. When it
is done, all of it ends.
"""

from launch import LaunchDescription

from hmsa_ros.clients.launching import REPLAY
from hmsa_ros.clients.ros_launch import description


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and nodes."""
    return description(REPLAY)
