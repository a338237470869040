"""
Recording in the background: a bounded queue and the thread that writes from it.

Who receives messages puts them here and goes on at once; compressing and waiting for the disk
happen in the thread. What cannot be kept is counted by topic, never dropped in silence. The state
of a recorder follows from both.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
import ctypes
from dataclasses import dataclass, field
from functools import partial
import threading
import time
from typing import Any, NamedTuple

from hmsa.bag.metadata import BagTopic
from hmsa.bag.output import Entry
from hmsa.bag.qos import Qos
from hmsa.bag.reader import topic_number
from hmsa.bag.writer import BagWriter, MIN_FILE_SIZE
from hmsa.errors import BadInputError, BagError, check_number

# Memory of a queued message in bytes, in addition to its payload.
MESSAGE_OVERHEAD = 250
RETRY_SECONDS = 1.0
#: Maximum time in s to write the queue at the end; the rest is counted as lost.
END_SECONDS = 10.0
# The C library keeps the memory of messages that were written. It is given back to the system
# after so many bytes of them, at most once in this time in s.
_TRIM_BYTES = 16 * 2**20
_TRIM_SECONDS = 5.0
# Further time in s for a disk that does not answer.
_GRACE_SECONDS = 5.0
#: Number of new files that may be opened immediately, and the interval in s after that: each file
#: needs declarations and an index, and waits for the disk.
FILE_BURST = 10
FILE_SECONDS = 1.0
OK, WARN, ERROR = range(3)
# Messages always wait for a flush: longer delays, in flush periods and in s, are reported.
_BEHIND_PERIODS = 4.0
_BEHIND_SECONDS = 1.0


@dataclass(frozen=True)
class RecordingLimits:
    """Limits on flushing, splitting, and memory."""

    flush_period: float = 0.5  #: maximum time in s until the operating system has a message
    max_size: int = 0  #: bytes at which a file is split; 0 for never, else at least 1024
    max_duration_ns: int = 0  #: time span at which a file is split; 0 for never
    #: bytes of queued messages at which new ones are counted as lost
    cache_size: int = 100 * 2**20
    snapshot_ns: int = 0  #: above 0: messages are kept this long, and written by a snapshot only

    def __post_init__(self) -> None:
        check_number('flush period', self.flush_period, 's', above=0.0, endless=True)
        if self.max_size and self.max_size < MIN_FILE_SIZE:
            raise BadInputError(
                f'largest file size is {self.max_size} bytes: expected 0 for no limit, or at '
                f'least {MIN_FILE_SIZE}')
        if self.max_duration_ns < 0 or self.snapshot_ns < 0:
            raise BadInputError('a duration is negative: expected at least 0')
        check_number('cache size in bytes', self.cache_size, least=1)


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
    """An action for the thread, and the future of its result."""

    action: Callable[[], object]
    answer: Future[object]


@dataclass
class _Batch:
    """Queued messages, their size in memory, and when they were queued."""

    messages: list[Entry]
    size: int
    since: float


class WriterThread:
    """
    Write to a bag in a separate thread.

    When writing fails or succeeds again, the thread calls ``report`` with a message and whether it
    is a failure.
    """

    def __init__(
            self, writer: BagWriter, limits: RecordingLimits,
            report: Callable[[str, bool], None] = lambda sentence, failure: None) -> None:
        self._writer = writer
        self._limits = limits
        self._report = report
        self._condition = threading.Condition()
        self._items: deque[_Task | _Batch] = deque()
        self._kept: deque[_Batch] = deque()  # for a snapshot
        self._queued = 0
        self._used = 0  # bytes of messages since memory was given back
        self._next_trim = 0.0
        self._topics: list[BagTopic] = []
        self._overflowed = Counter[int]()
        self._closing = False
        self._error = ''
        self._next_retry = 0.0
        self._deadline = float('inf')
        # New files that may be opened now, the time of that count, and splits that were skipped.
        self._files_left, self._files_since = float(FILE_BURST), time.monotonic()
        self._crowded = 0
        self._thread = threading.Thread(target=self._run, name='writer', daemon=True)
        self._thread.start()

    # From any thread -------------------------------------------------------------------------

    def add_topic(self, topic: BagTopic) -> int:
        """Add a topic, or new profiles of a known one; return its number for the messages."""
        topic.check()
        with self._condition:
            number = topic_number(topic, self._topics)
            if number == len(self._topics):
                self._topics.append(topic)
            self._ask(partial(self._writer.add_topic, topic))
        return number

    def put(self, messages: list[Entry], payload_bytes: int) -> None:
        """Queue messages with a total payload in bytes; return immediately."""
        size = payload_bytes + MESSAGE_OVERHEAD * len(messages)
        batch = _Batch(messages, size, time.monotonic())
        with self._condition:
            self._used += size
            if self._limits.snapshot_ns:
                self._keep(batch)
            elif self._queued + size > self._limits.cache_size:
                self._lose(messages)
            else:
                self._queued += size
                self._items.append(batch)
                if len(self._items) == 1:
                    self._condition.notify()

    def note(self, values: Mapping[str, str]) -> None:
        """Add to the custom data of the bag; a key that exists gets the new value."""
        self._ask(partial(self._writer.note, dict(values)))

    def split(self) -> str:
        """Continue in a new file after all messages queued so far; return its name."""
        return self._answer_to(self._writer.split)

    def begin_anew(self) -> None:
        """
        Continue in a new file if the current one has messages; return immediately.

        Used after a backward jump of time; messages kept for a snapshot are discarded.
        """
        with self._condition:
            while self._kept:
                self._queued -= self._kept.popleft().size
            self._ask(self._begin_anew)

    def snapshot(self) -> str:
        """Write the messages kept in memory; raise `BagError` if not in snapshot mode."""
        if not self._limits.snapshot_ns:
            raise BagError('a snapshot needs snapshot mode, and every message is recorded: '
                           'expected record.snapshot_mode: true')
        with self._condition:
            oldest = self._kept[-1].messages[-1][1] - self._limits.snapshot_ns if self._kept else 0
            count = 0
            for batch in self._kept:
                wanted = [x for x in batch.messages if x[1] >= oldest]
                self._items.append(_Batch(wanted, batch.size, time.monotonic()))
                count += len(wanted)
            self._kept.clear()
        self._answer_to(self._writer.flush)
        return f'{count} messages written'

    def status(self) -> Status:
        """Return the state."""
        with self._condition:
            since = next((x.since for x in self._items if isinstance(x, _Batch)), None)
            return Status(
                self._writer.file_name, self._error, self._writer.topic_counts(),
                {self._topics[number].name: count
                 for number, count in self._overflowed.items()},
                dict(self._writer.dropped), self._queued,
                0.0 if since is None else time.monotonic() - since, self._crowded)

    def close(self, last_words: Callable[[Status], Mapping[str, str]] | None = None) -> Status:
        """
        Write the queued messages, add the custom data of ``last_words``, and close the bag.

        The state returned counts what can be read in the files.
        """
        with self._condition:
            self._closing = True
            self._deadline = time.monotonic() + END_SECONDS
            self._condition.notify()
        self._thread.join(END_SECONDS + _GRACE_SECONDS)
        if self._thread.is_alive():
            # The thread is blocked by the disk: the bag stays as after a kill.
            self._error = (f'the disk of {self._writer.folder} has not answered for '
                           f'{_GRACE_SECONDS:g} s: the bag is not closed')
            self._give_up()
            return self.status()
        try:
            self._writer.flush()
        except OSError as error:
            self._error = self._error or _not_closed(error)
            self._writer.drop_pending()

        def count() -> None:
            """Count what can be read, and add the last words."""
            self._writer.check_files()
            if last_words is not None:
                self._writer.custom_data.update(last_words(self.status()))

        # Again at the end, since the last file may have been removed or shortened too.
        for act in (count, self._writer.close, count, self._writer.write_metadata):
            try:
                act()
            except OSError as error:
                self._error = self._error or _not_closed(error)
        return self.status()

    def _ask(self, action: Callable[[], object]) -> Future[object]:
        """Have the thread perform an action; return the future of its result."""
        task = _Task(action, Future())
        with self._condition:
            self._items.append(task)
            self._condition.notify()
        return task.answer

    def _answer_to(self, action: Callable[[], object]) -> str:
        """Have the thread perform an action, and return its result."""
        with self._condition:
            if self._closing:
                raise BagError('the recording has ended')
            answer = self._ask(action)
        try:
            return str(answer.result())
        except Exception as error:
            raise BagError(str(error)) from error

    def _keep(self, batch: _Batch) -> None:
        """Keep messages for a snapshot and discard the oldest; count a batch too large as lost."""
        self._queued += batch.size
        self._kept.append(batch)
        oldest = batch.messages[-1][1] - self._limits.snapshot_ns
        while self._kept and (self._kept[0].messages[-1][1] < oldest
                              or self._queued > self._limits.cache_size):
            given_way = self._kept.popleft()
            self._queued -= given_way.size
            if given_way is batch:
                self._lose(batch.messages)

    def _lose(self, messages: Iterable[Entry]) -> None:
        """Count messages that will not be written as lost."""
        self._overflowed.update(message[0] for message in messages)

    # In the thread ---------------------------------------------------------------------------

    def _run(self) -> None:
        """Write until the end."""
        # Shorter than the flush period because receiving and writing take time too.
        period = 0.6 * self._limits.flush_period
        next_flush = time.monotonic() + period
        while True:
            with self._condition:
                self._condition.wait_for(
                    lambda: self._closing or (self._items and not self._error),
                    max(0.0, next_flush - time.monotonic()))
                closing = self._closing
            try:
                if self._error and time.monotonic() >= self._next_retry:
                    self._retry()
                if not self._error:
                    self._take_items()
                    if time.monotonic() >= next_flush:
                        self._writer.flush()
            except OSError as error:
                self._fail(error)
            if time.monotonic() >= next_flush:
                next_flush = time.monotonic() + period
                self._give_back_memory()
            if closing and self._error:
                # One last attempt: a new file may succeed.
                self._retry()
            if closing and (self._error or self._is_late() or not self._items):
                self._give_up()
                return

    def _give_back_memory(self) -> None:
        """Give the memory of written messages back to the system from time to time."""
        now = time.monotonic()
        if self._used >= _TRIM_BYTES and now >= self._next_trim:
            self._used, self._next_trim = 0, now + _TRIM_SECONDS
            _trim(0)

    def _take_items(self) -> None:
        """Process the queue; after a failure, the rest waits for the next attempt."""
        while self._items and not self._is_late():
            item = self._items[0]
            if isinstance(item, _Task):
                self._items.popleft()
                try:
                    item.answer.set_result(item.action())
                except BaseException as error:
                    item.answer.set_exception(error)
                    if not isinstance(error, BagError):
                        raise
                continue
            rest = iter(item.messages)
            try:
                if self._limits.max_size or self._limits.max_duration_ns:
                    self._write_splitting(rest)
                else:
                    self._writer.write(rest)
            finally:
                item.messages = list(rest)
            with self._condition:
                self._items.popleft()
                self._queued -= item.size

    def _write_splitting(self, messages: Iterable[Entry]) -> None:
        """Write message by message, and continue in a new file when a limit is reached."""
        writer, limits = self._writer, self._limits
        for message in messages:
            full = (limits.max_size and writer.file_size >= limits.max_size) or (
                limits.max_duration_ns and writer.file_duration_ns >= limits.max_duration_ns)
            try:
                if full and self._may_split():
                    writer.split()
            finally:
                # Also if splitting fails: the message then stays pending in the writer.
                writer.write((message,))

    def _begin_anew(self) -> None:
        if not self._writer.is_file_empty and self._may_split():
            self._writer.split()

    def _may_split(self) -> bool:
        """Return whether a new file may be opened now, and update the counts."""
        now = time.monotonic()
        self._files_left = min(
            float(FILE_BURST), self._files_left + (now - self._files_since) / FILE_SECONDS)
        self._files_since = now
        if self._files_left < 1.0:
            self._crowded += 1
            return False
        self._files_left -= 1.0
        return True

    def _is_late(self) -> bool:
        """Return whether the end has taken too long."""
        return time.monotonic() > self._deadline

    def _fail(self, error: OSError) -> None:
        """Record that writing has failed; it is tried again later."""
        known = self._error
        self._error = f'cannot write to {self._writer.folder}: {_reason(error)}'
        if not known:
            self._report(
                f'{self._error}; recording resumes in a new file when possible, up to '
                f'{self._limits.cache_size} bytes are buffered until then', True)
        self._writer.abandon()
        self._next_retry = time.monotonic() + RETRY_SECONDS

    def _retry(self) -> None:
        """Try to continue in a new file."""
        try:
            name = self._writer.reopen()
        except OSError as error:
            self._fail(error)
        else:
            self._error = ''
            self._report(f'recording continues in {name}', False)

    def _give_up(self) -> None:
        """Count the rest of the queue as lost, and fail its pending actions."""
        with self._condition:
            for item in self._items:
                if isinstance(item, _Batch):
                    self._lose(item.messages)
                elif isinstance(item, _Task):
                    item.answer.set_exception(BagError('the recording has ended'))
            self._items.clear()


#: Of the C library of GNU; others give memory back by themselves.
_trim: Callable[[int], object] = getattr(ctypes.CDLL(None), 'malloc_trim', lambda pad: None)


def _not_closed(error: OSError) -> str:
    """Return the message for a bag that could not be closed."""
    return f'the bag could not be closed properly: {_reason(error)}'


def _reason(error: OSError) -> str:
    """Return the system's words for an error."""
    return error.strerror or str(error)


def lost_by_topic(*counts: Mapping[str, int]) -> dict[str, int]:
    """Return the total losses by topic."""
    total = Counter[str]()
    for count in counts:
        total.update(count)
    return total


@dataclass
class RecordedTopic:
    """A recorded topic: its subscription and its publishers."""

    name: str
    type: str
    number: int  #: of the topic in the bag
    qos: Any  #: with which it is subscribed to
    offered: tuple[Qos, ...]  #: by its publishers
    publishers: int = 0  #: at the last look
    last: dict[bytes, int] = field(default_factory=dict)  #: sequence number by publisher
    latest: dict[bytes, int] = field(default_factory=dict)  #: reception in ns by publisher
    received: int = 0
    largest: int = 0  #: payload so far, in bytes
    missed: int = 0  #: gaps in the sequence numbers
    before: int = 0  #: sent by publishers before they were matched

    @property
    def latched(self) -> bool:
        """Return whether a publisher may send its last messages to late subscribers."""
        return any(x.durability == 'transient_local' for x in self.offered)

    def begin_anew(self) -> None:
        """Accept reception timestamps before the latest ones: the clock was set back."""
        self.latest.clear()

    def take(
            self, messages: Iterable[tuple[int, int, int, bytes, bytes]],
            at: Callable[[int], int] | None, *, paused: bool) -> tuple[list[Entry], int]:
        """Count gaps; return the messages to write, and the length of their payloads in bytes."""
        # A message has source and reception timestamp in ns, sequence number, publisher, payload.
        # at() converts system time to log time. Messages during a pause do not count as missed.
        batch: list[Entry] = []
        size, largest = 0, self.largest
        for source, received, sequence, publisher, data in messages:
            before = self.last.get(publisher)
            largest = max(largest, len(data))
            if before is not None and sequence <= before:
                continue  # already received by the previous subscription
            if before is not None and not paused:
                self.missed += sequence - before - 1
            elif not paused and not self.latched:
                # Volatile publishers count from 1, and send nothing to late subscribers.
                self.before += sequence - 1
            self.last[publisher] = sequence
            if paused:
                continue
            # Not every middleware provides reception timestamps. A message that had to be sent
            # again is received after its successors, which are delivered only then.
            stamp = max(received or time.time_ns(), self.latest.get(publisher, 0))
            self.latest[publisher] = stamp
            batch.append((self.number, stamp if at is None else at(stamp), source, sequence, data))
            size += len(data)
        self.received += len(batch)
        self.largest = largest
        return batch, size


def judge(
        status: Status, state: str, lost: int, *, flush_period: float, clocks: int = 0,
        clock_ignored: bool = False) -> tuple[int, str]:
    """Return the level and the sentence of a recorder's diagnostics; ``flush_period`` in s."""
    if status.error:
        return ERROR, status.error
    reasons = []
    if lost:
        reasons.append(f'{lost} messages lost')
    if status.behind > max(_BEHIND_SECONDS, _BEHIND_PERIODS * flush_period):
        reasons.append(f'writing is {status.behind:.1f} s behind')
    if status.crowded:
        reasons.append('the limits ask for more than one file per second: files become longer '
                       'than configured')
    text = ', '.join([state, *reasons])
    if clock_ignored or clocks > 1:
        return WARN, f'{text}; {clocks} publishers of /clock, the first one is followed'
    return (WARN if reasons else OK), text


def figures(
        status: Status, lost: Mapping[str, int], before: Mapping[str, int]) -> dict[str, str]:
    """Return the values of a recorder's diagnostics, by key; ``behind`` is in seconds."""
    return {
        'file': status.file,
        'written': str(sum(status.written.values())),
        'lost': str(sum(lost.values())),
        'sent_before': str(sum(before.values())),
        'queued_bytes': str(status.queued_bytes),
        'behind': f'{status.behind:.3f}',
        'files_refused': str(status.crowded),
        **{f'lost.{name}': str(count) for name, count in lost.items() if count},
        **{f'sent_before.{name}': str(count) for name, count in before.items() if count}}
