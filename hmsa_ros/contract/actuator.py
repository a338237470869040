"""The actuator that a set of parameters describes."""

from collections.abc import Mapping
from typing import Any

from hmsa_ros.contract.parameters import ACTUATOR_FIELDS
from hmsa_ros.core.parameters import ActuatorParameters


def actuator_from(values: Mapping[str, Any]) -> ActuatorParameters:
    """Return the block of ``actuator.*`` in SI units, times the factors ``mismatch.*`` if any."""
    return ActuatorParameters(**{
        name: values[f'actuator.{name}'] * values.get(f'mismatch.{name}', 1.0)
        for name in ACTUATOR_FIELDS})
