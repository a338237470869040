"""
Recording in the background: a bounded queue and the thread that writes from it.

Who receives messages puts them here and goes on at once; compressing and waiting for the disk
happen in the thread. What cannot be kept is counted by topic, never dropped in silence.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
import threading
import time
from typing import NamedTuple

from hmsa_ros.bag.output import Entry
from hmsa_ros.bag.sink import Limits, Sink
from hmsa_ros.bag.topics import number_of, Topic
from hmsa_ros.bag.writer import BagWriter
from hmsa_ros.errors import BagError

__all__ = ['Limits', 'lost_by_topic', 'Recording', 'Status']

# What a queued message takes in memory besides its payload.
MESSAGE_OVERHEAD = 250
RETRY_SECONDS = 1.0
#: After so long the end does not wait any more: what is not yet written is counted as lost.
END_SECONDS = 10.0
# On top of it, for a disk that does not answer.
_GRACE_SECONDS = 5.0


class Status(NamedTuple):
    """
    State of a recording.

    File, error, counts by topic, memory in use, the seconds for which the oldest message has
    waited, and how often a new file was due too soon after the last ones.
    """

    file: str
    error: str
    written: Mapping[str, int]
    overflowed: Mapping[str, int]
    dropped: Mapping[str, int]
    queued_bytes: int
    behind: float
    crowded: int


class _Task(NamedTuple):
    """Something the thread is asked to do, and where its answer goes."""

    action: Callable[[], str]
    answer: Future[str]


class _Batch(NamedTuple):
    """Messages, what they take in memory, and since when they wait."""

    messages: list[Entry]
    size: int
    since: float


_Item = Topic | Mapping[str, str] | _Task | _Batch


class Recording:
    """
    Writes to a bag in a thread of its own.

    The thread calls ``report`` with a sentence, and whether it is a failure, when writing fails or
    succeeds again.
    """

    def __init__(
            self, writer: BagWriter, limits: Limits,
            report: Callable[[str, bool], None] = lambda sentence, failure: None) -> None:
        self._writer = writer
        self._limits = limits
        self._report = report
        self._condition = threading.Condition()
        self._items: deque[_Item] = deque()
        self._queued = 0
        self._topics: list[Topic] = []
        self._overflowed = Counter[int]()
        self._closing = False
        self._error = ''
        self._next_retry = 0.0
        self._rest: Iterator[Entry] | None = None
        self._batch = _Batch([], 0, 0.0)
        self._deadline = float('inf')
        self._sink = Sink(writer, limits, self._release)
        self._thread = threading.Thread(target=self._run, name='writer', daemon=True)
        self._thread.start()

    # From any thread -------------------------------------------------------------------------

    def add_topic(self, topic: Topic) -> int:
        """Announce a topic, or new offers of a known one; return its number for the messages."""
        topic.check()
        with self._condition:
            number = number_of(topic, self._topics)
            if number == len(self._topics):
                self._topics.append(topic)
            self._items.append(topic)
            self._condition.notify()
        return number

    def put(self, messages: list[Entry], payload_bytes: int) -> None:
        """Record messages, whose payloads have so many bytes in all; returns at once."""
        size = payload_bytes + MESSAGE_OVERHEAD * len(messages)
        with self._condition:
            if self._queued + size > self._limits.cache_size:
                self._lose(messages)
                return
            self._queued += size
            wake = not self._items
            self._items.append(_Batch(messages, size, time.monotonic()))
            if wake:
                self._condition.notify()

    def note(self, values: Mapping[str, str]) -> None:
        """Add to the custom data of the bag; a key that exists gets the new value."""
        with self._condition:
            self._items.append(dict(values))
            self._condition.notify()

    def split(self) -> str:
        """Go on in a new file, after all that has been put so far."""
        return self._ask(self._writer.split)

    def begin_anew(self) -> None:
        """
        Go on in a new file, if this one has messages; returns at once.

        For when time has jumped back: a snapshot does not reach back beyond it either.
        """
        with self._condition:
            self._items.append(_Task(self._sink.begin_anew, Future()))
            self._condition.notify()

    def snapshot(self) -> str:
        """Write what is kept in memory."""
        return self._ask(self._sink.snapshot)

    def status(self) -> Status:
        """Return the state."""
        with self._condition:
            batch = self._batch if self._rest is not None else next(
                (item for item in self._items if isinstance(item, _Batch)), None)
            return Status(
                self._writer.file_name, self._error, self._writer.topic_counts(),
                {self._topics[number].name: count
                 for number, count in self._overflowed.items()},
                dict(self._writer.dropped), self._queued,
                0.0 if batch is None else time.monotonic() - batch.since,
                self._sink.pace.refused)

    def close(self, last_words: Callable[[Status], Mapping[str, str]] | None = None) -> Status:
        """Write what has been put, add the custom data of ``last_words``, and close the bag."""
        with self._condition:
            self._closing = True
            self._deadline = time.monotonic() + END_SECONDS
            self._condition.notify()
        self._thread.join(END_SECONDS + _GRACE_SECONDS)
        if self._thread.is_alive():
            # It waits for the disk and cannot be waited for: the bag stays as a kill leaves it.
            self._error = (f'the disk of {self._writer.folder} has not answered for '
                           f'{_GRACE_SECONDS:g} s: the bag is not closed')
            self._give_up()
            return self.status()
        try:
            self._writer.flush()
        except OSError as error:
            self._error = self._error or _not_closed(error)
            self._writer.drop_pending()
        if last_words is not None:
            self._writer.custom_data.update(last_words(self.status()))
        try:
            self._writer.close()
        except OSError as error:
            self._error = self._error or _not_closed(error)
        return self.status()

    def _ask(self, action: Callable[[], str]) -> str:
        """Have the thread do something and return its answer."""
        answer = Future[str]()
        with self._condition:
            if self._closing:
                raise BagError('the recording has ended')
            self._items.append(_Task(action, answer))
            self._condition.notify()
        try:
            return answer.result()
        except Exception as error:
            raise BagError(str(error)) from error

    # In the thread ---------------------------------------------------------------------------

    def _run(self) -> None:
        """Write until the end."""
        # More often than promised: receiving and writing take time too.
        period = 0.6 * self._limits.flush_period
        next_flush = time.monotonic() + period
        while True:
            with self._condition:
                self._condition.wait_for(
                    lambda: self._closing or (self._items and not self._error),
                    max(0.0, next_flush - time.monotonic()))
                closing = self._closing
            try:
                if self._error:
                    self._retry(now=False)
                if not self._error:
                    self._take_items()
                if time.monotonic() >= next_flush and not self._error:
                    self._writer.flush()
            except OSError as error:
                self._fail(error)
            if time.monotonic() >= next_flush:
                next_flush = time.monotonic() + period
            if closing and self._error:
                # One last try; it may be the file alone that cannot grow any more.
                self._retry(now=True)
            if closing and (self._error or self._is_late()
                            or not self._items and self._rest is None):
                self._give_up()
                return

    def _take_items(self) -> None:
        """Write everything that is queued."""
        if self._rest is not None:
            self._write(self._rest, self._batch)
        while self._items and not self._is_late():
            item = self._items[0]
            if isinstance(item, _Batch):
                self._items.popleft()
                self._write(iter(item.messages), item)
            elif isinstance(item, _Task):
                self._items.popleft()
                self._answer(item)
            elif isinstance(item, Topic):
                self._writer.add_topic(item)
                self._items.popleft()
            else:
                self._items.popleft()
                self._writer.note(item)

    def _write(self, messages: Iterator[Entry], batch: _Batch) -> None:
        """Write messages; on failure what is left waits for the next try."""
        self._rest, self._batch = messages, batch
        self._sink.put(messages, batch.size, self._queued)
        self._rest = None

    def _is_late(self) -> bool:
        """Return whether the end has taken too long."""
        return time.monotonic() > self._deadline

    def _lose(self, messages: Iterable[Entry]) -> None:
        """Count messages that will not be written."""
        self._overflowed.update(message[0] for message in messages)

    def _release(self, size: int) -> None:
        """Give memory back to the queue."""
        with self._condition:
            self._queued -= size

    @staticmethod
    def _answer(request: _Task) -> None:
        """Do what was asked for."""
        try:
            request.answer.set_result(request.action())
        except BaseException as error:
            request.answer.set_exception(error)
            if not isinstance(error, BagError):
                raise

    def _fail(self, error: OSError) -> None:
        """Take note that writing is not possible."""
        self._error = f'cannot write to {self._writer.folder}: {_reason(error)}'
        self._report(
            f'{self._error}; recording resumes in a new file when possible, up to '
            f'{self._limits.cache_size} bytes are buffered until then', True)
        self._writer.abandon()
        self._next_retry = time.monotonic() + RETRY_SECONDS

    def _retry(self, *, now: bool) -> None:
        """Try to go on in a new file."""
        if not now and time.monotonic() < self._next_retry:
            return
        self._next_retry = time.monotonic() + RETRY_SECONDS
        try:
            name = self._writer.reopen()
            self._writer.flush()
        except OSError as error:
            self._error = f'cannot write to {self._writer.folder}: {_reason(error)}'
            self._writer.abandon()
            return
        self._error = ''
        self._report(f'recording continues in {name}', False)

    def _give_up(self) -> None:
        """Count what is left in the queue as lost, and answer who waits."""
        with self._condition:
            self._lose(self._rest or ())
            for item in self._items:
                if isinstance(item, _Batch):
                    self._lose(item.messages)
                elif isinstance(item, _Task):
                    item.answer.set_exception(BagError('the recording has ended'))
            self._items.clear()


def _not_closed(error: OSError) -> str:
    """Return the sentence for a bag that could not be closed."""
    return f'the bag could not be closed properly: {_reason(error)}'


def _reason(error: OSError) -> str:
    """Return the system's words for an error."""
    return error.strerror or str(error)


def lost_by_topic(*counts: Mapping[str, int]) -> dict[str, int]:
    """Return the sums of losses of several kinds by topic."""
    total = Counter[str]()
    for count in counts:
        total.update(count)
    return total
