"""
Measure the rate of studies on processes and on a cluster.

    python -m benchmarks rates [--minutes M] [--quick]
    python -m benchmarks lockstep [--quick]

The rates are those of the batch kernel alone on one core, and of studies on two processes and on a
Dask cluster of two. Lock-step compares that kernel with itself, one move at a time, and with the
same method in C, on one core.
"""

from contextlib import contextmanager, nullcontext
from functools import partial
import math
import os
from pathlib import Path
import tempfile
from time import perf_counter, process_time

import numpy as np

from benchmarks.sheet import Sheet
from hmsa import motion
from hmsa.model.law import pack
from hmsa.planning.two_step import Groups, HOLD_TOLERANCE, plan_two_step_batch, RTOL
from hmsa_studies.schedulers import cluster, in_order, local_processes
from hmsa_studies.study_folder import LEAST_ROWS, StudyFolder
from hmsa_studies.sweep import parse_grid, Sweep

WORKERS = 2
PROCESSES = partial(local_processes, WORKERS)


def grid(points):
    """Return a sweep over a number of points, in steps of 1000."""
    return Sweep({
        'zeta': parse_grid('0:1.5:1000', 'zeta'),
        'j_lim': parse_grid(f'4:9:{points // 1000}', 'j_lim')})


def rates(*, quick, minutes=math.inf):
    """Compare plans per second: the kernel alone on all cores, processes, a Dask cluster."""
    with cluster('local', WORKERS):
        # Fail now, not after minutes, if it is not installed.
        pass
    size = 20_000 if quick else 2_000_000
    found = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found['kernel'] = _together(size)
        # Points for about five minutes, at most 1e8; everything but the processes takes 100 s.
        seconds = min(280.0, max(60.0 * minutes - 100.0, 1.0))
        points = 400_000 if quick else min(100_000, int(found['kernel'] * seconds / 1000.0)) * 1000
        for words, start, rows in (
                ('processes', PROCESSES, points),
                ('on a cluster', partial(cluster, 'local', WORKERS), min(points, 20_000_000))):
            with _running(start) as again:
                # Each worker starts up first.
                StudyFolder(grid(8 * LEAST_ROWS), folder / f'{words} first').compute(again)
                begin, before = perf_counter(), _spent()
                StudyFolder(grid(rows), folder / words).compute(again)
                taken = perf_counter() - begin
            label = f'{rows:,} by {WORKERS} {words}'
            found[label] = rows / taken
            print(f'{label}: {taken:.0f} s, the parent {_spent() - before:.1f} s of a core')
            # Other guests of the host make cores slower and faster within minutes.
            found['kernel'] = max(found['kernel'], _together(size))
    load = os.getloadavg()[0]
    return Sheet(
        'rates', f'Plans a second by {WORKERS} processes on {os.cpu_count()} cores; load average '
        f'{load:.1f} at the end',
        ['by', 'plans/s', 'of the kernel'],
        [[x, f'{y:,.0f}', f'{y / found["kernel"]:.0%}'] for x, y in found.items()],
        {'rates': found, 'load_average': load})


@contextmanager
def _running(start):
    """Start workers for several studies; yield a function that returns them."""
    with start() as compute:
        yield lambda: nullcontext(compute)


def _together(size):
    """Return the plans per second of the kernel in as many processes at once."""
    with _running(PROCESSES) as again:
        list(in_order(again, _alone, [(1000,)] * WORKERS))
        return sum(in_order(again, _alone, [(size,)] * WORKERS))


def _alone(size):
    """Return the plans per second of the kernel on one core."""
    zeta, j_lim = (np.resize(parse_grid(x, x), size) for x in ('0:1.5:1000', '4:9:997'))
    begin = perf_counter()
    plan_two_step_batch(1.0, 1.1, Groups(zeta=zeta, j_lim=j_lim), workers=1)
    return size / (perf_counter() - begin)


def _spent():
    """Return the processor time of this process, in s."""
    times = os.times()
    return times.user + times.system


def lockstep(*, quick):
    """Compare moves in lock-step with one at a time, by processor time."""
    size = 1000
    zeta, j_lim = (np.resize(parse_grid(x, x), size) for x in ('0:1.5:1000', '4:9:997'))
    repeats = 1 if quick else 20
    entries = {
        'one move after the other': _one_by_one(zeta, j_lim, repeats),
        '2 moves in lock-step, baseline': _batch(zeta, j_lim, repeats, wide=False),
        '4 moves in lock-step, AVX2': _batch(zeta, j_lim, repeats, wide=True)}
    times = dict.fromkeys(entries, float('inf'))
    loads = {}
    for _ in range(1 if quick else 10):
        for words, run in entries.items():
            spent, loads[words] = run()
            times[words] = min(times[words], spent)
    first = next(iter(times))
    apart = {x: float(np.max(np.abs(y / loads[first] - 1.0))) for x, y in loads.items()}
    return Sheet(
        'lockstep', f'Plans from 1 to 1.1 on one core; load average {os.getloadavg()[0]:.1f}',
        ['by', 'time per plan', 'plans/s', 'ratio', 'beta_p differs by'],
        [[x, f'{1e6 * y:.2f} us', f'{1.0 / y:,.0f}', f'{y / times[first]:.3f}',
          f'{apart[x]:.0e}' if apart[x] else '-'] for x, y in times.items()],
        {'times': times, 'apart': apart})


def _one_by_one(zeta, j_lim, repeats):
    """Return a function that times the search for one move at a time, as `_batch` does."""
    materials = pack(zeta, j_lim, np.full(zeta.size, 2.0))

    def run():
        begin = process_time()
        for _ in range(repeats):
            found = [motion.two_step(1.0, 0.0, 1.1, x, -np.inf, np.inf, RTOL, HOLD_TOLERANCE)[1]
                     for x in materials]
        return (process_time() - begin) / repeats / zeta.size, np.array(found)

    return run


def _batch(zeta, j_lim, repeats, *, wide):
    """Return a function that times a batch: core seconds per plan, and beta_p."""
    rows = np.ones(zeta.size), np.zeros(zeta.size), np.full(zeta.size, 1.1)
    material = pack(zeta, j_lim, np.full(zeta.size, 2.0))
    results = np.empty((3, zeta.size))

    def run():
        begin = process_time()
        for _ in range(repeats):
            motion.two_step_batch(
                *rows, material, material.shape[1], -np.inf, np.inf, RTOL, HOLD_TOLERANCE, wide,
                np.empty(zeta.size, np.int64), *results)
        return (process_time() - begin) / repeats / zeta.size, results[0].copy()

    run()
    return run
