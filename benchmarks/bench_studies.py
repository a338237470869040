"""
What studies lose when workers are killed, and what a cluster leaves of the kernel's rate.

    python -m benchmarks studies [--quick]

A study runs on two processes. Twenty times, once some chunks are done, one of its workers is
killed with SIGKILL; the table is compared with that of a run that nobody disturbs. Then the same
plans are made by the batch kernel alone on one core, and by a Dask cluster of two processes.
"""

from contextlib import suppress
import multiprocessing
import os
from pathlib import Path
import random
import signal
import tempfile
import threading
from time import perf_counter, sleep

import numba
import numpy as np

from benchmarks.sheet import Sheet
from hmsa_ros.core.two_step import plan_two_step_batch
from hmsa_ros.studies.chunks import Chunks
from hmsa_ros.studies.engine import compute
from hmsa_ros.studies.executors import dask, local_processes
from hmsa_ros.studies.sweep import parse_grid, Sweep

WORKERS = 2
# Chunks that are done between two kills, at most.
_BETWEEN = 6


class Watched:
    """A sweep that leaves a file for each chunk that is begun."""

    def __init__(self, sweep, log):
        self._sweep, self._log = sweep, log
        self.size, self.digest = sweep.size, sweep.digest

    def table(self, begin, end):
        """Compute a chunk."""
        (self._log / f'{begin}-{os.getpid()}').touch()
        return self._sweep.table(begin, end)


def grid(points):
    """Return a sweep of so many points, in steps of 1000."""
    return Sweep({
        'zeta': parse_grid('0:2:1000', 'zeta'), 'j_lim': parse_grid(f'4:9:{points // 1000}', 'j')})


class Killer(threading.Thread):
    """Kills a worker at random, so many times, each once some chunks are done after the last."""

    def __init__(self, kills, chunks):
        super().__init__(daemon=True)
        self._left, self._chunks = kills, chunks
        self.killed = 0

    def run(self):
        """Kill until enough are killed."""
        dice = random.Random(1)
        while self._left:
            aim = len(self._chunks.found()) + dice.randint(1, _BETWEEN)
            while len(self._chunks.found()) < aim:
                sleep(0.02)
            sleep(dice.uniform(0.0, 0.3))
            with suppress(IndexError, ProcessLookupError):
                os.kill(dice.choice(multiprocessing.active_children()).pid, signal.SIGKILL)
                self.killed += 1
                self._left -= 1


def compare(*, quick):
    """Kill workers at random; passed if nothing of the table is lost."""
    kills = 2 if quick else 20
    # More chunks than the kills can wait for.
    sweep = grid(20_000 * (kills + 1) * _BETWEEN)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tables = []
        for words in ('quiet', 'killed'):
            log = folder / f'{words} log'
            log.mkdir()
            study = Watched(sweep, log)
            chunks = Chunks.of(study, folder / words)
            killer = Killer(kills if words == 'killed' else 0, chunks)
            killer.start()
            begin = perf_counter()
            compute(study, folder / words, lambda: local_processes(WORKERS), say=lambda _: None)
            spent = perf_counter() - begin
            chunks.merge(folder / f'{words}.parquet')
            tables.append((folder / f'{words}.parquet').read_bytes())
            again = len(list(log.iterdir())) - chunks.count
    same = tables[0] == tables[1]
    return Sheet(
        'studies', f'A study on {WORKERS} processes whose workers are killed',
        ['kills', 'chunks', 'begun again', 'at most', 'table', 'time'],
        [[str(killer.killed), str(chunks.count), str(again), str(WORKERS * killer.killed),
          'the same to the byte' if same else 'another', f'{spent:.0f} s']],
        {'kills': killer.killed, 'chunks': chunks.count, 'begun_again': again, 'same': same},
        same and killer.killed == kills and again <= WORKERS * kills)


def cluster(*, quick):
    """Compare a Dask cluster with the kernel alone."""
    sweep = grid(200_000 if quick else 10_000_000)
    numba.set_num_threads(1)
    size = 200_000
    zeta, j_lim = (np.resize(parse_grid(x, x), size) for x in ('0:2:1000', '4:9:997'))
    plan_two_step_batch(1.0, 1.1, zeta=zeta[:10], j_lim=j_lim[:10])

    def kernel():
        begin = perf_counter()
        plan_two_step_batch(1.0, 1.1, zeta=zeta, j_lim=j_lim)
        return size / (perf_counter() - begin)

    rates = [kernel()]
    with tempfile.TemporaryDirectory() as name, dask('local', WORKERS) as (executor, _):
        # Each worker loads the kernels.
        compute(grid(160_000), Path(name) / 'first', executor)
        begin = perf_counter()
        compute(sweep, Path(name) / 'study', executor)
        found = sweep.size / (perf_counter() - begin)
    rates.append(kernel())
    load = os.getloadavg()[0]
    rate = max(rates)
    return Sheet(
        'cluster', f'Plans a second on a Dask cluster of {WORKERS} processes on this machine',
        ['kernel, one core', 'cluster', 'share', 'load average'],
        [[f'{rate:,.0f}', f'{found:,.0f}', f'{found / WORKERS / rate:.0%}', f'{load:.1f}']],
        {'kernel': rates, 'cluster': found, 'load_average': load})
