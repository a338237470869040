"""
How fast can be recorded without loss.

    python benchmarks/bench_recorder.py [--seconds S] [--search-seconds S] [--json FILE]

First the highest rate is searched at which a bare raw subscription that does nothing, served
by the EventsExecutor, gets every 120-byte message of another process. At 80 % of that rate the
recorder of this package and a plain one (a raw subscription whose callback writes, served by
the SingleThreadedExecutor) then record for the given time, and the bare subscription is run
for as long. One table shows all of them. It takes some five minutes.

Once a reliable reader of Fast DDS has fallen behind by more than the writer keeps, repairs take
up the capacity and it does not catch up again as long as the stream lasts: on a machine that
does other work at the same time any receiver, the bare one too, may lose half a run.
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
TOPIC = '/load'
DEPTH = 10_000
# Raw payload with header and length: 120 bytes.
DATA_BYTES = 104
SHARE = 0.8


def qos():
    """Return the profile that all sides use."""
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH,
                      reliability=ReliabilityPolicy.RELIABLE)


def source(rate, seconds):
    """Send at a rate, then say how many."""
    import rclpy
    from rclpy.serialization import serialize_message
    from std_msgs.msg import UInt8MultiArray
    rclpy.init()
    node = rclpy.create_node('source', enable_rosout=False)
    publisher = node.create_publisher(UInt8MultiArray, TOPIC, qos())
    raw = serialize_message(UInt8MultiArray(data=bytes(DATA_BYTES)))
    while not publisher.get_subscription_count():
        time.sleep(0.01)
    time.sleep(0.5)
    total, sent, begin = round(rate * seconds), 0, time.perf_counter()
    while sent < total:
        due = min(total, int((time.perf_counter() - begin) * rate) + 1)
        if due <= sent:
            time.sleep(0.0002)
        for _ in range(due - sent):
            publisher.publish(raw)
        sent = max(sent, due)
    elapsed = time.perf_counter() - begin
    print(json.dumps({'bytes': len(raw), 'sent': sent, 'rate': sent / elapsed}), flush=True)
    time.sleep(1.0)
    rclpy.try_shutdown()


def receive(kind, folder):
    """Receive until told to end, then say how many."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.experimental.events_executor import EventsExecutor
    from rclpy.task import Future
    from std_msgs.msg import UInt8MultiArray
    ended = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.append(True))
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    node = rclpy.create_node('receiver', enable_rosout=False)
    count = 0
    if kind == 'bare':
        def callback(message):
            nonlocal count
            count += 1
        executor = EventsExecutor()
    else:
        from hmsa_ros.bag.writer import BagWriter, Topic
        writer = BagWriter(folder)
        number = writer.add_topic(Topic(TOPIC, 'std_msgs/msg/UInt8MultiArray'))
        flushed = time.monotonic()

        def callback(message, info):
            nonlocal count, flushed
            count += 1
            writer.write([(number, info['received_timestamp'], info['source_timestamp'], 0,
                           message)])
            if time.monotonic() - flushed > 0.5:
                writer.flush()
                flushed = time.monotonic()
        executor = SingleThreadedExecutor()
    node.create_subscription(UInt8MultiArray, TOPIC, callback, qos(), raw=True)
    executor.add_node(node)
    never = Future()
    while not ended:
        executor.spin_until_future_complete(never, 0.1)
    if kind != 'bare':
        writer.close()
    print(json.dumps({'received': count}), flush=True)
    rclpy.try_shutdown()


def measure(command, rate, seconds, count):
    """Run a receiver under load; return its figures."""
    environment = {**os.environ, 'PYTHONPATH': str(ROOT), 'PYTHONUNBUFFERED': '1'}
    receiver = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True)
    sender = subprocess.Popen(
        [sys.executable, __file__, '--role', 'source', str(rate), str(seconds)],
        stdout=subprocess.PIPE, env=environment, text=True)
    figures = json.loads(sender.communicate()[0])
    receiver.send_signal(signal.SIGINT)
    output = receiver.stdout.read()
    _, _, usage = os.wait4(receiver.pid, 0)
    receiver.returncode = 0
    received = count(output)
    return {
        'rate': figures['rate'], 'seconds': seconds, 'sent': figures['sent'],
        'received': received, 'lost': figures['sent'] - received,
        # Start and end included: what is used for nothing else.
        'cores': (usage.ru_utime + usage.ru_stime) / seconds,
        'memory': usage.ru_maxrss / 1024,
    }


def reported(output):
    """Return what a receiver has counted."""
    return json.loads(output.strip().splitlines()[-1])['received']


def bare(rate, seconds):
    """Measure a subscription that does nothing."""
    return measure([sys.executable, __file__, '--role', 'bare'], rate, seconds, reported)


def plain(rate, seconds, folder):
    """Measure a recorder whose callback writes."""
    return measure([sys.executable, __file__, '--role', 'plain', str(folder)], rate, seconds,
                   reported)


def recorder(rate, seconds, folder):
    """Measure the recorder of this package."""
    from hmsa_ros.bag.reader import BagReader
    return measure(
        [sys.executable, '-m', 'hmsa_ros', 'recorder', '--ros-args', '-p',
         f'storage.uri:={folder}', '-p', f'record.topics:=[{TOPIC}]'], rate, seconds,
        lambda output: sum(1 for _ in BagReader(folder).messages()))


def search(seconds):
    """Return the highest rate without loss, in steps of an eighth."""
    best, rate = None, 8000.0
    while rate < 500_000.0:
        # A second try: other work on the machine is not the subscription's fault.
        for _ in range(2):
            result = bare(rate, seconds)
            if not result['lost'] and result['rate'] > 0.97 * rate:
                best = result
                break
        else:
            reason = 'loses messages' if result['lost'] else 'cannot be sent that fast'
            print(f'{result["rate"]:9.0f}/s: bare subscription {reason}: '
                  f'{result["lost"]} of {result["sent"]}', file=sys.stderr)
            break
        rate *= 1.125
    return best


def main():
    """Search, measure, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--search-seconds', type=float, default=5.0)
    parser.add_argument('--json')
    parser.add_argument('--role', nargs='+', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        if options.role[0] == 'source':
            source(float(options.role[1]), float(options.role[2]))
        else:
            receive(options.role[0], options.role[-1])
        return 0
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    sys.path.insert(0, str(ROOT))
    results = {'bare subscription, highest rate': search(options.search_seconds)}
    if results['bare subscription, highest rate'] is None:
        print('even 8000 messages a second are not received without loss', file=sys.stderr)
        return 1
    rate = SHARE * results['bare subscription, highest rate']['rate']
    with tempfile.TemporaryDirectory() as folder:
        results['bare subscription'] = bare(rate, options.seconds)
        results['hmsa recorder'] = recorder(rate, options.seconds, Path(folder) / 'ours')
        results['plain recorder, SingleThreadedExecutor'] = plain(
            rate, options.seconds, Path(folder) / 'plain')
    head = f'{"receiver":40} {"msg/s":>8} {"s":>4} {"sent":>9} {"lost":>9} {"cores":>6} {"MB":>5}'
    print(head)
    print('-' * len(head))
    for name, result in results.items():
        print(f'{name:40} {result["rate"]:8.0f} {result["seconds"]:4.0f} {result["sent"]:9} '
              f'{result["lost"]:9} {result["cores"]:6.2f} {result["memory"]:5.0f}')
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=2))
    return 0 if results['hmsa recorder']['lost'] == 0 else 1


if __name__ == '__main__':
    sys.exit(main())
