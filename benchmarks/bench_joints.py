"""Measure how many joints a plant and planner serve at a rate, and how many pairs in parallel."""

from collections.abc import Sequence
from dataclasses import replace
import os
from pathlib import Path
import tempfile
from time import monotonic, sleep

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np

from benchmarks.faults.rig import Child, Rig
from benchmarks.measure import ros_domain
from benchmarks.sheet import Sheet
from hmsa.errors import HmsaError
from hmsa.interfaces import topics
from hmsa.model.units import NANOSECONDS
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.capture import Capture, Taken
from hmsa_ros.nodes.cdr import stamp_of
from hmsa_ros.nodes.conversions import to_trajectory

#: Joints of one plant and planner, and rate of samples in Hz.
_JOINTS = ((1, 1000.0), (16, 1000.0), (64, 1000.0), (128, 1000.0), (64, 4000.0))
_SPACES = (1, 4, 8)
_SECONDS = 6.0
#: Allowed lag of a plant behind the clock in s.
_BEHIND = 0.02
#: Allowed time for nodes to start on a busy machine, in s.
_PATIENCE = 180.0
_TICKS = os.sysconf('SC_CLK_TCK')


def _used(child: Child) -> float:
    """Return the processor time used by a process so far, in s."""
    text = Path(f'/proc/{child.popen.pid}/stat').read_text(encoding='ascii')
    words = text.rpartition(')')[2].split()
    return (int(words[11]) + int(words[12])) / _TICKS


class _Watch:
    """Count samples and verdicts of one pair, with their delays and messages."""

    def __init__(self, rig: Rig, space: str) -> None:
        self.behind: list[float] = []
        self.late = 0
        self.refusal = ''
        # Timestamped on arrival and not decoded, so that later work here does not count.
        self._capture = Capture(self._take)
        self._capture.add(None, ros_entities.listen(rig.node, replace(
            topics.JOINT_STATES, name=f'{space}/{topics.JOINT_STATES.name}')))
        self._capture.start()
        ros_entities.subscribe(rig.node, topics.STATUS, self._judge, f'{space}/{topics.PLANNER}')

    def close(self) -> None:
        """End the receiving thread."""
        self._capture.stop()

    def _take(self, taken: Sequence[tuple[None, list[Taken]]]) -> None:
        for _, messages in taken:
            for message in messages:
                self.behind.append(
                    (message.received_ns - stamp_of(message.data)) / NANOSECONDS)

    def _judge(self, message: DiagnosticStatus) -> None:
        self.late = next(int(x.value) for x in message.values if x.key == 'late')
        if message.level == DiagnosticStatus.ERROR:
            self.refusal = message.message


def _run(
        joints: int, rate: float, spaces: int, seconds: float, domain: int,
        folder: Path) -> dict[str, float]:
    """Measure one combination."""
    names = [f'joint_{i}' for i in range(joints)]
    listed = '[' + ', '.join(names) + ']'
    with Rig(folder, domain, watch=False) as rig:
        plants, planners, watches = [], [], []
        for k in range(spaces):
            space = f'/pair_{k}'
            shared = {'joints': listed, 'command_timeout': 0.0}
            plants.append(rig.start(
                'plant', {**shared, 'publish_rate': rate}, {'__ns': space}))
            planners.append(rig.start('planner', {'joints': listed}, {'__ns': space}))
            watches.append(_Watch(rig, space))
        rig.spin_until(
            lambda: all(x.behind for x in watches), 'samples of all plants', _PATIENCE)
        trajectories = [
            ros_entities.publisher(
                rig.node, topics.JOINT_TRAJECTORY, f'/pair_{k}/{topics.PLANNER}')
            for k in range(spaces)]
        rig.spin_until(
            lambda: all(x.get_subscription_count() for x in trajectories), 'the planners',
            _PATIENCE)
        rig.spin(1.0)
        for watch in watches:
            watch.behind.clear()
        begin = monotonic()
        used = [[_used(x) for x in group] for group in (plants, planners)]
        for publisher in trajectories:
            publisher.publish(_sequence(names, seconds))
        rig.spin(seconds)
        passed = monotonic() - begin
        shares = [
            sum(_used(x) - y for x, y in zip(group, before, strict=True)) / passed
            for group, before in zip((plants, planners), used, strict=True)]
        for watch in watches:
            watch.close()
            if watch.refusal:
                raise HmsaError(f'{joints} joints at {rate:g} Hz: {watch.refusal}')
        got = sum(len(x.behind) for x in watches) / passed / spaces
        behind = np.concatenate([x.behind for x in watches])
    return {
        'joints': joints, 'rate': rate, 'spaces': spaces, 'samples_per_second': got,
        'late': sum(x.late for x in watches), 'plant_cores': shares[0], 'planner_cores': shares[1],
        'behind_median': float(np.median(behind)),
        'behind_99': float(np.quantile(behind, 0.99))}


def _sequence(names: Sequence[str], seconds: float):  # type: ignore[no-untyped-def]
    """Return a request that moves all joints every 0.2 s."""
    return to_trajectory(
        [(1.1 if k % 2 else 1.2, round((k + 1) * 0.2 * NANOSECONDS))
         for k in range(int(seconds / 0.2))], names)


def compare(*, quick: bool) -> Sheet:
    """Measure joints in one pair of nodes, and pairs in parallel; 64 at 1 kHz must keep up."""
    cases = [(joints, rate, 1) for joints, rate in _JOINTS] + [
        (1, 1000.0, spaces) for spaces in _SPACES[1:]]
    if quick:
        cases = [(8, 1000.0, 1), (1, 500.0, 2)]
    domain = ros_domain()
    figures = []
    for joints, rate, spaces in cases:
        with tempfile.TemporaryDirectory() as folder:
            figures.append(_run(
                joints, rate, spaces, 1.0 if quick else _SECONDS, domain, Path(folder)))
        sleep(0.5)
    rows = [[
        f'{x["joints"]:g} joints at {x["rate"]:g} Hz'
        + (f', {x["spaces"]:g} pairs' if x['spaces'] > 1 else ''),
        f'{x["samples_per_second"]:.0f}', f'{100.0 * x["plant_cores"]:.0f} %',
        f'{100.0 * x["planner_cores"]:.0f} %', f'{1e3 * x["behind_median"]:.2f} ms',
        f'{1e3 * x["behind_99"]:.1f} ms', f'{x["late"]:g}'] for x in figures]
    wanted = [x for x in figures if (x['joints'], x['rate'], x['spaces']) == (64, 1000.0, 1)]
    return Sheet(
        'joints', 'Plant and planner at work, all joints moved five times a second',
        ('', 'samples/s each', 'plants', 'planners', 'behind, median', '99 %',
         'late commands'), rows, {'cases': figures},
        quick or all(
            x['samples_per_second'] > 0.99 * x['rate'] and x['behind_99'] < _BEHIND
            for x in wanted))
