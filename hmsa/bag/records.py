"""
Parse MCAP records from untrusted files, and merge the messages of chunks by log time.

See https://mcap.dev/spec. Little endian; a record consists of its opcode (1 byte), the length of
its content (8 bytes) and the content. The classes of the mcap package parse the content; this
module checks lengths, and limits the memory of decompressed chunks.
"""

from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
import heapq
import io
from itertools import islice
import os
import struct
from typing import Any, NamedTuple, Protocol, TypeVar
import zlib

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from hmsa.bag import limits
from hmsa.errors import BagError

#: Begin and end of a file.
MAGIC = MCAP0_MAGIC
PREFIX = struct.Struct('<BQ')
# Opcode, length, channel, sequence, log time, publish time; the payload follows.
MESSAGE_HEAD = struct.Struct('<BQHIQQ')
#: A plain int, since comparing an enum for every message is slow.
MESSAGE = int(Opcode.MESSAGE)
MESSAGE_FIXED = MESSAGE_HEAD.size - PREFIX.size
#: Maximum size of a chunk's fields before its data: the name of the compression is short.
CHUNK_HEAD_SIZE = 64
_CHUNK_HEAD = struct.Struct('<QQQII')
_Record = TypeVar('_Record', bound=McapRecord)

_CLASSES: dict[int, type[Any]] = {
    Opcode.HEADER: Header, Opcode.FOOTER: Footer, Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel, Opcode.CHUNK_INDEX: ChunkIndex, Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata, Opcode.METADATA_INDEX: MetadataIndex, Opcode.DATA_END: DataEnd,
    Opcode.SUMMARY_OFFSET: SummaryOffset}


@dataclass(frozen=True, slots=True)
class MessageBlock:
    """A chunk, or a run of messages outside chunks, and its position in the file."""

    file: int  #: number of the file
    offset: int
    length: int
    size: int  #: of the content
    start: int  #: lowest log time
    end: int  #: highest log time
    compression: str = ''  #: ``''``, ``'lz4'`` or ``'zstd'``
    crc: int = 0  #: CRC-32 of the content; 0 for none

    @classmethod
    def of_chunk(cls, file: int, offset: int, head: bytes, length: int) -> 'MessageBlock':
        """Read the fields before the data of a chunk record of a length, or raise `BagError`."""
        try:
            start, end, size, crc, name = _CHUNK_HEAD.unpack_from(head)
            begin = _CHUNK_HEAD.size + name + 8
            compression = head[_CHUNK_HEAD.size:begin - 8].decode()
            stored, = struct.unpack_from('<Q', head, begin - 8)
        except (struct.error, UnicodeDecodeError) as error:
            raise BagError('a chunk record ends early') from error
        if begin + stored != length:
            raise BagError(
                f'a chunk record has {length} bytes: its header states {begin + stored}')
        return cls(
            file, offset + PREFIX.size + begin, stored, size, start, end, compression, crc)

    def content(self, descriptor: int) -> bytes:
        """Return the content, or raise `BagError` if it is damaged."""
        content = decompress(
            read_exactly(descriptor, self.length, self.offset), self.compression, self.size)
        if self.crc and zlib.crc32(content) != self.crc:
            raise BagError('a chunk is damaged (its CRC differs)')
        return content


class _Content(ReadDataStream):
    """The content of a record, read to its end only, with invalid UTF-8 escaped."""

    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data))
        self._size = len(data)

    def read(self, length: int) -> bytes:
        if self.count + length > self._size:
            raise EndOfFile
        return super().read(length)

    def read_prefixed_string(self) -> str:
        return self.read(self.read4()).decode('utf-8', 'backslashreplace')


def parse(kind: type[_Record], content: bytes) -> _Record:
    """Parse a record by the mcap package; raise `BagError` if it is damaged or too large."""
    what = kind.__name__.lower()
    if len(content) > limits.RECORD_SIZE:
        raise BagError(f'a {what} record is larger than {limits.RECORD_SIZE} bytes')
    stream = _Content(content)
    try:
        record: _Record = kind.read(stream)  # type: ignore[attr-defined]
    except (McapError, struct.error) as error:
        raise BagError(f'a {what} record ends early') from error
    if stream.count != len(content):
        raise BagError(f'a {what} record is longer than its content')
    return record


def parse_any(opcode: int, content: bytes) -> McapRecord | None:
    """Return the record, None if of unknown kind; see `parse`."""
    kind = _CLASSES.get(opcode)
    return None if kind is None else parse(kind, content)


def decompress(data: bytes, compression: str, size: int) -> bytes:
    """Return the ``size`` bytes of a chunk's content, or raise `BagError` if damaged."""
    if not compression:
        content = data
    elif compression == 'zstd':
        import zstandard
        try:
            # A frame may contain its size, which must be that of the chunk: decompression never
            # allocates more.
            if zstandard.frame_content_size(data) not in (size, -1):
                raise BagError('a chunk does not decompress to the size in its header')
            content = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        except zstandard.ZstdError as error:
            raise BagError(f'a chunk does not decompress: {error}') from error
    elif compression == 'lz4':
        import lz4.frame
        try:
            content = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        except RuntimeError as error:
            raise BagError(f'a chunk does not decompress: {error}') from error
    else:
        raise BagError(f'a chunk is compressed with {compression!r}: expected lz4 or zstd')
    if len(content) != size:
        raise BagError(f'a chunk has {len(content)} bytes of content: its header states {size}')
    return content


def split(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of each record's content; raise `BagError` if truncated."""
    offset, size = 0, len(content)
    prefix_size, unpack = PREFIX.size, PREFIX.unpack_from
    while offset < size:
        if offset + prefix_size > size:
            raise BagError('a record in a chunk ends early')
        opcode, length = unpack(content, offset)
        start = offset + prefix_size
        offset = start + length
        if offset > size or (opcode == MESSAGE and length < MESSAGE_FIXED):
            raise BagError('a record in a chunk ends early')
        yield opcode, start, offset


def read_exactly(descriptor: int, length: int, offset: int) -> bytes:
    """Return ``length`` bytes from an offset; raise `BagError` if the file has fewer."""
    data = os.pread(descriptor, length, offset)
    while len(data) < length:
        more = os.pread(descriptor, length - len(data), offset + len(data))
        if not more:
            raise BagError('the file has become shorter')
        data += more
    return data


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
        unpack, prefix_size = MESSAGE_HEAD.unpack_from, PREFIX.size
        try:
            for opcode, begin, _ in split(content):
                if opcode == MESSAGE:
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
        unpack, head_size = MESSAGE_HEAD.unpack_from, MESSAGE_HEAD.size
        prefix_size = PREFIX.size
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
