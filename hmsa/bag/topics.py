"""The topics of a bag, from the channels of its files and from its metadata."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

from mcap.records import Schema

from hmsa.bag import qos
from hmsa.bag.definitions import EMPTY, installed
from hmsa.bag.foreign import ForeignFile
from hmsa.bag.metadata import BagTopic
from hmsa.bag.scan import ScannedFile
from hmsa.errors import BagError


def number_of(topic: BagTopic, known: Sequence[BagTopic]) -> int:
    """Return the number of a topic among those known, or the next one for a new topic."""
    return next((
        number for number, other in enumerate(known)
        if (other.name, other.type) == (topic.name, topic.type)), len(known))


def topics_of(
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
