"""Planning beside the loop that sends commands: in a thread, or at once in simulated time."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import suppress
import sys
from threading import Condition, Thread
from typing import Any, Protocol

from hmsa.planning import Check, proceed

#: Work that calls its argument after each bounded piece.
Work = Callable[[Check], Any]
# Time in s after which the thread lets the loop continue. With Python's 5 ms, commands of a
# sequence of 10,000 points that is being planned are up to 10 ms late (bench_planner, lateness).
_SWITCH = 5e-4


class AbandonedError(Exception):
    """Raised in work whose result is not wanted any more."""


class Job:
    """A piece of work in progress."""

    def __init__(self, work: Work) -> None:
        self.work = work
        self._future: Future[Any] = Future()
        self._abandoned = False

    def abandon(self) -> None:
        """End the work at its next check."""
        self._abandoned = True

    def check(self) -> None:
        """Raise `AbandonedError` if the result is not wanted any more."""
        if self._abandoned:
            raise AbandonedError

    def run(self, check: Check) -> None:
        """Carry out the work; the result is its value or its error."""
        try:
            self._future.set_result(self.work(check))
        except BaseException as error:  # for the loop to handle
            self._future.set_exception(error)

    def done(self, seconds: float = 0.0) -> bool:
        """Wait up to some seconds for the end of the work; return whether it has ended."""
        # Before Python 3.11 it is no TimeoutError.
        with suppress(FutureTimeoutError):
            self._future.exception(seconds)
        return self._future.done()

    def result(self) -> Any:
        """Return the result of work that has ended, or raise its error."""
        return self._future.result(0.0)


class Worker(Protocol):
    """Carries out work."""

    def submit(self, work: Work) -> Job:
        """Begin a piece of work."""


class Inline:
    """Carries out work at once: in simulated time it takes none."""

    def submit(self, work: Work) -> Job:
        """Carry out a piece of work."""
        job = Job(work)
        job.run(proceed)
        return job


class PlanningThread:
    """
    Carries out work in one thread, which starts with the first work.

    Work that is submitted while other work is under way is carried out at the next check of that,
    so that a stop does not wait for a long sequence.
    """

    def __init__(self) -> None:
        self._jobs: deque[Job] = deque()
        self._news = Condition()
        self._started = False

    def submit(self, work: Work) -> Job:
        """Begin a piece of work."""
        job = Job(work)
        with self._news:
            self._jobs.append(job)
            self._news.notify()
        if not self._started:
            self._started = True
            sys.setswitchinterval(_SWITCH)
            Thread(target=self._run, name='planning', daemon=True).start()
        return job

    def _run(self) -> None:
        while True:
            with self._news:
                while not self._jobs:
                    self._news.wait()
            self._carry_out()

    def _carry_out(self) -> None:
        """Carry out the jobs that wait, the newest first."""
        while self._jobs:
            job = self._jobs.pop()

            def check(job: Job = job) -> None:
                job.check()
                self._carry_out()
            job.run(check)
