"""Selection of the topics to record, and of those to play, and their quality of service."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
import re
from typing import Any, ClassVar

from rclpy.duration import Duration
from rclpy.qos import LivelinessPolicy, QoSProfile
from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden

from hmsa.bag.qos import Qos
from hmsa.errors import BadInputError
from hmsa.interfaces import topics
from hmsa_ros.nodes import ros_entities

# Depth of a republished topic whose recorded depth is unknown, as for publishers discovered over
# DDS.
PUBLISHER_DEPTH = 1000
# Limit on recorded depths, since the middleware allocates memory for them.
MAX_DEPTH = 100_000


def _last(name: str) -> str:
    return name.rsplit('/', 1)[-1]


#: Last part of the names of topics that cause motion.
COMMAND_TOPICS = frozenset(_last(topic.name) for topic in (
    topics.FLUX_DENSITY_COMMAND, topics.JOINT_TRAJECTORY, topics.SETPOINT))
# Types that drive a coil or a planner, whatever the name of the topic, except for reports.
_COMMAND_TYPES = frozenset((topics.FLUX_DENSITY_COMMAND.type, topics.JOINT_TRAJECTORY.type))
_REPORTS = frozenset(_last(topic.name) for topic in (
    topics.FLUX_DENSITY_APPLIED, topics.PLAN))
# Full name as validated by rcl; the middleware adds three characters to the length.
_FULL_NAME = re.compile(r'(?:/[A-Za-z_][A-Za-z0-9_]*)+')
_LONGEST_NAME = 247


def is_full_name(name: str) -> bool:
    """Return whether a name is a valid full name; rclpy would truncate one at a NUL byte."""
    return len(name) <= _LONGEST_NAME and _FULL_NAME.fullmatch(name) is not None


@dataclass(frozen=True)
class _Choice:
    topics: tuple[str, ...] = ()
    regex: str = ''
    exclude_topics: tuple[str, ...] = ()
    exclude_regex: str = ''

    #: Names of the parameters with the expressions.
    expressions: ClassVar[tuple[str, str]]

    def __post_init__(self) -> None:
        for parameter, expression in zip(
                self.expressions, (self.regex, self.exclude_regex), strict=True):
            try:
                re.compile(expression)
            except re.error as error:
                raise BadInputError(
                    f'parameter {parameter} is {expression!r}: expected a regular expression '
                    f'({error})') from error

    def excludes(self, topic: str) -> bool:
        """Return whether a topic is excluded, which takes precedence."""
        return topic in self.exclude_topics or bool(
            self.exclude_regex and re.search(self.exclude_regex, topic))

    def selects(self, topic: str) -> bool:
        """Return whether a topic is selected by name or expression, or there is no selection."""
        return not self.excludes(topic) and bool(
            topic in self.topics or self.regex and re.search(self.regex, topic)
            or not (self.topics or self.regex))


@dataclass(frozen=True)
class Selection(_Choice):
    """Topics to record, by full names or expressions; by default all that are not hidden."""

    all_topics: bool = False
    expressions = ('record.regex', 'record.exclude_regex')
    #: Parameters of a recorder that `of` reads.
    parameters: ClassVar[tuple[str, ...]] = (
        'record.topics', 'record.regex', 'record.exclude_topics', 'record.exclude_regex',
        'record.all_topics')

    @classmethod
    def of(cls, values: Mapping[str, Any], full_name: Callable[[str], str]) -> 'Selection':
        """Return the selection described by a recorder's parameters; names become full names."""
        topics, regex, excluded, exclude_regex, all_topics = (values[x] for x in cls.parameters)
        return cls(tuple(map(full_name, topics)), regex, tuple(map(full_name, excluded)),
                   exclude_regex, all_topics)

    def wants(self, topic: str) -> bool:
        """Return whether to record a topic; those in ``topics`` are, unless excluded."""
        if topic not in self.topics and topic_or_service_is_hidden(topic):
            return False
        return self.selects(topic) or self.all_topics and not self.excludes(topic)


@dataclass(frozen=True)
class Filter(_Choice):
    """Topics to play, by full names or expressions, and commands that are permitted."""

    expressions = ('play.regex_to_filter', 'play.exclude_regex_to_filter')

    def withholds(self, topic: str, resolved: str, type_name: str) -> bool:
        """Return whether a topic, resolved for publishing, is a command not selected by name."""
        if topic in self.topics:
            return False
        return (_last(topic) in COMMAND_TOPICS or _last(resolved) in COMMAND_TOPICS
                or (type_name in _COMMAND_TYPES and _last(resolved) not in _REPORTS))


def stored_profile(profile: QoSProfile) -> Qos:
    """Return a profile of `Node.get_publishers_info_by_topic` in the form stored in a bag."""
    return Qos(
        profile.history.name.lower(), profile.depth, profile.reliability.name.lower(),
        profile.durability.name.lower(), profile.deadline.nanoseconds,
        profile.lifespan.nanoseconds, profile.liveliness.name.lower(),
        profile.liveliness_lease_duration.nanoseconds,
        profile.avoid_ros_namespace_conventions)


def subscription_profile(offered: Iterable[Qos], depth: int) -> QoSProfile:
    """Return the strongest profile that is compatible with all given publishers."""
    profiles = list(offered)
    reliable = all(profile.reliability == 'reliable' for profile in profiles)
    latched = all(profile.durability == 'transient_local' for profile in profiles)
    return ros_entities.profile(topics.Quality(depth, reliable, latched))


def publisher_profile(recorded: Sequence[Qos]) -> QoSProfile:
    """Return a profile that serves every subscriber that the recorded publishers served."""
    # Reliable if any publisher was, transient local if any was. The depth is the recorded one. If
    # that is unknown, a latched topic keeps one message for each recorded publisher, so that a
    # late subscriber receives the same messages.
    latched = any(profile.durability == 'transient_local' for profile in recorded)
    reliable = not recorded or any(
        profile.reliability in ('reliable', 'system_default') for profile in recorded)
    depth = min(MAX_DEPTH, max((profile.depth for profile in recorded), default=0))
    profile = ros_entities.profile(topics.Quality(
        depth or (min(MAX_DEPTH, len(recorded)) if latched else PUBLISHER_DEPTH),
        reliable, latched))
    alike = set(recorded)
    if len(alike) == 1:
        # Deadline, lifespan and liveliness apply only if all publishers agreed on them.
        only = alike.pop()
        profile.deadline = Duration(nanoseconds=only.deadline_ns)
        profile.lifespan = Duration(nanoseconds=only.lifespan_ns)
        profile.liveliness_lease_duration = Duration(nanoseconds=only.lease_ns)
        profile.avoid_ros_namespace_conventions = only.avoid_ros_namespace_conventions
        if only.liveliness == 'manual_by_topic':
            profile.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
    return profile
