"""
Writing a bag: a folder of MCAP files and ``metadata.yaml``, as rosbag2 (Jazzy) lays it out.

`BagWriter` keeps what has been written readable at every moment: each flush ends a chunk and
hands it to the operating system, ``metadata.yaml`` exists from the start, and a write that fails
half way is undone. Message payloads are stored as given.
"""

from collections.abc import Iterable, Mapping, Sequence
import contextlib
from dataclasses import dataclass, field
import errno
import itertools
import os
from pathlib import Path
import struct
from types import TracebackType
from typing import NamedTuple
import zlib

from hmsa_ros import __version__
from hmsa_ros.bag import metadata, qos, records
from hmsa_ros.errors import BadInputError, BagError

LIBRARY = f'hmsa_ros {__version__}'
# Takes up space that is given back when the disk is full, so that the file can still get its
# summary and the bag its metadata.
RESERVE = '.reserve'
_RESERVE_STEP = 256 * 1024
# Metadata records that a file may have in any case.
_NOTES_SIZE = 2**20
# Name of the metadata record with the experiment.
EXPERIMENT = 'hmsa_ros'
MIN_FILE_SIZE = 1024
MAX_CHANNELS = 2**16 - 1


@dataclass(frozen=True)
class Preset:
    """How chunks are stored: compression (``''``, lz4, zstd), its level, and whether with CRC."""

    compression: str
    level: int = 0
    crc: bool = True


# Names as rosbag2 has them, and lz4. With fastwrite rosbag2 leaves out chunks too; here they
# stay, since the recovery of a cut file goes by them.
PRESETS: Mapping[str, Preset] = {
    'none': Preset(''),
    'fastwrite': Preset('', crc=False),
    'lz4': Preset('lz4'),
    'zstd_fast': Preset('zstd', 1),
    'zstd_small': Preset('zstd', 9),
}


@dataclass(frozen=True)
class Topic:
    """
    A topic to be written.

    Attributes
    ----------
    name, type : str
        For example ``'/joint_states'`` and ``'sensor_msgs/msg/JointState'``.
    definition : str
        Message definition with its dependencies; empty if not known.
    definition_encoding : str
        ``'ros2msg'`` or ``'ros2idl'``; empty if not known.
    profiles : tuple of hmsa_ros.bag.qos.Qos
        What the publishers offer.
    type_hash : str
        RIHS01 hash, empty if not known.

    """

    name: str
    type: str
    definition: str = ''
    definition_encoding: str = 'ros2msg'
    profiles: tuple[qos.Qos, ...] = ()
    type_hash: str = ''

    def __post_init__(self) -> None:
        if not self.name:
            raise BadInputError('a topic has an empty name: expected a name such as /stretch')
        if not self.type:
            raise BadInputError(f'topic {self.name} has an empty type: expected a message type')


class Entry(NamedTuple):
    """A message to be written: topic number, stamps in nanoseconds, sequence and payload."""

    topic: int
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


@dataclass
class _Chunk:
    """Messages that are not yet in the file."""

    parts: list[bytes] = field(default_factory=list)
    index: dict[int, list[int]] = field(default_factory=dict)
    size: int = 0
    start: int = 2**64 - 1
    end: int = 0
    count: int = 0


@dataclass
class _File:
    """The file being written, and what its summary will say."""

    descriptor: int
    name: str
    number: int
    offset: int = 0
    schemas: list[records.Schema] = field(default_factory=list)
    channels: list[records.Channel] = field(default_factory=list)
    chunk_indexes: list[bytes] = field(default_factory=list)
    metadata_indexes: list[bytes] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    start: int = 2**64 - 1
    end: int = 0
    index_size: int = 0
    # What the metadata records in it say of the experiment, and how long they are.
    noted: dict[str, str] = field(default_factory=dict)
    notes_size: int = 0


class BagWriter:
    """
    Writes messages to a new bag.

    Parameters
    ----------
    folder : path
        Folder of the bag; must not exist.
    preset : str
        Name in `PRESETS`.
    chunk_size : int
        Length in bytes at which a chunk is closed.
    custom_data : mapping of str to str
        Stored in ``metadata.yaml`` and in a metadata record; may be added to until the end.
    ros_distro : str
        Stored in ``metadata.yaml``.
    fsync : bool
        Whether each flush waits until the data are on the disk.

    Attributes
    ----------
    folder : pathlib.Path
        Folder of the bag.
    custom_data : dict of str to str
        See `note`.
    dropped : dict of str to int
        By topic, messages that were given to `write` and are not in the bag: those that could
        not be written by the end, and those in a file that was removed under the writer.

    Raises
    ------
    BadInputError
        If the folder exists, cannot be made, or an option is out of range.

    Notes
    -----
    The writer does not split by itself: `file_size` and `file_duration_ns` tell its user when.

    """

    def __init__(
            self, folder: str | os.PathLike[str], *, preset: str = 'none',
            chunk_size: int = 768 * 1024, custom_data: Mapping[str, str] | None = None,
            ros_distro: str = 'jazzy', fsync: bool = False) -> None:
        if preset not in PRESETS:
            raise BadInputError(
                f'storage preset is {preset!r}: expected one of {", ".join(PRESETS)}')
        if chunk_size < 1:
            raise BadInputError(f'chunk size is {chunk_size}: expected at least 1 byte')
        self.folder = Path(folder)
        self.custom_data = dict(custom_data or {})
        self._preset = PRESETS[preset]
        self._chunk_size = chunk_size
        self._ros_distro = ros_distro
        self._fsync = fsync
        self._topics: list[Topic] = []
        self._files: list[metadata.FileMetadata] = []
        self._counts: dict[int, int] = {}
        self._chunk = _Chunk()
        self._file: _File | None = None
        self._next_number = 0
        self._reserved = 0
        self._closed = False
        self.dropped: dict[str, int] = {}
        try:
            self.folder.mkdir(parents=True)
        except FileExistsError:
            raise BadInputError(
                f'{self.folder} exists: expected the name of a new bag; choose another name '
                'or remove it') from None
        except OSError as error:
            raise BadInputError(
                f'{self.folder} cannot be made ({error.strerror}): expected a folder that can '
                'be written to') from error
        try:
            self._open()
        except OSError as error:
            raise BadInputError(
                f'{self.folder} cannot be written to ({error.strerror}): expected a folder '
                'with space that can be written to') from error

    def __enter__(self) -> 'BagWriter':
        return self

    def __exit__(
            self, kind: type[BaseException] | None, error: BaseException | None,
            traceback: TracebackType | None) -> None:
        self.close()

    # What is asked for -----------------------------------------------------------------------

    @property
    def is_open(self) -> bool:
        """Return whether there is a file to write to."""
        return self._file is not None

    @property
    def file_name(self) -> str:
        """Return the name of the file being written, empty if none is."""
        return self._file.name if self._file else ''

    @property
    def file_size(self) -> int:
        """Return the size of the file being written with what is not yet flushed, in bytes."""
        return self._file.offset + self._chunk.size if self._file else 0

    @property
    def file_duration_ns(self) -> int:
        """Return the time between the first and the last message of the file, in ns."""
        if self._file is None:
            return 0
        return max(0, max(self._file.end, self._chunk.end)
                   - min(self._file.start, self._chunk.start))

    @property
    def message_count(self) -> int:
        """Return how many messages are in the files, those not yet flushed left out."""
        return sum(self._counts.values())

    @property
    def is_file_empty(self) -> bool:
        """Return whether the file being written has no message yet."""
        return not self._chunk.count and (self._file is None or not self._file.counts)

    @property
    def pending_count(self) -> int:
        """Return how many messages wait for the next flush."""
        return self._chunk.count

    def topic_counts(self) -> dict[str, int]:
        """
        Return the number of messages written.

        Returns
        -------
        dict of str to int
            By topic.

        """
        return {topic.name: self._counts.get(number, 0)
                for number, topic in enumerate(self._topics)}

    # Writing ---------------------------------------------------------------------------------

    def add_topic(self, topic: Topic) -> int:
        """
        Announce a topic and return its number.

        Parameters
        ----------
        topic : Topic
            What will be written; the same topic again with new profiles replaces them in
            ``metadata.yaml`` and in the next file.

        Returns
        -------
        int
            Number for `Entry.topic`.

        Raises
        ------
        BagError
            If there are too many topics.
        OSError
            If it cannot be written.

        """
        for number, known in enumerate(self._topics):
            if known.name == topic.name and known.type == topic.type:
                self._topics[number] = topic
                return number
        if len(self._topics) >= MAX_CHANNELS:
            raise BagError(f'a bag cannot have more than {MAX_CHANNELS} topics')
        self._topics.append(topic)
        if self._file is not None:
            self._append(self._declare(self._file, topic))
        return len(self._topics) - 1

    def write(self, entries: Iterable[tuple[int, int, int, int, bytes]]) -> None:
        """
        Add messages; full chunks go to the file.

        Parameters
        ----------
        entries : iterable of tuple
            As `Entry`, in any order of stamps.

        Raises
        ------
        OSError
            If a chunk cannot be written. The file is then as it was before, the messages taken
            from ``entries`` so far wait in memory for `flush` or `reopen`, and the rest can
            still be taken if ``entries`` is an iterator.

        """
        chunk = self._chunk
        pack = records.MESSAGE_HEAD.pack
        head_size = records.MESSAGE_HEAD.size
        fixed = records.MESSAGE_FIXED
        for topic, log_time, publish_time, sequence, data in entries:
            length = len(data)
            index = chunk.index.get(topic)
            if index is None:
                index = chunk.index[topic] = []
            index += log_time, chunk.size
            chunk.parts += pack(
                records.MESSAGE, fixed + length, topic + 1, sequence & 0xFFFFFFFF, log_time,
                publish_time), data
            chunk.size += head_size + length
            chunk.count += 1
            chunk.start = min(chunk.start, log_time)
            chunk.end = max(chunk.end, log_time)
            if chunk.size >= self._chunk_size:
                self._write_chunk()
                chunk = self._chunk

    def note(self, values: Mapping[str, str]) -> None:
        """
        Add to the custom data, in ``metadata.yaml`` and in the file.

        In the file they come at the end in any case, and at once as long as such records are a
        small part of it.

        Parameters
        ----------
        values : mapping of str to str
            Replace those of the same key.

        Raises
        ------
        OSError
            If it cannot be written; it is then tried again when the file is closed.

        """
        self.custom_data.update(values)
        file = self._file
        if file is None:
            return
        # What changes all the time would be more than the messages are.
        if file.notes_size <= max(_NOTES_SIZE, file.offset // 16):
            self._write_notes(file)
        metadata.write(self.folder, self._metadata())

    def flush(self) -> None:
        """
        Hand everything to the operating system, so that the end of this process loses nothing.

        Raises
        ------
        OSError
            If it cannot be written, or the file is no longer in its folder.

        """
        self._write_chunk()
        if self._file is None:
            return
        self._check_still_there(self._file)
        if self._fsync:
            os.fsync(self._file.descriptor)

    def split(self) -> str:
        """
        Close the file and go on in a new one.

        Returns
        -------
        str
            Name of the new file.

        Raises
        ------
        OSError
            If it cannot be written.

        """
        self._write_chunk()
        self._finish_file()
        return self._open()

    def reopen(self) -> str:
        """
        Give up the file, closing it as well as can be done, and go on in a new one.

        For use after an `OSError`, when writing may be possible again.

        Returns
        -------
        str
            Name of the new file.

        Raises
        ------
        OSError
            If it still cannot be written.

        """
        self.abandon()
        self.folder.mkdir(parents=True, exist_ok=True)
        # Not until what waits will fit: every try that fails later would leave a file behind.
        disk = os.statvfs(self.folder)
        if disk.f_bavail * disk.f_frsize < self._chunk.size * 5 // 4 + 2 * _RESERVE_STEP:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._open()

    def drop_pending(self) -> None:
        """Forget the messages that wait for the next flush, counting them in `dropped`."""
        self._lose({topic: len(index) // 2 for topic, index in self._chunk.index.items()})
        self._chunk = _Chunk()

    def abandon(self) -> None:
        """Give up the file after an `OSError`, closing it as well as can be done."""
        if self._file is None:
            return
        self._give_back_reserve()
        if not self._file.counts:
            self._discard(self._file)
            return
        try:
            self._check_still_there(self._file)
        except OSError:
            self._lose(self._file.counts, written=True)
            os.close(self._file.descriptor)
            self._file = None
            return
        try:
            self._finish_file()
        except OSError:
            # The summary did not fit either: the messages are there, a reader that needs the
            # summary gets it from `hmsa bag recover`.
            if self._file is not None:
                self._forget_file(self._file)

    def _discard(self, file: _File) -> None:
        """Remove a file without messages."""
        os.close(file.descriptor)
        self._file = None
        self._next_number = file.number
        with contextlib.suppress(OSError):
            (self.folder / file.name).unlink()

    def _reserve(self, size: int) -> None:
        """Take up space on the disk for the end of the file."""
        if size <= self._reserved:
            return
        size = -(-size // _RESERVE_STEP) * _RESERVE_STEP
        descriptor = os.open(
            self.folder / RESERVE, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            os.posix_fallocate(descriptor, 0, size)
        finally:
            os.close(descriptor)
        self._reserved = size

    def _give_back_reserve(self) -> None:
        """Give the space back."""
        self._reserved = 0
        with contextlib.suppress(OSError):
            (self.folder / RESERVE).unlink()

    def close(self) -> None:
        """
        Write what is left and close the bag; closing again does nothing.

        Raises
        ------
        OSError
            If it cannot be written; what was written before stays readable.

        """
        if self._closed:
            return
        self._closed = True
        try:
            self._write_chunk()
            self._finish_file()
        finally:
            self.drop_pending()
            self.abandon()
            self._give_back_reserve()
            if self.folder.is_dir():
                metadata.write(self.folder, self._metadata())

    # Inside ----------------------------------------------------------------------------------

    def _append(self, data: bytes) -> int:
        """Append to the file, all or nothing; return where it begins."""
        file = self._file
        if file is None:
            raise OSError('no file is open')
        offset = file.offset
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(file.descriptor, view):]
        except OSError:
            os.ftruncate(file.descriptor, offset)
            os.lseek(file.descriptor, offset, os.SEEK_SET)
            raise
        file.offset += len(data)
        return offset

    def _open(self) -> str:
        """Open the next file and write what every file begins with."""
        while True:
            name = f'{self.folder.name}_{self._next_number}.mcap'
            number = self._next_number
            self._next_number += 1
            try:
                descriptor = os.open(
                    self.folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC,
                    0o666)
                break
            except FileExistsError:
                continue
        file = self._file = _File(descriptor, name, number)
        try:
            self._append(records.MAGIC + records.header('ros2', LIBRARY))
            self._write_metadata_records(file)
            self._append(b''.join(self._declare(file, topic) for topic in self._topics))
            metadata.write(self.folder, self._metadata())
            self._reserve(_RESERVE_STEP)
        except OSError:
            self._give_back_reserve()
            self._discard(file)
            raise
        return name

    def _declare(self, file: _File, topic: Topic) -> bytes:
        """Return the records that announce a topic and note them for the summary."""
        data = b''
        schema = next((schema for schema in file.schemas if schema.name == topic.type), None)
        if schema is None:
            schema = records.Schema(
                len(file.schemas) + 1, topic.type, topic.definition_encoding,
                topic.definition.encode())
            file.schemas.append(schema)
            data = records.schema(schema)
        channel = records.Channel(
            len(file.channels) + 1, schema.id, topic.name, 'cdr', {
                'offered_qos_profiles': qos.to_yaml(topic.profiles),
                'topic_type_hash': topic.type_hash})
        file.channels.append(channel)
        return data + records.channel(channel)

    def _write_metadata_records(self, file: _File) -> None:
        """Write the record that rosbag2 has at both ends of a file, and the experiment."""
        self._write_metadata(file, 'rosbag2', {'serialized_metadata': metadata.to_yaml(
            self._metadata(only_file=file), outer_key=False)})
        self._write_notes(file)

    def _write_notes(self, file: _File) -> None:
        """Write what of the experiment the file does not tell yet: viewers show each record."""
        values = {'version': __version__, **self.custom_data}
        new = {key: value for key, value in values.items() if file.noted.get(key) != value}
        if new:
            file.notes_size += self._write_metadata(file, EXPERIMENT, new)
            file.noted.update(new)

    def _write_metadata(self, file: _File, name: str, values: Mapping[str, str]) -> int:
        """Write a metadata record and return its length."""
        data = records.metadata(name, values)
        offset = self._append(data)
        file.metadata_indexes.append(records.metadata_index(offset, len(data), name))
        return len(data)

    def _write_chunk(self) -> None:
        """Append the chunk in progress and its message indexes."""
        chunk = self._chunk
        if not chunk.count:
            return
        if self._file is None:
            raise OSError('no file is open')
        content = b''.join(chunk.parts)
        preset = self._preset
        packed = records.compress(content, preset.compression, preset.level)
        record = records.chunk_head(
            chunk.start, chunk.end, len(content), zlib.crc32(content) if preset.crc else 0,
            preset.compression, len(packed)) + packed
        offsets, indexes, position = [], [], len(record)
        for topic, index in chunk.index.items():
            data = records.record(records.MESSAGE_INDEX, struct.pack(
                f'<HI{len(index)}Q', topic + 1, 8 * len(index), *index))
            offsets.append((topic + 1, position))
            indexes.append(data)
            position += len(data)
        start = self._append(b''.join([record, *indexes]))
        self._chunk = _Chunk()
        file = self._file
        file.chunk_indexes.append(records.record(records.CHUNK_INDEX, b''.join((
            struct.pack('<QQQQI', chunk.start, chunk.end, start, len(record),
                        10 * len(offsets)),
            *(struct.pack('<HQ', channel, start + offset) for channel, offset in offsets),
            struct.pack('<Q', position - len(record)),
            records.text(preset.compression),
            struct.pack('<QQ', len(packed), len(content))))))
        file.index_size += len(file.chunk_indexes[-1])
        file.start = min(file.start, chunk.start)
        file.end = max(file.end, chunk.end)
        for topic, index in chunk.index.items():
            file.counts[topic] = file.counts.get(topic, 0) + len(index) // 2
            self._counts[topic] = self._counts.get(topic, 0) + len(index) // 2
        # Twice the custom data and the list of topics, and the index.
        self._reserve(file.index_size + _RESERVE_STEP // 2)

    def _lose(self, counts: Mapping[int, int], *, written: bool = False) -> None:
        """Count messages that are not in the bag after all."""
        for topic, count in counts.items():
            name = self._topics[topic].name
            self.dropped[name] = self.dropped.get(name, 0) + count
            if written:
                self._counts[topic] -= count

    def _check_still_there(self, file: _File) -> None:
        """Refuse to go on in a file that was removed: what is written there is lost."""
        path = self.folder / file.name
        try:
            there = os.stat(path)
        except OSError as error:
            raise FileNotFoundError(
                error.errno, f'{path} is gone', str(path)) from error
        if not os.path.samestat(there, os.fstat(file.descriptor)):
            raise FileNotFoundError(2, f'{path} has been replaced', str(path))

    def _finish_file(self) -> None:
        """Write metadata and summary, close the file and bring ``metadata.yaml`` up to date."""
        file = self._file
        if file is None:
            return
        self._check_still_there(file)
        length, indexes = file.offset, len(file.metadata_indexes)
        try:
            self._write_metadata_records(file)
            self._append(self._summary(file))
        except OSError:
            os.ftruncate(file.descriptor, length)
            os.lseek(file.descriptor, length, os.SEEK_SET)
            file.offset = length
            del file.metadata_indexes[indexes:]
            raise
        if self._fsync:
            os.fsync(file.descriptor)
        self._forget_file(file)
        metadata.write(self.folder, self._metadata())

    def _forget_file(self, file: _File) -> None:
        """Close the file and note it among the files written."""
        os.close(file.descriptor)
        self._files.append(self._file_metadata(file))
        self._file = None

    def _summary(self, file: _File) -> bytes:
        """Return everything from the end of the data to the end of the file."""
        end = records.data_end()
        start = file.offset + len(end)
        statistics = records.record(records.STATISTICS, struct.pack(
            '<QHIIIIQQI', sum(file.counts.values()), len(file.schemas), len(file.channels), 0,
            len(file.metadata_indexes), len(file.chunk_indexes),
            file.start if file.counts else 0, file.end, 10 * len(file.counts))
            + b''.join(struct.pack('<HQ', topic + 1, count)
                       for topic, count in file.counts.items()))
        groups: Sequence[tuple[int, list[bytes]]] = (
            (records.SCHEMA, [records.schema(schema) for schema in file.schemas]),
            (records.CHANNEL, [records.channel(channel) for channel in file.channels]),
            (records.STATISTICS, [statistics]),
            (records.CHUNK_INDEX, file.chunk_indexes),
            (records.METADATA_INDEX, file.metadata_indexes))
        summary, offsets = b'', b''
        for opcode, group in groups:
            data = b''.join(group)
            if data:
                offsets += records.summary_offset(opcode, start + len(summary), len(data))
                summary += data
        offsets_start = start + len(summary)
        summary += offsets
        return (end + summary + records.footer(start, offsets_start, summary) + records.MAGIC)

    def _file_metadata(self, file: _File) -> metadata.FileMetadata:
        """Return what the metadata say of the file being written."""
        if not file.counts:
            return metadata.FileMetadata(file.name)
        return metadata.FileMetadata(
            file.name, file.start, file.end - file.start, sum(file.counts.values()))

    def _metadata(self, only_file: _File | None = None) -> metadata.BagMetadata:
        """Return the metadata of the bag, or of one file for the record inside it."""
        if only_file is None:
            files = [*self._files, *([self._file_metadata(self._file)] if self._file else [])]
            counts = self._counts
        else:
            files = [self._file_metadata(only_file)]
            counts = only_file.counts
        filled = [file for file in files if file.message_count]
        start = min((file.start_ns for file in filled), default=metadata.NO_TIME)
        end = max((file.start_ns + file.duration_ns for file in filled), default=start)
        return metadata.BagMetadata(
            start, end - start, sum(file.message_count for file in files),
            tuple(metadata.TopicMetadata(
                topic.name, topic.type, 'cdr', topic.profiles, topic.type_hash,
                counts.get(number, 0)) for number, topic in enumerate(self._topics)),
            tuple(files), dict(self.custom_data), self._ros_distro)


def parse_custom_data(pairs: Iterable[str]) -> dict[str, str]:
    """
    Read ``key=value`` pairs.

    Parameters
    ----------
    pairs : iterable of str
        For example ``('actuator=A3', 'operator=Kim')``; empty strings are passed over.

    Returns
    -------
    dict of str to str
        In the order given.

    Raises
    ------
    BadInputError
        If one has no ``=`` or no key, or a key comes twice.

    """
    values: dict[str, str] = {}
    for pair in itertools.filterfalse(lambda text: not text, pairs):
        key, equals, value = pair.partition('=')
        if not equals or not key.strip():
            raise BadInputError(f'custom data is {pair!r}: expected key=value')
        if key.strip() in values:
            raise BadInputError(f'custom data has the key {key.strip()!r} twice: expected once')
        values[key.strip()] = value
    return values
