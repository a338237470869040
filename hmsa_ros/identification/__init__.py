"""
The parameters of an actuator out of a recording of its motion.

`identify` takes a `Recording` and returns a frozen `Identification`. Nothing here needs ROS.
"""

from hmsa_ros.identification.identify import identify
from hmsa_ros.identification.intervals import profile
from hmsa_ros.identification.recording import Recording
from hmsa_ros.identification.result import Identification

__all__ = ['Identification', 'Recording', 'identify', 'profile']
