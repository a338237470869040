"""Entry points of all processes: signals are taken over before anything slow is imported."""

from collections.abc import Sequence
from functools import partial
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


def _node(name: str) -> int:
    """Run ``hmsa NAME`` as a program of its own."""
    return main([name, *sys.argv[1:]])


planner = partial(_node, 'planner')
plant = partial(_node, 'plant')
driver = partial(_node, 'driver')
recorder = partial(_node, 'recorder')
controller = partial(_node, 'controller')
player = partial(_node, 'player')
