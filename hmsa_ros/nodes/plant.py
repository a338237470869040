"""Plant node: simulated actuators, driven by stamped flux density commands."""

from array import array
from collections import deque
from collections.abc import Callable, Sequence
from time import monotonic_ns

from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from hmsa_ros.core.actuators import Actuators, check_stretch
from hmsa_ros.core.pacer import Pacer
from hmsa_ros.core.sensor import Sample, Sensor
from hmsa_ros.core.simulation import too_large
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.core.warmup import warm_up
from hmsa_ros.errors import BadInputError
from hmsa_ros.nodes import conversions, interface
from hmsa_ros.nodes.guard import COMMAND_SOURCES
from hmsa_ros.nodes.joints import declare_joints, JointParameters, JOINTS
from hmsa_ros.nodes.managed import AUTOSTART, ManagedNode
from hmsa_ros.nodes.marker_publisher import (
    MARKER_FRAME,
    MARKER_RATE,
    MARKER_SCALE,
    StateMarkers,
)
from hmsa_ros.nodes.markers import State
from hmsa_ros.nodes.parameters import JOINT, ParameterSpec
from hmsa_ros.nodes.plant_joint import OWN, PlantJoint, setup_from
from hmsa_ros.nodes.runner import run

PARAMETERS = (
    AUTOSTART,
    *OWN,
    JOINT,
    JOINTS,
    ParameterSpec(
        'command_source', 'any',
        'Whose commands are obeyed: those of any publisher, or only of the first until it is '
        'gone.', choices=COMMAND_SOURCES),
    ParameterSpec(
        'command_delay', 0.0,
        'Transport delay: time from the arrival of a command until it is known.', 's', 0.0, 1e3),
    ParameterSpec(
        'measurement_delay', 0.0,
        'Transport delay: time from taking a sample, which its stamp tells, until it is '
        'published.', 's', 0.0, 1e3),
    ParameterSpec(
        'seed', 0, 'Of the noise: the same seed gives the same run.', '', 0, 2**31 - 1),
    ParameterSpec(
        'publish_rate', 1000.0, "Samples per second of the plant's own time.", 'Hz',
        1e-3, 1e6),
    ParameterSpec(
        'publish_scalars', 'auto',
        'Whether stretch and stretch_rate are published beside joint_states; auto for a single '
        'joint only.', choices=('auto', 'always', 'never')),
    ParameterSpec(
        'publish_clock', False,
        'Whether the plant is the authority on simulated time and publishes /clock; leave '
        'use_sim_time of this node false then.'),
    ParameterSpec(
        'real_time_factor', 1.0,
        'Simulated seconds per second as authority on /clock; 0 for as fast as it can.', '',
        0.0, 1e6, read_only=False),
    ParameterSpec(
        'start_time', 1.0,
        'Simulated time to begin at, above 0 since a ROS clock at 0 has not started.', 's',
        1e-3, 1e9),
    ParameterSpec(
        'start_paused', False, 'Whether to wait for ~/set_paused before time runs.'),
    ParameterSpec(
        'step_count', 1, 'Samples that one call of ~/step advances.', '', 1, 100_000,
        read_only=False),
    MARKER_FRAME,
    MARKER_RATE,
    MARKER_SCALE,
)

_TICK_SECONDS = 0.001
# Of each tick, the share that samples may take; commands and services get the rest.
_BUDGET_NS = 800_000
# A gap of the clock that is not simulated through but skipped.
_LARGEST_GAP_NS = 5 * NANOSECONDS
_PAUSED_CLOCK_NS = 100_000_000


class PlantNode(ManagedNode):
    """Advances `Actuators` along a clock and publishes their samples."""

    def __init__(self) -> None:
        """Declare the parameters, and start if told to."""
        super().__init__(interface.PLANT)
        self._values = declare_joints(
            self, [x for x in PARAMETERS if x is not AUTOSTART], OWN)
        self.add_on_set_parameters_callback(self._on_parameters)
        self._joints: list[PlantJoint] = []
        self._pacer = Pacer(0, 1.0)
        self.autostart()

    def configure(self) -> None:
        """
        Create actuators, topics and services; time does not run yet.

        Raises
        ------
        BadInputError
            If parameters do not go together.

        """
        values = self._values
        self._period = max(round(NANOSECONDS / values['publish_rate']), 1)
        self._authority: bool = values['publish_clock']
        if self._authority and self.get_parameter('use_sim_time').value:
            raise BadInputError(
                'publish_clock and use_sim_time are both true: expected a plant that either '
                'leads simulated time or follows it')
        each = [values.of(name) for name in values.names]
        _check_reset(values)
        start = round(values['start_time'] * NANOSECONDS) if self._authority else 0
        self._actuators = Actuators([setup_from(x) for x in each], time=start)
        self._sensor = Sensor(
            [x['stretch_noise'] for x in each], [x['rate_noise'] for x in each],
            round(values['measurement_delay'] * NANOSECONDS), values['seed'])
        self._command_delay = round(values['command_delay'] * NANOSECONDS)
        # Commands on their way: when they are known, for which joint, stamp and level.
        self._transit: deque[tuple[int, int, int, float]] = deque()
        warm_up()
        self._next_sample = start
        self._pacer = Pacer(
            start, values['real_time_factor'] if self._authority else 1.0,
            paused=values['start_paused'])
        self._clock_published = 0
        self._measured = (start, monotonic_ns())
        self._clocks_warned = False

        self._joint_states = self._publisher(interface.JOINT_STATES)
        self._message = interface.JOINT_STATES.type(name=list(values.names))
        self._diagnostics = self._publisher(interface.DIAGNOSTICS)
        self._clock_publisher = (
            self._publisher(interface.CLOCK_TOPIC) if self._authority else None)
        scalars = values['publish_scalars']
        self._scalars = scalars == 'always' or (scalars == 'auto' and len(each) == 1)
        self._joints = [
            PlantJoint(self, self, i, values.names, x, self._scalars) for i, x in enumerate(each)]
        for i, joint in enumerate(self._joints):
            joint.tell_applied(start, self.level(i))
        StateMarkers(
            self, values, values['real_time_factor'] if self._authority else 1.0,
            self._states)
        self._serve(interface.RESET, self._on_reset)
        self._serve(interface.STEP, self._on_step)
        self._serve(interface.SET_PAUSED, self._on_set_paused)

        # Steady time: what to simulate is decided by the pacer or the node's clock, and the
        # tick only looks at it.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TICK_SECONDS, self._on_tick, clock=steady)
        self.create_timer(1.0, self._on_diagnostics, clock=steady)

    def activate(self) -> None:
        """Let time run, from where it stood."""
        self._pacer.set_paused(self._pacer.paused, self.time)

    def deactivate(self) -> None:
        """Hold time; commands on their way are lost."""
        self._transit.clear()

    def cleanup(self) -> None:
        """Close the inputs that no executor serves."""
        for joint in self._joints:
            joint.commands.close()
        self._joints = []

    def close(self) -> None:
        """End with the process."""
        self.cleanup()

    def _publisher(self, topic: interface.Topic):  # type: ignore[no-untyped-def]
        return self.create_publisher(topic.type, topic.name, topic.qos)

    def _serve(self, service: interface.Service, callback: Callable[..., object]) -> None:
        self.create_service(service.type, service.name, callback)

    # -- time ----------------------------------------------------------------------------------

    @property
    def time(self) -> int:
        """Time in ns of the simulation."""
        return self._actuators.time

    @property
    def _standing(self) -> bool:
        """Whether time stands still."""
        return self._pacer.paused or not self.active

    def _on_tick(self) -> None:
        for joint in self._joints:
            joint.commands.poll()
        if self._authority:
            self._lead()
        else:
            self._follow()

    def _lead(self) -> None:
        """Advance simulated time at the real-time factor, and publish it."""
        steady = monotonic_ns()
        if self._standing:
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
        if now == 0:
            return
        if self.time == 0:
            self._go_on_from(now)
        if now < self.time - self._period:
            self.get_logger().warning(
                f'the clock jumped back by {(self.time - now) / 1e9:.3f} s: the '
                'simulation starts again from its initial state',
                throttle_duration_sec=1.0)
            self._go_on_from(now)
            for i in range(len(self._joints)):
                self._start_again(i)
            self._transit.clear()
        elif self._standing:
            self._go_on_from(now)
            return
        elif now - self.time > _LARGEST_GAP_NS:
            self.get_logger().warning(
                f'the clock jumped ahead by {(now - self.time) / 1e9:.3f} s: the '
                'simulation goes on from there in its present state')
            self._go_on_from(now)
        begin = monotonic_ns()
        while (self._next_sample <= now and not self._standing
                and monotonic_ns() - begin < _BUDGET_NS):
            self._sample()

    def _go_on_from(self, now: int) -> None:
        """Set the time without simulating up to it; samples lie on a grid from time zero."""
        for joint in self._joints:
            # Time that was not simulated is no silence.
            joint.watchdog.pass_over(now - self.time)
        self._actuators.time = now
        self._next_sample = -(-now // self._period) * self._period

    def _sample(self) -> None:
        """Advance to the next sample and publish it."""
        time = self._next_sample
        while self._transit and self._transit[0][0] <= time:
            known, i, stamp, level = self._transit.popleft()
            self._advance(known)
            self._obey(i, stamp, level)
        for joint in self._joints:
            joint.watch(time)
        self._advance(time)
        self._next_sample += self._period
        self._publish_clock(monotonic_ns())
        self._tell_changes()
        actuators = self._actuators
        for sample in self._sensor.measure(Sample(
                time, actuators.stretch.copy(), actuators.rate, actuators.flux_density)):
            self._tell(sample)

    def _advance(self, time: int) -> None:
        """Advance all joints; those whose load is too large start again."""
        for i, reached in self._actuators.advance(time):
            joint = self._joints[i]
            joint.failed += 1
            self.get_logger().error(
                f'{too_large(reached, self.level(i))}; joint {joint.name} starts again from '
                'its initial state')
            self._start_again(i)

    def _start_again(self, i: int) -> None:
        self._actuators.reset(i)
        self._joints[i].start_again()
        self._sensor.forget()
        self._tell_changes()

    # -- what is told --------------------------------------------------------------------------
    # Every view of the state, markers among them, is published from here.

    def _tell(self, sample: Sample) -> None:
        message = self._message
        message.header.stamp = conversions.to_time(sample.time)
        message.position = array('d', sample.stretch.tobytes())
        message.velocity = array('d', sample.rate.tobytes())
        message.effort = array('d', sample.flux_density.tobytes())
        self._joint_states.publish(message)
        if self._scalars:
            for joint, stretch, rate in zip(
                    self._joints, message.position, message.velocity, strict=True):
                joint.tell_scalars(stretch, rate)

    def _tell_changes(self) -> None:
        for i, stamp, level in self._actuators.changes:
            self._joints[i].tell_applied(stamp, level)
        self._actuators.changes.clear()

    def _states(self) -> tuple[int, list[State]]:
        """Return the time and what the joints do, for who looks."""
        actuators = self._actuators
        return actuators.time, [State(*x) for x in zip(
            actuators.stretch.tolist(), actuators.flux_density.tolist(), strict=True)]

    def _publish_clock(self, steady: int) -> None:
        if self._clock_publisher is not None:
            self._clock_publisher.publish(conversions.to_clock(self.time))
        self._clock_published = steady

    # -- what drives the joints ----------------------------------------------------------------

    def level(self, joint: int) -> float:
        """
        Return the level in force on a joint.

        Parameters
        ----------
        joint : int
            Its place.

        Returns
        -------
        float
            In T, that of the amplifier's last command.

        """
        return self._actuators.schedules[joint].current

    def take(self, joint: int, stamp: int, flux_density: float) -> None:
        """
        Have a command take effect once it has passed the transport delay.

        Parameters
        ----------
        joint : int
            Its place.
        stamp : int
            Time in ns from which it applies, 0 for at once.
        flux_density : float
            In T.

        Raises
        ------
        BadInputError
            If nobody could follow it.

        """
        if self._command_delay:
            self._actuators.check_level(joint, flux_density)
            self._transit.append((self.time + self._command_delay, joint, stamp, flux_density))
        else:
            self._obey(joint, stamp, flux_density)

    def _obey(self, joint: int, stamp: int, flux_density: float) -> None:
        late = self._actuators.command(joint, stamp or self.time, flux_density)
        self._joints[joint].obeyed(late)

    def go_safe(self, joint: int, stamp: int, flux_density: float) -> None:
        """
        Have the watchdog's level take effect.

        Parameters
        ----------
        joint : int
            Its place.
        stamp : int
            Time in ns.
        flux_density : float
            In T.

        """
        self._actuators.command(joint, stamp, flux_density)

    def push(self, joint: int, stamp: int, force: float) -> None:
        """
        Have a force act on a joint.

        Parameters
        ----------
        joint : int
            Its place.
        stamp : int
            Time in ns from which it acts, 0 for at once.
        force : float
            Along the field in N.

        Raises
        ------
        BadInputError
            If nobody could follow it.

        """
        self._actuators.force(joint, stamp or self.time, force)

    # -- services and parameters ---------------------------------------------------------------

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        where = []
        for i, joint in enumerate(self._joints):
            values = self._values.of(joint.name)
            rate = values['reset_rate']
            self._actuators.reset(i, values['reset_stretch'] or None, rate)
            joint.start_again()
            how = f'at rate {rate:g}/s' if rate else 'at rest'
            where.append(f'{how} at stretch {self._actuators.stretch[i]:g}')
        self._transit.clear()
        self._sensor.forget()
        self._tell_changes()
        response.success = True
        response.message = where[0] if len(where) == 1 else ', '.join(
            f'{joint.name} {text}' for joint, text in zip(self._joints, where, strict=True))
        return response

    def _on_step(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._authority:
            response.message = 'the plant follows a clock: expected publish_clock true'
        elif not self._pacer.paused:
            response.message = 'the plant runs: expected it paused (~/set_paused)'
        elif not self.active:
            response.message = f'the plant is {self.state}: expected it active'
        else:
            for joint in self._joints:
                joint.commands.poll()
            for _ in range(self._values['step_count']):
                before = self.time
                while self.time == before:
                    # The first sample is the start itself.
                    self._sample()
            self._pacer.set_paused(True, self.time)
            response.success = True
            response.message = f'at {self.time / 1e9:.9f} s'
        return response

    def _on_set_paused(
            self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._pacer.set_paused(request.data, self.time)
        response.success = True
        response.message = 'paused' if request.data else 'running'
        return response

    def _on_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Take changed parameters, or refuse them together."""
        try:
            changed = self._values.changed(parameters)
            _check_reset(changed)
        except BadInputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._values = changed
        factor = changed['real_time_factor']
        if self._joints and self._authority and factor != self._pacer.factor:
            self._pacer.set_factor(factor, self.time)
        return SetParametersResult(successful=True)

    # -- reports -------------------------------------------------------------------------------

    def _on_diagnostics(self) -> None:
        self._diagnostics.publish(conversions.to_diagnostics(
            int(self.get_clock().now().nanoseconds), self._status_of_commands(),
            self._status_of_time()))

    def _status_of_commands(self) -> DiagnosticStatus:
        joints = self._joints
        late, refused = sum(x.late for x in joints), sum(x.refused for x in joints)
        unreadable = sum(x.commands.unreadable for x in joints)
        strangers = sum(x.commands.refused for x in joints)
        failed = sum(x.failed for x in joints)
        silent = [x.name for x in joints if x.watchdog.tripped]
        crowded = [x.name for x in joints if x.crowded()]
        level, notes = DiagnosticStatus.OK, []
        if late or refused or strangers or unreadable:
            level = DiagnosticStatus.WARN
            notes.append(f'{late} commands late, {refused + strangers + unreadable} refused')
        if crowded:
            level = DiagnosticStatus.WARN
            notes.append(f'several publishers command {_listed(crowded)}')
        if failed:
            level = DiagnosticStatus.ERROR
            notes.append(f'{failed} times started again after a load too large to follow')
        if silent:
            level = DiagnosticStatus.ERROR
            notes.append(f'no command and no heartbeat for {_listed(silent)}')
        return conversions.to_status(
            f'{self.get_name()}: commands', ', '.join(x.name for x in joints), level,
            '; '.join(notes) or 'commands in time',
            {'received': sum(x.received for x in joints), 'late': late,
             'refused': refused + unreadable, 'refused_source': strangers, 'failed': failed,
             'largest_lateness_ms': f'{max(x.latest for x in joints) / 1e6:.3f}',
             'timeouts': sum(x.watchdog.trips for x in joints), 'silent': len(silent),
             'time': f'{self.time / 1e9:.9f}', 'paused': self._pacer.paused})

    def _status_of_time(self) -> DiagnosticStatus:
        then, since = self._measured
        steady = monotonic_ns()
        self._measured = (self.time, steady)
        achieved = (self.time - then) / max(steady - since, 1) if then else 0.0
        level = DiagnosticStatus.OK
        message = f'time stands, {self.state}' if self._standing else 'time runs'
        clocks = self.count_publishers(interface.CLOCK_TOPIC.name)
        if clocks > 1 and (self._authority or self.get_parameter('use_sim_time').value):
            level = DiagnosticStatus.WARN
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


def _listed(names: Sequence[str]) -> str:
    """Return names for a sentence, the first few of many."""
    return ', '.join(names[:4]) + (f' and {len(names) - 4} more' if len(names) > 4 else '')


def _check_reset(values: JointParameters) -> None:
    """Refuse a state to reset to that does not exist."""
    for name in values.names:
        own = values.of(name)
        if own['reset_stretch']:
            check_stretch(
                own['reset_stretch'], setup_from(own).actuator.nondimensional,
                f'reset_stretch of {name}')


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
