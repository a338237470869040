"""
Quality of service as rosbag2 stores it: a YAML list of profiles.

Jazzy (metadata version 9) writes names (``reliable``); older bags hold the numbers of rmw.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from hmsa_ros.bag import limits
from hmsa_ros.errors import BagError

HISTORIES = ('system_default', 'keep_last', 'keep_all', 'unknown')
RELIABILITIES = ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available')
DURABILITIES = ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available')
LIVELINESSES = (
    'system_default', 'automatic', 'manual_by_node', 'manual_by_topic', 'unknown',
    'best_available')
INFINITE_NS = 9223372036854775807
#: Key of custom data, before a topic's name: profiles of publishers that came later.
LATER = 'offered_qos_profiles.'


@dataclass(frozen=True)
class Qos:
    """One offered profile; durations in ns, `INFINITE_NS` for none."""

    history: str = 'unknown'  # one of `HISTORIES`
    depth: int = 0  # 0 where it was not discovered
    reliability: str = 'reliable'  # one of `RELIABILITIES`
    durability: str = 'volatile'  # one of `DURABILITIES`
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = 'automatic'  # one of `LIVELINESSES`
    lease_ns: int = INFINITE_NS
    avoid_ros_namespace_conventions: bool = False

    def __post_init__(self) -> None:
        for name, value, known in (
                ('history', self.history, HISTORIES),
                ('reliability', self.reliability, RELIABILITIES),
                ('durability', self.durability, DURABILITIES),
                ('liveliness', self.liveliness, LIVELINESSES)):
            if value not in known:
                raise BagError(f'QoS {name} is {value!r}: expected one of {", ".join(known)}')
        for name, number in (
                ('depth', self.depth), ('deadline', self.deadline_ns),
                ('lifespan', self.lifespan_ns), ('liveliness lease', self.lease_ns)):
            if number < 0:
                raise BagError(f'QoS {name} is {number}: expected at least 0')


def _time_to_map(nanoseconds: int) -> dict[str, int]:
    """Split as rosbag2 does."""
    return {'sec': nanoseconds // 10**9, 'nsec': nanoseconds % 10**9}


def _time_from_map(value: Any) -> int:
    """Read a duration; at most what means none."""
    total = int(value['sec']) * 10**9 + int(value['nsec'])
    return min(total, INFINITE_NS)


def _name(value: Any, known: tuple[str, ...]) -> str:
    """Read a policy given as a name or as the number of rmw; what is unknown says so."""
    if isinstance(value, str):
        return value if value in known else 'unknown'
    number = int(value)
    return known[number] if 0 <= number < len(known) else 'unknown'


def to_maps(profiles: Iterable[Qos]) -> list[dict[str, Any]]:
    """Return profiles as plain maps, in the order of keys that rosbag2 writes."""
    return [{
        'history': profile.history,
        'depth': profile.depth,
        'reliability': profile.reliability,
        'durability': profile.durability,
        'deadline': _time_to_map(profile.deadline_ns),
        'lifespan': _time_to_map(profile.lifespan_ns),
        'liveliness': profile.liveliness,
        'liveliness_lease_duration': _time_to_map(profile.lease_ns),
        'avoid_ros_namespace_conventions': profile.avoid_ros_namespace_conventions,
    } for profile in profiles]


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
        return tuple(_from_map(item) for item in items or ())
    except (BagError, KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        what = str(error) if isinstance(error, BagError) else type(error).__name__
        raise BagError(
            f'offered_qos_profiles cannot be read ({what}): expected a YAML list of '
            'profiles') from error


def _from_map(item: Mapping[str, Any]) -> Qos:
    """Read one profile."""
    return Qos(
        history=_name(item['history'], HISTORIES),
        depth=max(0, int(item['depth'])),
        reliability=_name(item['reliability'], RELIABILITIES),
        durability=_name(item['durability'], DURABILITIES),
        deadline_ns=_time_from_map(item['deadline']),
        lifespan_ns=_time_from_map(item['lifespan']),
        liveliness=_name(item['liveliness'], LIVELINESSES),
        lease_ns=_time_from_map(item['liveliness_lease_duration']),
        avoid_ros_namespace_conventions=bool(item['avoid_ros_namespace_conventions']))
