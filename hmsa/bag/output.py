"""
Write one MCAP file.

A chunk is written completely or not at all. Space for the chunk and the summary is reserved on the
disk beforehand, so that the file can be closed even if the disk is full.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
import errno
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

from hmsa import __version__
from hmsa.bag import metadata, qos
from hmsa.bag.metadata import BagTopic
from hmsa.bag.records import MAGIC, MESSAGE, MESSAGE_FIXED, MESSAGE_HEAD

LIBRARY = f'hmsa_ros {__version__}'
#: Name of the metadata record with the experiment.
EXPERIMENT = 'hmsa_ros'
#: Space is reserved in steps of this many bytes.
RESERVE_STEP = 256 * 1024
_INDEX_HEAD = struct.Struct('<BQHI')
_COMPRESS: Mapping[str, Any] = {
    '': lambda data: data, 'lz4': lz4.frame.compress, 'zstd': zstandard.compress}
#: Compression of each preset, and whether it has checksums. The names are those of rosbag2, and
#: lz4. rosbag2's fastwrite also omits chunks; here they stay, since `hmsa bag recover` needs them.
PRESETS: Mapping[str, tuple[str, bool]] = {
    'none': ('', True), 'fastwrite': ('', False), 'lz4': ('lz4', True),
    'zstd_fast': ('zstd', True), 'zstd_small': ('zstd', True)}

#: A message: topic number, log and publish time in ns, sequence and payload.
Entry = tuple[int, int, int, int, bytes]


class OutputFile:
    """
    One file of a bag; methods that write raise `OSError` if the disk does not accept all of it.

    ``topics`` is the list of the bag's topics, which may grow. ``counts`` contains the number of
    messages by topic, ``start`` and ``end`` the lowest and highest log time, ``size`` the bytes
    written (until `finish`, the file on disk is larger), ``message_size`` that of the
    messages, and ``notes_size`` that of the metadata records of the experiment.
    """

    def __init__(self, path: Path, preset: str, topics: Sequence[BagTopic]) -> None:
        self._descriptor = os.open(
            path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        self.path = path
        self.counts = Counter[int]()
        self.start, self.end = 2**64 - 1, 0
        self.size = self.message_size = self.notes_size = 0
        self._compression, self._has_crc = PRESETS[preset]
        self._topics = topics
        self._schemas: dict[str, Schema] = {}  # by message type
        self._channels: list[Channel] = []
        self._declared: list[McapRecord] = []  # schemas and channels for the next chunk
        # Packed, since a recording of a day has 300,000 of them.
        self._chunks, self._metadata = bytearray(), bytearray()
        self._chunk_count = self._metadata_count = 0
        self._noted: dict[str, str] = {}
        self._crc = 0
        # Bytes reserved on the disk, and those needed for the end of the file.
        self._room = self._end_size = self._notes_room = 0
        self._ending = False

    def write(self, entries: Sequence[Entry]) -> None:
        """Store messages as one chunk, preceded by the declarations of new topics."""
        self._declare()
        declared = _packed(self._declared)
        content, places = _messages(entries, len(declared))
        data = declared + content
        times = [entry[1] for entry in entries]
        chunk = Chunk(
            compression=self._compression, data=_COMPRESS[self._compression](data),
            message_start_time=min(times), message_end_time=max(times),
            uncompressed_size=len(data), uncompressed_crc=zlib.crc32(data) if self._has_crc else 0)
        parts = [_packed([chunk])]
        after = indexes_at = self.size + len(parts[0])
        offsets = {}
        for topic, pairs in places.items():
            offsets[topic + 1] = after
            index = struct.pack(f'<{len(pairs)}Q', *pairs)
            parts += _INDEX_HEAD.pack(
                Opcode.MESSAGE_INDEX, len(index) + 6, topic + 1, len(index)), index
            after += _INDEX_HEAD.size + len(index)
        chunk_index = ChunkIndex(
            message_start_time=chunk.message_start_time,
            message_end_time=chunk.message_end_time, chunk_start_offset=self.size,
            chunk_length=len(parts[0]), message_index_offsets=offsets,
            message_index_length=after - indexes_at, compression=self._compression,
            compressed_size=len(chunk.data), uncompressed_size=len(data))
        packed_index = _packed([chunk_index])
        self._add(b''.join(parts), len(packed_index))
        self._declared.clear()
        self._chunks += packed_index
        self._chunk_count += 1
        self.message_size += after - chunk_index.chunk_start_offset - len(declared)
        self.counts.update({topic: len(pairs) // 2 for topic, pairs in places.items()})
        self.start = min(self.start, chunk.message_start_time)
        self.end = max(self.end, chunk.message_end_time)

    def describe(self, serialized_metadata: str, notes: Mapping[str, str]) -> None:
        """Store the metadata that rosbag2 has at both ends of a file, and the experiment."""
        if not self.size:
            self._add(MAGIC + _packed([Header('ros2', LIBRARY)]))
        self._add_metadata('rosbag2', {'serialized_metadata': serialized_metadata})
        self.note(notes)

    def note(self, values: Mapping[str, str]) -> None:
        """Store new or changed values of the experiment only: viewers show each record."""
        new = {key: value for key, value in values.items() if self._noted.get(key) != value}
        if new:
            # All values are written again at the end, and twice to the metadata file.
            self._notes_room = 4 * sum(len(key) + len(value) for key, value in values.items())
            before = self.size
            self._add_metadata(EXPERIMENT, new)
            self.notes_size += self.size - before
            self._noted.update(new)

    def finish(
            self, serialized_metadata: str, notes: Mapping[str, str], *, fsync: bool) -> None:
        """Store the metadata and the summary in the reserved space, and close the file."""
        self._declare()
        self._ending = True
        self.describe(serialized_metadata, notes)
        count = self.counts.total()
        statistics = Statistics(
            attachment_count=0, channel_count=len(self._channels),
            channel_message_counts={topic + 1: x for topic, x in self.counts.items()},
            chunk_count=self._chunk_count, message_count=count,
            message_start_time=self.start if count else 0, message_end_time=self.end,
            metadata_count=self._metadata_count, schema_count=len(self._schemas))
        groups = [
            (Opcode.SCHEMA, _packed(self._schemas.values())),
            (Opcode.CHANNEL, _packed(self._channels)), (Opcode.STATISTICS, _packed([statistics])),
            (Opcode.CHUNK_INDEX, bytes(self._chunks)),
            (Opcode.METADATA_INDEX, bytes(self._metadata))]
        data_end = _packed([DataEnd(self._crc if self._has_crc else 0)])
        begin = self.size + len(data_end)
        starts = itertools.accumulate((len(data) for _, data in groups), initial=begin)
        offsets = _packed(
            SummaryOffset(group_opcode=code, group_start=start, group_length=len(data))
            for (code, data), start in zip(groups, starts, strict=False) if data)
        summary = b''.join(data for _, data in groups) + offsets
        footer = Footer(
            summary_start=begin, summary_offset_start=begin + len(summary) - len(offsets),
            summary_crc=0)
        if self._has_crc:
            # The CRC covers the summary and the preceding fields of the footer.
            footer.summary_crc = zlib.crc32(summary + _packed([footer])[:-4])
        self._add(data_end + summary + _packed([footer]) + MAGIC)
        os.ftruncate(self._descriptor, self.size)
        if fsync:
            self.sync()
        self.close()

    def sync(self) -> None:
        """Wait until all data are on the disk."""
        os.fsync(self._descriptor)

    def close(self) -> None:
        """Close the file as it is."""
        os.close(self._descriptor)

    def check_still_there(self) -> None:
        """Raise `FileNotFoundError` if the file was removed or replaced."""
        try:
            there = os.stat(self.path)
        except OSError as error:
            raise FileNotFoundError(
                error.errno, f'{self.path} is gone', str(self.path)) from error
        if not os.path.samestat(there, os.fstat(self._descriptor)):
            raise FileNotFoundError(2, f'{self.path} has been replaced', str(self.path))

    def summary(self) -> metadata.FileMetadata:
        """Return the entry of the file in the bag's metadata."""
        if not self.counts:
            return metadata.FileMetadata(self.path.name)
        return metadata.FileMetadata(
            self.path.name, self.start, self.end - self.start, self.counts.total())

    def _declare(self) -> None:
        """Declare new topics; they are stored with the next chunk and in the summary."""
        for topic in self._topics[len(self._channels):]:
            if topic.type not in self._schemas:
                self._schemas[topic.type] = Schema(
                    id=len(self._schemas) + 1, name=topic.type,
                    encoding=topic.definition_encoding, data=topic.definition.encode())
                self._declared.append(self._schemas[topic.type])
            self._channels.append(Channel(
                id=len(self._channels) + 1, topic=topic.name, message_encoding=topic.encoding,
                schema_id=self._schemas[topic.type].id, metadata={
                    'offered_qos_profiles': qos.to_yaml(topic.profiles),
                    'topic_type_hash': topic.type_hash}))
            self._declared.append(self._channels[-1])
        # They are repeated in the summary and the metadata.
        self._end_size += 3 * len(_packed(self._declared))

    def _add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Store a metadata record."""
        data = _packed([Metadata(name=name, metadata=dict(values))])
        index = MetadataIndex(offset=self.size, length=len(data), name=name)
        packed_index = _packed([index])
        self._add(data, len(packed_index))
        self._metadata += packed_index
        self._metadata_count += 1

    def _add(self, data: bytes, end_size: int = 0) -> None:
        """Store data completely or not at all, reserving ``end_size`` more bytes for the end."""
        if os.fstat(self._descriptor).st_size < self.size:
            # Otherwise the file would get a hole, and a summary of messages that it lost.
            raise OSError(errno.EIO, f'another process has shortened {self.path.name}')
        self._end_size += end_size
        needed = self.size + len(data) + self._end_size + self._notes_room + RESERVE_STEP // 2
        if needed > self._room and not self._ending:
            room = -(-needed // RESERVE_STEP) * RESERVE_STEP
            os.posix_fallocate(self._descriptor, 0, room)
            self._room = room
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self._descriptor, view):]
        except OSError:
            os.ftruncate(self._descriptor, self.size)
            os.lseek(self._descriptor, self.size, os.SEEK_SET)
            self._room = self.size
            raise
        self.size += len(data)
        self._crc = zlib.crc32(data, self._crc)


def _packed(records: Iterable[McapRecord]) -> bytes:
    """Return records as bytes."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _messages(entries: Sequence[Entry], place: int) -> tuple[bytes, dict[int, list[int]]]:
    """Return messages as bytes that start at a place, and their times and places by topic."""
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
