"""Recover a readable bag after a crash, a full disk or damage."""

from dataclasses import dataclass, replace
import os

from hmsa.bag import limits
from hmsa.bag.definitions import ROS1
from hmsa.bag.reader import BagReader
from hmsa.bag.writer import BagWriter
from hmsa.errors import BadInputError, BagError


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
