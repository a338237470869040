"""
Vibration-free command shaping for hard-magnetic soft actuators on ROS 2.

In Python, without ROS, in seconds and tesla:

>>> import hmsa_ros
>>> block = hmsa_ros.Actuator(shear_modulus=30e3, half_length=5e-3, remanence=0.08, zeta=0.1)
>>> plan = block.plan([(1.1, 0.5), (1.0, 0.5)])
>>> print(plan.report())
stretch  duration (s)  first level (T)  move time (s)  last level (T)  status
───────  ────────────  ───────────────  ─────────────  ──────────────  ────────
    1.1           0.5        0.0710244     0.00165067         0.12964  two_step
      1           0.5         0.062155     0.00165032               0  two_step
>>> motion = plan.simulate(truth=block.scaled(shear_modulus=1.02), noise=1e-4)

``hmsa_ros.model`` models the actuator, ``hmsa_ros.planning`` plans the commands that move it, and
``hmsa_ros.device`` contains the simulated plant and drivers of hardware, all without ROS.
``hmsa_ros.bag`` reads and writes recordings, ``hmsa_ros.nodes`` contains the ROS 2 nodes, and
``hmsa_ros.cli`` is the command line.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = '0.1.0'

if TYPE_CHECKING:
    from hmsa_ros.api.actuator import Actuator
    from hmsa_ros.api.identified import Identified, identify
    from hmsa_ros.api.motion import compare, Motion, read
    from hmsa_ros.api.plan import Plan
    from hmsa_ros.errors import (
        AssumedWarning,
        BadInputError,
        HmsaError,
        MissingWarning,
        UnusualWarning,
    )
    from hmsa_ros.table import Table

__all__ = [
    'Actuator', 'AssumedWarning', 'BadInputError', 'HmsaError', 'Identified',
    'MissingWarning', 'Motion', 'Plan', 'Table', 'UnusualWarning', 'compare', 'identify', 'read']

# Module of each name, which is imported on first use.
_HOMES = {
    'Actuator': 'api.actuator', 'AssumedWarning': 'errors', 'BadInputError': 'errors',
    'HmsaError': 'errors', 'Identified': 'api.identified', 'MissingWarning': 'errors',
    'Motion': 'api.motion', 'Plan': 'api.plan', 'Table': 'table', 'UnusualWarning': 'errors',
    'compare': 'api.motion', 'identify': 'api.identified', 'read': 'api.motion'}

if not TYPE_CHECKING:
    def __getattr__(name):
        if name not in _HOMES:
            raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
        found = globals()[name] = getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)
        return found


def __dir__() -> list[str]:
    return __all__
