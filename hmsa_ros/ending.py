"""
How a process ends when a signal asks it to.

Python answers SIGINT with an exception wherever it happens to be: a traceback while modules are
imported, and nothing at all in a destructor or the callback of a weak reference, which drop it
(each import runs one). It answers SIGTERM and SIGHUP, and every signal while it shuts down, by
dying. So an entry point takes all three over before it imports anything slow, and a process that
has something to put in order only notes them, and looks where it is safe to end.
"""

from collections.abc import Callable
import ctypes
import os
import signal

_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# How long a process may take to end when all is done, in s.
_LAST_SECONDS = 10


class Ending:
    """Whether a signal `asked` this process to end, and the exit `status` that shells expect."""

    def __init__(self) -> None:
        """Leave signals as they are."""
        self.asked = False
        self.status = 128 + signal.SIGINT
        self._respond: Callable[[], object] | None = None

    def leave(self, status: int | None = None) -> None:
        """End the process at once from now on: nothing has been done yet."""
        self._take_over(lambda: os._exit(self.status if status is None else status))

    def interrupt(self) -> None:
        """Raise KeyboardInterrupt from now on, if the signals have been taken over."""
        if self._taken:
            self._take_over(_raise)

    def note(self) -> None:
        """Only note signals from now on; the process calls `check`, or looks at `asked`."""
        self._take_over(None)

    def ignore(self) -> None:
        """Pass over signals from now on: the process is about to end anyway."""
        if self._taken:
            for number in _NUMBERS:
                signal.signal(number, signal.SIG_IGN)

    def finish(self, status: int) -> None:
        """Have the process end with a status, soon, even if a library hangs in its clean-up."""
        _exit_after(_LAST_SECONDS, status)

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


class _Event(ctypes.Structure):
    """``struct sigevent`` of Linux that has a function called in a thread (man 7 sigevent)."""

    _fields_ = (
        ('value', ctypes.c_void_p), ('number', ctypes.c_int), ('notify', ctypes.c_int),
        ('function', ctypes.c_void_p), ('rest', ctypes.c_byte * 40))


def _exit_after(seconds: int, status: int) -> None:
    """
    Call ``_exit`` with a status after some seconds, from a thread that needs no Python.

    Fast DDS 2.14 may never come back from the end of a participant: it waits, without letting
    go, for a thread that has just received the end of another one.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, 'timer_create'):
        return
    in_thread, monotonic = 2, 1
    event = _Event(
        value=status, notify=in_thread, function=ctypes.cast(libc._exit, ctypes.c_void_p).value)
    timer = ctypes.c_void_p()
    if libc.timer_create(monotonic, ctypes.byref(event), ctypes.byref(timer)) == 0:
        # struct itimerspec: interval and time to go, each in seconds and nanoseconds.
        libc.timer_settime(timer, 0, ctypes.byref((ctypes.c_long * 4)(0, 0, seconds, 0)), None)


#: Of this process.
ENDING = Ending()
