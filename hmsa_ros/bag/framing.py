"""
The records of an MCAP file being written, in their order, and the indexes at its end.

Record classes are the mcap package's. Its `Writer` makes five objects and twenty calls of a
message, which is most of the time that recording small messages takes; here messages are packed
a chunk at a time.
"""

from collections.abc import Iterable, Mapping, Sequence
import itertools
import os
import struct
from typing import Any
import zlib

import lz4.frame
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
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
import zstandard

from hmsa_ros.bag.records import MAGIC, MESSAGE, MESSAGE_FIXED, MESSAGE_HEAD

_INDEX_HEAD = struct.Struct('<BQHI')
_COMPRESS: Mapping[str, Any] = {
    '': lambda data: data, 'lz4': lz4.frame.compress, 'zstd': zstandard.compress}

#: A message: topic number, log and publish time in ns, sequence and payload.
Entry = tuple[int, int, int, int, bytes]


class Stream:
    """Keeps what is written until `commit`, which stores all of it or nothing."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self.stored = self.position = self.crc = 0
        self._pending: list[bytes] = []

    def write(self, data: bytes) -> None:
        """Keep data."""
        self._pending.append(data)
        self.position += len(data)

    def commit(self) -> None:
        """Store what is kept, or undo a part of it that was stored, and raise `OSError`."""
        data = b''.join(self._pending)
        self._pending.clear()
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self.descriptor, view):]
        except OSError:
            self.position = self.stored
            os.ftruncate(self.descriptor, self.stored)
            os.lseek(self.descriptor, self.stored, os.SEEK_SET)
            raise
        self.stored = self.position
        self.crc = zlib.crc32(data, self.crc)


class Framing:
    """
    Writes records to a stream; `OSError` leaves the file as it was before the call.

    ``compression`` is ``''``, ``'lz4'`` or ``'zstd'``. ``counts`` has the messages stored by
    channel less one; ``start`` and ``end`` are the lowest and highest log time stored.
    """

    def __init__(self, stream: Stream, library: str, compression: str, *, crc: bool) -> None:
        self._stream = stream
        self._compression = compression
        self._crc = crc
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._declared: list[McapRecord] = []
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self.counts: dict[int, int] = {}
        self.start, self.end = 2**64 - 1, 0
        stream.write(MAGIC + _packed([Header('ros2', library)]))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Announce a message type with the next chunk; return its number."""
        self._schemas.append(Schema(
            id=len(self._schemas) + 1, name=name, encoding=encoding, data=data))
        self._declared.append(self._schemas[-1])
        return len(self._schemas)

    def add_channel(self, topic: str, schema: int, metadata: dict[str, str]) -> None:
        """Announce a topic with the next chunk."""
        self._channels.append(Channel(
            id=len(self._channels) + 1, topic=topic, schema_id=schema, message_encoding='cdr',
            metadata=metadata))
        self._declared.append(self._channels[-1])

    def add_chunk(self, entries: Sequence[Entry]) -> None:
        """Store messages, the topic of each being its channel less one."""
        declared = _packed(self._declared)
        content, places = _messages(entries, len(declared))
        data = declared + content
        times = [entry[1] for entry in entries]
        stored = _COMPRESS[self._compression](data)
        chunk = Chunk(
            compression=self._compression, data=stored, message_start_time=min(times),
            message_end_time=max(times), uncompressed_size=len(data),
            uncompressed_crc=zlib.crc32(data) if self._crc else 0)
        offset = self._stream.position
        record = _packed([chunk])
        self._stream.write(record)
        after = offsets_at = self._stream.position
        offsets = {}
        for topic, pairs in places.items():
            offsets[topic + 1] = after
            index = struct.pack(f'<{len(pairs)}Q', *pairs)
            self._stream.write(_INDEX_HEAD.pack(
                Opcode.MESSAGE_INDEX, len(index) + 6, topic + 1, len(index)) + index)
            after = self._stream.position
        self._stream.commit()
        self._declared.clear()
        self._chunks.append(ChunkIndex(
            message_start_time=chunk.message_start_time,
            message_end_time=chunk.message_end_time, chunk_start_offset=offset,
            chunk_length=len(record), message_index_offsets=offsets,
            message_index_length=after - offsets_at, compression=self._compression,
            compressed_size=len(stored), uncompressed_size=len(data)))
        for topic, pairs in places.items():
            self.counts[topic] = self.counts.get(topic, 0) + len(pairs) // 2
        self.start = min(self.start, chunk.message_start_time)
        self.end = max(self.end, chunk.message_end_time)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Store a metadata record."""
        data = _packed([Metadata(name=name, metadata=dict(values))])
        offset = self._stream.position
        self._stream.write(data)
        self._stream.commit()
        self._metadata.append(MetadataIndex(offset=offset, length=len(data), name=name))

    def add_summary(self) -> None:
        """Store the summary and the end of the file."""
        stream = self._stream
        stream.write(_packed([DataEnd(stream.crc if self._crc else 0)]))
        begin = stream.position
        groups = [
            (Opcode.SCHEMA, _packed(self._schemas)), (Opcode.CHANNEL, _packed(self._channels)),
            (Opcode.STATISTICS, _packed([self._statistics()])),
            (Opcode.CHUNK_INDEX, _packed(self._chunks)),
            (Opcode.METADATA_INDEX, _packed(self._metadata))]
        starts = itertools.accumulate((len(data) for _, data in groups), initial=begin)
        offsets = _packed(
            SummaryOffset(group_opcode=code, group_start=start, group_length=len(data))
            for (code, data), start in zip(groups, starts, strict=False) if data)
        summary = b''.join(data for _, data in groups) + offsets
        footer = Footer(
            summary_start=begin, summary_offset_start=begin + len(summary) - len(offsets),
            summary_crc=0)
        if self._crc:
            # Of the summary and the footer's fields before it.
            footer.summary_crc = zlib.crc32(summary + _packed([footer])[:-4])
        stream.write(summary + _packed([footer]) + MAGIC)
        stream.commit()

    def _statistics(self) -> Statistics:
        count = sum(self.counts.values())
        return Statistics(
            attachment_count=0, channel_count=len(self._channels),
            channel_message_counts={topic + 1: x for topic, x in self.counts.items()},
            chunk_count=len(self._chunks), message_count=count,
            message_start_time=self.start if count else 0, message_end_time=self.end,
            metadata_count=len(self._metadata), schema_count=len(self._schemas))


def _packed(records: Iterable[McapRecord]) -> bytes:
    """Return records as bytes."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _messages(entries: Sequence[Entry], place: int) -> tuple[bytes, dict[int, list[int]]]:
    """Return messages as bytes that begin at a place, and by topic their times and places."""
    pack, head = MESSAGE_HEAD.pack, MESSAGE_HEAD.size
    parts: list[bytes] = []
    places: dict[int, list[int]] = {}
    for topic, log_time, publish_time, sequence, data in entries:
        length = len(data)
        parts += (pack(MESSAGE, length + MESSAGE_FIXED, topic + 1, sequence & 0xFFFFFFFF,
                       log_time, publish_time), data)
        try:
            places[topic] += (log_time, place)
        except KeyError:
            places[topic] = [log_time, place]
        place += head + length
    return b''.join(parts), places
