"""Measure the cost of a cycle of planner and plant in one process, and the loop's lateness."""

from collections.abc import Callable
from pathlib import Path
import tempfile
from time import monotonic_ns, sleep, thread_time_ns

import numpy as np

from benchmarks.faults.rig import Rig
from benchmarks.measure import ros_domain
from benchmarks.sheet import Sheet
from hmsa.interfaces import topics
from hmsa.model.units import NANOSECONDS
from hmsa_ros.nodes.conversions import to_trajectory

#: Bound in us of the 99 % quantile of a cycle's processor time, beyond the excess of a bare loop's
#: 99 % quantile over its median, which is due to the machine.
LARGEST = 300.0
_PERIOD_NS = 1_000_000
_LOOP = 'controller: loop'
_SECONDS = 20.0
#: Between two moves, in s.
_HOLD = 0.5
_LEAD = 0.005


def _run(seconds: float, *, moves: bool, readers: bool, folder: Path) -> dict[str, float]:
    """Return the newest figures of the loop, with the lateness of these seconds alone."""
    with Rig(folder, ros_domain(), watch=readers) as rig:
        rig.start('controller', {'lead_time': _LEAD})
        rig.ready(topics.PLANNER)
        rig.spin_until(lambda: _LOOP in rig.diagnostics, 'diagnostics of the loop')
        # Discard the start: run more cycles than the loop's statistics cover.
        rig.spin(5.0)
        before = dict(rig.diagnostics[_LOOP])
        if moves:
            rig.publish_trajectory(to_trajectory(
                [(1.1 if k % 2 else 1.2, round((k + 1) * _HOLD * NANOSECONDS))
                 for k in range(int(seconds / _HOLD))], ['actuator']))
        rig.spin(seconds)
        after = rig.diagnostics[_LOOP]
        cycles = int(after['cycles']) - int(before['cycles'])
        return {
            'cycles_per_second': cycles / seconds,
            'late': (int(after['late']) - int(before['late'])) / max(cycles, 1),
            **{x: float(after[f'work_{x}_us']) for x in ('p50', 'p99', 'largest')},
            'rest_p99': float(after['rest_p99_us']),
            'commands_late': rig.value('planner: commands', 'late')}


def _sum(count: int) -> float:
    total = 0.0
    for k in range(count):
        total += 1.5 * k
    return total


def _spent(work: Callable[[], object]) -> float:
    """Return the processor time of a call in us."""
    begin = thread_time_ns()
    work()
    return (thread_time_ns() - begin) / 1e3


def _bare(median: float, cycles: int) -> dict[str, float]:
    """Return the figures of a loop that only adds numbers, for about ``median`` us each ms."""
    count = 1000
    per_number = min(_spent(lambda: _sum(count)) for _ in range(100)) / count
    count = round(median / per_number)
    spent, due = [], monotonic_ns()
    for _ in range(cycles):
        due += _PERIOD_NS
        sleep(max(due - monotonic_ns(), 0) / NANOSECONDS)
        spent.append(_spent(lambda: _sum(count)))
    return {'p50': float(np.median(spent)), 'p99': float(np.quantile(spent, 0.99))}


def compare(*, quick: bool) -> Sheet:
    """Measure at rest, moved, and moved with a reader of all topics; each beside a bare loop."""
    cases = {
        'at rest': {'moves': False, 'readers': False},
        'moved twice a second': {'moves': True, 'readers': False},
        'moved, and another process reads all': {'moves': True, 'readers': True}}
    if quick:
        cases = {'moved twice a second': cases['moved twice a second']}
    seconds = 2.0 if quick else _SECONDS
    figures, bare = {}, {}
    for name, case in cases.items():
        with tempfile.TemporaryDirectory() as folder:
            figures[name] = _run(seconds, folder=Path(folder), **case)
        bare[name] = _bare(figures[name]['p50'], round(1e3 * seconds))
    return Sheet(
        'controller', 'One cycle of the controller, 1 joint at 1 kHz: processor time',
        ('', 'cycles/s', 'median', '99 %', 'bare loop, 99 %', 'largest', 'after it, 99 %',
         'cycles late', 'late commands'),
        [[name, f'{x["cycles_per_second"]:.0f}', f'{x["p50"]:.0f} us', f'{x["p99"]:.0f} us',
          f'{bare[name]["p99"]:.0f} us', f'{x["largest"]:.0f} us', f'{x["rest_p99"]:.0f} us',
          f'{100.0 * x["late"]:.2f} %', f'{x["commands_late"]:.0f}']
         for name, x in figures.items()], {'cases': figures, 'bare': bare},
        quick or all(
            x['p99'] < LARGEST + bare[name]['p99'] - bare[name]['p50']
            for name, x in figures.items()))
