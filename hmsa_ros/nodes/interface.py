"""
Names, types and quality of service of every topic and service.

All names are relative or private, so that namespaces and remapping work; only ``/clock`` and
``/diagnostics`` are absolute, as ROS has them.
"""

from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, MagneticField
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

RELIABLE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.RELIABLE)
# A plan may be sent as one burst of commands; none of them may be overwritten unread.
COMMAND = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.RELIABLE)
# Samples at 1 kHz and more: deep enough for a reader that pauses for some hundred samples.
SAMPLES = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL)
CLOCK = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


@dataclass(frozen=True)
class Topic:
    """A topic: its name, message class and quality of service."""

    name: str
    type: type[Any]
    qos: QoSProfile


@dataclass(frozen=True)
class Service:
    """A service: its name and service class."""

    name: str
    type: type[Any]


PLANNER = 'planner'
PLANT = 'plant'
RECORDER = 'recorder'
PLAYER = 'player'

JOINT_TRAJECTORY = Topic('~/joint_trajectory', JointTrajectory, RELIABLE)
SETPOINT = Topic('~/setpoint', Float64, RELIABLE)
PLAN = Topic('~/plan', JointTrajectory, LATCHED)
STATUS = Topic('~/status', DiagnosticStatus, LATCHED)
FLUX_DENSITY_COMMAND = Topic('flux_density_command', MagneticField, COMMAND)
JOINT_STATES = Topic('joint_states', JointState, SAMPLES)
STRETCH = Topic('stretch', Float64, SAMPLES)
STRETCH_RATE = Topic('stretch_rate', Float64, SAMPLES)
CLOCK_TOPIC = Topic('/clock', Clock, CLOCK)
DIAGNOSTICS = Topic('/diagnostics', DiagnosticArray, RELIABLE)

STOP = Service('~/stop', Trigger)
RESET = Service('~/reset', Trigger)
STEP = Service('~/step', Trigger)
SET_PAUSED = Service('~/set_paused', SetBool)
PAUSE = Service('~/pause', Trigger)
RESUME = Service('~/resume', Trigger)
TOGGLE_PAUSED = Service('~/toggle_paused', Trigger)
IS_PAUSED = Service('~/is_paused', Trigger)
PLAY_NEXT = Service('~/play_next', Trigger)
SPLIT_BAGFILE = Service('~/split_bagfile', Trigger)


def from_outside(name: str, node: str) -> str:
    """
    Return a private name as another node in the same namespace addresses it.

    Parameters
    ----------
    name : str
        Name as declared here, for example ``'~/stop'``.
    node : str
        Name of the node that owns it, for example ``'planner'``.

    Returns
    -------
    str
        For example ``'planner/stop'``; names that are not private are returned unchanged.

    """
    return f'{node}/{name[2:]}' if name.startswith('~/') else name
