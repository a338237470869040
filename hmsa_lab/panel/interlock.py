"""The panel's switch on the interlock of a driver."""

import math

from rclpy.node import Node
from std_msgs.msg import Bool

from hmsa.interfaces.topics import DRIVER, INTERLOCK
from hmsa_ros.nodes import ros_entities

# Interval of repeats in s, well within the default interlock_timeout of a driver.
_REPEAT_SECONDS = 0.1


class InterlockSwitch:
    """
    Open and close the interlock of a driver, once asked to.

    A message is repeated while the panel runs. An opening outlasts the panel: a driver keeps its
    interlock open until another publisher closes it.
    """

    def __init__(self, node: Node) -> None:
        self._node, self._publisher = node, ros_entities.publisher(node, INTERLOCK, DRIVER)
        self.closed: bool | None = None  #: as last requested; None before the first request
        self._next = math.inf

    @property
    def present(self) -> bool:
        """Whether a driver listens."""
        return ros_entities.heard(self._node, self._publisher)

    def turn(self, now: float, *, closed: bool) -> None:
        """Open or close it, from a time in s on."""
        self.closed, self._next = closed, now
        self.repeat(now)

    def repeat(self, now: float) -> None:
        """Repeat the last message when it is time."""
        if self.closed is not None and now >= self._next:
            self._publisher.publish(Bool(data=self.closed))
            self._next = now + _REPEAT_SECONDS
