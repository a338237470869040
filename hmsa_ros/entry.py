"""Entry points of all processes: signals are taken over before anything slow is imported."""

from collections.abc import Sequence
import sys

from hmsa_ros.ending import ENDING


def main(argv: Sequence[str] | None = None) -> int:
    """Run the ``hmsa`` command; return its exit status."""
    ENDING.leave()
    from hmsa_ros.cli import main as command
    try:
        status = command(argv)
    finally:
        # Python's own end takes a while, in which it would answer signals by dying.
        ENDING.ignore()
    ENDING.finish(status)
    return status


def planner() -> int:
    """Run ``hmsa planner``."""
    return main(['planner', *sys.argv[1:]])


def plant() -> int:
    """Run ``hmsa plant``."""
    return main(['plant', *sys.argv[1:]])


def driver() -> int:
    """Run ``hmsa driver``."""
    return main(['driver', *sys.argv[1:]])


def recorder() -> int:
    """Run ``hmsa recorder``."""
    return main(['recorder', *sys.argv[1:]])


def controller() -> int:
    """Run ``hmsa controller``."""
    return main(['controller', *sys.argv[1:]])


def player() -> int:
    """Run ``hmsa player``."""
    return main(['player', *sys.argv[1:]])
