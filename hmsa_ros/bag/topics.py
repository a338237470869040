"""The topics of a bag, from the channels of its files and from what its metadata say."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from mcap.records import Channel, Schema

from hmsa_ros.bag import limits, qos
from hmsa_ros.bag.intake import Problems, ScannedFile
from hmsa_ros.bag.metadata import TopicMetadata
from hmsa_ros.errors import BadInputError, BagError


@dataclass(frozen=True)
class Topic:
    """A topic of a bag, read or to be written."""

    name: str  #: for example ``'/joint_states'``
    type: str  #: for example ``'sensor_msgs/msg/JointState'``; empty if a bag does not have it
    definition: str = ''  #: with its dependencies; empty if not known
    definition_encoding: str = 'ros2msg'  #: or ``'ros2idl'``, empty
    profiles: tuple[qos.Qos, ...] = ()  #: what the publishers offer
    type_hash: str = ''  #: RIHS01 hash, empty if not known
    encoding: str = 'cdr'  #: of the messages

    def check(self) -> None:
        """Raise `BadInputError` for a topic that nobody could name or decode."""
        if not self.name:
            raise BadInputError('a topic has an empty name: expected a name such as /stretch')
        if not self.type:
            raise BadInputError(f'topic {self.name} has an empty type: expected a message type')


def number_of(topic: Topic, known: Sequence[Topic]) -> int:
    """Return the number of a topic among those known, or the next one for a new topic."""
    return next((
        number for number, other in enumerate(known)
        if (other.name, other.type) == (topic.name, topic.type)), len(known))


class Topics:
    """Gathers topics: ``by_name``, in order of appearance."""

    def __init__(
            self, described: Iterable[TopicMetadata], custom_data: Mapping[str, str],
            problems: Problems) -> None:
        self._described = {topic.name: topic for topic in described}
        self._custom_data = custom_data
        self._problems = problems
        self.by_name: dict[str, Topic] = {}

    def add(self, file: ScannedFile, channel: Channel) -> None:
        """Take in a channel as a topic."""
        known = self.by_name.get(channel.topic)
        if known is None and len(self.by_name) >= limits.TOPICS:
            self._problems.add(f'the bag has more than {limits.TOPICS} topics: the rest is '
                               'skipped')
            return
        schema = file.schemas.get(channel.schema_id)
        described = self._described.get(channel.topic)
        if schema is None:
            self._problems.add(
                f'{file.path.name}: topic {channel.topic} has no message definition: its '
                'messages can be sent again but not decoded')
            schema = Schema(
                id=0, name=described.type if described is not None else '', encoding='', data=b'')
        if known is not None and known.type != schema.name:
            self._problems.add(
                f'topic {channel.topic} has the types {known.type} and {schema.name}: the '
                f'messages of type {schema.name} are skipped')
            return
        profiles = self._profiles(
            file, channel.topic, channel.metadata.get('offered_qos_profiles', ''))
        for more in () if described is None else described.profiles, self._profiles(
                file, channel.topic, self._custom_data.get(qos.LATER + channel.topic, '')):
            profiles += tuple(profile for profile in more if profile not in profiles)
        if known is None:
            self.by_name[channel.topic] = Topic(
                channel.topic, schema.name, schema.data.decode('utf-8', 'replace'),
                schema.encoding, profiles, channel.metadata.get('topic_type_hash', ''),
                channel.message_encoding)
        elif len(profiles) > len(known.profiles):
            # A later split may know more publishers.
            self.by_name[channel.topic] = replace(known, profiles=profiles)

    def _profiles(self, file: ScannedFile, topic: str, text: str) -> tuple[qos.Qos, ...]:
        """Return stored profiles, none if they cannot be read."""
        try:
            return qos.from_stored(text)
        except BagError as error:
            self._problems.add(f'{file.path.name}: topic {topic}: {error}')
            return ()
