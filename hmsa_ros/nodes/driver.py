"""Driver node: real hardware in the place of the plant, written to at the stamps of commands."""

from dataclasses import replace
from functools import partial
from time import time_ns

from hmsa_ros.contract import topics
from hmsa_ros.contract.parameters import JOINT, ParameterSpec, PUBLISH_RATE
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.device.hardware import HardwareDevice, HardwareJoint, load
from hmsa_ros.device.worker import HardwareWorker
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.nodes.device_node import (
    COMMAND_SOURCE,
    DeviceJoint,
    DeviceNode,
    FALLBACK,
    fallback_from,
    PUBLISH_SCALARS,
)
from hmsa_ros.nodes.joints import declare_joints, JointParameters, JOINTS
from hmsa_ros.nodes.managed import AUTOSTART
from hmsa_ros.nodes.runner import run

#: Parameters that each joint may have values of its own for.
OWN = (
    ParameterSpec(
        'flux_density_limit', 0.5,
        'Largest flux density, of either sign, that is written; commands beyond it are refused.',
        'T', 1e-9, 1e3),
    # A real coil is not left on.
    *(replace(x, default='zero') if x.name == 'safe_flux' else x for x in FALLBACK),
)

HARDWARE = ParameterSpec(
    'hardware', '',
    'What writes and reads, as MODULE:NAME: called with the name of a joint, it returns an object '
    'with the methods write and read. The module is found as an import finds it, or in the '
    'working directory.')

PARAMETERS = (
    AUTOSTART,
    HARDWARE,
    *OWN,
    JOINT,
    JOINTS,
    COMMAND_SOURCE,
    replace(
        PUBLISH_RATE, minimum=0.0,
        description='Rate at which the hardware is read; 0 where there is no sensor.'),
    PUBLISH_SCALARS,
)


class DriverNode(DeviceNode):
    """Passes commands to hardware, which a thread serves, and publishes what comes of it."""

    device: HardwareWorker

    def __init__(self) -> None:
        super().__init__(topics.DRIVER)
        self.values = declare_joints(
            self, [x for x in PARAMETERS if x is not AUTOSTART], OWN)
        self.failure: HmsaError | None = None
        self.autostart()

    def configure(self) -> None:
        """
        Switch the coils off, and create the topics.

        Raises
        ------
        BadInputError
            If parameters are out of range, or there is no such hardware.

        """
        if self.get_parameter('use_sim_time').value:
            raise BadInputError(
                'use_sim_time is true: expected false, hardware follows the clock of the machine')
        self.device = HardwareWorker(_make_device(self.values), time_ns)
        self._open(DeviceJoint)

    def now(self) -> int:
        """Return the machine's time in ns."""
        return time_ns()

    def deactivate(self) -> None:
        """Switch the coils off."""
        self.device.switch_off()

    def cleanup(self) -> None:
        """Switch the coils off, and leave the hardware alone."""
        if self._joints:
            self.device.close()
        super().cleanup()

    def _go_on(self) -> None:
        if self.device.failure is not None:
            self.failure, self.finished = self.device.failure, True


def _make_device(values: JointParameters) -> HardwareDevice:
    """Return the device that parameters describe, with its coils switched off."""
    make = load(values[HARDWARE.name])
    rate = values[PUBLISH_RATE.name]
    return HardwareDevice(
        [HardwareJoint(make(name), own['flux_density_limit'], fallback_from(own))
         for name, own in ((x, values.of(x)) for x in values.names)],
        time=time_ns(), period=max(round(NANOSECONDS / rate), 1) if rate else 0)


#: Run by ``hmsa driver`` with the command line's arguments; returns the exit status.
main = partial(run, DriverNode)
