"""Errors of the model parameters, and their uncertainty."""

from dataclasses import dataclass, replace
from itertools import product
import math

import numpy as np

from hmsa.errors import BadInputError
from hmsa.model.delivery import Delivery
from hmsa.model.parameters import NondimensionalParameters


@dataclass(frozen=True)
class Errors:
    """
    Errors of the model: actual value = model's (1 + error).

    Errors are above -1; that of the damping coefficient may be -1 (no damping).
    """

    #: Of G, which affects the loads, the time scale and, for a given coefficient c, zeta.
    shear_modulus: float = 0.0
    zeta: float = 0.0  #: of the damping coefficient c
    j_lim: float = 0.0
    remanence: float = 0.0  #: of Br, which affects the loads

    def __post_init__(self) -> None:
        """Check the values."""
        for name, value in vars(self).items():
            least = name == 'zeta'
            if not (-1.0 < value < math.inf or (least and value == -1.0)):
                raise BadInputError(
                    f'error of {name} is {value:g}: expected a finite number '
                    f'{"of at least" if least else "above"} -1')

    @property
    def stiffer(self) -> float:
        """Return the actuator's unit of load relative to that of the model."""
        return (1.0 + self.shear_modulus) / (1.0 + self.remanence)

    @property
    def faster(self) -> float:
        """Return the model's time scale relative to that of the actuator."""
        return math.sqrt(1.0 + self.shear_modulus)

    def delivery(self, planned: Delivery) -> Delivery:
        """Return ramps and lag of the model in the actuator's units."""
        return Delivery(
            slew=planned.slew / self.faster / self.stiffer, lag=planned.lag * self.faster)

    def actual(self, material: NondimensionalParameters) -> NondimensionalParameters:
        """Return the actuator's dimensionless group: zeta = c/8 sqrt(1/(L^2 H^2 rho G))."""
        return replace(
            material,
            zeta=material.zeta * (1.0 + self.zeta) / self.faster,
            j_lim=material.j_lim * (1.0 + self.j_lim),
            creep=replace(
                material.creep, times=tuple(x * self.faster for x in material.creep.times)))


#: Errors of G, damping coefficient, J_lim and remanence.
Offs = tuple[float, float, float, float]


@dataclass(frozen=True)
class Ellipsoid:
    """A confidence region of the errors, centred at zero."""

    axes: tuple[Offs, ...]  #: half axes, one to four

    def __post_init__(self) -> None:
        """Check the axes."""
        if not (1 <= len(self.axes) <= 4 and all(math.isfinite(x) for y in self.axes for x in y)):
            raise BadInputError(
                f'an ellipsoid of errors has the half axes {self.axes}: expected one to four, of '
                'finite fractions')

    def offs(self, largest: float) -> list[Offs]:
        """Return the ends of the axes, the middles of the first, and points in between."""
        count = len(self.axes)
        ends = np.repeat(np.eye(count), 2, axis=0) * np.tile([[-1.0], [1.0]], (count, 1))
        between = np.array(list(product((-1.0, 1.0), repeat=count))) / math.sqrt(count)
        offs = np.concatenate([0.5 * ends[:2], ends, between]) @ np.array(self.axes)
        return [(a, b, c, d) for a, b, c, d in np.clip(offs, -largest, largest).tolist()]


#: Maximum errors of G, damping coefficient and J_lim separately, or all of them jointly.
Uncertainty = tuple[float, float, float] | Ellipsoid
