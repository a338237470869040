"""
Measure the timing error of bag playback.

    python -m benchmarks player [--quick]

A bag of equally spaced messages is played. For each speed, the error of the sending times against
the bag's own spacing is printed, from the source timestamps that the middleware adds to each
message. Time counts from the first message. Before and after, the same is measured for a loop
that only sleeps, which shows the machine's own limit at that moment.
"""

import json
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time

START = 1_700_000_000 * 10**9


def write(folder, rate, seconds):
    """Write a bag of numbers at a rate."""
    import struct

    from hmsa.bag.definitions import message_definition, type_hash
    from hmsa.bag.qos import Qos
    from hmsa.bag.writer import BagTopic, BagWriter
    name = 'std_msgs/msg/Float64'
    encoding, text = message_definition(name)
    with BagWriter(folder, preset='zstd_fast') as writer:
        number = writer.add_topic(BagTopic(
            '/load', name, text, encoding, (Qos(),), type_hash(name)))
        writer.write((number, START + round(i * 1e9 / rate), 0, i,
                      b'\0\1\0\0' + struct.pack('<d', i)) for i in range(round(rate * seconds)))


def receive():
    """Take messages from a raw subscription; print their source timestamps at the end."""
    import rclpy
    from rclpy.qos import HistoryPolicy, QoSProfile
    from std_msgs.msg import Float64

    from hmsa_ros.nodes.capture import Capture, RawSubscription
    ended = []
    signal.signal(signal.SIGINT, lambda *_: ended.append(True))
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    node = rclpy.create_node('receiver', enable_rosout=False)
    stamps: list[tuple[int, str]] = []
    capture = Capture(lambda taken: stamps.extend(
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
    """Sleep until each time of a grid; return the delay of each wake-up."""
    late, begin = [], time.monotonic()
    for i in range(round(rate * seconds)):
        time.sleep(max(0.0, begin + i / rate - time.monotonic()))
        late.append(time.monotonic() - begin - i / rate)
    return sorted(late)


def cells(errors):
    """Return median, p99 and largest of sorted errors as text."""
    return [f'{error * 1e3:.3f} ms' for error in (
        errors[len(errors) // 2], errors[len(errors) * 99 // 100], errors[-1])]


def play(folder, speed):
    """Play a bag at a speed; return the timestamps and numbers received."""
    import struct
    receiver = subprocess.Popen(
        [sys.executable, str(Path(__file__).resolve())], stdout=subprocess.PIPE)
    subprocess.run(
        [sys.executable, '-m', 'hmsa_ros', 'player', '--ros-args', '--log-level', 'warn', '-p',
         f'storage.uri:={folder}', '-p', f'play.rate:={float(speed)}', '-p',
         'play.wait_for_subscribers:=[/load]'], check=True, stdout=subprocess.DEVNULL)
    receiver.send_signal(signal.SIGINT)
    received = json.loads(receiver.communicate()[0])
    return ([stamp for stamp, _ in received],
            [struct.unpack('<d', bytes.fromhex(data))[0] for _, data in received])


def compare(*, quick):
    """Write, play, and return the table; passed if in order, and at rate 1 99 % within 1 ms."""
    from benchmarks.measure import keep_local
    from benchmarks.sheet import Sheet
    rate, seconds = 1000.0, 2.0 if quick else 30.0
    keep_local()
    count = round(rate * seconds)
    rows, figures, passed = [], {}, True

    def sleeping(name):
        errors = sleep_only(rate, seconds / 3)
        rows.append([name, f'{rate:,.0f}', '', '', '', *cells(errors)])

    sleeping('a loop that only sleeps, before')
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'bag'
        write(bag, rate, seconds)
        for speed in (1.0, 10.0):
            stamps, numbers = play(bag, speed)
            errors = sorted(
                abs((stamp - stamps[0]) * 1e-9 - (number - numbers[0]) / rate / speed)
                for stamp, number in zip(stamps, numbers, strict=True))
            skipped = len(set(range(count)) - set(numbers))
            order = numbers == sorted(numbers)
            rows.append([
                f'hmsa player at rate {speed:g}', f'{rate * speed:,.0f}', f'{count:,}',
                f'{skipped:,}', 'yes' if order else 'no', *cells(errors)])
            figures[f'rate {speed:g}'] = {
                'count': count, 'skipped': skipped, 'order': order,
                'median': errors[len(errors) // 2], 'p99': errors[len(errors) * 99 // 100],
                'largest': errors[-1]}
            passed &= order and not skipped and (
                speed != 1.0 or errors[len(errors) * 99 // 100] < 1e-3)
    sleeping('a loop that only sleeps, after')
    return Sheet(
        'player', "Error of the sending times against the bag's own spacing",
        ['', 'messages/s', 'sent', 'skipped', 'in order', 'median', 'p99', 'largest'], rows,
        figures, passed)


if __name__ == '__main__':
    receive()
