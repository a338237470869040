"""
Vibration-free command shaping for hard-magnetic soft actuators.

In seconds and tesla:

>>> import hmsa
>>> block = hmsa.Actuator(shear_modulus=30e3, half_length=5e-3, remanence=0.08, zeta=0.1)
>>> plan = block.plan([(1.1, 0.5), (1.0, 0.5)])
>>> print(plan.report())
stretch  duration (s)  first level (T)  move time (s)  last level (T)  status
───────  ────────────  ───────────────  ─────────────  ──────────────  ────────
    1.1           0.5        0.0710244     0.00165067         0.12964  two_step
      1           0.5         0.062155     0.00165032               0  two_step
>>> motion = plan.simulate(truth=block.scaled(shear_modulus=1.02), noise=1e-4)

``hmsa.model`` models the actuator, ``hmsa.planning`` plans the commands that move it,
``hmsa.judge`` decides whether it arrived, ``hmsa.identification`` finds its parameters,
``hmsa.runs`` reads recordings, ``hmsa.report`` evaluates them, and ``hmsa.cli`` is the command
line. Nothing here depends on ROS; ``hmsa_ros`` contains the nodes.
"""

from importlib import import_module
import sys
from typing import TYPE_CHECKING

__version__ = '0.2.0'

if TYPE_CHECKING:
    from hmsa.api.actuator import Actuator
    from hmsa.api.identified import Identified, identify
    from hmsa.api.motion import compare, Motion, read
    from hmsa.api.plan import Plan
    from hmsa.errors import (
        AssumedWarning,
        BadInputError,
        HmsaError,
        MissingWarning,
        UnusualWarning,
    )
    from hmsa.table import Table

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
            raise AttributeError(
                f'module {__name__!r} has no attribute {name!r}',
                name=name, obj=sys.modules[__name__])
        found = globals()[name] = getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)
        return found


def __dir__() -> list[str]:
    return __all__
