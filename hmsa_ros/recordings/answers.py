"""Requests in a bag that no planner has answered."""

from collections.abc import Iterator
from typing import Any

from hmsa_ros.bag.reader import BagReader
from hmsa_ros.errors import BagError
from hmsa_ros.recordings.topics import STATUS, TRAJECTORY, TYPES


def unanswered(reader: BagReader) -> Iterator[str]:
    """Yield a sentence for each topic of sequences that holds some without a verdict."""
    for topic, found in sorted(reader.topics.items()):
        if found.type != TYPES[TRAJECTORY] or not f'/{topic}'.endswith(f'/{TRAJECTORY}'):
            continue
        status = f'{topic[:-len(TRAJECTORY)]}{STATUS}'
        verdicts = {'': False, **{_value(x, 'request'): True for x in _messages(reader, status)}}
        names = [x.header.frame_id for x in _messages(reader, topic)]
        # Whose requests have no names cannot be told.
        count = sum(bool(x) and x not in verdicts for x in names)
        if count:
            why = 'no planner took it' if status in reader.topics else (
                'the planner was not active, or its status was not recorded')
            yield (f'{count} request{"s" * (count > 1)} on {topic} '
                   f'{"have" if count > 1 else "has"} no verdict on {status}: {why}')


def _messages(reader: BagReader, topic: str) -> Iterator[Any]:
    """Yield what can be decoded of a topic."""
    if topic not in reader.topics:
        return
    try:
        decode = reader.decoder(topic)
        for message in reader.messages([topic]):
            yield decode(message.data)
    except BagError:
        # Damage is noted elsewhere.
        return


def _value(status: Any, key: str) -> str:
    return next((x.value for x in status.values if x.key == key), '')
