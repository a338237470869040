"""Scan a file of a bag: by its summary, or else record by record."""

from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
import os
from pathlib import Path
import struct
from typing import Any, TypeVar
import zlib

from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from hmsa.bag import limits, records
from hmsa.bag.folder import advice_on
from hmsa.bag.merge import Cursor
from hmsa.bag.records import MAGIC, MessageBlock, PREFIX
from hmsa.errors import BadInputError, BagError, printable

# Messages outside chunks are grouped and handled like chunks.
_RUN_BYTES = 512 * 1024
_CRC_BYTES = 2**20
# Size of an entry of a map in addition to its texts.
_ENTRY_BYTES = 100
_FOOTER_SIZE = PREFIX.size + 20
_TAIL_SIZE = _FOOTER_SIZE + len(MAGIC)
_DATA_END_SIZE = PREFIX.size + 4
# Valid records that are not used here.
_PASSED_OVER = frozenset((Opcode.ATTACHMENT, Opcode.ATTACHMENT_INDEX))
_Declared = TypeVar('_Declared', Schema, Channel)


class ReadLimits:
    """
    Limits and problems of all files of a bag.

    ``problems`` contains a sentence for each unreadable part, without repetition and limited in
    number.
    """

    def __init__(self, max_chunk_size: int) -> None:
        self._max_chunk_size = max_chunk_size
        self._kept = 0
        self._known: set[str] = set()
        self.problems: list[str] = []

    def problem(self, sentence: str) -> None:
        """Record a problem."""
        if sentence in self._known or len(self._known) > limits.PROBLEMS:
            return
        self._known.add(sentence)
        self.problems.append(
            printable(sentence) if len(self._known) <= limits.PROBLEMS
            else 'further problems are not listed')

    def check_size(self, size: int, what: str) -> None:
        """Raise `BagError` if a size in bytes exceeds the limit."""
        if size > self._max_chunk_size:
            raise BagError(f'a {what} of {size} bytes is larger than the {self._max_chunk_size} '
                           'bytes allowed')

    def keep(self, size: int) -> None:
        """Count the size of records kept in memory; raise `BagError` above the limit."""
        if self._kept + size > limits.KEPT_SIZE:
            raise BagError(f'schemas, channels and metadata are larger than '
                           f'{limits.KEPT_SIZE} bytes')
        self._kept += size


class ScannedFile:
    """
    The content of a file: records by id, metadata records by name.

    ``blocks`` are its parts with messages, in order; ``closed`` is whether its writer closed it,
    and ``said`` how many messages it says that it has, None if it does not. Raises `BadInputError`
    if it is not an MCAP file.
    """

    def __init__(self, intake: ReadLimits, path: Path, number: int) -> None:
        self.path = path
        self.paths = [path]
        self.closed = False
        self.said: int | None = None
        self._intake = intake
        self._number = number  # its place in the bag
        self._damaged = self._counted = False
        self._data_end = self._data_crc = 0
        self._clear()
        try:
            with path.open('rb') as stream:
                self._descriptor = stream.fileno()  # while it is read
                self._size = os.fstat(self._descriptor).st_size
                magic = stream.read(len(MAGIC))
                if magic != MAGIC:
                    what = advice_on(path) or ('is empty' if not magic else (
                        f'was cut off after {self._size} bytes' if MAGIC.startswith(magic) else
                        f'is not an MCAP file, as it begins with {magic!r}')
                        ) + ': expected an MCAP file'
                    raise BadInputError(f'{path} {what}')
                if not self._read_summary():
                    self._clear()
                    self._walk()
        except OSError as error:
            raise BadInputError(
                f'{path} cannot be read ({error.strerror}): expected an MCAP file') from error

    @property
    def complete(self) -> bool:
        """Return whether its writer closed it, and no damage has been found so far."""
        return self.closed and not self._damaged

    def problem(self, sentence: str) -> None:
        """Record a problem, and that the file is damaged."""
        self._damaged = True
        self._intake.problem(f'{self.path.name}{sentence}')

    def counts(self) -> dict[int, int]:
        """Return the messages by channel, counting them if the statistics may be wrong."""
        try:
            with self.path.open('rb') as stream:
                self._descriptor = stream.fileno()
                self._check_data()
                if self._damaged and not self._counted:
                    self._count()
        except OSError as error:
            self.problem(f' cannot be read any more: {error.strerror}')
        return self._counts

    def cursor(
            self, block: MessageBlock, topic_of: Callable[[int], str | None], start: int,
            end: int) -> Cursor | None:
        """Return the messages of a block in the order stored; report damage."""
        try:
            with self.path.open('rb') as stream:
                content = block.content(stream.fileno())
        except (BagError, OSError) as error:
            self.problem(f': {error}, at byte {block.offset}: skipped')
            return None
        cursor = Cursor((block.file, block.offset), content, topic_of, start, end)
        if cursor.problem:
            self.problem(f': {cursor.problem}, at byte {block.offset}: skipped')
        return cursor

    def _clear(self) -> None:
        """Reset the content."""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.blocks: list[MessageBlock] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self._counts = Counter[int]()

    def _take(self, record: McapRecord) -> None:
        """Add a schema, channel or metadata record; raise `BagError` if it is too large."""
        if isinstance(record, Schema):
            if self._is_new(self.schemas, record):
                self._intake.keep(len(record.data))
                if len(record.data) > limits.DEFINITION_SIZE:
                    raise BagError(
                        f'the definition of {record.name} has {len(record.data)} bytes, more '
                        f'than {limits.DEFINITION_SIZE}')
                self.schemas[record.id] = record
        elif isinstance(record, Channel):
            if self._is_new(self.channels, record):
                self._intake.keep(sum(map(len, record.metadata.values())) + len(record.topic))
                self.channels[record.id] = record
        elif isinstance(record, Metadata):
            if record.name not in self.metadata:
                self._intake.keep(len(record.name) + _ENTRY_BYTES)
            values = self.metadata.setdefault(record.name, {})
            # A new value replaces the old one in memory.
            self._intake.keep(sum(
                len(value) - len(values[key]) if key in values
                else len(value) + len(key) + _ENTRY_BYTES
                for key, value in record.metadata.items()))
            values.update(record.metadata)

    def _is_new(self, known: Mapping[int, _Declared], record: _Declared) -> bool:
        """Return whether a declaration is new and within limits."""
        what = type(record).__name__.lower()
        if record.id in known:
            if known[record.id] != record:
                self.problem(f': {what} {record.id} is declared in two ways')
            return False
        if len(known) >= limits.CHANNELS:
            self.problem(f' declares more than {limits.CHANNELS} of {what}: the rest is skipped')
            return False
        return True

    def _add_block(self, block: MessageBlock, offset: int) -> None:
        """Add a chunk unless it is too large."""
        try:
            self._intake.check_size(max(block.size, block.length), 'chunk')
        except BagError as error:
            self.problem(f': {error}, at byte {offset}: skipped')
        else:
            self.blocks.append(block)

    # -- record by record -----------------------------------------------------------------------

    def _walk(self) -> None:
        """Read the file record by record, and count its messages."""
        offset, chunked = len(MAGIC), False
        self.closed, self.said = False, None
        run: int | None = None  # where messages outside chunks begin
        while offset + PREFIX.size <= self._size and not self.closed:
            head = os.pread(self._descriptor, PREFIX.size + records.CHUNK_HEAD_SIZE, offset)
            opcode, length = PREFIX.unpack_from(head)
            end = offset + PREFIX.size + length
            if end > self._size or opcode == 0:
                break
            if len(self.blocks) > limits.CHUNKS:
                self.problem(f' has more than {limits.CHUNKS} chunks: the rest is skipped')
                break
            try:
                if opcode != Opcode.MESSAGE or run is not None and offset - run >= _RUN_BYTES:
                    self._end_run(run, offset)
                    run = None
                if opcode == Opcode.MESSAGE:
                    if length < records.MESSAGE_FIXED:
                        raise BagError('a message record ends early')
                    self._intake.check_size(length, 'message')
                    if chunked:
                        self.problem(' has messages outside its chunks')
                    run = offset if run is None else run
                else:
                    chunked = chunked or opcode == Opcode.CHUNK
                    record = self._read_record(offset, head)
                    if isinstance(record, Statistics):
                        self.said = record.message_count
                    self.closed = isinstance(record, Footer) and os.pread(
                        self._descriptor, len(MAGIC), end) == MAGIC
            except BagError as error:
                self._end_run(run, offset)
                run = None
                self.problem(f': {error}, at byte {offset}: skipped')
            offset = end
        self._end_run(run, offset)
        if not self.closed:
            self.problem(
                f' is not complete: it can be read up to byte {offset} of {self._size}')
        self._count()

    def _end_run(self, begin: int | None, end: int) -> None:
        """Add messages outside chunks as a chunk of unknown times."""
        if begin is not None:
            self.blocks.append(MessageBlock(self._number, begin, end - begin, end - begin, -1, -1))

    def _read_record(self, offset: int, head: bytes) -> McapRecord | None:
        """Read one record that is not a message."""
        opcode, length = PREFIX.unpack_from(head)
        content = head[PREFIX.size:]
        if opcode == Opcode.CHUNK:
            self._add_block(MessageBlock.of_chunk(self._number, offset, content, length), offset)
        elif opcode == Opcode.MESSAGE_INDEX:
            if length < 6 or struct.unpack_from('<I', content, 2)[0] != length - 6:
                raise BagError('a message index record ends early')
        elif opcode not in _PASSED_OVER:
            if length > limits.RECORD_SIZE:
                raise BagError(f'a record of {length} bytes is larger than '
                               f'{limits.RECORD_SIZE} bytes')
            record = records.parse_any(
                opcode, records.read_exactly(self._descriptor, length, offset + PREFIX.size))
            if record is None:
                raise BagError(f'a record is of the unknown kind {opcode:#x}')
            self._take(record)
            return record
        return None

    def _count(self) -> None:
        """Read all blocks for their declarations, counts and times."""
        blocks, self.blocks, self._counts, self._counted = self.blocks, [], Counter(), True
        unpack = records.MESSAGE_HEAD.unpack_from
        for block in blocks:
            start, end = 2**64, -1
            channels = array('H')
            try:
                content = block.content(self._descriptor)
                for opcode, begin, until in records.split(content):
                    if opcode == records.MESSAGE:
                        _, _, channel, _, time, _ = unpack(content, begin - PREFIX.size)
                        channels.append(channel)
                        start, end = min(start, time), max(end, time)
                        continue
                    try:
                        record = records.parse_any(opcode, content[begin:until])
                        if not isinstance(record, (Schema, Channel)):
                            raise BagError(f'a chunk holds a record of the kind {opcode:#x}')
                        self._take(record)
                    except BagError as error:
                        self.problem(f': {error}: skipped')
            except BagError as error:
                self.problem(f': {error}, at byte {block.offset}: skipped')
            self._counts.update(channels)
            if channels:
                self.blocks.append(replace(block, start=start, end=end))
        found, said = self._counts.total(), self.said
        if said is not None and said != found:
            self.problem(f': {said - found} of {said} messages cannot be read' if said > found else
                         f' holds {found} messages that can be read: it says {said}')

    # -- by the summary -------------------------------------------------------------------------

    def _read_summary(self) -> bool:
        """Read the summary; return False if it is missing or unreliable."""
        tail = os.pread(self._descriptor, _TAIL_SIZE, max(0, self._size - _TAIL_SIZE))
        if not (tail.endswith(MAGIC) and tail.startswith(PREFIX.pack(Opcode.FOOTER, 20))):
            return False
        self.closed = True
        try:
            footer = records.parse(Footer, tail[PREFIX.size:_FOOTER_SIZE])
            start, end = footer.summary_start, self._size - _TAIL_SIZE
            if not start:
                return False
            if not _DATA_END_SIZE < start <= end or end - start > limits.SUMMARY_SIZE:
                raise BagError('it does not lie where the file says')
            summary = records.read_exactly(self._descriptor, end - start, start)
            if footer.summary_crc not in (0, zlib.crc32(tail[:25], zlib.crc32(summary))):
                raise BagError('its CRC differs')
            return self._take_summary(summary, start - _DATA_END_SIZE)
        except BagError as error:
            self.problem(
                f': the summary cannot be used ({error}): the file is read record by record')
            return False

    def _take_summary(self, summary: bytes, data_end: int) -> bool:
        """Add the records of a summary; return False if it is incomplete."""
        found: defaultdict[type[McapRecord] | None, list[Any]] = defaultdict(list)
        for opcode, begin, end in records.split(summary):
            record = records.parse_any(opcode, summary[begin:end])
            found[None if record is None else type(record)].append(record)
        chunks: list[ChunkIndex] = found[ChunkIndex]
        if not found[Statistics]:
            return False
        statistics: Statistics = found[Statistics][-1]
        if statistics.message_count and not chunks or (
                statistics.channel_count and not found[Channel]):
            return False
        _check(statistics, chunks, len(found[Channel]))
        for record in (*found[Schema], *found[Channel]):
            self._take(record)
        self._counts = Counter(statistics.channel_message_counts)
        self.said = statistics.message_count
        end_record = records.read_exactly(self._descriptor, _DATA_END_SIZE, data_end)
        if not end_record.startswith(PREFIX.pack(Opcode.DATA_END, 4)):
            self.problem(f' is damaged at byte {data_end}: no end of data')
        self._data_end = data_end
        self._data_crc = records.parse(DataEnd, end_record[PREFIX.size:]).data_section_crc
        before = len(MAGIC)
        for index in sorted(chunks, key=lambda index: index.chunk_start_offset):
            offset = index.chunk_start_offset
            if offset < before or offset + index.chunk_length > data_end:
                raise BagError(f'a chunk at byte {offset} overlaps with something else')
            before = offset + index.chunk_length
            self._find_chunk(index)
        for entry in found[MetadataIndex]:
            self._find_metadata(entry)
        return True

    def _find_chunk(self, index: ChunkIndex) -> None:
        """Take in a chunk as the summary describes it."""
        offset = index.chunk_start_offset
        # The index has no checksum.
        crc, = struct.unpack('<I', records.read_exactly(
            self._descriptor, 4, offset + PREFIX.size + 24))
        self._add_block(MessageBlock(
            self._number, offset + PREFIX.size + 40 + len(index.compression.encode()),
            index.compressed_size, index.uncompressed_size, index.message_start_time,
            index.message_end_time, index.compression, crc), offset)

    def _find_metadata(self, index: MetadataIndex) -> None:
        """Take in a metadata record that the summary names."""
        try:
            if not PREFIX.size <= index.length <= limits.RECORD_SIZE:
                raise BagError(f'a metadata record has {index.length} bytes')
            data = records.read_exactly(self._descriptor, index.length, index.offset)
            if PREFIX.unpack_from(data) != (Opcode.METADATA, index.length - PREFIX.size):
                raise BagError('a metadata record is not where the index says')
            self._take(records.parse(Metadata, data[PREFIX.size:]))
        except (BagError, OverflowError) as error:
            self.problem(f': {error}, at byte {index.offset}: skipped')

    def _check_data(self) -> None:
        """Hold the data against their CRC, unless that would take long."""
        if not self._data_crc or self._damaged or self._data_end > limits.CHECKED_SIZE:
            return
        crc = 0
        for offset in range(0, self._data_end, _CRC_BYTES):
            size = min(_CRC_BYTES, self._data_end - offset)
            crc = zlib.crc32(os.pread(self._descriptor, size, offset), crc)
        if crc != self._data_crc:
            self.problem(' is damaged: the CRC of its data differs')


def _check(statistics: Statistics, chunks: list[ChunkIndex], declared: int) -> None:
    """Hold the statistics of a file against the rest of its summary."""
    filled = [index for index in chunks if index.uncompressed_size]
    for what, said, found in (
            ('chunks', statistics.chunk_count, len(chunks)),
            ('channels', statistics.channel_count, declared),
            ('messages', statistics.message_count,
             sum(statistics.channel_message_counts.values())),
            ('ns to begin with', statistics.message_start_time, min(
                (x.message_start_time for x in filled), default=statistics.message_start_time)),
            ('ns to end with', statistics.message_end_time, max(
                (x.message_end_time for x in filled), default=statistics.message_end_time))):
        if said != found:
            raise BagError(f'it says {said} {what} and has {found}')
