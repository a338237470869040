"""Plant node: simulated actuators, driven by timestamped flux density commands."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
import math
from time import monotonic_ns
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rclpy.publisher import Publisher
from sensor_msgs.msg import Temperature

from hmsa.errors import BadInputError, check_number
from hmsa.interfaces import parameters as shared
from hmsa.interfaces import topics
from hmsa.interfaces.actuator import planned_from, too_few_samples
from hmsa.interfaces.parameters import ParameterSpec
from hmsa.model.actuators import Setup, unheld
from hmsa.model.sensor import SensorErrors
from hmsa.model.units import NANOSECONDS
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.nodes import conversions, ros_entities
from hmsa_ros.nodes.device_node import COMMON, DeviceJoint, DeviceNode, FALLBACK, fallback_from
from hmsa_ros.nodes.managed import AUTOSTART, run
from hmsa_ros.nodes.markers import (
    MARKER_FRAME,
    MARKER_RATE,
    MARKER_SCALE,
    MarkerState,
    show_states,
)
from hmsa_ros.nodes.parameters import declare_joints, JointParameters
from hmsa_ros.timekeeping import RealTimeFactor, StepWatch

#: Parameters that may have a separate value for each joint.
OWN = (
    *shared.BLOCK,
    shared.INITIAL_STRETCH,
    *shared.MISMATCH,
    *shared.VISCOELASTIC,
    shared.SLEW_LIMIT,
    shared.COIL_TIME_CONSTANT,
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
        'reset_rate', 0.0, 'Stretch rate after ~/reset.', '1/s', -1e9, 1e9, read_only=False),
)


# Interval in ns, in simulated time, of the temperature.
_TEMPERATURE_NS = 200_000_000


class PlantJoint(DeviceJoint):
    """A simulated actuator, which forces may disturb, and its coil or a heater warm."""

    _device: SimulatedDevice

    def __init__(self, node: DeviceNode, number: int) -> None:
        super().__init__(node, number)
        ros_entities.subscribe(node, topics.of_joint(
            topics.DISTURBANCE_FORCE, self.name, node.values.names), self._on_force)
        topic = topics.of_joint(topics.TEMPERATURE, self.name, node.values.names)
        self._temperature: Publisher | None = None
        self._warmed = -_TEMPERATURE_NS
        if self._device.warms(number):
            self._temperature = ros_entities.publisher(node, topic)
        elif number in self._device.temperatures:
            ros_entities.subscribe(node, topic, self._on_temperature)

    def publish_temperature(self) -> None:
        """Publish the temperature of a block that its coil warms, if that is due."""
        time = self._device.time
        if self._temperature is not None and abs(time - self._warmed) >= _TEMPERATURE_NS:
            self._warmed = time
            self._temperature.publish(conversions.to_temperature(
                time, self._device.temperatures[self._number]))

    def _on_temperature(self, message: Temperature) -> None:
        if not self._node.active:
            return
        try:
            self._device.set_temperature(self._number, message.temperature)
        except BadInputError as error:
            self._node.get_logger().error(
                f'{self._of_me}temperature ignored: {error}', throttle_duration_sec=1.0)

    def _on_force(self, message: WrenchStamped) -> None:
        if not self._node.active:
            return
        try:
            self._device.push(self._number, *_from_wrench(message))
        except BadInputError as error:
            self._node.get_logger().error(
                f'{self._of_me}disturbance refused: {error}', throttle_duration_sec=1.0)


def _joints_from(values: JointParameters) -> dict[str, SimulatedJoint]:
    """Return the joints that the values of `OWN` describe, including the mismatch."""
    def joint(_: str, own: Mapping[str, Any]) -> SimulatedJoint:
        actuator = planned_from(own)
        if own['reset_stretch']:
            actuator.nondimensional.check(own['reset_stretch'], 'reset_stretch')
        return SimulatedJoint(
            Setup(
                actuator, own['initial_stretch'], own['slew_limit'] or math.inf,
                own['coil_time_constant']),
            fallback_from(own),
            SensorErrors(*(own[x] for x in (
                'stretch_noise', 'rate_noise', 'stretch_bias', 'stretch_gain'))))

    return values.each(joint)


def _from_wrench(message: WrenchStamped) -> tuple[int, float]:
    """Return timestamp in ns and force along the field in N of a disturbance."""
    force, torque = message.wrench.force, message.wrench.torque
    check_number('force.z', force.z, 'N')
    if any((force.x, force.y, torque.x, torque.y, torque.z)):
        raise BadInputError(
            'there is a force across the field, or a torque: expected force.z alone, since the '
            'block moves along the field only')
    stamp = conversions.from_time(message.header.stamp)
    if stamp < 0:
        raise BadInputError(f'disturbing force has timestamp {stamp} ns: expected at least 0')
    return stamp, float(force.z)


PARAMETERS = (
    AUTOSTART,
    *OWN,
    *COMMON,
    ParameterSpec(
        'command_delay', 0.0,
        'Simulated transport delay of commands.', 's', 0.0, 1e3),
    ParameterSpec(
        'measurement_delay', 0.0,
        'Simulated transport delay of samples: they are published this long after their '
        'timestamp.', 's', 0.0, 1e3),
    ParameterSpec(
        'seed', 0, 'Seed of the noise; the same seed gives the same run.', '', 0, 2**31 - 1),
    shared.PUBLISH_RATE,
    ParameterSpec(
        'publish_clock', False,
        'Whether the plant publishes /clock as the source of simulated time; leave its own '
        'use_sim_time false then.'),
    ParameterSpec(
        'real_time_factor', 1.0,
        'Simulated seconds per real second when the plant publishes /clock; 0 for as fast as '
        'possible.', '', 0.0, 1e6, read_only=False),
    ParameterSpec(
        'start_time', 1.0,
        'Initial simulated time; above 0, because a ROS clock at 0 has not started.', 's',
        1e-3, 1e9),
    ParameterSpec(
        'start_paused', False, 'Whether to start paused, until ~/set_paused is called.'),
    ParameterSpec(
        'step_count', 1, 'Number of samples that ~/step advances.', '', 1, 100_000,
        read_only=False),
    MARKER_FRAME,
    MARKER_RATE,
    MARKER_SCALE,
)

# Time in ns of each tick for samples; the rest is for commands and services.
_BUDGET_NS = 800_000
_PAUSED_CLOCK_NS = 100_000_000


class PlantNode(DeviceNode):
    """Advance a `SimulatedDevice` along a clock, and publish its samples and changes."""

    _joints: Sequence[PlantJoint] = ()

    def __init__(self) -> None:
        super().__init__(topics.PLANT)
        self.values = declare_joints(self, PARAMETERS, OWN)
        self.on_change(self._take_parameters)
        self._pacer = RealTimeFactor(0, 1.0)
        self._clock_seen = 0
        self._steps = StepWatch()
        self.autostart()

    def configure(self) -> None:
        """
        Create actuators, topics and services; time does not run yet.

        Raises
        ------
        BadInputError
            If the parameters are inconsistent.

        """
        values = self.values
        self._authority: bool = values['publish_clock']
        if self._authority and self.simulated:
            raise BadInputError(
                'publish_clock and use_sim_time are both true: expected a plant that either '
                'leads simulated time or follows it')
        start = round(values['start_time'] * NANOSECONDS) if self._authority else 0
        factor = values['real_time_factor'] if self._authority else 1.0
        joints = _joints_from(values)
        for name, joint in joints.items():
            for odd in (too_few_samples(joint.setup.actuator, values['publish_rate']),
                        unheld(joint.setup.actuator.nondimensional)):
                if odd:
                    self.get_logger().warning(f'joint {name}: {odd}')
        self.device = SimulatedDevice(
            [*joints.values()], period=max(round(NANOSECONDS / values['publish_rate']), 1),
            time=start, command_delay=round(values['command_delay'] * NANOSECONDS),
            measurement_delay=round(values['measurement_delay'] * NANOSECONDS),
            seed=values['seed'])
        self._pacer = RealTimeFactor(start, factor, paused=values['start_paused'])
        self._clock_published = 0
        self._measured = (start, monotonic_ns())
        self._clocks_warned = False
        # Time in ns that was skipped because the plant fell behind, since the last report.
        self._fell = 0

        self._clock_publisher = (
            ros_entities.publisher(self, topics.CLOCK_TOPIC) if self._authority else None)
        self._open(PlantJoint)
        show_states(self, values, factor, self._states)
        self.offer(topics.RESET, self._on_reset)
        self.offer(topics.STEP, self._on_step)
        self.offer(topics.SET_PAUSED, self._on_set_paused)

    def activate(self) -> None:
        """Let time run, from its present value."""
        self._pacer.set_paused(self._pacer.paused, self.device.time)

    def deactivate(self) -> None:
        """Stop time; pending commands are lost."""
        self.device.drop_commands()

    # -- time ----------------------------------------------------------------------------------

    @property
    def _standing(self) -> bool:
        """Whether time is stopped."""
        return self._pacer.paused or not self.active

    @property
    def leading_time(self) -> int | None:
        """Simulated time in ns, if this plant publishes the clock."""
        return self.device.time if self._joints and self._authority else None

    def _stood_still(self, span: int) -> None:
        """Have the simulation catch up, or continue from its time if that leads."""
        if self._authority:
            self._pacer.set_paused(self._pacer.paused, self.device.time)
        elif not self.simulated and not self._standing:
            super()._stood_still(span)

    def _go_on(self) -> None:
        """Simulate up to the present time, scaled by the real-time factor if leading."""
        if not self._authority:
            self._follow()
            return
        steady = monotonic_ns()
        if self._standing:
            if steady - self._clock_published >= _PAUSED_CLOCK_NS:
                self._publish_clock(steady)
            return
        self._run(self._pacer.target(steady))

    def _follow(self) -> None:
        """Advance to the node's clock: the wall clock, or a /clock of another node."""
        # Without simulated time, the wall clock of rclpy, without creating objects.
        now, by = (self.now(), 0) if self.simulated else self._steps.read()
        if now == 0:
            return
        if by:
            self._clock_seen += by
            self.device.clock_set(by)
        behind = now - self._clock_seen < 1_000_000_000
        self._clock_seen = now
        jump = self.device.follow(now, standing=self._standing)
        if jump:
            self._fell += max(jump, 0) if behind else 0
            seconds = abs(jump) / 1e9
            self.get_logger().warning(
                f'the clock jumped back by {seconds:.3f} s: the simulation starts again from its '
                'initial state' if jump < 0 else
                (f'the plant fell {seconds:.3f} s behind the clock (lower publish_rate)'
                 if behind else f'the clock jumped ahead by {seconds:.3f} s')
                + ': the simulation continues from there in its present state',
                throttle_duration_sec=1.0)
        if not self._standing:
            self._run(now)

    def _run(self, target: float) -> None:
        """Simulate up to a time in ns, for about `_BUDGET_NS` of real time at most."""
        begin = monotonic_ns()
        while self.device.next_sample <= target and monotonic_ns() - begin < _BUDGET_NS:
            self._sample()

    def _sample(self) -> None:
        self._advance()
        self._publish_news()

    def _advance(self) -> None:
        self.device.advance(self.device.next_sample)
        self._publish_clock(monotonic_ns())

    # -- other publications --------------------------------------------------------------------

    def _publish_news(self) -> None:
        if self.device.temperatures:
            for joint in self._joints:
                joint.publish_temperature()
        super()._publish_news()

    def _states(self) -> tuple[int, list[MarkerState]]:
        """Return time and state of the joints, for viewers."""
        device = self.device
        return device.time, [MarkerState(*x) for x in zip(
            device.stretch.tolist(), device.flux_density.tolist(), strict=True)]

    def _publish_clock(self, steady: int) -> None:
        if self._clock_publisher is not None:
            self._clock_publisher.publish(conversions.to_clock(self.device.time))
        self._clock_published = steady

    # -- services and parameters ---------------------------------------------------------------

    def _on_reset(self) -> tuple[bool, str]:
        where = []
        for i, joint in enumerate(self._joints):
            values = self.values.of(joint.name)
            rate = values['reset_rate']
            self.device.restart(i, values['reset_stretch'] or None, rate)
            how = f'at rate {rate:g}/s' if rate else 'at rest'
            where.append(f'{how} at {self.device.coordinates[i]} {self.device.stretch[i]:g}')
        self.device.drop_commands()
        self._publish_news()
        return True, where[0] if len(where) == 1 else ', '.join(
            f'{joint.name} {text}' for joint, text in zip(self._joints, where, strict=True))

    def _on_step(self) -> tuple[bool, str]:
        if not self._authority:
            return False, 'the plant follows a clock: expected publish_clock true'
        if not self._pacer.paused:
            return False, 'the plant is running: expected it paused (~/set_paused)'
        if not self.active:
            return False, f'the plant is {self.state}: expected it active'
        self._poll_commands()
        for _ in range(self.values['step_count']):
            before = self.device.time
            while self.device.time == before:
                # The first sample is the start itself.
                self._sample()
        self._pacer.set_paused(True, self.device.time)
        return True, f'at {self.device.time / 1e9:.9f} s'

    def _on_set_paused(self, paused: bool) -> tuple[bool, str]:
        self._pacer.set_paused(paused, self.device.time)
        return True, 'paused' if paused else 'running'

    def _take_parameters(self, given: Mapping[str, Any]) -> None:
        changed = self.values.changed(given)
        _joints_from(changed)
        self.values = changed
        factor = changed['real_time_factor']
        if self._joints and self._authority and factor != self._pacer.factor:
            self._pacer.set_factor(factor, self.device.time)

    # -- reports -------------------------------------------------------------------------------

    def _report(self) -> Iterable[DiagnosticStatus]:
        yield self._status_of_commands(
            paused=self._pacer.paused, **conversions.coordinates(dict(zip(
                (x.name for x in self._joints), self.device.coordinates, strict=True))))
        yield self._status_of_time()

    def _status_of_time(self) -> DiagnosticStatus:
        then, since = self._measured
        steady = monotonic_ns()
        self._measured = (self.device.time, steady)
        achieved = (self.device.time - then) / max(steady - since, 1) if then else 0.0
        level = 0
        message = f'time is held, {self.state}' if self._standing else 'time runs'
        if self._fell:
            level = 1
            message = (f'the plant fell {self._fell / NANOSECONDS:.3f} s behind the clock: lower '
                       'publish_rate')
        self._fell = 0
        clocks = self.count_publishers(topics.CLOCK_TOPIC.name)
        if clocks > 1 and (self._authority or self.simulated):
            level = 1
            message = f'{clocks} publishers of /clock: expected one'
            if self._authority:
                message = (f'{message}, this plant, which is the authority on simulated time '
                           '(publish_clock)')
            if not self._clocks_warned:
                self.get_logger().warning(
                    f'{message}; nodes see time go back and forth until the others end')
        self._clocks_warned = clocks > 1
        requested = self._pacer.factor
        return conversions.to_status(
            f'{self.get_name()}: time', '', level, message,
            {'state': self.state, 'real_time_factor': f'{requested:g}',
             'real_time_factor_achieved': f'{achieved:.3f}', 'clock_publishers': clocks})


#: Run by ``hmsa plant`` with the command line's arguments; returns the exit status.
main = partial(run, PlantNode)
