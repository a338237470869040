"""
Start the planner, the simulated actuator and, unless told otherwise, the recorder.

    ros2 launch hmsa_ros demo.launch.py namespace:=left bag:=/tmp/left

The plant is the authority on simulated time and publishes ``/clock``. With ``plant:=false`` a
driver of real hardware takes its place, and time is the wall clock's. ``rviz:=true`` shows the
actuators in RViz.
"""

from launch import LaunchDescription

from hmsa_ros.clients.launching import DEMO
from hmsa_ros.clients.ros_launch import description


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and nodes."""
    return description(DEMO)
