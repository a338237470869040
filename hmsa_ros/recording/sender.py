"""Send the messages of a bag on an absolute schedule."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from itertools import islice
import time

from hmsa.bag.reader import BagReader, Message
from hmsa_ros.recording.playback_clock import PlaybackClock, PlayingInterruptedError

_POLL_SECONDS = 0.02
# Number of batches that share the messages and the memory read ahead.
_BATCHES = 8
#: Limit on the memory of messages read ahead.
READ_AHEAD_BYTES = 64 * 2**20


class ReadAhead:
    """Read ``size`` messages ahead in a thread; ``read`` takes the argument ``cancelled``."""

    def __init__(self, read: Callable[..., Iterator[Message]], size: int) -> None:
        self._ended = False
        self._messages = read(cancelled=lambda: self._ended)
        self._most = -(-size // _BATCHES)
        # A single thread keeps the batches in order.
        self._thread = ThreadPoolExecutor(1, 'read ahead')
        self._ahead = deque(self._thread.submit(self._batch) for _ in range(_BATCHES))

    def _batch(self) -> list[Message]:
        """Return the next messages, none at the end."""
        batch, size = [], 0
        for message in islice(self._messages, self._most):
            batch.append(message)
            size += len(message.data)
            if size > READ_AHEAD_BYTES // _BATCHES:
                break
        return batch

    def __iter__(self) -> Iterator[Message]:
        while batch := self._ahead.popleft().result():
            self._ahead.append(self._thread.submit(self._batch))
            yield from batch

    def wait(self, transport: PlaybackClock) -> None:
        """Wait for the first messages, the end, or an interruption."""
        while not (self._ahead[0].done() or transport.interrupted):
            wait([self._ahead[0]], _POLL_SECONDS)

    def stop(self) -> None:
        """Stop reading."""
        self._ended = True
        self._thread.shutdown(cancel_futures=True)


#: Interval in s at which the clock is repeated during a pause.
CLOCK_WHILE_WAITING_SECONDS = 0.1
# Without a minimum, a loop over a bag of zero length would send without pause.
_SHORTEST_ROUND_SECONDS = 0.1


@dataclass(frozen=True)
class Excerpt:
    """The part of a bag that is played: times in ns, and whether it loops."""

    first: int
    start: int
    end: int
    loop: bool = False
    read_ahead: int = 1000


@dataclass(frozen=True)
class ClockOut:
    """The clock: sent at a frequency in Hz of real time (0 for none), or before each message."""

    send: Callable[[int], None]
    frequency: float = 0.0
    on_publish: bool = False


class Sender:
    """
    Send a bag once or in a loop, on the schedule of a transport.

    ``latched`` contains the number of messages that a late subscriber of a topic receives;
    ``count`` is the number of messages sent so far.
    """

    def __init__(
            self, reader: BagReader, out: Mapping[str, Callable[[bytes], object]],
            latched: Mapping[str, int], transport: PlaybackClock, excerpt: Excerpt,
            clock: ClockOut | None = None) -> None:
        self._reader = reader
        self._out = out
        self._latched = latched
        self._transport = transport
        self._excerpt = excerpt
        self._clock = clock or ClockOut(lambda when: None)
        self.count = 0

    def run(self) -> None:
        """Send until the end of the excerpt or of the last round, or until stopped."""
        while True:
            begin, count = time.monotonic(), self.count
            if not self._play(self._excerpt.start) or self.count == count:
                return
            if not self._excerpt.loop or self._transport.rest(
                    begin + _SHORTEST_ROUND_SECONDS - time.monotonic()):
                return

    def _play(self, start: int) -> bool:
        """Play from a time on; return whether the end was reached."""
        while True:
            source = ReadAhead(partial(
                self._reader.messages, self._out.keys(), start=start, end=self._excerpt.end + 1),
                self._excerpt.read_ahead)
            try:
                self._send_latched(start)
                # Time starts when the first message is ready.
                source.wait(self._transport)
                self._transport.begin(start)
                self._send_all(source, start)
                return True
            except PlayingInterruptedError:
                if self._transport.stopped:
                    return False
                start = self._transport.take_seek(self._excerpt.first)
            finally:
                source.stop()

    def _send_all(self, messages: Iterable[Message], start: int) -> None:
        """Send messages, each at its time."""
        tick, clock = start, self._clock
        if clock.frequency > 0.0:
            # Before the first message: in a loop, this is the backward jump of time.
            clock.send(start)
        for message in messages:
            tick = self._tick_until(message.log_time, tick, last=False)
            if clock.on_publish:
                clock.send(message.log_time)
            self._out[message.topic](message.data)
            self.count += 1
            self._transport.sent(message.log_time)
        self._tick_until(self._excerpt.end, tick, last=True)
        if clock.frequency > 0.0:
            clock.send(self._excerpt.end)

    def _tick_until(self, when: int, tick: int, *, last: bool) -> int:
        """Wait until a time of the bag, with the clock's ticks before it; return the next tick."""
        clock = self._clock
        while clock.frequency > 0.0 and tick <= when:
            self._wait(tick, message=False)
            if self._transport.stepping and not last:
                break
            clock.send(tick)
            tick += max(1, round(1e9 * self._transport.rate / clock.frequency))
        self._wait(when, message=not last)
        return tick

    def _wait(self, when: int, *, message: bool) -> None:
        """Wait until a time of the bag."""
        while (standing_at := self._transport.wait(
                when, message=message, timeout=CLOCK_WHILE_WAITING_SECONDS)) is not None:
            # Repeat the time for new subscribers.
            self._clock.send(standing_at)

    def _send_latched(self, start: int) -> None:
        """Send the messages that a new subscriber of the latched topics would have received."""
        if not self._latched or start <= self._excerpt.first:
            return
        kept = {name: deque[Message]() for name in self._latched}
        size = 0
        for message in self._reader.messages(
                self._latched.keys(), end=start, cancelled=lambda: self._transport.interrupted):
            latest = kept[message.topic]
            latest.append(message)
            size += len(message.data)
            while len(latest) > self._latched[message.topic] or (
                    size > READ_AHEAD_BYTES and len(latest) > 1):
                size -= len(latest.popleft().data)
        for message in sorted((message for messages in kept.values() for message in messages),
                              key=lambda message: message.log_time):
            self._out[message.topic](message.data)
            self.count += 1
