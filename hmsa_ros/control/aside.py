"""Work that another process does, so that commands do not wait for it."""

from collections.abc import Callable, Generator, Iterator
import os
import select
import signal
import subprocess
import sys
from time import monotonic_ns
from typing import Any, TypeVar

T = TypeVar('T')
#: Yields while an answer is waited for, and returns it.
Awaited = Generator[None, None, T]
#: Does work, whose arguments and result can be pickled, here or in another process.
Doing = Callable[..., Awaited[Any]]

#: How often to look for answers, in ns.
ANSWER = 5_000_000
# Whatever work is made of is imported before the first.
_WORKER = (
    'import sys; sys.path[:] = {!r}; import hmsa_ros.control.feedback; '
    'from hmsa_ros.control.aside import serve; serve({})')
# How long in ns an answer is waited for: the first takes seconds on a busy machine.
_PATIENCE = 20_000_000_000
# By how much it gives way to whoever sends and obeys commands.
_NICE = 5


def here(work: Callable[..., T], *arguments: object) -> Awaited[T]:
    """Do work in this process, at once."""
    yield from ()
    return work(*arguments)


def goes_on(work: Iterator[None]) -> bool:
    """Go on with work; return whether its answer is waited for."""
    return next(work, work) is not work


class Aside:
    """
    Does work in a process of its own, one piece of work after another.

    The process starts with the first work, unless it was started before. Should it end, work is
    done `here` from then on, and `tell` is called with a sentence that says so.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
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
        """Start the process, if it does not run."""
        if self._worker is None and not self._lost:
            try:
                self._worker = _Worker()
            except OSError:
                self._lose()

    def _lose(self) -> None:
        self.close()
        if not self._lost:
            self._tell(
                'the process that estimates beside the planner has ended, does not answer, or '
                'cannot start: the planner estimates itself, and commands may wait for that; see '
                'what ended it (memory?), and start the planner again')
        self._lost = True

    def close(self) -> None:
        """End the process, whatever it does; more work starts another one."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.end()


class _Worker:
    """The process, and what it was asked."""

    def __init__(self) -> None:
        from multiprocessing.connection import Pipe  # slow to load, and seldom of use

        self._line, its = Pipe()
        # It ends with the line, not with the signal that a terminal sends to all.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process = subprocess.Popen(
                [sys.executable, '-c', _WORKER.format(sys.path, its.fileno())],
                stdin=subprocess.DEVNULL, pass_fds=[its.fileno()])
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            its.close()
        # Its own method makes a new one each time, which takes ten times as long.
        self._look = select.poll()
        self._look.register(self._line, select.POLLIN)
        # What takes the answer that it owes; the first one says that it is ready.
        self._owed: list[Any] | None = []

    def result(self, work: object, arguments: object) -> Awaited[Any]:
        """
        Return the result of work, once what was asked for before is done.

        Raises `OSError` or `EOFError` if there is no answer to come, or none for long.
        """
        end = monotonic_ns() + _PATIENCE
        answer: list[Any] = []
        while not answer:
            if self._owes():
                if monotonic_ns() > end:
                    raise TimeoutError
                yield
            elif not answer:
                self._owed = answer
                self._line.send((work, arguments))
        return answer[0]

    def _owes(self) -> bool:
        """Take an answer that has come, whoever waits for it; return whether one is to come."""
        if self._owed is not None and self._look.poll(0):
            self._owed.append(self._line.recv())
            self._owed = None
        return self._owed is not None

    def end(self) -> None:
        """End the process, whatever it does."""
        self._line.close()
        self._process.kill()
        self._process.wait()


def serve(place: int) -> None:
    """Do the work that comes by a line, a file descriptor, and answer, until it is cut."""
    os.nice(_NICE)
    from multiprocessing.connection import Connection

    line, answer = Connection(place), None
    while True:
        try:
            line.send(answer)
            work, arguments = line.recv()
        except (EOFError, OSError):
            return
        # An error ends the process: whoever asked meets it in its own.
        answer = work(*arguments)
