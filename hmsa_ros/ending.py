"""
How a process ends when a signal asks it to.

Python answers SIGINT with an exception wherever it happens to be: a traceback while modules are
imported, and nothing at all in a destructor or the callback of a weak reference, which drop it
(each import runs one). It answers SIGTERM and SIGHUP, and every signal while it shuts down, by
dying. So an entry point takes all three over before it imports anything slow, and a process that
has something to put in order only notes them, and looks where it is safe to end.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import gc
import os
import signal
import sys
import threading
from typing import Any

from hmsa_ros import _deadline

_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# How long a process may take to end when all is done, in s.
_LAST_SECONDS = 3
# Deadlines of a process: of a call, and of its own end.
_CALL, _END = 0, 1


class Ending:
    """Whether a signal `asked` this process to end, and the exit `status` that shells expect."""

    def __init__(self) -> None:
        """Leave signals as they are."""
        self.asked = False
        self.status = 128 + signal.SIGINT
        self._respond: Callable[[], object] | None = None

    def leave(self, status: int | None = None, text: str = '') -> None:
        """End the process at once from now on, with a sentence: nothing has been done yet."""
        def respond() -> None:
            if text:
                with suppress(OSError):
                    os.write(sys.stderr.fileno(), encoded(text))
            os._exit(self.status if status is None else status)
        self._take_over(respond)

    def interrupt(self) -> None:
        """Raise KeyboardInterrupt from now on, if the signals have been taken over."""
        if self._taken:
            self._take_over(_raise)
            signal.signal(signal.SIGALRM, lambda *_: _raise())
            sys.unraisablehook = _raise_again

    def note(self) -> None:
        """Only note signals from now on; the process calls `check`, or looks at `asked`."""
        self._take_over(None)

    @contextmanager
    def by_default(self) -> Iterator[None]:
        """Have signals end the process at once meanwhile, even where no Python runs."""
        if not self._taken or threading.current_thread() is not threading.main_thread():
            yield
            return
        before = [(x, signal.signal(x, signal.SIG_DFL)) for x in _NUMBERS
                  if signal.getsignal(x) == self._on_signal]
        try:
            yield
        finally:
            for number, handler in before:
                signal.signal(number, handler)

    def go_on(self) -> None:
        """Pass over Ctrl-Z from now on: nobody would watch what the process has switched on."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTSTP, signal.SIG_IGN)

    def ignore(self) -> None:
        """Pass over signals from now on: the process is about to end anyway."""
        if self._taken:
            for number in _NUMBERS:
                signal.signal(number, signal.SIG_IGN)

    def finish(self, status: int) -> None:
        """
        Have the process end with a status, soon, even if a library hangs in its clean-up.

        Fast DDS 2.14 may never come back from the end of a participant: it waits, without
        letting go, for a thread that has just received the end of another one.
        """
        _deadline.set(_END, _LAST_SECONDS, status)
        if 'rclpy' in sys.modules:
            # What refers to itself, as nodes do, would keep the participant until after Python's
            # end, where Fast DDS takes it away while a thread may still read from it.
            gc.unfreeze()
            gc.collect()

    def check(self) -> None:
        """Raise KeyboardInterrupt if the end has been asked for."""
        if self.asked:
            _raise()

    @property
    def _taken(self) -> bool:
        return signal.getsignal(signal.SIGTERM) == self._on_signal

    def _take_over(self, respond: Callable[[], object] | None) -> None:
        self._respond = respond
        for number in _NUMBERS:
            # A shell has its background jobs ignore SIGINT, nohup SIGHUP. A process that notes
            # signals is one to be ended by them, and SIGINT is the usual one.
            if signal.getsignal(number) is not signal.SIG_IGN or (
                    respond is None and number == signal.SIGINT):
                signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, _: object) -> None:
        self.asked = True
        self.status = 128 + number
        if self._respond is not None:
            self._respond()


def _raise() -> None:
    raise KeyboardInterrupt


def _raise_again(dropped: Any) -> None:
    """Raise an interrupt that Python has dropped a little later; show what else it drops."""
    if issubclass(dropped.exc_type, KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_REAL, 0.001)
    else:
        sys.__unraisablehook__(dropped)


def encoded(text: str) -> bytes:
    """Return a sentence as `Deadline` takes it."""
    return f'hmsa: error: {text}'.encode()[:_deadline.LONGEST - 1] + b'\n'


class Deadline:
    """
    Ends the process with a sentence, even where no Python runs: something took too long.

    There is one in a process. Time in which the process is stopped does not count.
    """

    def say(self, text: bytes) -> None:
        """Say this, as `encoded` makes it, when the time is over."""
        _deadline.say(_CALL, text)

    def set(self, seconds: float) -> None:
        """Say it, and end the process with status 1, after some seconds; 0 for not at all."""
        _deadline.set(_CALL, seconds, 1)


#: Of this process.
ENDING = Ending()
