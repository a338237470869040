"""
Publishes numbered std_msgs/Float64 messages from a separate process.

    talker.py TOPIC COUNT [--rate HZ] [--best-effort] [--latched] [--depth N] [--first VALUE]
              [--wait SUBSCRIBERS]

It waits for its subscribers, publishes, prints "done" and stays until it is asked to end. It keeps
the last N messages, by default all, for subscribers that missed some.
"""

import argparse
import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument('topic')
    parser.add_argument('count', type=int)
    parser.add_argument('--rate', type=float, default=1000.0)
    parser.add_argument('--best-effort', action='store_true')
    parser.add_argument('--latched', action='store_true')
    # A reliable publisher cannot repeat messages that it no longer stores.
    parser.add_argument('--depth', type=int)
    parser.add_argument('--first', type=float, default=0.0)
    parser.add_argument('--wait', type=int, default=1)
    options = parser.parse_args()
    # It ends at once: two participants that end simultaneously may wait for each other.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node('talker', enable_rosout=False, start_parameter_services=False)
    publisher = node.create_publisher(Float64, options.topic, QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=options.depth or options.count,
        reliability=ReliabilityPolicy.BEST_EFFORT if options.best_effort
        else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if options.latched
        else DurabilityPolicy.VOLATILE))
    while publisher.get_subscription_count() < options.wait:
        time.sleep(0.01)
    begin = time.monotonic()
    for i in range(options.count):
        delay = begin + i / options.rate - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)
        publisher.publish(Float64(data=options.first + i))
    print('done', flush=True)
    rclpy.spin(node)
    return 0


if __name__ == '__main__':
    sys.exit(main())
