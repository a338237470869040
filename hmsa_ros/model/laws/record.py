"""What a law of elasticity is: its constants, and what is left of it without its scale."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hmsa_ros.errors import BadInputError, excerpt

# Families of laws: the first number of a packed material.
GENT = 0.0  # 1/J_lim
NEO_HOOKEAN = 1.0  # none
POLYNOMIAL = 2.0  # b, a_1 to a_5 of b (I2 - 3) + sum a_k (I1 - 3)^k
OGDEN = 3.0  # number of terms, then mu and alpha of each
TABLE = 4.0  # number of pieces, then what `hmsa_ros.model.laws.curve.Curve.packed` returns
BEAM = 5.0  # what `hmsa_ros.model.laws.bending.packed` returns
ARRUDA_BOYCE = 6.0  # mu, lambda_m
DIELECTRIC = 7.0  # 1/J_lim
_COORDINATES = {BEAM: 'deflection', DIELECTRIC: 'capacitance ratio'}

#: Place of the constants in a packed material.
CONSTANTS = 6
#: Powers of I1 - 3 that the polynomial family has.
POWERS = 5
#: Of a law that is a formula: no block reaches these stretches.
ENDLESS = (1e-3, 1e3)


@dataclass(frozen=True)
class Constant:
    """One constant of a law."""

    name: str  #: of the parameter, as in ``'law.c10'``
    symbol: str  #: what it is in the energy
    #: Pa scales with the shear modulus, T with the flux density of load 1; empty for others.
    unit: str = 'Pa'
    kind: type = float  #: float, list or str
    minimum: float = -1e12  #: of the number, or of each in a list; closed range
    maximum: float = 1e12
    fixed: bool = False  #: whether it is read once, when a node starts
    #: Among the constants of the family, the first of a list, which has every other place; -1 for
    #: one that cannot be identified.
    place: int = -1
    inverse: bool = False  #: whether 1 over it goes to 0 where it is without effect


@dataclass(frozen=True)
class Elastic:
    """An elastic energy in units of its shear modulus at small strain."""

    law: str  #: name
    family: float  #: one of the families above
    constants: tuple[float, ...]  #: those of the family
    #: Parameters that gave it, those in Pa and in T in units of the block.
    given: tuple[tuple[str, Any], ...]
    limits: tuple[float, float] = ENDLESS  #: beyond which nothing is known
    shape: float | None = None  #: c1 in place of that of a block
    section: float = 0.0  #: width times thickness of a beam over its length squared; 0 for a block
    #: Voltage of the load 1 over the root of G, in V/sqrt(Pa); 0 for what a field drives.
    volts: float = 0.0

    @property
    def rest(self) -> float:
        """Coordinate at rest without a field: 1, or deflection 0 of a beam."""
        return 0.0 if self.family == BEAM else 1.0

    @property
    def coordinate(self) -> str:
        """What the coordinate is called."""
        return _COORDINATES.get(self.family, 'stretch')


@dataclass(frozen=True)
class Law:
    """A law that may be chosen."""

    name: str  #: value of the parameter ``law``
    energy: str  #: W per reference volume
    source: str  #: where it was published
    constants: tuple[Constant, ...] = ()  #: besides those of the actuator
    #: From the values of the constants, and of the actuator, to the shear modulus at small strain
    #: and what is left of the law in units of it; none for Gent and its limit.
    scaled: Callable[[Mapping[str, Any]], tuple[float, Elastic]] | None = None
    own_modulus: bool = True  #: whether G follows from the constants of what is scaled
    endless: bool = False  #: whether J_lim is infinite, whatever the parameter says
    #: From the values of the constants to those that are in a file which they name.
    completed: Callable[[Mapping[str, Any]], dict[str, Any]] | None = None


def positive_modulus(law: str, modulus: float, words: str, values: Sequence[Any]) -> float:
    """
    Return a shear modulus at small strain in Pa, which follows from constants as the words say.

    If it is not positive, at rest such a block would not be stable: `BadInputError`.
    """
    if not 1e-3 <= modulus <= 1e12:
        raise BadInputError(
            f'the constants of law {law} are {", ".join(map(excerpt, values))}: expected a shear '
            f'modulus {words} of 0.001 to 1e+12 Pa, got {modulus:g} Pa')
    return modulus


def polynomial(
        law: Law, values: Mapping[str, Any], modulus: float, powers: Sequence[float],
        second: float = 0.0) -> Elastic:
    """
    Return a law that is a polynomial of I1 - 3, and linear in I2 - 3, in units of the modulus.

    All but the values are in Pa: the modulus at small strain, factors of the ``powers`` 1, 2, ...,
    at most `POWERS`, of I1 - 3, and the factor of I2 - 3.
    """
    filled = (*powers, *(0.0,) * (POWERS - len(powers)))
    return Elastic(
        law.name, POLYNOMIAL, tuple(x / modulus for x in (second, *filled)),
        given(law, values, modulus))


def given(
        law: Law, values: Mapping[str, Any], modulus: float) -> tuple[tuple[str, Any], ...]:
    """Return the constants of a law, those in Pa in units of the shear modulus."""
    def scaled(constant: Constant) -> Any:
        value = values[constant.name]
        if constant.kind is list:
            value = tuple(value)
        if constant.unit != 'Pa':
            return value
        return tuple(x / modulus for x in value) if constant.kind is list else value / modulus

    return tuple((x.name, scaled(x)) for x in law.constants)

