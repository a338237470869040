"""
Devices that move actuators: the simulated plant, and drivers of real hardware.

A `Device` accepts timestamped levels and is advanced to a time by its caller. It does not depend
on ROS, and has neither threads nor a clock.
"""

from hmsa_ros.device.watchdog import StateLostError

__all__ = ['StateLostError']
