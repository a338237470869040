"""Planner node: setpoints in, the shaped stream of stamped flux density commands out."""

from collections.abc import Callable, Mapping, Sequence
from time import monotonic_ns

from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from hmsa_ros.core.status import Code, RefusedError
from hmsa_ros.core.timeline import Draft, PlannedLevel
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.core.warmup import warm_up
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.nodes import conversions, interface
from hmsa_ros.nodes.channel import JointChannel
from hmsa_ros.nodes.joints import declare_joints
from hmsa_ros.nodes.managed import AUTOSTART, ManagedNode
from hmsa_ros.nodes.marker_publisher import TargetMarkers
from hmsa_ros.nodes.planning import group_from, models_from, nanoseconds, OWN, SPECS
from hmsa_ros.nodes.runner import run
from hmsa_ros.nodes.takeover import TakeOver
from hmsa_ros.nodes.timekeeping import Seldom, StepWatch

PARAMETERS = SPECS

# How often the outbox and the progress are looked at while something is due soon, and how
# seldom while nothing is; simulated time may run at any pace, and is looked at often.
_POLL_NS = 2_000_000
_LONGEST_POLL_NS = 100_000_000
# Clock jumps nearer to each other than this are told of once.
_STORM_NS = NANOSECONDS
# So far ahead that all there is gets sent.
_FAR = 2**62
_WARNINGS = (Code.TOO_DAMPED, Code.INDISTINGUISHABLE, Code.SPELL_TOO_SHORT)

_Request = Callable[[int], Mapping[str, Draft]]


class PlannerNode(ManagedNode):
    """Wires `hmsa_ros.core.group.PlannerGroup` to topics, services and the clock."""

    def __init__(self) -> None:
        """Declare the parameters, and start if told to."""
        super().__init__(interface.PLANNER)
        self._settings = declare_joints(
            self, [x for x in PARAMETERS if x is not AUTOSTART], OWN)
        self._group = group_from(self._settings)
        seconds = warm_up()
        if seconds > 1.0:
            self.get_logger().info(f'loaded the numerical kernels in {seconds:.1f} s')
        self.add_on_set_parameters_callback(self._on_parameters)
        self.autostart()

    # -- states --------------------------------------------------------------------------------

    def configure(self) -> None:
        """Create topics, services and timers."""
        self._group = group_from(self._settings)
        self._verdict = (DiagnosticStatus.OK, 'no request yet', 'none', '')
        self._progress: object = None
        self._sent = self._beats = self._late = self._replanned = self._refused = 0
        self._largest_lateness = self._jumps = self._last_jump = 0
        # Where planning is slower than lead_time: how much later than now to plan for, and how
        # much earlier to send, so that nothing becomes due while that much is worked out. In ns.
        self._slow = 0
        self._several_clocks = False
        # Requests that wait until the state in force is known, and whether it is.
        self._take_over: TakeOver | None = None
        self._waiting: list[tuple[_Request, str]] = []
        self._engaged = False
        # Joints whose plan reality has left, and those of which that is suspected: the stamp of
        # what should have been told of.
        self._astray: set[str] = set()
        self._unheard: dict[str, int] = {}
        self._wake: int | None = None
        self._tell_late, self._tell_foreign, self._tell_replanned = Seldom(), Seldom(), Seldom()
        self._steps = StepWatch()

        self._channels = {
            name: JointChannel(
                self, name, self._settings.names, self._on_setpoint, self._on_applied)
            for name in self._settings.names}
        self._plan, self._status, self._diagnostics = (
            self.create_publisher(x.type, x.name, x.qos)
            for x in (interface.PLAN, interface.STATUS, interface.DIAGNOSTICS))
        self._targets = TargetMarkers(self, self._settings)
        topic = interface.JOINT_TRAJECTORY
        self.create_subscription(topic.type, topic.name, self._on_trajectory, topic.qos)
        self.create_service(interface.STOP.type, interface.STOP.name, self._on_stop)

        # Steady time: timers on simulated time fire once a /clock message at the most, and
        # what is due is decided by the node's clock anyhow.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._poll = self.create_timer(_POLL_NS / NANOSECONDS, self._on_poll, clock=steady)
        self.create_timer(1.0, self._on_diagnostics, clock=steady)
        # A sign of life counts in the time of whoever listens.
        self._heartbeat = self.create_timer(1.0, self._on_heartbeat)
        self._set_heartbeat()
        self._jump = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False),
            post_callback=self._on_jump)
        self._publish_status()

    def activate(self) -> None:
        """Take requests; the first of them reads the state in force."""
        self._poll.reset()

    def deactivate(self) -> None:
        """Come to rest, for which all commands are sent now, and send nothing more."""
        self._end_take_over()
        self._waiting.clear()
        now = self._now()
        if self._engaged and now:
            self._group.take(self._group.draft_stop(now), now)
            for name, planner in self._group.planners.items():
                for level in planner.due(_FAR):
                    self._send(name, level.stamp, level)
            self._verdict = (
                DiagnosticStatus.OK, 'deactivated: coming to rest', 'stopped', '')
        self._engaged = False
        self._publish_status()

    def cleanup(self) -> None:
        """Forget the plans."""
        self._jump.unregister()
        self._channels = {}

    def _now(self) -> int:
        before = monotonic_ns()
        now = int(self.get_clock().now().nanoseconds)
        if not self.get_clock().ros_time_is_active:
            back = self._steps.set_back(before, now, monotonic_ns())
            if back:
                self._drop_plans(back)
        return now

    # -- requests ------------------------------------------------------------------------------

    def _on_trajectory(self, message: JointTrajectory) -> None:
        def plan(now: int) -> Mapping[str, Draft]:
            points, stamp = conversions.from_trajectories(
                message, self._settings.names,
                partial=self._settings['allow_partial_joints'])
            return self._group.draft_request(points, stamp, now)
        self._request(plan, message.header.frame_id)

    def _on_setpoint(self, joint: str, stretch: float) -> None:
        self._request(lambda now: self._group.draft_setpoint(joint, stretch, now), '')

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._request(self._group.draft_stop, '')
        response.message = self._verdict[1] if not self._waiting else (
            'accepted: to be carried out as soon as the state in force is known')
        return response

    def _request(self, plan: _Request, name: str) -> bool:
        """Answer a request, now or once it is known where the actuators are."""
        now = self._now()
        if self.active and not self._engaged and now:
            patience = nanoseconds(self._settings['takeover_timeout'])
            if self._take_over is None and patience and TakeOver.possible(self):
                self._take_over = TakeOver(
                    self, self._settings.names, patience,
                    nanoseconds(self._settings['takeover_max_age']))
            if self._take_over is not None:
                self._waiting.append((plan, name))
                self._poll_soon()
                return True
        return self._answer(plan, name)

    def _answer(self, plan: _Request, request: str) -> bool:
        """Plan a request, start sending and publish the verdict; say whether it was taken."""
        now = self._now()
        try:
            if not self.active:
                raise RefusedError(
                    Code.INACTIVE,
                    f'the planner is {self.state}: expected it active (ros2 lifecycle set '
                    f'{self.get_fully_qualified_name()} activate)')
            if now == 0:
                raise RefusedError(
                    Code.NO_TIME,
                    'simulated time has not started: expected messages on /clock (start the '
                    'simulator, or set use_sim_time to false)')
            drafts = plan(now)
            if drafts:
                drafts, now = self._in_time(plan, drafts, now)
        except HmsaError as error:
            code = Code.BAD_INPUT if isinstance(error, BadInputError) else Code.NOT_CONVERGED
            if isinstance(error, RefusedError):
                code = error.code
            self._refused += 1
            self._verdict = (DiagnosticStatus.ERROR, str(error), str(code), request)
            self.get_logger().error(f'request refused ({code}): {error}')
            self._publish_status()
            return False
        self._engaged = True
        self._astray -= drafts.keys()
        changed = self._group.take(drafts, now)
        self._send_due(now)
        warnings = [
            x for draft in drafts.values() for x in draft.segments if x.code in _WARNINGS]
        if warnings:
            self._verdict = (
                DiagnosticStatus.WARN, warnings[0].reason, str(warnings[0].code), request)
            self.get_logger().warning(warnings[0].reason)
        elif not changed:
            self._verdict = (
                DiagnosticStatus.OK, 'already on the way there: the plan stays', 'unchanged',
                request)
        else:
            self._verdict = (DiagnosticStatus.OK, 'accepted', 'accepted', request)
        if changed:
            self._publish_plan()
        self._publish_status()
        self._poll_soon()
        return True

    def _in_time(
            self, plan: _Request, drafts: Mapping[str, Draft],
            now: int) -> tuple[Mapping[str, Draft], int]:
        """Plan again for later, if planning that much took longer than the lead time."""
        spent = self._now() - now
        self._slow = 0
        if min(x.begin for x in drafts.values()) >= now + spent:
            return drafts, now
        self._slow = 3 * spent
        later = now + self._slow
        return plan(later), later

    # -- the state in force --------------------------------------------------------------------

    def _end_take_over(self) -> None:
        """Take the samples there are, and carry out what has waited for them."""
        found, self._take_over = self._take_over, None
        if found is None:
            return
        found.close()
        for name, planner in self._group.planners.items():
            if name not in found.samples:
                self.get_logger().warning(
                    f'no sample of joint {name} on joint_states: it is taken to rest at its '
                    'initial stretch')
                continue
            stamp, stretch, rate, in_force = found.samples[name]
            applied = self._channels[name].applied
            try:
                planner.take_over(
                    stamp, stretch, rate, in_force,
                    applied[1] if applied is not None and applied[0] <= stamp else None)
            except BadInputError as error:
                self.get_logger().warning(f'sample of joint {name} ignored: {error}')
        self._engaged = True
        waiting, self._waiting = self._waiting, []
        for plan, name in waiting:
            self._answer(plan, name)

    def _on_applied(self, joint: str, stamp: int, flux_density: float) -> None:
        """Hold what took effect against the plan."""
        if not self._engaged:
            return
        found = self._group.applied(
            joint, stamp, flux_density, nanoseconds(self._settings['lateness_tolerance']))
        if found is None:
            return
        if found.late > 0:
            self._note_late(found.late)
        elif found.foreign and self._tell_foreign():
            self.get_logger().warning(
                f'joint {joint}: {flux_density:g} T took effect, which was not commanded')
        if self._settings['replan_late']:
            self._astray.add(joint)
            self._poll_soon()

    def _note_late(self, late: int) -> None:
        self._late += 1
        self._largest_lateness = max(self._largest_lateness, late)
        if self._tell_late():
            self.get_logger().warning(
                f'command {late / 1e6:.3f} ms after the time it applies: {self._advice()}')

    def _advice(self) -> str:
        needed = self._settings['lead_time'] + self._largest_lateness / NANOSECONDS
        return f'raise lead_time to more than {needed:.3g} s'

    def _replan(self, now: int) -> None:
        """Plan anew for the joints that are not where they were to be."""
        found = self._group.resume(sorted(self._astray), now + self._slow)
        self._astray.clear()
        request = self._verdict[3]
        self._replanned += found.resumed
        if found.stopped:
            name, reason = next(iter(found.stopped.items()))
            self._verdict = (
                DiagnosticStatus.ERROR,
                f'joint {name} comes to rest, since its sequence cannot be resumed: {reason}',
                'stopped', request)
        elif found.given_up:
            self._verdict = (
                DiagnosticStatus.WARN,
                f'commands come late again and again, by up to '
                f'{self._largest_lateness / 1e6:.3f} ms, and vibration is left: '
                f'{self._advice()}', 'late', request)
        elif found.resumed:
            missed = f', without {found.missed} setpoints whose time is over' \
                if found.missed else ''
            self._verdict = (
                DiagnosticStatus.WARN,
                'commands took effect otherwise than planned: the rest is planned anew'
                + missed, 'replanned', request)
        else:
            return
        if self._tell_replanned():
            self.get_logger().warning(self._verdict[1])
        # At once, since telling of it takes time too.
        self._send_due(now)
        if found.resumed or found.stopped:
            self._publish_plan()
        self._publish_status()

    # -- time ----------------------------------------------------------------------------------

    def _poll_soon(self) -> None:
        """Look at the outbox soon, as the plan has changed."""
        self._wake = 0
        self._poll.timer_period_ns = _POLL_NS
        self._poll.reset()

    def _on_poll(self) -> None:
        if self._take_over is not None:
            if self._take_over.over:
                self._end_take_over()
            return
        if self._wake is None or not self._engaged:
            self._poll.cancel()
            return
        now = self._now()
        if now >= self._wake:
            self._act(now)
        self._rest_until_wake(now)

    def _act(self, now: int) -> None:
        """Do what is due, and note when to look again."""
        if self._settings['replan_late']:
            self._drop_missed(now)
            if self._astray:
                self._replan(now)
        self._send_due(now)
        if self._group.progress(now) != self._progress:
            self._publish_status()
        self._wake = self._group.next_event(now)

    def _rest_until_wake(self, now: int) -> None:
        """Poll more seldom while nothing is due, and not at all if nothing ever is."""
        if self._wake is None:
            self._poll.cancel()
            return
        if self.get_clock().ros_time_is_active:
            return
        wanted = min(max(self._wake - now, _POLL_NS), _LONGEST_POLL_NS)
        if wanted != self._poll.timer_period_ns:
            self._poll.timer_period_ns = wanted
            self._poll.reset()

    def _drop_missed(self, now: int) -> None:
        """Take out of the plans what is too late to be sent, as after a jump of the clock."""
        tolerance = nanoseconds(self._settings['lateness_tolerance'])
        for name, planner in self._group.planners.items():
            due = planner.next_due
            if due is None or due + planner.options.lead_time >= now - tolerance \
                    or not self._group.may_resume(name):
                continue
            late = now - due - planner.options.lead_time
            self._note_late(late)
            self._late += planner.drop_missed(now, tolerance) - 1
            self._astray.add(name)

    def _send_due(self, now: int) -> None:
        for name, planner in self._group.planners.items():
            for level in planner.due(now + self._slow):
                self._send(name, level.stamp, level)
                if level.stamp < now:
                    self._note_late(now - level.stamp)

    def _send(self, name: str, stamp: int, level: PlannedLevel) -> None:
        self._channels[name].send(stamp, level, self._settings['frame_id'])
        self._sent += 1

    def _on_heartbeat(self) -> None:
        """Send the level in force again: who listens learns that we are alive."""
        if not self._engaged or not self.active:
            return
        now = self._now()
        self._look_for_unheard(now)
        for name, planner in self._group.planners.items():
            level = planner.last_sent
            due = planner.next_due
            stamp = max(now + planner.options.lead_time, level.stamp)
            period = planner.options.period
            stamp = stamp if period == 0 else -(-stamp // period) * period
            if due is not None and stamp >= due + planner.options.lead_time:
                # The next command is about to be sent.
                continue
            self._channels[name].send(stamp, level, self._settings['frame_id'])
            self._beats += 1

    def _look_for_unheard(self, now: int) -> None:
        """Find plans that reality has left without a word; news may be as late as commands."""
        if not self._settings['replan_late']:
            return
        before, self._unheard = self._unheard, {}
        for name, planner in self._group.planners.items():
            if self._channels[name].applied is None:
                # Nobody tells.
                continue
            stamp = planner.unheard(now - planner.options.lead_time)
            if stamp is None:
                continue
            if before.get(name) != stamp:
                # It may wait to be read.
                self._unheard[name] = stamp
                continue
            planner.drop_unheard(stamp)
            self._astray.add(name)
            self._poll_soon()

    def _set_heartbeat(self) -> None:
        period = nanoseconds(self._settings['heartbeat_period'])
        if period == 0:
            self._heartbeat.cancel()
            return
        self._heartbeat.timer_period_ns = period
        self._heartbeat.reset()

    def _on_jump(self, jump: TimeJump) -> None:
        if jump.delta.nanoseconds < 0:
            self._drop_plans(-jump.delta.nanoseconds)

    def _drop_plans(self, back: int) -> None:
        """Begin anew where the clock was set back; where the actuators are is read again."""
        self._jumps += 1
        self._group.restart()
        self._engaged = False
        self._astray.clear()
        for channel in self._channels.values():
            channel.applied = None
        last, self._last_jump = self._last_jump, monotonic_ns()
        if self._jumps > 1 and self._last_jump - last < _STORM_NS:
            return
        self._verdict = (
            DiagnosticStatus.WARN,
            f'the clock jumped back by {back / NANOSECONDS:.3f} s: the plan is dropped, and the '
            'actuator taken to be at its initial stretch unless joint_states tells otherwise',
            'clock_jumped', '')
        self.get_logger().warning(self._verdict[1])
        self._publish_status()

    # -- reports -------------------------------------------------------------------------------

    def _publish_plan(self) -> None:
        planners = self._group.planners
        if len(planners) == 1:
            (name, planner), = planners.items()
            self._plan.publish(conversions.to_plan(planner.plan, name))
        else:
            self._plan.publish(conversions.to_plans(*self._group.preview()))

    def _publish_status(self) -> None:
        self._progress = progress, each = self._group.progress(self._now())
        level, message, code, request = self._verdict
        values: dict[str, object] = {
            'code': code, 'request': request, 'plan': self._group.number,
            'state': progress.state, 'setpoint': progress.setpoint,
            'setpoints': progress.setpoints, 'stretch': progress.stretch,
            'late': self._late, 'replanned': self._replanned}
        if len(each) > 1:
            for name, of_joint in each.items():
                values |= {
                    f'{name}.state': of_joint.state, f'{name}.setpoint': of_joint.setpoint,
                    f'{name}.setpoints': of_joint.setpoints,
                    f'{name}.stretch': of_joint.stretch}
        self._status.publish(conversions.to_status(
            'planner: request', ', '.join(each), level, message, values))
        self._targets.show(self._now(), {
            name: float(x.stretch) if x.stretch else None for name, x in each.items()})

    def _on_diagnostics(self) -> None:
        level = DiagnosticStatus.WARN if self._late else DiagnosticStatus.OK
        message = f'{self._late} commands late: {self._advice()}' if self._late \
            else 'commands sent in time'
        clocks = self.count_publishers('/clock') if self.get_clock().ros_time_is_active else 1
        if clocks > 1:
            level = DiagnosticStatus.WARN
            message = f'{clocks} publishers on /clock, and time may go back and forth: ' \
                'expected one'
            if not self._several_clocks:
                self.get_logger().warning(message)
        self._several_clocks = clocks > 1
        self._diagnostics.publish(conversions.to_diagnostics(
            self._now(), conversions.to_status(
                f'{self.get_name()}: commands', ', '.join(self._channels), level, message,
                {'sent': self._sent, 'late': self._late, 'refused': self._refused,
                 'replanned': self._replanned, 'heartbeats': self._beats,
                 'largest_lateness_ms': f'{self._largest_lateness / 1e6:.3f}',
                 'clock_jumps': self._jumps})))

    # -- parameters ----------------------------------------------------------------------------

    def _on_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Take changed parameters from the next request on, or refuse them together."""
        try:
            changed = self._settings.changed(parameters)
            models = models_from(changed, self._group)
        except BadInputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        beat = changed['heartbeat_period'] != self._settings['heartbeat_period']
        self._settings = changed
        for name, model in models.items():
            self._group.planners[name].take_model(model)
        self._group.simultaneous = changed['simultaneous_arrival']
        if beat and self.state != 'unconfigured':
            self._set_heartbeat()
        return SetParametersResult(successful=True)


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
