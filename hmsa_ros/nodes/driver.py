"""Driver node: writes timestamped commands to hardware, in place of the plant."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
import math
from time import monotonic_ns, time_ns
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import ParameterDescriptor
from std_msgs.msg import Bool

from hmsa.ending import Deadline, ENDING
from hmsa.errors import BadInputError, HmsaError, listed
from hmsa.interfaces import topics
from hmsa.interfaces.parameters import ParameterSpec, PUBLISH_RATE
from hmsa.model.units import NANOSECONDS
from hmsa_ros.device.coil import HardwareJoint
from hmsa_ros.device.hardware import Calls, load, OPTIONAL
from hmsa_ros.device.watchdog import Interlock, judge_hardware, judge_interlock
from hmsa_ros.device.worker import HardwareDevice, HardwareWorker
from hmsa_ros.nodes import conversions, ros_entities
from hmsa_ros.nodes.capture import decode
from hmsa_ros.nodes.device_node import COMMON, DeviceJoint, DeviceNode, FALLBACK, fallback_from
from hmsa_ros.nodes.managed import AUTOSTART, run
from hmsa_ros.nodes.parameters import declare_joints, JointParameters

# Time in s after which slow start-up of hardware is reported.
_PATIENCE = 5.0

#: Parameters that may have a separate value for each joint.
OWN = (
    ParameterSpec(
        'flux_density_limit', 0.5,
        'Largest flux density, of either sign, that is written; commands beyond it are refused.',
        'T', 1e-9, 1e3),
    ParameterSpec(
        'temperature_limit', 0.0,
        'Temperature of the coil, where the hardware reports it, above which the coil is switched '
        'off and commands are refused, until it is 5 degrees cooler; 0 for no limit.',
        'deg C', 0.0, 1e3),
    # A real coil is not left on.
    *(replace(x, default='zero') if x.name == 'safe_flux' else x for x in FALLBACK),
)

HARDWARE = ParameterSpec(
    'hardware.name', '',
    'Hardware class: serial_board (a board on a serial port), scpi_supply (a bench supply), topic '
    '(a topic of another node), or MODULE:NAME. NAME is called with the name of a joint, and '
    'returns an object with the methods write and read. MODULE is searched for like an import, '
    'and in the working directory. `hardware` is short for this parameter. Other parameters '
    'hardware.* are passed as keyword arguments; those of a joint (left.hardware.*) take '
    'precedence.')

TIMEOUT = ParameterSpec(
    'hardware.timeout', 1.0,
    'Time limit of a call of the hardware; if it is exceeded, the driver tries to switch off from '
    'another thread, and ends.', 's', 0.01, 1e3)

RECONNECT = ParameterSpec(
    'hardware.reconnect', False,
    'Whether to continue when failed hardware, as after a disconnected cable, obeys again; as '
    'after an open interlock, the coil is off until a new request. Otherwise the driver ends.')

INTERLOCK = (
    ParameterSpec(
        'interlock_required', False,
        'Whether a publisher must close ~/interlock, and repeat that within interlock_timeout, '
        'for commands to be obeyed; otherwise only a publisher that opens it counts, while the '
        'driver runs.'),
    ParameterSpec(
        'interlock_timeout', 0.5,
        'Longest silence of a publisher that closed a required ~/interlock.', 's', 0.01, 1e3),
)

# Parameters that look like settings of the hardware class but belong to the node.
_NOT_ITS_OWN = (HARDWARE.name, TIMEOUT.name, RECONNECT.name)
#: Alternative name for a start value of `HARDWARE`.
SHORT = 'hardware'

PARAMETERS = (
    AUTOSTART,
    HARDWARE,
    TIMEOUT,
    RECONNECT,
    *INTERLOCK,
    *OWN,
    *COMMON,
    replace(
        PUBLISH_RATE, minimum=0.0,
        description='Rate at which the hardware is read; 0 where there is no sensor.'),
)


class DriverNode(DeviceNode):
    """Pass commands to hardware in a separate thread, and publish results and samples."""

    device: HardwareDevice
    worker: HardwareWorker

    def __init__(self) -> None:
        super().__init__(topics.DRIVER)
        given = self._parameter_overrides
        if SHORT in given:
            # A name that is both a value and a namespace breaks ``ros2 param dump``.
            given.setdefault(HARDWARE.name, given.pop(SHORT))
        self.values = declare_joints(self, PARAMETERS, OWN)
        self._settings = {x: self._settings_of(x) for x in self.values.names}
        self.failure: HmsaError | None = None
        required, timeout = (self.values[x.name] for x in INTERLOCK)
        # An interlock that is open stays open when the driver is configured again.
        self._interlock = Interlock(required=required, timeout=round(timeout * NANOSECONDS))
        self.autostart()

    def _settings_of(self, joint: str) -> dict[str, Any]:
        """Declare the parameters of a hardware class; return their values."""
        found = {}
        for prefix in ('hardware.', f'{joint}.hardware.'):
            for name, parameter in self._parameter_overrides.items():
                if name.startswith(prefix) and name not in _NOT_ITS_OWN:
                    if not self.has_parameter(name):
                        self.declare_parameter(
                            name, parameter.value, ParameterDescriptor(read_only=True))
                    found[name.removeprefix(prefix)] = parameter.value
        return found

    def configure(self) -> None:
        """
        Switch the coils off, and create the topics.

        Raises
        ------
        HmsaError
            If parameters are out of range, or the hardware does not exist or does not respond.

        """
        if self.simulated:
            raise BadInputError(
                'use_sim_time is true: expected false, hardware follows the clock of the machine')
        name = self.values[HARDWARE.name]
        self.trouble = self.away = ''
        ENDING.go_on()
        with ENDING.by_default():
            self.worker = HardwareWorker(
                partial(_make_device, name, self.values, self._settings), time_ns,
                reconnect=self.values[RECONNECT.name])
            while not self.worker.started(_PATIENCE):
                self.get_logger().warning(
                    f'waiting for {name}: it has not started yet, or its first write has not '
                    'returned')
        self.device = self.worker.device
        self.get_logger().info(_described(self.device, self.values))
        self._lock = ros_entities.listen(self, topics.INTERLOCK)
        self._mind_interlock()
        self._open(DeviceJoint)

    @property
    def commanded(self) -> HardwareWorker:
        """The thread that serves the hardware, which receives the commands."""
        return self.worker

    def now(self) -> int:
        """Return the machine's time in ns."""
        return time_ns()

    def deactivate(self) -> None:
        """Switch the coils off."""
        self.worker.switch_off()

    def cleanup(self) -> None:
        """Switch the coils off, and release the hardware."""
        if self._joints:
            self.worker.close()
            self.failure = self.worker.failure
            self._lock.destroy()
        super().cleanup()

    def _mind_interlock(self) -> None:
        """Process messages about the interlock, and pass on whether it is open."""
        now = monotonic_ns()
        for taken in self._lock.take():
            try:
                closed = bool(decode(taken.data, Bool).data)
            except BadInputError:
                closed = False
            self._interlock.receive(
                taken.publisher, now, closed=closed,
                present=lambda: ros_entities.publishers_of(self, topics.INTERLOCK.name))
        before, why = self.worker.locked, self._interlock.look(now)
        self.worker.lock(why)
        if bool(why) != bool(before):
            if why:
                self.get_logger().error(f'interlock open, the coil goes off: {why}')
            else:
                self.get_logger().info(
                    'interlock closed: the next request moves the actuator again')
            if self._joints:
                self._diagnose()

    def _go_on(self) -> None:
        self._mind_interlock()
        self.worker.look_after()
        trouble = self.worker.trouble
        if trouble != (self.trouble or self.away):
            if trouble:
                self.get_logger().error(trouble)
            else:
                self.get_logger().info(
                    'the hardware responds again: the next request moves the actuator')
            if self.values[RECONNECT.name]:
                self.away = trouble
            else:
                self.trouble = trouble
                for joint in self._joints:
                    # Commands are no longer received, which planners can detect.
                    joint.close()
            self._diagnose()
        if self.worker.failure is not None:
            self.failure, self.finished = self.worker.failure, True

    def _report(self) -> Iterable[DiagnosticStatus]:
        yield from super()._report()
        yield conversions.to_status(
            f'{self.get_name()}: interlock', ', '.join(self.values.names),
            *judge_interlock(self._interlock.why),
            {'required': self._interlock.required, 'openings': self._interlock.openings})
        device = self.device
        level, message = judge_hardware(
            self.worker.trouble or device.too_warm, **device.counts)
        yield conversions.to_status(
            f'{self.get_name()}: hardware', ', '.join(self.values.names), level, message,
            {**device.counts, **device.facts})


def _make_device(
        name: str, values: JointParameters,
        settings: Mapping[str, Mapping[str, Any]]) -> HardwareDevice:
    """Return the device described by the parameters and the name of its hardware."""
    rate = values[PUBLISH_RATE.name]
    return HardwareDevice(
        [HardwareJoint(
            load(name, joint, settings[joint]), own['flux_density_limit'], fallback_from(own),
            joint, own['temperature_limit'] or math.inf)
         for joint, own in ((x, values.of(x)) for x in values.names)],
        time=time_ns(), period=max(round(NANOSECONDS / rate), 1) if rate else 0,
        calls=Calls(values[TIMEOUT.name], Deadline()))


def _described(device: HardwareDevice, values: JointParameters) -> str:
    """Return a description of the hardware in one line."""
    each = []
    for joint in device.coils:
        own, coil = values.of(joint.name), joint.instrument
        rate, safe = own[PUBLISH_RATE.name], own['safe_flux']
        optional = [x for x in OPTIONAL if coil.has(x)]
        each.append(
            f'{coil.name} for joint {joint.name}'
            f'{f" ({coil.description})" if coil.description else ""}'
            f'{f" with {listed(optional)}" if optional else ""}: limit {joint.limit:g} T, '
            f'resolution {_known(coil.resolution, "T")}, slew {_known(coil.slew, "T/s")}, '
            + (f'read at {rate:g} Hz' if rate else 'not read')
            + ('' if coil.clock_map is None else
               f', its clock known to {coil.clock_map.error * 1e6:.0f} us')
            + f', {safe} after '
            f'{own["command_timeout"]:g} s without a command')
    return f'{"; ".join(each)}; {TIMEOUT.name} {values[TIMEOUT.name]:g} s'


def _known(value: float | None, unit: str) -> str:
    return 'not given' if value is None else f'{value:g} {unit}'


#: Run by ``hmsa driver`` with the command line's arguments; returns the exit status.
main = partial(run, DriverNode)
