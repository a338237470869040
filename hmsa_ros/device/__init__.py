"""
Devices that move actuators: the simulated plant, and drivers of real hardware.

A `Device` accepts timestamped levels and is advanced to a time by its caller. It does not depend
on ROS, and has neither threads nor a clock. The parts for hardware classes are also here.
"""

from hmsa_ros.device.assembly import Assembly, CoilModel, parts, SensorScale
from hmsa_ros.device.protocol import StateLostError

__all__ = ['Assembly', 'CoilModel', 'parts', 'SensorScale', 'StateLostError']
