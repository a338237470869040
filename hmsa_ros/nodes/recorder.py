"""
Recorder: writes topics to a bag, counts what is lost, and says so.

The node's own executor serves discovery, services and diagnostics. Messages take another way:
`Capture` takes them off their subscriptions in a thread, `Recording` writes them in another.

As a managed node it opens the bag when it is configured, records while it is active, and closes
the bag when it is cleaned up.
"""

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
import datetime
import json
import os
from pathlib import Path
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterEvent
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Trigger

from hmsa_ros import __version__
from hmsa_ros.bag.definitions import message_definition, type_hash
from hmsa_ros.bag.experiment import SetpointLog
from hmsa_ros.bag.qos import Qos
from hmsa_ros.bag.reception import figures, judge, RecordedTopic
from hmsa_ros.bag.recording import Limits, lost_by_topic, Recording, Status
from hmsa_ros.bag.writer import BagWriter, parse_custom_data, Topic
from hmsa_ros.errors import BadInputError, BagError
from hmsa_ros.nodes import interface
from hmsa_ros.nodes.capture import Capture, decode, RawSubscription, SimulatedTime, Taken
from hmsa_ros.nodes.conversions import from_time
from hmsa_ros.nodes.managed import ManagedNode
from hmsa_ros.nodes.message_types import interface_class, type_name_of
from hmsa_ros.nodes.parameters import declare
from hmsa_ros.nodes.qos import stored, subscription
from hmsa_ros.nodes.recorder_parameters import PARAMETERS
from hmsa_ros.nodes.remote_parameters import RemoteParameters
from hmsa_ros.nodes.runner import run
from hmsa_ros.nodes.selection import Selection

DIAGNOSTICS_SECONDS = 1.0
# Between being told to end and the last look at what has come.
_LINGER_SECONDS = 0.1
# One look in so many asks for the publishers of every topic, changed in number or not.
_FULL_LOOK = 10
# Nodes whose parameters are requested.
_MAX_NODES = 256

# Topics with setpoints, by the last part of their names.
_SETPOINTS = {
    topic.name.rsplit('/', 1)[-1]: topic
    for topic in (interface.JOINT_TRAJECTORY, interface.SETPOINT)}


class Recorder(ManagedNode):
    """
    ROS 2 node that records.

    Attributes
    ----------
    folder : pathlib.Path
        The bag's folder.
    failure : BagError or None
        Why recording failed.
    finished : bool
        Whether it has, so that the process ends.

    Raises
    ------
    BadInputError
        If a parameter cannot be used or the bag cannot be made.

    """

    def __init__(self) -> None:
        super().__init__(interface.RECORDER)
        self._parameters_in = declare(self, PARAMETERS)
        self.failure: BagError | None = None
        self._closed = True
        self.autostart()

    def configure(self) -> None:
        """Open the bag and start receiving."""
        values = self._parameters_in
        self._selection = Selection(
            tuple(map(self._full_name, values['record.topics'])), values['record.all_topics'],
            values['record.regex'], tuple(map(self._full_name, values['record.exclude_topics'])),
            values['record.exclude_regex'])
        self._topics: dict[str, RecordedTopic] = {}
        self._refused: dict[str, str] = {}
        # While inactive it is paused.
        self._paused = True
        self._resumes = not values['record.start_paused']
        self._sim_time = SimulatedTime() if self.get_parameter('use_sim_time').value else None
        self._experiment: dict[str, str] = {'hmsa_ros.version': __version__}
        self._setpoints = SetpointLog()
        self._setpoint_topics: set[str] = set()
        self._said_ready = False
        self._polls = 0
        limits = Limits(
            values['storage.flush_period'], values['storage.max_bagfile_size'],
            values['storage.max_bagfile_duration'] * 10**9, values['storage.max_cache_size'],
            round(values['record.snapshot_duration'] * 1e9)
            if values['record.snapshot_mode'] else 0)
        writer = BagWriter(
            values['storage.uri'] or datetime.datetime.now().strftime(
                'hmsa_%Y_%m_%d-%H_%M_%S'),
            preset=values['storage.storage_preset_profile'],
            custom_data={**self._experiment, **parse_custom_data(
                values['storage.custom_data'])},
            ros_distro=os.environ.get('ROS_DISTRO', 'jazzy'), fsync=values['storage.fsync'])
        self.folder: Path = writer.folder
        self._recording = Recording(writer, limits, self._report)
        self._capture = Capture(self, self._deliver)
        self._closed = False
        self._start()

    def activate(self) -> None:
        """Record, unless it was paused before."""
        self._paused = not self._resumes

    def deactivate(self) -> None:
        """Pause."""
        self._resumes = not self._paused
        self._paused = True

    def cleanup(self) -> None:
        """Close the bag."""
        self.close()

    def _start(self) -> None:
        """Create what the node offers and start receiving."""
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        if self._sim_time is not None:
            self._clock_subscription = RawSubscription(
                self, ClockMessage, interface.CLOCK_TOPIC.name,
                QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1000,
                           reliability=ReliabilityPolicy.BEST_EFFORT))
            self._capture.add(self._sim_time, self._clock_subscription)
        self._capture.start()
        self._diagnostics = self.create_publisher(
            interface.DIAGNOSTICS.type, interface.DIAGNOSTICS.name, interface.DIAGNOSTICS.qos)
        for name, callback in (
                (interface.PAUSE.name, self._on_pause), (interface.RESUME.name, self._on_resume),
                (interface.IS_PAUSED.name, self._on_is_paused),
                (interface.SPLIT_BAGFILE.name, self._on_split),
                (interface.SNAPSHOT.name, self._on_snapshot)):
            self.create_service(Trigger, name, callback)
        for topic in _SETPOINTS.values():
            # From the start, so that the first one is not missed; others when they are found.
            self._follow_setpoints(topic, self._full_name(
                interface.from_outside(topic.name, interface.PLANNER)))
        self._followed: dict[str, RemoteParameters] = {}
        self.create_subscription(
            ParameterEvent, '/parameter_events', self._on_parameter_event, 100)
        interval = (self._parameters_in['record.topic_polling_interval.sec']
                    + self._parameters_in['record.topic_polling_interval.nsec'] * 1e-9)
        self.create_timer(max(interval, 1e-3), self._on_poll, clock=steady)
        self.create_timer(DIAGNOSTICS_SECONDS, self._on_diagnostics, clock=steady)
        self.get_logger().info(f'recording to {self.folder}')

    def _full_name(self, name: str) -> str:
        """Return the full, remapped name of a topic or node."""
        resolved: str = self.resolve_topic_name(name)
        return resolved

    def _on_poll(self) -> None:
        """Look for new topics, new publishers, and parameters of the experiment's nodes."""
        if self._capture.error is not None:
            self.failure = BagError(f'receiving has ended: {self._capture.error!r}')
            self.finished = True
        if self._sim_time is not None and not self._sim_time.started:
            return
        self._polls += 1
        self._find_nodes()
        for name, types in self.get_topic_names_and_types():
            if self._selection.wants(name):
                self._look_at(name, types)
            topic = _SETPOINTS.get(name.rsplit('/', 1)[-1])
            if topic is not None and type_name_of(topic.type) in types and any(
                    name.startswith(f'{node}/') for node in self._followed):
                self._follow_setpoints(topic, name)
        self._say_ready()
        for followed in self._followed.values():
            followed.poll(self._note)

    def _find_nodes(self) -> None:
        """Look for nodes whose parameters are to be stored."""
        wanted = self._parameters_in['experiment.nodes']
        bare = {name for name in wanted if '/' not in name}
        full = {self._full_name(name) for name in wanted if '/' in name}
        # By their services. The names of nodes come on a topic of their own, and what is published
        # on it by several at the same time may get lost (ros2/rmw_fastrtps#792).
        for service, _ in self.get_service_names_and_types():
            node, _, last = service.rpartition('/')
            if last == 'list_parameters' and (
                    node.rpartition('/')[2] in bare or node in full) \
                    and node not in self._followed and len(self._followed) < _MAX_NODES:
                self._followed[node] = RemoteParameters(self, node)

    def _follow_setpoints(self, topic: interface.Topic, name: str) -> None:
        """Store the setpoints that are sent on a topic."""
        if name not in self._setpoint_topics:
            self._setpoint_topics.add(name)
            self.create_subscription(
                topic.type, name, lambda message: self._on_setpoint(name, message), topic.qos)

    def _look_at(self, name: str, types: Sequence[str]) -> None:
        """Subscribe to a topic, or again if its publishers ask for it."""
        known = self._topics.get(name)
        # Asking who they are takes five times as long as how many.
        count = self.count_publishers(name)
        if known is not None and count == known.publishers and self._polls % _FULL_LOOK:
            return
        infos = [info for info in self.get_publishers_info_by_topic(name)
                 if known is None or info.topic_type == known.type]
        if known is not None:
            known.publishers = count
        if not infos:
            return
        offered = tuple(sorted((stored(info.qos_profile) for info in infos), key=repr))
        if known is not None and not Counter(offered) - Counter(known.offered):
            return  # nobody is new; who has left does not change what was recorded
        type_name = known.type if known is not None else infos[0].topic_type
        if len(types) > 1 and known is None:
            self._refuse(f'{name}#', f'topic {name} has the types {", ".join(types)}: '
                                     f'{type_name} is recorded')
        try:
            message_type = interface_class(type_name)
        except BagError as error:
            self._refuse(name, f'topic {name} is not recorded: {error}')
            return
        hashes = {str(info.topic_type_hash) for info in infos
                  if info.topic_type == type_name}
        number = self._recording.add_topic(self._describe(name, type_name, offered, hashes))
        qos = subscription(offered, self._parameters_in['record.queue_depth'])
        if known is None:
            recorded = RecordedTopic(name, type_name, number, qos, offered)
            self._topics[name] = recorded
            self._capture.add(recorded, RawSubscription(self, message_type, name, qos))
            self.get_logger().info(f'subscribed to {name} ({type_name})')
            return
        known.offered = offered
        if (qos.reliability, qos.durability) != (known.qos.reliability, known.qos.durability):
            known.qos = qos
            self._capture.replace(known, RawSubscription(self, message_type, name, qos))
            self.get_logger().info(
                f'subscribed to {name} again, as its publishers offer another quality of service')

    def _describe(
            self, name: str, type_name: str, offered: tuple[Qos, ...],
            hashes: Iterable[str]) -> Topic:
        """Return what the bag stores of a topic."""
        try:
            encoding, definition = message_definition(type_name)
        except BagError as error:
            self._refuse(f'{name}!', f'topic {name} is recorded without definition: {error}')
            encoding, definition = '', ''
        known = {text for text in hashes if text.startswith('RIHS01_')}
        return Topic(
            name, type_name, definition, encoding, offered,
            known.pop() if len(known) == 1 else '' if known else type_hash(type_name))

    def _refuse(self, key: str, sentence: str) -> None:
        """Warn once."""
        if key not in self._refused:
            self._refused[key] = sentence
            self.get_logger().warning(sentence)

    def _wanted_count(self) -> int:
        """Return how many topics are waited for, as far as it is known."""
        missing = [name for name in self._selection.topics if name not in self._topics]
        return len(self._topics) + len(missing)

    def _say_ready(self) -> None:
        """Log, once, that every topic requested by name is subscribed to."""
        if not self._said_ready and self._selection.topics \
                and self._wanted_count() == len(self._topics):
            self._said_ready = True
            self.get_logger().info(
                f'ready: subscribed to all {len(self._selection.topics)} topics')

    def _deliver(self, taken: Sequence[tuple[Any, list[Taken]]]) -> None:
        """Stamp, count and pass on what has been received."""
        clock = self._sim_time
        if clock is not None and taken[0][0] is clock:
            for message in taken[0][1]:
                try:
                    now = from_time(decode(message.data, ClockMessage).clock)
                except BadInputError:
                    now = -1
                if now < 0:
                    clock.ignored += 1
                    continue
                before = clock.add(message.received_ns, now, message.publisher)
                if before is not None:
                    # What came before the jump belongs to the file so far.
                    taken = self._take_in_until(message.received_ns, taken)
                    self._begin_anew(before, now)
            taken = taken[1:]
        for key, messages in taken:
            self._take_in(key, messages)

    def _take_in_until(
            self, moment: int,
            taken: Sequence[tuple[Any, list[Taken]]]) -> list[tuple[Any, list[Taken]]]:
        """Take in what was received before a moment; return the rest, the clock as it was."""
        rest = [taken[0]]
        for key, messages in taken[1:]:
            count = bisect_left(messages, moment, key=lambda message: message.received_ns)
            self._take_in(key, messages[:count])
            rest.append((key, messages[count:]))
        return rest

    def _begin_anew(self, before: int, now: int) -> None:
        """Go on in a new file: a simulation began anew, or a bag is played in a loop."""
        self.get_logger().warning(
            f'simulated time jumped back from {before * 1e-9:.3f} s to {now * 1e-9:.3f} s: '
            'recording continues in a new file')
        self._recording.begin_anew()
        if self._sim_time is not None:
            self._note({'time_jumps': str(self._sim_time.jumps)})

    def _take_in(self, topic: RecordedTopic, messages: list[Taken]) -> None:
        """Count gaps and hand the messages to the writer."""
        batch, size = topic.take(
            messages, None if self._sim_time is None else self._sim_time.at, paused=self._paused)
        if batch:
            self._recording.put(batch, size)

    def _note(self, values: Mapping[str, str]) -> None:
        """Store something about the experiment."""
        new = {key: value for key, value in values.items()
               if self._experiment.get(key) != value}
        if new:
            self._experiment.update(new)
            self._recording.note(new)

    def _on_setpoint(self, name: str, message: Any) -> None:
        """Store a setpoint or a sequence of them."""
        self._setpoints.add(name, self.get_clock().now().nanoseconds, message)

    def _on_parameter_event(self, event: ParameterEvent) -> None:
        """Store a change of a parameter of the experiment's nodes."""
        followed = self._followed.get(event.node)
        if followed is not None:
            self._note(followed.texts(
                (parameter.name, parameter.value)
                for parameter in [*event.new_parameters, *event.changed_parameters]))

    def _on_pause(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Stop recording for a while."""
        return self._set_paused(True, response)

    def _on_resume(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Go on recording."""
        return self._set_paused(False, response)

    def _set_paused(self, paused: bool, response: Trigger.Response) -> Trigger.Response:
        """Pause or go on."""
        if not self.active:
            response.message = f'the recorder is {self.state}: expected an active one'
            return response
        response.success = True
        state = 'paused' if paused else 'recording'
        response.message = state if self._paused != paused else f'already {state}'
        self._paused = paused
        return response

    def _on_is_paused(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Say by ``success`` whether recording is paused."""
        response.success = self._paused
        response.message = 'paused' if self._paused else 'recording'
        return response

    def _on_split(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Go on in a new file."""
        return self._answer(response, self._recording.split)

    def _on_snapshot(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Write what is kept in memory."""
        return self._answer(response, self._recording.snapshot)

    @staticmethod
    def _answer(response: Trigger.Response, action: Callable[[], str]) -> Trigger.Response:
        """Do what was asked for and say how it went."""
        try:
            response.message, response.success = action(), True
        except BagError as error:
            response.message = str(error)
        return response

    def _lost(self, status: Status) -> dict[str, int]:
        """Return the number of lost messages by topic."""
        missed = {topic.name: topic.missed for topic in list(self._topics.values())}
        return lost_by_topic(missed, status.overflowed, status.dropped)

    def _lost_text(self, lost: Mapping[str, int]) -> str:
        """Return the number of lost messages of every topic as it is stored."""
        return json.dumps({**dict.fromkeys(list(self._topics), 0), **lost})

    def _on_diagnostics(self) -> None:
        """Publish the state."""
        status = self._recording.status()
        lost = self._lost(status)
        total = sum(lost.values())
        self._note(self._setpoints.news())
        # In the bag at once, so that it is known after a crash too.
        self._note({'lost': self._lost_text(lost)})
        state = ('inactive' if not self.active else 'paused' if self._paused
                 else 'waiting for /clock'
                 if self._sim_time is not None and not self._sim_time.started else 'recording')
        clocks = 0 if self._sim_time is None else self.count_publishers(
            interface.CLOCK_TOPIC.name)
        level, text = judge(
            status, state, total, flush_period=self._parameters_in['storage.flush_period'],
            clocks=clocks, clock_ignored=self._sim_time is not None and bool(
                self._sim_time.ignored))
        values = {
            'bag': str(self.folder),
            'state': state,
            'subscribed': f'{len(self._topics)}/{self._wanted_count()}',
            'received': str(sum(topic.received for topic in self._topics.values())),
            **figures(status, lost),
            **({} if self._sim_time is None else {
                'time_jumps': str(self._sim_time.jumps),
                'clock_ignored': str(self._sim_time.ignored)}),
        }
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [DiagnosticStatus(
            level=bytes((level,)), name=f'{self.get_fully_qualified_name().lstrip("/")}: bag',
            message=text, hardware_id='',
            values=[KeyValue(key=key, value=value) for key, value in values.items()])]
        self._diagnostics.publish(message)

    def _report(self, sentence: str, failure: bool) -> None:
        """Log what happened to the writer."""
        if failure:
            self.get_logger().error(sentence)
        else:
            self.get_logger().warning(sentence)

    def close(self) -> None:
        """Record what has arrived, close the bag and print the counts."""
        if self._closed:
            return
        self._closed = True
        # What was sent before and got lost on the way comes again meanwhile.
        time.sleep(_LINGER_SECONDS)
        self._capture.stop()
        self._note(self._setpoints.news())
        status = self._recording.close(
            lambda last: {'lost': self._lost_text(self._lost(last))})
        lost = self._lost(status)
        written = sum(status.written.values())
        print(f'hmsa recorder: {written} messages of {len(self._topics)} topics in '
              f'{self.folder}, {sum(lost.values())} lost', flush=True)
        for name, count in sorted(lost.items()):
            if count:
                print(f'hmsa recorder: lost {count} of {name}', flush=True)
        if status.error and self.failure is None:
            self.failure = BagError(status.error)


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the recorder.

    Parameters
    ----------
    args : sequence of str, optional
        Command-line arguments; default ``sys.argv[1:]``.

    Returns
    -------
    int
        Exit status.

    """
    return run(Recorder, args)
