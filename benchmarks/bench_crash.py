"""
How much is lost when the recorder is killed.

    python benchmarks/bench_crash.py [--kills N] [--rate HZ]

While another process publishes, the recorder is started and killed with SIGKILL at a random
moment, N times. Each bag is recovered, read by an independent reader, and the loss measured:
the time from the last message in the bag to the kill. Takes some five seconds a kill.
"""

import argparse
import os
from pathlib import Path
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time

ROOT = Path(__file__).resolve().parent.parent


def source(rate):
    """Publish numbers at a rate until told to end."""
    import rclpy
    from std_msgs.msg import Float64
    rclpy.init()
    node = rclpy.create_node('source', enable_rosout=False)
    publisher = node.create_publisher(Float64, '/load', 1000)
    begin, i = time.monotonic(), 0
    while rclpy.ok():
        publisher.publish(Float64(data=float(i)))
        i += 1
        time.sleep(max(0.0, begin + i / rate - time.monotonic()))


def kill_one(folder, flush_period, wait):
    """Record, kill, recover; return the loss in seconds and the number of messages."""
    from rosbags.rosbag2 import Reader

    from hmsa_ros.bag.reader import BagReader
    from hmsa_ros.bag.recover import recover
    recorder = subprocess.Popen(
        [sys.executable, '-m', 'hmsa_ros', 'recorder', '--ros-args', '--log-level', 'warn', '-p',
         f'storage.uri:={folder}', '-p', 'record.topics:=[/load]', '-p',
         f'storage.flush_period:={flush_period}'])
    end = time.monotonic() + 60.0
    while not (folder.is_dir() and any(BagReader(folder).counts().values())):
        if time.monotonic() > end:
            raise SystemExit('nothing was recorded within 60 s')
        time.sleep(0.05)
    time.sleep(wait)
    killed = time.time_ns()
    recorder.kill()
    recorder.wait()
    recovered = folder.with_name(folder.name + '_recovered')
    recover(folder, recovered)
    with Reader(recovered) as reader:
        stamps = [stamp for _, stamp, _ in reader.messages()]
    sequences = [message.sequence for message in BagReader(recovered).messages()]
    if sequences != list(range(sequences[0], sequences[0] + len(sequences))):
        raise SystemExit(f'{recovered} has gaps')
    return (killed - stamps[-1]) * 1e-9, len(stamps)


def main():
    """Kill, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--kills', type=int, default=50)
    parser.add_argument('--rate', type=float, default=1000.0)
    parser.add_argument('--flush-period', type=float, default=0.5)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--role', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role == 'source':
        source(options.rate)
        return 0
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['PYTHONPATH'] = str(ROOT)
    sys.path.insert(0, str(ROOT))
    sender = subprocess.Popen(
        [sys.executable, __file__, '--role', 'source', '--rate', str(options.rate)],
        stderr=subprocess.DEVNULL)
    dice = random.Random(options.seed)
    losses, count = [], 0
    try:
        with tempfile.TemporaryDirectory() as folder:
            for i in range(options.kills):
                loss, messages = kill_one(
                    Path(folder) / f'bag{i}', options.flush_period, dice.uniform(0.0, 1.5))
                losses.append(loss)
                count += messages
    finally:
        sender.send_signal(signal.SIGKILL)
        sender.wait()
    print(f'{len(losses)} kills at {options.rate:g} messages/s, flush period '
          f'{options.flush_period:g} s: {count} messages recovered, all readable; lost at the '
          f'end: median {statistics.median(losses):.3f} s, largest {max(losses):.3f} s')
    return 0 if max(losses) <= options.flush_period else 1


if __name__ == '__main__':
    sys.exit(main())
