"""
One MCAP file being written.

A chunk is in the file whole or not at all, and room for the chunk and for the summary is taken
on the disk before, so that a full disk leaves a file that can still be closed.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
import itertools
import os
from pathlib import Path
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

from hmsa_ros import __version__
from hmsa_ros.bag import metadata, qos
from hmsa_ros.bag.records import MAGIC, MESSAGE, MESSAGE_FIXED, MESSAGE_HEAD
from hmsa_ros.bag.topics import Topic

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


LIBRARY = f'hmsa_ros {__version__}'
#: Name of the metadata record with the experiment.
EXPERIMENT = 'hmsa_ros'
#: Room is taken in steps of so many bytes.
RESERVE_STEP = 256 * 1024
# A message with its index entry; a channel in the indexes of a chunk; a chunk.
_MESSAGE_BYTES = MESSAGE_HEAD.size + 16
_CHANNEL_BYTES = 25
_CHUNK_BYTES = 256


@dataclass(frozen=True)
class Preset:
    """How chunks are stored: compression, and whether with checksums."""

    compression: str = ''
    crc: bool = True


# Names as rosbag2 has them, and lz4. With fastwrite rosbag2 leaves out chunks too; here they
# stay, since the recovery of a cut file goes by them.
PRESETS: Mapping[str, Preset] = {
    'none': Preset(),
    'fastwrite': Preset(crc=False),
    'lz4': Preset('lz4'),
    'zstd_fast': Preset('zstd'),
    'zstd_small': Preset('zstd'),
}


class OutputFile(Framing):
    """
    One file of a bag; its methods raise `OSError` if the disk does not take what they write.

    ``counts`` has the messages stored by topic, ``overhead`` the bytes of all else, ``noted`` what
    the metadata records say of the experiment, and ``notes_size`` their length.
    """

    def __init__(self, path: Path, number: int, preset: Preset) -> None:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        super().__init__(Stream(descriptor), LIBRARY, preset.compression, crc=preset.crc)
        self.path = path
        self.number = number
        self.overhead = self.notes_size = 0
        self.noted: dict[str, str] = {}
        self._types: dict[str, int] = {}
        self._ending = False
        self._end_size = self._notes_room = self._room = 0

    @property
    def size(self) -> int:
        """Return how many bytes are stored."""
        return self._stream.stored

    def reserve(self, size: int) -> None:
        """Take room for some bytes more and for the end of the file."""
        needed = self.size + size + self._end_size + self._notes_room + RESERVE_STEP // 2
        if needed > self._room:
            room = -(-needed // RESERVE_STEP) * RESERVE_STEP
            os.posix_fallocate(self._stream.descriptor, 0, room)
            self._room = room

    def declare(self, topic: Topic) -> None:
        """Announce the next topic; it is stored with the next chunk and in the summary."""
        data = topic.definition.encode()
        values = {
            'offered_qos_profiles': qos.to_yaml(topic.profiles),
            'topic_type_hash': topic.type_hash}
        size = len(topic.name) * 4 + sum(map(len, values.values())) + 100
        if topic.type not in self._types:
            size += len(data) + len(topic.type) * 4
        # In a chunk, in the summary, and in the metadata.
        self._end_size += 4 * size
        self.reserve(0)
        self.overhead += size
        if topic.type not in self._types:
            self._types[topic.type] = self.add_schema(
                topic.type, topic.definition_encoding, data)
        self.add_channel(topic.name, self._types[topic.type], values)

    def write(self, entries: Sequence[Entry], size: int) -> None:
        """Store messages with ``size`` bytes of payload as one chunk."""
        index = _CHUNK_BYTES + _CHANNEL_BYTES * len({entry[0] for entry in entries})
        content = size + _MESSAGE_BYTES * len(entries) + self.overhead
        # What cannot be compressed becomes a little longer.
        self.reserve(content + content // 128 + 2 * index)
        self._end_size += index
        self.add_chunk(entries)

    def describe(self, serialized_metadata: str, notes: Mapping[str, str]) -> None:
        """Store the record that rosbag2 has at both ends of a file, and the experiment."""
        self._store('rosbag2', {'serialized_metadata': serialized_metadata})
        self.note(notes)

    def note(self, values: Mapping[str, str]) -> None:
        """Store what of the experiment the file does not say yet: viewers show each record."""
        new = {key: value for key, value in values.items() if self.noted.get(key) != value}
        if new:
            # All of it comes once more at the end, and twice in the metadata file.
            self._notes_room = 4 * sum(len(key) + len(value) for key, value in values.items())
            self.notes_size += self._store(EXPERIMENT, new)
            self.noted.update(new)

    def _store(self, name: str, values: Mapping[str, str]) -> int:
        """Store a metadata record and return its length."""
        if not self._ending:
            self.reserve(100 + sum(
                4 * (len(key) + len(value)) + 8 for key, value in values.items()))
        self._end_size += len(name) + 50
        before = self.size
        self.add_metadata(name, values)
        self.overhead += self.size - before
        return self.size - before

    def finish(
            self, serialized_metadata: str, notes: Mapping[str, str], *, fsync: bool) -> None:
        """Store the metadata and the summary in the room taken, and close the file."""
        self._ending = True
        self.describe(serialized_metadata, notes)
        self.add_summary()
        os.ftruncate(self._stream.descriptor, self.size)
        if fsync:
            self.sync()
        self.close()

    def sync(self) -> None:
        """Wait until what is stored is on the disk."""
        os.fsync(self._stream.descriptor)

    def close(self) -> None:
        """Close the file as it is."""
        os.close(self._stream.descriptor)

    def check_still_there(self) -> None:
        """Raise `FileNotFoundError` if the file was removed: what is written is lost."""
        try:
            there = os.stat(self.path)
        except OSError as error:
            raise FileNotFoundError(
                error.errno, f'{self.path} is gone', str(self.path)) from error
        if not os.path.samestat(there, os.fstat(self._stream.descriptor)):
            raise FileNotFoundError(2, f'{self.path} has been replaced', str(self.path))

    def summary(self) -> metadata.FileMetadata:
        """Return what the bag's metadata say of the file."""
        if not self.counts:
            return metadata.FileMetadata(self.path.name)
        return metadata.FileMetadata(
            self.path.name, self.start, self.end - self.start, sum(self.counts.values()))
