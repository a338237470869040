"""
Player: publishes the messages of a bag with their recorded spacing.

The node's executor serves services and parameters. A thread publishes each message at its time on
an absolute schedule, so that delays do not accumulate. A second thread reads ahead.

Commands cause motion. Topics with commands (see `hmsa_ros.nodes.selection`) are omitted unless
they are selected by name, in ``play.topics_to_filter``.

As a managed node, it opens the bag and creates its publishers when it is configured, plays while
it is active, and releases both when it is cleaned up.
"""

from collections.abc import Iterable, Mapping, Sequence
import contextlib
import math
import os
import sys
import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.duration import Duration
from rclpy.expand_topic_name import expand_topic_name

from hmsa.bag.playback import (
    CLOCK_WHILE_WAITING_SECONDS,
    ClockOut,
    Excerpt,
    PlaybackClock,
    Sender,
)
from hmsa.bag.reader import BagReader
from hmsa.errors import BadInputError, BagError, HmsaError, listed
from hmsa.interfaces import topics
from hmsa.interfaces.parameters import duration_from, duration_specs, ParameterSpec
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.conversions import to_clock, to_status
from hmsa_ros.nodes.managed import ManagedNode, run
from hmsa_ros.nodes.parameters import declare
from hmsa_ros.nodes.playback_publishers import (
    create_senders,
    Followers,
    full_name,
    latched,
    NAMED_AT_MOST,
    RequiredSubscribers,
)
from hmsa_ros.nodes.selection import Filter

_POLL_SECONDS = 0.02
# Reliable messages that found the receiver's queue full are sent again when a heartbeat of Fast
# DDS requests them, every 3 s with profiles other than ours. The wait at the end has to last for
# several heartbeats, in slices.
_ACKNOWLEDGED_SECONDS = 0.5
# Discovery may take three seconds, the period of participant announcements. Later subscribers are
# not waited for.
_DISCOVERY_SECONDS = 3.5
# Time in s of waiting after which it is said what is awaited.
_QUIET_SECONDS = 1.0
# Of the sending thread: precise timing on a busy machine needs it.
_REALTIME_PRIORITY = 1
# Limit of builtin_interfaces/Time.
_LATEST_CLOCK = 2**31 * 10**9

PARAMETERS = (
    ParameterSpec('storage.uri', '', 'Folder of the bag, or one of its files.'),
    ParameterSpec('play.rate', 1.0, 'Playback speed relative to the recording.', '', 1e-3, 1e3,
                  read_only=False),
    ParameterSpec('play.loop', False, 'Whether to start again at the end.'),
    ParameterSpec('play.start_paused', False, 'Whether to start paused.'),
    *duration_specs('play.start_offset', 0, 'Whole seconds to skip at the start.'),
    *duration_specs('play.playback_duration', -1, 'Whole seconds to play; negative for all.', -1),
    ParameterSpec(
        'play.seek', -1.0,
        'Set while playing to jump to this time after the first message of the bag.', 's',
        -1.0, 1e9, read_only=False),
    ParameterSpec(
        'play.topics_to_filter', [],
        'Topics to send; empty for all except commands.'),
    ParameterSpec(
        'play.regex_to_filter', '',
        'Regular expression; topics that contain a match are sent too, except commands.'),
    ParameterSpec('play.exclude_topics_to_filter', [], 'Topics not to send.'),
    ParameterSpec(
        'play.exclude_regex_to_filter', '',
        'Regular expression; topics that contain a match are not sent.'),
    ParameterSpec(
        'play.clock_publish_frequency', 0.0,
        "Rate at which /clock is published, in the bag's time; 0 for never.", 'Hz', 0.0, 1e5),
    ParameterSpec(
        'play.clock_publish_on_topic_publish', False,
        'Whether to publish /clock before each message.'),
    ParameterSpec(
        'play.wait_for_subscribers', [],
        'Topics that must have a subscriber before anything is sent.'),
    ParameterSpec(
        'play.wait_for_nodes', [],
        'Managed nodes that must be active before anything is sent; if there are any, one of '
        'them must subscribe to each topic in play.wait_for_subscribers.'),
    ParameterSpec(
        'play.wait_for_recorder', '',
        'Recorder that must be active, and subscribe to what it is to record of the nodes in '
        'play.wait_for_nodes, before anything is sent; empty for none.'),
    ParameterSpec(
        'play.wait_for_subscribers_timeout', 60.0, 'How long to wait for subscribers and nodes.',
        's', 0.0, 1e6),
    ParameterSpec(
        'play.wait_for_samples', [],
        'Topics of samples (sensor_msgs/msg/JointState) from nodes that follow /clock: at the end '
        'the player waits until they have reached the time of the last message.'),
    *duration_specs('play.delay', 0, 'Whole seconds to wait before playing.'),
    ParameterSpec(
        'play.read_ahead_queue_size', 1000, 'Number of messages to read ahead.',
        '', 1, 10_000_000),
    *duration_specs(
        'play.wait_acked_timeout', 20,
        'Whole seconds to wait at the end for acknowledgements of reliable subscribers, and for '
        'the next sample of play.wait_for_samples; negative for no wait.', -1),
)


class Player(ManagedNode):
    """ROS 2 node that plays a bag; ``failure`` contains the reason for an early end."""

    def __init__(self) -> None:
        super().__init__(topics.PLAYER)
        self._values = declare(self, PARAMETERS)
        self.failure: HmsaError | None = None
        self._transport = PlaybackClock(0, 1.0)
        self._transport.stop()
        self._thread: threading.Thread | None = None
        self.on_change(self._take_parameters)
        self.autostart()

    # States ----------------------------------------------------------------------------------

    def configure(self) -> None:
        """
        Open the bag, create its publishers, and wait.

        Raises
        ------
        BadInputError
            If a parameter or the bag is invalid.

        """
        values = self._values
        if not values['storage.uri']:
            raise BadInputError(
                'parameter storage.uri is empty: expected the folder of a bag or one of its '
                'files, for example -p storage.uri:=run1')
        self._reader = BagReader(values['storage.uri'])
        self._problems_reported = 0
        self._report_problems()
        self._excerpt = self._choose_excerpt()
        self._clock_out = self._offer_clock()
        self._senders = create_senders(
            self, self._reader, Filter(
                self._names('play.topics_to_filter'), values['play.regex_to_filter'],
                self._names('play.exclude_topics_to_filter'),
                values['play.exclude_regex_to_filter']),
            own_clock=self._clock_out is not None)
        self._required = RequiredSubscribers(
            self, {full_name(self, name): x for name, x in self._senders.items()},
            self._names('play.wait_for_subscribers'),
            self._names('play.wait_for_nodes'), ''.join(self._names('play.wait_for_recorder')))
        followers = self._names('play.wait_for_samples')
        if followers and self._clock_out is None:
            raise BadInputError(
                'parameter play.wait_for_samples needs a /clock from the player: set '
                'play.clock_publish_frequency')
        self._followers = Followers(self, followers)
        # While inactive, it is paused.
        self._resumes = not values['play.start_paused']
        self._transport = PlaybackClock(
            self._excerpt.start, self.get_parameter('play.rate').value)
        self._sender = Sender(
            self._reader, {name: x.publish for name, x in self._senders.items()},
            latched(self._reader, self._senders), self._transport, self._excerpt, self._clock_out)
        self._offer_services()
        self._thread = threading.Thread(
            target=self._run, args=(self._transport,), name='player', daemon=True)
        self._thread.start()

    def activate(self) -> None:
        """Play, unless it was paused before."""
        self._transport.set_paused(not self._resumes)

    def deactivate(self) -> None:
        """Pause."""
        self._resumes = not self._transport.paused
        self._transport.set_paused(True)

    def cleanup(self) -> None:
        """Stop playing."""
        self.close()
        self.finished = False

    def close(self) -> None:
        """End the player's thread."""
        self._transport.stop()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    # Selection of the messages ---------------------------------------------------------------

    def _names(self, parameter: str) -> tuple[str, ...]:
        """Return the full names of topics or nodes in a parameter."""
        given = self._values[parameter]
        return tuple(expand_topic_name(name, self.get_name(), self.get_namespace())
                     for name in ([given] if isinstance(given, str) else given) if name)

    def _choose_excerpt(self) -> Excerpt:
        """Return the part of the bag to play."""
        first, last = self._reader.start_time or 0, self._reader.end_time
        start = first + duration_from(self._values, 'play.start_offset')
        length = duration_from(self._values, 'play.playback_duration')
        if last is not None and start > last:
            raise BadInputError(
                f'parameter play.start_offset is {(start - first) * 1e-9:g} s: expected at most '
                f'{(last - first) * 1e-9:g} s, where {self._reader.path} ends')
        end = (first if last is None else last) if length < 0 else start + length
        return Excerpt(first, start, end, self._values['play.loop'],
                       self._values['play.read_ahead_queue_size'])

    def _offer_clock(self) -> ClockOut | None:
        """Return the clock if requested, and publish its first time."""
        frequency = self._values['play.clock_publish_frequency']
        on_publish = self._values['play.clock_publish_on_topic_publish']
        self._clock_publisher: Any = None
        if not (frequency > 0.0 or on_publish):
            return None
        latest = max(self._excerpt.start, self._excerpt.end)
        if latest >= _LATEST_CLOCK:
            raise BadInputError(
                f'{self._reader.path} reaches to {latest * 1e-9:.0f} s: expected less than '
                f'{_LATEST_CLOCK // 10**9} s for /clock')
        # Published first, so that nodes that wait for it can get ready.
        self._clock_publisher = ros_entities.publisher(self, topics.CLOCK_TOPIC)
        self._send_clock(self._excerpt.start)
        return ClockOut(self._send_clock, frequency, on_publish)

    def _send_clock(self, when: int) -> None:
        self._clock_publisher.publish(to_clock(when))

    def _report_problems(self) -> None:
        """Log each part of the bag that could not be read, once."""
        for problem in self._reader.problems[self._problems_reported:]:
            self.get_logger().warning(problem)
        self._problems_reported = len(self._reader.problems)

    # Sending, in the player's thread ---------------------------------------------------------

    def _run(self, transport: PlaybackClock) -> None:
        """Play, then end the process."""
        # If the system grants it.
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_REALTIME_PRIORITY))
        try:
            self._wait_for_required(transport)
            transport.rest(duration_from(self._values, 'play.delay') * 1e-9)
            self.get_logger().info(
                f'playing {len(self._senders)} topics of {self._reader.path}, '
                f'{max(0, self._excerpt.end - self._excerpt.start) * 1e-9:.3f} s at rate '
                f'{transport.rate:g}')
            self._sender.run()
            self._wait_for_followers(transport)
            self._finish(transport)
        except HmsaError as error:
            self.failure = error
        except Exception as error:
            if self.context.ok():
                self.failure = HmsaError(f'playing {self._reader.path} failed: {error!r}')
        finally:
            transport.stop()
            self.finished = True

    def _wait_for_required(self, transport: PlaybackClock) -> None:
        """Wait until the required subscribers are present."""
        begin = next_clock = time.monotonic()
        timeout = self._values['play.wait_for_subscribers_timeout']
        settled, quiet = begin + _DISCOVERY_SECONDS, begin + _QUIET_SECONDS
        while not transport.rest(_POLL_SECONDS):
            now = time.monotonic()
            if self._clock_out is not None and now >= next_clock:
                self._send_clock(self._excerpt.start)
                next_clock = now + CLOCK_WHILE_WAITING_SECONDS
            missing = self._required.missing()
            if not missing and (now >= settled or self._required.found(self._clock_publisher)):
                return
            if now >= quiet:
                quiet = math.inf
                self.get_logger().info(
                    f'waiting up to {timeout:g} s: no {", no ".join(missing)}' if missing else
                    f'waiting up to {_DISCOVERY_SECONDS:g} s for subscribers')
            if missing and now >= begin + timeout:
                raise HmsaError(
                    f'no {", no ".join(missing)} within {timeout:g} s: expected one; start it, '
                    'or remove it from play.wait_for_subscribers, play.wait_for_nodes and '
                    'play.wait_for_recorder')

    def _wait_for_followers(self, transport: PlaybackClock) -> None:
        """Wait while nodes that follow the clock get closer to its present time."""
        limit = duration_from(self._values, 'play.wait_acked_timeout') * 1e-9
        behind, since = self._followers.behind(self._excerpt.end), time.monotonic()
        while limit >= 0.0 and behind and not transport.rest(_POLL_SECONDS):
            # The message may be lost.
            self._send_clock(self._excerpt.end)
            now = self._followers.behind(self._excerpt.end)
            if now != behind:
                behind, since = now, time.monotonic()
            elif time.monotonic() >= since + limit:
                self.get_logger().warning(
                    f'no sample within {limit:g} s, and {self._followers.in_words(behind)}: '
                    'expected samples until the end of the bag; look at their publisher')
                break

    def _finish(self, transport: PlaybackClock) -> None:
        """Wait for acknowledgements, and report the number of messages."""
        self._report_problems()
        limit = duration_from(self._values, 'play.wait_acked_timeout')
        waiting = list(self._senders.values()) if limit >= 0 else []
        end = time.monotonic() + limit * 1e-9
        while waiting and not transport.stopped:
            left = max(0.0, min(end - time.monotonic(), _ACKNOWLEDGED_SECONDS))
            if waiting[0].wait_for_all_acked(Duration(nanoseconds=round(left * 1e9))):
                del waiting[0]
            elif time.monotonic() >= end:
                self.get_logger().warning(
                    'not every subscriber of ' + ', '.join(x.topic_name for x in waiting)
                    + f' acknowledged every message within {limit * 1e-9:g} s; with a larger '
                    'play.wait_acked_timeout.sec they get more time')
                break
        missing = self._reader.unreadable() if self._reader.problems else 0
        print(f'hmsa player: {self._sender.count} messages sent'
              + f', {missing} of the bag cannot be read' * bool(missing), flush=True)
        if not (self._sender.count or transport.stopped):
            self.failure = BagError(f'no message of {self._reader.path} was sent: '
                                    + self._why_nothing())

    def _why_nothing(self) -> str:
        """Return why there was nothing to send."""
        if not any(self._reader.counts().values()):
            return 'the bag has none'
        if not self._senders:
            return ('no topic is sent, as said above; its topics are '
                    + listed(sorted(self._reader.topics), NAMED_AT_MOST))
        return (f'{listed(sorted(self._senders), NAMED_AT_MOST)} has none in the part that is '
                'played; see play.start_offset, play.playback_duration and '
                'play.topics_to_filter')

    # Services and parameters, in the executor's thread ---------------------------------------

    def _offer_services(self) -> None:
        transport = self._transport
        self.offer(topics.PAUSE, lambda: self._set_paused(True))
        self.offer(topics.RESUME, lambda: self._set_paused(False))
        self.offer(topics.TOGGLE_PAUSED, lambda: self._set_paused(not transport.paused))
        self.offer(topics.IS_PAUSED, lambda: (
            transport.paused, 'paused' if transport.paused else 'playing'))
        self.offer(topics.PLAY_NEXT, self._on_play_next)
        self.offer(topics.STOP, self._on_stop)
        self.diagnose(self._report)

    @property
    def _inactive(self) -> str:
        return f'the player is {self.state}: expected an active one'

    def _set_paused(self, paused: bool) -> tuple[bool, str]:
        if not self.active:
            return False, self._inactive
        self._transport.set_paused(paused)
        return True, 'paused' if paused else 'playing'

    def _on_play_next(self) -> tuple[bool, str]:
        if not self.active:
            return False, self._inactive
        if not self._transport.paused or self._transport.stopped:
            return False, 'not paused: expected a paused player; call pause first'
        sent = self._transport.step(1.0)
        return sent, 'sent' if sent else 'none was due: playing has not begun, or has ended'

    def _on_stop(self) -> tuple[bool, str]:
        """Stop playing, and end the process."""
        # Delayed until this response is sent, since the process would end before.
        self.every(0.1, self._transport.stop)
        return True, 'stopped'

    def _take_parameters(self, given: Mapping[str, Any]) -> None:
        """Adopt a new rate, or jump to another time."""
        if self._transport.stopped:
            # A rate set while stopped applies to the next run.
            return
        seek, length = given.get('play.seek', -1.0), self._excerpt.end - self._excerpt.first
        if seek > length * 1e-9:
            raise BadInputError(
                f'parameter play.seek is {seek:g}: expected at most {length * 1e-9:g} s, where '
                'playing ends')
        if 'play.rate' in given:
            self._transport.set_rate(given['play.rate'])
        if seek >= 0.0:
            self._transport.seek(self._excerpt.first + round(seek * 1e9))

    def _report(self) -> Iterable[DiagnosticStatus]:
        transport, excerpt = self._transport, self._excerpt
        state = 'inactive' if not self.active else 'paused' if transport.paused else 'playing'
        values = {
            'bag': self._reader.path, 'state': state, 'sent': self._sender.count,
            'position': f'{(transport.position - excerpt.first) * 1e-9:.3f}',
            'duration': f'{(excerpt.end - excerpt.first) * 1e-9:.3f}',
            'rate': f'{transport.rate:g}', 'largest_delay': f'{transport.late:.6f}',
        }
        yield to_status(
            f'{self.get_fully_qualified_name().lstrip("/")}: bag', '', 0, state, values)


def main(args: Sequence[str] | None = None) -> int:
    """Run the player with the command line's arguments; return the exit status."""
    # Reading ahead must not delay publishing by the default 5 ms.
    sys.setswitchinterval(0.0005)
    return run(Player, args)
