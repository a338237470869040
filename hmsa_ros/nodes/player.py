"""
Player: sends the messages of a bag again, at the spacing they were recorded with.

The node's executor serves services and parameters. A thread sends: each message at its own
place on an absolute schedule, so that no delay adds up. A second thread reads ahead.

Commands move things. Topics that carry them (see `hmsa_ros.nodes.selection`) are left out unless
they are asked for by name, in ``play.topics_to_filter`` or ``play.allow_commands``.

As a managed node it opens the bag and offers its topics when it is configured, plays while it is
active, and gives both up when it is cleaned up.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
import contextlib
from functools import partial
import os
import sys
import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.expand_topic_name import expand_topic_name
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Trigger

from hmsa_ros.bag.limits import CHUNK_SIZE
from hmsa_ros.bag.read_ahead import READ_AHEAD_BYTES, ReadAhead
from hmsa_ros.bag.reader import BagReader, Message, TopicInfo
from hmsa_ros.errors import BadInputError, BagError, HmsaError, printable
from hmsa_ros.nodes import interface
from hmsa_ros.nodes.managed import ManagedNode
from hmsa_ros.nodes.message_types import interface_class
from hmsa_ros.nodes.parameters import declare, ParameterSpec
from hmsa_ros.nodes.qos import publisher
from hmsa_ros.nodes.runner import run
from hmsa_ros.nodes.selection import Filter

DIAGNOSTICS_SECONDS = 1.0
# A wait that can be woken ends this much early; the rest is slept, which is more exact.
_FINE_SECONDS = 0.01
_POLL_SECONDS = 0.02
_CLOCK_WHILE_WAITING_SECONDS = 0.1
# Reliable messages that found the receiver's queue full are sent again when a heartbeat of
# Fast DDS asks for them, with other profiles than ours every 3 s: the wait at the end has to
# last for several, in slices.
_ACKNOWLEDGED_SECONDS = 0.5
# A loop over a bag of a single moment would send without pause.
_SHORTEST_ROUND_SECONDS = 0.1
# What a builtin_interfaces/Time can hold.
_LATEST_CLOCK = 2**31 * 10**9

PARAMETERS = (
    ParameterSpec('storage.uri', '', 'Folder of the bag, or an .mcap file.'),
    ParameterSpec(
        'storage.max_chunk_size', CHUNK_SIZE,
        'Largest chunk or message that is read; larger ones are passed over.', 'B', 1),
    ParameterSpec('play.rate', 1.0, 'Speed as a multiple of the recorded one.', '', 1e-3, 1e3,
                  read_only=False),
    ParameterSpec('play.loop', False, 'Whether to begin again at the end.'),
    ParameterSpec('play.start_paused', False, 'Whether to begin paused.'),
    ParameterSpec('play.start_offset.sec', 0, 'Whole seconds to pass over at the start.', 's', 0),
    ParameterSpec(
        'play.start_offset.nsec', 0, 'Nanoseconds on top of them.', 'ns', 0, 999_999_999),
    ParameterSpec(
        'play.playback_duration.sec', -1,
        'Whole seconds to play from the start, negative for all.', 's', -1),
    ParameterSpec(
        'play.playback_duration.nsec', 0, 'Nanoseconds on top of them.', 'ns', 0, 999_999_999),
    ParameterSpec(
        'play.seek', -1.0,
        'Set while playing: go on from this time after the first message of the bag.', 's',
        -1.0, 1e9, read_only=False),
    ParameterSpec(
        'play.topics_to_filter', [],
        'Topics to send, all others are left out; empty for all but commands.'),
    ParameterSpec(
        'play.regex_to_filter', '',
        'Topics in which this regular expression is found are sent, all others are left out.'),
    ParameterSpec('play.exclude_topics_to_filter', [], 'Topics not to send.'),
    ParameterSpec(
        'play.exclude_regex_to_filter', '',
        'Topics in which this regular expression is found are not sent.'),
    ParameterSpec(
        'play.allow_commands', [],
        'Topics with commands that may be sent, besides those in play.topics_to_filter.'),
    ParameterSpec(
        'play.clock_publish_frequency', 0.0,
        'Rate at which /clock is published in the time of the bag, 0 for not.', 'Hz', 0.0, 1e5),
    ParameterSpec(
        'play.clock_publish_on_topic_publish', False,
        'Whether /clock is published before each message.'),
    ParameterSpec(
        'play.wait_for_subscribers', [],
        'Topics that must have a subscriber before anything is sent.'),
    ParameterSpec(
        'play.wait_for_subscribers_timeout', 60.0, 'How long to wait for them.', 's', 0.0, 1e6),
    ParameterSpec(
        'play.discovery_time', 3.5,
        'How long to look for subscribers that are there already; not waited for in full when '
        'every topic has one, or those in play.wait_for_subscribers do.', 's', 0.0, 3600.0),
    ParameterSpec('play.delay.sec', 0, 'Whole seconds to wait before playing.', 's', 0),
    ParameterSpec('play.delay.nsec', 0, 'Nanoseconds on top of them.', 'ns', 0, 999_999_999),
    ParameterSpec(
        'play.read_ahead_queue_size', 1000, 'Messages read ahead.', '', 1, 10_000_000),
    ParameterSpec(
        'play.realtime_priority', 1,
        'Real-time priority of the thread that sends, where the system grants it; 0 for an '
        'ordinary thread.', '', 0, 99),
    ParameterSpec(
        'play.wait_acked_timeout.sec', 20,
        'Whole seconds to wait at the end for reliable subscribers, negative for not at all.',
        's', -1),
    ParameterSpec(
        'play.wait_acked_timeout.nsec', 0, 'Nanoseconds on top of them.', 'ns', 0, 999_999_999),
)


class Player(ManagedNode):
    """
    ROS 2 node that plays a bag.

    Attributes
    ----------
    failure : HmsaError or None
        Why playing ended early.
    finished : bool
        Whether there is nothing left to do.

    Raises
    ------
    BadInputError
        If a parameter or the bag cannot be used.

    """

    def __init__(self) -> None:
        super().__init__(interface.PLAYER)
        self._values = declare(self, PARAMETERS)
        self.failure: HmsaError | None = None
        self._change = threading.Condition()
        self._stopped = True
        self._thread: threading.Thread | None = None
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.autostart()

    # States ----------------------------------------------------------------------------------

    def configure(self) -> None:
        """
        Open the bag, offer its topics, and wait.

        Raises
        ------
        BadInputError
            If a parameter or the bag cannot be used.

        """
        values = self._values
        if not values['storage.uri']:
            raise BadInputError(
                'parameter storage.uri is empty: expected the folder of a bag or an .mcap file, '
                'for example -p storage.uri:=run1')
        self._reader = BagReader(
            values['storage.uri'], max_chunk_size=values['storage.max_chunk_size'])
        self._problems_told = 0
        self._tell_problems()
        self._filter = Filter(
            self._names('play.topics_to_filter'), values['play.regex_to_filter'],
            self._names('play.exclude_topics_to_filter'),
            values['play.exclude_regex_to_filter'], self._names('play.allow_commands'))
        first, last = self._reader.start_time, self._reader.end_time
        self._first = 0 if first is None else first
        self._start = self._first + self._span('play.start_offset')
        length = self._span('play.playback_duration')
        self._end = (self._first if last is None else last) if length < 0 \
            else self._start + length
        self._rate = self.get_parameter('play.rate').value
        # While inactive it is paused.
        self._paused = True
        self._resumes = not values['play.start_paused']
        self._stopped = False
        self._seek: int | None = None
        self._next_wanted = 0
        self._next_answers: deque[threading.Event] = deque()
        self._anchor = (self._start, time.monotonic())
        self._position = self._start
        self._sent = 0
        self._late = 0.0
        self._clock_out: Any = None
        if values['play.clock_publish_frequency'] > 0.0 \
                or values['play.clock_publish_on_topic_publish']:
            if max(self._start, self._end) >= _LATEST_CLOCK:
                raise BadInputError(
                    f'{self._reader.path} reaches to {self._end * 1e-9:.0f} s: expected less '
                    f'than {_LATEST_CLOCK // 10**9} s for /clock')
            # First of all, so that nodes that wait for it can get ready.
            self._clock_out = self.create_publisher(
                ClockMessage, interface.CLOCK_TOPIC.name, interface.CLOCK_TOPIC.qos)
            self._send_clock(self._start)
        self._out = self._create_publishers()
        self._offer()
        self._thread = threading.Thread(target=self._run, name='player', daemon=True)
        self._thread.start()

    def activate(self) -> None:
        """Play, unless it was paused before."""
        self._set_paused(not self._resumes)

    def deactivate(self) -> None:
        """Pause."""
        self._resumes = not self._paused
        self._set_paused(True)

    def cleanup(self) -> None:
        """End playing."""
        self.close()
        self.finished = False

    def _names(self, parameter: str) -> tuple[str, ...]:
        """Return the full names of topics in a parameter, as they are in the bag."""
        return tuple(expand_topic_name(name, self.get_name(), self.get_namespace())
                     for name in self._values[parameter])

    def _span(self, parameter: str) -> int:
        """Return a time span given as seconds and nanoseconds, in nanoseconds."""
        seconds: int = self._values[f'{parameter}.sec']
        nanoseconds: int = self._values[f'{parameter}.nsec']
        return -1 if seconds < 0 else seconds * 10**9 + nanoseconds

    def _create_publishers(self) -> dict[str, Any]:
        """Return a publisher for each topic that is sent."""
        result: dict[str, Any] = {}
        for name, info in self._reader.topics.items():
            if not self._filter.passes(name):
                continue
            reason = self._left_out(name, info)
            if reason:
                self.get_logger().warning(printable(f'topic {name} is left out: {reason}'))
                continue
            try:
                result[name] = self.create_publisher(
                    interface_class(info.type), name, publisher(info.profiles))
            except Exception as error:
                # A name or a quality of service that no publisher can have.
                self.get_logger().warning(printable(
                    f'topic {name} is left out: it cannot be published '
                    f'({" ".join(str(error).split())})'))
        missing = [name for name in (*self._filter.topics, *self._filter.allow_commands)
                   if name not in self._reader.topics]
        if missing:
            self.get_logger().warning(printable(
                f'the bag has no topic {", ".join(missing)}; it has '
                + (', '.join(self._reader.topics) or 'none')))
        waited = [name for name in self._names('play.wait_for_subscribers')
                  if name not in result]
        if waited:
            raise BadInputError(
                f'parameter play.wait_for_subscribers names {", ".join(waited)}: expected topics '
                'that are sent, ' + (', '.join(result) or 'of which there is none'))
        return result

    def _left_out(self, name: str, info: TopicInfo) -> str:
        """Return why a topic that passes the filter is not sent, empty if it is."""
        if self._filter.withholds(name):
            return ('it carries commands; name it in play.topics_to_filter or '
                    'play.allow_commands to send it')
        if name == interface.CLOCK_TOPIC.name and self._clock_out is not None:
            return 'the player publishes the clock itself'
        if info.encoding != 'cdr':
            return f'its messages are encoded as {info.encoding!r}, expected cdr'
        try:
            interface_class(info.type)
        except BagError as error:
            return str(error)
        return ''

    def _offer(self) -> None:
        """Create services, diagnostics and the parameter callback."""
        for name, callback in (
                (interface.PAUSE.name, self._on_pause), (interface.RESUME.name, self._on_resume),
                (interface.TOGGLE_PAUSED.name, self._on_toggle),
                (interface.IS_PAUSED.name, self._on_is_paused),
                (interface.PLAY_NEXT.name, self._on_play_next),
                (interface.STOP.name, self._on_stop)):
            self.create_service(Trigger, name, callback)
        self._diagnostics = self.create_publisher(
            interface.DIAGNOSTICS.type, interface.DIAGNOSTICS.name, interface.DIAGNOSTICS.qos)
        self.create_timer(
            DIAGNOSTICS_SECONDS, self._on_diagnostics,
            clock=Clock(clock_type=ClockType.STEADY_TIME))

    # Sending, in the player's thread ---------------------------------------------------------

    def _run(self) -> None:
        """Play, then have the process end."""
        # Before all ordinary processes, where the system grants that; exact timing on a busy
        # machine is not to be had otherwise.
        priority = self._values['play.realtime_priority']
        if priority:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
        try:
            self._wait_for_subscribers()
            self._get_going()
            while self._round() and self._values['play.loop']:
                pass
            self._finish()
        except HmsaError as error:
            self.failure = error
        except Exception as error:
            if self.context.ok():
                self.failure = HmsaError(f'playing {self._reader.path} failed: {error!r}')
        finally:
            with self._change:
                self._stopped = True
                for answer in self._next_answers:
                    answer.set()
            self.finished = True

    def _tell_problems(self) -> None:
        """Log what could not be read of the bag, each once."""
        for problem in self._reader.problems[self._problems_told:]:
            self.get_logger().warning(problem)
        self._problems_told = len(self._reader.problems)

    def _round(self) -> bool:
        """Play from the start to the end; return whether it makes sense to do so again."""
        begin, sent = time.monotonic(), self._sent
        if not self._play(self._start) or self._sent == sent:
            return False
        with self._change:
            return not (self._values['play.loop'] and self._change.wait_for(
                lambda: self._stopped, begin + _SHORTEST_ROUND_SECONDS - time.monotonic()))

    def _wait_for_subscribers(self) -> None:
        """Wait until who is to receive the messages is there."""
        names = self._names('play.wait_for_subscribers')
        begin = time.monotonic()
        limit = begin + self._values['play.wait_for_subscribers_timeout']
        # Discovery may take three seconds, the period at which participants announce
        # themselves; who has not been found by then is not there.
        settled = begin + self._values['play.discovery_time']
        next_clock = begin
        while self.context.ok() and not self._stopped:
            now = time.monotonic()
            if self._clock_out is not None and now >= next_clock:
                self._send_clock(self._start)
                next_clock = now + _CLOCK_WHILE_WAITING_SECONDS
            counts = {name: sender.get_subscription_count()
                      for name, sender in self._out.items()}
            missing = [name for name in names if not counts[name]]
            half_way = any(
                sender.get_subscription_count() < self.count_subscribers(sender.topic)
                for sender in (*self._out.values(), self._clock_out) if sender is not None)
            found = not half_way and (bool(names) or all(counts.values()))
            if not missing and (found or now >= settled):
                return
            if missing and now >= limit:
                raise HmsaError(
                    f'no subscriber of {", ".join(missing)} within '
                    f'{self._values["play.wait_for_subscribers_timeout"]:g} s: expected one; '
                    'start it or take the topic out of play.wait_for_subscribers')
            time.sleep(_POLL_SECONDS)

    def _get_going(self) -> None:
        """Say what is played, and wait as long as was asked for."""
        delay = self._span('play.delay') * 1e-9
        if delay > 0.0:
            with self._change:
                self._change.wait_for(lambda: self._stopped, delay)
        self.get_logger().info(
            f'playing {len(self._out)} topics of {self._reader.path}, '
            f'{max(0, self._end - self._start) * 1e-9:.3f} s at rate {self._rate:g}')

    def _play(self, start: int) -> bool:
        """Play from a time on; return whether the end was reached."""
        while True:
            source = ReadAhead(
                partial(self._read, start), self._values['play.read_ahead_queue_size'])
            try:
                self._send_latched(start)
                # Time runs from when there is something to send.
                source.wait(self._interrupted)
                with self._change:
                    self._position = start
                    self._anchor = (start, time.monotonic())
                outcome = self._send_all(source, start)
            finally:
                source.stop()
            if outcome != 'seek':
                return outcome == 'end'
            with self._change:
                start, self._seek = self._seek or self._first, None

    def _read(self, start: int, cancelled: Callable[[], bool]) -> Iterator[Message]:
        """Return the messages to send from a time on."""
        return self._reader.messages(
            self._out.keys(), start=start, end=self._end + 1, cancelled=cancelled)

    def _interrupted(self) -> bool:
        """Return whether what is going on has been given up."""
        return self._stopped or self._seek is not None

    def _send_all(self, messages: Iterable[Message], start: int) -> str:
        """Send messages, each at its time; return 'end', 'seek' or 'stop'."""
        tick = start
        if self._values['play.clock_publish_frequency'] > 0.0:
            # Before the first message: in a loop, time jumps back with this.
            self._send_clock(start)
        on_publish = self._values['play.clock_publish_on_topic_publish']
        for message in messages:
            outcome, tick = self._tick_until(message.log_time, tick, last=False)
            if outcome:
                return outcome
            if on_publish:
                self._send_clock(message.log_time)
            self._out[message.topic].publish(message.data)
            self._sent += 1
            self._position = message.log_time
            if self._next_answers:
                self._answer_next()
        outcome, _ = self._tick_until(self._end, tick, last=True)
        if not outcome and self._values['play.clock_publish_frequency'] > 0.0:
            self._send_clock(self._end)
        return outcome or 'end'

    def _tick_until(self, when: int, tick: int, *, last: bool) -> tuple[str, int]:
        """Wait until a time of the bag, with the clock's ticks before it."""
        frequency = self._values['play.clock_publish_frequency']
        if frequency > 0.0:
            while tick <= when:
                outcome = self._wait(tick, message=False)
                if outcome:
                    return outcome, tick
                if self._next_wanted and not last:
                    break
                self._send_clock(tick)
                tick += max(1, round(1e9 * self._rate / frequency))
        return self._wait(when, message=not last), tick

    def _wait(self, when: int, *, message: bool) -> str:
        """Wait until a time of the bag; return why it did not come, or an empty string."""
        while True:
            with self._change:
                if self._stopped or not self.context.ok():
                    return 'stop'
                if self._seek is not None:
                    return 'seek'
                if self._paused:
                    if self._next_wanted:
                        if message:
                            self._next_wanted -= 1
                            self._anchor = (when, time.monotonic())
                        return ''
                    # The clock stands still, but who comes now is to know it.
                    if not self._change.wait(_CLOCK_WHILE_WAITING_SECONDS) \
                            and self._clock_out is not None:
                        self._send_clock(self._anchor[0])
                    continue
                since, began = self._anchor
                delay = began + (when - since) * 1e-9 / self._rate - time.monotonic()
                if delay > 2 * _FINE_SECONDS:
                    self._change.wait(delay - _FINE_SECONDS)
                    continue
            if delay > 0.0:
                time.sleep(delay)
            else:
                self._late = max(self._late, -delay)
            return ''

    def _send_clock(self, when: int) -> None:
        """Publish a time of the bag."""
        message = ClockMessage()
        message.clock.sec, message.clock.nanosec = divmod(when, 10**9)
        self._clock_out.publish(message)

    def _send_latched(self, start: int) -> None:
        """Send what a subscriber of the latched topics would have got at a time."""
        depths = {
            name: publisher(self._reader.topics[name].profiles).depth for name in self._out
            if any(profile.durability == 'transient_local'
                   for profile in self._reader.topics[name].profiles)}
        if not depths or start <= self._first:
            return
        kept = {name: deque[Message]() for name in depths}
        size = 0
        for message in self._reader.messages(
                depths.keys(), end=start, cancelled=self._interrupted):
            latest = kept[message.topic]
            latest.append(message)
            size += len(message.data)
            while len(latest) > depths[message.topic] or (
                    size > READ_AHEAD_BYTES and len(latest) > 1):
                size -= len(latest.popleft().data)
        for message in sorted((message for messages in kept.values() for message in messages),
                              key=lambda message: message.log_time):
            self._out[message.topic].publish(message.data)
            self._sent += 1

    def _answer_next(self) -> None:
        """Tell who asked for the next message that it is on its way."""
        with self._change:
            self._next_answers.popleft().set()

    def _finish(self) -> None:
        """Wait for reliable subscribers and say what was sent."""
        self._tell_problems()
        limit = self._span('play.wait_acked_timeout')
        waiting = list(self._out.values()) if limit >= 0 else []
        end = time.monotonic() + limit * 1e-9
        while waiting and self.context.ok() and not self._stopped:
            left = max(0.0, min(end - time.monotonic(), _ACKNOWLEDGED_SECONDS))
            if waiting[0].wait_for_all_acked(Duration(nanoseconds=round(left * 1e9))):
                del waiting[0]
            elif time.monotonic() >= end:
                self.get_logger().warning(
                    'not every subscriber of ' + ', '.join(sender.topic for sender in waiting)
                    + f' acknowledged every message within {limit * 1e-9:g} s; with a larger '
                    'play.wait_acked_timeout.sec they get more time')
                break
        print(f'hmsa player: {self._sent} messages sent', flush=True)

    # Services and parameters, in the executor's thread ---------------------------------------

    def _set_paused(self, paused: bool) -> None:
        """Pause or go on, without a jump in the schedule."""
        with self._change:
            if paused == self._paused:
                return
            since, began = self._anchor
            now = time.monotonic()
            if paused:
                self._anchor = (since + round((now - began) * 1e9 * self._rate), now)
            else:
                self._anchor = (since, now)
            self._paused = paused
            self._change.notify_all()

    def _change_pause(self, paused: bool, response: Trigger.Response) -> Trigger.Response:
        """Pause or go on, if the node is active."""
        if not self.active:
            response.message = f'the player is {self.state}: expected an active one'
            return response
        self._set_paused(paused)
        return self._answer(response)

    def _answer(self, response: Trigger.Response) -> Trigger.Response:
        """Answer with the state."""
        response.success = True
        response.message = 'paused' if self._paused else 'playing'
        return response

    def _on_pause(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Pause."""
        return self._change_pause(True, response)

    def _on_resume(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Go on."""
        return self._change_pause(False, response)

    def _on_toggle(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Pause or go on."""
        return self._change_pause(not self._paused, response)

    def _on_is_paused(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Tell by ``success`` whether playing is paused."""
        self._answer(response)
        response.success = self._paused
        return response

    def _on_play_next(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Send one message while paused."""
        answer = threading.Event()
        with self._change:
            if not self.active or not self._paused or self._stopped:
                response.message = 'not paused: expected a paused player; call pause first'
                return response
            self._next_wanted += 1
            self._next_answers.append(answer)
            self._change.notify_all()
        answer.wait(1.0)
        response.success = answer.is_set() and not self._stopped
        response.message = 'sent' if response.success else 'there is no next message'
        return response

    def _on_stop(
            self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """End playing, and with it the process."""
        response.success = True
        response.message = 'stopped'
        # After this answer has left: the end of the process would overtake it.
        self.create_timer(
            0.1, self._stop, clock=Clock(clock_type=ClockType.STEADY_TIME))
        return response

    def _stop(self) -> None:
        """End the player's thread."""
        with self._change:
            self._stopped = True
            self._change.notify_all()

    def _on_set_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Take a new rate, or a time to go on from."""
        specs = {spec.name: spec for spec in PARAMETERS}
        for parameter in parameters:
            if parameter.name in specs:
                try:
                    specs[parameter.name].check(parameter.value)
                except BadInputError as error:
                    return SetParametersResult(successful=False, reason=str(error))
            if parameter.name == 'play.seek' and not self._stopped:
                length = (self._end - self._first) * 1e-9
                if parameter.value > length:
                    return SetParametersResult(
                        successful=False, reason=f'parameter play.seek is {parameter.value:g}: '
                        f'expected at most {length:g} s, where playing ends')
        for parameter in parameters:
            if self._stopped:
                break  # a rate set now is that of the next time
            if parameter.name == 'play.rate':
                self._set_rate(parameter.value)
            elif parameter.name == 'play.seek' and parameter.value >= 0.0:
                with self._change:
                    self._seek = self._first + round(parameter.value * 1e9)
                    self._change.notify_all()
        return SetParametersResult(successful=True)

    def _set_rate(self, rate: float) -> None:
        """Change the speed, without a jump in the schedule."""
        with self._change:
            since, began = self._anchor
            now = time.monotonic()
            if not self._paused:
                self._anchor = (since + round((now - began) * 1e9 * self._rate), now)
            self._rate = rate
            self._change.notify_all()

    def _on_diagnostics(self) -> None:
        """Publish the state."""
        state = 'inactive' if not self.active else 'paused' if self._paused else 'playing'
        values = {
            'bag': str(self._reader.path), 'state': state, 'sent': str(self._sent),
            'position': f'{(self._position - self._first) * 1e-9:.3f}',
            'duration': f'{(self._end - self._first) * 1e-9:.3f}',
            'rate': f'{self._rate:g}', 'largest_delay': f'{self._late:.6f}',
        }
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [DiagnosticStatus(
            level=DiagnosticStatus.OK, message=state, hardware_id='',
            name=f'{self.get_fully_qualified_name().lstrip("/")}: bag',
            values=[KeyValue(key=key, value=value) for key, value in values.items()])]
        self._diagnostics.publish(message)

    def close(self) -> None:
        """End the player's thread."""
        self._stop()
        if self._thread is not None:
            self._thread.join()
            self._thread = None


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the player.

    Parameters
    ----------
    args : sequence of str, optional
        Command-line arguments; default ``sys.argv[1:]``.

    Returns
    -------
    int
        Exit status.

    """
    # Reading ahead must not hold up sending for the usual 5 ms.
    sys.setswitchinterval(0.0005)
    return run(Player, args)
