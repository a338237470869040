"""
Detect other planners or devices: there must be only one of each.

A process that was killed stays in the graph for about 20 s. A publisher is therefore counted only
while its process is active: each node of the package publishes on /diagnostics once a second, and
other processes are detected by their samples. One that ended before another began to publish was
replaced by it. Publishers are distinguished by their identifiers (GIDs), whose first part is that
of the process.
"""

from collections.abc import Hashable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
import math
from time import time_ns

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from hmsa.errors import BadInputError
from hmsa.interfaces import topics
from hmsa.model.units import NANOSECONDS
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.capture import RawSubscription, Taken
from hmsa_ros.nodes.cdr import JointStateReader

#: Time in s after its last message during which a process counts as running.
LATELY_SECONDS = 2.5
_LATELY = round(LATELY_SECONDS * NANOSECONDS)
_PROCESS_BYTES = 12
# Samples read per second; the queue also contains some of a publisher with a lower rate.
_SAMPLES = replace(topics.JOINT_STATES, qos=topics.Quality(100, reliable=False))


def several(what: str, nodes: Sequence[str]) -> str:
    """Return a message if there are several planners, plants or the like; else empty."""
    if len(nodes) < 2:
        return ''
    left = 'one' if len(nodes) == 2 else 'all but one'
    named = sorted(x or 'a node of unknown name' for x in nodes)
    return f'{len(nodes)} {what} ({" and ".join(named)}): stop {left}'


class Active:
    """Sources of messages that are active at the same time; times in ns of one clock."""

    def __init__(self) -> None:
        # First and last message since the source was silent.
        self._heard: dict[Hashable, tuple[int, int]] = {}

    def note(self, source: Hashable, time: int) -> None:
        """Record the time of a message."""
        first, last = self._heard.get(source, (time, time))
        self._heard[source] = (time if time - last > _LATELY else first), max(time, last)

    def among(self, sources: Iterable[Hashable], now: int) -> set[Hashable]:
        """Return those of some sources that are active, without those that were replaced."""
        heard = {x: self._heard[x] for x in sources
                 if x in self._heard and now - self._heard[x][1] < _LATELY}
        newest = max((first for first, _ in heard.values()), default=0)
        return {x for x, (_, last) in heard.items() if last >= newest}


class DuplicateNodes:
    """
    Find the running publishers of topics; to be called once a second.

    With ``samples``, publishers of samples that send no diagnostics are detected too.
    """

    def __init__(self, node: Node, *, samples: bool = True) -> None:
        self._node, self._of_samples = node, samples
        self._diagnostics = ros_entities.listen(node, topics.DIAGNOSTICS)
        self._samples: RawSubscription | None = None
        # Processes, and publishers of samples of a joint.
        self._processes, self._sampling = Active(), Active()
        self._reader = JointStateReader()

    def look(self) -> None:
        """Process the messages that have arrived."""
        self._note(self._diagnostics.take())
        states = topics.JOINT_STATES.name
        if not self._of_samples:
            return
        if self._samples is None and len(self._publishers(states)) > 1:
            self._samples = ros_entities.listen(self._node, _SAMPLES)
        elif self._samples is not None:
            self._note(taken := self._samples.take())
            # Only the newest message of each publisher, since reading all would take long.
            for one in {x.publisher: x for x in taken}.values():
                with suppress(BadInputError):
                    joints, _, (stretches, *_) = self._reader.read(one.data)
                    for joint, stretch in zip(joints, stretches, strict=True):
                        if math.isfinite(stretch):
                            self._sampling.note((joint, one.publisher), one.received_ns)

    def devices(self, joints: Sequence[str]) -> str:
        """Return a message if several plants or drivers run for one of the joints; else empty."""
        for joint in joints:
            what = f'plants or drivers of joint {joint}'
            applied = topics.of_joint(topics.FLUX_DENSITY_APPLIED, joint, joints).name
            sampling = self._publishers(topics.JOINT_STATES.name)
            active = self._sampling.among([(joint, x) for x in sampling], time_ns())
            if found := several(what, self._running(applied)) or several(what, [
                    node for gid, node in sampling.items() if (joint, gid) in active]):
                return found
        return ''

    def planners(self, owner: str = '') -> str:
        """Return a message if several planners run under this node's or the owner's name."""
        return several('planners', self._running(topics.from_outside(topics.STATUS.name, owner)))

    def crowded(self, joints: Sequence[str], owner: str) -> bool:
        """Return whether the graph, including killed processes, has several of anything."""
        return any(len(self._publishers(x)) > 1 for x in (
            topics.from_outside(topics.STATUS.name, owner), topics.JOINT_STATES.name,
            *(topics.of_joint(topics.FLUX_DENSITY_APPLIED, x, joints).name for x in joints)))

    def close(self) -> None:
        """Destroy the subscriptions."""
        self._diagnostics.destroy()
        if self._samples is not None:
            self._samples.destroy()

    def _note(self, taken: Iterable[Taken]) -> None:
        for one in taken:
            self._processes.note(one.publisher[:_PROCESS_BYTES], one.received_ns)

    def _running(self, topic: str) -> list[str]:
        """Return the nodes that publish a topic and whose processes are active."""
        # A node whose name is unknown is just being discovered, or has ended.
        found = {gid: node for gid, node in self._publishers(topic).items() if node}
        active = self._processes.among({x[:_PROCESS_BYTES] for x in found}, time_ns())
        return [node for gid, node in found.items() if gid[:_PROCESS_BYTES] in active]

    def _publishers(self, topic: str) -> dict[bytes, str]:
        try:
            return ros_entities.publishers_of(self._node, topic)
        except rclpy_implementation.RCLError:
            # Joint names in messages are arbitrary and may not be valid in a topic.
            return {}
