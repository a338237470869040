"""
Names, types, quality of service and meaning of every topic and service.

All names are relative or private, so that namespaces and remapping work; only ``/clock`` and
``/diagnostics`` are absolute, as ROS has them. The reference in the documentation is made from
what stands here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, MagneticField
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

RELIABLE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.RELIABLE)
# A plan may be sent as one burst of commands; none of them may be overwritten unread.
COMMAND = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.RELIABLE)
# Samples at 1 kHz and more: deep enough for a reader that pauses for some seconds.
SAMPLES = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=5000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL)
# The changes of level that took effect last, for who comes late.
CHANGES = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL)
CLOCK = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


@dataclass(frozen=True)
class Topic:
    """
    A topic.

    Attributes
    ----------
    name : str
        Relative or private.
    type : type
        Message class.
    qos : rclpy.qos.QoSProfile
        Of publishers and subscribers alike.
    meaning : str
        What a message says, in one or two sentences.
    publishers, subscribers : tuple of str
        Nodes of this package that send and take it.

    """

    name: str
    type: type[Any]
    qos: QoSProfile
    meaning: str = ''
    publishers: tuple[str, ...] = ()
    subscribers: tuple[str, ...] = ()


@dataclass(frozen=True)
class Service:
    """
    A service.

    Attributes
    ----------
    name : str
        Private to the node that serves it.
    type : type
        Service class.
    meaning : mapping of str to str
        What a call does, in one or two sentences, by the node that serves it.

    """

    name: str
    type: type[Any]
    meaning: Mapping[str, str] = field(default_factory=dict)


PLANNER = 'planner'
PLANT = 'plant'
RECORDER = 'recorder'
PLAYER = 'player'
NODES = (PLANNER, PLANT, RECORDER, PLAYER)

JOINT_TRAJECTORY = Topic(
    '~/joint_trajectory', JointTrajectory, RELIABLE,
    'A sequence of setpoints. By its `time_from_start` each point is at rest at its `positions`, '
    "having left the one before at that one's. Stamp 0 starts now; with a stamp ahead the "
    'running plan is kept until then; a sequence that began in the past is joined where it is.',
    subscribers=(PLANNER, RECORDER))
SETPOINT = Topic(
    '~/setpoint', Float64, RELIABLE,
    'One stretch to go to now, held until the next request.',
    subscribers=(PLANNER, RECORDER))
PLAN = Topic(
    '~/plan', JointTrajectory, LATCHED,
    'The plan: a point at each change of level, with the stretch and rate predicted there and '
    'the flux density from then on.', publishers=(PLANNER,))
STATUS = Topic(
    '~/status', DiagnosticStatus, LATCHED,
    'The verdict on the last request, with a code and a sentence, and how far its sequence has '
    'come.', publishers=(PLANNER,))
FLUX_DENSITY_COMMAND = Topic(
    'flux_density_command', MagneticField, COMMAND,
    'The shaped command. From its stamp on, which may lie ahead, z is the flux density in tesla; '
    'x and y are 0. A message supersedes all earlier ones stamped at or after it.',
    publishers=(PLANNER,), subscribers=(PLANT,))
FLUX_DENSITY_APPLIED = Topic(
    'flux_density_applied', MagneticField, CHANGES,
    'What became of the commands: one message at each change of level that takes effect, stamped '
    'with the time at which it really did; z is the level from then on in tesla.',
    publishers=(PLANT,), subscribers=(PLANNER,))
DISTURBANCE_FORCE = Topic(
    'disturbance_force', WrenchStamped, RELIABLE,
    'A force on the simulated actuator that nobody has planned for. From its stamp on (0: at '
    'once) force.z pulls along the field in newton, until the next message; all else is 0.',
    subscribers=(PLANT,))
JOINT_STATES = Topic(
    'joint_states', JointState, SAMPLES,
    'Samples of the actuator: position is stretch, velocity stretch rate in 1/s, effort the flux '
    'density in force in tesla.', publishers=(PLANT,), subscribers=(PLANNER,))
STRETCH = Topic(
    'stretch', Float64, SAMPLES, 'The stretch alone, to plot and to echo.', publishers=(PLANT,))
STRETCH_RATE = Topic(
    'stretch_rate', Float64, SAMPLES, 'The stretch rate alone, in 1/s.', publishers=(PLANT,))
MARKERS = Topic(
    '~/markers', MarkerArray, LATCHED,
    "What a 3-D view shows. The plant's: each block as it is deformed, its magnetisation and the "
    "field as arrows, at marker_rate while somebody subscribes. The planner's: each block as it "
    'is to become, when that changes.', publishers=(PLANT, PLANNER))
CLOCK_TOPIC = Topic(
    '/clock', Clock, CLOCK,
    'Simulated time, from the plant or the player if a parameter makes it the authority.',
    publishers=(PLANT, PLAYER))
DIAGNOSTICS = Topic(
    '/diagnostics', DiagnosticArray, RELIABLE,
    'Counters and health, once a second.', publishers=NODES)

STOP = Service('~/stop', Trigger, {
    PLANNER: 'Drops the rest of the sequence and comes to rest without vibration.',
    PLAYER: 'Ends playing.'})
RESET = Service('~/reset', Trigger, {
    PLANT: 'Puts the actuators back to their initial states, or to reset_stretch and '
           'reset_rate; time goes on.'})
STEP = Service('~/step', Trigger, {
    PLANT: 'Advances a paused plant by step_count samples, one unless set.'})
SET_PAUSED = Service('~/set_paused', SetBool, {PLANT: 'Stops simulated time, or lets it run.'})
PAUSE = Service('~/pause', Trigger, {
    RECORDER: 'Stops writing; what arrives meanwhile is left out.', PLAYER: 'Holds playing.'})
RESUME = Service('~/resume', Trigger, {
    RECORDER: 'Writes again.', PLAYER: 'Goes on playing.'})
TOGGLE_PAUSED = Service('~/toggle_paused', Trigger, {PLAYER: 'Holds playing, or goes on.'})
IS_PAUSED = Service('~/is_paused', Trigger, {
    RECORDER: '`success` says whether it is paused.',
    PLAYER: '`success` says whether it is paused.'})
PLAY_NEXT = Service('~/play_next', Trigger, {PLAYER: 'Sends one message of a paused bag.'})
SNAPSHOT = Service('~/snapshot', Trigger, {
    RECORDER: 'Writes what a recorder in snapshot mode holds in memory.'})
SPLIT_BAGFILE = Service('~/split_bagfile', Trigger, {
    RECORDER: 'Closes the file and goes on in a new one.'})


def of_joint(topic: Topic, joint: str, joints: Sequence[str]) -> Topic:
    """
    Return the topic of one joint.

    Parameters
    ----------
    topic : Topic
        As declared here.
    joint : str
        Name of the joint.
    joints : sequence of str
        All joints of the node.

    Returns
    -------
    Topic
        With the joint before the name, as in ``left/flux_density_command`` or
        ``~/left/setpoint``; the same where there is only one joint.

    """
    if len(joints) == 1:
        return topic
    name = topic.name
    return replace(
        topic, name=f'~/{joint}/{name[2:]}' if name.startswith('~/') else f'{joint}/{name}')


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
