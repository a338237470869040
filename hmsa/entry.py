"""
Entry point of all processes, which installs signal handlers before slow imports.

The modules imported here are loaded when Python starts. Until then, Python handles a signal
itself, at worst with a traceback of its module ``site``; only a parent that starts it with signals
blocked could prevent that.
"""

# The basis of `signal`, which imports more than all of this.
import _signal  # type: ignore[import-not-found]
import os


def main(argv: list[str] | None = None) -> int:
    """Run the ``hmsa`` command; return its exit status."""
    _take_over()
    # The matrices here are small: threads of a linear algebra library would wait longer for each
    # other than they compute.
    os.environ.setdefault('OMP_NUM_THREADS', '1')
    from hmsa.ending import ENDING
    ENDING.leave()
    from hmsa.cli import main as command
    try:
        status = command(argv)
    except SystemExit as end:  # of argparse
        status = int(end.code or 0)
    finally:
        # Signals during the shutdown of Python, which takes a while, would end it immediately.
        ENDING.ignore()
    ENDING.finish(status)
    return status


def _take_over() -> None:
    """Let a signal end the process immediately, until `Ending` handles it."""
    for number in (_signal.SIGINT, _signal.SIGTERM, _signal.SIGHUP):
        if _signal.getsignal(number) != _signal.SIG_IGN:
            _signal.signal(number, lambda number, _: os._exit(128 + number))
