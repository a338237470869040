"""What a bag being written holds: its topics, counts, files and custom data."""

from collections import Counter
from collections.abc import Iterable, Mapping

from hmsa_ros import __version__
from hmsa_ros.bag import metadata
from hmsa_ros.bag.output import OutputFile
from hmsa_ros.bag.topics import Topic


class Contents:
    """
    What a bag being written holds.

    ``topics`` are by number, ``files`` those closed; ``dropped`` counts messages that are not in
    the bag after all, by topic; ``ended`` says whether the recording has ended.
    """

    def __init__(self, custom_data: Mapping[str, str], ros_distro: str) -> None:
        self.topics: list[Topic] = []
        self.files: list[metadata.FileMetadata] = []
        self.custom_data: dict[str, str] = {}
        self.dropped: Counter[str] = Counter()
        self.ended = False
        self._ros_distro = ros_distro
        self._counts: Counter[int] = Counter()
        self.note(custom_data)

    def note(self, values: Mapping[str, str]) -> None:
        """Add to the custom data; what UTF-8 cannot hold is written as its codes."""
        for key, value in values.items():
            self.custom_data[_storable(key)] = _storable(value)

    def notes(self) -> dict[str, str]:
        """Return what a file says of the experiment."""
        return {'version': __version__, **self.custom_data}

    def counts(self) -> dict[str, int]:
        """Return the number of messages written, by topic."""
        return {topic.name: self._counts[number]
                for number, topic in enumerate(self.topics)}

    def count(self, numbers: Iterable[int]) -> None:
        """Count messages written, each by its topic's number."""
        self._counts.update(numbers)

    def lose(self, numbers: Iterable[int]) -> None:
        """Count messages that could not be written."""
        self.dropped.update(self.topics[number].name for number in numbers)

    def lose_file(self, file: OutputFile) -> None:
        """Count the messages of a file that is gone."""
        for number, count in file.counts.items():
            self.dropped[self.topics[number].name] += count
            self._counts[number] -= count

    def describe(self, file: OutputFile | None) -> metadata.BagMetadata:
        """Return the metadata of the bag, with the file being written if there is one."""
        files = [*self.files, *([file.summary()] if file else [])]
        ended = {} if self.ended else {metadata.NOT_ENDED: 'true'}
        return self._metadata(files, self._counts, {**self.custom_data, **ended})

    def serialized(self, file: OutputFile) -> str:
        """Return the metadata as rosbag2 has them in a file, about that file alone."""
        return metadata.to_yaml(
            self._metadata([file.summary()], file.counts, self.custom_data), outer_key=False)

    def _metadata(
            self, files: list[metadata.FileMetadata], counts: Mapping[int, int],
            custom_data: Mapping[str, str]) -> metadata.BagMetadata:
        """Return metadata."""
        filled = [file for file in files if file.message_count]
        start = min((file.start_ns for file in filled), default=metadata.NO_TIME)
        end = max((file.start_ns + file.duration_ns for file in filled), default=start)
        return metadata.BagMetadata(
            start, end - start, sum(file.message_count for file in files),
            tuple(metadata.TopicMetadata(
                topic.name, topic.type, 'cdr', topic.profiles, topic.type_hash,
                counts.get(number, 0)) for number, topic in enumerate(self.topics)),
            tuple(files), custom_data, self._ros_distro)


def _storable(text: str) -> str:
    """Return a text with what UTF-8 cannot hold written as its codes."""
    return text.encode('utf-8', 'backslashreplace').decode()
