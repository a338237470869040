"""
What moves actuators: the simulated plant, and drivers of real hardware.

A `Device` takes stamped levels and is advanced to a time by whoever drives it. It knows no ROS,
and has no threads and no clock. What a class of hardware may raise, `StateLostError`, is here too.
"""

from hmsa_ros.device.protocol import StateLostError

__all__ = ['StateLostError']
