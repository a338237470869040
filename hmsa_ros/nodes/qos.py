"""Quality of service between rclpy and what a bag stores."""

from collections.abc import Iterable, Sequence

from rclpy.duration import Duration
from rclpy.qos import LivelinessPolicy, QoSProfile

from hmsa_ros.bag.qos import Qos
from hmsa_ros.interfaces.topics import Quality
from hmsa_ros.nodes import endpoints

# Depth of a republished topic whose recorded depth is unknown, as it is where publishers are
# discovered over DDS.
PUBLISHER_DEPTH = 1000
# Recorded depths are believed up to here: the middleware sets memory aside for them.
MAX_DEPTH = 100_000


def stored(profile: QoSProfile) -> Qos:
    """Return a profile of `Node.get_publishers_info_by_topic` as a bag stores it."""
    return Qos(
        profile.history.name.lower(), profile.depth, profile.reliability.name.lower(),
        profile.durability.name.lower(), profile.deadline.nanoseconds,
        profile.lifespan.nanoseconds, profile.liveliness.name.lower(),
        profile.liveliness_lease_duration.nanoseconds,
        profile.avoid_ros_namespace_conventions)


def subscription(offered: Iterable[Qos], depth: int) -> QoSProfile:
    """Return the strongest profile that receives from all of one or more publishers."""
    profiles = list(offered)
    reliable = all(profile.reliability == 'reliable' for profile in profiles)
    latched = all(profile.durability == 'transient_local' for profile in profiles)
    return endpoints.profile(Quality(depth, reliable, latched))


def publisher(recorded: Sequence[Qos]) -> QoSProfile:
    """Return the profile that serves every subscriber that the recorded publishers served."""
    # Reliable if any was, transient local if any was. The depth is the recorded one. Where it is
    # unknown a latched topic keeps one message a recorded publisher, so that who comes late gets
    # what it would have got.
    latched = any(profile.durability == 'transient_local' for profile in recorded)
    reliable = not recorded or any(
        profile.reliability in ('reliable', 'system_default') for profile in recorded)
    depth = min(MAX_DEPTH, max((profile.depth for profile in recorded), default=0))
    profile = endpoints.profile(Quality(
        depth or (min(MAX_DEPTH, len(recorded)) if latched else PUBLISHER_DEPTH),
        reliable, latched))
    alike = set(recorded)
    if len(alike) == 1:
        # Deadlines and the like only mean something if all publishers agreed on them.
        only = alike.pop()
        profile.deadline = Duration(nanoseconds=only.deadline_ns)
        profile.lifespan = Duration(nanoseconds=only.lifespan_ns)
        profile.liveliness_lease_duration = Duration(nanoseconds=only.lease_ns)
        profile.avoid_ros_namespace_conventions = only.avoid_ros_namespace_conventions
        if only.liveliness == 'manual_by_topic':
            profile.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
    return profile
