"""By how much an actuator differs from its model."""

from dataclasses import dataclass, replace
import math

from hmsa_ros.core.parameters import NondimensionalParameters
from hmsa_ros.errors import BadInputError


@dataclass(frozen=True)
class Errors:
    """
    By how much the actuator differs from the model: actual value = model's (1 + error).

    Attributes
    ----------
    shear_modulus : float
        Of G, above -1. It scales the loads, the time unit and, for a given coefficient c, zeta.
    zeta : float
        Of the damping coefficient c, at least -1.
    j_lim : float
        Of J_lim, above -1.

    Raises
    ------
    BadInputError
        If a value is not finite or out of range.

    """

    shear_modulus: float = 0.0
    zeta: float = 0.0
    j_lim: float = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        for name, value, least in (
                ('shear_modulus', self.shear_modulus, False), ('zeta', self.zeta, True),
                ('j_lim', self.j_lim, False)):
            if not (-1.0 < value < math.inf or (least and value == -1.0)):
                raise BadInputError(
                    f'error of {name} is {value:g}: expected a finite number '
                    f'{"of at least" if least else "above"} -1')

    def actual(self, material: NondimensionalParameters) -> NondimensionalParameters:
        """Return the model's group for the actuator: zeta = c/8 sqrt(1/(L^2 H^2 rho G))."""
        return replace(
            material,
            zeta=material.zeta * (1.0 + self.zeta) / math.sqrt(1.0 + self.shear_modulus),
            j_lim=material.j_lim * (1.0 + self.j_lim))
