"""
Hyperelastic models that are written once, as an energy in Python.

The energy is a function of the `Strain` and of the constants, as numbers. It is called once, with
terms in place of numbers, which record the operations. Their derivatives give the force. Both are
programs that the compiled equation of motion runs over its scalars (``Formula`` in
``hmsa/motion/hmsa/law.hpp``), which provide the derivatives by the constants.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
import math
from typing import Any, Union

from hmsa.errors import BadInputError
from hmsa.model.laws.record import (
    above,
    Constant,
    Elastic,
    FORMULA,
    given,
    Law,
    positive_modulus,
)

# Operations of a program; the first is none.
_LEAF, _SUM, _PRODUCT, _INVERSE, _POSITIVE, _LOG, _LOG1P, _EXP, _EXPM1, _POWER = range(10)
# Numbers that the motion provides, and their derivatives by the stretch: stretch along the field
# and across it, I1 - 3 and I2 - 3, and the derivatives of the last two.
_GIVEN = 6
# Registers of the compiled motion.
_MOST = 96
# Largest power that is a product.
_SMALL = 4

Number = Union['Term', float]


class _Program:
    """Operations on constants and given numbers, each one once."""

    def __init__(self, constants: int) -> None:
        self.constants = constants
        self.steps: list[tuple[int, Any, Any]] = []
        self._places: dict[tuple[int, Any, Any], int] = {}
        self.leaves = [self.term(_LEAF, f'{i}') for i in range(constants + _GIVEN)]

    def term(self, operation: int, a: Any, b: int | None = None) -> 'Term':
        step = (operation, a, a if b is None else b)
        if step not in self._places:
            self._places[step] = len(self.steps)
            self.steps.append(step)
        return Term(self, self._places[step])

    def literal(self, value: Number) -> 'Term':
        return value if isinstance(value, Term) else self.term(_LEAF, float(value))

    def slope(self, of: 'Term') -> 'Term':
        """Return the derivative of a term by the stretch."""
        along, across, _, _, by_first, by_second = self.leaves[self.constants:]
        slopes: dict[int, Number] = dict(enumerate(
            (1.0, -0.5 * across ** 3, by_first, by_second), self.constants))
        for i, (operation, a, b) in enumerate(self.steps[:of.place + 1]):
            if operation == _LEAF:
                slopes.setdefault(i, 0.0)
                continue
            x, y, by, other = Term(self, a), Term(self, b), slopes[a], slopes[b]
            if operation == _SUM:
                slopes[i] = by + other
            elif operation == _PRODUCT:
                slopes[i] = by * y + x * other
            elif operation == _POWER:
                slopes[i] = Term(self, i) * (by * y / x + log(x) * other)
            else:
                slopes[i] = by * {
                    _INVERSE: lambda here, x: -here * here,
                    _LOG: lambda _, x: 1.0 / x.positive(),
                    _LOG1P: lambda _, x: 1.0 / (1.0 + x).positive(),
                    _EXP: lambda here, _: here,
                    _EXPM1: lambda here, _: here + 1.0}[operation](Term(self, i), x)
        return self.literal(slopes[of.place])

    def packed(self, energy: 'Term', values: tuple[float, ...]) -> tuple[float, ...]:
        """Return the constants of the family for values of the constants."""
        needed = [self._needed(x.place) for x in (self.slope(energy), energy)]
        provided = range(self.constants, self.constants + _GIVEN)
        moving = set(provided)
        literals, fixed = list[int](), list[int]()
        runs: list[list[int]] = [[], []]
        for i in sorted(needed[0] | needed[1]):
            operation, a, b = self.steps[i]
            if isinstance(a, float):
                literals.append(i)
            elif operation != _LEAF and not moving.isdisjoint((a, b)):
                moving.add(i)
                for run, own in zip(runs, needed, strict=True):
                    run.extend([i] if i in own else ())
            elif operation != _LEAF:
                fixed.append(i)
        known = [*range(self.constants), *literals]
        rows: list[float] = []
        for before, run in (
                (known, fixed), *(([*known, *fixed, *provided], x) for x in runs)):
            places = {x: i for i, x in enumerate([*before, *run])}
            if len(places) > _MOST:
                raise BadInputError(f'energy takes {len(places)} steps: expected {_MOST}')
            for i in run:
                operation, a, b = self.steps[i]
                rows += [float(operation), float(places[a]), float(places[b])]
        return tuple(map(float, (
            len(known), len(fixed), *map(len, runs), *values,
            *(self.steps[i][1] for i in literals), *rows)))

    def _needed(self, place: int) -> set[int]:
        found, open_ = set[int](), [place]
        while open_:
            i = open_.pop()
            if i not in found:
                found.add(i)
                operation, a, b = self.steps[i]
                if operation != _LEAF:
                    open_ += [a, b]
        return found


@dataclass(frozen=True)
class Term:
    """A number that a program computes."""

    program: _Program
    place: int

    @property
    def _known(self) -> float | None:
        operation, value, _ = self.program.steps[self.place]
        return value if operation == _LEAF and isinstance(value, float) else None

    def __add__(self, other: Number) -> 'Term':
        """Add."""
        other = self.program.literal(other)
        if self._known == 0.0 or other._known == 0.0:
            return other if self._known == 0.0 else self
        return self.program.term(_SUM, *sorted((self.place, other.place)))

    def __mul__(self, other: Number) -> 'Term':
        """Multiply."""
        other = self.program.literal(other)
        for one, two in ((self, other), (other, self)):
            if one._known in (0.0, 1.0):
                return one if one._known == 0.0 else two
        return self.program.term(_PRODUCT, *sorted((self.place, other.place)))

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> 'Term':
        """Negate."""
        return self * -1.0

    def __sub__(self, other: Number) -> 'Term':
        """Subtract."""
        return self + -other

    def __rsub__(self, other: Number) -> 'Term':
        """Subtract from a number."""
        return other + -self

    def __truediv__(self, other: Number) -> 'Term':
        """Divide."""
        return self * (other ** -1 if isinstance(other, Term) else 1.0 / other)

    def __rtruediv__(self, other: float) -> 'Term':
        """Divide a number."""
        return other * self ** -1

    def __pow__(self, exponent: Number) -> 'Term':
        """Raise to a power; to one that is not a whole number, of a positive base."""
        if exponent == 0:
            return self.program.literal(1.0)
        if not isinstance(exponent, Term) and exponent == int(exponent) and (
                abs(exponent) <= _SMALL):
            found = self if exponent > 0 else self.program.term(_INVERSE, self.place)
            return math.prod([found] * (abs(int(exponent)) - 1), start=found)
        return self.program.term(_POWER, self.place, self.program.literal(exponent).place)

    def positive(self) -> 'Term':
        """Return this number, NaN unless it is positive."""
        return self.program.term(_POSITIVE, self.place)


@dataclass(frozen=True)
class Strain:
    """Strain of a block of constant volume."""

    first: Term  #: I1 - 3
    second: Term  #: I2 - 3
    along: Term  #: stretch along the field
    across: Term  #: stretch across the field

    def over_stretches(self, part: Callable[[Term], Term]) -> Term:
        """Return the sum of a function over the three principal stretches."""
        return part(self.along) + 2.0 * part(self.across)


def log(x: Term) -> Term:
    """Return the natural logarithm; there is no energy where x is not positive."""
    return x.program.term(_LOG, x.place)


def log1p(x: Term) -> Term:
    """Return the logarithm of 1 + x; there is no energy where this is not positive."""
    return x.program.term(_LOG1P, x.place)


def exp(x: Term) -> Term:
    """Return the exponential."""
    return x.program.term(_EXP, x.place)


def expm1(x: Term) -> Term:
    """Return the exponential less 1."""
    return x.program.term(_EXPM1, x.place)


def law_of(
        name: str, text: str, source: str, constants: tuple[Constant, ...],
        energy: Callable[..., Term]) -> Law:
    """
    Return a model whose energy is a function in Python.

    Parameters
    ----------
    name, text, source : str
        Name of the model, its energy for readers, and the publication.
    constants : tuple of Constant
        Its constants, which are numbers; the energy is proportional to those in Pa.
    energy : callable
        The energy in Pa as a function of the `Strain` and of the constants in their order; 0 at
        rest, where the stretches are 1. It consists of sums, products, quotients, powers, and the
        functions of this module.

    Returns
    -------
    Law
        For `hmsa.model.laws.LAWS`.

    """
    program = _Program(len(constants))
    known, (along, across, first, second, _, _) = (
        program.leaves[:len(constants)], program.leaves[len(constants):])
    total = energy(Strain(first, second, along, across), *known)

    def scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
        import numpy as np  # which not all users of laws need

        from hmsa.motion import elastic_stiffness

        numbers = tuple(float(values[x.name]) for x in constants)
        for constant, value in zip(constants, numbers, strict=True):
            above(name, constant.name, value, constant.above)
        stiffness = elastic_stiffness(1.0, np.array([
            FORMULA, 0.0, 1.0, 0.0, 0.0, math.inf, *program.packed(total, numbers)]))
        # psi'' is 3 at rest, in units of G.
        modulus = positive_modulus(name, stiffness / 3.0, 'of its energy at rest', numbers)
        scales = (modulus if x.unit == 'Pa' else 1.0 for x in constants)
        return modulus, Elastic(name, FORMULA, program.packed(total, tuple(
            x / y for x, y in zip(numbers, scales, strict=True))), given(law, values, modulus))

    law = Law(name, text, source, tuple(
        replace(x, place=i) for i, x in enumerate(constants)), scaled)
    return law
