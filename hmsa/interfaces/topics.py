"""
Names, types, quality of service and meaning of all topics and services, without ROS.

All names are relative or private, so that namespaces and remapping work; only ``/clock`` and
``/diagnostics`` are absolute, as usual in ROS. `hmsa_ros.nodes.ros_entities` creates them with
rclpy, and the reference documentation is generated from this module.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class Quality:
    """Queue depth, retransmission of lost messages, and delivery to late subscribers."""

    depth: int
    reliable: bool = True
    latched: bool = False


RELIABLE = Quality(10)
# A plan may be sent as one burst of commands, none of which may be overwritten before reading.
COMMAND = Quality(1000)
# Samples at 1 kHz or more: deep enough for a reader that pauses for some seconds.
SAMPLES = Quality(5000)
LATCHED = Quality(1, latched=True)
# Messages that are useless when late.
NEWEST = Quality(1, reliable=False)
# The last changes of level, for late subscribers and for a recorder that pauses.
CHANGES = Quality(1000, latched=True)
# The outcomes of the last setpoints, for a recorder that has just been started or pauses.
OUTCOME = Quality(1000, latched=True)
CLOCK = Quality(1, reliable=False)


@dataclass(frozen=True)
class Topic:
    """
    A topic by its relative or private name, with its publishers and subscribers in this package.

    The type is in the form ``'sensor_msgs/msg/JointState'``. Publishers and subscribers use the
    same quality of service.
    """

    name: str
    type: str
    qos: Quality
    meaning: str = ''
    publishers: tuple[str, ...] = ()
    subscribers: tuple[str, ...] = ()


@dataclass(frozen=True)
class Service:
    """A service by its private name and type, with its effect by serving node."""

    name: str
    type: str
    meaning: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Action:
    """
    An action by its private name and type, with its server and the meaning of a goal.

    The action and its state topic exist if their types are installed.
    """

    name: str
    type: str
    server: str
    meaning: str
    state: Topic


PLANNER = 'planner'
PLANT = 'plant'
DRIVER = 'driver'
RECORDER = 'recorder'
PLAYER = 'player'
SENSE = 'sense'
NODES = (PLANNER, PLANT, DRIVER, RECORDER, PLAYER, SENSE)

_FIELD = 'sensor_msgs/msg/MagneticField'
_FLOAT = 'std_msgs/msg/Float64'
_TRAJECTORY = 'trajectory_msgs/msg/JointTrajectory'
_TRIGGER = 'std_srvs/srv/Trigger'

JOINT_TRAJECTORY = Topic(
    '~/joint_trajectory', _TRAJECTORY, RELIABLE,
    'A sequence of setpoints. The actuator leaves the previous point at its `time_from_start` and '
    'is at rest at `positions` no later than the `time_from_start` of this point. Timestamp 0 '
    'starts now; a future timestamp '
    'keeps the current plan until then; a sequence that began in the past is joined in the '
    'middle. With `trajectory_mode` path, points with `velocities` are a path that is followed to '
    'rest at its end. Points without `positions` and with `effort` are raw levels: the flux '
    'density in tesla from `time_from_start` on; the planner checks them and ends at rest. A '
    'trajectory without points is a stop.',
    subscribers=(PLANNER, RECORDER))
SETPOINT = Topic(
    '~/setpoint', _FLOAT, RELIABLE,
    'One stretch to go to now, held until the next request.',
    subscribers=(PLANNER, RECORDER))
PLAN = Topic(
    '~/plan', _TRAJECTORY, LATCHED,
    'The plan: a point at each change of level, with the predicted stretch and rate, and the '
    'flux density from then on.', publishers=(PLANNER,))
STATUS = Topic(
    '~/status', 'diagnostic_msgs/msg/DiagnosticStatus', LATCHED,
    'The status of the last request: a code and a sentence, the measured values of the last '
    'setpoint, and the progress of the sequence. With several joints, those that only show '
    'progress come 2 ms apart for each further joint.', publishers=(PLANNER,))
OUTCOMES = Topic(
    '~/outcomes', 'diagnostic_msgs/msg/DiagnosticStatus', OUTCOME,
    'The outcome of each requested setpoint, published once the setpoint is evaluated or over, '
    'and again if the outcome changes; `hardware_id` is the joint, `message` a sentence, and '
    'times are in ns. Asked: '
    '`asked` (setpoint, path or levels), `request`, `plan`, `setpoint` of `setpoints`, `target` '
    'and `start` in `coordinate`, `begins`, `end`, and whether it is `held` after that. Planned: '
    '`moves`, a list of begin and arrival as planned first and after each new plan, the last '
    '`arrival`, and whether it was `corrected` from samples. Ended early: `ended` '
    '(replaced, stopped, or the code of the status) at `until`; setpoints that never began share '
    'one outcome, from `setpoint` `through` another. Found: `verdict` and its figures in stretch, '
    'unless the setpoint ended before it could be evaluated.',
    publishers=(PLANNER,))
ESTIMATE = Topic(
    '~/estimate', 'diagnostic_msgs/msg/DiagnosticArray', RELIABLE,
    'With the parameter `feedback`: a sentence for each joint, the estimated parameters with '
    'their standard deviations (`NAME.std`) and the given values (`NAME.nominal`), whether plans '
    'use them, and the number of rejected samples.',
    publishers=(PLANNER,))
FLUX_DENSITY_COMMAND = Topic(
    'flux_density_command', _FIELD, COMMAND,
    'The shaped command: from its timestamp on, which may be in the future, z is the flux density '
    'in tesla; x and y are 0. A message replaces all earlier ones with the same or a later '
    'timestamp. After a cut-off of the coil, all are rejected until 0 T is commanded with the '
    'time of the cut-off as the timestamp, or with 0 (now).',
    publishers=(PLANNER,), subscribers=(PLANT, DRIVER))
FLUX_DENSITY_APPLIED = Topic(
    'flux_density_applied', _FIELD, CHANGES,
    'The applied level: one message per change of level, timestamped when it took effect; z is '
    'the actual level from then on, in tesla, and NaN if it is unknown.',
    publishers=(PLANT, DRIVER), subscribers=(PLANNER,))
FLUX_DENSITY_RECEIVED = Topic(
    'flux_density_received', 'sensor_msgs/msg/TimeReference', NEWEST,
    'A receipt for a command, and a heartbeat five times a second: `header.stamp` is when the '
    'newest command arrived, or the current time, in the clock of the sender; `time_ref` is the '
    'timestamp of that command (0 before the first), `source` the joint. `frame_id` is '
    '`interlock` while the interlock is open, and `cut_off` after a cut-off of the coil, until '
    'that is acknowledged: `time_ref` is then the time of the cut-off. It is `late` if the '
    'newest command came too late and was rejected. The planner uses it to check that commands '
    'arrive and apply, and to measure the offset of the clocks. Optional for a driver of your '
    'own.',
    publishers=(PLANT, DRIVER), subscribers=(PLANNER,))
INTERLOCK = Topic(
    '~/interlock', 'std_msgs/msg/Bool', RELIABLE,
    'An interlock, such as a door switch or an emergency stop: `true` closes it, `false` opens '
    'it. While '
    'it is open, the coil is off, and all commands and requests are rejected. It is closed once '
    'all publishers have closed it. Publish it reliably, and repeat it.',
    subscribers=(DRIVER,))
DISTURBANCE_FORCE = Topic(
    'disturbance_force', 'geometry_msgs/msg/WrenchStamped', RELIABLE,
    'An unplanned force on the simulated actuator: from its timestamp on (0: immediately) until '
    'the next message, force.z pulls along the field, in newtons; all other components are 0.',
    subscribers=(PLANT,))
TEMPERATURE = Topic(
    'temperature', 'sensor_msgs/msg/Temperature', NEWEST,
    'The temperature of the block in degrees Celsius, where parameters `thermal.*` say what it '
    'changes. The plant publishes it if its coil warms the block (`thermal.rise`); otherwise it '
    'subscribes, and the simulated block takes the published temperature.',
    publishers=(PLANT,), subscribers=(PLANNER, PLANT))
JOINT_STATES = Topic(
    'joint_states', 'sensor_msgs/msg/JointState', SAMPLES,
    'Samples of the actuator: position is stretch, velocity stretch rate in 1/s, effort the '
    'applied flux density in tesla.', publishers=(PLANT, DRIVER, SENSE), subscribers=(PLANNER,))
STRETCH = Topic(
    'stretch', _FLOAT, SAMPLES, 'The stretch alone, for plotting and echo.',
    publishers=(PLANT, DRIVER))
STRETCH_RATE = Topic(
    'stretch_rate', _FLOAT, SAMPLES, 'The stretch rate alone, in 1/s.',
    publishers=(PLANT, DRIVER))
MARKERS = Topic(
    '~/markers', 'visualization_msgs/msg/MarkerArray', LATCHED,
    'Markers for a 3-D view. The plant publishes each deformed block, with arrows for its '
    'magnetisation and the field, at marker_rate while there is a subscriber; the planner '
    'publishes each block at its target whenever that changes.', publishers=(PLANT, PLANNER))
CLOCK_TOPIC = Topic(
    '/clock', 'rosgraph_msgs/msg/Clock', CLOCK,
    'Simulated time, published by the plant or the player if a parameter enables it.',
    publishers=(PLANT, PLAYER))
DIAGNOSTICS = Topic(
    '/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', RELIABLE,
    'Counters and health, once a second. Nodes use them to detect a second planner, plant or '
    'driver of a joint.', publishers=NODES, subscribers=(PLANNER, PLANT, DRIVER))

FOLLOW = Action(
    '~/follow_joint_trajectory', 'control_msgs/action/FollowJointTrajectory', PLANNER,
    'A trajectory as MoveIt sends it to a `joint_trajectory_controller`: with velocities a path, '
    'without them a sequence of setpoints. It succeeds if samples show that the actuator arrived.',
    Topic(
        '~/controller_state', 'control_msgs/msg/JointTrajectoryControllerState', RELIABLE,
        'The planned stretch and rate (`reference`), the newest sample (`feedback`), their '
        'difference (`error`) and the flux density in tesla (`output`), 20 times a second.'))

STOP = Service('~/stop', _TRIGGER, {
    PLANNER: 'Drops the rest of the sequence and comes to rest without vibration. It replies at '
             'once; `~/status` says once plant or driver has acknowledged the stop.',
    PLAYER: 'Ends playback.'})
RESET_ESTIMATE = Service('~/reset_estimate', _TRIGGER, {
    PLANNER: 'Discards the estimate: plans and estimates restart from the given parameters.'})
SAVE_ESTIMATE = Service('~/save_estimate', _TRIGGER, {
    PLANNER: 'Writes the estimate with its covariance to `feedback_file`, as a parameter file.'})
RESET = Service('~/reset', _TRIGGER, {
    PLANT: 'Returns the actuators to their initial states, or to reset_stretch and reset_rate; '
           'time continues.'})
STEP = Service('~/step', _TRIGGER, {
    PLANT: 'Advances a paused plant by step_count samples (default 1).'})
SET_PAUSED = Service('~/set_paused', 'std_srvs/srv/SetBool', {
    PLANT: 'Pauses or resumes simulated time.'})
PAUSE = Service('~/pause', _TRIGGER, {
    RECORDER: 'Pauses recording; messages that arrive meanwhile are not recorded.',
    PLAYER: 'Pauses playback.'})
RESUME = Service('~/resume', _TRIGGER, {
    RECORDER: 'Resumes recording.', PLAYER: 'Resumes playback.'})
TOGGLE_PAUSED = Service('~/toggle_paused', _TRIGGER, {PLAYER: 'Pauses or resumes playback.'})
IS_PAUSED = Service('~/is_paused', _TRIGGER, {
    RECORDER: '`success` says whether it is paused.',
    PLAYER: '`success` says whether it is paused.'})
PLAY_NEXT = Service('~/play_next', _TRIGGER, {PLAYER: 'Sends the next message while paused.'})
SNAPSHOT = Service('~/snapshot', _TRIGGER, {
    RECORDER: 'Writes the messages that a recorder in snapshot mode holds in memory.'})
SPLIT_BAGFILE = Service('~/split_bagfile', _TRIGGER, {
    RECORDER: 'Closes the current file and continues in a new one.'})


def of_joint(topic: Topic, joint: str, joints: Sequence[str]) -> Topic:
    """Return the topic of a joint, whose name it contains if there are several joints."""
    if len(joints) == 1:
        return topic
    start = '~/' if topic.name.startswith('~/') else ''
    return replace(topic, name=f'{start}{joint}/{topic.name.removeprefix(start)}')


def from_outside(name: str, node: str) -> str:
    """Return ``'~/stop'`` as ``'planner/stop'``; other names, or without a node, unchanged."""
    return f'{node}/{name[2:]}' if node and name.startswith('~/') else name
