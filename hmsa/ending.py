"""
End of a process on a signal.

Python responds to SIGINT with an exception at an arbitrary point. This prints a traceback while
modules are imported, and is dropped in a destructor or the callback of a weak reference, which
every import runs. SIGTERM and SIGHUP, and all signals during shutdown, end Python immediately. An
entry point therefore installs handlers for all three before it imports slow modules. A process
that needs to clean up only records signals, and checks them where it is safe to end.
"""

import atexit
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import gc
import os
import signal
import sys
import threading
from typing import Any

from hmsa import _deadline

_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Time limit in s for a process to end after its clean-up.
_LAST_SECONDS = 3
# Deadlines of a process: for a call, and for its end.
_CALL, _END = 0, 1


class Ending:
    """Whether a signal `asked` this process to end, and the exit `status` expected by shells."""

    def __init__(self) -> None:
        """Leave the signal handlers unchanged."""
        self.asked = False
        self.status = 128 + signal.SIGINT
        self._last: int | None = None
        self._respond: Callable[[], object] | None = None

    def leave(self, status: int | None = None, text: str = '') -> None:
        """End the process immediately on a signal from now on, without clean-up but a message."""
        def respond() -> None:
            if text:
                with suppress(OSError):
                    os.write(sys.stderr.fileno(), encoded(text))
            os._exit(self.status if status is None else status)
        self._take_over(respond)

    def interrupt(self) -> None:
        """Raise KeyboardInterrupt on a signal from now on, if the handlers are installed."""
        if self._taken:
            self._take_over(_raise)
            signal.signal(signal.SIGALRM, lambda *_: _raise())
            sys.unraisablehook = _raise_again

    def note(self) -> None:
        """Only record signals from now on; the process calls `check`, or reads `asked`."""
        self._take_over(None)

    @contextmanager
    def by_default(self) -> Iterator[None]:
        """Let signals end the process immediately meanwhile, even if Python is blocked."""
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
        """Ignore Ctrl-Z from now on, since a stopped process cannot monitor its hardware."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTSTP, signal.SIG_IGN)

    def ignore(self) -> None:
        """Ignore signals from now on, since the process is about to end."""
        if self._taken:
            for number in _NUMBERS:
                signal.signal(number, signal.SIG_IGN)

    def finish(self, status: int) -> None:
        """
        End the process with a status as soon as Python ends, even if a library blocks before.

        Fast DDS 2.14 may never return from the deletion of a participant: it waits, while holding
        a lock, for a thread that has just received the end of another participant.
        """
        _deadline.set(_END, _LAST_SECONDS, status)
        if 'rclpy' in sys.modules:
            # Reference cycles, as of nodes, would keep the participant until after the end of
            # Python, where Fast DDS deletes it while a thread may still read from it.
            gc.unfreeze()
            gc.collect()
        self._last = status

    def quit(self) -> None:
        """
        End the process now if it is finished; called where Python ends.

        Python would take longer to take all modules apart than a short command takes in all.
        """
        if self._last is not None:
            for stream in filter(None, (sys.stdout, sys.stderr)):
                with suppress(OSError, ValueError):  # nobody reads it any more
                    stream.flush()
            if 'rclpy' in sys.modules:
                # Libraries buffer lines of their own.
                import ctypes
                ctypes.CDLL(None).fflush(None)
            os._exit(self._last)

    def check(self) -> None:
        """Raise KeyboardInterrupt if the end was requested."""
        if self.asked:
            _raise()

    @property
    def _taken(self) -> bool:
        return signal.getsignal(signal.SIGTERM) == self._on_signal

    def _take_over(self, respond: Callable[[], object] | None) -> None:
        self._respond = respond
        for number in _NUMBERS:
            # Background jobs of a shell ignore SIGINT, and jobs of nohup ignore SIGHUP. A process
            # that records signals must still respond to SIGINT, the usual one.
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
    """Raise an interrupt dropped by Python again after a moment; show other dropped errors."""
    if issubclass(dropped.exc_type, KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_REAL, 0.001)
    else:
        sys.__unraisablehook__(dropped)


def encoded(text: str) -> bytes:
    """Return a message in the form required by `Deadline`."""
    return f'hmsa: error: {text}'.encode()[:_deadline.LONGEST - 1] + b'\n'


class Deadline:
    """
    Ends the process with a message after a time, even if Python is blocked.

    There is one for each process. Time while the process is stopped does not count.
    """

    def set_text(self, text: bytes) -> None:
        """Set the message, in the form of `encoded`, to print at the deadline."""
        _deadline.say(_CALL, text)

    def set(self, seconds: float) -> None:
        """End the process with the message and status 1 after some seconds; 0 cancels that."""
        _deadline.set(_CALL, seconds, 1)


#: The ending of this process.
ENDING = Ending()
# First, and so called last of all.
atexit.register(ENDING.quit)
