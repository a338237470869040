"""
Recording in the background: a bounded queue and the thread that writes from it.

Who receives messages puts them here and goes on at once; compressing and waiting for the disk
happen in the thread. What cannot be kept is counted by topic, never dropped in silence.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
import threading
import time
from typing import NamedTuple

from hmsa_ros.bag.writer import BagWriter, MIN_FILE_SIZE, Topic
from hmsa_ros.errors import BadInputError, BagError

# What a queued message takes in memory besides its payload.
MESSAGE_OVERHEAD = 250
RETRY_SECONDS = 1.0

Message = tuple[int, int, int, int, bytes]


@dataclass(frozen=True)
class Limits:
    """
    When to flush, when to split and how much to keep in memory.

    Attributes
    ----------
    flush_period : float
        Seconds after which at the latest a message is with the operating system; above 0.
    max_size : int
        Size in bytes at which a file is split; 0 for never, else at least 1024.
    max_duration_ns : int
        Time span at which a file is split, in nanoseconds; 0 for never.
    cache_size : int
        Bytes of queued messages at which new ones are counted as lost; at least 1.
    snapshot_ns : int
        In nanoseconds: above 0, messages are kept in memory for this long and only written
        when a snapshot is asked for.

    """

    flush_period: float = 0.5
    max_size: int = 0
    max_duration_ns: int = 0
    cache_size: int = 100 * 2**20
    snapshot_ns: int = 0

    def __post_init__(self) -> None:
        if not self.flush_period > 0.0:
            raise BadInputError(f'flush period is {self.flush_period} s: expected above 0')
        if self.max_size and self.max_size < MIN_FILE_SIZE:
            raise BadInputError(
                f'largest file size is {self.max_size} bytes: expected 0 for no limit, or at '
                f'least {MIN_FILE_SIZE}')
        if self.max_duration_ns < 0 or self.snapshot_ns < 0:
            raise BadInputError('a duration is negative: expected at least 0')
        if self.cache_size < 1:
            raise BadInputError(f'cache size is {self.cache_size}: expected at least 1 byte')


class Status(NamedTuple):
    """State of a recording: file, error, counts by topic and memory in use."""

    file: str
    error: str
    written: Mapping[str, int]
    overflowed: Mapping[str, int]
    dropped: Mapping[str, int]
    queued_bytes: int
    peak_bytes: int


@dataclass
class _Request:
    """Something the thread is asked to do, and its answer."""

    action: Callable[[], str]
    done: threading.Event = field(default_factory=threading.Event)
    answer: str = ''
    error: BaseException | None = None


_Item = Topic | Mapping[str, str] | _Request | tuple[list[Message], int]


class Recording:
    """
    Writes to a bag in a thread of its own.

    Parameters
    ----------
    writer : hmsa_ros.bag.writer.BagWriter
        From now on used by the thread alone.
    limits : Limits
        When to flush and to split, and how much to keep.
    report : callable
        Called in the thread with a sentence when writing fails or succeeds again; its second
        argument says whether it is a failure.

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
        self._peak = 0
        self._topics: list[Topic] = []
        self._overflowed: dict[int, int] = {}
        self._closing = False
        self._error = ''
        self._next_retry = 0.0
        self._rest: Iterator[Message] | None = None
        self._rest_size = 0
        self._ring: deque[tuple[list[Message], int]] = deque()
        self._thread = threading.Thread(target=self._run, name='writer', daemon=True)
        self._thread.start()

    # From any thread -------------------------------------------------------------------------

    def add_topic(self, topic: Topic) -> int:
        """
        Announce a topic, or new offers of a known one.

        Parameters
        ----------
        topic : hmsa_ros.bag.writer.Topic
            What will be recorded.

        Returns
        -------
        int
            Number of the topic in messages.

        """
        with self._condition:
            number = next((
                i for i, known in enumerate(self._topics)
                if (known.name, known.type) == (topic.name, topic.type)), len(self._topics))
            if number == len(self._topics):
                self._topics.append(topic)
            self._items.append(topic)
            self._condition.notify()
        return number

    def put(self, messages: list[Message], payload_bytes: int) -> None:
        """
        Record messages; returns at once.

        Parameters
        ----------
        messages : list of tuple
            Topic number, log time, publish time, sequence and payload of each.
        payload_bytes : int
            Length of all payloads.

        """
        size = payload_bytes + MESSAGE_OVERHEAD * len(messages)
        with self._condition:
            if self._queued + size > self._limits.cache_size:
                for message in messages:
                    self._overflowed[message[0]] = self._overflowed.get(message[0], 0) + 1
                return
            self._queued += size
            self._peak = max(self._peak, self._queued)
            wake = not self._items
            self._items.append((messages, size))
            if wake:
                self._condition.notify()

    def note(self, values: Mapping[str, str]) -> None:
        """
        Add to the custom data of the bag.

        Parameters
        ----------
        values : mapping of str to str
            Replace those of the same key.

        """
        with self._condition:
            self._items.append(dict(values))
            self._condition.notify()

    def split(self) -> str:
        """
        Go on in a new file, after all that has been put so far.

        Returns
        -------
        str
            Name of the new file.

        Raises
        ------
        BagError
            If it cannot be done.

        """
        return self._ask(self._split)

    def begin_anew(self) -> None:
        """
        Go on in a new file, if this one has messages; returns at once.

        For when time has jumped back: a snapshot does not reach back beyond it either.
        """
        with self._condition:
            self._items.append(_Request(self._begin_anew))
            self._condition.notify()

    def snapshot(self) -> str:
        """
        Write what is kept in memory.

        Returns
        -------
        str
            How many messages were written, in words.

        Raises
        ------
        BagError
            If it cannot be done.

        """
        return self._ask(self._snapshot)

    def status(self) -> Status:
        """
        Return the state.

        Returns
        -------
        Status
            As of now.

        """
        with self._condition:
            return Status(
                self._writer.file_name, self._error, self._writer.topic_counts(),
                {self._topics[number].name: count
                 for number, count in self._overflowed.items()},
                dict(self._writer.dropped), self._queued, self._peak)

    def close(self, last_words: Callable[[Status], Mapping[str, str]] | None = None) -> Status:
        """
        Write what has been put so far and close the bag.

        Parameters
        ----------
        last_words : callable, optional
            Gets the state when everything is written and returns custom data to add.

        Returns
        -------
        Status
            The last state; ``error`` says what could not be written.

        """
        with self._condition:
            self._closing = True
            self._condition.notify()
        self._thread.join()
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
        request = _Request(action)
        with self._condition:
            if self._closing:
                raise BagError('the recording has ended')
            self._items.append(request)
            self._condition.notify()
        request.done.wait()
        if request.error is not None:
            raise BagError(str(request.error)) from request.error
        return request.answer

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
            if closing and (self._error or not self._items and self._rest is None):
                self._give_up()
                return

    def _take_items(self) -> None:
        """Write everything that is queued."""
        if self._rest is not None:
            self._write(self._rest, self._rest_size)
        while self._items:
            item = self._items[0]
            if isinstance(item, tuple):
                self._items.popleft()
                self._write(iter(item[0]), item[1])
            elif isinstance(item, _Request):
                self._items.popleft()
                self._answer(item)
            elif isinstance(item, Topic):
                self._writer.add_topic(item)
                self._items.popleft()
            else:
                self._items.popleft()
                self._writer.note(item)

    def _write(self, messages: Iterator[Message], size: int) -> None:
        """Write messages; on failure what is left waits for the next try."""
        self._rest, self._rest_size = messages, size
        if self._limits.snapshot_ns:
            self._keep(list(messages), size)
        elif self._limits.max_size or self._limits.max_duration_ns:
            self._write_splitting(messages)
            self._release(size)
        else:
            self._writer.write(messages)
            self._release(size)
        self._rest = None

    def _release(self, size: int) -> None:
        """Give memory back to the queue."""
        with self._condition:
            self._queued -= size

    def _write_splitting(self, messages: Iterator[Message]) -> None:
        """Write one message after the other, with a new file where a limit is reached."""
        writer, limits = self._writer, self._limits
        for message in messages:
            if (limits.max_size and writer.file_size >= limits.max_size) or (
                    limits.max_duration_ns
                    and writer.file_duration_ns >= limits.max_duration_ns):
                writer.split()
            writer.write((message,))

    def _keep(self, messages: list[Message], size: int) -> None:
        """Keep messages in memory for a snapshot, the oldest giving way."""
        self._ring.append((messages, size))
        newest = messages[-1][1]
        while self._ring and (
                self._ring[0][0][-1][1] < newest - self._limits.snapshot_ns
                or self._queued > self._limits.cache_size * 9 // 10):
            self._release(self._ring.popleft()[1])

    def _snapshot(self) -> str:
        """Write the messages kept in memory."""
        if not self._limits.snapshot_ns:
            raise BagError('there is no snapshot to take: every message is recorded; expected '
                           'snapshot mode')
        newest = self._ring[-1][0][-1][1] if self._ring else 0
        count = 0
        while self._ring:
            messages, size = self._ring.popleft()
            wanted = [message for message in messages
                      if message[1] >= newest - self._limits.snapshot_ns]
            self._writer.write(wanted)
            self._release(size)
            count += len(wanted)
        self._writer.flush()
        return f'{count} messages written'

    def _split(self) -> str:
        """Go on in a new file."""
        return self._writer.split()

    def _begin_anew(self) -> str:
        """Go on in a new file, without what is kept for a snapshot."""
        while self._ring:
            self._release(self._ring.popleft()[1])
        return self._writer.file_name if self._writer.is_file_empty else self._writer.split()

    @staticmethod
    def _answer(request: _Request) -> None:
        """Do what was asked for."""
        try:
            request.answer = request.action()
        except (OSError, BagError) as error:
            request.error = error
            if isinstance(error, OSError):
                raise
        finally:
            request.done.set()

    def _fail(self, error: OSError) -> None:
        """Take note that writing is not possible."""
        self._error = f'cannot write to {self._writer.folder}: {_reason(error)}'
        self._report(
            f'{self._error}; recording goes on in a new file when it is possible again, up to '
            f'{self._limits.cache_size} bytes are kept until then', True)
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
        self._report(f'recording goes on in {name}', False)

    def _give_up(self) -> None:
        """Count what is left in the queue as lost, and answer who waits."""
        left = list(self._rest or ())
        with self._condition:
            for item in self._items:
                if isinstance(item, tuple):
                    left += item[0]
                elif isinstance(item, _Request):
                    item.error = BagError('the recording has ended')
                    item.done.set()
            self._items.clear()
            for message in left:
                self._overflowed[message[0]] = self._overflowed.get(message[0], 0) + 1


def _not_closed(error: OSError) -> str:
    """Return the sentence for a bag that could not be closed."""
    return f'the bag could not be closed properly: {_reason(error)}'


def _reason(error: OSError) -> str:
    """Return the system's words for an error."""
    return error.strerror or str(error)


def lost_by_topic(*counts: Mapping[str, int]) -> dict[str, int]:
    """
    Add up losses of several kinds.

    Parameters
    ----------
    *counts : mapping of str to int
        By topic.

    Returns
    -------
    dict of str to int
        Sums by topic.

    """
    total: dict[str, int] = {}
    for count in counts:
        for topic, number in count.items():
            total[topic] = total.get(topic, 0) + number
    return total


def duration_ns(seconds: float) -> int:
    """Return seconds as whole nanoseconds."""
    return round(seconds * 1e9)
