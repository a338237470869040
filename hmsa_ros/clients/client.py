"""A client of the planner: sends a sequence, receives the verdict, tracks the progress."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import accumulate
import math
from time import monotonic, sleep
from typing import Any
from uuid import uuid4

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.srv import GetState
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from hmsa.cli.terminal import under_way
from hmsa.ending import ENDING
from hmsa.errors import BadInputError, HmsaError
from hmsa.interfaces import topics
from hmsa.interfaces.diagnostics import StatusVerdict
from hmsa.model.status import Code
from hmsa.model.units import NANOSECONDS
from hmsa_ros.clients.experiment import check_stretches
from hmsa_ros.clients.link import Link, SILENCE
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.capture import decode, RawSubscription
from hmsa_ros.nodes.conversions import from_time, to_trajectory
from hmsa_ros.nodes.duplicate_nodes import DuplicateNodes, LATELY_SECONDS
from hmsa_ros.nodes.temporary_node import ServiceCall, SLICE_SECONDS

# Time in s for an existing planner node to subscribe: configuration takes a fraction of a second,
# much longer on a busy machine.
_LISTENS_SECONDS = 60.0
# Time in s until a request without an answer is sent again, doubled each time: a planner that has
# just discovered this client may not have received it.
_AGAIN_SECONDS = 1.0
# Time in s until a subscriber that is in the graph but not matched counts as unreachable.
_MATCHED_SECONDS = 3.0
# Time in s from discovery of a recorder until it is assumed to receive.
_SETTLED_SECONDS = 1.0
# Time in s in which the speed of simulated time is measured.
_PACE_SECONDS = 0.5
# Time in s until all nodes of the host are discovered.
_DISCOVERY_SECONDS = 0.6
_OTHERS = (
    'another planner, plant or driver is running, which a simulated run must not command: stop '
    'it, or set another ROS_DOMAIN_ID')
# Time in s after which killed nodes have left the graph.
_FORGOTTEN_SECONDS = 22.0
# Time in s to discover the subscriber of the commands, and until they count as not carried out.
_DEVICE_SECONDS, _UNHEARD_SECONDS = 1.5, 3.0


class PlannerClient(Link):
    """
    A client of one planner; a context manager.

    Parameters
    ----------
    namespace : str
        Namespace of the planner.
    joints : sequence of str
        Names of its joints.
    timeout : float
        Time in s to wait for the planner.

    """

    def __init__(
            self, *, namespace: str = '', joints: Sequence[str] = ('actuator',),
            timeout: float = 10.0) -> None:
        super().__init__(namespace, timeout)
        self._begin = monotonic()
        self._joints = tuple(joints)
        self._begun: float | None = None  # time at which the planner's subscription was found
        #: Name of the last request.
        self.requested = ''
        # The request, and when and after which time in s it is sent again without an answer.
        self._message: Any = None
        self._again, self._pause = math.inf, _AGAIN_SECONDS

    def find_planner(self, each: Callable[[], None] | None = None) -> None:
        """Wait until a planner subscribes and its status has arrived; call ``each`` meanwhile."""
        where = self._namespace or '/'

        def found() -> bool:
            return self.verdict is not SILENCE and self._reached()

        # A node that does not subscribe yet is still starting.
        self.spin_until(
            lambda: found() or self._is_there(topics.PLANNER), lambda: self.no_planner, each,
            awaited=f'a planner in namespace {where}: start one with hmsa planner')
        state = ServiceCall(
            self.node, GetState, f'{topics.PLANNER}/get_state', GetState.Request())

        def settled() -> bool:
            if found() or not self._is_there(topics.PLANNER):
                return True
            # The answer arrives once the startup is complete.
            answer = state.answer()
            if answer is not None and answer.current_state.label == 'unconfigured':
                raise HmsaError(
                    'the planner is not configured and takes no requests: expected it active '
                    f'(ros2 lifecycle set {where.rstrip("/")}/{topics.PLANNER} configure, then '
                    'activate)')
            return False

        self.spin_until(
            settled, 'the planner does not subscribe to requests', each,
            max(self.timeout, _LISTENS_SECONDS),
            awaited='the planner, which is starting or cannot be reached')
        state.close()
        self.spin_until(
            found, lambda: self.no_planner, each, awaited='the planner to take requests')

    def _reached(self) -> bool:
        """Return whether a request reaches the planner, rather than only other subscribers."""
        if not self.listened:
            self._begun = None
            return False
        if self._begun is None:
            self._begun = monotonic()
        # A subscriber that cannot be reached holds nobody up.
        return (ros_entities.matched(self.node, self._publisher, self._planner)
                or monotonic() - self._begun > _MATCHED_SECONDS)

    def _is_there(self, name: str) -> bool:
        return (name, f'/{self._namespace.strip("/")}') in (
            self.node.get_node_names_and_namespaces())

    def check_alone(self, *, own: bool = False) -> None:
        """
        Check that there is only one planner, plant and driver, as far as can be discovered.

        Parameters
        ----------
        own : bool
            Whether they are expected to be started by the caller. A request for simulated nodes
            must never reach others, so any other node is an error then.

        Raises
        ------
        HmsaError
            If there are several; it names them.

        """
        self.pass_time(self._begin + _DISCOVERY_SECONDS - monotonic())
        duplicates = DuplicateNodes(self.node)
        try:
            end = monotonic() + (_FORGOTTEN_SECONDS if own else LATELY_SECONDS)
            # Killed nodes are still discovered, but inactive.
            with under_way('looking whether a second planner, plant or driver has ended'):
                while duplicates.crowded(self._joints, topics.PLANNER) and monotonic() < end:
                    duplicates.look()
                    if found := (duplicates.planners(topics.PLANNER)
                                 or duplicates.devices(self._joints)):
                        raise HmsaError(_OTHERS if own else found)
                    self.pass_time(SLICE_SECONDS)
            if own and duplicates.crowded(self._joints, topics.PLANNER):
                raise HmsaError(_OTHERS)
        finally:
            duplicates.close()

    def pass_time(self, seconds: float) -> None:
        """Serve callbacks for a time in s."""
        end = monotonic() + seconds
        while monotonic() < end:
            ENDING.check()
            self._executor.spin_once(timeout_sec=min(SLICE_SECONDS, max(end - monotonic(), 0.0)))

    def find_recorder(self) -> None:
        """Wait until a recorder subscribes to the requests, and so to all other topics."""
        since = math.inf

        def recorded() -> bool:
            # The recorder discovers this publisher slightly later than the other way round, and
            # misses earlier messages.
            nonlocal since
            since = min(since, monotonic()) if subscribed() else math.inf
            return monotonic() - since >= _SETTLED_SECONDS

        def subscribed() -> bool:
            heard = ros_entities.subscribers_of(self.node, self._publisher.topic_name).values()
            return not ros_entities.recorders(self.node).isdisjoint(heard) and (
                self._publisher.get_subscription_count() >= len(heard))

        self.spin_until(
            recorded, f'no recorder of {self._publisher.topic_name}; start one with hmsa recorder',
            awaited='a recorder: start one with hmsa recorder')

    def find_plant(self) -> None:
        """Wait briefly until the commands have a subscriber; the planner reports failure."""
        with suppress(HmsaError):
            self.spin_until(lambda: not self.unheard(), 'no plant', timeout=_DEVICE_SECONDS)

    def unheard(self) -> list[str]:
        """Return the command topics without subscribers other than recorders."""
        leave_out = ros_entities.recorders(self.node)
        return [x for x in self._commands() if leave_out.issuperset(
            ros_entities.subscribers_of(self.node, x).values())]

    def _commands(self) -> list[str]:
        """Return the topics on which the planner commands joints, including remapped ones."""
        named = [
            topic for topic, types in self.node.get_topic_names_and_types()
            if topics.FLUX_DENSITY_COMMAND.type in types and self._planner in (
                ros_entities.publishers_of(self.node, topic).values())]
        return [x for x in named if x.split('/')[-2] in self._joints] or named or [
            self.node.resolve_topic_name(
                topics.of_joint(topics.FLUX_DENSITY_COMMAND, x, self._joints).name)
            for x in self._joints]

    def send_sequence(
            self, setpoints: Sequence[tuple[float | Sequence[float], float]],
            levels: Sequence[tuple[float, float]] = (),
            path: Sequence[Sequence[float]] = ()) -> StatusVerdict:
        """
        Send a sequence that begins now, and wait for the verdict.

        Parameters
        ----------
        setpoints : sequence of (float or sequence of float, float)
            Stretch, common or for each joint, and duration in s.
        levels : sequence of (float, float)
            Alternative without setpoints: time in s from now, and flux density in T of all joints
            from then on.
        path : sequence of sequence of float
            Alternative: time in s from now, stretch of all joints, rate in 1/s and acceleration in
            1/s^2, ending at rest. The planner's trajectory_mode must be path.

        Returns
        -------
        Verdict
            Of level OK or WARN.

        Raises
        ------
        BadInputError
            If the number of stretches does not match the joints, or the planner refuses the
            sequence.
        HmsaError
            If the planner does not answer.

        """
        deadline = monotonic() + self.timeout
        while True:
            request = self.publish(setpoints, levels, path)
            self.spin_until(
                lambda request=request: self.verdict.on(request) is not None,  # type: ignore[misc]
                lambda: self._may_run('the planner did not acknowledge the request'),
                self.send_again,
                awaited="the planner's verdict: it plans, or waits for plant, driver, samples or "
                "feedback")
            verdict = self.verdict.on(request)
            if verdict is not None and verdict.level < DiagnosticStatus.ERROR[0]:
                return verdict
            # A planner that has just started may not have received the time yet.
            if verdict is not None and (
                    verdict.code != 'no_time' or monotonic() > deadline):
                raise BadInputError(
                    f'the planner refused: {verdict.message}'
                    + '; name the joints with --joint' * (verdict.code == Code.UNKNOWN_JOINT))
            self._executor.spin_once(timeout_sec=SLICE_SECONDS)
            sleep(SLICE_SECONDS)

    def _may_run(self, unknown: str) -> str:
        """Return what is known of the request, and how to stop it."""
        now, space = self.verdict, self._namespace and f' --namespace {self._namespace}'
        at = f'setpoint {now.setpoint} of {now.setpoints}, ' if now.setpoint else ''
        return (
            f'{unknown}, which may still be carried out: stop it with hmsa stop{space}; last '
            f'status: {at}{now.state}, {now.unheard or now.message}')

    def publish(
            self, setpoints: Sequence[tuple[float | Sequence[float], float]],
            levels: Sequence[tuple[float, float]] = (),
            path: Sequence[Sequence[float]] = ()) -> str:
        """
        Send a sequence as `send_sequence` does, without waiting; return the name of the request.

        Raises
        ------
        BadInputError
            If the number of stretches does not match the joints, or the sequence is too long.

        """
        check_stretches(setpoints, self._joints)
        points: list[tuple[float, Any]] = [
            *levels, *((time, point) for time, *point in path),
            *zip(accumulate(x for _, x in setpoints), (x for x, _ in setpoints), strict=True)]
        if points and points[-1][0] >= 2**31:
            raise BadInputError(
                f'the sequence lasts {points[-1][0]:g} s: expected less than 2^31 s')
        self.requested = uuid4().hex
        self._message = to_trajectory(
            [(x, round(time * NANOSECONDS)) for time, x in points], self._joints,
            frame=self.requested, raw=bool(levels), path=bool(path))
        self._publisher.publish(self._message)
        self._pause = _AGAIN_SECONDS
        self._again = monotonic() + self._pause
        return self.requested

    def send_again(self) -> None:
        """Send the last request again when due; the planner carries it out once."""
        if monotonic() > self._again:
            self._pause *= 2.0
            self._again = monotonic() + self._pause
            self._publisher.publish(self._message)

    def pace(self) -> float:
        """Return the speed of simulated time relative to real time, 1 without simulated time."""
        if not self.node.count_publishers(topics.CLOCK_TOPIC.name):
            return 1.0
        clock = ros_entities.listen(self.node, topics.CLOCK_TOPIC)
        seen: list[tuple[float, float]] = []

        def measured() -> bool:
            if (now := newest_time(clock)) is not None:
                seen.append((monotonic(), now))
            return bool(seen) and seen[-1][0] - seen[0][0] >= _PACE_SECONDS

        try:
            # Without a message the planner says that it has no time.
            with suppress(HmsaError):
                self.spin_until(measured, 'time does not advance', timeout=4.0 * _PACE_SECONDS)
        finally:
            clock.destroy()
        if not seen or seen[-1][1] <= seen[0][1]:
            return 1.0
        return (seen[-1][1] - seen[0][1]) / (seen[-1][0] - seen[0][0])

    def follow(
            self, verdict: StatusVerdict, *, each: Callable[[StatusVerdict], None] | None = None,
            timeout: float) -> StatusVerdict:
        """
        Wait until a sequence has been carried out and, if measured, judged completely.

        Parameters
        ----------
        verdict : Verdict
            The verdict returned by `send_sequence`.
        each : callable, optional
            Called about 20 times a second with the newest verdict.
        timeout : float
            Time limit in s from the start of the sequence on, of simulated time if that is
            published and slower.

        Returns
        -------
        Verdict
            The last one; its ``failure`` is empty if all setpoints arrived.

        Raises
        ------
        HmsaError
            If another request replaces the sequence, the commands are not carried out, or the time
            limit is exceeded.

        """
        heard = monotonic()

        def done() -> bool:
            now = self.verdict
            if now.plan != verdict.plan:
                raise HmsaError(f'the sequence ended early: {self.instead_of(verdict)}')
            nonlocal heard
            ended = (
                now.setpoint == now.setpoints and now.state in ('at_rest', 'settling')
                and not now.watching)
            if now.state == 'idle' and now.level >= DiagnosticStatus.ERROR[0]:
                # Dropped: there will be no further result.
                return True
            if not now.unheard:
                heard = monotonic()
            elif monotonic() - heard > _UNHEARD_SECONDS:
                raise HmsaError(f'the sequence is not carried out: {now.unheard}')
            return ended and not now.unheard

        with _slower_time(self.node, self.timeout) as time:
            self.spin_until(
                done, lambda: self._may_run('the planner did not report the end of the sequence'),
                None if each is None else lambda: each(self.verdict), timeout,
                self._since_start(time), 'the end of the sequence')
        end = self.verdict
        if end.state != 'idle':
            # A refused request leaves the sequence alone, and is the last one in the status.
            end = end.on(verdict.request) or replace(
                end, level=verdict.level, message=verdict.message, code=verdict.code)
        if verdict.code == Code.UNCHANGED:
            # The plan is that of an earlier request, and its other setpoints are not this one's.
            end = end.of_last(self._joints)
        late = end.late - verdict.late
        if late > 0 and not end.failure and end.measured != Code.ARRIVED:
            raise HmsaError(
                f'{late} commands came late, and the result is not measured: expected '
                'commands in time (lead_time), or samples (joint_states)')
        return end

    def _since_start(self, time: Callable[[], float]) -> Callable[[], float]:
        """Return a clock in s that stands still until the planner begins the sequence."""
        waited, before = 0.0, time()

        def passed() -> float:
            nonlocal waited, before
            now = time()
            if self.verdict.state == 'waiting' and self._is_there(topics.PLANNER):
                waited += now - before
            before = now
            return now - waited

        return passed


def newest_time(clock: RawSubscription) -> float | None:
    """Return the newest simulated time in s received on /clock; None without a new one."""
    for taken in clock.take()[-1:]:
        with suppress(BadInputError):
            return from_time(decode(taken.data, Clock).clock) / NANOSECONDS
    return None


@contextmanager
def _slower_time(node: Node, timeout: float) -> Iterator[Callable[[], float]]:
    """Yield a clock in s of simulated time, at most as fast as real time; gaps count."""
    if not node.count_publishers(topics.CLOCK_TOPIC.name):
        yield monotonic
        return
    clock = ros_entities.listen(node, topics.CLOCK_TOPIC)
    passed, heard, before = 0.0, monotonic(), math.nan

    def time() -> float:
        nonlocal passed, heard, before
        now, seconds = monotonic(), newest_time(clock)
        if seconds is not None:
            if seconds > before:
                passed += min(seconds - before, now - heard)
            heard, before = now, seconds
        # Real time counts once the publisher has disappeared.
        return passed + max(now - heard - timeout, 0.0)

    try:
        yield time
    finally:
        clock.destroy()
