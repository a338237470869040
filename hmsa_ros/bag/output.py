"""
One MCAP file being written.

A chunk is in the file whole or not at all, and room for the chunk and for the summary is taken
on the disk before, so that a full disk leaves a file that can still be closed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import os
from pathlib import Path

from hmsa_ros import __version__
from hmsa_ros.bag import metadata, qos
from hmsa_ros.bag.framing import Entry, Framing, Stream
from hmsa_ros.bag.records import MESSAGE_HEAD
from hmsa_ros.bag.topics import Topic

LIBRARY = f'hmsa_ros {__version__}'
#: Name of the metadata record with the experiment.
EXPERIMENT = 'hmsa_ros'
#: Room is taken in steps of so many bytes.
RESERVE_STEP = 256 * 1024
# A message with its index entry; a channel in the indexes of a chunk; a chunk.
_MESSAGE_BYTES = MESSAGE_HEAD.size + 16
_CHANNEL_BYTES = 25
_CHUNK_BYTES = 256


@dataclass(frozen=True)
class Preset:
    """How chunks are stored: compression, and whether with checksums."""

    compression: str = ''
    crc: bool = True


# Names as rosbag2 has them, and lz4. With fastwrite rosbag2 leaves out chunks too; here they
# stay, since the recovery of a cut file goes by them.
PRESETS: Mapping[str, Preset] = {
    'none': Preset(),
    'fastwrite': Preset(crc=False),
    'lz4': Preset('lz4'),
    'zstd_fast': Preset('zstd'),
    'zstd_small': Preset('zstd'),
}


class OutputFile(Framing):
    """
    One file of a bag; its methods raise `OSError` if the disk does not take what they write.

    ``counts`` has the messages stored by topic, ``overhead`` the bytes of all else, ``noted`` what
    the metadata records say of the experiment, and ``notes_size`` their length.
    """

    def __init__(self, path: Path, number: int, preset: Preset) -> None:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        super().__init__(Stream(descriptor), LIBRARY, preset.compression, crc=preset.crc)
        self.path = path
        self.number = number
        self.overhead = self.notes_size = 0
        self.noted: dict[str, str] = {}
        self._types: dict[str, int] = {}
        self._ending = False
        self._end_size = self._notes_room = self._room = 0

    @property
    def size(self) -> int:
        """Return how many bytes are stored."""
        return self._stream.stored

    def reserve(self, size: int) -> None:
        """Take room for some bytes more and for the end of the file."""
        needed = self.size + size + self._end_size + self._notes_room + RESERVE_STEP // 2
        if needed > self._room:
            room = -(-needed // RESERVE_STEP) * RESERVE_STEP
            os.posix_fallocate(self._stream.descriptor, 0, room)
            self._room = room

    def declare(self, topic: Topic) -> None:
        """Announce the next topic; it is stored with the next chunk and in the summary."""
        data = topic.definition.encode()
        values = {
            'offered_qos_profiles': qos.to_yaml(topic.profiles),
            'topic_type_hash': topic.type_hash}
        size = len(topic.name) * 4 + sum(map(len, values.values())) + 100
        if topic.type not in self._types:
            size += len(data) + len(topic.type) * 4
        # In a chunk, in the summary, and in the metadata.
        self._end_size += 4 * size
        self.reserve(0)
        self.overhead += size
        if topic.type not in self._types:
            self._types[topic.type] = self.add_schema(
                topic.type, topic.definition_encoding, data)
        self.add_channel(topic.name, self._types[topic.type], values)

    def write(self, entries: Sequence[Entry], size: int) -> None:
        """Store messages with ``size`` bytes of payload as one chunk."""
        index = _CHUNK_BYTES + _CHANNEL_BYTES * len({entry[0] for entry in entries})
        content = size + _MESSAGE_BYTES * len(entries) + self.overhead
        # What cannot be compressed becomes a little longer.
        self.reserve(content + content // 128 + 2 * index)
        self._end_size += index
        self.add_chunk(entries)

    def describe(self, serialized_metadata: str, notes: Mapping[str, str]) -> None:
        """Store the record that rosbag2 has at both ends of a file, and the experiment."""
        self._store('rosbag2', {'serialized_metadata': serialized_metadata})
        self.note(notes)

    def note(self, values: Mapping[str, str]) -> None:
        """Store what of the experiment the file does not say yet: viewers show each record."""
        new = {key: value for key, value in values.items() if self.noted.get(key) != value}
        if new:
            # All of it comes once more at the end, and twice in the metadata file.
            self._notes_room = 4 * sum(len(key) + len(value) for key, value in values.items())
            self.notes_size += self._store(EXPERIMENT, new)
            self.noted.update(new)

    def _store(self, name: str, values: Mapping[str, str]) -> int:
        """Store a metadata record and return its length."""
        if not self._ending:
            self.reserve(100 + sum(
                4 * (len(key) + len(value)) + 8 for key, value in values.items()))
        self._end_size += len(name) + 50
        before = self.size
        self.add_metadata(name, values)
        self.overhead += self.size - before
        return self.size - before

    def finish(
            self, serialized_metadata: str, notes: Mapping[str, str], *, fsync: bool) -> None:
        """Store the metadata and the summary in the room taken, and close the file."""
        self._ending = True
        self.describe(serialized_metadata, notes)
        self.add_summary()
        os.ftruncate(self._stream.descriptor, self.size)
        if fsync:
            self.sync()
        self.close()

    def sync(self) -> None:
        """Wait until what is stored is on the disk."""
        os.fsync(self._stream.descriptor)

    def close(self) -> None:
        """Close the file as it is."""
        os.close(self._stream.descriptor)

    def check_still_there(self) -> None:
        """Raise `FileNotFoundError` if the file was removed: what is written is lost."""
        try:
            there = os.stat(self.path)
        except OSError as error:
            raise FileNotFoundError(
                error.errno, f'{self.path} is gone', str(self.path)) from error
        if not os.path.samestat(there, os.fstat(self._stream.descriptor)):
            raise FileNotFoundError(2, f'{self.path} has been replaced', str(self.path))

    def summary(self) -> metadata.FileMetadata:
        """Return what the bag's metadata say of the file."""
        if not self.counts:
            return metadata.FileMetadata(self.path.name)
        return metadata.FileMetadata(
            self.path.name, self.start, self.end - self.start, sum(self.counts.values()))
