"""
Recorder: writes topics to a bag, and counts and reports lost messages.

The node's own executor serves discovery, services and diagnostics. Messages bypass it: `Capture`
takes them from their subscriptions in a thread, `WriterThread` writes them in another. The quality
of service of a subscription matches the publishers.

As a managed node, it opens the bag when it is configured, records while it is active, and closes
the bag when it is cleaned up.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
import datetime
from functools import partial
import json
from operator import gt, lt
from pathlib import Path
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import ParameterEvent
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from hmsa import __version__
from hmsa.bag.definitions import message_definition, type_hash
from hmsa.bag.output import PRESETS
from hmsa.bag.qos import Qos
from hmsa.bag.writer import BagTopic, BagWriter, parse_custom_data
from hmsa.bag.writer_thread import (
    figures,
    judge,
    lost_by_topic,
    RecordedTopic,
    RecordingLimits,
    Status,
    WriterThread,
)
from hmsa.errors import BadInputError, BagError
from hmsa.interfaces import topics
from hmsa.interfaces.parameters import duration_from, duration_specs, ParameterSpec
from hmsa.model.units import NANOSECONDS
from hmsa_ros.middleware import ros_distro
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.capture import Capture, decode, RawSubscription, SimulatedTime, Taken
from hmsa_ros.nodes.conversions import from_time, to_status
from hmsa_ros.nodes.managed import ManagedNode, run
from hmsa_ros.nodes.parameters import declare
from hmsa_ros.nodes.selection import Selection, stored_profile, subscription_profile
from hmsa_ros.nodes.temporary_node import RemoteParameters
from hmsa_ros.timekeeping import StepWatch

# Share of the memory for waiting messages that the queues of the middleware may take: these serve
# while the recorder gets no processor, its own queue while the disk is slow.
_QUEUES = 1 / 4
# Smallest queue of a subscription.
_MIN_DEPTH = 2
# Every so many looks, all publishers are looked up, even if their number has not changed.
_FULL_LOOK = 10
PARAMETERS = (
    ParameterSpec(
        'storage.uri', '',
        'Folder of the new bag, which must not exist yet; empty for a name with date and time.'),
    ParameterSpec(
        'storage.storage_preset_profile', 'none',
        'Compression: none, fastwrite (none, without checksums), lz4, zstd_fast or zstd_small.',
        choices=tuple(PRESETS)),
    ParameterSpec(
        'storage.max_bagfile_size', 0,
        'File size at which the bag is split; 0 for never, otherwise at least 1024.', 'B', 0),
    ParameterSpec(
        'storage.max_bagfile_duration', 0,
        'Duration after which the bag is split; 0 for never.', 's', 0),
    ParameterSpec(
        'storage.max_cache_size', 100 * 2**20,
        'Memory for messages waiting to be written; messages beyond it are counted as lost.',
        'B', 2**16),
    ParameterSpec(
        'storage.custom_data', [], 'Pairs key=value to store in the bag.'),
    ParameterSpec(
        'storage.flush_period', 0.5,
        'Longest time until a received message survives a crash of the process.', 's',
        0.01, 3600.0),
    ParameterSpec(
        'storage.fsync', False,
        'Whether each flush waits for the disk, so that messages also survive a power failure.'),
    ParameterSpec(
        'record.topics', [],
        'Topics to record; with no selection at all, every topic is recorded.'),
    ParameterSpec('record.all_topics', False, 'Whether to record every topic.'),
    ParameterSpec(
        'record.regex', '', 'Regular expression; topics that contain a match are recorded.'),
    ParameterSpec('record.exclude_topics', [], 'Topics not to record.'),
    ParameterSpec(
        'record.exclude_regex', '',
        'Regular expression; topics that contain a match are not recorded.'),
    ParameterSpec('record.start_paused', False, 'Whether to start paused.'),
    *duration_specs(
        'record.topic_polling_interval', 0, 'Whole seconds between searches for new topics.',
        most=3600, nanoseconds=100_000_000),
    ParameterSpec(
        'record.queue_depth', 10_000,
        'Longest queue of a subscription in the middleware; large messages get shorter ones, '
        'which take a quarter of storage.max_cache_size in all.', '', 1, 1_000_000),
    ParameterSpec(
        'record.snapshot_mode', False,
        'Whether to keep messages only in memory until ~/snapshot is called.'),
    ParameterSpec(
        'record.snapshot_duration', 10.0, 'How far back a snapshot reaches.', 's', 1e-3, 1e6),
    ParameterSpec(
        'experiment.nodes', [topics.PLANNER, topics.PLANT],
        'Nodes whose parameters are stored in the bag; a name without a slash matches nodes in '
        'any namespace.'),
)

# Time from the request to end until the last messages are taken.
_LINGER_SECONDS = 0.1
# Limit on the number of nodes whose parameters are requested.
_MAX_NODES = 256


class Subscriptions:
    """
    Subscribe to the selected topics, and list them in ``topics``.

    ``depth`` is the largest number of messages in the queue of a subscription, and ``cache_size``
    the memory in bytes for waiting messages. The middleware limits a queue by messages only, and
    keeps the memory of a queue that was full: large messages get shorter queues.
    """

    def __init__(
            self, node: Node, selection: Selection, recording: WriterThread, capture: Capture,
            depth: int, cache_size: int) -> None:
        self.topics: dict[str, RecordedTopic] = {}
        self._node = node
        self._selection = selection
        self._recording = recording
        self._capture = capture
        self._depth = depth
        self._queue_size = cache_size * _QUEUES
        self._refused: set[str] = set()
        self._reported_ready = False
        self._looks = 0

    @property
    def wanted_count(self) -> int:
        """Return the number of topics to record, as far as it is known."""
        missing = [name for name in self._selection.topics if name not in self.topics]
        return len(self.topics) + len(missing)

    def silent(self) -> list[str]:
        """Return the topics, subscribed to or selected by name, without any message so far."""
        heard = {name for name, topic in self.topics.items() if topic.received}
        return sorted({*self._selection.topics, *self.topics} - heard)

    def look(self, found: Iterable[tuple[str, Sequence[str]]]) -> None:
        """Subscribe to the new topics among those found, given with their types."""
        self._looks += 1
        for name, types in found:
            if self._selection.wants(name):
                self._look_at(name, types)
        self._shorten()
        if not self._reported_ready and self._selection.topics \
                and self.wanted_count == len(self.topics):
            self._reported_ready = True
            self._node.get_logger().info(
                f'ready: subscribed to all {len(self._selection.topics)} topics')

    def _look_at(self, name: str, types: Sequence[str]) -> None:
        """Subscribe to a topic, or again if its publishers require it."""
        known = self.topics.get(name)
        # Looking up the publishers takes five times as long as counting them.
        count = self._node.count_publishers(name)
        if known is not None and count == known.publishers and self._looks % _FULL_LOOK:
            return
        infos = [info for info in self._node.get_publishers_info_by_topic(name)
                 if known is None or info.topic_type == known.type]
        if known is not None:
            known.publishers = count
        if not infos:
            return
        offered = tuple(sorted((stored_profile(info.qos_profile) for info in infos), key=repr))
        if known is not None and not Counter(offered) - Counter(known.offered):
            return  # no new publisher; one that left changes nothing
        type_name = known.type if known is not None else infos[0].topic_type
        if len(types) > 1 and known is None:
            self._warn(f'topic {name} has the types {", ".join(types)}: {type_name} is recorded')
        hashes = {str(info.topic_type_hash) for info in infos if info.topic_type == type_name}
        self._subscribe(known, name, type_name, offered, hashes)

    def _subscribe(
            self, known: RecordedTopic | None, name: str, type_name: str,
            offered: tuple[Qos, ...], hashes: Iterable[str]) -> None:
        try:
            message_type = ros_entities.interface_class(type_name)
        except BagError as error:
            self._warn(f'topic {name} is not recorded: {error}')
            return
        number = self._recording.add_topic(self._describe(name, type_name, offered, hashes))
        qos = subscription_profile(offered, self._depth if known is None else known.qos.depth)
        logger = self._node.get_logger()
        if known is None:
            recorded = RecordedTopic(name, type_name, number, qos, offered)
            self.topics[name] = recorded
            self._capture.add(recorded, RawSubscription(self._node, message_type, name, qos))
            logger.info(f'subscribed to {name} ({type_name})')
            return
        known.offered = offered
        if (qos.reliability, qos.durability) != (known.qos.reliability, known.qos.durability):
            self._replace(known, qos)
            logger.info(
                f'subscribed to {name} again, as its publishers offer another quality of service')

    def _shorten(self) -> None:
        """Shorten the queues that could take more than their share of the memory."""
        left, count = self._queue_size, len(self.topics)
        for topic in sorted(self.topics.values(), key=lambda x: x.largest):
            # What small messages leave is for the large ones.
            share = min(left / count, self._depth * topic.largest)
            left, count = left - share, count - 1
            depth = max(_MIN_DEPTH, int(share / max(topic.largest, 1)))
            # By half at least, since messages may grow little by little.
            if topic.largest and depth <= topic.qos.depth // 2:
                self._replace(topic, subscription_profile(topic.offered, depth))

    def _replace(self, topic: RecordedTopic, qos: QoSProfile) -> None:
        """Subscribe to a topic again."""
        topic.qos = qos
        self._capture.replace(topic, RawSubscription(
            self._node, ros_entities.interface_class(topic.type), topic.name, qos))

    def _describe(
            self, name: str, type_name: str, offered: tuple[Qos, ...],
            hashes: Iterable[str]) -> BagTopic:
        """Return the description of a topic for the bag."""
        try:
            encoding, definition = message_definition(type_name)
        except BagError as error:
            self._warn(f'topic {name} is recorded without definition: {error}')
            encoding, definition = '', ''
        known = {text for text in hashes if text.startswith('RIHS01_')}
        return BagTopic(
            name, type_name, definition, encoding, offered,
            known.pop() if len(known) == 1 else '' if known else type_hash(type_name))

    def _warn(self, sentence: str) -> None:
        if sentence not in self._refused:
            self._refused.add(sentence)
            self._node.get_logger().warning(sentence)


class Recorder(ManagedNode):
    """ROS 2 node that records to the bag in ``folder``; ``failure`` contains a fatal error."""

    def __init__(self) -> None:
        super().__init__(topics.RECORDER)
        self._parameters_in = declare(self, PARAMETERS)
        self.failure: BagError | None = None
        self._closed = True
        self.autostart()

    def configure(self) -> None:
        """Open the bag and start receiving."""
        values = self._parameters_in
        selection = Selection.of(values, self.resolve_topic_name)
        # While inactive, it is paused anyway.
        self._paused: bool = values['record.start_paused']
        self._sim_time = SimulatedTime() if self.simulated else None
        self._steps, self._set_back, self._ahead = StepWatch(), 0, 0
        self._experiment: dict[str, str] = {'hmsa_ros.version': __version__}
        # Number of topics with a publisher at the last look, and of nodes whose parameters are
        # stored.
        self._matched = self._known = 0
        limits = RecordingLimits(
            values['storage.flush_period'], values['storage.max_bagfile_size'],
            values['storage.max_bagfile_duration'] * 10**9, values['storage.max_cache_size'],
            round(values['record.snapshot_duration'] * 1e9)
            if values['record.snapshot_mode'] else 0)
        writer = BagWriter(
            values['storage.uri'] or datetime.datetime.now().strftime('hmsa_%Y_%m_%d-%H_%M_%S'),
            preset=values['storage.storage_preset_profile'],
            custom_data={**self._experiment, **parse_custom_data(values['storage.custom_data'])},
            ros_distro=ros_distro(), fsync=values['storage.fsync'])
        self.folder: Path = writer.folder
        self._recording = WriterThread(writer, limits, self.complain)
        self._capture = Capture(self._deliver)
        self._recorded = Subscriptions(
            self, selection, self._recording, self._capture, values['record.queue_depth'],
            limits.cache_size)
        self._closed = False
        if self._sim_time is not None:
            self._capture.add(self._sim_time, ros_entities.listen(self, replace(
                topics.CLOCK_TOPIC, qos=topics.Quality(1000, reliable=False))))
        self._capture.start()
        self.offer(topics.PAUSE, lambda: self._set_paused(True))
        self.offer(topics.RESUME, lambda: self._set_paused(False))
        self.offer(topics.IS_PAUSED, lambda: (
            self._pausing, 'paused' if self._pausing else 'recording'))
        self.offer(topics.SPLIT_BAGFILE, lambda: (True, self._recording.split()))
        self.offer(topics.SNAPSHOT, lambda: (True, self._recording.snapshot()))
        self._followed: dict[str, RemoteParameters] = {}
        self.create_subscription(
            ParameterEvent, '/parameter_events', self._on_parameter_event, 100)
        interval = duration_from(self._parameters_in, 'record.topic_polling_interval') * 1e-9
        self.every(max(interval, 1e-3), self._on_poll)
        self._diagnose = self.diagnose(self._status_of_bag)
        self.get_logger().info(f'recording to {self.folder}')

    @property
    def _pausing(self) -> bool:
        """Whether incoming messages are not recorded."""
        return self._paused or not self.active

    def _on_poll(self) -> None:
        """Look for new topics, new publishers, and parameters of the experiment's nodes."""
        if self._capture.error is not None:
            self.failure = BagError(f'receiving has ended: {self._capture.error!r}')
            self.finished = True
        if self._sim_time is not None and not self._sim_time.started:
            return
        self._find_nodes()
        self._recorded.look(self.get_topic_names_and_types())
        for followed in self._followed.values():
            followed.poll(self._note)
        before = self._matched, self._known
        self._matched = sum(isinstance(x, RecordedTopic) for x in self._capture.matched())
        self._known = sum(x.known for x in self._followed.values())
        if (self._matched, self._known) != before:
            # Immediately, since a process may be waiting for it.
            self._diagnose()

    def _find_nodes(self) -> None:
        """Find nodes whose parameters are to be stored."""
        wanted = self._parameters_in['experiment.nodes']
        bare = {name for name in wanted if '/' not in name}
        full = {self.resolve_topic_name(name) for name in wanted if '/' in name}
        # Identified by their services: node names are published on a separate topic, where
        # simultaneous messages may get lost (ros2/rmw_fastrtps#792).
        for service, _ in self.get_service_names_and_types():
            node, _, last = service.rpartition('/')
            if last == 'list_parameters' and (
                    node.rpartition('/')[2] in bare or node in full) \
                    and node not in self._followed and len(self._followed) < _MAX_NODES:
                self._followed[node] = RemoteParameters(self, node)

    def _deliver(self, taken: Sequence[tuple[Any, list[Taken]]]) -> None:
        """Add timestamps to received messages, count them and pass them on."""
        taken = self._follow_wall(taken) if self._sim_time is None else self._follow(
            self._sim_time, taken)
        self._take_in(taken)

    def _follow_wall(
            self, taken: Sequence[tuple[Any, list[Taken]]]) -> list[tuple[Any, list[Taken]]]:
        """Report a clock that is set, and record messages from before it was set back."""
        now, by = self._steps.read()
        if by > 0:
            self._ahead += by
            self.get_logger().warning(
                f'the clock of this host was set ahead by {by / NANOSECONDS:.3f} s: nothing was '
                'recorded in the time that the bag shows there')
            self._note({'time_set_ahead': f'{self._ahead / NANOSECONDS:.3f} s'})
        if by >= 0:
            return [*taken]
        earlier, rest = _parted(taken, partial(lt, now))
        self._take_in(earlier)
        for topic in list(self._recorded.topics.values()):
            topic.begin_anew()
        # Within a file, log times rise.
        self.get_logger().warning(
            f'the clock of this host was set back by {-by / NANOSECONDS:.3f} s: recording '
            'continues in a new file')
        self._recording.begin_anew()
        self._set_back += 1
        self._note({'time_jumps': str(self._set_back)})
        return rest

    def _follow(
            self, clock: SimulatedTime,
            taken: Sequence[tuple[Any, list[Taken]]]) -> list[tuple[Any, list[Taken]]]:
        """Separate and apply clock messages, and record messages from before a jump back."""
        ticks = [x for key, messages in taken if key is clock for x in messages]
        rest = [x for x in taken if x[0] is not clock]
        for message in ticks:
            try:
                now = from_time(decode(message.data, Clock).clock)
            except BadInputError:
                now = -1
            if now < 0:
                clock.ignored += 1
                continue
            before = clock.add(message.received_ns, now, message.publisher)
            if before is None:
                continue
            # Messages from before the jump belong to the present file, including those that
            # arrived during this round or exceeded its limit.
            for key, messages in self._capture.take_again():
                if key is clock:
                    ticks += messages
                else:
                    rest.append((key, messages))
            earlier, rest = _parted(rest, partial(gt, message.received_ns))
            self._take_in(earlier)
            # A simulation restarted, or a bag is played in a loop.
            self.get_logger().warning(
                f'simulated time jumped back from {before * 1e-9:.3f} s to {now * 1e-9:.3f} s: '
                'recording continues in a new file')
            self._recording.begin_anew()
            self._note({'time_jumps': str(clock.jumps)})
        return rest

    def _take_in(self, taken: Iterable[tuple[RecordedTopic, list[Taken]]]) -> None:
        """Count gaps, and pass the messages to the writer."""
        at = None if self._sim_time is None else self._sim_time.at
        for topic, messages in taken:
            batch, size = topic.take(messages, at, paused=self._pausing)
            if batch:
                self._recording.put(batch, size)

    def _note(self, values: Mapping[str, str]) -> None:
        """Store information about the experiment."""
        new = {key: value for key, value in values.items()
               if self._experiment.get(key) != value}
        if new:
            self._experiment.update(new)
            self._recording.note(new)

    def _on_parameter_event(self, event: ParameterEvent) -> None:
        """Store a change of a parameter of the experiment's nodes."""
        followed = self._followed.get(event.node)
        if followed is not None:
            self._note(followed.texts(
                (parameter.name, parameter.value)
                for parameter in [*event.new_parameters, *event.changed_parameters]))

    def _set_paused(self, paused: bool) -> tuple[bool, str]:
        if not self.active:
            return False, f'the recorder is {self.state}: expected an active one'
        state = 'paused' if paused else 'recording'
        same, self._paused = self._paused == paused, paused
        return True, f'already {state}' if same else state

    def _lost(self, status: Status) -> dict[str, int]:
        """Return the number of lost messages by topic."""
        missed = {topic.name: topic.missed for topic in list(self._recorded.topics.values())}
        return lost_by_topic(missed, status.overflowed, status.dropped)

    def _before(self) -> dict[str, int]:
        """Return by topic the number of messages sent before the recorder was matched."""
        return {topic.name: topic.before for topic in list(self._recorded.topics.values())}

    def _lost_note(self, lost: Mapping[str, int]) -> dict[str, str]:
        """Return the numbers of missing messages by topic in their stored form."""
        return {
            'lost': json.dumps({**dict.fromkeys(list(self._recorded.topics), 0), **lost}),
            'sent_before': json.dumps(self._before())}

    def _status_of_bag(self) -> Iterable[DiagnosticStatus]:
        status = self._recording.status()
        lost = self._lost(status)
        # Written immediately, so that it is known after a crash too.
        self._note(self._lost_note(lost))
        state = ('inactive' if not self.active else 'paused' if self._paused
                 else 'waiting for /clock'
                 if self._sim_time is not None and not self._sim_time.started else 'recording')
        clocks = 0 if self._sim_time is None else self.count_publishers(
            topics.CLOCK_TOPIC.name)
        level, text = judge(
            status, state, sum(lost.values()),
            flush_period=self._parameters_in['storage.flush_period'],
            clocks=clocks, clock_ignored=self._sim_time is not None and bool(
                self._sim_time.ignored))
        values = {
            'bag': self.folder,
            'state': state,
            'subscribed': f'{len(self._recorded.topics)}/{self._recorded.wanted_count}',
            'matched': self._matched,
            'parameters_of': self._known,
            'received': sum(topic.received for topic in self._recorded.topics.values()),
            **figures(status, lost, self._before()),
            **({} if self._sim_time is None else {
                'time_jumps': self._sim_time.jumps, 'clock_ignored': self._sim_time.ignored}),
        }
        yield to_status(
            f'{self.get_fully_qualified_name().lstrip("/")}: bag', '', level, text, values)

    def cleanup(self) -> None:
        """Close the bag."""
        self.close()

    def close(self) -> None:
        """Record the messages that have arrived, close the bag and print the counts."""
        if self._closed:
            return
        self._closed = True
        # Meanwhile, lost messages from before are sent again.
        time.sleep(_LINGER_SECONDS)
        self._capture.stop()
        status = self._recording.close(lambda last: self._lost_note(self._lost(last)))
        lost = self._lost(status)
        written = sum(status.written.values())
        before = self._before()
        print(f'hmsa recorder: {written} messages of {len(self._recorded.topics)} topics in '
              f'{self.folder}, {sum(lost.values())} lost'
              + f', {sum(before.values())} sent before the recorder was matched' * any(
                  before.values()), flush=True)
        for sentence, counts in (
                ('lost {} of {}', lost),
                ('{} of {} sent before the recorder was matched', before)):
            for name, count in sorted(counts.items()):
                if count:
                    print('hmsa recorder:', sentence.format(count, name), flush=True)
        if silent := self._recorded.silent():
            print(f'hmsa recorder: no message was received on {", ".join(silent)}', flush=True)
        # Gaps in what was received are counted; what was received must be in the bag.
        unwritten = sum(lost_by_topic(status.overflowed, status.dropped).values())
        if self.failure is None and (status.error or unwritten):
            self.failure = BagError(status.error or (
                f'{unwritten} messages that were received are missing from {self.folder}'))


def _parted(
        taken: Iterable[tuple[Any, list[Taken]]], before: Callable[[int], bool],
) -> tuple[list[tuple[Any, list[Taken]]], list[tuple[Any, list[Taken]]]]:
    """Split messages, in the order of reception, by whether their time in ns is before a jump."""
    earlier, rest = [], []
    for key, messages in taken:
        count = next(
            (i for i, x in enumerate(messages) if not before(x.received_ns)), len(messages))
        earlier.append((key, messages[:count]))
        rest.append((key, messages[count:]))
    return earlier, rest


#: Run by ``hmsa recorder`` with the command line's arguments; returns the exit status.
main = partial(run, Recorder)
