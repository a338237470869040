"""Assignment of the topics of a bag to actuators, by the ends of their names."""

from collections.abc import Callable, Iterator, Mapping
import contextlib
from typing import Any, TYPE_CHECKING

from hmsa.errors import BadInputError, HmsaError
from hmsa.interfaces import topics as declared

if TYPE_CHECKING:
    from hmsa.bag.reader import BagReader

#: Message type by role, the end of a topic's name.
TYPES = {
    declared.from_outside(x.name, declared.PLANNER): x.type for x in (
        declared.JOINT_STATES, declared.FLUX_DENSITY_COMMAND, declared.FLUX_DENSITY_APPLIED,
        declared.DISTURBANCE_FORCE, declared.PLAN, declared.STATUS, declared.OUTCOMES,
        declared.ESTIMATE, declared.TEMPERATURE)}
(JOINT_STATES, COMMAND, APPLIED, FORCE, PLAN, STATUS, OUTCOMES, ESTIMATE,
 TEMPERATURE) = TYPES
# Roles with a topic for each joint if there are several.
_OF_A_JOINT = (COMMAND, APPLIED, FORCE, TEMPERATURE)
_TRAJECTORY = declared.from_outside(declared.JOINT_TRAJECTORY.name, declared.PLANNER)


def topics_by_joint(reader: 'BagReader') -> dict[str, dict[str, dict[str, str]]]:
    """
    Return topics by namespace, joint (empty for a single one) and role.

    Raise `BadInputError` if there are no joint states, or only commands in other namespaces.
    """
    found: dict[str, dict[str, str]] = {role: {} for role in TYPES}  # topics by namespace
    for topic in reader.topics.values():
        for role, kind in TYPES.items():
            if topic.type == kind and f'/{topic.name}'.endswith(f'/{role}'):
                found[role].setdefault(topic.name[:-len(role)].rstrip('/'), topic.name)
    if not found[JOINT_STATES]:
        has = ', '.join(sorted(reader.topics)) or 'none: the bag is empty'
        raise BadInputError(
            f'{reader.path} has no topic .../{JOINT_STATES} ({TYPES[JOINT_STATES]}): expected a '
            f'bag of a run; its topics are {has}')
    spaces: dict[str, dict[str, dict[str, str]]] = {}
    for space in found[JOINT_STATES]:
        own = _topics_in(found, space)
        if COMMAND in own or not found[COMMAND]:
            spaces[space] = {'': own}
            continue
        by_joint = {
            where[len(space) + 1:]: where for where in found[COMMAND]
            if where.startswith(f'{space}/') and '/' not in where[len(space) + 1:]}
        if by_joint:
            spaces[space] = {joint: {
                **own, **{x: found[x][where] for x in _OF_A_JOINT if where in found[x]}}
                for joint, where in by_joint.items()}
    if not spaces:
        raise BadInputError(
            f'{reader.path} has joint states and commands in different namespaces: expected '
            f'{COMMAND} beside one of ' + ', '.join(found[JOINT_STATES].values()))
    return spaces


def _topics_in(found: Mapping[str, Mapping[str, str]], space: str) -> dict[str, str]:
    """Return the topics of a namespace, by role."""
    topics = {}
    for role, topic_in in found.items():
        if space in topic_in:
            topics[role] = topic_in[space]
        elif len(topic_in) == len(found[JOINT_STATES]) == 1 and (
                role not in _OF_A_JOINT or len(found[COMMAND]) == 1):
            # Planner and plant are in different namespaces, remapped to each other.
            topics[role], = topic_in.values()
    return topics


def unanswered(reader: 'BagReader') -> Iterator[str]:
    """Yield a sentence for each topic of sequences that contains some without a verdict."""
    for topic, known in sorted(reader.topics.items()):
        if known.type != declared.JOINT_TRAJECTORY.type or (
                not f'/{topic}'.endswith(f'/{_TRAJECTORY}')):
            continue
        status = f'{topic[:-len(_TRAJECTORY)]}{STATUS}'
        # Requests without names cannot be checked.
        answered = {'', *_texts(reader, status, lambda x: next(
            (y.value for y in x.values if y.key == 'request'), ''))}
        names = _texts(reader, topic, lambda x: x.header.frame_id)
        count = sum(x not in answered for x in names)
        if count:
            why = 'no planner took it' if status in reader.topics else (
                'the planner was not active, or its status was not recorded')
            yield (f'{count} request{"s" * (count > 1)} on {topic} '
                   f'{"have" if count > 1 else "has"} no verdict on {status}: {why}')


def _texts(reader: 'BagReader', topic: str, text_in: Callable[[Any], str]) -> list[str]:
    """Return a text of each message of a topic, as far as messages can be decoded."""
    texts: list[str] = []
    # Damage is reported elsewhere, and the bag contains the definition.
    with contextlib.suppress(HmsaError, AttributeError, TypeError):
        decode = reader.decoder(topic)
        for message in reader.messages([topic]):
            texts.append(text_in(decode(message.data)))
    return texts
