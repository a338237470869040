"""Selection of the topics to record, and of those to play."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import re
from typing import Any, ClassVar

from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden

from hmsa.errors import BadInputError
from hmsa.interfaces import topics


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

    def _excludes(self, topic: str) -> bool:
        return topic in self.exclude_topics or bool(
            self.exclude_regex and re.search(self.exclude_regex, topic))


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
        if self._excludes(topic):
            return False
        if topic in self.topics:
            return True
        if topic_or_service_is_hidden(topic):
            return False
        if self.regex and re.search(self.regex, topic):
            return True
        return self.all_topics or not (self.topics or self.regex)


@dataclass(frozen=True)
class Filter(_Choice):
    """Topics to play, by full names or expressions, and commands that are permitted."""

    expressions = ('play.regex_to_filter', 'play.exclude_regex_to_filter')

    def passes(self, topic: str) -> bool:
        """Return whether a topic is selected, commands aside; exclusion takes precedence."""
        if self._excludes(topic):
            return False
        if topic in self.topics:
            return True
        if self.regex:
            return re.search(self.regex, topic) is not None
        return not self.topics

    def withholds(self, topic: str, resolved: str, type_name: str) -> bool:
        """Return whether a topic, resolved for publishing, is a command not selected by name."""
        if topic in self.topics:
            return False
        return (_last(topic) in COMMAND_TOPICS or _last(resolved) in COMMAND_TOPICS
                or (type_name in _COMMAND_TYPES and _last(resolved) not in _REPORTS))
