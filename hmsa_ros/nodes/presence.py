"""
Who else plays the part of a planner or of a device: two of either are one too many.

A process that was killed stays in the graph for some 20 s. So a publisher counts only while its
process is heard: each node of the package publishes on /diagnostics once a second, and of others
the samples are heard. Publishers are told apart by their identifiers (GIDs), whose first part is
that of the process.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
import math
from time import time_ns

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from hmsa_ros.errors import BadInputError
from hmsa_ros.interfaces import topics
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.nodes import endpoints
from hmsa_ros.nodes.capture import RawSubscription, Taken
from hmsa_ros.nodes.conversions import from_samples

#: How long a process that was heard counts as running, in s.
LATELY_SECONDS = 2.5
_PROCESS_BYTES = 12
# Samples looked at a second; of a publisher that sends fewer than others some are among them.
_SAMPLES = replace(topics.JOINT_STATES, qos=topics.Quality(100, reliable=False))


def several(what: str, nodes: Sequence[str]) -> str:
    """Return that there are several planners, plants or the like; empty for fewer than two."""
    if len(nodes) < 2:
        return ''
    left = 'one' if len(nodes) == 2 else 'all but one'
    return f'{len(nodes)} {what} ({" and ".join(sorted(nodes))}): stop {left}'


class Presence:
    """
    Finds from a node which publishers of topics are running; to be asked once a second.

    ``samples`` are listened to only where somebody beside the devices needs them too.
    """

    def __init__(self, node: Node, *, samples: bool = True) -> None:
        self._node, self._of_samples = node, samples
        self._diagnostics = endpoints.listen(node, topics.DIAGNOSTICS)
        self._samples: RawSubscription | None = None
        # When processes, and publishers of samples of a joint, were last heard, in system time.
        self._heard: dict[bytes, int] = {}
        self._sampled: dict[tuple[str, bytes], int] = {}

    def look(self) -> None:
        """Take in what has arrived."""
        self._note(self._diagnostics.take())
        states = topics.JOINT_STATES.name
        if not self._of_samples:
            return
        if self._samples is None and len(self._publishers(states)) > 1:
            self._samples = endpoints.listen(self._node, _SAMPLES)
        elif self._samples is not None:
            self._note(taken := self._samples.take())
            # The newest of each publisher: reading all would take long.
            for one in {x.publisher: x for x in taken}.values():
                with suppress(BadInputError):
                    for joint, _, (stretch, *_) in from_samples(one.data):
                        if math.isfinite(stretch):
                            self._sampled[joint, one.publisher] = one.received_ns

    def devices(self, joints: Sequence[str]) -> str:
        """Return that several plants or drivers run of one of a node's joints; empty for none."""
        for joint in joints:
            what = f'plants or drivers of joint {joint}'
            applied = topics.of_joint(topics.FLUX_DENSITY_APPLIED, joint, joints).name
            if found := several(what, self._running(applied)) or several(what, [
                    node for gid, node in self._publishers(topics.JOINT_STATES.name).items()
                    if _lately(self._sampled.get((joint, gid), 0))]):
                return found
        return ''

    def planners(self, owner: str = '') -> str:
        """Return that several planners run under this node's name, or the owner's; or nothing."""
        return several('planners', self._running(topics.from_outside(topics.STATUS.name, owner)))

    def crowded(self, joints: Sequence[str], owner: str) -> bool:
        """Return whether the graph, killed processes included, has several of anything."""
        return any(len(self._publishers(x)) > 1 for x in (
            topics.from_outside(topics.STATUS.name, owner), topics.JOINT_STATES.name,
            *(topics.of_joint(topics.FLUX_DENSITY_APPLIED, x, joints).name for x in joints)))

    def close(self) -> None:
        """Listen no more."""
        self._diagnostics.destroy()
        if self._samples is not None:
            self._samples.destroy()

    def _note(self, taken: Iterable[Taken]) -> None:
        for one in taken:
            self._heard[one.publisher[:_PROCESS_BYTES]] = one.received_ns

    def _running(self, topic: str) -> list[str]:
        """Return the nodes that publish a topic and whose processes are heard."""
        return [node for gid, node in self._publishers(topic).items()
                if _lately(self._heard.get(gid[:_PROCESS_BYTES], 0))]

    def _publishers(self, topic: str) -> dict[bytes, str]:
        try:
            return endpoints.publishers_of(self._node, topic)
        except rclpy_implementation.RCLError:
            # Joints that messages name may have any name.
            return {}


def _lately(received_ns: int) -> bool:
    return time_ns() - received_ns < LATELY_SECONDS * NANOSECONDS
