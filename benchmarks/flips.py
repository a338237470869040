"""
One-bit changes of bags: each must be harmless or reported.

The bits are those of the headers of all records of a bag: opcode, length, timestamps, sizes,
checksums, and entire small records. A bag with one such bit flipped is read as `hmsa bag info`
and `hmsa bag recover` read it; the result is compared with the bag as written.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
import random
import shutil
import struct
from typing import Any

from mcap.opcode import Opcode

from hmsa.bag.info import summarize
from hmsa.bag.reader import BagReader
from hmsa.bag.records import MAGIC, PREFIX
from hmsa.bag.writer import BagTopic, BagWriter
from hmsa.errors import HmsaError

_FLOAT = 'std_msgs/msg/Float64'
# Bytes of a chunk or a message index before its bulk.
_HEADS = {Opcode.CHUNK: 48, Opcode.MESSAGE_INDEX: 22}
# Until a file is closed, MCAP has no checksum for the texts of its metadata records.
_HEADS_KILLED = {**_HEADS, Opcode.METADATA: 4}


@dataclass(frozen=True)
class Count:
    """Result of the flips."""

    said: int  # a problem was reported, or the bag refused
    harmless: int  # nothing was reported, and everything was read as written
    wrong: tuple[str, ...]  # something else was read without a report


def make_bag(folder: Path, *, preset: str = 'none', killed: bool = False) -> Path:
    """Write a bag of two topics in several chunks."""
    writer = BagWriter(folder, preset=preset, chunk_size=1000, custom_data={'actuator': 'A3'})
    numbers = [writer.add_topic(BagTopic(name, _FLOAT, 'float64 data\n')) for name in ('/a', '/b')]
    writer.write((
        numbers[i % 3 == 0], 10**18 + i * 10**6, 10**18 + i * 10**6, i,
        bytes((0, 1, 0, 0)) + struct.pack('<d', i)) for i in range(300))
    writer.flush()
    if killed:
        writer.abort()
    else:
        writer.close()
    return folder / f'{folder.name}_0.mcap'


def header_bits(data: bytes, *, killed: bool = False) -> list[int]:
    """Return the bits (eight times the byte's offset, plus the bit) of all records' headers."""
    bits: list[int] = []
    heads = _HEADS_KILLED if killed else _HEADS
    offset = len(MAGIC)
    while offset + PREFIX.size <= len(data):
        opcode, length = PREFIX.unpack_from(data, offset)
        if not opcode:
            break
        end = offset + PREFIX.size + min(length, heads.get(opcode, length))
        bits += range(8 * offset, 8 * min(end, len(data)))
        offset += PREFIX.size + length
    return bits


def flip(path: Path, bits: Sequence[int], work: Path) -> Count:
    """Read a bag with one flipped bit at a time."""
    original = path.read_bytes()
    truth = _read(path.parent)
    copy = work / path.parent.name
    shutil.copytree(path.parent, copy)
    said, harmless, wrong = 0, 0, []
    for bit in bits:
        changed = bytearray(original)
        changed[bit // 8] ^= 1 << bit % 8
        (copy / path.name).write_bytes(changed)
        try:
            found = _read(copy)
        except HmsaError:
            said += 1
            continue
        if set(found[-1]) - set(truth[-1]):
            said += 1
        elif found[:-1] == truth[:-1]:
            harmless += 1
        else:
            wrong.append(f'bit {bit % 8} of byte {bit // 8}')
    return Count(said, harmless, tuple(wrong))


def _read(folder: Path) -> tuple[Any, ...]:
    """Read a bag as the commands do; the problems are the last element."""
    summary = summarize(folder)
    reader = BagReader(folder)
    in_time = list(reader.messages())
    stored = list(reader.stored_messages())
    file = BagReader(reader.files[0])
    problems = [x.replace(str(folder), 'bag') for x in (*summary.problems, *reader.problems)]
    return (summary.start_ns, summary.end_ns, summary.topics, summary.custom_data,
            summary.complete, in_time, stored, file.records, file.custom_data, problems)


def samples(count: int, work: Path) -> Iterator[tuple[str, Count]]:
    """Flip bits of bags of every kind."""
    dice = random.Random(6)
    kinds = [(preset, killed) for preset in ('none', 'zstd_fast', 'lz4')
             for killed in (False, True)]
    for number, (preset, killed) in enumerate(kinds):
        name = f'{preset}{"_killed" if killed else ""}'
        path = make_bag(work / name, preset=preset, killed=killed)
        bits = header_bits(path.read_bytes(), killed=killed)
        share = count // len(kinds) + (number < count % len(kinds))
        (work / 'changed').mkdir(exist_ok=True)
        yield name, flip(path, dice.sample(bits, min(share, len(bits))), work / 'changed')
