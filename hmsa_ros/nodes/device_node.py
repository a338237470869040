"""Common base of the nodes that command a device and publish its reports."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
import math
from struct import Struct
from time import monotonic_ns
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState, MagneticField

from hmsa.errors import BadInputError
from hmsa.interfaces import topics
from hmsa.interfaces.parameters import JOINT, LATENESS_LIMIT, ParameterSpec
from hmsa.model.sensor import Sample
from hmsa.model.units import NANOSECONDS
from hmsa_ros.device.watchdog import Change, Fallback, judge_commands, Kind, Notice, SAFE_FLUX
from hmsa_ros.device.worker import STALL
from hmsa_ros.nodes import conversions, ros_entities
from hmsa_ros.nodes.capture import decode, FastPublisher, RawSubscription
from hmsa_ros.nodes.duplicate_nodes import DuplicateNodes
from hmsa_ros.nodes.managed import ManagedNode, silence
from hmsa_ros.nodes.parameters import JointParameters, JOINTS
from hmsa_ros.timekeeping import steady_ns, Throttle

#: Behaviour of a joint without commands; each joint may have its own values.
FALLBACK = (
    ParameterSpec(
        'command_timeout', 1.0,
        'Watchdog: longest time without command or heartbeat, after the first one, before the '
        'coil does what safe_flux says; 0 disables it. Paused time does not count.',
        's', 0.0, 1e6),
    ParameterSpec(
        'safe_flux', 'hold',
        'What the coil does when the watchdog trips: hold the commanded level, go to zero, or '
        'ramp to zero. Use zero or ramp for a real coil that must not be left on.',
        choices=SAFE_FLUX),
    ParameterSpec(
        'safe_ramp_rate', 1.0, 'Rate of the ramp to zero, which has steps of 1 ms.', 'T/s',
        1e-9, 1e12),
    LATENESS_LIMIT,
)

COMMAND_SOURCE = ParameterSpec(
    'command_source', 'any',
    'Publishers whose commands are obeyed: any, or only the first until it disappears.',
    choices=('any', 'first'))
PUBLISH_SCALARS = ParameterSpec(
    'publish_scalars', 'auto',
    'Whether to publish stretch and stretch_rate besides joint_states; auto: only for a '
    'single joint.', choices=('auto', 'always', 'never'))

#: Further parameters common to all devices.
COMMON = (JOINT, JOINTS, COMMAND_SOURCE, PUBLISH_SCALARS)
#: Period of the node's main loop in s.
TICK_SECONDS = 0.001
# Time in ns after a stall for the middleware to deliver the commands that have arrived.
_SETTLE = 30_000_000
# State after a refused command, and while the interlock is open.
_STAYS = ('the previous one stays in force', 'the coil is off')
# Intervals of receipts of a joint in ns: the minimum with commands, the maximum without.
_RECEIPTS, _SIGNS_OF_LIFE = 20_000_000, 200_000_000


def fallback_from(values: Mapping[str, Any]) -> Fallback:
    """Return the fallback described by the values of `FALLBACK`."""
    return Fallback(*(values[x.name] for x in FALLBACK))


class DeviceJoint:
    """
    Topics of an actuator, which obeys commands while its node is active.

    Commands come from any publisher, or only from the first one. A companion of the node commands
    directly, and its publications are ignored. ``received`` counts commands, ``refused`` those
    refused, ``refused_source`` those refused because of their publisher, and ``late`` those that
    were late; ``failed`` counts failures of the device. ``latest`` is the largest lateness in ns.
    """

    def __init__(self, node: 'DeviceNode', number: int) -> None:
        names = node.values.names
        self.name = names[number]
        self._node, self._device, self._number = node, node.device, number
        self._commanded = node.commanded
        self._of_me = '' if len(names) == 1 else f'joint {self.name}: '
        self._crowded = False
        self._refused_due, self._late_due = Throttle(), Throttle()
        self.received = self.refused = self.refused_source = 0
        self.late = self.latest = self.failed = 0
        self._applied, self._received = (
            FastPublisher(ros_entities.publisher(node, topics.of_joint(x, self.name, names)))
            for x in (topics.FLUX_DENSITY_APPLIED, topics.FLUX_DENSITY_RECEIVED))
        # Timestamps of the newest command, and of that of the last receipt; time of arrival of
        # the newest in ns, 0 if it is in a receipt; and steady time of the last receipt, and what
        # it said on rejections.
        self._newest, self._processed, self._came, self._reported_at = 0, 0, 0, 0
        self._reported = ''
        self._topic = topics.of_joint(topics.FLUX_DENSITY_COMMAND, self.name, names)
        # Publishers at the last look, and the identifier of the one obeyed, or ignored as
        # companion.
        self._publishers: dict[bytes, str] = {}
        self._first: bytes | None = None
        self._only_first = node.values[COMMAND_SOURCE.name] == 'first'
        self._commands: Any = (
            ros_entities.listen(node, self._topic) if self._only_first or node.companion
            else ros_entities.subscribe(node, self._topic, self._on_command))

    # -- out -----------------------------------------------------------------------------------

    def publish_applied(self, change: Change) -> None:
        """Publish that a level has taken effect."""
        self._applied.publish(conversions.to_command(change.stamp, change.level, ''))

    def publish_receipt(self) -> None:
        """Publish the newest command once it is processed or dropped, or a sign of life."""
        steady = monotonic_ns()
        passed = steady - self._reported_at
        if passed < _RECEIPTS:
            return
        came = 0 if self._commanded.busy else self._came
        # A heartbeat must not repeat a level that a stall has dropped.
        dropped = self.refuses == conversions.LATE != self._reported
        if passed < _SIGNS_OF_LIFE and not (came or dropped):
            return
        if came:
            self._processed, self._came = self._newest, 0
        refuses = self._reported = self.refuses
        cut = self.cut_off_time if refuses == conversions.CUT_OFF else 0
        self._received.publish(conversions.to_receipt(
            self.name, came or self._node.now(), cut or self._processed, refuses))
        self._reported_at = steady

    @property
    def refuses(self) -> str:
        """Reason why commands are rejected, as in a receipt."""
        if self._commanded.locked or self._node.away:
            return conversions.INTERLOCK
        guard = self._device.guards[self._number]
        if guard.is_cut_off:
            return conversions.CUT_OFF
        late = guard.too_late
        return conversions.LATE if late is not None and late == self._processed else ''

    @property
    def cut_off_time(self) -> int:
        """Time in ns that names the cut-off in force; 0 for none."""
        return int(self._device.guards[self._number].cut_off_time)

    def log(self, notice: Notice) -> None:
        """Count and log a notice of the device."""
        logger = self._node.get_logger()
        text = f'{self._of_me}{notice.text}'
        if notice.kind == Kind.LATE:
            self.late += 1
            self.latest = max(self.latest, notice.late)
            if self._late_due():
                logger.warning(text)
        elif notice.kind == Kind.REFUSED:
            self._refuse(notice.text)
        elif notice.kind in (Kind.SATURATED, Kind.CLOCK):
            logger.warning(text)
        elif notice.kind == Kind.HEARD:
            logger.info(text)
        else:
            self.failed += notice.kind == Kind.FAILED
            logger.error(text)

    # -- in ------------------------------------------------------------------------------------

    def _on_command(self, message: MagneticField) -> None:
        self._obey(lambda: conversions.from_command(message))

    def poll(self) -> None:
        """Process the commands that have arrived, if the executor does not."""
        if not isinstance(self._commands, RawSubscription):
            return
        for taken in self._commands.take():
            if self._obeys(taken.publisher):
                self._obey(lambda data=taken.data: conversions.from_command(  # type: ignore[misc]
                    decode(data, MagneticField)))

    def _obeys(self, publisher: bytes) -> bool:
        """Return whether commands of a publisher on the topic are obeyed."""
        if companion := self._node.companion:
            if publisher not in self._publishers:
                self._publishers = ros_entities.publishers_of(self._node, self._topic.name)
                self._first = next(
                    (x for x, node in self._publishers.items() if node == companion), None)
            if self._publishers.get(publisher) == companion:
                return False
        if not self._only_first:
            return True
        if self._first in (None, publisher) or self._first not in ros_entities.publishers_of(
                self._node, self._topic.name):
            self._first = publisher
            return True
        self.refused_source += 1
        self._node.get_logger().warning(
            f'command on {self._topic.name} refused: it comes from a publisher other than the one '
            'obeyed; stop one of them, or set command_source to any',
            throttle_duration_sec=60.0)
        return False

    def close(self) -> None:
        """Destroy the command subscription."""
        if isinstance(self._commands, RawSubscription):
            self._commands.destroy()
        elif self._commands is not None:
            silence(self._commands)
            self._node.destroy_subscription(self._commands)
        self._commands = None

    def command(self, stamp: int, level: float) -> None:
        """Apply a level in T from a timestamp in ns on, from a planner in the same process."""
        self._obey(lambda: (stamp, level))

    def _obey(self, read: Callable[[], tuple[int, float]]) -> None:
        if not self._node.active:
            return
        self._node.reads_first()
        self.received += 1
        try:
            stamp, level = read()
            self._newest, self._came = stamp, self._node.now()
            self._commanded.receive(self._number, stamp, level)
        except BadInputError as error:
            self._refuse(str(error))

    def _refuse(self, why: str) -> None:
        self.refused += 1
        if self._refused_due():
            stays = _STAYS[self.refuses == conversions.INTERLOCK]
            self._node.get_logger().error(f'{self._of_me}command refused, {stays}: {why}')

    def crowded(self) -> bool:
        """Return whether several publishers command this joint, and log that once."""
        count = self._node.count_publishers(self._topic.name)
        if count > 1 and not self._crowded:
            self._node.get_logger().warning(
                f'{self._of_me}{count} publishers command this joint: expected one; with '
                'command_source first only the first is obeyed')
        self._crowded = count > 1
        return self._crowded


_STAMP = Struct('<iI')
_NUMBER = Struct('<d')
# Values to locate each field by: their bytes do not occur in names.
_MARKS = {'position': math.pi, 'velocity': math.e, 'effort': math.tau}
# Encapsulation before the timestamp of the header: plain CDR, little-endian.
_PLAIN = b'\x00\x01\x00\x00'


class SamplePublisher:
    """
    Publish joint_states, and stretch and stretch rate of each joint if requested.

    rclpy converts a message at each publishing. This takes three times as long as inserting the
    numbers of a sample into a serialized message.
    """

    def __init__(self, node: Node, names: Sequence[str], *, scalars: bool) -> None:
        self._states = FastPublisher(ros_entities.publisher(node, topics.JOINT_STATES))
        self._scalars = [
            tuple(FastPublisher(ros_entities.publisher(node, topics.of_joint(x, name, names)))
                  for x in (topics.STRETCH, topics.STRETCH_RATE))
            for name in names] if scalars else []
        count = len(names)
        message = JointState(name=list(names), **{
            field: [mark] * count for field, mark in _MARKS.items()})
        self._data = bytearray(serialize_message(message))
        self._places = [
            slice(x, x + _NUMBER.size * count)
            for x in (self._data.index(_NUMBER.pack(mark) * count) for mark in _MARKS.values())]

    def publish(self, sample: Sample) -> None:
        """Publish a sample of all joints."""
        _STAMP.pack_into(self._data, len(_PLAIN), *divmod(sample.time, NANOSECONDS))
        for place, values in zip(
                self._places, (sample.stretch, sample.rate, sample.flux_density), strict=True):
            self._data[place] = values.tobytes()
        self._states.publish(bytes(self._data))
        # Empty if only joint_states are published.
        for (of_stretch, of_rate), stretch, rate in zip(
                self._scalars, sample.stretch.tolist(), sample.rate.tolist(), strict=False):
            of_stretch.publish(_PLAIN + _NUMBER.pack(stretch))
            of_rate.publish(_PLAIN + _NUMBER.pack(rate))


class DeviceNode(ManagedNode):
    """
    Publish the reports of a device in ``on_tick``; ``_go_on`` of a subclass advances the device.

    A planner in the same process may command the device directly. ``companion`` is its full name,
    and the linked node replaces ``on_tick``.
    """

    companion = ''
    trouble = ''  # why commands are permanently rejected
    away = ''  # why commands are temporarily rejected
    values: JointParameters
    device: Any
    _joints: Sequence[DeviceJoint] = ()
    _rivals = ''
    # Steady times in ns of the last tick, and until which commands are only read.
    _ticked = _read_until = 0

    def on_tick(self) -> None:
        """Process the commands that have arrived, advance the device, and publish its reports."""
        self._poll_commands()
        if self.reads_first():
            return
        self._go_on()
        self._publish_news()

    def reads_first(self) -> bool:
        """
        Return whether commands must be read before the device advances.

        After a stall of this process, such as SIGSTOP, commands and heartbeats wait to be read,
        which must not be a silence of the planner.
        """
        steady = steady_ns()
        before, self._ticked = self._ticked, steady
        if before and steady - before > STALL and self._joints and self.active:
            self._read_until = steady + _SETTLE
            self._stood_still(steady - before)
        return steady < self._read_until

    def _stood_still(self, span: int) -> None:
        """Have the device consider that this process stood still for some ns."""
        self.commanded.stood_still(span)

    def _poll_commands(self) -> None:
        for joint in self._joints:
            joint.poll()

    @abstractmethod
    def _go_on(self) -> None:
        """Advance the device to the present time."""

    @property
    def commanded(self) -> Any:
        """The receiver of commands, with the attribute `locked`: the device, or its thread."""
        return self.device

    @property
    def leading_time(self) -> int | None:
        """Time in ns, if this device publishes the clock."""
        return None

    def now(self) -> int:
        """Return the time in ns on the clock of command timestamps."""
        leading = self.leading_time
        return super().now() if leading is None else leading

    def _open(self, joint: type[DeviceJoint]) -> None:
        """Create the topics of samples and joints, and start the loop."""
        scalars, names = self.values[PUBLISH_SCALARS.name], self.values.names
        self._samples = SamplePublisher(self, names, scalars=scalars == 'always' or (
            scalars == 'auto' and len(names) == 1))
        self._joints = [joint(self, i) for i in range(len(names))]
        self._publish_news()
        if not self.companion:
            self.every(TICK_SECONDS, self.on_tick)
        self._duplicates = DuplicateNodes(self, samples=False)
        self._diagnose = self.diagnose(self._report)

    def _report(self) -> Iterable[DiagnosticStatus]:
        yield self._status_of_commands()

    def cleanup(self) -> None:
        """Close the subscriptions that no executor serves."""
        for joint in self._joints:
            joint.close()
        if self._joints:
            self._duplicates.close()
        self._joints = ()

    def close(self) -> None:
        """Clean up at the end of the process."""
        self.cleanup()

    # -- publications --------------------------------------------------------------------------

    def _publish_news(self) -> None:
        """Publish the reports of the device since the last call."""
        if self.active and not self.trouble and not self.companion:
            for joint in self._joints:
                joint.publish_receipt()
        for notice in self.device.notices():
            self._joints[notice.joint].log(notice)
        for change in self.device.changes():
            self._publish_change(change)
        for sample in self.device.samples():
            self._publish_sample(sample)

    def _publish_change(self, change: Change) -> None:
        self._joints[change.joint].publish_applied(change)

    def _publish_sample(self, sample: Sample) -> None:
        self._samples.publish(sample)

    def _find_rivals(self) -> str:
        """Return a message if other devices control a joint of this one, and log it once."""
        self._duplicates.look()
        rivals = self._duplicates.devices(self.values.names)
        if rivals and rivals != self._rivals:
            self.get_logger().error(rivals)
        self._rivals = rivals
        return rivals

    def _status_of_commands(self, **values: object) -> DiagnosticStatus:
        """Return the status of the commands, with additional values."""
        joints = self._joints
        counts = {x: sum(getattr(joint, x) for joint in joints) for x in (
            'late', 'refused', 'refused_source', 'failed')}
        silent = [joints[i].name for i in self.device.silent]
        level, message = judge_commands(
            **counts, silent=silent, crowded=[x.name for x in joints if x.crowded()],
            rivals=self._find_rivals())
        return conversions.to_status(
            f'{self.get_name()}: commands', ', '.join(x.name for x in joints),
            level, message,
            {'received': sum(x.received for x in joints), **counts,
             'largest_lateness_ms': f'{max(x.latest for x in joints) / 1e6:.3f}',
             'timeouts': self.device.trips, 'silent': len(silent),
             'time': f'{self.device.time / 1e9:.9f}', **values})
