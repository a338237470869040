"""
ROS 2 package that moves hard-magnetic soft actuators without residual vibration.

``hmsa_ros.nodes`` contains the nodes, ``hmsa_ros.runtime`` the decisions of a running planner, and
``hmsa_ros.device`` the simulated plant and drivers of hardware; the last two do not depend on ROS.
In Python, without ROS, use ``hmsa``, which has all names that were here before.
"""

from importlib import import_module
from typing import TYPE_CHECKING
import warnings

from hmsa import __version__

__all__ = ['__version__']

if not TYPE_CHECKING:
    def __getattr__(name):
        hmsa = import_module('hmsa')
        if name.startswith('_') or name not in hmsa.__all__:
            raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
        warnings.warn(
            f'hmsa_ros.{name} is hmsa.{name} now: expected import hmsa', DeprecationWarning,
            stacklevel=2)
        return getattr(hmsa, name)
