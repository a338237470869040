"""Executables of ``ros2 run hmsa_ros``: ``hmsa NODE`` for each node."""

from collections.abc import Callable
import sys

from hmsa.entry import main


def _node(name: str) -> Callable[[], int]:
    """Return an entry point that runs ``hmsa NAME``."""
    return lambda: main([name, *sys.argv[1:]])


planner, plant, driver, recorder, controller, player, sense = map(_node, (
    'planner', 'plant', 'driver', 'recorder', 'controller', 'player', 'sense'))
