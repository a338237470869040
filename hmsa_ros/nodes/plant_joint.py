"""One joint of the plant on the wire: commands and forces in, changes of level out."""

from collections.abc import Mapping, Sequence
import math
from typing import Any, Protocol

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import MagneticField
from std_msgs.msg import Float64

from hmsa_ros.core.actuators import Setup
from hmsa_ros.core.parameters import ActuatorParameters
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.core.watchdog import SAFE_FLUX, Watchdog
from hmsa_ros.errors import BadInputError
from hmsa_ros.nodes import conversions, interface
from hmsa_ros.nodes.guard import CommandInput
from hmsa_ros.nodes.parameters import ACTUATOR, INITIAL_STRETCH, ParameterSpec
from hmsa_ros.nodes.timekeeping import Seldom

MISMATCH = tuple(
    ParameterSpec(
        f'mismatch.{spec.name.partition(".")[2]}', 1.0,
        f'Factor on {spec.name}: what the plant has more or less of than the planner knows.',
        '', 1e-3, 1e3)
    for spec in ACTUATOR)

#: Parameters that each joint may have values of its own for.
OWN = (
    *ACTUATOR,
    INITIAL_STRETCH,
    *MISMATCH,
    ParameterSpec(
        'slew_limit', 0.0,
        'Rate at which the amplifier ramps to a commanded level; 0 for steps.', 'T/s',
        0.0, 1e12),
    ParameterSpec(
        'coil_time_constant', 0.0,
        'With which the field follows the amplifier, a lag of first order; 0 for at once.', 's',
        0.0, 1e3),
    ParameterSpec(
        'stretch_noise', 0.0, 'Standard deviation of the published stretch.', '', 0.0, 1e3),
    ParameterSpec(
        'rate_noise', 0.0, 'Standard deviation of the published stretch rate.', '1/s',
        0.0, 1e9),
    ParameterSpec(
        'command_timeout', 1.0,
        'Longest silence, in time that runs, of commands and heartbeats after the first one '
        'before the coil goes to safe_flux; 0 for any.', 's', 0.0, 1e6),
    ParameterSpec(
        'safe_flux', 'hold',
        'What the coil does then: hold what is commanded, zero at once, or ramp to zero. A real '
        'coil that must not be left on wants zero or ramp.', choices=SAFE_FLUX),
    ParameterSpec(
        'safe_ramp_rate', 1.0, 'Rate of the ramp to zero, in steps of a millisecond.', 'T/s',
        1e-9, 1e12),
    ParameterSpec(
        'reset_stretch', 0.0,
        'Stretch that ~/reset leads to, held by its flux density; 0 for initial_stretch.', '',
        0.0, 1e3, read_only=False),
    ParameterSpec(
        'reset_rate', 0.0, 'Stretch rate that ~/reset leads to.', '1/s', -1e9, 1e9,
        read_only=False),
)

_RAMP_STEP_NS = 1_000_000
_REASONS = {
    'hold': 'what is commanded stays (safe_flux hold)', 'zero': 'the field goes to zero',
    'ramp': 'the field ramps to zero'}


class Bench(Protocol):
    """What a joint asks of its plant."""

    @property
    def time(self) -> int:
        """Time in ns of the simulation."""

    @property
    def active(self) -> bool:
        """Whether commands are taken."""

    def take(self, joint: int, stamp: int, flux_density: float) -> None:
        """Have a command take effect, or refuse it with `BadInputError`."""

    def go_safe(self, joint: int, stamp: int, flux_density: float) -> None:
        """Have the level of the watchdog take effect."""

    def push(self, joint: int, stamp: int, force: float) -> None:
        """Have a force act, or refuse it with `BadInputError`."""

    def level(self, joint: int) -> float:
        """Return the level in force in T."""


class PlantJoint:
    """
    A simulated actuator on the wire.

    Parameters
    ----------
    node : rclpy.node.Node
        Node that it belongs to.
    bench : Bench
        Where its actuator is.
    number : int
        Its place among the joints.
    names : sequence of str
        Names of all joints of the node.
    values : mapping of str to object
        Parameters that hold for this joint.
    scalars : bool
        Whether to publish stretch and rate by themselves.

    Attributes
    ----------
    name : str
        Of the joint.
    commands : CommandInput
        Where its commands come in.
    watchdog : Watchdog
        Listens for them.
    received, refused, late, latest, failed : int
        Commands that came, were refused or late, the largest lateness in ns; and how often the
        simulation had to start again.

    """

    def __init__(
            self, node: Node, bench: Bench, number: int, names: Sequence[str],
            values: Mapping[str, Any], scalars: bool) -> None:
        """Create its topics."""
        self.name = names[number]
        self._node = node
        self._bench = bench
        self._number = number
        self._of_me = '' if len(names) == 1 else f'joint {self.name}: '
        self._timeout: float = values['command_timeout']
        self._safe: str = values['safe_flux']
        self._ramp_rate: float = values['safe_ramp_rate']
        self._ramp: tuple[int, float] | None = None
        self._crowded = False
        self._tell_refused, self._tell_late, self._tell_force = Seldom(), Seldom(), Seldom()
        self.watchdog = Watchdog(round(self._timeout * NANOSECONDS))
        self.received = self.refused = self.late = self.latest = self.failed = 0

        def publisher(topic: interface.Topic) -> Any:
            placed = interface.of_joint(topic, self.name, names)
            return node.create_publisher(placed.type, placed.name, placed.qos)

        self._applied = publisher(interface.FLUX_DENSITY_APPLIED)
        self._scalars = (publisher(interface.STRETCH), publisher(interface.STRETCH_RATE)) \
            if scalars else ()
        self.commands = CommandInput(
            node, interface.of_joint(interface.FLUX_DENSITY_COMMAND, self.name, names),
            self._on_command, values['command_source'])
        force = interface.of_joint(interface.DISTURBANCE_FORCE, self.name, names)
        node.create_subscription(force.type, force.name, self._on_force, force.qos)

    # -- out -----------------------------------------------------------------------------------

    def tell_applied(self, stamp: int, level: float) -> None:
        """Publish that a level has taken effect, at a stamp in ns and in T."""
        self._applied.publish(conversions.to_command(stamp, level, ''))

    def tell_scalars(self, stretch: float, rate: float) -> None:
        """Publish a measured stretch and rate in 1/s by themselves, where that is wanted."""
        if self._scalars:
            self._scalars[0].publish(Float64(data=stretch))
            self._scalars[1].publish(Float64(data=rate))

    # -- commands and forces -------------------------------------------------------------------

    def _on_command(self, message: MagneticField) -> None:
        if not self._bench.active:
            return
        self.received += 1
        try:
            stamp, flux_density = conversions.from_command(message)
            self._bench.take(self._number, stamp, flux_density)
        except BadInputError as error:
            self.refused += 1
            if self._tell_refused():
                self._node.get_logger().error(
                    f'{self._of_me}command refused, the one in force stays: {error}')

    def obeyed(self, late: int) -> None:
        """
        Note a command that has got through.

        Parameters
        ----------
        late : int
            How late it was in ns, 0 if it was in time or changed nothing.

        """
        self._ramp = None
        if self.watchdog.feed(self._bench.time):
            self._node.get_logger().info(f'{self._of_me}commands have come back')
        if late:
            self.late += 1
            self.latest = max(self.latest, late)
            if self._tell_late():
                self._node.get_logger().warning(
                    f'{self._of_me}command arrived {late / 1e6:.3f} ms after the time it '
                    'applies and was applied at once: raise lead_time of the planner')

    def _on_force(self, message: WrenchStamped) -> None:
        if not self._bench.active:
            return
        try:
            stamp, force = _from_wrench(message)
            self._bench.push(self._number, stamp, force)
        except BadInputError as error:
            if self._tell_force():
                self._node.get_logger().error(f'{self._of_me}disturbance refused: {error}')

    # -- silence -------------------------------------------------------------------------------

    def watch(self, until: int) -> None:
        """
        Go to the safe flux if nobody has commanded this joint for too long.

        Parameters
        ----------
        until : int
            Time in ns up to which is simulated next.

        """
        if self.watchdog.check(self._bench.time):
            self._node.get_logger().error(
                f'{self._of_me}no command and no heartbeat for {self._timeout:g} s: '
                f'{_REASONS[self._safe]}; is the planner running?')
            if self._safe == 'zero':
                self._bench.go_safe(self._number, self._bench.time, 0.0)
            elif self._safe == 'ramp':
                self._ramp = self._bench.time, self._bench.level(self._number)
        if self._ramp is None:
            return
        # A step each millisecond, so that what took effect is told exactly, like any command.
        begin, level = self._ramp
        for step in range(-(-(self._bench.time - begin) // _RAMP_STEP_NS),
                          (until - begin) // _RAMP_STEP_NS + 1):
            left = abs(level) - self._ramp_rate * step * _RAMP_STEP_NS / NANOSECONDS
            self._bench.go_safe(
                self._number, begin + step * _RAMP_STEP_NS, math.copysign(max(left, 0.0), level))
            if left <= 0.0:
                self._ramp = None
                return

    def start_again(self) -> None:
        """Forget the past after a reset: a first command arms the watchdog again."""
        self._ramp = None
        self.watchdog.disarm()

    def crowded(self) -> bool:
        """Return whether several publishers command this joint, and log it once."""
        count = self.commands.count()
        if count > 1 and not self._crowded:
            self._node.get_logger().warning(
                f'{self._of_me}{count} publishers command this joint: expected one; with '
                'command_source first only the first is obeyed')
        self._crowded = count > 1
        return self._crowded


def setup_from(values: Mapping[str, Any]) -> Setup:
    """
    Return the actuator that a joint's parameters describe.

    Parameters
    ----------
    values : mapping of str to object
        Those of `OWN`.

    Returns
    -------
    Setup
        With the block as it really is: its parameters times the mismatch.

    Raises
    ------
    BadInputError
        If a value is out of range.

    """
    names = [spec.name.partition('.')[2] for spec in ACTUATOR]
    return Setup(
        ActuatorParameters(**{
            name: values[f'actuator.{name}'] * values[f'mismatch.{name}'] for name in names}),
        values['initial_stretch'], values['slew_limit'] or math.inf,
        values['coil_time_constant'])


def _from_wrench(message: WrenchStamped) -> tuple[int, float]:
    """Return stamp in ns and force along the field in N of a disturbance."""
    force, torque = message.wrench.force, message.wrench.torque
    if not math.isfinite(force.z):
        raise BadInputError(f'force.z is {force.z:g} N: expected a finite number')
    if any((force.x, force.y, torque.x, torque.y, torque.z)):
        raise BadInputError(
            'a force across the field or a torque: expected force.z alone, the block moves '
            'along the field only')
    stamp = conversions.from_time(message.header.stamp)
    if stamp < 0:
        raise BadInputError(f'disturbing force stamped {stamp} ns: expected at least 0')
    return stamp, float(force.z)
