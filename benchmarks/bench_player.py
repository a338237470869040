"""
How exactly a bag is played.

    python benchmarks/bench_player.py [--rate HZ] [--seconds S] [--speeds 1 10]

A bag of equally spaced messages is played; for each speed the error of the sending times
against the bag's own spacing is printed, by the source stamps that the middleware puts on each
message. The first message is where time is counted from. Before and after, the same is measured
of a loop that only sleeps: what the machine itself allows at that moment.
"""

import argparse
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time

ROOT = Path(__file__).resolve().parent.parent
START = 1_700_000_000 * 10**9


def write(folder, rate, seconds):
    """Write a bag of numbers at a rate."""
    import struct

    from hmsa_ros.bag.definitions import message_definition, type_hash
    from hmsa_ros.bag.qos import Qos
    from hmsa_ros.bag.writer import BagWriter, Topic
    name = 'std_msgs/msg/Float64'
    encoding, text = message_definition(name)
    with BagWriter(folder, preset='zstd_fast') as writer:
        number = writer.add_topic(Topic(
            '/load', name, text, encoding, (Qos(),), type_hash(name)))
        writer.write((number, START + round(i * 1e9 / rate), 0, i,
                      b'\0\1\0\0' + struct.pack('<d', i)) for i in range(round(rate * seconds)))


def receive():
    """Take messages off a raw subscription; print their source stamps at the end."""
    import rclpy
    from rclpy.qos import HistoryPolicy, QoSProfile
    from std_msgs.msg import Float64
    sys.path.insert(0, str(ROOT))
    from hmsa_ros.nodes.capture import Capture, RawSubscription
    ended = []
    signal.signal(signal.SIGINT, lambda *_: ended.append(True))
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    node = rclpy.create_node('receiver', enable_rosout=False)
    stamps = []
    capture = Capture(node, lambda taken: stamps.extend(
        (message.source_ns, message.data[4:].hex()) for _, messages in taken
        for message in messages))
    capture.add('load', RawSubscription(node, Float64, '/load', QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=100_000)))
    capture.start()
    while not ended:
        time.sleep(0.1)
    capture.stop()
    print(json.dumps(stamps), flush=True)
    rclpy.try_shutdown()


def sleep_only(rate, seconds):
    """Sleep until each time of a grid; return how late each wake-up is."""
    late, begin = [], time.monotonic()
    for i in range(round(rate * seconds)):
        time.sleep(max(0.0, begin + i / rate - time.monotonic()))
        late.append(time.monotonic() - begin - i / rate)
    return sorted(late)


def figures(errors):
    """Return median, p99 and largest of sorted errors as text."""
    return '  '.join(f'{error * 1e3:7.3f} ms' for error in (
        errors[len(errors) // 2], errors[len(errors) * 99 // 100], errors[-1]))


def play(folder, speed):
    """Play a bag at a speed; return the stamps and numbers received."""
    import struct
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    receiver = subprocess.Popen(
        [sys.executable, __file__, '--receive'], stdout=subprocess.PIPE, env=environment)
    subprocess.run(
        [sys.executable, '-m', 'hmsa_ros', 'player', '--ros-args', '--log-level', 'warn', '-p',
         f'storage.uri:={folder}', '-p', f'play.rate:={float(speed)}', '-p',
         'play.wait_for_subscribers:=[/load]'], env=environment, check=True,
        stdout=subprocess.DEVNULL)
    receiver.send_signal(signal.SIGINT)
    received = json.loads(receiver.communicate()[0])
    return ([stamp for stamp, _ in received],
            [struct.unpack('<d', bytes.fromhex(data))[0] for _, data in received])


def main():
    """Write, play, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--rate', type=float, default=1000.0)
    parser.add_argument('--seconds', type=float, default=30.0)
    parser.add_argument('--speeds', type=float, nargs='+', default=[1.0, 10.0])
    parser.add_argument('--receive', action='store_true', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.receive:
        receive()
        return 0
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    sys.path.insert(0, str(ROOT))
    head = (f'{"speed":>6} {"msg/s":>7} {"sent":>7} {"received":>8} {"in order":>8} '
            f'{"median":>10}  {"p99":>10}  {"largest":>10}')
    print(head)
    print('-' * len(head))
    sleeping = f'{"only sleeping":>14} {"":>24} '
    print(sleeping + figures(sleep_only(options.rate, options.seconds / 3)))
    good = True
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'bag'
        write(bag, options.rate, options.seconds)
        count = round(options.rate * options.seconds)
        for speed in options.speeds:
            stamps, numbers = play(bag, speed)
            errors = sorted(
                abs((stamp - stamps[0]) * 1e-9 - number / options.rate / speed)
                for stamp, number in zip(stamps, numbers, strict=True))
            order = numbers == list(range(count))
            p99 = errors[len(errors) * 99 // 100]
            print(f'{speed:6g} {options.rate * speed:7.0f} {count:7} {len(numbers):8} '
                  f'{"yes" if order else "no":>8} {figures(errors)}')
            good &= order and (speed != 1.0 or p99 < 1e-3)
    print(sleeping + figures(sleep_only(options.rate, options.seconds / 3)))
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
