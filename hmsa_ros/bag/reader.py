"""
Reading a bag: a folder or a single ``.mcap`` file, written here or by rosbag2.

For analysis without ROS there is one function::

    read_messages(path, topics=None, *, start=None, end=None)
        -> iterator of DecodedMessage(topic, log_time_ns, publish_time_ns, message)

in order of log time over all files of the bag, messages of equal stamp in the order they were
written. ``message`` has the fields of the message type as attributes
(``message.header.stamp.sec``). For raw payloads use `BagReader`.

What cannot be read is passed over and told in `BagReader.problems`, one sentence each: a file
that was cut off gives everything up to the cut, a damaged chunk costs that chunk.

A bag may come from anybody: what it says of sizes is held against `hmsa_ros.bag.limits` before
memory is taken, only files in its own folder are read, and nothing in it is ever run.
"""

from array import array
from collections.abc import Callable, Collection, Iterator
import contextlib
from dataclasses import dataclass, field
import heapq
import io
from itertools import islice
import os
from pathlib import Path
import re
import struct
from typing import Any, NamedTuple
import zlib

from hmsa_ros.bag import limits, metadata, qos, records
from hmsa_ros.errors import BadInputError, BagError, printable

# Messages outside chunks are grouped, so that they are handled like chunks.
_RUN_BYTES = 512 * 1024
_HEAD_BYTES = 64
# A field that is an array of messages.
_NESTED = re.compile(r'^\s*(?:[A-Z]\w*|\w+/[\w/]+)\s*\[', re.MULTILINE)
# What an entry of a map takes besides its texts.
_ENTRY_BYTES = 100
# Later than any log time.
_NEVER = 2**64


class Message(NamedTuple):
    """A message as stored: topic, stamps in nanoseconds, sequence and payload."""

    topic: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


class DecodedMessage(NamedTuple):
    """A decoded message: topic, stamps in nanoseconds and the message itself."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    message: Any


@dataclass(frozen=True)
class TopicInfo:
    """
    A topic of a bag.

    Attributes
    ----------
    name, type : str
        Topic and message type; the type is empty if the bag does not tell.
    encoding : str
        Of the messages, ``'cdr'``.
    definition_encoding, definition : str
        Message definition with its dependencies; empty if the bag has none.
    profiles : tuple of hmsa_ros.bag.qos.Qos
        What the publishers offered.
    type_hash : str
        RIHS01 hash, empty if unknown.

    """

    name: str
    type: str
    encoding: str = 'cdr'
    definition_encoding: str = ''
    definition: str = ''
    profiles: tuple[qos.Qos, ...] = ()
    type_hash: str = ''


@dataclass(frozen=True)
class _Block:
    """A chunk, or a run of messages outside chunks: where it lies and the times it spans."""

    file: int
    offset: int
    length: int
    start: int
    end: int
    chunk: records.ChunkHead | None


@dataclass
class _File:
    """What the scan of one file found."""

    path: Path
    size: int = 0
    profile: str = ''
    library: str = ''
    complete: bool = False
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    blocks: list[_Block] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    counts: dict[int, int] | None = None


class BagReader:
    """
    Reads a bag.

    Parameters
    ----------
    path : path
        Folder of a bag, or one ``.mcap`` file.
    max_chunk_size : int
        Largest content of a chunk, and largest message, in bytes; what is larger is passed
        over. Reading takes a few times as much memory at most.

    Attributes
    ----------
    path : pathlib.Path
        As given.
    files : tuple of pathlib.Path
        The files read, in order.
    topics : mapping of str to TopicInfo
        By name, in order of appearance.
    metadata : hmsa_ros.bag.metadata.BagMetadata or None
        What ``metadata.yaml`` says, if it is there and can be read.
    custom_data : mapping of str to str
        From ``metadata.yaml``, or else from the files.
    records : mapping of str to mapping
        Metadata records by name, those of one name together; of several values the last
        counts.
    problems : list of str
        What could not be read so far, one sentence each; grows while messages are read.

    Raises
    ------
    BadInputError
        If there is nothing that could be read.

    """

    def __init__(
            self, path: str | os.PathLike[str], *,
            max_chunk_size: int = limits.CHUNK_SIZE) -> None:
        if max_chunk_size < 1:
            raise BadInputError(
                f'largest chunk is {max_chunk_size} bytes: expected at least 1')
        self.path = Path(path)
        self._max_chunk_size = max_chunk_size
        self.problems: list[str] = []
        self._known_problems: set[str] = set()
        self._kept = 0
        self.metadata: metadata.BagMetadata | None = None
        paths = self._find_files()
        self._files: list[_File] = []
        for file_path in paths:
            try:
                self._files.append(self._scan(file_path, len(self._files)))
            except BagError as error:
                if len(paths) == 1:
                    raise
                self._problem(str(error))
        if not self._files:
            raise BadInputError(f'no file of {self.path} can be read: ' + self.problems[0])
        self.files = tuple(file.path for file in self._files)
        self.records: dict[str, dict[str, str]] = {}
        for file in self._files:
            for name, values in file.metadata.items():
                self.records.setdefault(name, {}).update(values)
        self.topics: dict[str, TopicInfo] = {}
        for file in self._files:
            for channel in file.channels.values():
                self._add_topic(file, channel)
        self.custom_data = self._find_custom_data()

    # Finding files ---------------------------------------------------------------------------

    def _problem(self, sentence: str) -> None:
        """Note what could not be read, once."""
        if sentence in self._known_problems or len(self._known_problems) > limits.PROBLEMS:
            return
        self._known_problems.add(sentence)
        self.problems.append(
            printable(sentence) if len(self._known_problems) <= limits.PROBLEMS
            else 'there are more problems, which are not told')

    def _find_files(self) -> list[Path]:
        """Return the files of the bag in order."""
        path = self.path
        try:
            if path.is_file():
                if path.name == metadata.FILE_NAME:
                    raise BadInputError(
                        f'{path} describes a bag: expected its folder, {path.parent}')
                return [path]
            if not path.is_dir():
                what = 'is neither' if path.exists() else 'does not exist'
                raise BadInputError(
                    f'{path} {what}: expected the folder of a bag or an .mcap file')
            present = sorted(
                (entry for entry in path.iterdir()
                 if entry.name.endswith('.mcap') and self._is_own_file(entry)),
                key=_file_order)
        except OSError as error:
            raise BadInputError(
                f'{path} cannot be read ({error.strerror}): expected a bag') from error
        listed = self._listed_files()
        if listed:
            extra = [entry.name for entry in present if entry not in listed]
            if extra:
                # A crash leaves the last split unlisted; anything else is another bag.
                own = [entry for entry in present
                       if entry in listed or _stem(entry) == _stem(listed[0])]
                other = [entry.name for entry in present if entry not in own]
                if other:
                    self._problem(
                        f'{path} also holds {", ".join(other)}, which {metadata.FILE_NAME} does '
                        'not name: passed over')
                missing = [entry.name for entry in own if entry not in listed]
                if missing:
                    self._problem(
                        f'{metadata.FILE_NAME} does not name {", ".join(missing)}, which belongs '
                        'to the bag: read all the same')
                return own
            return listed
        if not present:
            others = sorted(entry.name for entry in path.iterdir() if entry.suffix == '.db3')
            if others:
                raise BadInputError(
                    f'{path} holds an SQLite bag ({others[0]}): expected MCAP; convert it with '
                    '"ros2 bag convert"')
            raise BadInputError(f'{path} holds no .mcap file: expected a bag')
        stems = sorted({_stem(entry) for entry in present})
        if len(stems) > 1:
            raise BadInputError(
                f'{path} has no usable {metadata.FILE_NAME} and holds files of several bags '
                f'({", ".join(stems)}): expected one bag; name one .mcap file')
        return present

    def _is_own_file(self, entry: Path) -> bool:
        """Return whether an entry of the folder is a file that lies in it."""
        if not entry.is_file():
            return False
        if entry.resolve().parent != self.path.resolve():
            self._problem(
                f'{entry} is a link to {entry.resolve()}, out of the folder of the bag: passed '
                'over; name that file to read it')
            return False
        return True

    def _listed_files(self) -> list[Path]:
        """Return the files that the metadata name and that are there."""
        path = self.path / metadata.FILE_NAME
        if not path.exists():
            self._problem(f'{path} is missing: the files themselves are read')
            return []
        try:
            self.metadata = metadata.read(path)
        except BagError as error:
            self._problem(f'{error}; the files themselves are read')
            return []
        if self.metadata.storage != 'mcap':
            raise BadInputError(
                f'{self.path} is stored as {self.metadata.storage!r}: expected mcap; convert it '
                'with "ros2 bag convert"')
        if self.metadata.compression_mode.upper() not in ('', 'NONE'):
            raise BadInputError(
                f'{self.path} is compressed by rosbag2 in mode '
                f'{self.metadata.compression_mode}: expected MCAP with compressed chunks; '
                'convert it with "ros2 bag convert"')
        found: dict[Path, None] = {}
        for file in self.metadata.files:
            # Up to version 3 paths begin with the folder; none leads out of it.
            candidate = self.path / Path(file.path.replace('\0', '')).name
            try:
                if self._is_own_file(candidate):
                    found[candidate] = None
                elif not candidate.is_file():
                    self._problem(
                        f'{candidate} is missing, though {metadata.FILE_NAME} names it')
            except OSError as error:
                self._problem(f'{candidate} cannot be read: {error.strerror}')
        return list(found)

    # Scanning --------------------------------------------------------------------------------

    def _scan(self, path: Path, number: int) -> _File:
        """Go through the records of a file without reading what the chunks hold."""
        file = _File(path)
        try:
            with path.open('rb') as stream:
                file.size = os.fstat(stream.fileno()).st_size
                if file.size == 0:
                    raise BadInputError(f'{path} is empty: expected an MCAP file')
                magic = stream.read(len(records.MAGIC))
                if magic != records.MAGIC:
                    if records.MAGIC.startswith(magic):
                        raise BadInputError(
                            f'{path} was cut off after {file.size} bytes: expected an MCAP file')
                    raise BadInputError(f'{path} is not an MCAP file: it begins with '
                                        f'{magic!r}, expected {records.MAGIC!r}')
                self._scan_records(stream.fileno(), file, number)
        except OSError as error:
            raise BadInputError(
                f'{path} cannot be read ({error.strerror}): expected an MCAP file') from error
        return file

    def _scan_records(self, descriptor: int, file: _File, number: int) -> None:
        """Go through the records of a file."""
        offset = len(records.MAGIC)
        run: list[int] = []  # offset, start and end of the messages outside chunks in a row
        prefix_size = records.PREFIX.size

        def end_run() -> None:
            if run:
                file.blocks.append(_Block(
                    number, run[0], offset - run[0], run[1], run[2], None))
                run.clear()

        while offset + prefix_size <= file.size:
            head = os.pread(descriptor, prefix_size + _HEAD_BYTES, offset)
            opcode, length = records.PREFIX.unpack_from(head)
            end = offset + prefix_size + length
            if end > file.size or opcode == 0:
                break
            try:
                if len(file.blocks) > limits.CHUNKS:
                    self._problem(
                        f'{file.path.name} has more than {limits.CHUNKS} chunks: the rest is '
                        'passed over')
                    break
                if opcode == records.MESSAGE:
                    if length < records.MESSAGE_FIXED:
                        raise BagError('a message record ends early')
                    self._check_size(length, 'message')
                    log_time = records.MESSAGE_HEAD.unpack_from(head)[4]
                    if run and offset - run[0] >= _RUN_BYTES:
                        end_run()
                    if run:
                        run[1:] = min(run[1], log_time), max(run[2], log_time)
                    else:
                        run += offset, log_time, log_time
                    offset = end
                    continue
                end_run()
                if opcode == records.CHUNK:
                    chunk = records.read_chunk_head(head[prefix_size:], length)
                    self._check_size(max(chunk.size, chunk.data_length), 'chunk')
                    file.blocks.append(_Block(
                        number, offset + prefix_size, length, chunk.start, chunk.end, chunk))
                elif opcode in (records.HEADER, records.SCHEMA, records.CHANNEL,
                                records.METADATA, records.STATISTICS):
                    if length > limits.RECORD_SIZE:
                        raise BagError(f'a record of {length} bytes is larger than '
                                       f'{limits.RECORD_SIZE} bytes')
                    self._note(file, opcode, _read_exactly(
                        descriptor, length, offset + prefix_size))
                elif opcode == records.FOOTER:
                    file.complete = os.pread(
                        descriptor, len(records.MAGIC), end) == records.MAGIC
                    offset = end
                    break
            except BagError as error:
                end_run()
                self._problem(f'{file.path.name}: {error}, at byte {offset}: passed over')
            offset = end
        end_run()
        if not file.complete:
            self._after_cut(descriptor, file, offset, number)
        elif file.blocks and not file.channels:
            self._channels_in_chunks(descriptor, file)

    def _check_size(self, size: int, what: str) -> None:
        """Refuse what is larger than the memory it may take."""
        if size > self._max_chunk_size:
            raise BagError(f'a {what} of {size} bytes is larger than the {self._max_chunk_size} '
                           'bytes allowed')

    def _keep(self, size: int) -> None:
        """Count what is kept of the small records, and refuse too much of it."""
        if self._kept + size > limits.KEPT_SIZE:
            raise BagError(f'schemas, channels and metadata are larger than '
                           f'{limits.KEPT_SIZE} bytes')
        self._kept += size

    def _note(self, file: _File, opcode: int, content: bytes) -> None:
        """Take in a small record."""
        if opcode == records.SCHEMA:
            if int.from_bytes(content[:2], 'little') in file.schemas:
                return
            schema = records.read_schema(content)
            if len(schema.data) > limits.DEFINITION_SIZE:
                raise BagError(
                    f'the definition of {schema.name} has {len(schema.data)} bytes, more than '
                    f'{limits.DEFINITION_SIZE}')
            self._keep(len(content))
            file.schemas[schema.id] = schema
        elif opcode == records.CHANNEL:
            if int.from_bytes(content[:2], 'little') in file.channels:
                return
            channel = records.read_channel(content)
            self._keep(len(content))
            file.channels[channel.id] = channel
        elif opcode == records.METADATA:
            name, values = records.read_metadata(content)
            known = file.metadata.setdefault(name, {})
            self._keep(len(name) + sum(
                len(value) + (0 if key in known else len(key) + _ENTRY_BYTES)
                for key, value in values.items() if known.get(key) != value))
            known.update(values)
        elif opcode == records.HEADER:
            file.profile, file.library = records.read_header(content)
        else:
            fields = records.Fields(content, 'statistics')
            fields.take(42)
            end = fields.number(4) + fields.offset
            counts = {}
            while fields.offset < end:
                channel_id = fields.number(2)
                counts[channel_id] = fields.number(8)
            file.counts = counts

    def _after_cut(self, descriptor: int, file: _File, offset: int, number: int) -> None:
        """Tell of the end of what could be read, and go on by the summary if there is one."""
        beyond = self._summary_blocks(descriptor, file, offset, number)
        if beyond:
            self._problem(
                f'{file.path.name} is damaged at byte {offset} of {file.size}: the chunks after '
                'it are found by the index')
            file.blocks += beyond
        else:
            self._problem(
                f'{file.path.name} is not complete: it can be read up to byte {offset} of '
                f'{file.size}')
        # Nothing after the cut declares channels again, so those inside the chunks are needed.
        self._channels_in_chunks(descriptor, file)

    def _summary_blocks(
            self, descriptor: int, file: _File, offset: int, number: int) -> list[_Block]:
        """Return the chunks behind a damaged place, by the index at the end of the file."""
        tail_size = records.FOOTER_SIZE + len(records.MAGIC)
        tail = os.pread(descriptor, tail_size, max(0, file.size - tail_size))
        if len(tail) < tail_size or not tail.endswith(records.MAGIC) \
                or tail[0] != records.FOOTER:
            return []
        position = struct.unpack_from('<Q', tail, records.PREFIX.size)[0]
        blocks: list[_Block] = []
        seen: set[int] = set()
        prefix_size = records.PREFIX.size
        while 0 < position < file.size - tail_size:
            head = os.pread(descriptor, prefix_size, position)
            if len(head) < prefix_size:
                break
            opcode, length = records.PREFIX.unpack(head)
            if position + prefix_size + length > file.size:
                break
            begin = position + prefix_size
            position = begin + length
            try:
                if length > limits.RECORD_SIZE or len(blocks) > limits.CHUNKS:
                    raise BagError('a record is too large')
                content = os.pread(descriptor, length, begin)
                if opcode in (records.SCHEMA, records.CHANNEL, records.STATISTICS):
                    self._note(file, opcode, content)
                elif opcode == records.CHUNK_INDEX:
                    fields = records.Fields(content, 'chunk index')
                    fields.take(16)
                    start = fields.number(8)
                    if not offset <= start < file.size or start in seen:
                        continue
                    seen.add(start)
                    head = os.pread(descriptor, prefix_size + _HEAD_BYTES, start)
                    if len(head) < prefix_size or head[0] != records.CHUNK:
                        continue
                    chunk_length = records.PREFIX.unpack_from(head)[1]
                    chunk = records.read_chunk_head(head[prefix_size:], chunk_length)
                    self._check_size(max(chunk.size, chunk.data_length), 'chunk')
                    if start + prefix_size + chunk_length <= file.size:
                        blocks.append(_Block(
                            number, start + prefix_size, chunk_length, chunk.start, chunk.end,
                            chunk))
            except BagError as error:
                self._problem(f'{file.path.name}: {error}, in the summary: passed over')
        return sorted(blocks, key=lambda block: block.offset)

    def _channels_in_chunks(self, descriptor: int, file: _File) -> None:
        """Take in the schemas and channels that are only declared inside chunks."""
        for block in file.blocks:
            if block.chunk is None:
                continue
            try:
                content = self._content(descriptor, block)
                for opcode, start, end in _inner_records(content):
                    if opcode in (records.SCHEMA, records.CHANNEL):
                        self._note(file, opcode, content[start:end])
            except BagError:
                continue  # told when its messages are read

    def _add_topic(self, file: _File, channel: records.Channel) -> None:
        """Take in a channel as a topic."""
        schema = file.schemas.get(channel.schema_id)
        if schema is None:
            self._problem(
                f'{file.path.name}: topic {channel.topic} has no message definition: its '
                'messages can be sent again but not decoded')
            noted = self._metadata_of(channel.topic)
            schema = records.Schema(0, noted.type if noted is not None else '', '', b'')
        try:
            profiles = qos.from_stored(channel.metadata.get('offered_qos_profiles'))
        except BagError as error:
            self._problem(f'{file.path.name}: topic {channel.topic}: {error}')
            profiles = ()
        noted = self._metadata_of(channel.topic)
        if noted is not None and len(noted.profiles) > len(profiles):
            # A channel tells of the publishers at its first message, the metadata of all.
            profiles = noted.profiles
        known = self.topics.get(channel.topic)
        if known is not None:
            if known.type != schema.name:
                self._problem(
                    f'topic {channel.topic} has the types {known.type} and {schema.name}: '
                    f'the messages of type {schema.name} are passed over')
            # A later split may know more publishers.
            if known.type != schema.name or len(known.profiles) >= len(profiles):
                return
        self.topics[channel.topic] = TopicInfo(
            channel.topic, schema.name, channel.encoding, schema.encoding,
            schema.data.decode('utf-8', 'replace'), profiles,
            channel.metadata.get('topic_type_hash', ''))

    def _metadata_of(self, topic: str) -> metadata.TopicMetadata | None:
        """Return what ``metadata.yaml`` says of a topic."""
        topics = () if self.metadata is None else self.metadata.topics
        return next((entry for entry in topics if entry.name == topic), None)

    def _find_custom_data(self) -> dict[str, str]:
        """Return the custom data of the metadata or else of the files."""
        if self.metadata is not None and self.metadata.custom_data:
            return dict(self.metadata.custom_data)
        return {key: value for key, value in self.records.get('hmsa_ros', {}).items()
                if key != 'version'}

    # Messages --------------------------------------------------------------------------------

    @property
    def complete(self) -> bool:
        """Return whether every file was closed by its writer."""
        return all(file.complete for file in self._files)

    @property
    def start_time(self) -> int | None:
        """Return the first log time in nanoseconds, None without a message."""
        return min((block.start for block in self._filled_blocks()), default=None)

    @property
    def end_time(self) -> int | None:
        """Return the last log time in nanoseconds, None without a message."""
        return max((block.end for block in self._filled_blocks()), default=None)

    def _filled_blocks(self) -> Iterator[_Block]:
        """Return the blocks with messages."""
        for file in self._files:
            for block in file.blocks:
                # The times of a chunk with channels only are 0, as stamps may be that never saw
                # a clock.
                if block.chunk is None or block.chunk.size and (
                        block.end or self._has_messages(block)):
                    yield block

    def _has_messages(self, block: _Block) -> bool:
        """Return whether a block has messages, by reading it."""
        cursor = self._cursor(block, None, (0, _NEVER))
        return cursor is not None and cursor.left

    def messages(
            self, topics: Collection[str] | None = None, *, start: int | None = None,
            end: int | None = None,
            cancelled: Callable[[], bool] = lambda: False) -> Iterator[Message]:
        """
        Return the messages in order of log time.

        Parameters
        ----------
        topics : collection of str, optional
            Only these topics; default all.
        start, end : int, optional
            Only log times of at least ``start`` and less than ``end``, in nanoseconds.
        cancelled : callable
            Asked before each chunk; the messages end when it says yes.

        Yields
        ------
        Message
            Messages of equal stamp in the order they were written.

        """
        blocks = sorted(
            (block for block in self._filled_blocks()
             if (start is None or block.end >= start) and (end is None or block.start < end)),
            key=lambda block: (block.start, block.file, block.offset))
        wanted = None if topics is None else frozenset(topics)
        span = (0 if start is None else start), (_NEVER if end is None else end)
        most = limits.CHUNKS_AT_ONCE * self._max_chunk_size
        active: list[_Cursor] = []
        for i, block in enumerate(blocks):
            if cancelled():
                return
            if sum(len(cursor.content) for cursor in active) + _content_size(block) > most:
                # Every chunk so far reaches beyond the start of this one.
                self._problem(
                    f'{self._files[block.file].path.name}: more than {most} bytes of chunks '
                    f'overlap in time, at byte {block.offset}: passed over')
            else:
                cursor = self._cursor(block, wanted, span)
                if cursor is not None:
                    cursor.sort()
                    active.append(cursor)
            yield from _merge(active, blocks[i + 1].start if i + 1 < len(blocks) else _NEVER)
            active = [cursor for cursor in active if cursor.left]

    def stored_messages(self) -> Iterator[Message]:
        """
        Return all messages in the order they lie in the files.

        Yields
        ------
        Message
            One after the other.

        """
        for file in self._files:
            for block in file.blocks:
                cursor = self._cursor(block, None, (0, _NEVER))
                if cursor is not None:
                    yield from cursor.take(_NEVER)

    def counts(self) -> dict[str, int]:
        """
        Return the number of messages by topic.

        Returns
        -------
        dict of str to int
            From the files' statistics where these are complete, else counted.

        """
        result = dict.fromkeys(self.topics, 0)
        for number, file in enumerate(self._files):
            if file.complete and file.counts is not None and not self._damaged(number):
                for channel_id, count in file.counts.items():
                    channel = file.channels.get(channel_id)
                    if channel is not None and channel.topic in result:
                        result[channel.topic] += count
            else:
                for block in file.blocks:
                    cursor = self._cursor(block, None, (0, _NEVER))
                    for name, count in cursor.counts().items() if cursor is not None else ():
                        result[name] += count
        return result

    def _damaged(self, number: int) -> bool:
        """Return whether something in a file has turned out not to be readable."""
        name = self._files[number].path.name
        return any(problem.startswith(name) for problem in self.problems)

    def _content(self, descriptor: int, block: _Block) -> bytes:
        """Return the checked content of a chunk or run."""
        if block.chunk is None:
            return _read_exactly(descriptor, block.length, block.offset)
        chunk = block.chunk
        content = records.decompress(
            _read_exactly(descriptor, chunk.data_length, block.offset + chunk.data_offset),
            chunk.compression, chunk.size)
        if chunk.crc and zlib.crc32(content) != chunk.crc:
            raise BagError('a chunk is damaged (its CRC differs)')
        return content

    def _cursor(
            self, block: _Block, topics: Collection[str] | None,
            span: tuple[int, int]) -> '_Cursor | None':
        """Return the messages of a chunk or run in the order stored; tell of damage."""
        file = self._files[block.file]
        try:
            descriptor = os.open(file.path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            self._problem(f'{file.path.name} cannot be read any more: {error.strerror}')
            return None
        try:
            content = self._content(descriptor, block)
        except (BagError, OSError) as error:
            self._problem(f'{file.path.name}: {error}, at byte {block.offset}: passed over')
            return None
        finally:
            os.close(descriptor)
        # Places, not messages: a chunk of many small messages would take ten times its size.
        times, places = array('Q'), array('Q')
        names: dict[int, str | None] = {}
        wanted: set[int] = set()
        first, beyond = span
        unpack, prefix_size = records.MESSAGE_HEAD.unpack_from, records.PREFIX.size
        try:
            for opcode, start, end in _inner_records(content):
                if opcode != records.MESSAGE:
                    if opcode in (records.SCHEMA, records.CHANNEL):
                        self._note(file, opcode, content[start:end])
                    continue
                _, _, channel_id, _, log_time, _ = unpack(content, start - prefix_size)
                if channel_id not in names:
                    name = names[channel_id] = self._topic_of(file, channel_id)
                    if name is not None and (topics is None or name in topics):
                        wanted.add(channel_id)
                if channel_id in wanted and first <= log_time < beyond:
                    times.append(log_time)
                    places.append(start - prefix_size)
        except BagError as error:
            self._problem(f'{file.path.name}: {error}, at byte {block.offset}: passed over')
        return _Cursor((block.file, block.offset), content, names, times, places)

    def _topic_of(self, file: _File, channel_id: int) -> str | None:
        """Return the topic of a channel, None if its messages are passed over."""
        channel = file.channels.get(channel_id)
        if channel is None:
            self._problem(f'{file.path.name}: channel {channel_id} is nowhere declared: its '
                          'messages are passed over')
            return None
        if channel.topic not in self.topics:
            self._add_topic(file, channel)
        schema = file.schemas.get(channel.schema_id)
        if schema is not None and schema.name != self.topics[channel.topic].type:
            return None
        return channel.topic

    # Decoding --------------------------------------------------------------------------------

    def decoder(self, topic: str) -> Callable[[bytes], Any]:
        """
        Return the function that decodes a topic's payloads.

        Parameters
        ----------
        topic : str
            Name of a topic of the bag.

        Returns
        -------
        callable
            Takes a payload, returns an object with the message's fields as attributes. It
            raises `BagError` for a payload that does not fit the type.

        Raises
        ------
        BadInputError
            If the bag has no such topic.
        BagError
            If the bag has no definition that can be read.

        """
        info = self.topics.get(topic)
        if info is None:
            raise BadInputError(
                f'{self.path} has no topic {topic}: expected one of '
                + (', '.join(sorted(self.topics)) or 'none, the bag is empty'))
        return _make_decoder(info)


class _Cursor:
    """
    A place among the messages of a chunk or run.

    Parameters
    ----------
    key : tuple of int
        Where it was written; of equal stamps the smaller comes first.
    content : bytes
        Of the chunk.
    names : mapping of int to str
        Topics by channel.
    times, places : array of int
        Log time and offset in the content of each message.

    """

    def __init__(
            self, key: tuple[int, int], content: bytes, names: dict[int, str | None],
            times: 'array[int]', places: 'array[int]') -> None:
        self.key = key
        self.content = content
        self._names = names
        self._times = times
        self._places = places
        self._next = 0

    def sort(self) -> None:
        """Put the messages in order of time; equal ones stay as they are."""
        times = self._times
        # Nearly always they are in order already.
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
        """Return the next messages, up to a log time; that is for messages in order."""
        unpack, head_size = records.MESSAGE_HEAD.unpack_from, records.MESSAGE_HEAD.size
        prefix_size = records.PREFIX.size
        content, names = self.content, self._names
        while self._next < len(self._times) and self._times[self._next] < limit:
            place = self._places[self._next]
            self._next += 1
            _, length, channel_id, sequence, log_time, publish_time = unpack(content, place)
            yield Message(
                names[channel_id] or '', log_time, publish_time, sequence,
                content[place + head_size:place + prefix_size + length])

    def counts(self) -> dict[str, int]:
        """Return the number of messages by topic."""
        result: dict[str, int] = {}
        for place in self._places:
            name = self._names[records.MESSAGE_HEAD.unpack_from(self.content, place)[2]] or ''
            result[name] = result.get(name, 0) + 1
        return result


def _content_size(block: _Block) -> int:
    """Return the length of a block's content."""
    return block.length if block.chunk is None else block.chunk.size


def _merge(cursors: list[_Cursor], limit: int) -> Iterator[Message]:
    """Return the messages of several chunks up to a log time, in order."""
    heap = [(cursor.time, cursor.key, cursor) for cursor in cursors
            if cursor.left and cursor.time < limit]
    heapq.heapify(heap)
    while heap:
        _, key, cursor = heapq.heappop(heap)
        # Up to the next message of another chunk; where they are equal, key decides.
        until = limit if not heap else min(limit, heap[0][0] + (key < heap[0][1]))
        yield from cursor.take(until)
        if cursor.left and cursor.time < limit:
            heapq.heappush(heap, (cursor.time, key, cursor))


def _make_decoder(info: TopicInfo) -> Callable[[bytes], Any]:
    """Return the decoder of a topic."""
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory
    # A decoder of its own: the library keeps decoders by schema number, which differs between
    # the files of a bag.
    try:
        # Its parser prints before it raises.
        with contextlib.redirect_stderr(io.StringIO()), \
                contextlib.redirect_stdout(io.StringIO()):
            decode = DecoderFactory().decoder_for(info.encoding, Schema(
                id=1, name=info.type, encoding=info.definition_encoding,
                data=info.definition.encode()))
    except Exception as error:  # the parser raises errors of many unrelated classes
        raise BagError(f'the definition of {info.type} in the bag cannot be read: '
                       f'{error}') from error
    if decode is None:
        raise BagError(
            f'messages of topic {info.name} ({info.type or "unknown type"}) cannot be decoded: '
            f'expected CDR with a ros2msg definition, got {info.encoding!r} with '
            f'{info.definition_encoding or "no definition"!r}')

    # Arrays of primitive values take what they say of their length; those of messages may take
    # a hundred times as much.
    most = limits.DECODED_SIZE if _NESTED.search(info.definition) else limits.CHUNK_SIZE

    def checked(data: bytes) -> Any:
        if len(data) > most:
            raise BagError(
                f'a message of topic {info.name} has {len(data)} bytes: expected at most {most} '
                f'of a message of type {info.type} to be decoded')
        try:
            return decode(data)
        except Exception as error:
            raise BagError(f'a message of topic {info.name} does not decode as {info.type}: '
                           f'{str(error) or type(error).__name__}') from error

    return checked


def read_messages(
        path: str | os.PathLike[str], topics: Collection[str] | None = None, *,
        start: int | None = None, end: int | None = None) -> Iterator[DecodedMessage]:
    """
    Return the decoded messages of a bag in order of log time.

    Parameters
    ----------
    path : path
        Folder of a bag, or one ``.mcap`` file.
    topics : collection of str, optional
        Only these topics; default all that can be decoded. A name that the bag does not have
        gives no messages.
    start, end : int, optional
        Only log times of at least ``start`` and less than ``end``, in nanoseconds.

    Yields
    ------
    DecodedMessage
        ``(topic, log_time_ns, publish_time_ns, message)``.

    Raises
    ------
    BadInputError
        If there is no bag.
    BagError
        If a topic that was asked for by name cannot be decoded.

    """
    reader = BagReader(path)
    decoders: dict[str, Callable[[bytes], Any] | None] = {}
    for message in reader.messages(topics, start=start, end=end):
        topic = message.topic
        if topic not in decoders:
            try:
                decoders[topic] = reader.decoder(topic)
            except BagError:
                if topics is not None:
                    raise
                decoders[topic] = None
        decode = decoders[topic]
        if decode is not None:
            yield DecodedMessage(
                topic, message.log_time, message.publish_time, decode(message.data))


def _inner_records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Return opcode, start and end of the content of each record; raise at a broken one."""
    offset, size = 0, len(content)
    prefix_size, unpack = records.PREFIX.size, records.PREFIX.unpack_from
    while offset < size:
        if offset + prefix_size > size:
            raise BagError('a record in a chunk ends early')
        opcode, length = unpack(content, offset)
        start = offset + prefix_size
        offset = start + length
        if offset > size or (opcode == records.MESSAGE and length < records.MESSAGE_FIXED):
            raise BagError('a record in a chunk ends early')
        yield opcode, start, offset


def _read_exactly(descriptor: int, length: int, offset: int) -> bytes:
    """Read from a file, or raise if it has become shorter."""
    data = os.pread(descriptor, length, offset)
    while len(data) < length:
        more = os.pread(descriptor, length - len(data), offset + len(data))
        if not more:
            raise BagError('the file has become shorter')
        data += more
    return data


def _stem(path: Path) -> str:
    """Return a file's name without number and ending."""
    return re.sub(r'(_\d+)?\.mcap$', '', path.name)


def _file_order(path: Path) -> tuple[str, int]:
    """Sort by name, then by number."""
    match = re.search(r'_(\d+)\.mcap$', path.name)
    return _stem(path), int(match[1]) if match else -1


