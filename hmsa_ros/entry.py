"""Executables of ``ros2 run hmsa_ros``: ``hmsa NODE`` for each node."""

from collections.abc import Callable
import sys

from hmsa.entry import main


def _node(name: str) -> Callable[[], int]:
    """Return an entry point that runs ``hmsa NAME``."""
    return lambda: main([name, *sys.argv[1:]])


planner = _node('planner')
plant = _node('plant')
driver = _node('driver')
recorder = _node('recorder')
controller = _node('controller')
player = _node('player')
sense = _node('sense')
