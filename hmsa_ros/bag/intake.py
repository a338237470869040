"""What the scan of a file takes in, within limits, and the problems that it finds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from mcap.records import Channel, McapRecord, Metadata, Schema

from hmsa_ros.bag import limits
from hmsa_ros.bag.records import Block
from hmsa_ros.errors import BagError, printable

_Declared = TypeVar('_Declared', Schema, Channel)
# What an entry of a map takes besides its texts.
_ENTRY_BYTES = 100


class Problems:
    """Sentences about what cannot be read, each once and not without end."""

    def __init__(self) -> None:
        self.sentences: list[str] = []
        self._known: set[str] = set()

    def add(self, sentence: str) -> None:
        """Note one."""
        if sentence in self._known or len(self._known) > limits.PROBLEMS:
            return
        self._known.add(sentence)
        self.sentences.append(
            printable(sentence) if len(self._known) <= limits.PROBLEMS
            else 'further problems are not listed')


@dataclass
class Intake:
    """What is taken in of all files of a bag, within a limit in bytes for chunks and messages."""

    max_chunk_size: int
    problems: Problems
    kept: int = 0  #: bytes of schemas, channels and metadata

    def check_size(self, size: int, what: str) -> None:
        """Raise `BagError` for what is larger, in bytes, than the memory it may take."""
        if size > self.max_chunk_size:
            raise BagError(f'a {what} of {size} bytes is larger than the {self.max_chunk_size} '
                           'bytes allowed')

    def keep(self, size: int) -> None:
        """Count what is kept of the small records; raise `BagError` for too much of it."""
        if self.kept + size > limits.KEPT_SIZE:
            raise BagError(f'schemas, channels and metadata are larger than '
                           f'{limits.KEPT_SIZE} bytes')
        self.kept += size


@dataclass
class ScannedFile:
    """What a file holds; records by their id, metadata records by name."""

    path: Path
    number: int  #: its place in the bag
    size: int  #: in bytes
    intake: Intake
    complete: bool = False  #: whether it was closed by its writer
    damaged: bool = False  #: whether something in it does not agree with the rest
    counted: bool = False  #: whether `counts` were counted, and not only read
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)  #: its parts with messages, in their order
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)  #: messages by channel
    data_end: int = 0
    data_crc: int = 0  #: CRC-32 of the data; 0 for none

    def problem(self, sentence: str) -> None:
        """Note that something is damaged."""
        self.damaged = True
        self.intake.problems.add(f'{self.path.name}{sentence}')

    def add_block(self, block: Block, offset: int) -> None:
        """Take in a chunk that is not too large."""
        try:
            self.intake.check_size(max(block.size, block.length), 'chunk')
        except BagError as error:
            self.problem(f': {error}, at byte {offset}: skipped')
        else:
            self.blocks.append(block)

    def take(self, record: McapRecord) -> None:
        """Take in a schema, channel or metadata, or raise `BagError` if it is too large."""
        if isinstance(record, Schema):
            if self._is_new(self.schemas, record):
                self.intake.keep(len(record.data))
                if len(record.data) > limits.DEFINITION_SIZE:
                    raise BagError(
                        f'the definition of {record.name} has {len(record.data)} bytes, more '
                        f'than {limits.DEFINITION_SIZE}')
                self.schemas[record.id] = record
        elif isinstance(record, Channel):
            if self._is_new(self.channels, record):
                self.intake.keep(sum(map(len, record.metadata.values())) + len(record.topic))
                self.channels[record.id] = record
        elif isinstance(record, Metadata):
            values = self.metadata.setdefault(record.name, {})
            self.intake.keep(len(record.name) + sum(
                len(value) + (0 if key in values else len(key) + _ENTRY_BYTES)
                for key, value in record.metadata.items() if values.get(key) != value))
            values.update(record.metadata)

    def _is_new(self, known: Mapping[int, _Declared], record: _Declared) -> bool:
        """Return whether a declaration is to be taken in."""
        what = type(record).__name__.lower()
        if record.id in known:
            if known[record.id] != record:
                self.problem(f': {what} {record.id} is declared in two ways')
            return False
        if len(known) >= limits.CHANNELS:
            self.problem(f' declares more than {limits.CHANNELS} of {what}: the rest is skipped')
            return False
        return True
