"""Scan a file of a bag: by its summary, or else record by record."""

from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
import os
from pathlib import Path
import struct
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
from hmsa.bag.metadata import advice_on
from hmsa.bag.records import Cursor, MAGIC, MessageBlock, PREFIX
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


class ReadLimits:
    """
    Limits and problems of all files of a bag.

    ``problems`` contains a sentence for each unreadable part, without repetition and limited in
    number.
    """

    def __init__(self, max_chunk_size: int) -> None:
        self._max_chunk_size = max_chunk_size
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
        self._kept = 0  # bytes of records in memory
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.blocks: list[MessageBlock] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self._counts = Counter[int]()

    def _take(self, record: McapRecord, size: int) -> None:
        """Keep a schema, channel or metadata record of a size; raise `BagError` if too many."""
        known: dict[int, Schema] | dict[int, Channel]
        if isinstance(record, (Schema, Channel)):
            known = self.schemas if isinstance(record, Schema) else self.channels
            if record.id in known:
                if known[record.id] != record:
                    self.problem(f': {type(record).__name__.lower()} {record.id} is declared in '
                                 'two ways')
                return
        elif isinstance(record, Metadata):
            size += len(record.metadata) * _ENTRY_BYTES
        else:
            return
        if self._kept + size > limits.KEPT_SIZE:
            raise BagError(
                f'schemas, channels and metadata are larger than {limits.KEPT_SIZE} bytes')
        self._kept += size
        if isinstance(record, Metadata):
            self.metadata.setdefault(record.name, {}).update(record.metadata)
        elif isinstance(record, Schema):
            self.schemas[record.id] = record
        else:
            self.channels[record.id] = record

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
                    self._read_record(offset, head)
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

    def _read_record(self, offset: int, head: bytes) -> None:
        """Read one record that is not a message."""
        opcode, length = PREFIX.unpack_from(head)
        start = offset + PREFIX.size
        if opcode == Opcode.CHUNK:
            self._add_block(
                MessageBlock.of_chunk(self._number, offset, head[PREFIX.size:], length), offset)
        elif opcode == Opcode.MESSAGE_INDEX:
            # A chunk with a wrong bit would be passed over in silence.
            if length < 6 or struct.unpack_from('<I', head, PREFIX.size + 2)[0] != length - 6:
                raise BagError('a message index record ends early')
        elif opcode not in _PASSED_OVER:
            record = records.parse_any(opcode, records.read_exactly(
                self._descriptor, min(length, limits.RECORD_SIZE + 1), start))
            if record is None:
                raise BagError(f'a record is of the unknown kind {opcode:#x}')
            if isinstance(record, Statistics):
                self.said = record.message_count
            self.closed = isinstance(record, Footer) and os.pread(
                self._descriptor, len(MAGIC), start + length) == MAGIC
            self._take(record, length)

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
                        self._take(record, until - begin)
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
                         f' contains {found} readable messages: its summary states {said}')

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
                raise BagError('it is not at the position that the footer states')
            summary = records.read_exactly(self._descriptor, end - start, start)
            if footer.summary_crc not in (0, zlib.crc32(tail[:25], zlib.crc32(summary))):
                raise BagError('its CRC differs')
            self._data_end = start - _DATA_END_SIZE
            data_end = records.read_exactly(self._descriptor, _DATA_END_SIZE, self._data_end)
            self._data_crc = records.parse(DataEnd, data_end[PREFIX.size:]).data_section_crc
            return self._take_summary(summary)
        except BagError as error:
            self.problem(
                f': the summary cannot be used ({error}): the file is read record by record')
            return False

    def _take_summary(self, summary: bytes) -> bool:
        """Add the records of a summary; return False if it is incomplete."""
        statistics = None
        for opcode, begin, end in records.split(summary):
            record = records.parse_any(opcode, summary[begin:end])
            if isinstance(record, ChunkIndex):
                self._find_chunk(record)
            elif isinstance(record, MetadataIndex):
                self._find_metadata(record)
            elif isinstance(record, Statistics):
                statistics = record
            elif record is not None:
                self._take(record, end - begin)
        if statistics is None or statistics.channel_count != len(self.channels) or (
                statistics.message_count and not self.blocks):
            return False
        if statistics.chunk_count != len(self.blocks) and not self._damaged:
            raise BagError(
                f'it states {statistics.chunk_count} chunks and has {len(self.blocks)}')
        self.blocks.sort(key=lambda block: block.offset)
        self._counts = Counter(statistics.channel_message_counts)
        self.said = statistics.message_count
        return True

    def _find_chunk(self, index: ChunkIndex) -> None:
        """Take in a chunk as the summary describes it."""
        offset = index.chunk_start_offset
        if offset + index.chunk_length > self._data_end:
            raise BagError(f'a chunk at byte {offset} overlaps with something else')
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
            data = records.read_exactly(self._descriptor, min(
                index.length, PREFIX.size + limits.RECORD_SIZE + 1), index.offset)
            if data[:1] != bytes((Opcode.METADATA,)):
                raise BagError('a metadata record is not where the index says')
            self._take(records.parse(Metadata, data[PREFIX.size:]), index.length)
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
