"""
Measure pre-emption: from a request's arrival at the planner node to its first command.

The actuator moves all the time: each setpoint comes 3 ms after the previous one, half way through
its move, so every plan starts from a moving state. The node's own time is the processor time of
its callback, which plans and publishes the first command, the plan and the verdict. The round
trip is wall-clock time and adds DDS on this host in both directions and the executors of two
processes.
"""

import os
from statistics import median
import subprocess
import sys
from time import monotonic, perf_counter, thread_time

import numpy as np

from benchmarks.measure import Row, table
from benchmarks.sheet import Sheet

MODES: tuple[tuple[str, dict[str, str]], ...] = (
    ('two_step', {}),
    ('robust', {'shaper': 'robust'}),
    ('minimum_time', {'shaper': 'minimum_time'}),
    ('two_step on a grid of 1 ms', {'command_mode': 'sampled'}),
    ('two_step through ramps of 50 T/s', {'slew_limit': '50.0'}),
)
_SPACING_NS = 3_000_000
_TARGETS = np.random.default_rng(1).uniform(0.8, 1.4, 4096)


def compare(*, quick: bool = False) -> Sheet:
    """Measure all modes; the column of times is the 99th percentile."""
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    count = 20 if quick else 2000
    rows = [own_time(name, parameters, count) for name, parameters in MODES]
    rows.append(round_trip(count // 4))
    return table(
        'preemption', f'Pre-emption of a moving actuator, {count} requests a mode', '99 %', '',
        rows)


def own_time(name: str, parameters: dict[str, str], count: int) -> Row:
    """Time the node's callback."""
    import rclpy
    from rosgraph_msgs.msg import Clock
    from std_msgs.msg import Float64

    from hmsa_ros.nodes.conversions import to_time
    from hmsa_ros.nodes.planner import PlannerNode

    words = ['hmsa', '--ros-args', '-p', 'use_sim_time:=true']
    for key, value in parameters.items():
        words += ['-p', f'{key}:={value}']
    rclpy.init(args=words)
    try:
        node = PlannerNode()
        source = node._time_source
        channel = node._channels['actuator']
        spans = []
        for i in range(count):
            # Simulated time, set as by /clock; requests are 3 ms apart in it.
            source.clock_callback(Clock(clock=to_time(10**9 + i * _SPACING_NS)))
            message = Float64(data=float(_TARGETS[i % _TARGETS.size]))
            begin = thread_time()
            channel._on_setpoint(message)
            spans.append(thread_time() - begin)
        refused = node._runtime.planning.refused
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
    return _row(name, "the node's own time", spans, f'; {refused} refused' if refused else '')


def round_trip(count: int) -> Row:
    """Time the round trip of a setpoint to the planner process and its first command."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from std_msgs.msg import Float64

    from hmsa.interfaces import topics
    from hmsa_ros.nodes import ros_entities

    planner = subprocess.Popen([sys.executable, '-m', 'hmsa_ros', 'planner'])
    rclpy.init(args=[])
    try:
        node = rclpy.create_node('preemption')
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        received: list[float] = []
        command = topics.FLUX_DENSITY_COMMAND
        ros_entities.subscribe(node, command, lambda _: received.append(perf_counter()))
        publisher = ros_entities.publisher(node, topics.SETPOINT, topics.PLANNER)
        deadline = monotonic() + 30.0
        while publisher.get_subscription_count() == 0 or not node.count_publishers(command.name):
            executor.spin_once(timeout_sec=0.05)
            if monotonic() > deadline:
                raise TimeoutError('the planner has not come up within 30 s')
        spans = []
        for i in range(count):
            received.clear()
            begin = perf_counter()
            publisher.publish(Float64(data=float(_TARGETS[i % _TARGETS.size])))
            deadline = monotonic() + 5.0
            while not received and monotonic() < deadline:
                executor.spin_once(timeout_sec=0.05)
            if received:
                spans.append(received[0] - begin)
        executor.shutdown()
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
        planner.terminate()
        planner.wait()
    return _row('two_step', 'round trip over DDS, two processes', spans, '')


def _row(name: str, setting: str, spans: list[float], more: str) -> Row:
    return Row(
        name, setting, float(np.percentile(spans, 99)), median(spans), None,
        f'largest {1e3 * max(spans):.2f} ms of {len(spans)}{more}')
