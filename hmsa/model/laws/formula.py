"""
Hyperelastic models that are written once, as an energy in Python.

The energy is a function of the `Strain` and of the constants, as numbers. It is called once, with
terms in place of numbers, which record the operations. Their derivatives give the force. Both are
tapes that the compiled equation of motion runs over its scalars (``Formula`` in
``hmsa/motion/hmsa/law.hpp``), which provide the derivatives by the constants.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
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

# Operations of a tape; the first is none. Two of them also have a form with a constant.
(_LEAF, _SUM, _SUM_FIXED, _PRODUCT, _PRODUCT_FIXED, _INVERSE, _DEFINED, _LOG, _LOG1P, _EXP,
 _EXPM1) = range(11)
# Numbers that the motion provides: stretch along the field and across it, the inverse of the
# first, I1 - 3 and I2 - 3, and the derivatives of these two by the stretch.
_GIVEN = 7
# Registers of the compiled motion, and the factor between operation and registers in a step, which
# is one number.
_MOST, _PART = 96, 128
# Largest power that is a product.
_SMALL = 4

Number = Union['Term', float]


class _Tape:
    """Operations on constants and given numbers, each one once."""

    def __init__(self, constants: int) -> None:
        self.constants = constants
        self.steps: list[tuple[int, Any, Any]] = []
        #: By step (`Term.rank`).
        self.ranks: list[int] = []
        self._places: dict[tuple[int, Any, Any], int] = {}
        self.leaves = [self.term(_LEAF, f'{i}') for i in range(constants + _GIVEN)]
        #: Factor and exponential of the first exponential of a multiple of a term.
        self.exponentials = dict[Term, tuple[float, Term]]()
        self.along, self.across, inverse = self.leaves[constants:constants + 3]
        self.inverses = {
            self.along: inverse, inverse: self.along, self.across: self.along * self.across}

    def term(self, operation: int, a: Any, b: int | None = None) -> 'Term':
        step = (operation, a, a if b is None else b)
        if step not in self._places:
            self._places[step] = len(self.steps)
            self.ranks.append(
                max(1, *(self.ranks[x] for x in step[1:])) if operation != _LEAF
                else 0 if isinstance(a, float) else 1 if int(a) < self.constants else 2)
            self.steps.append(step)
        return Term(self, self._places[step])

    def literal(self, value: Number) -> 'Term':
        return value if isinstance(value, Term) else self.term(_LEAF, float(value))

    def slope(self, of: 'Term') -> 'Term':
        """Return the derivative of a term by the stretch; NaN where the term has no value."""
        along, across, inverse, _, _, by_first, by_second = self.leaves[self.constants:]
        slopes: dict[int, Number] = dict(enumerate(
            (1.0, -0.5 * inverse * across, -(inverse * inverse), by_first, by_second),
            self.constants))
        positive = dict[Term, None]()
        for i in sorted(self._needed(of.place)):
            operation, a, b = self.steps[i]
            if operation == _LEAF:
                slopes.setdefault(i, 0.0)
                continue
            here, x, y, by, other = (
                *(Term(self, j) for j in (i, a, b)), slopes[a], slopes[b])
            if operation == _SUM:
                slopes[i] = by + other
            elif operation == _PRODUCT:
                slopes[i] = by * y + x * other
            elif operation == _INVERSE:
                slopes[i] = by * (-here * here)
            elif operation in (_EXP, _EXPM1):
                slopes[i] = by * exp(x)
            else:
                inside = x if operation == _LOG else 1.0 + x
                slopes[i] = by / inside
                if inside != along and inside.rank == 2:
                    positive[inside] = None
        found = self.literal(slopes[of.place])
        for each in positive:
            found = self.term(_DEFINED, found.place, each.place)
        return found

    def compiled(self, energy: 'Term') -> tuple[list[float], list[float], list[float]]:
        """Return the head, the literals and the steps for the compiled motion."""
        needed = [self._needed(x.place) for x in (self.slope(energy), energy)]
        every = [i for i in sorted(needed[0] | needed[1]) if self.steps[i][0] != _LEAF]
        literals = [i for i in sorted(needed[0] | needed[1]) if self.ranks[i] == 0]
        known = [*range(self.constants), *literals]
        fixed = [i for i in every if self.ranks[i] == 1]
        provided = range(self.constants, self.constants + _GIVEN)
        places = {x: i for i, x in enumerate([*known, *fixed])}
        head, steps = [float(len(known))], list[float]()
        for before, run in ((known, fixed), *(
                (provided, [i for i in every if i in own and self.ranks[i] == 2])
                for own in needed)):
            places |= {x: i for i, x in enumerate([*before, *run])}
            if len(before) + len(run) > _MOST:
                raise BadInputError(
                    f'energy takes {len(before) + len(run)} steps: expected {_MOST}')
            head.append(float(len(run)))
            for i in run:
                operation, a, b = self.steps[i]
                if operation in (_SUM, _PRODUCT) and self.ranks[a] < self.ranks[i] == 2:
                    operation, a, b = operation + 1, b, a
                steps.append(float((operation * _PART + places[b]) * _PART + places[a]))
        return head, [self.steps[i][1] for i in literals], steps

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
    """A number that a tape computes."""

    tape: _Tape
    place: int

    @property
    def known(self) -> float | None:
        """Return its value if it is a literal."""
        value = self.tape.steps[self.place][1]
        return value if self.rank == 0 else None

    @property
    def rank(self) -> int:
        """Return 0 for a literal, 1 for what depends on constants alone, 2 for what moves."""
        return self.tape.ranks[self.place]

    def _with(self, operation: int, other: 'Term', neutral: float) -> 'Term':
        if neutral in (self.known, other.known):
            return other if self.known == neutral else self
        a, b = sorted((self, other), key=lambda x: (x.rank, x.place))
        return self.tape.term(operation, a.place, b.place)

    def factors(self) -> tuple[float, 'Term', 'Term']:
        """Return the literal, the constant and the moving factor."""
        one = self.tape.literal(1.0)
        if self.known is not None:
            return self.known, one, one
        operation, a, b = self.tape.steps[self.place]
        if operation == _PRODUCT and (first := Term(self.tape, a)).rank < self.rank:
            number, fixed, _ = first.factors()
            rest = Term(self.tape, b)
            return (number, fixed, rest) if self.rank == 2 else (number, rest, one)
        return (1.0, one, self) if self.rank == 2 else (1.0, self, one)

    def __add__(self, other: Number) -> 'Term':
        """Add."""
        return self._with(_SUM, self.tape.literal(other), 0.0)

    def __mul__(self, other: Number) -> 'Term':
        """Multiply, literals and constants first."""
        (number, *mine), (by, *its) = self.factors(), self.tape.literal(other).factors()
        found = self.tape.literal(number * by)
        if number * by == 0.0:
            return found
        for x, y in zip(mine, its, strict=True):
            found = found._with(_PRODUCT, x._with(_PRODUCT, y, 1.0), 1.0)
        return found

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
            return self.tape.literal(1.0)
        if not isinstance(exponent, Term) and exponent == int(exponent) and (
                abs(exponent) <= _SMALL):
            found = self if exponent > 0 else self._inverse()
            return math.prod([found] * (abs(int(exponent)) - 1), start=found)
        return exp(exponent * log(self))

    def _inverse(self) -> 'Term':
        return self.tape.inverses.get(self) or self.tape.term(_INVERSE, self.place)


@dataclass(frozen=True)
class Strain:
    """Strain of a block of constant volume."""

    first: Term  #: I1 - 3
    second: Term  #: I2 - 3
    along: Term  #: stretch along the field
    across: Term  #: stretch across the field

    def over_stretches(self, part: Callable[[Term], Term]) -> Term:
        """Return the sum of a function over the three principal stretches."""
        # An exponential along the field is a power of that across it, but not the reverse.
        return 2.0 * part(self.across) + part(self.along)


def log(x: Term) -> Term:
    """Return the natural logarithm; there is no energy where x is not positive."""
    if x == x.tape.across:
        return -0.5 * log(x.tape.along)
    return x.tape.term(_LOG, x.place)


def log1p(x: Term) -> Term:
    """Return the logarithm of 1 + x; there is no energy where this is not positive."""
    return x.tape.term(_LOG1P, x.place)


def exp(x: Term) -> Term:
    """Return the exponential, as a power of one of the same term if there is one."""
    if x.known is not None:
        return x.tape.literal(math.exp(x.known))
    number, fixed, moving = x.factors()
    by, first = x.tape.exponentials.setdefault(
        fixed * moving, (number, x.tape.term(_EXP, x.place)))
    times = number / by
    return first ** times if times == int(times) and abs(times) <= _SMALL else (
        x.tape.term(_EXP, x.place))


def expm1(x: Term) -> Term:
    """Return the exponential less 1."""
    return x.tape.term(_EXPM1, x.place)


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
    tape = _Tape(len(constants))
    known, (along, across, _, first, second, _, _) = (
        tape.leaves[:len(constants)], tape.leaves[len(constants):])
    total = energy(Strain(first, second, along, across), *known)

    @cache
    def compiled() -> tuple[list[float], list[float], list[float]]:
        return tape.compiled(total)

    def packed(numbers: tuple[float, ...]) -> tuple[float, ...]:
        head, literals, steps = compiled()
        return (*head, *numbers, *literals, *steps)

    def scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
        import numpy as np  # which not all users of laws need

        from hmsa.motion import elastic_stiffness

        numbers = tuple(float(values[x.name]) for x in constants)
        for constant, value in zip(constants, numbers, strict=True):
            above(name, constant.name, value, constant.above)
        stiffness = elastic_stiffness(1.0, np.array([
            FORMULA, 0.0, 1.0, 0.0, 0.0, math.inf, *packed(numbers)]))
        # psi'' is 3 at rest, in units of G.
        modulus = positive_modulus(name, stiffness / 3.0, 'of its energy at rest', numbers)
        scales = (modulus if x.unit == 'Pa' else 1.0 for x in constants)
        return modulus, Elastic(name, FORMULA, packed(tuple(
            x / y for x, y in zip(numbers, scales, strict=True))), given(law, values, modulus))

    law = Law(name, text, source, tuple(
        replace(x, place=i) for i, x in enumerate(constants)), scaled)
    return law
