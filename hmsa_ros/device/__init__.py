"""
What moves actuators: the simulated plant, and drivers of real hardware.

A `Device` takes stamped levels and is advanced to a time by whoever drives it. It knows no ROS,
and has no threads and no clock. The parts of a class of hardware are here too.
"""

from hmsa_ros.device.assembly import Assembly, CoilModel, parts, SensorScale
from hmsa_ros.device.protocol import StateLostError

__all__ = ['Assembly', 'CoilModel', 'parts', 'SensorScale', 'StateLostError']
