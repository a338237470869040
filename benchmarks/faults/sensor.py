"""
Relay samples from plant to planner as a noisy sensor that fails on SIGUSR1.

    python -m benchmarks.faults.sensor IN OUT FAULT

Takes samples from topic IN and sends them to topic OUT.
"""

import argparse
from collections.abc import Sequence
from contextlib import suppress
import copy
from dataclasses import replace
import math
import random
import signal
import sys

import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState

from hmsa.interfaces import topics
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.managed import spin

#: Faults of the sensor.
FAULTS = ('nan', 'freeze', 'jump', 'swap', 'twice', 'silence')
_NOISE, _JUMP = 1e-3, 0.05


class Sensor(Node):
    """Relay samples, with a fault once requested."""

    def __init__(self, options: argparse.Namespace) -> None:
        """Subscribe and relay."""
        super().__init__('sensor', enable_rosout=False)
        self._fault = options.fault
        self.failed = False
        self._random = random.Random(1)
        self._held: JointState | None = None
        self._last = 0.0
        topic = topics.JOINT_STATES
        self._publisher = ros_entities.publisher(self, replace(topic, name=options.target))
        ros_entities.subscribe(self, replace(topic, name=options.source), self._on_sample)

    def _on_sample(self, message: JointState) -> None:
        stretch = message.position[0] + self._random.gauss(0.0, _NOISE)
        # A camera measures neither of them.
        message.velocity, message.effort = [], []
        if not self.failed:
            self._last = stretch
        elif self._fault in ('nan', 'freeze', 'jump'):
            stretch = {
                'nan': math.nan, 'freeze': self._last, 'jump': stretch + _JUMP}[self._fault]
        message.position = [stretch]
        for x in self._passed_on(message) if self.failed else (message,):
            self._publisher.publish(x)

    def _passed_on(self, message: JointState) -> Sequence[JointState]:
        if self._fault == 'twice':
            return message, message
        if self._fault == 'silence':
            return ()
        if self._fault == 'swap':
            if self._held is None:
                self._held = copy.copy(message)
                return ()
            held, self._held = self._held, None
            return message, held
        return (message,)


def main(arguments: list[str] | None = None) -> int:
    """Relay samples until interrupted."""
    parser = argparse.ArgumentParser(description='Pass samples on, with a fault.')
    parser.add_argument('source')
    parser.add_argument('target')
    parser.add_argument('fault', choices=FAULTS)
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    rclpy.init(args=[])
    node = Sensor(options)
    signal.signal(signal.SIGUSR1, lambda *_: setattr(node, 'failed', True))
    with suppress(KeyboardInterrupt):
        spin((node,), lambda: False)
    return 0


if __name__ == '__main__':
    sys.exit(main())
