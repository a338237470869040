"""Planner node: converts setpoints into a shaped stream of timestamped flux density commands."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
import math
from time import monotonic_ns, time_ns
from typing import Any, TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import MagneticField, Temperature, TimeReference
from std_msgs.msg import Float64

from hmsa.errors import BadInputError, BagError
from hmsa.interfaces import topics
from hmsa.interfaces.actuator import actuator_from
from hmsa.interfaces.diagnostics import Outcome
from hmsa.model.actuators import unheld
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa.offload import Offload
from hmsa.plugins import FOLLOWER, registered
from hmsa_ros.nodes import conversions, ros_entities
from hmsa_ros.nodes.capture import decode, RawSubscription, Taken
from hmsa_ros.nodes.cdr import JointStateReader, read_trajectory
from hmsa_ros.nodes.duplicate_nodes import DuplicateNodes
from hmsa_ros.nodes.managed import ManagedNode, run
from hmsa_ros.nodes.markers import TargetMarkers
from hmsa_ros.nodes.parameters import declare_joints
from hmsa_ros.nodes.planning import group_from, models_from, OWN, PARAMETERS, settings_from
from hmsa_ros.runtime import records
from hmsa_ros.runtime.runtime import Runtime
from hmsa_ros.runtime.worker import PlanningThread
from hmsa_ros.timekeeping import steady_ns, StepWatch, Throttle

if TYPE_CHECKING:
    from hmsa_ros.nodes.follow import FollowJointTrajectory

# Time in ns after which all topics of a device that runs are discovered.
_DISCOVERY = 2 * NANOSECONDS

# Periods of serving the runtime while work is due soon, and while none is; simulated time has any
# pace and is read often.
_POLL_NS = 2_000_000
_LONGEST_POLL_NS = 100_000_000
# Matches publishers of samples with any reliability.
_SAMPLES = replace(
    topics.JOINT_STATES, qos=replace(topics.JOINT_STATES.qos, reliable=False))
# Queue for the newest samples of several joints, each with its own publisher.
_NEWEST = replace(topics.JOINT_STATES, qos=topics.Quality(20, reliable=False))
# Time in ns that a subscription to samples is kept after use, since it takes time to match.
_LINGER_NS = 2 * NANOSECONDS
# Reading interval in ns, and number of messages read before commands are served again: of 64
# joints, they take 2 ms. A callback of the executor takes longer than reading a sample.
_READ_NS, _AT_ONCE = 10_000_000, 50


class JointChannel:
    """Publishers and subscriptions of one joint; ``serve`` is called after each message."""

    def __init__(
            self, node: Node, joint: str, joints: Sequence[str], runtime: Runtime,
            serve: Callable[[], None], *, linked: bool = False) -> None:
        """Create them; a linked device passes its reports on directly."""
        self._node, self._joint, self._runtime, self._serve = node, joint, runtime, serve
        self._ignored_due = Throttle()
        self._command = ros_entities.publisher(
            node, topics.of_joint(topics.FLUX_DENSITY_COMMAND, joint, joints))
        ros_entities.subscribe(
            node, topics.of_joint(topics.SETPOINT, joint, joints), self._on_setpoint)
        self._applied = self._received = ''
        self._discovered = monotonic_ns() + _DISCOVERY
        if not linked:
            self._applied, self._received = (
                ros_entities.subscribe(
                    node, topics.of_joint(topic, joint, joints), take).topic_name
                for topic, take in (
                    (topics.FLUX_DENSITY_APPLIED, self._on_applied),
                    (topics.FLUX_DENSITY_RECEIVED, self._on_received)))

        self._temperature: object = None
        self._names = tuple(joints)
        self.look_at_temperature()

    def look_at_temperature(self) -> None:
        """Subscribe to the temperature once it matters."""
        if self._temperature is None and self._joint in self._runtime.temperatures.joints:
            self._temperature = ros_entities.subscribe(
                self._node, topics.of_joint(topics.TEMPERATURE, self._joint, self._names),
                self._on_temperature)

    def publish_command(self, command: records.Send, frame: str) -> None:
        """Publish a command in the frame of the coil."""
        self._command.publish(
            conversions.to_command(command.stamp, command.flux_density, frame))

    @property
    def found(self) -> bool:
        """Whether a device subscribes to the commands and reports applied levels."""
        return not self._applied or bool(
            ros_entities.heard(self._node, self._command) and (
                self._node.count_publishers(self._applied)
                or self._node.count_publishers(topics.JOINT_STATES.name)))

    @property
    def reports(self) -> bool:
        """Whether a device gives receipts, or may, as long as discovery is not complete."""
        return bool(self._received) and (
            monotonic_ns() < self._discovered or bool(
                self._node.count_publishers(self._received)))

    @property
    def reporters(self) -> frozenset[bytes]:
        """Identifiers of the publishers of applied levels."""
        return frozenset(
            ros_entities.publishers_of(self._node, self._applied) if self._applied else ())

    def unheard(self) -> str:
        """Return why commands are not carried out; empty if they are."""
        if not self._applied:
            return ''
        if not ros_entities.heard(self._node, self._command):
            return f'no node subscribes to {self._command.topic_name}: start a plant or a driver'
        if not self._node.count_publishers(self._received):
            # The present subscriber gives no receipts.
            self._runtime.devices.receipts.forget(self._joint)
        if not self._node.count_publishers(self._applied) and not self._node.count_publishers(
                topics.JOINT_STATES.name):
            return (
                f'no node reports applied levels ({self._applied}) or samples '
                '(joint_states): start a plant, or a driver that does')
        return ''

    def _on_setpoint(self, message: Float64) -> None:
        self._runtime.request(records.StretchRequest(self._joint, message.data))
        self._serve()

    def _on_temperature(self, message: Temperature) -> None:
        self._runtime.temperature(
            self._joint, conversions.from_time(message.header.stamp), message.temperature)
        self._serve()

    def _on_received(self, message: TimeReference) -> None:
        self._runtime.received(
            self._joint, conversions.from_time(message.header.stamp),
            conversions.from_time(message.time_ref),
            cut_off=message.header.frame_id == conversions.CUT_OFF,
            locked=message.header.frame_id == conversions.INTERLOCK,
            late=message.header.frame_id == conversions.LATE)
        if message.header.frame_id:
            self._serve()

    def _on_applied(self, message: MagneticField) -> None:
        try:
            self._runtime.applied(self._joint, *conversions.from_command(message))
        except BadInputError as error:
            if self._ignored_due():
                self._node.get_logger().error(f'update of joint {self._joint} ignored: {error}')
        self._serve()


class PlannerNode(ManagedNode):
    """Connect `hmsa_ros.runtime.runtime.Runtime` to topics, services and the clock."""

    #: Whether a linked device in the same process serves the runtime.
    linked = False

    def __init__(self) -> None:
        super().__init__(topics.PLANNER)
        self._settings = declare_joints(self, PARAMETERS, OWN)
        self._worker = PlanningThread()
        self._offload = Offload(
            self.get_logger().warning, registered(FOLLOWER)['adapt'].module,
            len(self._settings.names))
        # The executor would store an event for each message on /clock, without limit if the node
        # cannot keep up. This subscription, read by `now`, only keeps the newest. It is unsuitable
        # for a node that must process commands before the time published after them.
        self._ticks: RawSubscription | None = None
        self._time_source._subscribe_to_clock_topic = self._follow_clock
        if self.simulated:
            self.destroy_subscription(self._time_source._clock_sub)
            self._time_source._clock_sub = None
            self._follow_clock()
        self._steps = StepWatch()
        self._runtime = self._new_runtime()
        self._channels: dict[str, JointChannel] = {}
        self._reader = JointStateReader()
        self._samples: RawSubscription | None = None
        self._newest: RawSubscription | None = None
        self._listen_until = self._read = 0
        self._due: float = math.inf  # when to serve next, by the monotonic clock in ns
        self._crowded = ''
        self._action: FollowJointTrajectory | None = None
        self.on_change(self._take_parameters)
        self.autostart()

    def _new_runtime(self) -> Runtime:
        runtime = Runtime(
            group_from(self._settings), settings_from(self._settings), records.Environment(
                self.now, worker=self._worker, one_clock=self._one_clock,
                observable=self._observable, unheard=self._unheard,
                found=lambda joint: self._channels[joint].found,
                reports=lambda joint: self._channels[joint].reports,
                reporters=lambda joint: self._channels[joint].reporters, glance=self._glance))
        runtime.devices.deliver = lambda command: self._take((command,))
        runtime.follower.doing = self._offload
        if runtime.follower.on:
            self._offload.start()
        return runtime

    # -- states --------------------------------------------------------------------------------

    def configure(self) -> None:
        """Create topics, services and timers."""
        self._runtime = self._new_runtime()
        names = self._settings.names
        for name in names:
            if lost := unheld(actuator_from(self._settings.of(name)).nondimensional):
                self.get_logger().warning(f'joint {name}: {lost}')
        self._channels = {x: JointChannel(
            self, x, names, self._runtime, self._serve_soon, linked=self.linked) for x in names}
        if not self.linked:
            self._newest = ros_entities.listen(self, _NEWEST)
        self._plan, self._status, self._outcomes, self._estimate = (
            ros_entities.publisher(self, x) for x in (
                topics.PLAN, topics.STATUS, topics.OUTCOMES, topics.ESTIMATE))
        self._targets = TargetMarkers(self, self._settings)
        ros_entities.subscribe(self, topics.JOINT_TRAJECTORY, self._on_trajectory, raw=True)
        self.offer(topics.STOP, self._on_stop)
        self.offer(topics.RESET_ESTIMATE, lambda: (True, self._runtime.follower.reset()))
        self.offer(topics.SAVE_ESTIMATE, lambda: (
            True, self._runtime.follower.save(by_joint=bool(self._settings['joints']))))
        # Timers on simulated time fire at most once for each /clock message, and the node's clock
        # decides what is due.
        self._poll = self.every(_POLL_NS / NANOSECONDS, self._serve)
        if self.linked:
            self._poll.cancel()
        self._duplicates = DuplicateNodes(self)
        if self._action is None:
            self._action = self._offer_action()
        else:
            self._action.begin(self._runtime)
        self.diagnose(self._report)
        self._jump = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False),
            post_callback=self._on_jump)
        self._serve()

    def _offer_action(self) -> 'FollowJointTrajectory | None':
        """Return the action server, or None if its messages are not installed."""
        try:
            interfaces = [
                ros_entities.interface_class(x.type) for x in (topics.FOLLOW, topics.FOLLOW.state)]
        except BagError:
            self.get_logger().info(
                f'no action {topics.FOLLOW.name}: it needs the package control_msgs')
            return None
        # Actions take time to import, and other nodes do not need them.
        from hmsa_ros.nodes.follow import FollowJointTrajectory
        return FollowJointTrajectory(self, self._runtime, self._serve, *interfaces)

    def activate(self) -> None:
        """Accept requests; the first one reads the actual state."""
        self._runtime.active = True
        self._serve()

    def deactivate(self) -> None:
        """Come to rest, sending all commands for that now, and send nothing more."""
        self._runtime.deactivate()
        self._serve()

    def cleanup(self) -> None:
        """Drop the plans."""
        self._offload.close()
        self._jump.unregister()
        self._duplicates.close()
        self._poll.cancel()
        self._channels = {}
        for subscription in (self._samples, self._newest):
            if subscription is not None:
                subscription.destroy()
        self._samples = self._newest = None

    def close(self) -> None:
        """Publish the outcomes of setpoints that have none, and end the estimation process."""
        if self._channels and self.context.ok():
            self._take(self._runtime.close())
        self._offload.close()

    # -- in ------------------------------------------------------------------------------------

    def _on_trajectory(self, data: bytes) -> None:
        try:
            request = read_trajectory(data)
        except BadInputError as error:
            self._runtime.planning.refuse(error, records.Trajectory((), (), 0))
        else:
            self._runtime.request(request)
        self._serve()

    def _on_stop(self) -> tuple[bool, str]:
        verdict = self._runtime.request(records.Stop())
        self._serve()
        return verdict.severity < records.Severity.ERROR, verdict.message

    def _read_samples(self) -> bool:
        """Process the samples that have arrived; return whether more may wait."""
        if self._samples is None:
            return False
        before, self._read = self._read, monotonic_ns()
        taken = self._samples.take(_AT_ONCE)
        # Samples of two plants do not belong to one actuator.
        if taken and not self._runtime.crowded:
            self._take_samples(taken, before)
        return len(taken) == _AT_ONCE

    def _take_samples(self, taken: Sequence[Taken], after: int) -> None:
        """Process samples that arrived after a steady time in ns."""
        ages = [self._ago(x) for x in taken]
        # The clock may have been set since a sample arrived. It is read last, so that a pause in
        # between cannot make a sample arrive before it was taken.
        most = monotonic_ns() - after
        now = self.now()
        rows: dict[tuple[str, ...], list[Any]] = {}
        for message, age in zip(taken, ages, strict=True):
            try:
                names, stamp, measured = self._reader.read(message.data)
            except BadInputError as error:
                self.get_logger().error(f'sample ignored: {error}', throttle_duration_sec=1.0)
                continue
            rows.setdefault(names, []).append((stamp, *measured, now - min(age, most)))
        if not rows or not self._runtime.looks_at(max(x[0] for y in rows.values() for x in y)):
            return
        for names, of_joints in rows.items():
            for name, samples in records.by_joint(names, of_joints):
                self._runtime.observed(name, samples)

    def _ago(self, taken: Taken) -> int:
        """Return the age of a received message in ns, by the node's clock."""
        return 0 if self._one_clock() else max(time_ns() - taken.received_ns, 0)

    def _glance(self) -> Iterator[tuple[str, records.ObservedSample]]:
        """Yield the newest samples, if any, without decoding all of them."""
        missing = set(self._channels)
        for taken in reversed([] if self._newest is None else self._newest.take()):
            if not missing:
                return
            with suppress(BadInputError):
                names, stamp, measured = self._reader.read(taken.data)
                for name, stretch, rate, flux_density in zip(names, *measured, strict=True):
                    if name in missing:
                        missing.discard(name)
                        ago = self._ago(taken)
                        yield name, records.ObservedSample(
                            stamp, stretch, rate, flux_density,
                            None if self._one_clock() else self.now() - ago - stamp,
                            self._runtime.environment.steady() - ago)

    def _one_clock(self) -> bool:
        """Return whether all nodes share one clock."""
        return self.simulated

    def _observable(self) -> bool:
        """Return whether there may be a publisher of samples."""
        return bool(self.count_publishers(topics.JOINT_STATES.name))

    def _unheard(self) -> str:
        """Return why commands are not carried out; empty if they are."""
        return next(filter(None, (x.unheard() for x in self._channels.values())), '')

    # -- time ----------------------------------------------------------------------------------

    def now(self) -> int:
        """Return the node's time in ns; pass a step of the clock on to the runtime."""
        if self.simulated:
            for taken in [] if self._ticks is None else self._ticks.take()[-1:]:
                try:
                    self._time_source.clock_callback(decode(taken.data, Clock))
                except BadInputError as error:
                    self.get_logger().error(
                        f'message on /clock skipped: {error}', throttle_duration_sec=1.0)
            return super().now()
        # Equal to the time of rclpy's clock, without creating objects.
        now, by = self._steps.read()
        if by:
            self._runtime.clock_set(by)
        return now

    def _follow_clock(self) -> None:
        if self._ticks is None:
            self._ticks = ros_entities.listen(self, topics.CLOCK_TOPIC)

    def _on_jump(self, jump: TimeJump) -> None:
        if jump.delta.nanoseconds < 0:
            self._runtime.clock_set_back(-jump.delta.nanoseconds)

    def _serve(self) -> None:
        """Publish the outputs of the runtime, and schedule the next call."""
        if not self._channels:
            # Cleaned up, while the loop of a controller continues.
            return
        begun = monotonic_ns()
        self._take(self._runtime.tick(self.now()))
        if not self.linked:
            self._listen()
            self._pace(soon=self._read_samples())
            if monotonic_ns() - begun > _POLL_NS and not self._poll.is_canceled():
                # Else, it would be called again at once, and what has arrived not be read.
                self._poll.reset()

    def _serve_soon(self) -> None:
        """Serve within a period, since frequent messages are not served one by one."""
        # The executor calls the timer only after all messages that came before it is due, of
        # which a path has a thousand a second.
        if self.simulated or self._channels and monotonic_ns() > self._due + _READ_NS:
            self._serve()
        elif self._channels and (self._runtime.urgent or self._poll.is_canceled()):
            self._pace()

    def _pace(self, *, soon: bool = False) -> None:
        """Schedule the next service of the runtime, when work is due or soon."""
        wake, longest = self._runtime.wake, _LONGEST_POLL_NS
        if self._samples is not None:
            longest = _POLL_NS if soon else _READ_NS
        elif wake is None and not self.simulated:
            self._poll.cancel()
            self._due = math.inf
            self._runtime.serve_by(None)
            return
        period = _POLL_NS
        if not self.simulated:
            period = longest if wake is None else min(
                max(wake - self.now(), _POLL_NS), longest)
        if period != self._poll.timer_period_ns or self._poll.is_canceled():
            self._poll.timer_period_ns = period
            self._poll.reset()
        self._due = monotonic_ns() + period
        self._runtime.serve_by(steady_ns() + period)

    def _listen(self) -> None:
        """Subscribe to samples while they are needed."""
        wanted = self._runtime.wants_samples
        if wanted:
            self._listen_until = monotonic_ns() + _LINGER_NS
        if wanted and self._samples is None:
            self._samples = ros_entities.listen(self, _SAMPLES)
        elif self._samples is not None and monotonic_ns() > self._listen_until:
            self._samples.destroy()
            self._samples = None

    # -- out -----------------------------------------------------------------------------------

    def _take(self, outputs: Iterable[records.Output]) -> None:
        for output in outputs:
            self._publish(output)

    def _publish(self, output: records.Output) -> None:
        match output:
            case records.Send():
                self._channels[output.joint].publish_command(output, self._settings['frame_id'])
            case records.PlanChanged():
                self._plan.publish(conversions.to_plan(output.stamps, output.samples))
            case records.StatusChanged():
                self._status.publish(conversions.to_planner_status(output))
                if self._action is not None:
                    self._action.update(output)
                self._targets.show(self.now(), {
                    name: float(x.stretch) if x.stretch else None
                    for name, x in output.each.items()})
            case Outcome():
                self._outcomes.publish(conversions.to_outcome(output))
            case records.EstimateChanged():
                self._estimate.publish(conversions.to_diagnostics(
                    output.time, conversions.to_status(
                        f'{self.get_name()}: estimate', output.joint, output.severity,
                        output.message, output.values)))
            case records.Note():
                self.complain(output.message, output.severity is records.Severity.ERROR)

    def _report(self) -> Iterable[DiagnosticStatus]:
        severity, message, values = self._runtime.report()
        self._serve()
        if crowded := self._crowd():
            severity, message = records.Severity.ERROR, crowded
            if crowded != self._crowded:
                self.get_logger().error(crowded)
        self._crowded = crowded
        yield conversions.to_status(
            f'{self.get_name()}: commands', ', '.join(self._channels), severity, message, values)

    def _crowd(self) -> str:
        """Return a message if there are several planners, devices or clocks; else empty."""
        self._duplicates.look()
        rivals = self._duplicates.planners()
        crowd = rivals or self._duplicates.devices(self._settings.names)
        self._runtime.crowded = RefusedError(
            Code.SEVERAL_PLANNERS if rivals else Code.SEVERAL_PLANTS, crowd) if crowd else None
        clocks = self.count_publishers('/clock') if self.simulated else 1
        return crowd or (
            f'{clocks} publishers on /clock, and time may go back and forth: expected one'
            if clocks > 1 else '')

    # -- parameters ----------------------------------------------------------------------------

    def _take_parameters(self, given: Mapping[str, Any]) -> None:
        changed = self._settings.changed(given)
        settings, models = settings_from(changed), models_from(changed, self._runtime.group)
        self._settings = changed
        self._runtime.change(settings, models, simultaneous=changed['simultaneous_arrival'])
        for channel in self._channels.values():
            channel.look_at_temperature()


#: Run by ``hmsa planner`` with the command line's arguments; returns the exit status.
main = partial(run, PlannerNode)
