"""What a file of a bag holds: by its summary, or else record by record."""

from collections.abc import Iterator
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

from hmsa_ros.bag import limits, records
from hmsa_ros.bag.intake import Intake, ScannedFile
from hmsa_ros.bag.records import Block, MAGIC, PREFIX
from hmsa_ros.errors import BadInputError, BagError

# Messages outside chunks are grouped, so that they are handled like chunks.
_RUN_BYTES = 512 * 1024
# Read by nobody here, but no sign of damage.
_PASSED_OVER = frozenset(
    (Opcode.ATTACHMENT, Opcode.ATTACHMENT_INDEX, Opcode.SUMMARY_OFFSET))


def walk(descriptor: int, file: ScannedFile) -> None:
    """Take in a file record by record, and count its messages."""
    offset, ended, statistics = len(MAGIC), False, None
    run: list[int] = []  # offset, start and end of the messages outside chunks in a row

    def end_run() -> None:
        if run:
            length = offset - run[0]
            file.blocks.append(Block(
                file.number, run[0], length, length, run[1], run[2]))
            run.clear()

    chunked = False
    while offset + PREFIX.size <= file.size and not ended:
        head = os.pread(descriptor, PREFIX.size + records.CHUNK_HEAD_SIZE, offset)
        opcode, length = PREFIX.unpack_from(head)
        end = offset + PREFIX.size + length
        if end > file.size or opcode == 0:
            break
        try:
            if len(file.blocks) > limits.CHUNKS:
                file.problem(f' has more than {limits.CHUNKS} chunks: the rest is skipped')
                break
            if opcode == Opcode.MESSAGE:
                if length < records.MESSAGE_FIXED:
                    raise BagError('a message record ends early')
                file.intake.check_size(length, 'message')
                if chunked:
                    file.problem(' has messages outside its chunks')
                log_time = records.MESSAGE_HEAD.unpack_from(head)[4]
                if run and offset - run[0] >= _RUN_BYTES:
                    end_run()
                if run:
                    run[1:] = min(run[1], log_time), max(run[2], log_time)
                else:
                    run += offset, log_time, log_time
            else:
                end_run()
                chunked = chunked or opcode == Opcode.CHUNK
                record = _read_record(descriptor, file, offset, head)
                statistics = record if isinstance(record, Statistics) else statistics
                ended = isinstance(record, Footer) and os.pread(
                    descriptor, len(MAGIC), end) == MAGIC
        except BagError as error:
            end_run()
            file.problem(f': {error}, at byte {offset}: skipped')
        offset = end
    end_run()
    if not ended:
        file.problem(f' is not complete: it can be read up to byte {offset} of {file.size}')
    file.complete = ended
    _count(descriptor, file)
    found = sum(file.counts.values())
    if statistics is not None and statistics.message_count != found:
        file.problem(
            f' holds {found} messages that can be read: it says {statistics.message_count}')


def _read_record(
        descriptor: int, file: ScannedFile, offset: int, head: bytes) -> McapRecord | None:
    """Take in one record that is no message."""
    opcode, length = PREFIX.unpack_from(head)
    content = head[PREFIX.size:]
    if opcode == Opcode.CHUNK:
        file.add_block(Block.of_chunk(file.number, offset, content, length), offset)
    elif opcode == Opcode.MESSAGE_INDEX:
        if length < 6 or struct.unpack_from('<I', content, 2)[0] != length - 6:
            raise BagError('a message index record ends early')
    elif opcode not in _PASSED_OVER:
        if length > limits.RECORD_SIZE:
            raise BagError(f'a record of {length} bytes is larger than '
                           f'{limits.RECORD_SIZE} bytes')
        record = records.parse_any(
            opcode, records.read_exactly(descriptor, length, offset + PREFIX.size))
        if record is None:
            raise BagError(f'a record is of the unknown kind {opcode:#x}')
        file.take(record)
        return record
    return None


def _count(descriptor: int, file: ScannedFile) -> None:
    """Go through all chunks: for what is declared in them, and for what is true of them."""
    blocks, file.blocks, file.counted = file.blocks, [], True
    for block in blocks:
        times: list[int] = []
        try:
            for channel, time in _messages(file, block.content(descriptor)):
                file.counts[channel] = file.counts.get(channel, 0) + 1
                times[:] = (min(times[0], time), max(times[1], time)) if times else (
                    time, time)
        except BagError as error:
            file.problem(f': {error}, at byte {block.offset}: skipped')
        if times and (block.start, block.end) != tuple(times):
            file.problem(f': a chunk has other times than it says, at byte {block.offset}')
        if times:
            file.blocks.append(replace(block, start=times[0], end=times[1]))


def _messages(file: ScannedFile, content: bytes) -> Iterator[tuple[int, int]]:
    """Return channel and log time of each message, and take in what else is there."""
    unpack = records.MESSAGE_HEAD.unpack_from
    for opcode, start, end in records.split(content):
        if opcode == records.MESSAGE:
            _, _, channel, _, time, _ = unpack(content, start - PREFIX.size)
            yield channel, time
        else:
            try:
                record = records.parse_any(opcode, content[start:end])
                if not isinstance(record, (Schema, Channel)):
                    raise BagError(f'a chunk holds a record of the kind {opcode:#x}')
                file.take(record)
            except BagError as error:
                file.problem(f': {error}: skipped')


_FOOTER_SIZE = PREFIX.size + 20
_DATA_END_SIZE = PREFIX.size + 4


def read_summary(descriptor: int, file: ScannedFile) -> bool:
    """Take in a file by its summary; False if that is missing or not to be trusted."""
    tail_size = _FOOTER_SIZE + len(MAGIC)
    tail = os.pread(descriptor, tail_size, max(0, file.size - tail_size))
    if not (len(tail) == tail_size and tail.endswith(MAGIC)
            and tail.startswith(PREFIX.pack(Opcode.FOOTER, 20))):
        return False
    file.complete = True
    footer = records.parse(Footer, tail[PREFIX.size:_FOOTER_SIZE])
    start, end = footer.summary_start, file.size - tail_size
    if not start:
        return False
    try:
        if not _DATA_END_SIZE < start <= end or end - start > limits.SUMMARY_SIZE:
            raise BagError('it does not lie where the file says')
        summary = records.read_exactly(descriptor, end - start, start)
        if footer.summary_crc not in (0, zlib.crc32(tail[:25], zlib.crc32(summary))):
            raise BagError('its CRC differs')
        return _take_summary(descriptor, file, summary, start)
    except BagError as error:
        file.problem(
            f': the summary cannot be used ({error}): the file is read record by record')
        return False


def _take_summary(descriptor: int, file: ScannedFile, summary: bytes, start: int) -> bool:
    """Take in the records of a summary; False if they are not complete."""
    chunks: list[ChunkIndex] = []
    notes: list[MetadataIndex] = []
    statistics: Statistics | None = None
    declared = 0
    for opcode, begin, end in records.split(summary):
        record = records.parse_any(opcode, summary[begin:end])
        if isinstance(record, ChunkIndex):
            chunks.append(record)
        elif isinstance(record, MetadataIndex):
            notes.append(record)
        elif isinstance(record, Statistics):
            statistics = record
        elif record is not None:
            declared += isinstance(record, Channel)
            file.take(record)
    if statistics is None or statistics.message_count and not chunks \
            or statistics.channel_count and not declared:
        return False
    _check(statistics, chunks, declared)
    file.counts = dict(statistics.channel_message_counts)
    end_record = records.read_exactly(descriptor, _DATA_END_SIZE, start - _DATA_END_SIZE)
    if not end_record.startswith(PREFIX.pack(Opcode.DATA_END, 4)):
        file.problem(f' is damaged at byte {start - _DATA_END_SIZE}: no end of data')
    file.data_end = start - _DATA_END_SIZE
    file.data_crc = records.parse(DataEnd, end_record[PREFIX.size:]).data_section_crc
    _find_chunks(descriptor, file, chunks)
    for entry in notes:
        _find_metadata(descriptor, file, entry)
    return True


def _find_chunks(descriptor: int, file: ScannedFile, chunks: list[ChunkIndex]) -> None:
    """Hold the heads of the chunks against the index."""
    before = len(MAGIC)
    for index in sorted(chunks, key=lambda index: index.chunk_start_offset):
        offset = index.chunk_start_offset
        after = offset + index.chunk_length
        if offset < before or after > file.data_end:
            raise BagError(f'a chunk at byte {offset} overlaps with something else')
        before = after
        head = os.pread(descriptor, PREFIX.size + records.CHUNK_HEAD_SIZE, offset)
        content, length = head[PREFIX.size:], index.chunk_length - PREFIX.size
        crc = struct.unpack_from('<I', content, 24)[0] if len(content) >= 28 else 0
        block = Block(
            file.number, offset + PREFIX.size + 40 + len(index.compression.encode()),
            index.compressed_size, index.uncompressed_size, index.message_start_time,
            index.message_end_time, index.compression, crc)
        try:
            found = Block.of_chunk(file.number, offset, content, length)
        except BagError:
            found = None
        if block != found or not head.startswith(PREFIX.pack(Opcode.CHUNK, length)):
            file.problem(f' is damaged at byte {offset}: the chunk there is not as the index '
                         'says, and is read as that says')
        file.add_block(block, offset)


def _find_metadata(descriptor: int, file: ScannedFile, index: MetadataIndex) -> None:
    """Take in a metadata record that the summary names."""
    try:
        if not PREFIX.size <= index.length <= limits.RECORD_SIZE:
            raise BagError(f'a metadata record has {index.length} bytes')
        data = records.read_exactly(descriptor, index.length, index.offset)
        if PREFIX.unpack_from(data) != (Opcode.METADATA, index.length - PREFIX.size):
            raise BagError('a metadata record is not where the index says')
        record = records.parse(Metadata, data[PREFIX.size:])
        if record.name != index.name:
            raise BagError('a metadata record is not called as the index says')
        file.take(record)
    except (BagError, OverflowError) as error:
        file.problem(f': {error}, at byte {index.offset}: skipped')


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


_CRC_BYTES = 2**20


def scan(intake: Intake, path: Path, number: int) -> ScannedFile:
    """Find out what a file holds; raise `BadInputError` if it is no MCAP file."""
    try:
        with path.open('rb') as stream:
            size = os.fstat(stream.fileno()).st_size
            if size == 0:
                raise BadInputError(f'{path} is empty: expected an MCAP file')
            magic = stream.read(len(MAGIC))
            if magic != MAGIC:
                if MAGIC.startswith(magic):
                    raise BadInputError(
                        f'{path} was cut off after {size} bytes: expected an MCAP file')
                raise BadInputError(f'{path} is not an MCAP file: it begins with '
                                    f'{magic!r}, expected {MAGIC!r}')
            descriptor = stream.fileno()
            file = ScannedFile(path, number, size, intake)
            if not read_summary(descriptor, file):
                file = replace(
                    file, schemas={}, channels={}, blocks=[], metadata={}, counts={})
                walk(descriptor, file)
            return file
    except OSError as error:
        raise BadInputError(
            f'{path} cannot be read ({error.strerror}): expected an MCAP file') from error


def check_data(file: ScannedFile) -> None:
    """Hold the data of a file against their CRC, unless that would take long."""
    crc, offset = 0, 0
    if not file.data_crc or file.damaged or file.data_end > limits.CHECKED_SIZE:
        return
    with file.path.open('rb') as stream:
        while offset < file.data_end:
            data = stream.read(min(_CRC_BYTES, file.data_end - offset))
            if not data:
                break
            crc = zlib.crc32(data, crc)
            offset += len(data)
    if crc != file.data_crc:
        file.problem(' is damaged: the CRC of its data differs')
