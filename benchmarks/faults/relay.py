"""
Relay commands from planner to plant: delay, drop, duplicate or reorder them.

    python -m benchmarks.faults.relay IN OUT [--delay S] [--first N] [--drop I,...] [--twice]
                                      [--swap]

Takes commands from topic IN and sends them to topic OUT. Delays are in steady time, independent
of the nodes' clock. Prints "joined" once planner, plant and an observing node are connected.
"""

import argparse
from collections import deque
from contextlib import suppress
from dataclasses import replace
import signal
import sys
from time import monotonic

from builtin_interfaces.msg import Time
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import MagneticField

from hmsa.interfaces import topics
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.managed import spin

_TICK_SECONDS = 0.0005
# The plant and an observing node.
_LISTENERS = 2


class Relay(Node):
    """Relay commands, with a fault."""

    def __init__(self, options: argparse.Namespace) -> None:
        """Subscribe and relay."""
        super().__init__('relay', enable_rosout=False)
        self._options = options
        self._drop = {int(x) for x in options.drop.split(',') if x}
        self._count, self._joined = 0, False
        self._held: MagneticField | None = None
        # Timestamps of lost commands; a heartbeat may repeat one before it applies.
        self._lost: list[Time] = []
        self._waiting: deque[tuple[float, MagneticField]] = deque()
        topic = topics.FLUX_DENSITY_COMMAND
        self._publisher = ros_entities.publisher(self, replace(topic, name=options.target))
        self._commands = ros_entities.subscribe(
            self, replace(topic, name=options.source), self._on_command)
        self.create_timer(
            _TICK_SECONDS, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _on_command(self, message: MagneticField) -> None:
        self._count += 1
        if self._count in self._drop:
            self._lost.append(message.header.stamp)
        if message.header.stamp in self._lost:
            return
        if self._options.swap and self._count <= 2:
            if self._held is None:
                self._held = message
                return
            self._publisher.publish(message)
            # The later command must supersede it for good.
            self._lost.append(message.header.stamp)
            message, self._held = self._held, None
        delay = self._options.delay
        if self._options.first and self._count > self._options.first:
            delay = 0.0
        for _ in range(2 if self._options.twice else 1):
            self._waiting.append((monotonic() + delay, message))
        self._on_tick()

    def _on_tick(self) -> None:
        if not self._joined and (self._commands.get_publisher_count() >= 1
                                 and self._publisher.get_subscription_count() >= _LISTENERS):
            self._joined = True
            print('joined')
        # In order of arrival, unless asked to reorder them.
        while self._waiting and self._waiting[0][0] <= monotonic():
            self._publisher.publish(self._waiting.popleft()[1])


def main(arguments: list[str] | None = None) -> int:
    """Relay until interrupted."""
    parser = argparse.ArgumentParser(description='Relay commands with a fault.')
    parser.add_argument('source')
    parser.add_argument('target')
    parser.add_argument('--delay', type=float, default=0.0, help='seconds')
    parser.add_argument('--first', type=int, default=0, help='delay only the first so many')
    parser.add_argument('--drop', default='', help='numbers of the commands to drop, from 1')
    parser.add_argument('--twice', action='store_true', help='send each command twice')
    parser.add_argument('--swap', action='store_true', help='send the first two in turn')
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    rclpy.init(args=[])
    node = Relay(options)
    with suppress(KeyboardInterrupt):
        spin((node,), lambda: False)
    return 0


if __name__ == '__main__':
    sys.exit(main())
