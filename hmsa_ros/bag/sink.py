"""Where recorded messages go: written, split into files, or kept for a snapshot."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
import time

from hmsa_ros.bag.output import Entry
from hmsa_ros.bag.writer import BagWriter, MIN_FILE_SIZE
from hmsa_ros.errors import BadInputError, BagError

#: New files that may follow each other at once, and then one in so many seconds: each costs
#: declarations, an index, and waiting for the disk.
FILE_BURST = 10
FILE_SECONDS = 1.0


@dataclass(frozen=True)
class Limits:
    """When to flush, when to split and how much to keep in memory."""

    flush_period: float = 0.5  #: s after which the operating system has a message at the latest
    max_size: int = 0  #: bytes at which a file is split; 0 for never, else at least 1024
    max_duration_ns: int = 0  #: time span at which a file is split; 0 for never
    #: bytes of queued messages at which new ones are counted as lost
    cache_size: int = 100 * 2**20
    snapshot_ns: int = 0  #: above 0, messages are kept for so long, written for a snapshot

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


class _Pace:
    """Allows some new files at once, and then one after the other."""

    def __init__(self) -> None:
        self._left = float(FILE_BURST)
        self._last = time.monotonic()
        self.refused = 0

    def allows(self) -> bool:
        """Return whether a new file may be begun, and take note if so."""
        now = time.monotonic()
        self._left = min(float(FILE_BURST), self._left + (now - self._last) / FILE_SECONDS)
        self._last = now
        if self._left < 1.0:
            self.refused += 1
            return False
        self._left -= 1.0
        return True


class Sink:
    """Writes messages, splits them into files, or keeps them for a snapshot."""

    def __init__(
            self, writer: BagWriter, limits: Limits, release: Callable[[int], None]) -> None:
        self._writer = writer
        self._limits = limits
        self._release = release
        self._ring: deque[tuple[list[Entry], int]] = deque()
        self.pace = _Pace()

    def put(self, messages: Iterator[Entry], size: int, queued: int) -> None:
        """Take messages that use ``size`` of the ``queued`` bytes."""
        if self._limits.snapshot_ns:
            self._keep(list(messages), size, queued)
            return
        if self._limits.max_size or self._limits.max_duration_ns:
            self._write_splitting(messages)
        else:
            self._writer.write(messages)
        self._release(size)

    def _write_splitting(self, messages: Iterator[Entry]) -> None:
        """Write one message after the other, with a new file where a limit is reached."""
        writer, limits = self._writer, self._limits
        for message in messages:
            full = (limits.max_size and writer.file_size >= limits.max_size) or (
                limits.max_duration_ns and writer.file_duration_ns >= limits.max_duration_ns)
            if full and self.pace.allows():
                writer.split()
            writer.write((message,))

    def _keep(self, messages: list[Entry], size: int, queued: int) -> None:
        """Keep messages in memory for a snapshot, the oldest giving way."""
        self._ring.append((messages, size))
        newest = messages[-1][1]
        while self._ring and (
                self._ring[0][0][-1][1] < newest - self._limits.snapshot_ns
                or queued > self._limits.cache_size * 9 // 10):
            given_back = self._ring.popleft()[1]
            queued -= given_back
            self._release(given_back)

    def snapshot(self) -> str:
        """Write what is kept, and say what; raise `BagError` if every message is recorded."""
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

    def begin_anew(self) -> str:
        """Go on in a new file, without what is kept for a snapshot."""
        while self._ring:
            self._release(self._ring.popleft()[1])
        if self._writer.is_file_empty or not self.pace.allows():
            return self._writer.file_name
        return self._writer.split()
