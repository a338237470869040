"""
A file of a bag by its summary.

The mcap package's readers trust the summary. Here it is held against its CRC, the statistics,
the heads of the chunks and the end of the data, and what does not agree is said.
"""

import os
import struct
import zlib

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Metadata, MetadataIndex, Statistics

from hmsa_ros.bag import limits, records
from hmsa_ros.bag.intake import ScannedFile
from hmsa_ros.bag.records import Block, MAGIC, PREFIX
from hmsa_ros.errors import BagError

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
