"""
Publish simulated time, with jumps.

    python -m benchmarks.faults.clock [--start S] [--jump AFTER:BY]

Time runs with the wall clock, from S on; AFTER seconds later it jumps by BY seconds.
"""

import argparse
import signal
import sys
from time import monotonic, sleep

import rclpy

from hmsa.interfaces import topics
from hmsa.model.units import NANOSECONDS
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.conversions import to_clock

_PERIOD_SECONDS = 0.001


def main(arguments: list[str] | None = None) -> int:
    """Publish until interrupted."""
    parser = argparse.ArgumentParser(description='Publish simulated time.')
    parser.add_argument('--start', type=float, default=100.0, help='seconds')
    parser.add_argument('--jump', default='0:0', help='AFTER:BY, seconds')
    options = parser.parse_args(arguments)
    after, _, by = options.jump.partition(':')
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    rclpy.init(args=[])
    node = rclpy.create_node('clock', enable_rosout=False)
    publisher = ros_entities.publisher(node, topics.CLOCK_TOPIC)
    begin = monotonic()
    try:
        while rclpy.ok():
            passed = monotonic() - begin
            time = options.start + passed + (float(by) if passed >= float(after) else 0.0)
            publisher.publish(to_clock(round(time * NANOSECONDS)))
            sleep(_PERIOD_SECONDS)
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == '__main__':
    sys.exit(main())
