"""Send the messages of a bag on an absolute schedule: pause, seek, step and stop."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from itertools import islice
import threading
import time

from hmsa.bag.reader import BagReader, Message

# An interruptible wait ends this much early; sleeping the rest is more accurate.
_FINE_SECONDS = 0.01

_POLL_SECONDS = 0.02
# Number of batches that share the messages and the memory read ahead.
_BATCHES = 8
#: Limit on the memory of messages read ahead.
READ_AHEAD_BYTES = 64 * 2**20


class PlayingInterruptedError(Exception):
    """Playback was stopped, or is to continue from another time of the bag."""


class PlaybackClock:
    """
    The schedule of one playback, initially paused: when each time of the bag (ns) is due.

    ``rate`` multiplies the recorded speed, ``position`` is the current time of the bag and
    ``late`` the largest delay of a message so far in s. Every change notifies ``change``.
    """

    def __init__(self, start: int, rate: float) -> None:
        self.change = threading.Condition()
        self.paused = True
        self.stopped = False
        self.rate = rate
        self.position = start
        self.late = 0.0
        self._seek: int | None = None
        self._steps = 0
        self._answers: deque[threading.Event] = deque()
        self._anchor = (start, time.monotonic())

    # Called by other threads -------------------------------------------------------------------

    def set_paused(self, paused: bool) -> None:
        """Pause or resume, without a jump in the schedule."""
        with self.change:
            if paused != self.paused:
                self._rebase()
                self.paused = paused
                self.change.notify_all()

    def set_rate(self, rate: float) -> None:
        """Change the speed, without a jump in the schedule."""
        with self.change:
            self._rebase()
            self.rate = rate
            self.change.notify_all()

    def seek(self, when: int) -> None:
        """Continue from a time of the bag in ns."""
        with self.change:
            self._seek = when
            self.change.notify_all()

    def step(self, timeout: float) -> bool:
        """Send one message while paused; return whether there was one within ``timeout`` s."""
        answer = threading.Event()
        with self.change:
            self._steps += 1
            self._answers.append(answer)
            self.change.notify_all()
        answer.wait(timeout)
        with self.change:
            if self._steps and not answer.is_set():
                # Withdraw the step, so that it does not send a message later.
                self._steps -= 1
                self._answers.remove(answer)
        return answer.is_set() and not self.stopped

    def stop(self) -> None:
        """Stop playback, and end all waits for it."""
        with self.change:
            self.stopped = True
            for answer in self._answers:
                answer.set()
            self.change.notify_all()

    def _rebase(self) -> None:
        """Restart the schedule at the current time and position."""
        since, began = self._anchor
        now = time.monotonic()
        if not self.paused:
            since += round((now - began) * 1e9 * self.rate)
        self._anchor = (since, now)

    # Called by the thread that sends -----------------------------------------------------------

    def begin(self, start: int) -> None:
        """Start the schedule: a time of the bag is due now."""
        with self.change:
            self.position = start
            self._anchor = (start, time.monotonic())

    @property
    def interrupted(self) -> bool:
        """Return whether playback is to stop or to seek."""
        return self.stopped or self._seek is not None

    def take_seek(self, otherwise: int) -> int:
        """Return the time of the bag to continue from."""
        with self.change:
            start, self._seek = self._seek, None
            return otherwise if start is None else start

    @property
    def stepping(self) -> bool:
        """Whether the next message is to be sent immediately."""
        return self._steps > 0

    def sent(self, when: int) -> None:
        """Record that a message was sent, and complete the step that requested it."""
        self.position = when
        if self._answers:
            with self.change:
                # A step may have been withdrawn in between.
                if self._answers:
                    self._answers.popleft().set()

    def rest(self, seconds: float) -> bool:
        """Wait for a time in s; return whether playback was stopped meanwhile."""
        with self.change:
            return self.change.wait_for(lambda: self.stopped, max(0.0, seconds))

    def wait(self, when: int, *, message: bool, timeout: float) -> int | None:
        """
        Wait until a time of the bag (ns) is due; a message can be requested by a step.

        Returns None then, or the current time of the bag after ``timeout`` s of a pause. Raises
        `PlayingInterruptedError`.
        """
        while True:
            with self.change:
                if self.interrupted:
                    raise PlayingInterruptedError
                since, began = self._anchor
                if self.paused:
                    if self._steps:
                        if message:
                            self._steps -= 1
                            self._anchor = (when, time.monotonic())
                        return None
                    if not self.change.wait(timeout):
                        return since
                    continue
                delay = began + (when - since) * 1e-9 / self.rate - time.monotonic()
                if delay > 2 * _FINE_SECONDS:
                    self.change.wait(delay - _FINE_SECONDS)
                    continue
            if delay > 0.0:
                time.sleep(delay)
            else:
                self.late = max(self.late, -delay)
            return None


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
