"""
The link to a planner: its status, and the stop.

Imports little, since a stop must go out as soon as possible: NumPy, which many messages need,
would take half of the start of the process.
"""

import math
from time import monotonic
from uuid import uuid4

from diagnostic_msgs.msg import DiagnosticStatus
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from hmsa.cli.terminal import under_way
from hmsa.ending import ENDING
from hmsa.errors import HmsaError, listed
from hmsa.interfaces import topics
from hmsa.interfaces.diagnostics import StatusVerdict
from hmsa.model.status import Code
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.temporary_node import SLICE_SECONDS, TemporaryNode

# Time limit in s for a stop, perhaps in slow motion; time until it is sent again to a planner that
# has not answered, as one that was just discovered may not have received it; and interval of looks
# for the planner, as discovery wakes no executor.
_STOP_SECONDS = 15.0
_AGAIN_SECONDS = 0.1
_LOOK_SECONDS = 0.005

# Codes of warnings that a stop has failed; others, as of a plan made anew, are not its end.
_FAILED = (Code.SUPERSEDED, Code.VIBRATING)
# Codes of errors that say whether the coil is off, or what to do.
_KNOWN = (*_FAILED, Code.UNHEARD, Code.CUT_OFF, Code.INTERLOCK)
#: Verdict before the first status.
SILENCE = StatusVerdict(0, 'no reply from the planner yet', '', '', '', 0, 0)


class Link(TemporaryNode):
    """
    A link to the planner of a namespace; a context manager.

    Parameters
    ----------
    namespace : str
        Namespace of the planner.
    timeout : float
        Time in s to wait for the planner.

    """

    def __init__(self, namespace: str = '', timeout: float = 10.0) -> None:
        super().__init__('client', namespace, timeout)
        self._namespace = namespace
        self._planner = ros_entities.full_name(topics.PLANNER, namespace)
        #: Last verdict of the planner.
        self.verdict: StatusVerdict = SILENCE
        ros_entities.subscribe(self.node, topics.STATUS, self._on_status, topics.PLANNER)
        self._publisher = ros_entities.publisher(
            self.node, topics.JOINT_TRAJECTORY, topics.PLANNER)

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.verdict = StatusVerdict.read(message)

    @property
    def planner(self) -> str:
        """The planner, in words."""
        return f'the planner in namespace {self._namespace or "/"}'

    @property
    def no_planner(self) -> str:
        """That no planner is found, and what to do."""
        here = f'no planner in namespace {self._namespace or "/"}'
        if others := self.namespaces:
            return f'{here}, but in {listed(others)}: name it with --namespace {others[0]}'
        return (
            f'{here}; start one with hmsa planner, with the same ROS_DOMAIN_ID and '
            'ROS_AUTOMATIC_DISCOVERY_RANGE as here')

    @property
    def namespaces(self) -> list[str]:
        """Other namespaces with a planner."""
        return sorted(x for name, x in self.node.get_node_names_and_namespaces()
                      if name == topics.PLANNER and x != self.node.get_namespace())

    def instead_of(self, verdict: StatusVerdict) -> str:
        """Return what the planner carries out instead of the plan of a verdict, in words."""
        # It counts plans, and knows the recent requests by name.
        if self.verdict.plan <= verdict.plan:
            return (
                f'{self.planner} was restarted, or a second one answers ({self.verdict.message}): '
                'expected one until the end')
        return (
            'a newer request arrived, for its joints or for others '
            f'({self.verdict.message})')

    def publish_stop(self, name: str) -> None:
        """Send a stop of a name."""
        self._publisher.publish(JointTrajectory(header=Header(frame_id=name)))

    @property
    def listened(self) -> bool:
        """Whether the planner subscribes to the requests, as far as known."""
        return bool(self._publisher.get_subscription_count()) and self._planner in (
            ros_entities.subscribers_of(self.node, self._publisher.topic_name).values())

    def stop(self) -> StatusVerdict:
        """
        Stop the planner before anything else is known of it, and wait for the result.

        Signals are ignored if one has requested the end already.

        Returns
        -------
        Verdict
            With the code ``stopped``.

        Raises
        ------
        HmsaError
            If plant or driver have not acknowledged the stop, or samples contradict it: what is
            known, and what to do.
        KeyboardInterrupt
            If a signal requested the end meanwhile.

        """
        asked, stopping = ENDING.asked, Stopping(self)
        with under_way(stopping.words) as change:
            while stopping.failure is None and stopping.done is None:
                if not asked:
                    ENDING.check()
                change(stopping.words)
                self._executor.spin_once(
                    timeout_sec=SLICE_SECONDS if stopping.answered else _LOOK_SECONDS)
                stopping.go_on()
        if stopping.done is None:
            raise HmsaError(stopping.failure or '')
        return stopping.done

    def try_to_stop(self) -> str:
        """Stop as `stop` does; return why it is not known to rest, empty if it is."""
        try:
            self.stop()
        except HmsaError as error:
            return str(error)
        return ''


class Stopping:
    """
    A stop of the planner of a link, to be continued by `go_on` while the link is spun.

    It is a trajectory without points on the topic of the requests, so that it cannot overtake the
    last one of the link. ``done`` is the verdict once it says stopped, ``failure`` the reason why
    it does not.
    """

    def __init__(self, link: Link) -> None:
        self._link, self._begin = link, monotonic()
        self._name, self._sent = uuid4().hex, -math.inf
        self._verdict: StatusVerdict | None = None
        self.done: StatusVerdict | None = None
        self.failure: str | None = None
        self.go_on()

    @property
    def answered(self) -> bool:
        """Whether the planner has answered the stop, so that another request comes after it."""
        return self._verdict is not None

    @property
    def words(self) -> str:
        """What is awaited, or the result."""
        if self.done is not None:
            return self.done.message
        if self.failure is not None:
            return self.failure
        if self._sent == -math.inf:
            others = self._link.namespaces
            where = f' (one runs in {listed(others)}: --namespace {others[0]})' if others else ''
            return (
                f'waiting up to {self._link.timeout:g} s for {self._link.planner}, to stop it'
                f'{where}')
        return f'waiting for {self._link.planner} to answer the stop' if (
            self._verdict is None) else 'stopping: waiting for plant or driver to acknowledge it'

    def go_on(self) -> None:
        """Send the stop, again until it is answered, and look for its result."""
        link, now = self._link, monotonic()
        verdict = self._verdict = link.verdict.on(self._name) or self._verdict
        passed = now - self._begin
        if verdict is None:
            if now - self._sent > _AGAIN_SECONDS and link.listened:
                self._sent = now
                link.publish_stop(self._name)
            if passed > link.timeout:
                self.failure = (
                    f'waited {passed:.0f} s: {link.no_planner}; if an actuator moves, switch '
                    'its coil off' if self._sent == -math.inf else
                    f'the planner has not answered the stop for {passed:.1f} s: switch the coil '
                    'off')
        elif verdict.code == Code.STOPPED and verdict.level < DiagnosticStatus.ERROR[0]:
            self.done = verdict
        elif verdict.level >= DiagnosticStatus.ERROR[0] or verdict.code in _FAILED:
            self.failure = verdict.message + (
                '' if verdict.code in _KNOWN else
                '; plant or driver has not acknowledged the stop: switch the coil off there')
        elif link.verdict.plan != verdict.plan or link.verdict.on(self._name) is None:
            self.failure = f'the stop was sent, but {link.instead_of(verdict)}'
        elif not link.listened:
            self.failure = (
                f'the stop was sent, but {link.planner} has ended: if an actuator moves, switch '
                'its coil off')
        elif passed > _STOP_SECONDS:
            self.failure = (
                f'the planner has not come to rest ({link.verdict.state}: {verdict.message}): '
                'expected rest; hmsa watch shows the motion')
