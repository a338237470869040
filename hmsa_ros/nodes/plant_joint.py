"""One joint of the plant on the wire: commands and forces in, changes of level out."""

from collections.abc import Callable, Mapping, Sequence
import math
from typing import Any

from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import MagneticField

from hmsa_ros.contract.actuator import actuator_from, creep_from
from hmsa_ros.contract.parameters import (
    BLOCK,
    COIL_TIME_CONSTANT,
    INITIAL_STRETCH,
    MISMATCH,
    ParameterSpec,
    SLEW_LIMIT,
    VISCOELASTIC,
)
from hmsa_ros.core.actuators import check_stretch, Setup
from hmsa_ros.device.protocol import Change, Kind, Notice
from hmsa_ros.device.sensor import SensorErrors
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.device.watchdog import Fallback, SAFE_FLUX
from hmsa_ros.errors import BadInputError
from hmsa_ros.nodes import conversions, interface
from hmsa_ros.nodes.guard import CommandInput
from hmsa_ros.nodes.managed import ManagedNode
from hmsa_ros.nodes.timekeeping import Seldom

#: Parameters that each joint may have values of its own for.
OWN = (
    *BLOCK,
    INITIAL_STRETCH,
    *MISMATCH,
    *VISCOELASTIC,
    SLEW_LIMIT,
    COIL_TIME_CONSTANT,
    ParameterSpec(
        'stretch_noise', 0.0, 'Standard deviation of the noise on the published stretch.',
        '', 0.0, 1e3),
    ParameterSpec(
        'rate_noise', 0.0, 'Standard deviation of the noise on the published stretch rate.', '1/s',
        0.0, 1e9),
    ParameterSpec(
        'stretch_bias', 0.0, 'Sensor bias, added to the published stretch.', '', -1e3, 1e3),
    ParameterSpec(
        'stretch_gain', 1.0,
        'Sensor gain, a factor on the published stretch and stretch rate.', '', 1e-3, 1e3),
    ParameterSpec(
        'command_timeout', 1.0,
        'Watchdog: longest time without command or heartbeat, after the first one, before the '
        'coil does what safe_flux says; 0 disables it. Paused time does not count.',
        's', 0.0, 1e6),
    ParameterSpec(
        'safe_flux', 'hold',
        'What the coil does when the watchdog trips: hold the commanded level, go to zero, or '
        'ramp to zero. Use zero or ramp for a real coil that must not be left on.',
        choices=SAFE_FLUX),
    ParameterSpec(
        'safe_ramp_rate', 1.0, 'Rate of the ramp to zero, which has steps of 1 ms.', 'T/s',
        1e-9, 1e12),
    ParameterSpec(
        'reset_stretch', 0.0,
        'Stretch after ~/reset, held by its equilibrium flux density; 0 for initial_stretch.', '',
        -1.0, 1e3, read_only=False),
    ParameterSpec(
        'reset_rate', 0.0, 'Stretch rate after ~/reset.', '1/s', -1e9, 1e9,
        read_only=False),
)


class PlantJoint:
    """
    A simulated actuator on the wire; it obeys ``commands`` while its node is active.

    ``received``, ``refused``, ``late`` and ``failed`` count commands that came, were refused or
    late, and how often the simulation had to start again; ``latest`` is the largest lateness in
    ns.
    """

    def __init__(
            self, node: ManagedNode, device: SimulatedDevice, number: int,
            names: Sequence[str], values: Mapping[str, Any], companion: str = '') -> None:
        """Create its topics."""
        self.name = names[number]
        self._node = node
        self._device = device
        self._number = number
        self._of_me = '' if len(names) == 1 else f'joint {self.name}: '
        self._crowded = False
        self._tell_refused, self._tell_late, self._tell_force = Seldom(), Seldom(), Seldom()
        self.received = self.refused = self.late = self.latest = self.failed = 0

        self._applied = interface.publisher(
            node, interface.of_joint(interface.FLUX_DENSITY_APPLIED, self.name, names))
        self.commands = CommandInput(
            node, interface.of_joint(interface.FLUX_DENSITY_COMMAND, self.name, names),
            self._on_command, values['command_source'], companion)
        force = interface.of_joint(interface.DISTURBANCE_FORCE, self.name, names)
        node.create_subscription(force.type, force.name, self._on_force, force.qos)

    # -- out -----------------------------------------------------------------------------------

    def publish_applied(self, change: Change) -> None:
        """Publish that a level has taken effect."""
        self._applied.publish(conversions.to_command(change.stamp, change.level, ''))

    def log(self, notice: Notice) -> None:
        """Count and log what the device has noticed."""
        logger = self._node.get_logger()
        text = f'{self._of_me}{notice.text}'
        if notice.kind == Kind.LATE:
            self.late += 1
            self.latest = max(self.latest, notice.late)
            if self._tell_late():
                logger.warning(text)
        elif notice.kind == Kind.HEARD:
            logger.info(text)
        else:
            self.failed += notice.kind == Kind.FAILED
            logger.error(text)

    # -- in ------------------------------------------------------------------------------------

    def _on_command(self, message: MagneticField) -> None:
        self._obey(lambda: conversions.from_command(message))

    def command(self, stamp: int, level: float) -> None:
        """Obey a level in T from a stamp in ns on, from a planner in the same process."""
        self._obey(lambda: (stamp, level))

    def _obey(self, read: Callable[[], tuple[int, float]]) -> None:
        if not self._node.active:
            return
        self.received += 1
        try:
            self._device.receive(self._number, *read())
        except BadInputError as error:
            self.refused += 1
            if self._tell_refused():
                self._node.get_logger().error(
                    f'{self._of_me}command refused, the previous one stays in force: {error}')

    def _on_force(self, message: WrenchStamped) -> None:
        if not self._node.active:
            return
        try:
            self._device.push(self._number, *_from_wrench(message))
        except BadInputError as error:
            if self._tell_force():
                self._node.get_logger().error(f'{self._of_me}disturbance refused: {error}')

    def crowded(self) -> bool:
        """Return whether several publishers command this joint, and log it once."""
        count = self.commands.count()
        if count > 1 and not self._crowded:
            self._node.get_logger().warning(
                f'{self._of_me}{count} publishers command this joint: expected one; with '
                'command_source first only the first is obeyed')
        self._crowded = count > 1
        return self._crowded


def joint_from(values: Mapping[str, Any]) -> SimulatedJoint:
    """Return the joint that the values of `OWN` describe: the block times the mismatch."""
    actuator = actuator_from(values)
    if values['reset_stretch']:
        check_stretch(
            values['reset_stretch'], actuator.nondimensional, 'reset_stretch')
    return SimulatedJoint(
        Setup(
            actuator, values['initial_stretch'], values['slew_limit'] or math.inf,
            values['coil_time_constant'], creep_from(values)),
        Fallback(values['command_timeout'], values['safe_flux'], values['safe_ramp_rate']),
        SensorErrors(
            values['stretch_noise'], values['rate_noise'], values['stretch_bias'],
            values['stretch_gain']))


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
