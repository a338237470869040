"""Plant node: the simulated actuator, driven by stamped flux density commands."""

from collections.abc import Callable, Sequence
import math
from time import monotonic_ns

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import MagneticField
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

from hmsa_ros.core.pacer import Pacer
from hmsa_ros.core.simulation import ActuatorSimulation
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.core.warmup import warm_up
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.nodes import conversions, interface
from hmsa_ros.nodes.parameters import (
    ACTUATOR,
    actuator_from,
    declare,
    INITIAL_STRETCH,
    JOINT,
    ParameterSpec,
)
from hmsa_ros.nodes.runner import run

PARAMETERS = (
    *ACTUATOR,
    JOINT,
    INITIAL_STRETCH,
    ParameterSpec(
        'slew_limit', 0.0,
        'Rate at which the amplifier ramps to a commanded level; 0 for steps.', 'T/s',
        0.0, 1e12),
    ParameterSpec(
        'publish_rate', 1000.0, "Samples per second of the plant's own time.", 'Hz',
        1e-3, 1e6),
    ParameterSpec(
        'publish_clock', False,
        'Whether the plant is the authority on simulated time and publishes /clock; leave '
        'use_sim_time of this node false then.'),
    ParameterSpec(
        'real_time_factor', 1.0,
        'Simulated seconds per second as authority on /clock; 0 for as fast as it can.', '',
        0.0, 1e6),
    ParameterSpec(
        'start_time', 1.0,
        'Simulated time to begin at, above 0 since a ROS clock at 0 has not started.', 's',
        1e-3, 1e9),
    ParameterSpec(
        'start_paused', False, 'Whether to wait for ~/set_paused before time runs.'),
)

_TICK_SECONDS = 0.001
# Of each tick, the share that samples may take; commands and services get the rest.
_BUDGET_NS = 800_000
# A gap of the clock that is not simulated through but skipped.
_LARGEST_GAP_NS = 5 * NANOSECONDS
_PAUSED_CLOCK_NS = 100_000_000


class PlantNode(Node):
    """Advances `ActuatorSimulation` along a clock and publishes its samples."""

    def __init__(self) -> None:
        """Declare, create and wait for time to run."""
        super().__init__(interface.PLANT)
        values = declare(self, PARAMETERS)
        self._joint: str = values['joint']
        self._period = max(round(NANOSECONDS / values['publish_rate']), 1)
        self._authority: bool = values['publish_clock']
        if self._authority and self.get_parameter('use_sim_time').value:
            raise BadInputError(
                'publish_clock and use_sim_time are both true: expected a plant that either '
                'leads simulated time or follows it')
        warm_up()
        start = round(values['start_time'] * NANOSECONDS) if self._authority else 0
        self._simulation = ActuatorSimulation(
            actuator_from(values), time=start, stretch=values['initial_stretch'],
            slew_limit=values['slew_limit'] or math.inf)
        self._pacer = Pacer(
            start, values['real_time_factor'] if self._authority else 1.0,
            paused=values['start_paused'])
        self._next_sample = start
        self._late = self._received = self._refused = self._failed = self._latest = 0
        self._clock_published = 0

        self._joint_states = self._publisher(interface.JOINT_STATES)
        self._stretch = self._publisher(interface.STRETCH)
        self._stretch_rate = self._publisher(interface.STRETCH_RATE)
        self._diagnostics = self._publisher(interface.DIAGNOSTICS)
        self._clock_publisher = (
            self._publisher(interface.CLOCK_TOPIC) if self._authority else None)
        command = interface.FLUX_DENSITY_COMMAND
        self.create_subscription(command.type, command.name, self._on_command, command.qos)
        self._serve(interface.RESET, self._on_reset)
        self._serve(interface.STEP, self._on_step)
        self._serve(interface.SET_PAUSED, self._on_set_paused)

        # Steady time: what to simulate is decided by the pacer or the node's clock, and the
        # tick only looks at it.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(
            _TICK_SECONDS, self._lead if self._authority else self._follow, clock=steady)
        self.create_timer(1.0, self._on_diagnostics, clock=steady)

    def _publisher(self, topic: interface.Topic):  # type: ignore[no-untyped-def]
        return self.create_publisher(topic.type, topic.name, topic.qos)

    def _serve(self, service: interface.Service, callback: Callable[..., object]) -> None:
        self.create_service(service.type, service.name, callback)

    # -- time ----------------------------------------------------------------------------------

    def _lead(self) -> None:
        """Advance simulated time at the real-time factor, and publish it."""
        steady = monotonic_ns()
        if self._pacer.paused:
            if steady - self._clock_published >= _PAUSED_CLOCK_NS:
                self._publish_clock(steady)
            return
        target = self._pacer.target(steady)
        while (self._pacer.unlimited or self._next_sample <= target) \
                and monotonic_ns() - steady < _BUDGET_NS:
            self._sample()

    def _follow(self) -> None:
        """Advance to the node's clock: the wall clock, or somebody else's /clock."""
        now = int(self.get_clock().now().nanoseconds)
        simulation = self._simulation
        if now == 0:
            return
        if simulation.time == 0:
            self._go_on_from(now)
        if now < simulation.time - self._period:
            self.get_logger().warning(
                f'the clock jumped back by {(simulation.time - now) / 1e9:.3f} s: the '
                'simulation starts again from its initial state')
            simulation.reset()
            self._go_on_from(now)
        elif self._pacer.paused:
            self._go_on_from(now)
            return
        elif now - simulation.time > _LARGEST_GAP_NS:
            self.get_logger().warning(
                f'the clock jumped ahead by {(now - simulation.time) / 1e9:.3f} s: the '
                'simulation goes on from there in its present state')
            self._go_on_from(now)
        begin = monotonic_ns()
        while (self._next_sample <= now and not self._pacer.paused
                and monotonic_ns() - begin < _BUDGET_NS):
            self._sample()

    def _go_on_from(self, now: int) -> None:
        """Set the time without simulating up to it; samples lie on a grid from time zero."""
        self._simulation.time = now
        self._next_sample = -(-now // self._period) * self._period

    def _sample(self) -> None:
        """Advance to the next sample and publish it."""
        simulation = self._simulation
        try:
            simulation.advance(self._next_sample)
        except HmsaError as error:
            self._failed += 1
            self.get_logger().error(
                f'{error}; the simulation starts again from its initial state')
            simulation.reset()
            simulation.time = self._next_sample
        self._next_sample += self._period
        self._publish_clock(monotonic_ns())
        stretch, rate = simulation.stretch, simulation.rate
        self._joint_states.publish(conversions.to_joint_state(
            simulation.time, self._joint, stretch, rate, simulation.flux_density))
        self._stretch.publish(Float64(data=stretch))
        self._stretch_rate.publish(Float64(data=rate))

    def _publish_clock(self, steady: int) -> None:
        if self._clock_publisher is not None:
            self._clock_publisher.publish(conversions.to_clock(self._simulation.time))
        self._clock_published = steady

    # -- commands and services -----------------------------------------------------------------

    def _on_command(self, message: MagneticField) -> None:
        self._received += 1
        try:
            stamp, flux_density = conversions.from_command(message)
            late = self._simulation.command(stamp or self._simulation.time, flux_density)
        except BadInputError as error:
            self._refused += 1
            self.get_logger().error(
                f'command refused, the one in force stays: {error}',
                throttle_duration_sec=1.0)
            return
        if late:
            self._late += 1
            self._latest = max(self._latest, late)
            self.get_logger().warning(
                f'command arrived {late / 1e6:.3f} ms after the time it applies and was '
                'applied at once: raise lead_time of the planner',
                throttle_duration_sec=1.0)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._simulation.reset()
        response.success = True
        response.message = f'at rest at stretch {self._simulation.stretch:g}'
        return response

    def _on_step(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._authority:
            response.message = 'the plant follows a clock: expected publish_clock true'
        elif not self._pacer.paused:
            response.message = 'the plant runs: expected it paused (~/set_paused)'
        else:
            before = self._simulation.time
            while self._simulation.time == before:
                # The first sample is the start itself.
                self._sample()
            self._pacer.set_paused(True, self._simulation.time)
            response.success = True
            response.message = f'at {self._simulation.time / 1e9:.9f} s'
        return response

    def _on_set_paused(
            self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._pacer.set_paused(request.data, self._simulation.time)
        response.success = True
        response.message = 'paused' if request.data else 'running'
        return response

    def _on_diagnostics(self) -> None:
        level = DiagnosticStatus.OK
        message = 'commands in time'
        if self._late or self._refused:
            level = DiagnosticStatus.WARN
            message = f'{self._late} commands late, {self._refused} refused'
        if self._failed:
            level = DiagnosticStatus.ERROR
            message = f'{self._failed} times started again after a load too large to follow'
        self._diagnostics.publish(conversions.to_diagnostics(
            int(self.get_clock().now().nanoseconds), conversions.to_status(
                f'{self.get_name()}: commands', self._joint, level, message,
                {'received': self._received, 'late': self._late, 'refused': self._refused,
                 'failed': self._failed,
                 'largest_lateness_ms': f'{self._latest / 1e6:.3f}',
                 'time': f'{self._simulation.time / 1e9:.9f}',
                 'paused': self._pacer.paused})))


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the plant node.

    Parameters
    ----------
    args : sequence of str, optional
        Command-line arguments; default ``sys.argv[1:]``.

    Returns
    -------
    int
        Exit status.

    """
    return run(PlantNode, args)
