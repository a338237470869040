"""
Records messages of plant or driver, and writes them to a file when asked to end.

    onlooker.py FILE.npy

A row contains the timestamp and the time of arrival in s, stretch and flux density in T.
"""

import signal
import sys
import time

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState


def main():
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node('onlooker', start_parameter_services=False)
    rows = []
    ends = []

    def take(message):
        if not rows:
            print('sees', flush=True)
        stamp = message.header.stamp
        rows.append((
            stamp.sec + 1e-9 * stamp.nanosec, time.time(), message.position[0],
            message.effort[0]))
        if ends and rows[-1][0] >= ends[0]:
            raise KeyboardInterrupt

    def end(*_):
        # Once all samples taken so far are read.
        ends.append(time.time())

    node.create_subscription(JointState, 'joint_states', take, 5000)
    signal.signal(signal.SIGTERM, end)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        np.save(sys.argv[1], np.array(rows))


if __name__ == '__main__':
    main()
