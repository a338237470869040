"""A client of the planner: sends a sequence, reads the verdict, follows the progress."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import accumulate
import math
from time import monotonic, sleep
from typing import Any
from uuid import uuid4

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.srv import GetState
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from hmsa_ros.ending import ENDING
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.interfaces import topics
from hmsa_ros.interfaces.status import Verdict
from hmsa_ros.lab import graph
from hmsa_ros.lab.experiment import check_stretches
from hmsa_ros.model.status import Code
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.nodes import endpoints
from hmsa_ros.nodes.capture import decode, RawSubscription
from hmsa_ros.nodes.conversions import from_time, to_trajectory
from hmsa_ros.nodes.presence import LATELY_SECONDS, Presence
from hmsa_ros.nodes.service_call import ServiceCall
from hmsa_ros.nodes.visitor import SLICE_SECONDS, Visitor

# How long a planner whose node is there may take to listen: it configures itself in a fraction of
# a second, which a machine that is busy with much else stretches.
_LISTENS_SECONDS = 60.0
# To come to rest, perhaps in slow motion; and until a planner that does not answer is gone.
_STOP_SECONDS = 15.0
_GONE_SECONDS = 3.0
# How long a recorder is seen before it is taken to hear.
_SETTLED_SECONDS = 1.0
# Until all nodes of the host are seen.
_DISCOVERY_SECONDS = 0.6
_OTHERS = (
    'another planner, plant or driver is running, which a simulated run must not command: stop '
    'it, or set another ROS_DOMAIN_ID')
# Nodes that were killed have left the graph after this time.
_FORGOTTEN_SECONDS = 22.0
# Whoever carries out commands may not have been found yet.
_UNHEARD_SECONDS = 3.0


_SILENCE = Verdict(0, 'no reply from the planner yet', '', '', '', 0, 0)


class PlannerClient(Visitor):
    """
    Talks to one planner; a context manager.

    Parameters
    ----------
    namespace : str
        Namespace of the planner.
    joints : sequence of str
        Names of its joints.
    timeout : float
        Patience with a silent planner in s.

    """

    def __init__(
            self, *, namespace: str = '', joints: Sequence[str] = ('actuator',),
            timeout: float = 10.0) -> None:
        super().__init__('client', namespace, timeout)
        self._begin = monotonic()
        self._joints = tuple(joints)
        self._namespace = namespace
        #: What the planner said last.
        self.verdict: Verdict = _SILENCE
        #: The request that was sent last.
        self.requested = ''
        endpoints.subscribe(self.node, topics.STATUS, self._on_status, topics.PLANNER)
        self._publisher = endpoints.publisher(
            self.node, topics.JOINT_TRAJECTORY, topics.PLANNER)

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.verdict = Verdict.read(message)

    def find_planner(self, each: Callable[[], None] | None = None) -> None:
        """Wait until a planner listens and its status has arrived, and call ``each`` meanwhile."""
        where = self._namespace or '/'
        failure = (
            f'no planner in namespace {where}; start one with hmsa planner, with the same '
            'ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE as here')

        def found() -> bool:
            return (self.verdict is not _SILENCE
                    and self._publisher.get_subscription_count() > 0)

        # One whose node is there but does not listen yet is still starting.
        self.spin_until(lambda: found() or self._is_there(topics.PLANNER), failure, each)
        state = ServiceCall(
            self.node, GetState, f'{topics.PLANNER}/get_state', GetState.Request())

        def settled() -> bool:
            if found() or not self._is_there(topics.PLANNER):
                return True
            # It answers as soon as it is not busy with its start.
            answer = state.answer()
            if answer is not None and answer.current_state.label == 'unconfigured':
                raise HmsaError(
                    'the planner is not configured and takes no requests: expected it active '
                    f'(ros2 lifecycle set {where.rstrip("/")}/{topics.PLANNER} configure, then '
                    'activate)')
            return False

        self.spin_until(
            settled, 'the planner does not subscribe to requests', each,
            max(self._timeout, _LISTENS_SECONDS))
        state.close()
        self.spin_until(found, failure, each)

    def _is_there(self, name: str) -> bool:
        return (name, f'/{self._namespace.strip("/")}') in (
            self.node.get_node_names_and_namespaces())

    def check_alone(self, *, own: bool = False) -> None:
        """
        Make sure that there are no two planners, plants or drivers, as far as can be seen.

        Parameters
        ----------
        own : bool
            Whether those that are there should be ours: a request for simulated ones must never
            reach others. Then none may be seen beside them.

        Raises
        ------
        HmsaError
            If there are; it names them.

        """
        self.pass_time(self._begin + _DISCOVERY_SECONDS - monotonic())
        presence = Presence(self.node)
        try:
            end = monotonic() + (_FORGOTTEN_SECONDS if own else LATELY_SECONDS)
            # Killed ones are still seen, but not heard.
            while presence.crowded(self._joints, topics.PLANNER) and monotonic() < end:
                presence.look()
                if found := presence.planners(topics.PLANNER) or presence.devices(self._joints):
                    raise HmsaError(_OTHERS if own else found)
                self.pass_time(SLICE_SECONDS)
            if own and presence.crowded(self._joints, topics.PLANNER):
                raise HmsaError(_OTHERS)
        finally:
            presence.close()

    def pass_time(self, seconds: float) -> None:
        """Serve callbacks for some time."""
        end = monotonic() + seconds
        while monotonic() < end:
            ENDING.check()
            self._executor.spin_once(timeout_sec=min(SLICE_SECONDS, max(end - monotonic(), 0.0)))

    def find_recorder(self) -> None:
        """Wait until somebody who records subscribes to what is sent, and with it to all else."""
        since = math.inf

        def recorded() -> bool:
            # The recorder learns of this publisher a little later than the other way round, and
            # drops what comes before.
            nonlocal since
            since = min(since, monotonic()) if subscribed() else math.inf
            return monotonic() - since >= _SETTLED_SECONDS

        def subscribed() -> bool:
            heard = endpoints.subscribers_of(self.node, self._publisher.topic_name).values()
            return not graph.recorders(self.node).isdisjoint(heard) and (
                self._publisher.get_subscription_count() >= len(heard))

        self.spin_until(
            recorded, f'no recorder of {self._publisher.topic_name}; start one with hmsa recorder')

    def find_plant(self) -> None:
        """Wait until the commands reach somebody, for a short time: the planner reports it."""
        with suppress(HmsaError):
            self.spin_until(lambda: not self.unheard(), 'no plant', timeout=_UNHEARD_SECONDS)

    def unheard(self) -> list[str]:
        """Return the topics of commands that nobody but recorders subscribes to."""
        return graph.unheard(self.node, self._namespace, self._joints)

    def send(
            self, setpoints: Sequence[tuple[float | Sequence[float], float]],
            levels: Sequence[tuple[float, float]] = (),
            path: Sequence[Sequence[float]] = ()) -> Verdict:
        """
        Send a sequence that begins now and wait for the verdict.

        Parameters
        ----------
        setpoints : sequence of (float or sequence of float, float)
            Stretch, of all joints or one a joint, and span in s.
        levels : sequence of (float, float)
            Instead, with no setpoints: time in s from now, and flux density in T of all joints
            from then on.
        path : sequence of sequence of float
            Instead: time in s from now, stretch of all joints, rate in 1/s and acceleration in
            1/s^2, ending at rest. The planner's trajectory_mode must be path.

        Returns
        -------
        Verdict
            Of level OK or WARN.

        Raises
        ------
        BadInputError
            If the stretches are not as many as the joints, or the planner refuses the sequence.
        HmsaError
            If it does not answer.

        """
        deadline = monotonic() + self._timeout
        while True:
            request = self.publish(setpoints, levels, path)
            self.spin_until(
                lambda request=request: self.verdict.request == request,  # type: ignore[misc]
                'the planner did not reply with a verdict')
            if self.verdict.level < DiagnosticStatus.ERROR[0]:
                return self.verdict
            # A planner that has just started may not have heard the time yet.
            if self.verdict.code != 'no_time' or monotonic() > deadline:
                raise BadInputError(f'the planner refused: {self.verdict.message}')
            self._executor.spin_once(timeout_sec=SLICE_SECONDS)
            sleep(SLICE_SECONDS)

    def publish(
            self, setpoints: Sequence[tuple[float | Sequence[float], float]],
            levels: Sequence[tuple[float, float]] = (),
            path: Sequence[Sequence[float]] = ()) -> str:
        """
        Send a sequence as `send` does, without waiting; return the name of the request.

        Raises
        ------
        BadInputError
            If the stretches are not as many as the joints, or the sequence is too long.

        """
        check_stretches(setpoints, self._joints)
        points: list[tuple[float, Any]] = [
            *levels, *((time, point) for time, *point in path),
            *zip(accumulate(x for _, x in setpoints), (x for x, _ in setpoints), strict=True)]
        if points and points[-1][0] >= 2**31:
            raise BadInputError(
                f'the sequence lasts {points[-1][0]:g} s: expected less than 2^31 s')
        self.requested = uuid4().hex
        self._publisher.publish(to_trajectory(
            [(x, round(time * NANOSECONDS)) for time, x in points], self._joints,
            frame=self.requested, raw=bool(levels), path=bool(path)))
        return self.requested

    @property
    def listened(self) -> bool:
        """Whether somebody subscribes to what is sent."""
        return bool(self._publisher.get_subscription_count())

    def follow(
            self, verdict: Verdict, *, each: Callable[[Verdict], None] | None = None,
            timeout: float) -> Verdict:
        """
        Wait until a sequence has been carried out, and all of it judged where it is measured.

        Parameters
        ----------
        verdict : Verdict
            As `send` returned it.
        each : callable, optional
            Called about 20 times a second with the newest verdict.
        timeout : float
            Patience in s; in simulated ones where that time is published and runs slower.

        Returns
        -------
        Verdict
            The last one; its ``failure`` says whether all setpoints arrived.

        Raises
        ------
        HmsaError
            If another request took its place, nobody carries out the commands, or it takes too
            long.

        """
        heard = monotonic()

        def done() -> bool:
            now = self.verdict
            if now.request != verdict.request:
                raise HmsaError(
                    'the sequence was not followed to its end: a newer request came, for its '
                    f'joints or others ({now.message})')
            nonlocal heard
            ended = (
                now.setpoint == now.setpoints and now.state in ('at_rest', 'settling')
                and not now.watching)
            if now.state == 'idle' and now.level >= DiagnosticStatus.ERROR[0]:
                # Dropped: nothing more comes of it.
                return True
            if not now.unheard:
                heard = monotonic()
            elif monotonic() - heard > _UNHEARD_SECONDS:
                raise HmsaError(f'the sequence is not carried out: {now.unheard}')
            return ended and not now.unheard

        with _slower_time(self.node, self._timeout) as time:
            self.spin_until(
                done, 'the sequence has not finished',
                None if each is None else lambda: each(self.verdict), timeout, time)
        late = self.verdict.late - verdict.late
        if late > 0 and not self.verdict.failure and self.verdict.measured != Code.ARRIVED:
            raise HmsaError(
                f'{late} commands came late, and what comes of it is not measured: expected '
                'commands in time (lead_time), or samples (joint_states)')
        return self.verdict

    def stop(self) -> bool:
        """Have the planner come to rest, signals or not; return whether it says that it rests."""
        stop = endpoints.call(self.node, topics.STOP, topics.PLANNER, Trigger.Request())
        begin = monotonic()
        answer = None
        while monotonic() - begin < _STOP_SECONDS:
            self._executor.spin_once(timeout_sec=SLICE_SECONDS)
            # What was sent last may be on its way: the stop must come after it.
            patient = monotonic() - begin < _GONE_SECONDS
            if answer is None and (self.verdict.request == self.requested or not patient):
                answer = stop.answer()
                if answer is None and not patient and not stop.ready:
                    return False
            if answer is not None and self.verdict.state in ('at_rest', 'settling', 'idle'):
                return bool(answer.success)
        return False


def newest_time(clock: RawSubscription) -> float | None:
    """Return the newest simulated time in s that has come on /clock; None without a new one."""
    for taken in clock.take()[-1:]:
        with suppress(BadInputError):
            return from_time(decode(taken.data, Clock).clock) / NANOSECONDS
    return None


@contextmanager
def _slower_time(node: Node, timeout: float) -> Iterator[Callable[[], float]]:
    """Give a clock in s of simulated time that is no faster than the wall's; silence counts."""
    if not node.count_publishers(topics.CLOCK_TOPIC.name):
        yield monotonic
        return
    clock = endpoints.listen(node, topics.CLOCK_TOPIC)
    passed, heard, before = 0.0, monotonic(), math.nan

    def time() -> float:
        nonlocal passed, heard, before
        now, seconds = monotonic(), newest_time(clock)
        if seconds is not None:
            if seconds > before:
                passed += min(seconds - before, now - heard)
            heard, before = now, seconds
        # Where nobody publishes it any more the wall's counts.
        return passed + max(now - heard - timeout, 0.0)

    try:
        yield time
    finally:
        clock.destroy()
