"""Monitoring of an experiment: its nodes, the recorder, and the time."""

from collections.abc import Callable
from time import monotonic, time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import SetBool

from hmsa.errors import BadInputError, HmsaError
from hmsa.interfaces import topics
from hmsa.interfaces.diagnostics import whole
from hmsa.interfaces.parameters import BLOCK, WORDS
from hmsa_ros.clients.client import newest_time, PlannerClient
from hmsa_ros.clients.experiment import Experiment, START_SECONDS
from hmsa_ros.clients.remote import remote_parameters
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.temporary_node import ServiceCall

# Time limit in s for a sequence to be completed after its duration.
_GRACE_SECONDS = 20.0
# Time limit in s for a recorder to store the parameters of the nodes.
_STORED_SECONDS = 10.0
# Interval in s of checks of the nodes.
_LOOK_SECONDS = 0.5
_SAME = 1e-9


class ExperimentClient(PlannerClient):
    """
    A client of the planner that also monitors the nodes of an experiment.

    ``check_nodes`` raises an error if a started node has ended.
    """

    def __init__(self, experiment: Experiment, check_nodes: Callable[[], None]) -> None:
        super().__init__(
            namespace=experiment.namespace, joints=experiment.joints, timeout=START_SECONDS)
        self._experiment, self._check_nodes = experiment, check_nodes
        self.notes: list[str] = []
        # Number of topics for which the recorder reports a publisher.
        self._matched = 0
        # Number of nodes whose parameters are in the bag.
        self._stored = 0
        self._time = 0.0
        self._looked = 0.0
        # The time, and the moment at which it last advanced.
        self._seen = 0.0, monotonic()
        self._over: float | None = None
        self._parameters: dict[str, Any] = {}
        ros_entities.subscribe(self.node, topics.DIAGNOSTICS, self._on_diagnostics)
        # Only the newest message is read, since a callback for thousands a second is too slow.
        self._clock = ros_entities.listen(self.node, topics.CLOCK_TOPIC)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {x.key: x.value for x in status.values}
            # Ignore other recorders.
            if values.get('bag') == str(self._experiment.bag):
                self._matched = whole(values.get('matched'))
                self._stored = whole(values.get('parameters_of'))

    @property
    def now(self) -> float:
        """Time of the nodes in s."""
        if not self._experiment.nodes and not self.parameter('planner.use_sim_time'):
            return time()
        seconds = newest_time(self._clock)
        self._time = self._time if seconds is None else seconds
        return self._time

    @property
    def recorder_ready(self) -> bool:
        """Whether the recorder is matched with all published topics."""
        sent = [x for x in self._experiment.topics() if self.node.count_publishers(x)]
        return self._matched >= len(sent)

    def wait_for_parameters(self) -> None:
        """Wait until the bag contains parameters of planner and plant, or note their absence."""
        count = len({x.partition('.')[0] for x in self._parameters})
        try:
            self.spin_until(
                lambda: self._stored >= count, 'no parameters', self._check_nodes, _STORED_SECONDS)
        except HmsaError:
            self.notes.append(
                'the recorder has not read all parameters of planner and plant: they are not in '
                'the bag')

    @property
    def measured(self) -> bool:
        """Whether there is a publisher of samples."""
        return bool(self.node.count_publishers(topics.JOINT_STATES.name))

    # -- checks --------------------------------------------------------------------------------

    def read_parameters(self) -> None:
        """
        Request the parameters of planner and plant; there may be no plant, but a driver.

        Nodes that were started answer once all their publishers exist.
        """
        for name in (topics.PLANNER, topics.PLANT):
            if name == topics.PLANNER or self._experiment.nodes or self._is_there(name):
                self._parameters |= {f'{name}.{x}': y for x, y in remote_parameters(
                    self, name, each=self._check_nodes).items()}

    def parameter(self, name: str) -> object:
        """Return a parameter of a node by ``'node.name'``; None if it does not exist."""
        return self._parameters.get(name)

    def check(self) -> None:
        """
        Check that the running nodes can carry out the experiment.

        Raises
        ------
        BadInputError
            If a node's parameters differ from the parameter file.
        HmsaError
            If the commands have no subscriber.

        """
        wrong = [
            f'{name} is {self.parameter(name)} and not {value}'
            for name, value in self._experiment.expected.items()
            if name in self._parameters and not _same(self.parameter(name), value)]
        if wrong:
            raise BadInputError(
                f'the nodes run with other parameters than the file has ({"; ".join(wrong[:3])}'
                '): expected the same; start them with --params-file and that file')
        for spec in BLOCK:
            own, other = (self.parameter(f'{x}.{spec.name}')
                          for x in (topics.PLANT, topics.PLANNER))
            if own is not None and not _same(own, other):
                self.notes.append(
                    f'{spec.name} is {other} for the planner and {own} for the plant')
        self.spin_until(
            lambda: not self.unheard(),
            'no node receives the commands on '
            f'{", ".join(self.unheard()) or "their topics"}: '
            'expected a plant or a driver of the coil (hmsa plant)',
            awaited='a plant or driver that takes the commands')
        joints = self._experiment.joints
        if not self.node.count_publishers(
                topics.of_joint(topics.FLUX_DENSITY_APPLIED, joints[0], joints).name):
            self.notes.append(
                'no node reports the applied levels (flux_density_applied)')
            if not self.measured:
                raise HmsaError(
                    'no node reports applied levels (flux_density_applied) or samples '
                    '(joint_states): expected a plant or a driver that does')

    def look(self, end: float) -> None:
        """
        Check that the nodes exist and time advances; the sequence is over at ``end`` s.

        Raises
        ------
        HmsaError
            If a check fails.

        """
        self._check_nodes()
        moment, now = monotonic(), self.now
        if moment - self._looked < _LOOK_SECONDS:
            return
        self._looked = moment
        if now > self._seen[0]:
            self._seen = now, moment
        elif moment - self._seen[1] > START_SECONDS:
            raise HmsaError(f'time does not advance beyond {now:g} s: expected messages on /clock')
        if not self.node.count_publishers(
                topics.from_outside(topics.STATUS.name, topics.PLANNER)):
            raise HmsaError(
                'the planner has ended: expected it to run until the end of the sequence')
        if unheard := self.unheard():
            raise HmsaError(
                f'no node receives the commands on {", ".join(unheard)} any more: expected plant '
                'or driver to run until the end')
        if now > end:
            self._over = self._over or moment
            if moment - self._over > _GRACE_SECONDS:
                raise HmsaError(
                    f'the sequence has not ended {_GRACE_SECONDS:g} s after its planned end')

    def unpause(self) -> None:
        """Resume simulated time."""
        call = ServiceCall(
            self.node, SetBool, topics.from_outside(topics.SET_PAUSED.name, topics.PLANT),
            SetBool.Request(data=False))
        for condition, failure in (
                (lambda: call.ready, 'the plant offers no service to unpause it'),
                (lambda: call.answer() is not None, 'the plant did not answer'),
                (lambda: self.now > 0.0, 'time does not begin to advance')):
            self.spin_until(condition, failure, self._check_nodes)


def _same(own: object, other: object) -> bool:
    if isinstance(own, (int, float)) and isinstance(other, (int, float)):
        return own == other or abs(own - other) <= _SAME * max(abs(own), abs(other))
    return own == other or isinstance(other, bool) and own in WORDS[other]
