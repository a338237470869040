"""One joint of a device on the wire: commands in, changes of level out."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sensor_msgs.msg import MagneticField

from hmsa_ros.contract import topics
from hmsa_ros.contract.parameters import ParameterSpec
from hmsa_ros.device.protocol import Change, Kind, Notice
from hmsa_ros.device.watchdog import Device, Fallback, SAFE_FLUX
from hmsa_ros.device.worker import HardwareWorker
from hmsa_ros.errors import BadInputError
from hmsa_ros.nodes import conversions, interface
from hmsa_ros.nodes.guard import CommandInput
from hmsa_ros.nodes.managed import ManagedNode
from hmsa_ros.nodes.timekeeping import Seldom

#: What a joint does when nobody commands it; each may have values of its own.
FALLBACK = (
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
)


def fallback_from(values: Mapping[str, Any]) -> Fallback:
    """Return what the values of `FALLBACK` describe."""
    return Fallback(values['command_timeout'], values['safe_flux'], values['safe_ramp_rate'])


class DeviceJoint:
    """
    An actuator on the wire; it obeys ``commands`` while its node is active.

    ``received``, ``refused``, ``late`` and ``failed`` count commands that came, were refused or
    late, and how often the device failed; ``latest`` is the largest lateness in ns.
    """

    def __init__(
            self, node: ManagedNode, device: Device | HardwareWorker, number: int,
            names: Sequence[str], values: Mapping[str, Any], companion: str = '') -> None:
        self.name = names[number]
        self._node = node
        self._device = device
        self._number = number
        self._of_me = '' if len(names) == 1 else f'joint {self.name}: '
        self._crowded = False
        self._tell_refused, self._tell_late = Seldom(), Seldom()
        self.received = self.refused = self.late = self.latest = self.failed = 0
        self._applied = interface.publisher(
            node, topics.of_joint(topics.FLUX_DENSITY_APPLIED, self.name, names))
        self.commands = CommandInput(
            node, topics.of_joint(topics.FLUX_DENSITY_COMMAND, self.name, names),
            self._on_command, values['command_source'], companion)

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

    def crowded(self) -> bool:
        """Return whether several publishers command this joint, and log it once."""
        count = self.commands.count()
        if count > 1 and not self._crowded:
            self._node.get_logger().warning(
                f'{self._of_me}{count} publishers command this joint: expected one; with '
                'command_source first only the first is obeyed')
        self._crowded = count > 1
        return self._crowded
