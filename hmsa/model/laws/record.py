"""Record of a hyperelastic model: its constants, its dimensionless energy, and its coordinate."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import math
from typing import Any

from hmsa.errors import BadInputError, excerpt

# Families of models, the first number of a packed material, with their constants.
GENT = 0.0  # 1/J_lim
NEO_HOOKEAN = 1.0  # none
POLYNOMIAL = 2.0  # b, a_1 to a_5 of b (I2 - 3) + sum a_k (I1 - 3)^k
OGDEN = 3.0  # number of terms, then mu and alpha of each
TABLE = 4.0  # number of pieces, then `hmsa.model.laws.curve.StaticCharacteristic.packed`
BEAM = 5.0  # result of `hmsa.model.laws.bending.packed`
ARRUDA_BOYCE = 6.0  # mu, lambda_m
ELASTICA = 7.0  # result of `hmsa.model.laws.elastica.packed`
FORMULA = 8.0  # result of `hmsa.model.laws.formula`
CONDENSED = 9.0  # result of `hmsa.model.compressible.condensed`
#: Families whose coordinate is the deflection of a tip.
BEAMS = (BEAM, ELASTICA)

#: Index of the first constant in a packed material.
CONSTANTS = 6
#: Number of powers of I1 - 3 in the polynomial family.
POWERS = 5
#: Limits of a model that is a formula: no block reaches these stretches.
ENDLESS = (1e-3, 1e3)


@dataclass(frozen=True)
class Constant:
    """One constant of a model."""

    name: str  #: of the parameter, as in ``'law.c10'``
    symbol: str  #: meaning in the energy
    #: Pa scales with the shear modulus, T with the flux density of load 1; empty for others.
    unit: str = 'Pa'
    kind: type = float  #: float, list or str
    minimum: float = -1e12  #: of the number, or of each in a list; closed range
    maximum: float = 1e12
    above: float = -math.inf  #: bound of an open range
    fixed: bool = False  #: whether it is read once, when a node starts
    #: Index among the constants of the family; for a list, of its first value, with a stride of 2;
    #: -1 if it cannot be identified.
    place: int = -1
    inverse: bool = False  #: whether its inverse is 0 if it has no effect


@dataclass(frozen=True)
class Elastic:
    """An elastic energy in units of its shear modulus at small strain."""

    law: str  #: name
    family: float  #: one of the families above
    constants: tuple[float, ...]  #: constants of the family
    #: Parameters that it was made from, those in Pa and in T in units of the block.
    given: tuple[tuple[str, Any], ...]
    limits: tuple[float, float] = ENDLESS  #: range in which the energy is known
    shape: float | None = None  #: c1, if not that of a block
    section: float = 0.0  #: width times thickness of a beam over its length squared; 0 for a block
    #: Bulk over shear modulus; infinite for a block of constant volume.
    bulk_ratio: float = math.inf
    #: Exponent of the inverse stretch by which its transverse inertia grows in addition.
    inertia_exponent: float = 0.0
    #: What a compressible block has at constant volume; None for Gent.
    isochoric: 'Elastic | None' = None

    @property
    def rest(self) -> float:
        """Coordinate at rest without a field: 1, or deflection 0 of a beam."""
        return 0.0 if self.family in BEAMS else 1.0

    @property
    def coordinate(self) -> str:
        """Name of the coordinate."""
        return 'deflection' if self.family in BEAMS else 'stretch'


@dataclass(frozen=True)
class Law:
    """A hyperelastic model to choose."""

    name: str  #: value of the parameter ``law``
    energy: str  #: W per reference volume
    source: str  #: publication
    constants: tuple[Constant, ...] = ()  #: in addition to those of the actuator
    #: Maps the values of the constants, and of the actuator, to the shear modulus at small strain
    #: and the energy in units of it; None for Gent and neo-Hookean.
    scaled: Callable[[Mapping[str, Any]], tuple[float, Elastic]] | None = None
    endless: bool = False  #: whether J_lim is infinite, regardless of the parameter
    #: Maps the values of the constants to those read from a file that they name.
    completed: Callable[[Mapping[str, Any]], dict[str, Any]] | None = None


def positive_modulus(law: str, modulus: float, words: str, values: Sequence[Any]) -> float:
    """
    Return a shear modulus at small strain in Pa; ``words`` describe how constants determine it.

    Raise `BadInputError` if it is not positive, as such a block would not be stable at rest.
    """
    if not 1e-3 <= modulus <= 1e12:
        raise BadInputError(
            f'the constants of law {law} are {", ".join(map(excerpt, values))}: expected a shear '
            f'modulus {words} of 0.001 to 1e+12 Pa, got {modulus:g} Pa')
    return modulus


def above(law: str, name: str, value: float, least: float) -> float:
    """Return the value of a constant, or raise `BadInputError` if it is not above a bound."""
    if not value > least:
        raise BadInputError(
            f'parameter {name} is {value:g}: expected more than {least:g} for law {law}')
    return value


def polynomial(
        law: Law, values: Mapping[str, Any], modulus: float, powers: Sequence[float],
        second: float = 0.0) -> Elastic:
    """
    Return a model that is a polynomial of I1 - 3, and linear in I2 - 3, in units of the modulus.

    The modulus at small strain, the factors of the ``powers`` 1, 2, ... of I1 - 3 (at most
    `POWERS`) and the factor of I2 - 3 are in Pa.
    """
    filled = (*powers, *(0.0,) * (POWERS - len(powers)))
    return Elastic(
        law.name, POLYNOMIAL, tuple(x / modulus for x in (second, *filled)),
        given(law, values, modulus))


def given(
        law: Law, values: Mapping[str, Any], modulus: float) -> tuple[tuple[str, Any], ...]:
    """Return the constants of a model, with those in Pa in units of the shear modulus."""
    def scaled(constant: Constant) -> Any:
        value = values[constant.name]
        if constant.kind is list:
            value = tuple(value)
        if constant.unit != 'Pa':
            return value
        return tuple(x / modulus for x in value) if constant.kind is list else value / modulus

    return tuple((x.name, scaled(x)) for x in law.constants)


@dataclass(frozen=True)
class Coordinate:
    """A kind of position, and the range of its values."""

    name: str  #: in sentences, as plural
    plural: str
    symbol: str  #: in axes of figures, as tex
    tex: str
    meaning: str  #: definition and typical value
    rest: float  #: without a field
    at_rest: tuple[float, float]  #: range of a sensor without a field
    possible: tuple[float, float]  #: usual range of a sensor
    conceivable: tuple[float, float]  #: range of any position
    usual: tuple[float, float]  #: range of a motion of moderate size
    looks: str = ''  #: likely meaning of other values, and a remedy; empty if evident


STRETCH = Coordinate(
    'stretch', 'stretches', 'λ', r'\lambda', 'the length over the length at rest, around 1', 1.0,
    (0.6, 1.6), (0.15, 5.0), (0.0, 20.0), (0.6, 2.0))
DEFLECTION = Coordinate(
    'deflection', 'deflections', 'u', 'u',
    'the deflection of the tip over the length of the beam, around 0', 0.0,
    (-0.4, 0.4), (-1.2, 1.2), (-2.0, 2.0), (-0.6, 0.6),
    'a length, in mm perhaps, divide it by that of the beam; if it is the angle of the tip, take '
    'the deflection that goes with it')
#: Name of a position of unknown kind.
POSITION = 'position'
COORDINATES = {x.name: x for x in (STRETCH, DEFLECTION)}


def coordinate_of(law: Elastic | None) -> Coordinate:
    """Return the kind of position of a model; None for Gent."""
    return STRETCH if law is None else COORDINATES[law.coordinate]
