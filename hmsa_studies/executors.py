"""Executors for the chunks of a study: this process, local processes, or a Dask cluster."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager, ExitStack
from functools import partial
import logging
import multiprocessing
from multiprocessing.connection import wait
import os
from pathlib import Path
import signal
import threading
from typing import Any, TypeVar

from hmsa.errors import BadInputError, HmsaError

Result = TypeVar('Result')
#: Creates an executor; also returns the number of tasks to submit ahead.
Start = Callable[[], AbstractContextManager[tuple[Executor, int]]]

#: Seconds that a Dask scheduler has for its first answer.
PATIENCE = 15
#: Chunks waiting at a Dask cluster: they are small there, and it scales with the queue.
AHEAD = 1000
# A cluster on this machine shares its cores with the plans. By default Dask monitors itself a
# hundred times a second, and its workers return each freed page.
_QUIET = {
    'distributed.worker.profile.enabled': False,
    'distributed.admin.tick.interval': '1s',
    'distributed.admin.system-monitor.interval': '10s',
    'distributed.worker.memory.monitor-interval': '1s',
    'distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_': 1 << 30,
}


class Here(Executor):
    """Executor that computes in this process on submission."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> 'Future[Any]':
        """Call the function."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def here() -> Iterator[tuple[Executor, int]]:
    """Yield an executor of this process, and the number of chunks to submit ahead."""
    yield Here(), 1


@contextmanager
def local_processes(workers: int) -> Iterator[tuple[Executor, int]]:
    """Yield a pool of new processes, and the number of chunks to submit ahead; end all on exit."""
    pool = ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context('spawn'), initializer=_end_with_parent)
    try:
        yield pool, 4 * workers
        pool.shutdown()
    finally:
        for process in list((pool._processes or {}).values()):
            process.kill()
        pool.shutdown(cancel_futures=True)


def local(workers: int) -> Start:
    """
    Return a function that creates an executor with several processes, or with this one for 1.

    Raises
    ------
    BadInputError
        If the number is below 1.

    """
    if workers < 1:
        raise BadInputError(f'--workers is {workers}: expected at least 1')
    return here if workers == 1 else partial(local_processes, workers)


@contextmanager
def dask(address: str, workers: int | None = None) -> Iterator[tuple[Executor, int]]:
    """Yield an executor of a Dask cluster as `here` does, or raise `BadInputError`."""
    # An address is that of a scheduler, its file, or 'local' for a cluster on this machine.
    try:
        from dask import config
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise BadInputError(
            'dask.distributed is not installed: install it (pip install distributed) or '
            'take --workers or --shard') from error
    with ExitStack() as stack:
        if address == 'local':
            # For the lifetime of the cluster, which may start workers again.
            stack.enter_context(config.set(_QUIET))
            with held_signals():
                target = stack.enter_context(LocalCluster(
                    n_workers=workers or cores(), threads_per_worker=1, dashboard_address=None,
                    silence_logs=logging.CRITICAL))
        else:
            target = None if address.endswith('.json') else address
        try:
            if target is None:
                # Dask would wait forever for a missing file.
                Path(address).read_bytes()
            client = stack.enter_context(Client(
                target, timeout=PATIENCE, scheduler_file=address if target is None else None))
        except (OSError, ValueError, TypeError) as error:
            raise BadInputError(
                f'no Dask scheduler answers at {address!r} ({type(error).__name__}): expected '
                'local, an address as in tcp://node:8786, or a scheduler file that ends in '
                '.json') from error
        yield client.get_executor(), AHEAD


@contextmanager
def given(executor: Executor) -> Iterator[tuple[Executor, int]]:
    """Yield an executor of the caller, and the number of chunks to submit ahead."""
    yield executor, AHEAD


def in_order(
        start: Start, function: Callable[..., Result],
        tasks: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
    """Yield the results of a function for many arguments in order, or raise `HmsaError`."""
    running: deque[Future[Result]] = deque()
    try:
        with start() as (executor, ahead):
            for task in tasks:
                with held_signals():
                    running.append(executor.submit(function, *task))
                if len(running) >= ahead:
                    yield running.popleft().result()
            while running:
                yield running.popleft().result()
    except BrokenExecutor as error:
        raise HmsaError(
            'a worker died: expected enough memory for all of them; take fewer (--workers)'
        ) from error


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def held_signals() -> Iterator[None]:
    """Delay signals; processes started during this time never get SIGINT."""
    # Ctrl-C reaches all processes of a terminal; their parent ends them.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    # A partially started pool cannot be shut down. The mask only applies to this thread: Python
    # handles the signals of others in this one.
    noted: list[int] = []
    handlers = {
        x: handler for x in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        if (handler := signal.getsignal(x)) is not None
    } if threading.current_thread() is threading.main_thread() else {}
    for number in handlers:
        signal.signal(number, lambda x, _: noted.append(x))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for x in noted[:1]:
            signal.raise_signal(x)


def _end_with_parent() -> None:
    """End this worker when its parent process is gone, even by kill -9."""
    parent = multiprocessing.parent_process()
    if parent is None:
        raise HmsaError('not a worker: expected a process started by another')

    def watch(sentinel: int) -> None:
        wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, args=(parent.sentinel,), daemon=True).start()
