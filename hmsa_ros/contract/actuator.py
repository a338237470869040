"""The actuator that a set of parameters describes."""

from collections.abc import Mapping
from typing import Any

from hmsa_ros.contract.parameters import ACTUATOR_FIELDS
from hmsa_ros.core.parameters import ActuatorParameters


def actuator_from(values: Mapping[str, Any]) -> ActuatorParameters:
    """
    Return the block that parameters describe.

    Parameters
    ----------
    values : mapping of str to object
        All of ``actuator.*``, in SI units, and the factors ``mismatch.*`` where there are any,
        by which a simulated block differs from what it claims to be.

    Returns
    -------
    ActuatorParameters
        In SI units.

    Raises
    ------
    BadInputError
        If a value is out of range.

    """
    return ActuatorParameters(**{
        name: values[f'actuator.{name}'] * values.get(f'mismatch.{name}', 1.0)
        for name in ACTUATOR_FIELDS})
