"""
Write a bag: a folder of MCAP files and ``metadata.yaml``, in the layout of rosbag2 (Jazzy).

The bag is readable at any time: each flush ends a chunk and passes it to the operating system,
``metadata.yaml`` exists from the start, and a write that fails is rolled back. Message payloads
are stored as given. A bag that is damaged, by a crash or a full disk, is written anew as far as it
can be read.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
import contextlib
from dataclasses import dataclass, replace
import itertools
import operator
import os
from pathlib import Path
import re

from hmsa import __version__
from hmsa.bag import limits, metadata, qos
from hmsa.bag.definitions import ROS1
from hmsa.bag.metadata import BagTopic
from hmsa.bag.output import Entry, OutputFile, PRESETS
from hmsa.bag.reader import BagReader, topic_number
from hmsa.bag.records import MESSAGE_HEAD
from hmsa.errors import BadInputError, BagError, check_choice, check_number

__all__ = ['BagWriter', 'MIN_FILE_SIZE', 'parse_custom_data', 'PRESETS', 'BagTopic']
# Total size up to which changes of the custom data are written to a file at once. Later ones, of a
# recording of hours, are in ``metadata.yaml`` at once and in the file at its end.
_NOTES_SIZE = 2**20
MIN_FILE_SIZE = 1024
#: Limit of the MCAP format.
MAX_CHANNELS = 2**16 - 1
_TOPIC_OF = operator.itemgetter(0)


class BagWriter:
    """
    Writes messages to a new bag.

    Parameters
    ----------
    folder : path
        Folder of the bag; must not exist.
    preset : str
        Name in `hmsa.bag.output.PRESETS`.
    chunk_size : int
        Length in bytes at which a chunk is closed.
    custom_data : mapping of str to str
        Stored in ``metadata.yaml`` and in a metadata record.
    ros_distro : str
        Stored in ``metadata.yaml``.
    fsync : bool
        Whether each flush waits until the data are on the disk.

    Attributes
    ----------
    folder, custom_data
        As given; see `note`.
    dropped : dict of str to int
        By topic, messages given to `write` that are not in the bag: not written at the end, or
        in a file that another process removed or shortened; see `check_files`.

    Raises
    ------
    BadInputError
        If the folder exists, cannot be made, or an option is out of range. Methods that write
        raise `OSError`.

    Notes
    -----
    The writer does not split by itself: the caller decides, by `file_size` and
    `file_duration_ns`. Until `close`, ``metadata.yaml`` marks the recording as not ended.

    """

    def __init__(
            self, folder: str | os.PathLike[str], *, preset: str = 'none',
            chunk_size: int = 768 * 1024, custom_data: Mapping[str, str] | None = None,
            ros_distro: str = 'jazzy', fsync: bool = False) -> None:
        check_choice('storage preset', preset, PRESETS)
        check_number('chunk size in bytes', chunk_size, least=1)
        self.folder = Path(folder)
        # Metadata and messages are UTF-8; the name of a folder can be any bytes.
        self._stem = re.sub('[\ud800-\udfff]', '_', self.folder.name)
        self._ros_distro = ros_distro
        self._topics: list[BagTopic] = []
        # Files that were left, with their counts and size; None if they have no summary.
        self._left: list[tuple[metadata.FileMetadata, Counter[int], int | None]] = []
        self._counts: Counter[int] = Counter()  # messages written, by the number of their topic
        self.custom_data: dict[str, str] = {}
        self.dropped: Counter[str] = Counter()
        self._add(custom_data or {})
        self._preset = preset
        self._chunk_size = chunk_size
        self._fsync = fsync
        self._waiting: list[Entry] = []
        self._waiting_size = 0
        self._start, self._end = 2**64, 0  # of the log times that wait
        self._file: OutputFile | None = None
        self._next_number = 0
        self._closed = False
        try:
            self.folder.mkdir(parents=True)
            self._open()
        except FileExistsError:
            raise BadInputError(
                f'{self.folder} exists: expected the name of a new bag; choose another name or '
                'remove it') from None
        except OSError as error:
            with contextlib.suppress(OSError):
                self.folder.rmdir()  # else the next attempt would find it
            raise BadInputError(
                f'{self.folder} cannot be made ({error.strerror}): expected a folder with space '
                'that can be written to') from error

    def __enter__(self) -> 'BagWriter':
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    @property
    def file_name(self) -> str:
        """Return the name of the file being written, empty if none is."""
        return self._file.path.name if self._file else ''

    @property
    def file_size(self) -> int:
        """Return the size of the file's messages, including pending ones, in bytes."""
        return self._waiting_size + (self._file.message_size if self._file else 0)

    @property
    def file_duration_ns(self) -> int:
        """Return the time between the first and the last message of the file, in ns."""
        start, end = self._start, self._end
        if self._file is not None:
            start, end = min(start, self._file.start), max(end, self._file.end)
        return max(0, end - start)

    @property
    def is_file_empty(self) -> bool:
        """Return whether the file being written has no message yet."""
        return not self._waiting and (self._file is None or not self._file.counts)

    def topic_counts(self) -> dict[str, int]:
        """Return the number of messages written."""
        return {topic.name: self._counts[number] for number, topic in enumerate(self._topics)}

    def add_topic(self, topic: BagTopic) -> int:
        """Add a topic and return its number; raise `BagError` beyond `MAX_CHANNELS`."""
        topic.check()
        number = topic_number(topic, self._topics)
        if number < len(self._topics):
            # All files contain the first profiles.
            if set(topic.profiles) - set(self._topics[number].profiles):
                self.note({qos.LATER + topic.name: qos.to_yaml(topic.profiles)})
            return number
        if number >= MAX_CHANNELS:
            raise BagError(f'a bag cannot have more than {MAX_CHANNELS} topics')
        self._topics.append(topic)
        return number

    def write(self, entries: Iterable[Entry]) -> None:
        """Add messages in any order of log times (ns); full chunks go to the file."""
        for entry in entries:
            log_time = entry[1]
            if not self._waiting:
                self._start = self._end = log_time
            elif log_time > self._end:
                self._end = log_time
            elif log_time < self._start:
                self._start = log_time
            self._waiting.append(entry)
            self._waiting_size += MESSAGE_HEAD.size + len(entry[4])
            if self._waiting_size >= self._chunk_size:
                self._write_chunk()

    def note(self, values: Mapping[str, str]) -> None:
        """Add to the custom data: in ``metadata.yaml``, and in the file at once or at its end."""
        self._add(values)
        if self._file is not None:
            if self._file.notes_size <= _NOTES_SIZE:
                self._file.note(self._notes())
            self._write_metadata()

    def flush(self) -> None:
        """Pass everything to the operating system, so that it survives the end of the process."""
        self._write_chunk()
        if self._file is not None:
            self._file.check_still_there()
            if self._fsync:
                self._file.sync()

    def split(self) -> str:
        """Close the file and continue in a new one."""
        self._write_chunk()
        self._finish_file()
        return self._open()

    def reopen(self) -> str:
        """Abandon the file after an `OSError`, and write the pending messages to a new one."""
        self.abandon()
        self.folder.mkdir(parents=True, exist_ok=True)
        name = self._open()
        self.flush()
        return name

    def drop_pending(self) -> None:
        """Discard the pending messages, and count them in `dropped`."""
        self.dropped.update(self._topics[entry[0]].name for entry in self._waiting)
        self._forget_waiting()

    def abandon(self) -> None:
        """Abandon the file after an `OSError`, closing it as well as possible."""
        file = self._file
        if file is None:
            return
        if not file.counts:
            self._discard(file)
            return
        try:
            self._finish_file()
        except OSError as error:
            if self._file is None:
                return  # closed; only the metadata could not be written
            file.close()
            if not isinstance(error, FileNotFoundError):
                # The file has its messages but no summary; `hmsa bag recover` adds one.
                self._left.append((file.summary(), file.counts, None))
            else:
                self._drop(file.counts)
            self._file = None

    def abort(self) -> None:
        """End as if the process was killed: the file stays as it is, marked as not ended."""
        if not self._closed and self._file is not None:
            self._file.close()
        self._closed, self._file = True, None

    def close(self) -> None:
        """Write the pending messages and close the bag; closing again does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self._write_chunk()
            self._finish_file()
        finally:
            self.drop_pending()
            self.abandon()
            self.write_metadata()

    def check_files(self) -> None:
        """Drop the messages in files that other processes removed or shortened meanwhile."""
        found: list[tuple[metadata.FileMetadata, Counter[int], int | None]] = []
        for entry, counts, size in self._left:
            path = self.folder / entry.path
            readable: Mapping[str, int] = {}
            with contextlib.suppress(OSError, BagError, BadInputError):
                if path.stat().st_size == size:
                    found.append((entry, counts, size))
                    continue
                readable = BagReader(path).counts()
            missing = Counter({number: count - readable.get(self._topics[number].name, 0)
                               for number, count in counts.items()})
            self._drop(+missing)
            if readable:
                left = counts - missing
                found.append((replace(entry, message_count=left.total()), left, None))
        self._left = found

    def write_metadata(self) -> None:
        """Write ``metadata.yaml`` again, if the folder is still there."""
        if self.folder.is_dir():
            self._write_metadata()

    def _drop(self, counts: Mapping[int, int]) -> None:
        """Count written messages that are not in the bag any more."""
        self._counts.subtract(counts)
        for number, count in counts.items():
            self.dropped[self._topics[number].name] += count

    def _open(self) -> str:
        """Open the next file and write its header and metadata."""
        while True:
            path = self.folder / f'{self._stem}_{self._next_number}.mcap'
            self._next_number += 1
            with contextlib.suppress(FileExistsError):
                file = self._file = OutputFile(path, self._preset, self._topics)
                break
        try:
            file.describe(self._serialized(file), self._notes())
            self._write_metadata()
        except OSError:
            self._discard(file)
            raise
        return path.name

    def _discard(self, file: OutputFile) -> None:
        """Remove a file without messages."""
        file.close()
        self._file = None
        self._next_number -= 1
        with contextlib.suppress(OSError):
            file.path.unlink()

    def _write_chunk(self) -> None:
        """Write the pending messages as one chunk."""
        if not self._waiting:
            return
        if self._file is None:
            raise OSError('no file is open')
        self._file.write(self._waiting)
        self._counts.update(map(_TOPIC_OF, self._waiting))
        self._forget_waiting()

    def _forget_waiting(self) -> None:
        """Begin the next chunk."""
        self._waiting, self._waiting_size = [], 0
        self._start, self._end = 2**64, 0

    def _finish_file(self) -> None:
        """Write metadata and summary, close the file and update ``metadata.yaml``."""
        file = self._file
        if file is None:
            return
        file.check_still_there()
        file.finish(self._serialized(file), self._notes(), fsync=self._fsync)
        self._left.append((file.summary(), file.counts, file.size))
        self._file = None
        self._write_metadata()

    def _write_metadata(self) -> None:
        """Update ``metadata.yaml``."""
        files = [*(x for x, _, _ in self._left), *([self._file.summary()] if self._file else [])]
        ended = {} if self._closed else {metadata.NOT_ENDED: 'true'}
        metadata.write(self.folder, self._metadata(
            files, self._counts, {**self.custom_data, **ended}))

    def _add(self, values: Mapping[str, str]) -> None:
        """Add to the custom data, escaping characters that UTF-8 cannot encode."""
        self.custom_data.update({_storable(x): _storable(y) for x, y in values.items()})

    def _notes(self) -> dict[str, str]:
        """Return the metadata record of the experiment."""
        return {'version': __version__, **self.custom_data}

    def _serialized(self, file: OutputFile) -> str:
        """Return the metadata of one file, as rosbag2 stores them in it."""
        return metadata.to_yaml(
            self._metadata([file.summary()], file.counts, self.custom_data), outer_key=False)

    def _metadata(
            self, files: Sequence[metadata.FileMetadata], counts: Mapping[int, int],
            custom_data: Mapping[str, str]) -> metadata.BagMetadata:
        filled = [file for file in files if file.message_count]
        start = min((file.start_ns for file in filled), default=metadata.NO_TIME)
        end = max((file.start_ns + file.duration_ns for file in filled), default=start)
        return metadata.BagMetadata(
            start, end - start, sum(file.message_count for file in files),
            tuple(replace(topic, message_count=counts.get(number, 0))
                  for number, topic in enumerate(self._topics)),
            tuple(files), custom_data, self._ros_distro)


def _storable(text: str) -> str:
    """Return a text with the characters escaped that UTF-8 cannot encode."""
    return text.encode('utf-8', 'backslashreplace').decode()


def parse_custom_data(pairs: Iterable[str]) -> dict[str, str]:
    """Read pairs like ``'actuator=A3'``; raise `BadInputError` if malformed or repeated."""
    values: dict[str, str] = {}
    for pair in itertools.filterfalse(lambda text: not text, pairs):
        key, equals, value = pair.partition('=')
        if not equals or not key.strip():
            raise BadInputError(f'custom data is {pair!r}: expected key=value')
        if key.strip() in values:
            raise BadInputError(f'custom data has the key {key.strip()!r} twice: expected once')
        values[key.strip()] = value
    return values


@dataclass(frozen=True)
class Recovered:
    """Folder and number of messages of the new bag, and the unreadable parts of the old one."""

    folder: str
    message_count: int
    problems: tuple[str, ...]


def recover(
        path: str | os.PathLike[str], out: str | os.PathLike[str], *,
        max_chunk_size: int = limits.CHUNK_SIZE) -> Recovered:
    """Write all that can be read of a bag to a new one; raise `BagError` unless it reads back."""
    reader = BagReader(path, max_chunk_size=max_chunk_size)
    if any(topic.encoding == ROS1 for topic in reader.topics.values()):
        raise BadInputError(
            f'{path} is a bag of ROS 1, whose messages are encoded otherwise: expected one of ROS '
            f'2; convert it with "rosbags-convert --src {path} --dst {out} --dst-storage mcap"')
    try:
        with BagWriter(out, custom_data=reader.custom_data) as writer:
            numbers = {name: writer.add_topic(replace(topic, type=topic.type or 'unknown'))
                       for name, topic in reader.topics.items()}
            writer.write((
                numbers[x.topic], x.log_time, x.publish_time, x.sequence, x.data)
                for x in reader.stored_messages())
        expected = writer.topic_counts()
    except OSError as error:
        raise BagError(f'{out} cannot be written: {error.strerror or error}') from error
    check = BagReader(out, max_chunk_size=max_chunk_size + limits.CHUNK_SIZE)
    found = dict.fromkeys(check.topics, 0)
    for message in check.messages():
        found[message.topic] += 1
    if not check.complete or found != expected:
        raise BagError(f'{out} does not read back as written: '
                       + ('; '.join(check.problems) or f'{found}, expected {expected}'))
    # The count comes last because it may find more damage.
    reader.counts()
    return Recovered(str(out), sum(found.values()), tuple(reader.problems))
