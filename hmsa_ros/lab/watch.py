"""What an experiment looks at: who is there, the recorder's readiness, and the time."""

from collections.abc import Callable
from time import monotonic, time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import SetBool

from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.interfaces import topics
from hmsa_ros.interfaces.parameters import BLOCK, WORDS
from hmsa_ros.interfaces.status import whole
from hmsa_ros.lab.client import newest_time, PlannerClient
from hmsa_ros.lab.experiment import Experiment, START_SECONDS
from hmsa_ros.lab.remote import parameters_of
from hmsa_ros.nodes import endpoints

# How long the end of a sequence may keep us waiting after its time is over.
_GRACE_SECONDS = 20.0
# How long a recorder may take at the end to read the parameters of the nodes.
_STORED_SECONDS = 10.0
# Between two looks at who is there.
_LOOK_SECONDS = 0.5
_SAME = 1e-9


class Watch(PlannerClient):
    """
    A client of the planner that looks at the nodes of an experiment as well.

    ``check_nodes`` raises if one of those that were started has ended.
    """

    def __init__(self, experiment: Experiment, check_nodes: Callable[[], None]) -> None:
        super().__init__(
            namespace=experiment.namespace, joints=experiment.joints, timeout=START_SECONDS)
        self._experiment, self._check_nodes = experiment, check_nodes
        self.notes: list[str] = []
        # Topics of which the recorder has found a publisher, by what it says.
        self._matched = 0
        # Nodes whose parameters are in the bag.
        self._stored = 0
        self._time = 0.0
        self._looked = 0.0
        # The time, and when it last went on.
        self._seen = 0.0, monotonic()
        self._over: float | None = None
        self._parameters: dict[str, Any] = {}
        endpoints.subscribe(self.node, topics.DIAGNOSTICS, self._on_diagnostics)
        # Only the newest counts: the executor would call for each of thousands a second.
        self._clock = endpoints.listen(self.node, topics.CLOCK_TOPIC)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {x.key: x.value for x in status.values}
            # Others may record too.
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
        """Whether the recorder hears everything that somebody sends."""
        sent = [x for x in self._experiment.topics() if self.node.count_publishers(x)]
        return self._matched >= len(sent)

    def wait_for_parameters(self) -> None:
        """Wait until parameters of planner and plant are in the bag, or note that they are not."""
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
        """Whether somebody publishes samples."""
        return bool(self.node.count_publishers(topics.JOINT_STATES.name))

    # -- checks --------------------------------------------------------------------------------

    def read_parameters(self) -> None:
        """
        Ask planner and plant for their parameters; a driver of hardware may have none.

        Nodes that were started answer when they have created all that they publish.
        """
        for name in (topics.PLANNER, topics.PLANT):
            if name == topics.PLANNER or self._experiment.nodes or self._is_there(name):
                self._parameters |= {f'{name}.{x}': y for x, y in parameters_of(
                    self, name, each=self._check_nodes).items()}

    def parameter(self, name: str) -> object:
        """Return a parameter of a node by ``'node.name'``; None if it has none."""
        return self._parameters.get(name)

    def check(self) -> None:
        """
        Make sure that what runs can do what is asked.

        Raises
        ------
        BadInputError
            If a node's parameters are not those of the parameter file.
        HmsaError
            If nobody takes the commands.

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
            'expected a plant or a driver of the coil (hmsa plant)')
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
        Make sure that the nodes are there and time goes on; the sequence is over at ``end`` s.

        Raises
        ------
        HmsaError
            If something has gone.

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
            raise HmsaError('the planner has gone: expected it to run until the end')
        if unheard := self.unheard():
            raise HmsaError(
                f'no node receives the commands on {", ".join(unheard)} any more: expected plant '
                'or driver to run until the end')
        if now > end:
            self._over = self._over or moment
            if moment - self._over > _GRACE_SECONDS:
                raise HmsaError(
                    f'the sequence has not come to its end {_GRACE_SECONDS:g} s after its time')

    def unpause(self) -> None:
        """Let simulated time run."""
        call = endpoints.call(
            self.node, topics.SET_PAUSED, topics.PLANT, SetBool.Request(data=False))
        for condition, failure in (
                (lambda: call.ready, 'the plant offers no service to unpause it'),
                (lambda: call.answer() is not None, 'the plant did not answer'),
                (lambda: self.now > 0.0, 'time does not begin to advance')):
            self.spin_until(condition, failure, self._check_nodes)


def _same(own: object, other: object) -> bool:
    if isinstance(own, (int, float)) and isinstance(other, (int, float)):
        return own == other or abs(own - other) <= _SAME * max(abs(own), abs(other))
    return own == other or isinstance(other, bool) and own in WORDS[other]
