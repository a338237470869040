"""
Quality of service as rosbag2 stores it: a YAML list of profiles.

Jazzy (metadata version 9) writes names (``reliable``); older bags contain the numbers of rmw.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import yaml

from hmsa.bag import limits
from hmsa.errors import BagError

HISTORIES = ('system_default', 'keep_last', 'keep_all', 'unknown')
RELIABILITIES = ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available')
DURABILITIES = ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available')
LIVELINESSES = (
    'system_default', 'automatic', 'manual_by_node', 'manual_by_topic', 'unknown',
    'best_available')
_POLICIES = {
    'history': HISTORIES, 'reliability': RELIABILITIES, 'durability': DURABILITIES,
    'liveliness': LIVELINESSES}
INFINITE_NS = 9223372036854775807
#: Prefix of keys of custom data, before a topic's name: profiles of later publishers.
LATER = 'offered_qos_profiles.'


@dataclass(frozen=True)
class Qos:
    """One offered profile; durations in ns, `INFINITE_NS` for none."""

    history: str = 'unknown'  #: one of `HISTORIES`
    depth: int = 0  #: 0 if not discovered
    reliability: str = 'reliable'  #: one of `RELIABILITIES`
    durability: str = 'volatile'  #: one of `DURABILITIES`
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = 'automatic'  #: one of `LIVELINESSES`
    lease_ns: int = INFINITE_NS
    avoid_ros_namespace_conventions: bool = False

    def __post_init__(self) -> None:
        for name, known in _POLICIES.items():
            value = getattr(self, name)
            if value not in known:
                raise BagError(f'QoS {name} is {value!r}: expected one of {", ".join(known)}')
        for name, number in (
                ('depth', self.depth), ('deadline', self.deadline_ns),
                ('lifespan', self.lifespan_ns), ('liveliness lease', self.lease_ns)):
            if number < 0:
                raise BagError(f'QoS {name} is {number}: expected at least 0')


# As rosbag2 names the fields, in its order.
_KEYS = {x.name: x.name.removesuffix('_ns') for x in fields(Qos)} | {
    'lease_ns': 'liveliness_lease_duration'}


def _stored(name: str, value: Any) -> Any:
    """Return a field's value as rosbag2 stores it."""
    return {'sec': value // 10**9, 'nsec': value % 10**9} if name.endswith('_ns') else value


def _read(name: str, value: Any) -> Any:
    """Read a field's value; a policy is a name or a number of rmw, 'unknown' if neither."""
    known = _POLICIES.get(name)
    if known is not None:
        if isinstance(value, str):
            return value if value in known else 'unknown'
        number = int(value)
        return known[number] if 0 <= number < len(known) else 'unknown'
    if name.endswith('_ns'):
        return min(int(value['sec']) * 10**9 + int(value['nsec']), INFINITE_NS)
    return max(0, int(value)) if name == 'depth' else bool(value)


def to_maps(profiles: Iterable[Qos]) -> list[dict[str, Any]]:
    """Return profiles as dictionaries in rosbag2's order of keys."""
    return [{
        key: _stored(name, getattr(profile, name)) for name, key in _KEYS.items()}
        for profile in profiles]


def to_yaml(profiles: Iterable[Qos]) -> str:
    """Return profiles as the YAML list of a channel's metadata; empty for no profile."""
    maps = to_maps(profiles)
    if not maps:
        return ''
    text: str = yaml.safe_dump(maps, sort_keys=False)
    return text


def from_stored(value: Any) -> tuple[Qos, ...]:
    """Read profiles from YAML or a newer file's list, none from None, or raise `BagError`."""
    try:
        items = limits.load_yaml(value) if isinstance(value, str) else value
        return tuple(
            Qos(**{name: _read(name, item[key]) for name, key in _KEYS.items()})
            for item in items or ())
    except (BagError, KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        what = str(error) if isinstance(error, BagError) else type(error).__name__
        raise BagError(
            f'offered_qos_profiles cannot be read ({what}): expected a YAML list of '
            'profiles') from error
