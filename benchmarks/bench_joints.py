"""
Measure how many joints a plant and planner serve at a rate, and how many pairs in parallel.

Also measure how feedback corrects many joints that all differ from their model, and what it costs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
import os
from pathlib import Path
import tempfile
from time import monotonic, sleep
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from trajectory_msgs.msg import JointTrajectory

from benchmarks.faults.rig import Child, Rig
from benchmarks.measure import ros_domain
from benchmarks.sheet import Sheet
from hmsa.errors import HmsaError
from hmsa.interfaces import topics
from hmsa.interfaces.actuator import parameters_of
from hmsa.model.units import NANOSECONDS
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.capture import Capture, Taken
from hmsa_ros.nodes.cdr import JointStateReader, stamp_of
from hmsa_ros.nodes.conversions import to_trajectory
from hmsa_studies.commanders import SCENARIOS

#: Joints of one plant and planner, and rate of samples in Hz.
_JOINTS = ((1, 1000.0), (16, 1000.0), (64, 1000.0), (128, 1000.0), (64, 4000.0))
_SPACES = (1, 4, 8)
_SECONDS = 6.0
#: Joints of one plant and planner with feedback, their targets in turn, each held for so many s,
#: error of G, bias of the sensor, and part of the hold in which the error is read.
_ADAPTED, _TARGETS, _HOLD = (1, 16, 64), (1.4, 1.2, 1.4, 1.1, 1.4, 1.2), 1.2
_ERROR, _BIAS, _READ = 0.2, 3e-3, (0.6, 0.97)
#: Allowed lag of a plant behind the clock in s.
_BEHIND = 0.02
#: Allowed time for nodes to start on a busy machine, in s.
_PATIENCE = 180.0
_TICKS = os.sysconf('SC_CLK_TCK')


def _used(*processes: int) -> float:
    """Return the processor time used by processes so far, in s."""
    ticks = 0
    for process in processes:
        text = Path(f'/proc/{process}/stat').read_text(encoding='ascii')
        words = text.rpartition(')')[2].split()
        ticks += int(words[11]) + int(words[12])
    return ticks / _TICKS


class _Watch:
    """Count samples and verdicts of one pair, with their delays and messages."""

    def __init__(self, rig: Rig, space: str) -> None:
        self.taken: list[Taken] = []
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
            self.taken += messages

    @property
    def behind(self) -> list[float]:
        """Age in s of each sample on arrival."""
        return [(x.received_ns - stamp_of(x.data)) / NANOSECONDS for x in self.taken]

    def _judge(self, message: DiagnosticStatus) -> None:
        self.late = next(int(x.value) for x in message.values if x.key == 'late')
        if message.level == DiagnosticStatus.ERROR:
            self.refusal = message.message


class _Pairs:
    """Plants and planners of joints, one pair in each namespace, and what watches them."""

    def __init__(
            self, rig: Rig, names: Sequence[str], spaces: int, plant: Mapping[str, object],
            planner: Mapping[str, object]) -> None:
        shared = {'joints': f'[{", ".join(names)}]'}
        self.plants: list[Child] = []
        self.planners: list[Child] = []
        self.watches: list[_Watch] = []
        for k in range(spaces):
            space = {'__ns': f'/pair_{k}'}
            self.plants.append(rig.start(
                'plant', {**shared, 'command_timeout': 0.0, **plant}, space))
            self.planners.append(rig.start('planner', {**shared, **planner}, space))
            self.watches.append(_Watch(rig, space['__ns']))
        self._rig = rig
        rig.spin_until(
            lambda: all(x.taken for x in self.watches), 'samples of all plants', _PATIENCE)
        self._requests = [
            ros_entities.publisher(
                rig.node, topics.JOINT_TRAJECTORY, f'/pair_{k}/{topics.PLANNER}')
            for k in range(spaces)]
        rig.spin_until(
            lambda: all(x.get_subscription_count() for x in self._requests), 'the planners',
            _PATIENCE)

    def moved(self, request: JointTrajectory, seconds: float) -> dict[str, float]:
        """Send a request to all planners; return figures of the time until its end."""
        self._rig.spin(1.0)
        groups = [[x.popen.pid for x in self.plants], [x.popen.pid for x in self.planners],
                  [y for x in self.planners for y in _children(x.popen.pid)]]
        for watch in self.watches:
            watch.taken.clear()
        begin, used = monotonic(), [_used(*x) for x in groups]
        for publisher in self._requests:
            publisher.publish(request)
        self._rig.spin(seconds)
        passed = monotonic() - begin
        shares = [(_used(*x) - y) / passed for x, y in zip(groups, used, strict=True)]
        for watch in self.watches:
            watch.close()
            if watch.refusal:
                raise HmsaError(f'{len(request.joint_names)} joints: {watch.refusal}')
        behind = np.concatenate([x.behind for x in self.watches])
        return {
            'samples_per_second': len(behind) / passed / len(self.watches),
            'late': sum(x.late for x in self.watches), 'plant_cores': shares[0],
            'planner_cores': shares[1], 'estimating_cores': shares[2],
            'behind_median': float(np.median(behind)),
            'behind_99': float(np.quantile(behind, 0.99))}


def _children(process: int) -> list[int]:
    """Return the processes that a process has started."""
    text = Path(f'/proc/{process}/task/{process}/children').read_text(encoding='ascii')
    return [int(x) for x in text.split()]


def _run(
        joints: int, rate: float, spaces: int, seconds: float, domain: int,
        folder: Path) -> dict[str, float]:
    """Measure one combination."""
    names = [f'joint_{i}' for i in range(joints)]
    with Rig(folder, domain, watch=False) as rig:
        pairs = _Pairs(rig, names, spaces, {'publish_rate': rate}, {})
        return {'joints': joints, 'rate': rate, 'spaces': spaces,
                **pairs.moved(_sequence(names, seconds), seconds)}


def _sequence(names: Sequence[str], seconds: float) -> JointTrajectory:
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


def _adapted(joints: int, domain: int, folder: Path, targets: Sequence[float]) -> dict[str, Any]:
    """Measure how far joints rest off each of some targets with feedback, in % of the step."""
    scenario, names = SCENARIOS[2], [f'joint_{i}' for i in range(joints)]
    block = parameters_of(scenario.block)
    with Rig(folder, domain, watch=False) as rig:
        pairs = _Pairs(rig, names, 1, {
            **block, 'publish_rate': 1000.0, 'mismatch.shear_modulus': 1.0 + _ERROR,
            'stretch_noise': scenario.noise, 'stretch_bias': _BIAS, 'measurement_delay': 0.002},
            {**block, 'feedback': 'adapt', 'lead_time': 0.05})
        seen = pairs.moved(to_trajectory(
            [(x, round((k + 1) * _HOLD * NANOSECONDS)) for k, x in enumerate(targets)], names),
            len(targets) * _HOLD + 0.5)
    reader = JointStateReader()
    read = [reader.read(x.data) for x in pairs.watches[0].taken]
    time = np.array([x[1] for x in read]) / NANOSECONDS
    stretch = np.array([x[2][0] for x in read]) - _BIAS
    begin = time[np.argmax(np.max(np.abs(stretch - 1.0), axis=1) > 0.05 * abs(targets[0] - 1.0))]
    errors = []
    for k, (before, target) in enumerate(pairwise((1.0, *targets))):
        rests = (time > begin + (k + _READ[0]) * _HOLD) & (time < begin + (k + _READ[1]) * _HOLD)
        # A sequence that was dropped has no samples there.
        errors.append(100.0 * np.abs(
            np.mean(stretch[rests], axis=0) - target) / abs(target - before)
            if rests.any() else np.full(joints, np.nan))
    return {'joints': joints, **seen, 'errors': np.array(errors).T.tolist()}


def adapting(*, quick: bool) -> Sheet:
    """Measure feedback of many joints, which must not make commands late."""
    figures = []
    for joints in (2,) if quick else _ADAPTED:
        with tempfile.TemporaryDirectory() as folder:
            figures.append(_adapted(
                joints, ros_domain(), Path(folder), _TARGETS[:2] if quick else _TARGETS))
        sleep(0.5)
    rows = []
    for x in figures:
        first, second, *later = np.array(x['errors']).T
        rows.append([
            f'{x["joints"]:g} joints', f'{100.0 * x["planner_cores"]:.0f} %',
            f'{100.0 * x["estimating_cores"]:.0f} %', *(
                f'{np.median(y):.2f} ({np.max(y):.2f})'
                if np.size(y) and np.all(np.isfinite(y)) else '-'
                for y in (first, second, later)), f'{x["late"]:g}'])
    return Sheet(
        'adapting', 'Feedback: every G is 20 % higher than planned, samples at 1 kHz; how far '
        'joints rest off the target, % of the step, median (largest)',
        ('', 'planner', 'its estimates', 'first move', 'second', 'third to sixth',
         'late commands'), rows, {'cases': figures}, all(not x['late'] for x in figures))
