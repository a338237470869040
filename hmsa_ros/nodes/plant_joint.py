"""One joint of the plant: what it simulates, and the forces that disturb it."""

from collections.abc import Mapping
import math
from typing import Any

from geometry_msgs.msg import WrenchStamped

from hmsa_ros.control.seldom import Seldom
from hmsa_ros.device.sensor import SensorErrors
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.errors import BadInputError
from hmsa_ros.interfaces import topics
from hmsa_ros.interfaces.actuator import actuator_from, creep_from
from hmsa_ros.interfaces.parameters import (
    BLOCK,
    COIL_TIME_CONSTANT,
    INITIAL_STRETCH,
    MISMATCH,
    ParameterSpec,
    SLEW_LIMIT,
    VISCOELASTIC,
)
from hmsa_ros.model.actuators import check_stretch, Setup
from hmsa_ros.nodes import conversions, endpoints
from hmsa_ros.nodes.device_node import DeviceJoint, DeviceNode, FALLBACK, fallback_from

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
    *FALLBACK,
    ParameterSpec(
        'reset_stretch', 0.0,
        'Stretch after ~/reset, held by its equilibrium flux density; 0 for initial_stretch.', '',
        -1.0, 1e3, read_only=False),
    ParameterSpec(
        'reset_rate', 0.0, 'Stretch rate after ~/reset.', '1/s', -1e9, 1e9,
        read_only=False),
)


class PlantJoint(DeviceJoint):
    """A simulated actuator on the wire, which forces may disturb."""

    _device: SimulatedDevice

    def __init__(self, node: DeviceNode, number: int) -> None:
        super().__init__(node, number)
        self._tell_force = Seldom()
        endpoints.subscribe(node, topics.of_joint(
            topics.DISTURBANCE_FORCE, self.name, node.values.names), self._on_force)

    def _on_force(self, message: WrenchStamped) -> None:
        if not self._node.active:
            return
        try:
            self._device.push(self._number, *_from_wrench(message))
        except BadInputError as error:
            if self._tell_force():
                self._node.get_logger().error(f'{self._of_me}disturbance refused: {error}')


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
        fallback_from(values),
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
