"""
Entry points of all processes: signals are taken over before anything slow is imported.

What is imported here is there as soon as Python has started. While that starts it answers a
signal itself, with a traceback of its module ``site`` at worst: only who starts it with signals
blocked could prevent that.
"""

# Beneath `signal`, which imports more than all of this.
import _signal  # type: ignore[import-not-found]
from collections.abc import Callable
import os
import sys


def main(argv: list[str] | None = None) -> int:
    """Run the ``hmsa`` command; return its exit status."""
    _take_over()
    # The matrices here are small: threads of a linear algebra library wait longer for each other
    # than they compute, and a node would wait for them.
    os.environ.setdefault('OMP_NUM_THREADS', '1')
    from hmsa_ros.ending import ENDING
    ENDING.leave()
    from hmsa_ros.cli import main as command
    try:
        status = command(argv)
    finally:
        # Python's own end takes a while, in which it would answer signals by dying.
        ENDING.ignore()
    ENDING.finish(status)
    return status


def _take_over() -> None:
    """End the process at once on a signal, until `Ending` is there to answer it."""
    for number in (_signal.SIGINT, _signal.SIGTERM, _signal.SIGHUP):
        if _signal.getsignal(number) != _signal.SIG_IGN:
            _signal.signal(number, lambda number, _: os._exit(128 + number))


def _node(name: str) -> Callable[[], int]:
    """Return what runs ``hmsa NAME`` as a program of its own."""
    return lambda: main([name, *sys.argv[1:]])


planner = _node('planner')
plant = _node('plant')
driver = _node('driver')
recorder = _node('recorder')
controller = _node('controller')
player = _node('player')
sense = _node('sense')
