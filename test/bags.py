"""Comparison of bags with rosbags, an independent reader."""

from collections import Counter
from pathlib import Path

from hmsa.bag.metadata import FILE_NAME
from hmsa.bag.reader import BagReader
from hmsa.errors import HmsaError


def hold_against_rosbags(folder):
    """Compare every complete bag in a folder with what rosbags reads, topic by topic."""
    from rosbags.rosbag2 import Reader

    for path in Path(folder).rglob(FILE_NAME):
        try:
            reader = BagReader(path.parent)
            expected = Counter(reader.counts())
        except HmsaError:
            continue
        if reader.problems or not reader.complete:
            continue
        if reader.metadata is not None and reader.metadata.version < 4:
            # rosbags matches topics by their profiles, which such metadata lack.
            continue
        if reader.metadata is not None and not reader.metadata.storage:
            # rosbags refuses it.
            continue
        if any(x.encoding != 'cdr' for x in reader.topics.values()):
            # rosbags refuses them.
            continue
        with Reader(path.parent) as other:
            found = Counter(connection.topic for connection, _, _ in other.messages())
        assert found == +expected, f'rosbags reads {found} of {path.parent}'
