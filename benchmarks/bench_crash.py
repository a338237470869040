"""
Measure how much is lost when the recorder is killed.

    python -m benchmarks crash [--quick]

While another process publishes, recorders are started and each is killed with SIGKILL at a random
moment, fifty in all. Each bag is recovered and read by an independent reader. The loss is the
time from the last message in the bag to the kill.
"""

import contextlib
from pathlib import Path
import random
import statistics
import subprocess
import sys
import tempfile
import time

RATE = 1000.0
FLUSH_PERIOD = 0.5
# Recorders that run at the same time.
TOGETHER = 5


def source(rate):
    """Publish numbers at a rate until the process is terminated."""
    import rclpy
    from std_msgs.msg import Float64
    rclpy.init()
    node = rclpy.create_node('source', enable_rosout=False)
    publisher = node.create_publisher(Float64, '/load', 10_000)
    begin, i = time.monotonic(), 0
    while rclpy.ok():
        publisher.publish(Float64(data=float(i)))
        i += 1
        time.sleep(max(0.0, begin + i / rate - time.monotonic()))


class Recorder:
    """A recorder to be killed."""

    def __init__(self, folder):
        self.folder = folder
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'hmsa_ros', 'recorder', '--ros-args', '--log-level', 'warn',
             '-p', f'storage.uri:={folder}', '-p', 'record.topics:=[/load]', '-p',
             f'storage.flush_period:={FLUSH_PERIOD}'])
        self.killed = 0

    def wait(self):
        """Wait until something has been recorded."""
        from hmsa.bag.reader import BagReader
        from hmsa.errors import HmsaError
        end = time.monotonic() + 60.0
        while True:
            # Until its first bytes are written there is no bag.
            with contextlib.suppress(HmsaError):
                if any(BagReader(self.folder).counts().values()):
                    return
            if time.monotonic() > end:
                raise RuntimeError('nothing was recorded within 60 s')
            time.sleep(0.05)

    def kill(self):
        """Kill the process and note the time."""
        self.killed = time.time_ns()
        self.process.kill()

    def loss(self):
        """Recover the bag; return the loss in seconds, the number of messages and of gaps."""
        from rosbags.rosbag2 import Reader

        from hmsa.bag.reader import BagReader
        from hmsa.bag.writer import recover
        self.process.wait()
        recovered = self.folder.with_name(self.folder.name + '_recovered')
        recover(self.folder, recovered)
        with Reader(recovered) as reader:
            stamps = [stamp for _, stamp, _ in reader.messages()]
        sequences = [message.sequence for message in BagReader(recovered).messages()]
        # Dropped by the middleware while the processor was busy, not lost by the kill.
        gaps = sequences[-1] - sequences[0] + 1 - len(sequences)
        return (self.killed - stamps[-1]) * 1e-9, len(stamps), gaps


def compare(*, quick):
    """Kill, measure, and return the table; passed if no loss exceeds the flush period."""
    from benchmarks.measure import keep_local
    from benchmarks.sheet import Sheet
    kills = 2 if quick else 50
    keep_local()
    sender = subprocess.Popen(
        [sys.executable, str(Path(__file__).resolve())], stderr=subprocess.DEVNULL)
    dice = random.Random(1)
    losses, count, missing = list[float](), 0, 0
    recorders = []
    try:
        with tempfile.TemporaryDirectory() as folder:
            while len(losses) < kills:
                recorders = [
                    Recorder(Path(folder) / f'bag{len(losses)}_{i}')
                    for i in range(min(TOGETHER, kills - len(losses)))]
                for recorder in recorders:
                    recorder.wait()
                # At separate moments within three flush periods.
                for recorder in recorders:
                    time.sleep(dice.uniform(0.0, 3.0 * FLUSH_PERIOD / len(recorders)))
                    recorder.kill()
                for recorder in recorders:
                    loss, messages, gaps = recorder.loss()
                    losses.append(loss)
                    count += messages
                    missing += gaps
    finally:
        for recorder in recorders:
            recorder.process.kill()
            recorder.process.wait()
        sender.kill()
        sender.wait()
    losses.sort()
    return Sheet(
        'crash', f'Loss when the recorder is killed, at {RATE:g} messages/s and a flush period '
        f'of {FLUSH_PERIOD:g} s',
        ['kills', 'bags recovered', 'messages recovered', 'missing among them', 'median loss',
         'largest loss'],
        [[str(kills), str(len(losses)), f'{count:,}', f'{missing:,}',
          f'{statistics.median(losses):.3f} s', f'{losses[-1]:.3f} s']],
        {'losses': losses, 'messages': count, 'missing': missing},
        losses[-1] <= FLUSH_PERIOD and not missing)


if __name__ == '__main__':
    source(RATE)
