"""A file of a bag record by record: what is left of one without a summary to be trusted."""

from collections.abc import Iterator
from dataclasses import replace
import os
import struct

from mcap.opcode import Opcode
from mcap.records import Channel, Footer, McapRecord, Schema, Statistics

from hmsa_ros.bag import limits, records
from hmsa_ros.bag.intake import ScannedFile
from hmsa_ros.bag.records import Block, MAGIC, PREFIX
from hmsa_ros.errors import BagError

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
