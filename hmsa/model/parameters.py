"""Parameters of an actuator, in SI units and as the dimensionless group of Eq. 11."""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import product
import math
import re
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmsa.errors import BadInputError
from hmsa.model.creep import Creep
from hmsa.model.delivery import Delivery
from hmsa.model.laws.record import Coordinate, coordinate_of, Elastic, ELASTICA
from hmsa.model.modes import Modes
from hmsa.model.thermal import BLOCK_COEFFICIENTS, checked_temperature, Thermal
from hmsa.model.units import MU_0, Units

_ZERO_ALLOWED = ('zeta', 'damping_coefficient')
# Infinite for neo-Hookean, and for a block of constant volume.
_INFINITE_ALLOWED = ('j_lim', 'chain_limit', 'bulk_ratio')
_NO_NUMBERS = ('law', 'creep', 'modes', 'thermal')
# Exponents, which may be negative.
_ANY_SIGN = ('transverse_mass_exponent',)
# Factors on the mass, which no recording of one mode can tell from other values.
_FACTORS = ('mass_factor', 'transverse_mass_factor')
# Parameters of a compressible block.
_OF_VOLUME = ('bulk_ratio', 'transverse_mass_exponent')
# Scales and groups beyond this and its inverse belong to no block, and overflow in the equations.
_SMALLEST = 1e-100


def _check(record: object) -> None:
    """Raise `BadInputError` if a field of a record is out of range."""
    for field in fields(record):  # type: ignore[arg-type]
        name, value = field.name, getattr(record, field.name)
        if name in _NO_NUMBERS:
            continue
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            raise BadInputError(f'{name} is {value!r}: expected a number')
        zero, endless = name in _ZERO_ALLOWED, name in _INFINITE_ALLOWED
        # Compared first, since an integer may be too large to convert.
        size = abs(value) if name in _ANY_SIGN else value
        if not (0.0 < size <= sys.float_info.max or (
                zero or name in _ANY_SIGN) and value == 0.0 or endless and value == math.inf):
            least = '' if name in _ANY_SIGN else (
                ' of at least 0' if zero else ' greater than 0') + (', or inf' if endless else '')
            raise BadInputError(f'{name} is {value!r}: expected a finite number{least}')
        object.__setattr__(record, name, float(value))


@dataclass(frozen=True)
class NondimensionalParameters:
    """
    The dimensionless parameters of Eq. 11.

    Attributes
    ----------
    zeta : float
        Damping coefficient c/8 sqrt(1/(L^2 H^2 rho G)), at least 0. This is not a damping
        ratio: about a stretch of 1.1 critical damping is near 2.16 for J_lim 5.
    j_lim : float
        Limiting extensibility J_lim of the Gent model (Eq. 4), greater than 0; infinite for the
        neo-Hookean model.
    c1 : float
        Shape 2 H^2/L^2, greater than 0. The paper does not state it; the damping that it calls
        critical implies 2 (H = L).
    law : Elastic, optional
        Elastic energy in units of G. It replaces the Gent model, and J_lim has no effect.
    creep : Creep
        Viscoelastic branches, with times in time scales; default none.
    modes : Modes
        Secondary modes; default none.

    Raises
    ------
    BadInputError
        If a value is not finite or out of range.

    """

    zeta: float = 0.2
    j_lim: float = 5.0
    c1: float = 2.0
    law: Elastic | None = None
    creep: Creep = Creep()
    modes: Modes = Modes()

    def __post_init__(self) -> None:
        """Check the values."""
        _check(self)

    @cached_property
    def coordinate(self) -> Coordinate:
        """Kind of position, such as a stretch or the deflection of a beam."""
        return coordinate_of(self.law)

    @property
    def rest(self) -> float:
        """Stretch (or deflection of a beam) at rest without a field."""
        return self.coordinate.rest

    @cached_property
    def creeps(self) -> bool:
        """Whether there are viscoelastic branches with a stiffness above 0."""
        return len(self.branches) > 0

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Limiting stretches between which the force increases, both excluded."""
        from hmsa.model.law import LOWER, UPPER  # as below

        return float(self.packed[LOWER]), float(self.packed[UPPER])

    @cached_property
    def packed(self) -> NDArray[np.float64]:
        """The material argument of compiled functions, see `hmsa.model.law`."""
        from hmsa.model import law  # imports NumPy, which not all users of parameters need

        return law.pack(self.zeta, self.j_lim, self.c1, self.law)

    @cached_property
    def branches(self) -> NDArray[np.float64]:
        """Branches with a stiffness above 0 for `hmsa.motion`, shape (n, 6)."""
        from hmsa.motion import BRANCH  # as above

        return np.array(self.creep.rows()).reshape(-1, BRANCH)

    @cached_property
    def rows(self) -> NDArray[np.float64]:
        """Branches, then two rows for each secondary mode, for `hmsa.motion`, shape (n, 6)."""
        if not self.modes.ratios:
            return self.branches
        return np.concatenate([self.branches, np.array(self.modes.rows())])

    def observed(self, stretch: Any, rate: Any, others: Any) -> tuple[Any, Any]:
        """
        Return stretch and rate of all modes together, numbers or arrays of one shape.

        Those of the first mode come first, then positions and rates of the others in turns.
        """
        seen, speed = self.modes.observed(stretch, rate, others)
        if self.law is None or self.law.family != ELASTICA:
            return seen, speed
        from hmsa.model.laws import elastica  # as above

        # The share of the second mode of a bent beam is another one than that of a straight beam.
        gain, slope = elastica.lever(stretch)
        beside, apart, share = others[0] - stretch, others[1] - rate, self.modes.shares[0]
        return (seen + share * (gain - 1.0) * beside,
                speed + share * ((gain - 1.0) * apart + slope * rate * beside))

    @cached_property
    def elastic(self) -> 'NondimensionalParameters':
        """The group without branches."""
        return replace(self, creep=Creep()) if self.creeps else self

    @cached_property
    def ringing(self) -> 'NondimensionalParameters':
        """The group without secondary modes that hardly ring."""
        kept = self.modes.ringing
        if len(kept) == len(self.modes.ratios):
            return self
        numbers = self.modes.numbers
        return replace(self, modes=Modes.of_numbers([numbers[i] for i in kept]))

    def beyond(self, stretch: float, name: str = 'stretch') -> str:
        """Return why a stretch, by a name, is beyond the limits; empty if it is not."""
        lower, upper = self.limits
        if lower < stretch < upper:
            return ''
        kind = self.coordinate.name
        whose = f'J_lim {self.j_lim:g}' if self.law is None else f'law {self.law.law}'
        if self.law is not None and math.isfinite(self.law.bulk_ratio):
            whose += f' with bulk_ratio {self.law.bulk_ratio:g}'
        # Parameter names stay unchanged.
        called = re.sub(r'\bstretch\b', kind, name)
        return (f'{called} is {stretch:g}: expected a {kind} between the limits {lower:.4f} and '
                f'{upper:.4f} of {whose}')

    def check(self, stretch: float, name: str = 'stretch') -> None:
        """Raise `BadInputError` for a stretch, by a name, beyond the limits."""
        if reason := self.beyond(stretch, name):
            raise BadInputError(reason)


@dataclass(frozen=True)
class Geometry:
    """Geometric factors of parameters in SI units, from sizes (m) and model, for block or beam."""

    half_length: float
    half_thickness: float
    law: Elastic | None = None
    mass_factor: float = 1.0
    transverse_mass_factor: float = 1.0
    bulk_ratio: float = math.inf

    @property
    def c1(self) -> float:
        """Shape 2 H^2/L^2 of a block, or of the block with the inertia of a beam."""
        shape = None if self.law is None else self.law.shape
        return shape or 2.0 * (self.half_thickness / self.half_length) ** 2

    @property
    def inertia_c1(self) -> float:
        """Shape in the inertia m = (l^-3 + c1)/6, which has the transverse factor."""
        return self.c1 / self.transverse_mass_factor

    @property
    def inertia(self) -> float:
        """Factor on the density, for the mass factors: m(1) is `mass_factor` of the model's."""
        more, across = self.transverse_mass_factor, self.transverse
        return self.mass_factor * (
            more * (across + self.c1) / (more * across + self.c1))

    @property
    def transverse(self) -> float:
        """Transverse inertia at rest over that of constant volume, 4 nu^2, nu Poisson's ratio."""
        if math.isinf(self.bulk_ratio):
            return 1.0
        return ((3.0 * self.bulk_ratio - 2.0) / (3.0 * self.bulk_ratio + 1.0)) ** 2

    @property
    def loaded(self) -> float:
        """Area in m^2 on which a force acts: a face of a block, or the section of a beam."""
        section = self.law.section if self.law is not None and self.law.section else 1.0
        return 4.0 * section * self.half_length ** 2

    @property
    def damped(self) -> float:
        """Damping coefficient for zeta 1 over sqrt(rho G), in m^2: 8 L H for a block."""
        if self.law is not None and self.law.section:
            return 1.25 * self.loaded
        return 8.0 * self.half_length * self.half_thickness

    def damping_unit(self, density: float, shear_modulus: float) -> float:
        """Return the damping coefficient for zeta 1 in N s/m; arguments are in SI units."""
        # The damping in the equation of motion is zeta c1/2, with the shape in the inertia.
        return self.damped * math.sqrt(density * self.inertia * shear_modulus) * (
            self.inertia_c1 / self.c1)


@dataclass(frozen=True)
class ActuatorParameters:
    """
    A block of 2L x 2L x 2H of hard-magnetic elastomer, in SI units.

    Attributes
    ----------
    shear_modulus : float
        G in Pa, greater than 0.
    density : float
        rho in kg/m^3, greater than 0.
    half_length : float
        L in m, greater than 0.
    half_thickness : float
        H in m, along the field, greater than 0.
    remanence : float
        Residual flux density Br in T, greater than 0.
    chain_limit : float
        J_lim, dimensionless, greater than 0; infinite for neo-Hookean.
    damping_coefficient : float
        c of Eq. 9 in N s/m, at least 0.
    law : Elastic, optional
        Elastic energy in units of G. It replaces the Gent model, and J_lim has no effect.
    creep : Creep
        Viscoelastic branches, for planning; default none.
    modes : Modes
        Secondary modes; default none, as in the paper.
    mass_factor : float
        Factor on the inertia at rest, greater than 0; default 1.
    transverse_mass_factor : float
        Factor on the transverse inertia of a block relative to the axial one, greater than 0, with
        the same inertia at rest; default 1.
    thermal : Thermal
        Temperature coefficients, and the reference at which the values hold; default none.
    bulk_ratio : float
        Bulk over shear modulus of a compressible block, 1 to 1e6; default infinite, for constant
        volume.
    transverse_mass_exponent : float
        Exponent of the inverse stretch by which the transverse inertia of a compressible block
        grows in addition, -10 to 10; default 0.

    Raises
    ------
    BadInputError
        If a value is not finite or out of range.

    """

    shear_modulus: float
    density: float
    half_length: float
    half_thickness: float
    remanence: float
    chain_limit: float
    damping_coefficient: float
    law: Elastic | None = None
    creep: Creep = Creep()
    modes: Modes = Modes()
    mass_factor: float = 1.0
    transverse_mass_factor: float = 1.0
    thermal: Thermal = Thermal()
    bulk_ratio: float = math.inf
    transverse_mass_exponent: float = 0.0

    def __post_init__(self) -> None:
        """Check the values, and that they give usable scales."""
        _check(self)
        try:
            scales = self.time_unit, self.flux_density_unit, self.geometry.inertia_c1
        except ArithmeticError:
            scales = math.nan, math.nan, math.nan
        if not all(_SMALLEST < x < 1.0 / _SMALLEST for x in scales):
            raise BadInputError(
                f'the parameters of the actuator give a unit of time of {scales[0]:g} s, of flux '
                f'density of {scales[1]:g} T and c1 of {scales[2]:g}: expected values of a block, '
                'in SI units')
        if self.transverse_mass_factor != 1.0 and self.law is not None and self.law.shape:
            raise BadInputError(
                f'transverse_mass_factor is {self.transverse_mass_factor:g}: expected 1 for a '
                'beam, which has no transverse inertia of its own')
        if math.isfinite(self.bulk_ratio):
            from hmsa.model.compressible import check  # as below

            check(self.bulk_ratio, self.law, self.transverse_mass_exponent)
        elif self.transverse_mass_exponent:
            raise BadInputError(
                f'transverse_mass_exponent is {self.transverse_mass_exponent:g}: expected 0 '
                'without a finite bulk_ratio')
        for name, exponents in (
                ('ratio', self.modes.exponents), ('share', self.modes.share_exponents)):
            if any(exponents) and self.rest == 0.0:
                raise BadInputError(
                    f'modes.{name}_exponent is given for a beam: expected none, as its deflection '
                    'at rest is 0')
        self.creep.check(scales[0])

    @classmethod
    def from_nondimensional(
            cls, material: NondimensionalParameters, *, shear_modulus: float, density: float,
            half_length: float, remanence: float) -> 'ActuatorParameters':
        """
        Return the actuator with a dimensionless group at a given scale.

        Parameters
        ----------
        material : NondimensionalParameters
            zeta, J_lim and c1, and the hyperelastic model.
        shear_modulus, density, half_length, remanence : float
            The scale, in Pa, kg/m^3, m and T.

        Returns
        -------
        ActuatorParameters
            With H = L sqrt(c1/2) and c = 8 zeta L H sqrt(rho G).

        Raises
        ------
        BadInputError
            If a value is not finite or out of range.

        """
        # Checked before the square root, which a negative product does not have.
        cube = cls(shear_modulus, density, half_length, half_length, remanence,
                   material.j_lim, 0.0)
        law = material.law
        volume: dict[str, Any] = {} if law is None else {
            'bulk_ratio': law.bulk_ratio, 'transverse_mass_exponent': law.inertia_exponent}
        if law is not None and math.isfinite(law.bulk_ratio):
            law = law.isochoric
        made = replace(
            cube, half_thickness=half_length * math.sqrt(material.c1 / 2.0), law=law,
            modes=material.modes, **volume,
            creep=replace(material.creep, times=tuple(
                x * cube.time_unit for x in material.creep.times)))
        return replace(made, damping_coefficient=material.zeta * made.damping_unit)

    def at_temperature(self, temperature: float) -> 'ActuatorParameters':
        """
        Return the actuator at a temperature in degrees Celsius, which becomes the reference.

        Without coefficients, and at the reference, it is the same actuator. Raise `BadInputError`
        for an impossible temperature.
        """
        thermal = self.thermal
        checked_temperature(temperature)
        if not thermal or temperature == thermal.reference:
            return self
        changed: dict[str, Any] = {
            x: getattr(self, x) * thermal.factor(x, temperature) for x in BLOCK_COEFFICIENTS}
        return replace(self, thermal=thermal.at(temperature), **changed)

    @property
    def numbers(self) -> dict[str, float]:
        """All numeric values, by name."""
        return {
            x.name: getattr(self, x.name) for x in fields(self)
            if x.name not in (*_NO_NUMBERS, *_FACTORS, *_OF_VOLUME)}

    @property
    def factors(self) -> dict[str, float]:
        """Factors on the mass, by name."""
        return {x: getattr(self, x) for x in _FACTORS}

    @property
    def coordinate(self) -> Coordinate:
        """Kind of position, such as a stretch or the deflection of a beam."""
        return coordinate_of(self.law)

    @property
    def rest(self) -> float:
        """Stretch (or deflection of a beam) at rest without a field."""
        return self.coordinate.rest

    @property
    def geometry(self) -> Geometry:
        """Geometric factors from sizes and model."""
        return Geometry(
            self.half_length, self.half_thickness, self.law, bulk_ratio=self.bulk_ratio,
            **self.factors)

    @property
    def time_unit(self) -> float:
        """Time scale L sqrt(rho/G) in s, with the density times the factor on the inertia."""
        return self.half_length * math.sqrt(
            self.density * self.geometry.inertia / self.shear_modulus)

    @cached_property
    def period(self) -> float:
        """Period in s of small undamped motion about rest without a field."""
        from hmsa.model import law  # imports NumPy, which not all users of parameters need

        frequency = law.natural_frequency(self.rest, self.nondimensional.packed)
        return 2.0 * math.pi * self.time_unit / frequency

    @property
    def flux_density_unit(self) -> float:
        """Flux density of load 1, mu0 G/Br in T."""
        return MU_0 * self.shear_modulus / self.remanence

    @cached_property
    def units(self) -> Units:
        """Scales of time in s, and of the flux density in T."""
        return Units(
            self.time_unit, self.flux_density_unit, ' s', ' T', self.coordinate.name)

    @property
    def damping_unit(self) -> float:
        """Damping coefficient in N s/m for zeta 1: 8 L H sqrt(rho G), or that of a beam's tip."""
        return self.geometry.damping_unit(self.density, self.shear_modulus)

    @property
    def load_per_newton(self) -> float:
        """Load of a force of 1 N on both faces of a block, or on the tip of a beam."""
        return 1.0 / (self.geometry.loaded * self.shear_modulus)

    def side(self, stretch: float) -> float:
        """Return the transverse stretch of a block at rest under a stretch."""
        if math.isinf(self.bulk_ratio):
            return 1.0 / math.sqrt(stretch)
        from hmsa.model.compressible import side  # as above

        return side(stretch, self.law, self.chain_limit, self.bulk_ratio)

    @cached_property
    def energy(self) -> Elastic | None:
        """Elastic energy in units of G, with the change of volume if there is one."""
        if math.isinf(self.bulk_ratio):
            return self.law
        from hmsa.model.compressible import condensed  # as above

        return condensed(
            self.law, self.chain_limit, self.bulk_ratio, self.transverse_mass_exponent)

    @cached_property
    def nondimensional(self) -> NondimensionalParameters:
        """The dimensionless group of Eq. 11."""
        return NondimensionalParameters(
            zeta=self.damping_coefficient / self.damping_unit,
            j_lim=self.chain_limit,
            c1=self.geometry.inertia_c1,
            law=self.energy,
            creep=replace(self.creep, times=tuple(x / self.time_unit for x in self.creep.times)),
            modes=self.modes)


def paper_actuator(material: NondimensionalParameters | None = None) -> ActuatorParameters:
    """
    Return a soft silicone block with the paper's dimensionless parameters.

    G = 10 kPa, rho = 1900 kg/m^3, L = 10 mm, Br = 0.1 T: a time scale of 4.4 ms.

    Parameters
    ----------
    material : NondimensionalParameters, optional
        Default: zeta 0.2, J_lim 5, c1 2.

    Returns
    -------
    ActuatorParameters
        In SI units.

    """
    return ActuatorParameters.from_nondimensional(
        material or NondimensionalParameters(), shear_modulus=1.0e4, density=1900.0,
        half_length=0.01, remanence=0.1)


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
