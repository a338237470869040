"""Execute work in another process, so that commands do not wait for it."""

from collections.abc import Callable, Generator, Iterator
import os
import select
import signal
import subprocess
import sys
from time import monotonic_ns, sleep
from typing import Any, TypeVar

T = TypeVar('T')
#: Yields while waiting for a result, and returns it.
Awaited = Generator[None, None, T]
#: Executes work, with picklable arguments and result, here or in another process.
Doing = Callable[..., Awaited[Any]]

#: Interval in ns at which results are polled.
ANSWER = 5_000_000
# The module that the work uses is imported before the first work.
_WORKER = (
    'import sys; sys.path[:] = {!r}; import {}; '
    'from hmsa.offload import serve; serve({})')
# Longest wait in ns for the process to start, which on a busy machine takes many times as long as
# on an idle one, and for a result.
_START, _PATIENCE = 60_000_000_000, 20_000_000_000
# Niceness, relative to the processes that send and apply commands.
_NICE = 5


def here(work: Callable[..., T], *arguments: object) -> Awaited[T]:
    """Execute work in this process, immediately."""
    yield from ()
    return work(*arguments)


def finish(work: Awaited[T]) -> T:
    """Wait for the result of work."""
    while True:
        try:
            next(work)
            # Without a pause, it takes the core that the other process needs.
            sleep(ANSWER / 1e9)
        except StopIteration as end:
            result: T = end.value
            return result


def goes_on(work: Iterator[None]) -> bool:
    """Continue work; return whether its result is still pending."""
    return next(work, work) is not work


class Offload:
    """
    Execute work in a separate process, one piece after another.

    The process starts with the first work, or by `start`. If it ends, work is executed `here` from
    then on, and ``report`` is called with a message. It imports ``module`` before the first work.
    """

    def __init__(self, report: Callable[[str], None], module: str) -> None:
        self._report, self._module = report, module
        self._worker: _Worker | None = None
        self._lost = False

    def __call__(self, work: Callable[..., T], *arguments: object) -> Awaited[T]:
        """Return the result of work."""
        self.start()
        if self._worker is not None:
            try:
                result: T = yield from self._worker.result(work, arguments)
                return result
            except (OSError, EOFError):
                self._lose()
        return work(*arguments)

    def start(self) -> None:
        """Start the process if it is not running."""
        if self._worker is None and not self._lost:
            try:
                self._worker = _Worker(self._module)
            except OSError:
                self._lose()

    def _lose(self) -> None:
        self.close()
        if not self._lost:
            self._report(
                'the process that estimates beside the planner has ended, does not answer, or '
                'cannot start: the planner estimates itself, and commands may wait for that; see '
                'what ended it (memory?), and start the planner again')
        self._lost = True

    def close(self) -> None:
        """End the process immediately; further work starts another one."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end()


class _Worker:
    """The process and its pending work."""

    def __init__(self, module: str) -> None:
        from multiprocessing.connection import Pipe  # slow to import and rarely needed

        self._line, its = Pipe()
        # The worker ends with the pipe, not with the signal that a terminal sends to all
        # processes.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process = subprocess.Popen(
                [sys.executable, '-c', _WORKER.format(sys.path, module, its.fileno())],
                stdin=subprocess.DEVNULL, pass_fds=[its.fileno()])
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            its.close()
        # Connection.poll creates a new selector for each call, which takes ten times as long.
        self._look = select.poll()
        self._look.register(self._line, select.POLLIN)
        # List that receives the pending result; the first result signals that the worker is ready.
        self._owed: list[Any] | None = []
        self._patience = _START

    def result(self, work: object, arguments: object) -> Awaited[Any]:
        """
        Return the result of work, after the results of earlier work.

        Raises `OSError` or `EOFError` if no result will come, or none came in time.
        """
        begun = monotonic_ns()
        answer: list[Any] = []
        while not answer:
            if self._owes():
                if monotonic_ns() - begun > self._patience:
                    raise TimeoutError
                yield
            elif not answer:
                self._owed, begun = answer, monotonic_ns()
                self._line.send((work, arguments))
        return answer[0]

    def _owes(self) -> bool:
        """Receive a pending result if there is one; return whether one is still pending."""
        if self._owed is not None and self._look.poll(0):
            self._owed.append(self._line.recv())
            self._owed, self._patience = None, _PATIENCE
        return self._owed is not None

    def end(self) -> None:
        """End the process immediately."""
        self._line.close()
        self._process.kill()
        self._process.wait()


def serve(place: int) -> None:
    """Execute the work that arrives at a file descriptor until its other end closes."""
    os.nice(_NICE)
    from multiprocessing.connection import Connection

    line, answer = Connection(place), None
    while True:
        try:
            line.send(answer)
            work, arguments = line.recv()
        except (EOFError, OSError):
            return
        # An error ends the process: the caller then executes the work itself and gets the error.
        answer = work(*arguments)
