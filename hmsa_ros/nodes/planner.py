"""Planner node: setpoints in, the shaped stream of stamped flux density commands out."""

from collections.abc import Callable, Sequence
import math
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from hmsa_ros.core.planner import Options, Plan, Planner
from hmsa_ros.core.sequence import SHORT_SPELL
from hmsa_ros.core.shapers import SHAPERS
from hmsa_ros.core.status import Code, RefusedError
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
        'frame_id', 'coil', 'Frame of the coil in the stamped commands.'),
    ParameterSpec(
        'lead_time', 0.05, 'How far ahead of the time it applies a command is sent.', 's',
        0.0, 1e6),
    ParameterSpec(
        'shaper', 'two_step', 'How a move is commanded.', choices=tuple(SHAPERS),
        read_only=False),
    ParameterSpec(
        'robust_order', 2, 'Number of chained two-step commands of the shaper robust.', '',
        1, 16, read_only=False),
    ParameterSpec(
        'command_mode', 'continuous',
        'Whether commands are stamped with any time, or on the grid of command_period.',
        choices=('continuous', 'sampled')),
    ParameterSpec(
        'command_period', 0.001, 'Period of the grid in command_mode sampled.', 's',
        1e-9, 1e3),
    ParameterSpec(
        'slew_limit', 0.0,
        'Rate at which the amplifier ramps to a commanded level; 0 for steps.', 'T/s',
        0.0, 1e12),
    ParameterSpec(
        'short_spell', 'refuse', 'What to do with a spell that ends before its move does.',
        choices=SHORT_SPELL, read_only=False),
    ParameterSpec(
        'flux_density_min', -0.5, 'Least flux density that the coil may be asked for.', 'T',
        -1e3, 1e3, read_only=False),
    ParameterSpec(
        'flux_density_max', 0.5, 'Largest flux density that the coil may be asked for.', 'T',
        -1e3, 1e3, read_only=False),
)

# How often the outbox and the progress are looked at while a plan runs.
_POLL_SECONDS = 0.002
_WARNINGS = (Code.TOO_DAMPED, Code.INDISTINGUISHABLE, Code.SPELL_TOO_SHORT)


class PlannerNode(Node):
    """Wires `hmsa_ros.core.planner.Planner` to topics, services and the clock."""

    def __init__(self) -> None:
        """Declare, create and announce that there is no request yet."""
        super().__init__(interface.PLANNER)
        values = dict(declare(self, PARAMETERS))
        self._values = values
        self._joint: str = values['joint']
        seconds = warm_up()
        if seconds > 1.0:
            self.get_logger().info(f'loaded the numerical kernels in {seconds:.1f} s')
        self._planner = Planner(
            actuator_from(values), _options(values), stretch=values['initial_stretch'])
        self._verdict = (DiagnosticStatus.OK, 'no request yet', 'none', '')
        self._progress: tuple[object, ...] = ()
        self._sent = self._late = self._refused = 0

        self._command = self._publisher(interface.FLUX_DENSITY_COMMAND)
        self._plan = self._publisher(interface.PLAN)
        self._status = self._publisher(interface.STATUS)
        self._diagnostics = self._publisher(interface.DIAGNOSTICS)
        self._subscribe(interface.JOINT_TRAJECTORY, self._on_trajectory)
        self._subscribe(interface.SETPOINT, self._on_setpoint)
        self.create_service(interface.STOP.type, interface.STOP.name, self._on_stop)
        self.add_on_set_parameters_callback(self._on_parameters)

        # Steady time: timers on simulated time fire once a /clock message at the most, and
        # what is due is decided by the node's clock anyhow.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._poll = self.create_timer(_POLL_SECONDS, self._on_poll, clock=steady)
        self.create_timer(1.0, self._on_diagnostics, clock=steady)
        self._jump = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False),
            post_callback=self._on_jump)
        self._publish_status()

    def _publisher(self, topic: interface.Topic):  # type: ignore[no-untyped-def]
        return self.create_publisher(topic.type, topic.name, topic.qos)

    def _subscribe(self, topic: interface.Topic, callback: Callable[..., None]) -> None:
        self.create_subscription(topic.type, topic.name, callback, topic.qos)

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    # -- requests ------------------------------------------------------------------------------

    def _on_trajectory(self, message: JointTrajectory) -> None:
        def plan(now: int) -> Plan:
            points, stamp = conversions.from_trajectory(message, self._joint)
            return self._planner.request(points, stamp, now)
        self._answer(plan, message.header.frame_id)

    def _on_setpoint(self, message: Float64) -> None:
        self._answer(lambda now: self._planner.setpoint(message.data, now), '')

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._answer(self._planner.stop, '')
        response.message = self._verdict[1]
        return response

    def _answer(self, plan: Callable[[int], Plan], request: str) -> bool:
        """Plan a request, start sending and publish the verdict; say whether it was taken."""
        now = self._now()
        before = self._planner.plan.number
        try:
            if now == 0:
                raise RefusedError(
                    Code.NO_TIME,
                    'simulated time has not started: expected messages on /clock (start the '
                    'simulator, or set use_sim_time to false)')
            taken = plan(now)
        except HmsaError as error:
            code = Code.BAD_INPUT if isinstance(error, BadInputError) else Code.NOT_CONVERGED
            if isinstance(error, RefusedError):
                code = error.code
            self._refused += 1
            self._verdict = (DiagnosticStatus.ERROR, str(error), str(code), request)
            self.get_logger().error(f'request refused ({code}): {error}')
            self._publish_status()
            return False
        self._send_due(now)
        warnings = [x for x in taken.segments if x.code in _WARNINGS]
        if warnings:
            self._verdict = (
                DiagnosticStatus.WARN, warnings[0].reason, str(warnings[0].code), request)
            self.get_logger().warning(warnings[0].reason)
        elif taken.number == before:
            self._verdict = (
                DiagnosticStatus.OK, 'already on the way there: the plan stays', 'unchanged',
                request)
        else:
            self._verdict = (DiagnosticStatus.OK, 'accepted', 'accepted', request)
        if taken.number != before:
            self._plan.publish(conversions.to_plan(taken, self._joint))
        self._poll.reset()
        self._publish_status()
        return True

    # -- time ----------------------------------------------------------------------------------

    def _on_poll(self) -> None:
        now = self._now()
        self._send_due(now)
        progress = self._progress_at(now)
        if progress != self._progress:
            self._publish_status()
        if not self._planner.pending and progress[0] in ('idle', 'at_rest', 'settling'):
            self._poll.cancel()

    def _send_due(self, now: int) -> None:
        for level in self._planner.due(now):
            self._command.publish(conversions.to_command(
                level.stamp, level.flux_density, self._values['frame_id']))
            self._sent += 1
            if level.stamp < now:
                self._late += 1
                self.get_logger().warning(
                    f'command sent {(now - level.stamp) / 1e6:.3f} ms after the time it '
                    'applies: raise lead_time')

    def _on_jump(self, jump: TimeJump) -> None:
        if jump.delta.nanoseconds < 0:
            self._planner.restart()
            self._verdict = (
                DiagnosticStatus.WARN,
                f'the clock jumped back by {-jump.delta.nanoseconds / NANOSECONDS:.3f} s: the '
                'plan is dropped and the actuator taken to be at its initial stretch',
                'clock_jumped', '')
            self.get_logger().warning(self._verdict[1])
            self._publish_status()

    # -- reports -------------------------------------------------------------------------------

    def _progress_at(self, now: int) -> tuple[object, ...]:
        """Return state, place in the sequence and target; what a change of is published."""
        found = self._planner.segment(now)
        plan = self._planner.plan
        count = len(plan.segments) - plan.kept
        if found is None or found[0] < plan.kept:
            return ('waiting' if count else 'idle', 0, count, '')
        index, segment = found[0] - plan.kept, found[1]
        last = index == count - 1
        if segment.arrival is None:
            state = 'settling' if last else 'moving'
        elif now < segment.arrival:
            state = 'moving'
        else:
            state = 'at_rest' if last else 'holding'
        return (state, index + 1, count, f'{segment.stretch:.12g}')

    def _publish_status(self) -> None:
        self._progress = self._progress_at(self._now())
        level, message, code, request = self._verdict
        state, done, count, target = self._progress
        self._status.publish(conversions.to_status(
            'planner: request', self._joint, level, message,
            {'code': code, 'request': request, 'plan': self._planner.plan.number,
             'state': state, 'setpoint': done, 'setpoints': count, 'stretch': target}))

    def _on_diagnostics(self) -> None:
        level = DiagnosticStatus.WARN if self._late else DiagnosticStatus.OK
        message = f'{self._late} commands sent late' if self._late else 'commands sent in time'
        self._diagnostics.publish(conversions.to_diagnostics(
            self._now(), conversions.to_status(
                f'{self.get_name()}: commands', self._joint, level, message,
                {'sent': self._sent, 'late': self._late, 'refused': self._refused})))

    # -- parameters ----------------------------------------------------------------------------

    def _on_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Take changed parameters from the next request on, or refuse them together."""
        specs = {spec.name: spec for spec in PARAMETERS}
        values = self._values | {x.name: x.value for x in parameters if x.name in specs}
        try:
            for parameter in parameters:
                if parameter.name in specs:
                    specs[parameter.name].check(parameter.value)
            self._planner.set_options(_options(values))
        except BadInputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._values = values
        return SetParametersResult(successful=True)


def _options(values: dict[str, Any]) -> Options:
    """Return the planning options that declared parameters describe."""
    least, largest = float(values['flux_density_min']), float(values['flux_density_max'])
    if not least < largest:
        raise BadInputError(
            f'parameter flux_density_min is {least:g} T: expected less than flux_density_max, '
            f'which is {largest:g} T')
    return Options(
        shaper=str(values['shaper']), short_spell=str(values['short_spell']),
        flux_density_min=least, flux_density_max=largest,
        lead_time=round(float(values['lead_time']) * NANOSECONDS),
        period=0 if values['command_mode'] == 'continuous'
        else round(float(values['command_period']) * NANOSECONDS),
        slew_limit=float(values['slew_limit']) or math.inf,
        order=int(values['robust_order']))


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the planner node.

    Parameters
    ----------
    args : sequence of str, optional
        Command-line arguments; default ``sys.argv[1:]``.

    Returns
    -------
    int
        Exit status.

    """
    return run(PlannerNode, args)
