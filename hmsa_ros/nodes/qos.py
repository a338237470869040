"""Convert quality of service between rclpy and bags."""

from collections.abc import Iterable, Sequence

from rclpy.duration import Duration
from rclpy.qos import LivelinessPolicy, QoSProfile

from hmsa.bag.qos import Qos
from hmsa.interfaces.topics import Quality
from hmsa_ros.nodes import ros_entities

# Depth of a republished topic whose recorded depth is unknown, as for publishers discovered over
# DDS.
PUBLISHER_DEPTH = 1000
# Limit on recorded depths, since the middleware allocates memory for them.
MAX_DEPTH = 100_000


def stored(profile: QoSProfile) -> Qos:
    """Return a profile of `Node.get_publishers_info_by_topic` in the form stored in a bag."""
    return Qos(
        profile.history.name.lower(), profile.depth, profile.reliability.name.lower(),
        profile.durability.name.lower(), profile.deadline.nanoseconds,
        profile.lifespan.nanoseconds, profile.liveliness.name.lower(),
        profile.liveliness_lease_duration.nanoseconds,
        profile.avoid_ros_namespace_conventions)


def subscription(offered: Iterable[Qos], depth: int) -> QoSProfile:
    """Return the strongest profile that is compatible with all given publishers."""
    profiles = list(offered)
    reliable = all(profile.reliability == 'reliable' for profile in profiles)
    latched = all(profile.durability == 'transient_local' for profile in profiles)
    return ros_entities.profile(Quality(depth, reliable, latched))


def publisher(recorded: Sequence[Qos]) -> QoSProfile:
    """Return a profile that serves every subscriber that the recorded publishers served."""
    # Reliable if any publisher was, transient local if any was. The depth is the recorded one. If
    # that is unknown, a latched topic keeps one message for each recorded publisher, so that a
    # late subscriber receives the same messages.
    latched = any(profile.durability == 'transient_local' for profile in recorded)
    reliable = not recorded or any(
        profile.reliability in ('reliable', 'system_default') for profile in recorded)
    depth = min(MAX_DEPTH, max((profile.depth for profile in recorded), default=0))
    profile = ros_entities.profile(Quality(
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
