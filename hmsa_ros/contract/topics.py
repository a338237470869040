"""
Names, types, quality of service and meaning of every topic and service, without ROS.

All names are relative or private, so that namespaces and remapping work; only ``/clock`` and
``/diagnostics`` are absolute, as ROS has them. `hmsa_ros.nodes.interface` binds this page to
rclpy; the reference in the documentation is made from it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Quality:
    """
    Quality of service: the last `depth` messages are kept.

    Attributes
    ----------
    depth : int
        Of the queue.
    reliable : bool
        Whether lost messages are sent again.
    latched : bool
        Whether a late subscriber gets the kept messages (transient local).

    """

    depth: int
    reliable: bool = True
    latched: bool = False


RELIABLE = Quality(10)
# A plan may be sent as one burst of commands; none of them may be overwritten unread.
COMMAND = Quality(1000)
# Samples at 1 kHz and more: deep enough for a reader that pauses for some seconds.
SAMPLES = Quality(5000)
LATCHED = Quality(1, latched=True)
# The changes of level that took effect last, for late subscribers.
CHANGES = Quality(100, latched=True)
CLOCK = Quality(1, reliable=False)


@dataclass(frozen=True)
class Topic:
    """
    A topic.

    Attributes
    ----------
    name : str
        Relative or private.
    type : str
        Message type, for example ``'sensor_msgs/msg/JointState'``.
    qos : Quality
        Of publishers and subscribers alike.
    meaning : str
        What a message says, in one or two sentences.
    publishers, subscribers : tuple of str
        Nodes of this package that send and take it.

    """

    name: str
    type: str
    qos: Quality
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
    type : str
        Service type, for example ``'std_srvs/srv/Trigger'``.
    meaning : mapping of str to str
        What a call does, in one or two sentences, by the node that serves it.

    """

    name: str
    type: str
    meaning: Mapping[str, str] = field(default_factory=dict)


PLANNER = 'planner'
PLANT = 'plant'
RECORDER = 'recorder'
PLAYER = 'player'
NODES = (PLANNER, PLANT, RECORDER, PLAYER)

_FIELD = 'sensor_msgs/msg/MagneticField'
_FLOAT = 'std_msgs/msg/Float64'
_TRAJECTORY = 'trajectory_msgs/msg/JointTrajectory'
_TRIGGER = 'std_srvs/srv/Trigger'

JOINT_TRAJECTORY = Topic(
    '~/joint_trajectory', _TRAJECTORY, RELIABLE,
    'A sequence of setpoints. By its `time_from_start` each point is at rest at its `positions`, '
    "having left the one before at that one's. Stamp 0 starts now; with a stamp ahead the "
    'running plan is kept until then; a sequence that began in the past is joined where it is.',
    subscribers=(PLANNER, RECORDER))
SETPOINT = Topic(
    '~/setpoint', _FLOAT, RELIABLE,
    'One stretch to go to now, held until the next request.',
    subscribers=(PLANNER, RECORDER))
PLAN = Topic(
    '~/plan', _TRAJECTORY, LATCHED,
    'The plan: a point at each change of level, with the stretch and rate predicted there and '
    'the flux density from then on.', publishers=(PLANNER,))
STATUS = Topic(
    '~/status', 'diagnostic_msgs/msg/DiagnosticStatus', LATCHED,
    'The verdict on the last request, with a code and a sentence, and how far its sequence has '
    'come.', publishers=(PLANNER,))
FLUX_DENSITY_COMMAND = Topic(
    'flux_density_command', _FIELD, COMMAND,
    'The shaped command. From its stamp on, which may lie ahead, z is the flux density in tesla; '
    'x and y are 0. A message supersedes all earlier ones stamped at or after it.',
    publishers=(PLANNER,), subscribers=(PLANT,))
FLUX_DENSITY_APPLIED = Topic(
    'flux_density_applied', _FIELD, CHANGES,
    'The level in force: one message at each change of level that takes effect, stamped with the '
    'time at which it really did; z is the level from then on in tesla.',
    publishers=(PLANT,), subscribers=(PLANNER,))
DISTURBANCE_FORCE = Topic(
    'disturbance_force', 'geometry_msgs/msg/WrenchStamped', RELIABLE,
    'A force on the simulated actuator that nobody has planned for. From its stamp on (0: at '
    'once) force.z pulls along the field in newton, until the next message; all else is 0.',
    subscribers=(PLANT,))
JOINT_STATES = Topic(
    'joint_states', 'sensor_msgs/msg/JointState', SAMPLES,
    'Samples of the actuator: position is stretch, velocity stretch rate in 1/s, effort the flux '
    'density in force in tesla.', publishers=(PLANT,), subscribers=(PLANNER,))
STRETCH = Topic(
    'stretch', _FLOAT, SAMPLES, 'The stretch alone, to plot and to echo.', publishers=(PLANT,))
STRETCH_RATE = Topic(
    'stretch_rate', _FLOAT, SAMPLES, 'The stretch rate alone, in 1/s.', publishers=(PLANT,))
MARKERS = Topic(
    '~/markers', 'visualization_msgs/msg/MarkerArray', LATCHED,
    "What a 3-D view shows. The plant's: each block as it is deformed, its magnetisation and the "
    "field as arrows, at marker_rate while somebody subscribes. The planner's: each block as it "
    'is to become, when that changes.', publishers=(PLANT, PLANNER))
CLOCK_TOPIC = Topic(
    '/clock', 'rosgraph_msgs/msg/Clock', CLOCK,
    'Simulated time, from the plant or the player if a parameter makes it the authority.',
    publishers=(PLANT, PLAYER))
DIAGNOSTICS = Topic(
    '/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', RELIABLE,
    'Counters and health, once a second.', publishers=NODES)

STOP = Service('~/stop', _TRIGGER, {
    PLANNER: 'Drops the rest of the sequence and comes to rest without vibration.',
    PLAYER: 'Ends playing.'})
RESET = Service('~/reset', _TRIGGER, {
    PLANT: 'Puts the actuators back to their initial states, or to reset_stretch and '
           'reset_rate; time goes on.'})
STEP = Service('~/step', _TRIGGER, {
    PLANT: 'Advances a paused plant by step_count samples, one unless set.'})
SET_PAUSED = Service('~/set_paused', 'std_srvs/srv/SetBool', {
    PLANT: 'Stops simulated time, or lets it run.'})
PAUSE = Service('~/pause', _TRIGGER, {
    RECORDER: 'Stops writing; what arrives meanwhile is left out.', PLAYER: 'Holds playing.'})
RESUME = Service('~/resume', _TRIGGER, {
    RECORDER: 'Writes again.', PLAYER: 'Goes on playing.'})
TOGGLE_PAUSED = Service('~/toggle_paused', _TRIGGER, {PLAYER: 'Holds playing, or goes on.'})
IS_PAUSED = Service('~/is_paused', _TRIGGER, {
    RECORDER: '`success` says whether it is paused.',
    PLAYER: '`success` says whether it is paused.'})
PLAY_NEXT = Service('~/play_next', _TRIGGER, {PLAYER: 'Sends one message of a paused bag.'})
SNAPSHOT = Service('~/snapshot', _TRIGGER, {
    RECORDER: 'Writes what a recorder in snapshot mode holds in memory.'})
SPLIT_BAGFILE = Service('~/split_bagfile', _TRIGGER, {
    RECORDER: 'Closes the file and goes on in a new one.'})


def of_joint(name: str, joint: str, joints: Sequence[str]) -> str:
    """
    Return the name of one joint's topic.

    Parameters
    ----------
    name : str
        As declared here.
    joint : str
        Name of the joint.
    joints : sequence of str
        All joints of the node.

    Returns
    -------
    str
        With the joint before the last part, as in ``left/flux_density_command`` or
        ``~/left/setpoint``; unchanged where there is only one joint.

    """
    if len(joints) == 1:
        return name
    return f'~/{joint}/{name[2:]}' if name.startswith('~/') else f'{joint}/{name}'


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
