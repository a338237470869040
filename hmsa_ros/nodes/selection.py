"""Which topics are recorded, and which are played."""

from dataclasses import dataclass
import re

from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden

from hmsa_ros.errors import BadInputError
from hmsa_ros.nodes import interface
from hmsa_ros.nodes.message_types import type_name_of


def _last(name: str) -> str:
    """Return the last part of a name."""
    return name.rsplit('/', 1)[-1]


#: Last part of the names of topics that make something move.
COMMAND_TOPICS = frozenset(_last(topic.name) for topic in (
    interface.FLUX_DENSITY_COMMAND, interface.JOINT_TRAJECTORY, interface.SETPOINT))
# Types that drive a coil or a planner, whatever the topic is called, but for reports.
_COMMAND_TYPES = frozenset(type_name_of(topic.type) for topic in (
    interface.FLUX_DENSITY_COMMAND, interface.JOINT_TRAJECTORY))
_REPORTS = frozenset(_last(topic.name) for topic in (
    interface.FLUX_DENSITY_APPLIED, interface.PLAN))
# A full name, as rcl validates it; the middleware adds three characters to the length.
_FULL_NAME = re.compile(r'(?:/[A-Za-z_][A-Za-z0-9_]*)+')
_LONGEST_NAME = 247


def is_full_name(name: str) -> bool:
    """Return whether ROS takes a name for the same topic; rclpy would cut one at a NUL byte."""
    return len(name) <= _LONGEST_NAME and _FULL_NAME.fullmatch(name) is not None


def _check_expression(parameter: str, expression: str) -> None:
    """Refuse what is no regular expression."""
    try:
        re.compile(expression)
    except re.error as error:
        raise BadInputError(
            f'parameter {parameter} is {expression!r}: expected a regular expression '
            f'({error})') from error


def _excluded(topic: str, names: tuple[str, ...], expression: str) -> bool:
    """Return whether a topic is among names, or an expression that is not empty is found in it."""
    return topic in names or bool(expression and re.search(expression, topic))


@dataclass(frozen=True)
class Selection:
    """
    Which topics to record.

    Attributes
    ----------
    topics, exclude_topics : tuple of str
        Full names.
    all_topics : bool
        Whether every topic that is not hidden is wanted.
    regex, exclude_regex : str
        Regular expressions, empty for none.

    """

    topics: tuple[str, ...] = ()
    all_topics: bool = False
    regex: str = ''
    exclude_topics: tuple[str, ...] = ()
    exclude_regex: str = ''

    def __post_init__(self) -> None:
        _check_expression('record.regex', self.regex)
        _check_expression('record.exclude_regex', self.exclude_regex)

    def wants(self, topic: str) -> bool:
        """Return whether to record a topic; one in ``topics`` is, unless it is excluded."""
        if _excluded(topic, self.exclude_topics, self.exclude_regex):
            return False
        if topic in self.topics:
            return True
        if topic_or_service_is_hidden(topic):
            return False
        if self.regex and re.search(self.regex, topic):
            return True
        return self.all_topics or not (self.topics or self.regex)


@dataclass(frozen=True)
class Filter:
    """
    Which topics to send.

    Attributes
    ----------
    topics, exclude_topics : tuple of str
        Full names.
    regex, exclude_regex : str
        Regular expressions, empty for none.
    allow_commands : tuple of str
        Full names of command topics that may be sent too.

    """

    topics: tuple[str, ...] = ()
    regex: str = ''
    exclude_topics: tuple[str, ...] = ()
    exclude_regex: str = ''
    allow_commands: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check_expression('play.regex_to_filter', self.regex)
        _check_expression('play.exclude_regex_to_filter', self.exclude_regex)

    def passes(self, topic: str) -> bool:
        """Return whether to send a topic, commands apart; exclusion comes first."""
        if _excluded(topic, self.exclude_topics, self.exclude_regex):
            return False
        if topic in self.topics or topic in self.allow_commands:
            return True
        if self.regex:
            return re.search(self.regex, topic) is not None
        return not self.topics

    def withholds(self, topic: str, resolved: str, type_name: str) -> bool:
        """Return whether a topic, resolved to be sent, is a command not asked for by name."""
        if topic in self.topics or topic in self.allow_commands:
            return False
        return (_last(topic) in COMMAND_TOPICS or _last(resolved) in COMMAND_TOPICS
                or (type_name in _COMMAND_TYPES and _last(resolved) not in _REPORTS))
