"""Merge the messages of several chunks in order of log time."""

from array import array
from collections.abc import Callable, Iterator
import heapq
from itertools import islice
from typing import NamedTuple, Protocol

from hmsa.bag import records
from hmsa.errors import BagError


class Message(NamedTuple):
    """A stored message: topic, times in ns, sequence number and payload."""

    topic: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


class AnyCursor(Protocol):
    """A position in messages; among equal log times, the smaller ``key`` comes first."""

    key: tuple[int, int]
    size: int  #: in memory

    def sort(self) -> None:
        """Sort the messages by log time; the sort is stable."""

    @property
    def left(self) -> bool:
        """Return whether there is a next message."""

    @property
    def time(self) -> int:
        """Return the log time of the next message."""

    def take(self, limit: int) -> Iterator[Message]:
        """Yield the next messages before a log time; the messages must be sorted."""


class Cursor:
    """
    A position in the messages of a chunk or run, initially in stored order.

    Only times and offsets are kept: the messages of a chunk could take ten times its size. Among
    equal log times, the smaller ``key`` comes first; ``problem`` describes damage.
    """

    def __init__(
            self, key: tuple[int, int], content: bytes,
            topic_of: Callable[[int], str | None], start: int, end: int) -> None:
        self.key = key
        self.content = content
        self.size = len(content)
        self.problem = ''
        self._names: dict[int, str | None] = {}
        self._times, self._places = array('Q'), array('Q')
        self._next = 0
        names, times, places = self._names, self._times, self._places
        unpack, prefix_size = records.MESSAGE_HEAD.unpack_from, records.PREFIX.size
        try:
            for opcode, begin, _ in records.split(content):
                if opcode == records.MESSAGE:
                    _, _, channel, _, time, _ = unpack(content, begin - prefix_size)
                    if channel not in names:
                        names[channel] = topic_of(channel)
                    if names[channel] is not None and start <= time < end:
                        times.append(time)
                        places.append(begin - prefix_size)
        except BagError as error:
            self.problem = str(error)

    def sort(self) -> None:
        """Sort the messages by log time; the sort is stable."""
        times = self._times
        # Usually they are sorted already.
        if any(later < earlier for earlier, later in zip(times, islice(times, 1, None),
                                                         strict=False)):
            order = sorted(range(len(times)), key=times.__getitem__)
            self._times = array('Q', (times[i] for i in order))
            self._places = array('Q', (self._places[i] for i in order))

    @property
    def left(self) -> bool:
        """Return whether there is a next message."""
        return self._next < len(self._times)

    @property
    def time(self) -> int:
        """Return the log time of the next message."""
        return self._times[self._next]

    def take(self, limit: int) -> Iterator[Message]:
        """Yield the next messages before a log time; the messages must be sorted."""
        unpack, head_size = records.MESSAGE_HEAD.unpack_from, records.MESSAGE_HEAD.size
        prefix_size = records.PREFIX.size
        content, names = self.content, self._names
        while self._next < len(self._times) and self._times[self._next] < limit:
            place = self._places[self._next]
            self._next += 1
            _, length, channel, sequence, log_time, publish_time = unpack(content, place)
            yield Message(
                names[channel] or '', log_time, publish_time, sequence,
                content[place + head_size:place + prefix_size + length])


def merge(cursors: list[AnyCursor], limit: int) -> Iterator[Message]:
    """Yield the messages of sorted chunks before a log time; equal times in written order."""
    heap = [(cursor.time, cursor.key, cursor) for cursor in cursors
            if cursor.left and cursor.time < limit]
    heapq.heapify(heap)
    while heap:
        _, key, cursor = heapq.heappop(heap)
        # Up to the next message of another chunk; the key decides between equal times.
        until = limit if not heap else min(limit, heap[0][0] + (key < heap[0][1]))
        yield from cursor.take(until)
        if cursor.left and cursor.time < limit:
            heapq.heappush(heap, (cursor.time, key, cursor))
