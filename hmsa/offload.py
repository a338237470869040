"""Execute work in other processes, so that commands do not wait for it."""

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
# Interval in ns at which waiting work looks whether a process is free.
_LOOK = 500_000
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


def at_once(doing: Doing) -> int:
    """Return how many pieces of work are executed at a time."""
    return doing.count if isinstance(doing, Offload) else 1


def start(doing: Doing) -> None:
    """Start the processes that execute work, if there are to be any."""
    if isinstance(doing, Offload):
        doing.start()


def is_ready(doing: Doing) -> bool:
    """Return whether work begins at once: no process for it is still starting."""
    return not isinstance(doing, Offload) or doing.ready


class Offload:
    """
    Execute work in separate processes, each one piece after another.

    They start with the first work, or by `start`. If one ends, work is executed `here` from then
    on, and ``report`` is called with a message. They import ``module`` before the first work.
    Their number is at most ``count``, and one for each core.
    """

    def __init__(self, report: Callable[[str], None], module: str, count: int = 1) -> None:
        self._report, self._module = report, module
        self.count = max(min(count, len(os.sched_getaffinity(0))), 1)
        self._workers: list[_Process] = []
        self._next_look = 0  # time from which to look again whether a process is free
        self._lost = False

    def __call__(self, work: Callable[..., T], *arguments: object) -> Awaited[T]:
        """Return the result of work."""
        self.start()
        begun = monotonic_ns()
        try:
            while self._workers:
                now = monotonic_ns()
                # Looking takes a system call for each process, and much work may wait.
                if now >= self._next_look:
                    free = next((x for x in self._workers if not x.owes()), None)
                    if free is not None:
                        result: T = yield from free.result(work, arguments)
                        return result
                    self._next_look = now + _LOOK
                if now - begun > max(x.patience for x in self._workers):
                    raise TimeoutError
                yield
        except (OSError, EOFError):
            self._lose()
        return work(*arguments)

    @property
    def ready(self) -> bool:
        """Whether no process is still starting."""
        try:
            return not any(x.starting for x in self._workers)
        except (OSError, EOFError):
            self._lose()
        return True

    def start(self) -> None:
        """Start the processes if they are not running."""
        try:
            while len(self._workers) < self.count and not self._lost:
                self._workers.append(_Process(self._module))
        except OSError:
            self._lose()

    def _lose(self) -> None:
        self.close()
        if not self._lost:
            self._report(
                'a process that estimates beside the planner has ended, does not answer, or '
                'cannot start: the planner estimates itself, and commands may wait for that; see '
                'what ended it (memory?), and start the planner again')
        self._lost = True

    def close(self) -> None:
        """End the processes immediately; further work starts others."""
        workers, self._workers = self._workers, []
        for worker in workers:
            worker.end()


class _Process:
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
        self._ready = False
        self._begun = monotonic_ns()

    @property
    def starting(self) -> bool:
        """Whether it cannot execute work yet; raise `OSError` or `EOFError` if it never can."""
        self.owes()
        if not self._ready and monotonic_ns() - self._begun > _START:
            raise TimeoutError
        return not self._ready

    @property
    def patience(self) -> int:
        """Longest wait in ns for the pending result."""
        return _PATIENCE if self._ready else _START

    def result(self, work: object, arguments: object) -> Awaited[Any]:
        """
        Return the result of work, while no other is pending.

        Raises `OSError` or `EOFError` if no result will come, or none came in time.
        """
        begun = monotonic_ns()
        answer: list[Any] = []
        self._owed = answer
        self._line.send((work, arguments))
        while not answer:
            if self.owes():
                if monotonic_ns() - begun > self.patience:
                    raise TimeoutError
                yield
        return answer[0]

    def owes(self) -> bool:
        """Receive a pending result if there is one; return whether one is still pending."""
        if self._owed is not None and self._look.poll(0):
            self._owed.append(self._line.recv())
            self._owed, self._ready = None, True
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
