"""
Read a bag, a folder or a single file, of this package, of rosbag2 or of ROS 1.

For analysis without ROS, use one function::

    read_messages(path, topics=None, *, start=None, end=None)
        -> iterator of DecodedMessage(topic, log_time_ns, publish_time_ns, message)

in order of log time over all files of the bag, messages with equal times in the order written.
``message`` has the fields of the message type as attributes (``message.header.stamp.sec``). For
raw payloads use `BagReader`.

Unreadable parts are skipped and reported in `BagReader.problems`, one sentence each: a truncated
file is read up to its end, a damaged chunk is skipped.

Bags can come from untrusted sources: sizes in MCAP files are checked against `hmsa.bag.limits`
before memory is allocated, only files in the bag's folder are read, and no content is executed.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
import os
from pathlib import Path
from typing import Any, NamedTuple

from mcap.records import Schema

from hmsa.bag import limits, metadata, qos
from hmsa.bag.definitions import EMPTY, installed, make_decoder
from hmsa.bag.foreign import ForeignFile, is_foreign
from hmsa.bag.metadata import BagTopic, find_files
from hmsa.bag.output import EXPERIMENT
from hmsa.bag.records import AnyCursor, merge, Message, MessageBlock
from hmsa.bag.scan import ReadLimits, ScannedFile
from hmsa.errors import BadInputError, BagError, check_number, HmsaError

__all__ = ['BagReader', 'DecodedMessage', 'Message', 'BagTopic', 'read_messages']
# Later than any log time.
_NEVER = 2**64


class DecodedMessage(NamedTuple):
    """A decoded message: topic, times in ns, and the message."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    message: Any


class BagReader:
    """
    Reads a bag.

    Parameters
    ----------
    path : path
        Folder of a bag, or one of its files (``.mcap``, ``.db3``, ``.bag``).
    max_chunk_size : int
        Largest content of a chunk, and largest message, in bytes; larger ones are skipped. Reading
        takes at most a few times as much memory.

    Attributes
    ----------
    path : pathlib.Path
        As given.
    files : tuple of pathlib.Path
        The files read, in order.
    topics : mapping of str to BagTopic
        By name, in order of appearance.
    metadata : hmsa.bag.metadata.BagMetadata or None
        Content of ``metadata.yaml``; None if it is missing or unreadable.
    custom_data : mapping of str to str
        From ``metadata.yaml``, or else from the files.
    records : mapping of str to mapping
        Metadata records by name. Records of the same name are combined, later values replacing
        earlier ones.
    problems : list of str
        Unreadable parts found so far, one sentence each; grows while messages are read.

    Raises
    ------
    BadInputError
        If no file can be read.

    """

    def __init__(
            self, path: str | os.PathLike[str], *,
            max_chunk_size: int = limits.CHUNK_SIZE) -> None:
        check_number('largest chunk in bytes', max_chunk_size, least=1)
        self.path = Path(path)
        self._max_chunk_size = max_chunk_size
        intake = ReadLimits(max_chunk_size)
        self.problems = intake.problems
        paths, self.metadata = find_files(self.path, intake.problem)
        self._files: list[ScannedFile | ForeignFile] = []
        for file_path in paths:
            try:
                number = len(self._files)
                self._files.append(
                    ForeignFile(intake, file_path, number, self.metadata)
                    if is_foreign(file_path) else ScannedFile(intake, file_path, number))
            except HmsaError as error:
                if len(paths) == 1 and isinstance(error, BadInputError):
                    raise
                intake.problem(str(error))
        if not self._files:
            raise BadInputError(f'no file of {self.path} can be read: ' + self.problems[0])
        self.files = tuple(path for file in self._files for path in file.paths)
        self.records: dict[str, dict[str, str]] = {}
        for file in self._files:
            for name, values in file.metadata.items():
                self.records.setdefault(name, {}).update(values)
        noted = {} if self.metadata is None else dict(self.metadata.custom_data)
        self._ended = metadata.NOT_ENDED not in noted
        noted.pop(metadata.NOT_ENDED, None)
        if not self._ended:
            intake.problem(f'{self.path} was not closed by its recorder: it was killed, or '
                           'is still recording')
        self.custom_data = noted or {
            key: value for key, value in self.records.get(EXPERIMENT, {}).items()
            if key != 'version'}
        # Messages by file; of old versions of the metadata, 0.
        self._listed = {} if self.metadata is None or paths == [self.path] else {
            Path(x.path).name: x.message_count for x in self.metadata.files}
        read = {x.name for x in self.files}
        self._missing = sum(
            max(1, count) for name, count in self._listed.items() if name not in read)
        described = {} if self.metadata is None else {x.name: x for x in self.metadata.topics}
        self.topics = _topics_of(self._files, described, self.custom_data, intake.problem)

    @property
    def complete(self) -> bool:
        """Return whether the bag was closed, and no damage of it has been found so far."""
        return self.closed and not self._missing and all(file.complete for file in self._files)

    @property
    def closed(self) -> bool:
        """Return whether every file, and the bag as a whole, was closed by its writer."""
        return self._ended and all(file.closed for file in self._files)

    def unreadable(self) -> int:
        """Return how many messages cannot be read that the files or ``metadata.yaml`` list."""
        said = sum(max(file.said or 0, self._listed.get(file.path.name, 0))
                   for file in self._files) + self._missing
        if self.metadata is not None and self._ended:
            said = max(said, self.metadata.message_count)
        return max(0, said - sum(self.counts().values()))

    @property
    def start_time(self) -> int | None:
        """Return the first log time in nanoseconds, None without a message."""
        return min((block.start for block in self._filled_blocks()), default=None)

    @property
    def end_time(self) -> int | None:
        """Return the last log time in nanoseconds, None without a message."""
        return max((block.end for block in self._filled_blocks()), default=None)

    def _filled_blocks(self) -> Iterator[MessageBlock]:
        """Return the blocks with messages."""
        for file in self._files:
            for block in file.blocks:
                # A chunk without messages has the times 0, and so may messages recorded without
                # a clock.
                if block.size and (block.end or self._has_messages(block)):
                    yield block

    def _has_messages(self, block: MessageBlock) -> bool:
        """Return whether a block has messages, by reading it."""
        cursor = self._cursor(block)
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
            Called before each chunk; the iteration ends when it returns True.

        Yields
        ------
        Message
            Messages with equal times in the order written.

        """
        blocks = sorted(
            (block for block in self._filled_blocks()
             if (start is None or block.end >= start) and (end is None or block.start < end)),
            key=lambda block: (block.start, block.file, block.offset))
        wanted = None if topics is None else frozenset(topics)
        most = limits.CHUNKS_AT_ONCE * self._max_chunk_size
        active: list[AnyCursor] = []
        for i, block in enumerate(blocks):
            if cancelled():
                return
            if sum(cursor.size for cursor in active) + block.size > most:
                # All active chunks overlap with this one.
                self._files[block.file].problem(
                    f': more than {most} bytes of chunks overlap in time, at byte '
                    f'{block.offset}: skipped')
            else:
                cursor = self._cursor(
                    block, wanted, 0 if start is None else start, _NEVER if end is None else end)
                if cursor is not None:
                    cursor.sort()
                    active.append(cursor)
            yield from merge(active, blocks[i + 1].start if i + 1 < len(blocks) else _NEVER)
            active = [cursor for cursor in active if cursor.left]

    def stored_messages(self) -> Iterator[Message]:
        """Yield all messages in the order stored."""
        for file in self._files:
            for block in file.blocks:
                cursor = self._cursor(block)
                if cursor is not None:
                    yield from cursor.take(_NEVER)

    def counts(self) -> dict[str, int]:
        """Return the number of messages by topic, counting them if the statistics may be wrong."""
        result = dict.fromkeys(self.topics, 0)
        for file in self._files:
            for number, count in file.counts().items():
                name = self._topic_of(file, number) or ''
                if name in result:
                    result[name] += count
        return result

    def _cursor(
            self, block: MessageBlock, topics: Collection[str] | None = None, start: int = 0,
            end: int = _NEVER) -> AnyCursor | None:
        """Return the messages of a block in the order stored; report damage."""
        file = self._files[block.file]

        def topic_of(channel: int) -> str | None:
            name = self._topic_of(file, channel)
            return name if topics is None or name in topics else None

        return file.cursor(block, topic_of, start, end)

    def _topic_of(self, file: ScannedFile | ForeignFile, number: int) -> str | None:
        """Return the topic of a channel, None if its messages are skipped."""
        channel = file.channels.get(number)
        if channel is None:
            file.problem(f': channel {number} is not declared: its messages are skipped')
            return None
        known = self.topics.get(channel.topic)
        schema = file.schemas.get(channel.schema_id)
        if known is None or schema is not None and schema.name != known.type:
            return None
        return channel.topic

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
        return make_decoder(info)


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


def topic_number(topic: BagTopic, known: Sequence[BagTopic]) -> int:
    """Return the number of a topic among those known, or the next one for a new topic."""
    return next((
        number for number, other in enumerate(known)
        if (other.name, other.type) == (topic.name, topic.type)), len(known))


def _topics_of(
        files: Iterable[ScannedFile | ForeignFile], described: Mapping[str, BagTopic],
        custom_data: Mapping[str, str], problem: Callable[[str], None]) -> dict[str, BagTopic]:
    """Return the topics of files, with the profiles of their metadata, in order of appearance."""
    topics: dict[str, BagTopic] = {}
    for file in files:
        for channel in file.channels.values():
            name, known = channel.topic, topics.get(channel.topic)
            schema, stored = file.schemas.get(channel.schema_id), described.get(name)
            if schema is None:
                schema = Schema(
                    id=0, name='' if stored is None else stored.type, encoding='', data=b'')
            if known is not None and known.type != schema.name:
                problem(f'topic {name} has the types {known.type} and {schema.name}: the '
                        f'messages of type {schema.name} are skipped')
                continue
            profiles, later = (
                _profiles(text, f'{file.path.name}: topic {name}', problem) for text in (
                    channel.metadata.get('offered_qos_profiles', ''),
                    custom_data.get(qos.LATER + name, '')))
            for more in () if stored is None else stored.profiles, later:
                profiles += tuple(x for x in more if x not in profiles)
            if known is None:
                topic = topics[name] = BagTopic(
                    name, schema.name, schema.data.decode('utf-8', 'replace'), schema.encoding,
                    profiles, channel.metadata.get('topic_type_hash', ''),
                    channel.message_encoding)
                if not schema.data.strip() and topic.type != EMPTY and (
                        schema.encoding in ('', 'ros2msg')):
                    topics[name] = _defined(topic, file.path.name, problem)
            elif len(profiles) > len(known.profiles):
                # A later file may contain more publishers.
                topics[name] = replace(known, profiles=profiles)
    return topics


def _defined(topic: BagTopic, file: str, problem: Callable[[str], None]) -> BagTopic:
    """Return a topic without a definition with that of the installed type, if there is one."""
    try:
        return installed(topic)
    except BagError as error:
        problem(f'{file}: topic {topic.name} has no message definition: its messages can be sent '
                f'again but not decoded ({error})')
        return topic


def _profiles(text: str, where: str, problem: Callable[[str], None]) -> tuple[qos.Qos, ...]:
    """Return stored profiles, none if they cannot be read."""
    try:
        return qos.from_stored(text)
    except BagError as error:
        problem(f'{where}: {error}')
        return ()
