"""
Measure how fast messages can be recorded without loss.

    python -m benchmarks recorder [--quick]

First, the benchmark searches the highest rate at which a bare raw subscription with an empty
callback, served by the EventsExecutor, receives every 120-byte message of another process: for
some seconds at each rate, then for a whole minute at the rate found and at lower ones until
nothing is lost. At 80 % of that rate, the bare subscription, this package's recorder and a plain
recorder (a raw subscription whose callback writes, served by the SingleThreadedExecutor) run for
a minute each. One table shows all of them.

Once a reliable reader of Fast DDS has fallen behind by more than the writer keeps, repairs use up
the capacity, and it does not catch up while the stream lasts. On a machine with other load, any
receiver, even the bare one, may lose half a run: here, a receiver stopped for 0.06 s at four
fifths of the highest rate loses a third of the next ten seconds; one stopped for 0.02 s loses
nothing. A rate therefore counts as too high only after several tries of some seconds, and a run
with a loss is repeated; all runs are shown.
"""

from collections.abc import Callable
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time

TOPIC = '/load'
DEPTH = 10_000
# Raw payload with header and length: 120 bytes.
DATA_BYTES = 104
SHARE = 0.8
# The search starts here, doubles or halves, and then narrows down to this ratio.
FIRST_RATE = 20_000.0
RATIO = 1.1
TRIES = 2
SEARCH_SECONDS = 5.0
SEARCH_LIMIT_SECONDS = 150.0
# A queue can mask a rate that is too high for some seconds. The highest rate is therefore tried
# for the full duration of a recording, then lower ones by this factor each.
LOWER = 0.85
# Maximum runs of a receiver until one loses nothing.
RUNS = 3
# A sender that falls short of the requested rate by more has not reached it.
FAST_ENOUGH = 0.97


def qos():
    """Return the QoS profile that all sides use."""
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH,
                      reliability=ReliabilityPolicy.RELIABLE)


def source():
    """For each input line with a rate and seconds, publish and print the number sent."""
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
    for line in sys.stdin:
        rate, seconds = map(float, line.split())
        total, sent, begin = round(rate * seconds), 0, time.perf_counter()
        while sent < total:
            due = min(total, int((time.perf_counter() - begin) * rate) + 1)
            if due <= sent:
                time.sleep(0.0002)
            # At most as many as the reader has room for, in case this process was delayed.
            due = min(due, sent + DEPTH // 4)
            for _ in range(due - sent):
                publisher.publish(raw)
            sent = max(sent, due)
            if time.perf_counter() - begin > 1.2 * seconds:
                break
        elapsed = time.perf_counter() - begin
        print(json.dumps({'bytes': len(raw), 'sent': sent, 'rate': sent / elapsed}), flush=True)
    rclpy.try_shutdown()


def receive(kind, folder):
    """Receive until SIGINT or SIGTERM; print the count then and at each SIGUSR1."""
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
    callback: Callable[..., None]
    if kind == 'bare':
        def counted(message):
            nonlocal count
            count += 1

        callback, executor = counted, EventsExecutor()
    else:
        from hmsa.bag.writer import BagTopic, BagWriter
        writer = BagWriter(folder)
        topic = writer.add_topic(BagTopic(TOPIC, 'std_msgs/msg/UInt8MultiArray'))
        flushed = time.monotonic()

        def written(message, info):
            nonlocal count, flushed
            count += 1
            writer.write([(topic, info['received_timestamp'], info['source_timestamp'], 0,
                           message)])
            if time.monotonic() - flushed > 0.5:
                writer.flush()
                flushed = time.monotonic()

        callback, executor = written, SingleThreadedExecutor()
    signal.signal(signal.SIGUSR1, lambda *_: report(count))
    node.create_subscription(UInt8MultiArray, TOPIC, callback, qos(), raw=True)
    executor.add_node(node)
    never = Future()
    while not ended:
        executor.spin_until_future_complete(never, 0.1)
    if kind != 'bare':
        writer.close()
    report(count)
    rclpy.try_shutdown()


def report(count):
    """Print a count."""
    print(json.dumps({'received': count}), flush=True)


def role(*words):
    """Return the command line of one side."""
    return [sys.executable, str(Path(__file__).resolve()), *map(str, words)]


class Source:
    """The process that sends."""

    def __init__(self):
        self.process = subprocess.Popen(
            role('source'), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._requests, self._answers = self.process.stdin, self.process.stdout

    def send(self, rate, seconds):
        """Send; return the number sent and the rate."""
        self._requests.write(f'{rate} {seconds}\n')
        self._requests.flush()
        return json.loads(self._answers.readline())

    def close(self):
        """End the process."""
        self.process.communicate()


def measure(command, rate, seconds, count):
    """Run a receiver under load; return its figures."""
    receiver = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    sender = Source()
    figures = sender.send(rate, seconds)
    time.sleep(1.0)
    receiver.send_signal(signal.SIGINT)
    assert receiver.stdout is not None
    output = receiver.stdout.read()
    _, _, usage = os.wait4(receiver.pid, 0)
    receiver.returncode = 0
    sender.close()
    received = count(output)
    return {
        'rate': figures['rate'], 'seconds': seconds, 'sent': figures['sent'],
        'received': received, 'lost': figures['sent'] - received,
        # Including start and end, when nothing else runs.
        'cores': (usage.ru_utime + usage.ru_stime) / seconds,
        'memory': usage.ru_maxrss / 1024,
    }


def reported(output):
    """Return the count printed by a receiver."""
    return json.loads(output.strip().splitlines()[-1])['received']


def bare(rate, seconds):
    """Measure a subscription with an empty callback."""
    return measure(role('receive', 'bare', ''), rate, seconds, reported)


def plain(rate, seconds, folder):
    """Measure a recorder whose callback writes."""
    return measure(role('receive', 'plain', folder), rate, seconds, reported)


def recorder(rate, seconds, folder):
    """Measure the recorder of this package."""
    from hmsa.bag.reader import BagReader
    return measure(
        [sys.executable, '-m', 'hmsa_ros', 'recorder', '--ros-args', '-p',
         f'storage.uri:={folder}', '-p', f'record.topics:=[{TOPIC}]'], rate, seconds,
        lambda output: sum(1 for _ in BagReader(folder).messages()))


class Search:
    """Search for the highest rate without loss, some seconds at each rate."""

    def __init__(self, seconds):
        self._seconds = seconds
        self._end = time.monotonic() + SEARCH_LIMIT_SECONDS
        self._receiver = subprocess.Popen(
            role('receive', 'bare', ''), stdout=subprocess.PIPE, text=True)
        assert self._receiver.stdout is not None
        self._counts = self._receiver.stdout
        self._source = Source()
        self._before = 0

    def run(self):
        """Return the result at the highest rate without loss, None if there is none."""
        try:
            return self._search()
        finally:
            self._source.close()
            self._receiver.send_signal(signal.SIGINT)
            self._receiver.communicate()

    def _search(self):
        best, low, high, rate = None, None, None, FIRST_RATE
        while time.monotonic() < self._end and rate > 100.0 and (
                low is None or high is None or high / low > RATIO):
            result = self._try(rate)
            if result is not None:
                best, low = result, rate
            else:
                high = rate
            rate = rate * 2.0 if high is None else rate / 2.0 if low is None else (
                low * high) ** 0.5
        return best

    def _try(self, rate):
        """Return the result at a rate without loss, None if there was a loss."""
        for _ in range(TRIES):
            sent = self._source.send(rate, self._seconds)
            received = self._settled()
            lost = sent['sent'] - (received - self._before)
            self._before = received
            fast = sent['rate'] > FAST_ENOUGH * rate
            if not lost and fast:
                return {**sent, 'seconds': self._seconds, 'lost': 0}
            print(f'{rate:9.0f}/s: ' + (
                f'{lost} of {sent["sent"]} lost' if lost else 'cannot be sent that fast'),
                file=sys.stderr)
        return None

    def _settled(self):
        """Return the number of messages received once no more arrive."""
        count, same = -1, 0
        for _ in range(50):
            time.sleep(0.1)
            self._receiver.send_signal(signal.SIGUSR1)
            now = json.loads(self._counts.readline())['received']
            same = same + 1 if now == count else 0
            count = now
            if same >= 3:
                break
        return count


def sustained(rate, seconds):
    """Return the figures of the bare subscription at the highest rate it sustains."""
    while rate > 100.0:
        result = bare(rate, seconds)
        if not result['lost'] and result['rate'] > FAST_ENOUGH * rate:
            return result
        print(f'{rate:9.0f}/s for {seconds:.0f} s: {result["lost"]} of {result["sent"]} lost, '
              f'sent at {result["rate"]:.0f}/s', file=sys.stderr)
        rate *= LOWER
    return None


def runs(name, run):
    """Return the figures of a receiver's runs by name, until one loses nothing."""
    found = {}
    for number in range(1, RUNS + 1):
        found[f'{name}, run {number}'] = figures = run(number)
        if not figures['lost']:
            break
    return found


def compare(*, quick):
    """Search, measure, and return the table; passed if the last run lost nothing."""
    from benchmarks.measure import keep_local
    from benchmarks.sheet import Sheet
    seconds = 2.0 if quick else 60.0
    keep_local()
    found = Search(0.5 if quick else SEARCH_SECONDS).run()
    highest = sustained(found['rate'], seconds) if found is not None else None
    title = 'Recording 120-byte messages of another process'
    if highest is None:
        return Sheet('recorder', f'{title}: no rate goes without loss', [''], [], passed=False)
    rate = SHARE * highest['rate']
    with tempfile.TemporaryDirectory() as folder:
        ours = runs(
            'hmsa recorder', lambda k: recorder(rate, seconds, Path(folder) / f'ours{k}'))
        results = {
            'bare subscription, highest rate': highest,
            **runs('bare subscription', lambda k: bare(rate, seconds)),
            **ours,
            **runs('recorder on the SingleThreadedExecutor',
                   lambda k: plain(rate, seconds, Path(folder) / f'plain{k}')),
        }
    rows = [[name, f'{x["rate"]:,.0f}', f'{x["sent"]:,}', f'{x["lost"]:,}',
             f'{100.0 * x["cores"]:.0f} %', f'{x["memory"]:.0f} MB']
            for name, x in results.items()]
    return Sheet(
        'recorder', f'{title} for {seconds:.0f} s, at 80 % of the highest rate at which a bare '
        f'subscription loses none in that time ({highest["rate"]:,.0f}/s)',
        ['receiver', 'messages/s', 'sent', 'lost', 'processor', 'peak memory'], rows,
        results, list(ours.values())[-1]['lost'] == 0)


if __name__ == '__main__':
    if sys.argv[1] == 'source':
        source()
    else:
        receive(*sys.argv[2:])
