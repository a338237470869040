"""Where Dask computes: in this process, in local processes, or on a cluster."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager, ExitStack
from functools import partial
from importlib.util import find_spec
import logging
import multiprocessing
from multiprocessing.connection import wait
import os
from pathlib import Path
import signal
import threading
from typing import Any, TypeVar

from hmsa.errors import BadInputError, check_number, HmsaError
from hmsa.planning.two_step import available_cores

Result = TypeVar('Result')
#: Computes delayed functions, calls a function with the key of each that is done, and returns the
#: results in order.
Compute = Callable[[Sequence[Any], Callable[[str], object]], Sequence[Any]]
#: Starts the workers, which end with the context.
Start = Callable[[], AbstractContextManager[Compute]]

#: Seconds that a Dask scheduler has for its first answer.
PATIENCE = 15
# A cluster on this machine shares its cores with the plans. By default Dask monitors itself a
# hundred times a second, and its workers return each freed page.
_QUIET = {
    'distributed.worker.profile.enabled': False,
    'distributed.admin.tick.interval': '1s',
    'distributed.admin.system-monitor.interval': '10s',
    'distributed.worker.memory.monitor-interval': '1s',
    'distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_': 1 << 30,
    'distributed.worker.preload': [__name__],
}
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def require_dask() -> None:
    """Raise `BadInputError` if Dask is not installed."""
    # It is imported while workers start.
    if find_spec('dask') is None:
        raise BadInputError(
            'dask, which computes studies in chunks, is not installed: install it (pip install '
            'dask), or leave out --workers, --shard, --dask and --resume and write to a file '
            'that ends in .csv')


@contextmanager
def here() -> Iterator[Compute]:
    """Yield a function that computes in this process."""
    from dask.local import get_sync

    yield partial(_locally, get_sync)


@contextmanager
def local_processes(workers: int) -> Iterator[Compute]:
    """Yield a function that computes in new processes; end all of them on exit."""
    pool = ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context('spawn'), initializer=_end_with_parent)
    try:
        with _without_signals():
            for _ in range(workers):
                pool.submit(int)
        from dask.multiprocessing import get

        # Chunks are long: Dask need not send several at once.
        yield partial(_locally, get, pool=pool, chunksize=1)
    finally:
        for process in list((pool._processes or {}).values()):
            process.kill()
        pool.shutdown(cancel_futures=True)


def local(workers: int) -> Start:
    """
    Return a function that starts several processes, or uses this one for 1.

    Raises
    ------
    BadInputError
        If the number is below 1.

    """
    check_number('--workers', workers, least=1)
    return here if workers == 1 else partial(local_processes, workers)


@contextmanager
def cluster(address: str, workers: int | None) -> Iterator[Compute]:
    """Yield a function that computes on a Dask cluster, or raise `BadInputError`."""
    # An address is that of a scheduler, its file, or 'local' for a cluster on this machine.
    try:
        from dask import config
        from distributed import as_completed, Client, LocalCluster
    except ImportError as error:
        raise BadInputError(
            'dask.distributed is not installed: install it (pip install distributed) or '
            'take --workers or --shard') from error
    with ExitStack() as stack:
        if address == 'local':
            # For the lifetime of the cluster, which may start workers again.
            stack.enter_context(config.set(_QUIET))
            with _without_signals():
                target = stack.enter_context(LocalCluster(
                    n_workers=workers or available_cores(), threads_per_worker=1,
                    dashboard_address=None, silence_logs=logging.CRITICAL))
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

        def compute(tasks: Sequence[Any], done: Callable[[str], object]) -> Sequence[Any]:
            futures = client.compute(tasks)
            for future in as_completed(futures):
                future.result()
                done(future.key)
            return list(client.gather(futures))

        yield compute


def dask_setup(_: Any) -> None:
    """Ignore Ctrl-C in a worker of a local cluster, which its parent ends; called by Dask."""
    # Ctrl-C on a terminal would print two tracebacks for each worker.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def in_order(
        start: Start, function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]],
        advance: Callable[[int], object] = lambda _: None) -> Iterator[Result]:
    """
    Yield the results of a function for many arguments in order, or raise `HmsaError`.

    In this process, each as it is computed; by workers, when all are.
    """
    if start is here:
        for task in tasks:
            yield function(*task)
            advance(1)
        return
    require_dask()
    try:
        with start() as compute:
            from dask import delayed

            # Dask would look for its own objects in the arguments, and make records anew.
            found = compute(
                [delayed(partial(function, *x), pure=False)() for x in tasks],
                lambda _: advance(1))
    except BrokenExecutor as error:
        raise HmsaError(
            'a worker died: expected enough memory for all of them; take fewer (--workers)'
        ) from error
    yield from found


def _locally(
        scheduler: Callable[..., Any], tasks: Sequence[Any], done: Callable[[str], object],
        **settings: Any) -> Sequence[Any]:
    """Compute delayed functions with one of Dask's schedulers of a single machine."""
    import dask
    from dask.callbacks import Callback

    try:
        with Callback(posttask=lambda key, *_: done(key)):
            # A scheduler given by its name would import distributed, which takes 0.8 s.
            found: Sequence[Any] = dask.compute(*tasks, scheduler=scheduler, **settings)
    except Exception as error:
        # Without tblib, Dask adds the worker's traceback to the text of an error.
        raise getattr(error, 'exception', error) from None
    return found


@contextmanager
def _without_signals() -> Iterator[None]:
    """Delay signals; processes started during this time never get them."""
    # Ctrl-C reaches all processes of a terminal; their parent ends them. A partially started pool
    # could not be shut down.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent() -> None:
    """End this worker when its parent process is gone, even by kill -9."""
    parent = multiprocessing.parent_process()
    if parent is None:
        raise HmsaError('not a worker: expected a process started by another')

    def watch(sentinel: int) -> None:
        wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, args=(parent.sentinel,), daemon=True).start()
