"""
Bags of SQLite, of ROS 1, and compressed by rosbag2 as a whole, read by rosbags.

MCAP files are read by `hmsa.bag.scan`, because rosbags 0.11 leaves out the times of publishing,
by which plans are told from earlier ones that arrive late, refuses files that were cut off, and
takes 1059 MiB for a file of 17 kB made to do so, of which `scan` reads the rest in 25 MiB. Raw
messages come at 0.57 M/s (`scan`: 0.82 M/s), 100,000 JointState are decoded in 1.0 s (1.1 s).
"""

from collections.abc import Callable, Iterator
import contextlib
from pathlib import Path
from typing import Any

from mcap.records import Channel, Schema

from hmsa.bag import limits
from hmsa.bag.definitions import ROS1
from hmsa.bag.metadata import advice_on, BagMetadata, FILE_NAME
from hmsa.bag.records import Message, MessageBlock
from hmsa.bag.scan import ReadLimits
from hmsa.errors import BadInputError

_MAGICS = b'SQLite format 3\0', b'#ROSBAG V'
# Of SQLite's integers.
_LATEST = 2**63 - 1
_ENCODINGS = {'MSG': 'ros2msg', 'IDL': 'ros2idl', 'NONE': ''}


def is_foreign(path: Path) -> bool:
    """Return whether rosbags reads a file, or the folder of a compressed bag."""
    if path.is_dir():
        return True
    begin = b''
    with contextlib.suppress(OSError), path.open('rb') as file:  # `ScannedFile` reports it
        begin = file.read(len(_MAGICS[0]))
    return begin.startswith(_MAGICS) or path.suffix in ('.db3', '.bag')


class ForeignFile:
    """A file, or a whole compressed bag, with the interface of `hmsa.bag.scan.ScannedFile`."""

    closed = True

    def __init__(
            self, intake: ReadLimits, path: Path, number: int,
            metadata: BagMetadata | None) -> None:
        self.path = path
        self.paths = [path] if path.is_file() else sorted(
            x for x in path.iterdir() if x.name != FILE_NAME)
        self.metadata: dict[str, dict[str, str]] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._intake = intake
        self._number = number
        # Up to version 7 of the metadata, none is named.
        self._distribution = metadata.ros_distro if metadata else ''
        self._damaged = self._counted = False
        try:
            with self._opened() as reader:
                self._take(reader)
        except Exception as error:  # rosbags, apsw and the parsers of each format raise their own
            for x in self.paths:
                # In a compressed bag, compressed files are no mistake.
                if (advice := advice_on(x)) and (x == path or x.suffix != '.zstd'):
                    raise BadInputError(f'{x} {advice}') from error
            what = ' '.join(str(error).split()) or type(error).__name__
            raise BadInputError(
                f'{path} cannot be read ({what}): expected a bag of MCAP, SQLite or ROS 1'
            ) from error
        log = path.with_name(f'{path.name}-wal')
        if log.is_file() and log.stat().st_size:
            self.problem(f': the messages in {log.name} are not read: the recorder of the bag '
                         f'was killed, or is still recording; sqlite3 {path.name} "PRAGMA '
                         'wal_checkpoint" moves '
                         'them into the bag')

    @property
    def complete(self) -> bool:
        """Return whether no damage has been found so far."""
        return not self._damaged

    def problem(self, sentence: str) -> None:
        """Record a problem, and that the file is damaged."""
        self._damaged = True
        self._intake.problem(f'{self.path.name}{sentence}')

    def counts(self) -> dict[int, int]:
        """Return the messages by channel, counted by reading them: these files have no CRC."""
        small = sum(x.stat().st_size for x in self.paths) <= limits.CHECKED_SIZE
        if not self._counted and (small or self._damaged):
            self._counted = True
            self._counts = dict.fromkeys(self.channels, 0)
            for number, _, _ in self._messages(set(self.channels), 0, _LATEST):
                self._counts[number] += 1
        return self._counts

    def cursor(
            self, block: MessageBlock, topic_of: Callable[[int], str | None], start: int,
            end: int) -> 'ForeignCursor':
        """Return the messages of the file in order of time."""
        names = {number: name for number in self.channels
                 if (name := topic_of(number)) is not None}
        return ForeignCursor((block.file, block.offset), (
            Message(names[number], time, 0, 0, data)
            for number, time, data in self._messages(set(names), start, end)))

    def _opened(self) -> Any:
        """Return a reader; each iteration has its own, since it may be in another thread."""
        from rosbags import rosbag1, rosbag2
        if self.path.is_file() and self.path.suffix == '.bag':
            return rosbag1.Reader(self.path)
        return rosbag2.Reader(self.path)

    def _take(self, reader: Any) -> None:
        """Take in topics, counts and times."""
        for x in reader.connections:
            encoding = _ENCODINGS[x.msgdef.format.name]
            ros1 = not hasattr(x.ext, 'serialization_format')
            definition = x.msgdef.data or self._known(x.msgtype)
            self.schemas[x.id] = Schema(
                id=x.id, name=x.msgtype, encoding=ROS1 if ros1 else encoding or 'ros2msg',
                data=definition.encode())
            self.channels[x.id] = Channel(
                id=x.id, topic=x.topic, schema_id=x.id,
                message_encoding=ROS1 if ros1 else x.ext.serialization_format,
                metadata={'topic_type_hash': x.digest} if x.digest and not ros1 else {})
        self._counts = {x.id: x.msgcount for x in reader.connections}
        self.said: int | None = reader.message_count
        self.blocks = [MessageBlock(
            self._number, 0, 0, 1, reader.start_time, reader.end_time - 1)] if self.said else []

    def _known(self, kind: str) -> str:
        """Return the definition of a type in its distribution, empty if it is none of ROS."""
        from rosbags.typesys import get_typestore, Stores, TypesysError
        name = f'ROS2_{self._distribution.upper()}'
        try:
            store = get_typestore(Stores[name if name in Stores.__members__ else 'ROS2_HUMBLE'])
            return str(store.generate_msgdef(kind, ros_version=2)[0])
        except (KeyError, TypesysError):
            return ''

    def _messages(
            self, numbers: set[int], start: int, end: int
            ) -> Iterator[tuple[int, int, bytes]]:
        """Yield number of the channel, time and payload; report damage."""
        if not numbers:
            return
        try:
            with self._opened() as reader:
                for connection, time, data in reader.messages(
                        [x for x in reader.connections if x.id in numbers], start,
                        min(end, _LATEST)):
                    yield connection.id, time, bytes(data)
        except Exception as error:  # see __init__
            what = ' '.join(str(error).split()) or type(error).__name__
            self.problem(f': {what}: the rest is skipped')


class ForeignCursor:
    """A position in an iteration, with the interface of `hmsa.bag.records.Cursor`."""

    size = 0

    def __init__(self, key: tuple[int, int], messages: Iterator[Message]) -> None:
        self.key = key
        self._messages = messages
        self._next = next(messages, None)

    def sort(self) -> None:
        """Do nothing: rosbags sorts."""

    @property
    def left(self) -> bool:
        """Return whether there is a next message."""
        return self._next is not None

    @property
    def time(self) -> int:
        """Return the log time of the next message."""
        assert self._next is not None
        return self._next.log_time

    def take(self, limit: int) -> Iterator[Message]:
        """Yield the next messages before a log time."""
        while self._next is not None and self._next.log_time < limit:
            yield self._next
            self._next = next(self._messages, None)
