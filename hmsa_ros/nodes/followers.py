"""Nodes that follow a clock, seen by their samples."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from rclpy.node import Node

from hmsa_ros.interfaces import topics
from hmsa_ros.nodes import endpoints
from hmsa_ros.nodes.cdr import stamp_of


class Followers:
    """
    How far samples on topics (full names) have come.

    They are looked at only when somebody asks, so that they take no time from whoever plays.
    """

    def __init__(self, node: Node, names: Sequence[str]) -> None:
        self._subscriptions = {
            name: endpoints.listen(node, replace(topics.JOINT_STATES, name=name))
            for name in names}
        # Stamps in ns of the last two samples.
        self._stamps = dict.fromkeys(names, (0, 0))

    def behind(self, end: int) -> dict[str, int]:
        """Return by topic how many ns its samples still lack to a time, of those that do."""
        for name, subscription in self._subscriptions.items():
            while taken := subscription.take():
                for x in taken[-2:]:
                    self._stamps[name] = self._stamps[name][1], stamp_of(x.data)
        # The next sample may be due after the end only.
        return {name: end - last for name, (before, last) in self._stamps.items()
                if not before or 2 * last - before <= end}

    @staticmethod
    def in_words(behind: Mapping[str, int]) -> str:
        """Say what `behind` returned."""
        return ', '.join(f'those of {name} end {lack * 1e-9:.3f} s too early'
                         for name, lack in behind.items())
