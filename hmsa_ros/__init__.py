"""
Vibration-free command shaping for hard-magnetic soft actuators on ROS 2.

``hmsa_ros.model`` is the actuator, ``hmsa_ros.planning`` the commands that move it, and
``hmsa_ros.device`` the simulated plant and drivers of hardware, all without ROS. ``hmsa_ros.bag``
reads and writes recordings, ``hmsa_ros.nodes`` is the ROS 2 edge and ``hmsa_ros.cli`` the command
line.
"""

__version__ = '0.1.0'
