"""Secondary modes of an actuator that is a continuum: oscillators beside the first mode."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any

from hmsa.errors import BadInputError

#: Ways to hold an actuator, of which the first is the paper's: it has no secondary modes. The last
#: is that of a beam, the others those of a block.
MOUNTS = ('paper', 'free', 'glued', 'clamped')
#: Maximum number of secondary modes.
MOST = 3
#: Damping ratio from which a mode hardly rings. All weak modes of a continuum together are one of
#: these: predictions of a two-step command are then within a fifth of finite elements, and without
#: it 0.65 to 0.8 of them (benchmarks continuum).
BROAD = 0.6
# Numbers in place of a flow rule, in the rows of position and rate of a mode.
_POSITION, _RATE = -1.0, -2.0
# Maximum ratio to the frequency of the first mode: faster ones vibrate below what steps excite.
_FASTEST = 100.0
# Largest exponents of the stretch in ratios and shares.
_STEEPEST, _MOST_GRADED = 5.0, 10.0


@dataclass(frozen=True)
class Modes:
    """
    Up to three secondary modes, which vibrate beside the first.

    The stretch is the sum of s_i z_i over all modes, with shares s_i that add up to 1. The first
    mode obeys the equation of motion. Each other one is an oscillator about the same rest,
    z'' + 2 d w z' + w^2 (z - z_1 - f/k) = 0. There, f is the load less the elastic force at the
    position z_1 of the first mode, k the stiffness there, and w the natural frequency of small
    motion about it times a ratio, which may grow with a power of z_1, as may the ratio of the
    share to that of the first mode. At rest, all z_i equal the stretch.
    """

    ratios: tuple[float, ...] = ()  #: of frequency to that of the first mode, above 1 to 100
    shares: tuple[float, ...] = ()  #: of the static stretch; negative for a mode in antiphase
    dampings: tuple[float, ...] = ()  #: damping ratios, at least 0 and below 1
    #: Exponents of the stretch in the ratios, -5 to 5; empty for 0.
    exponents: tuple[float, ...] = ()
    #: Exponents of the stretch in shares relative to that of the first, -10 to 10; empty for 0.
    share_exponents: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check the values."""
        named = {
            'frequency_ratio': self.ratios, 'share': self.shares, 'damping_ratio': self.dampings}
        named |= {x: y for x, y in (
            ('ratio_exponent', self.exponents), ('share_exponent', self.share_exponents)) if y}
        counts = {len(x) for x in named.values()}
        if len(counts) > 1:
            raise BadInputError(
                ', '.join(f'modes.{x} has {len(y)}' for x, y in named.items())
                + ' values: expected one of each for every secondary mode')
        if len(self.ratios) > MOST:
            raise BadInputError(
                f'modes.frequency_ratio has {len(self.ratios)} values: expected at most {MOST} '
                'secondary modes')
        for name, holds, expected in (
                ('frequency_ratio', lambda x: 1.0 < x <= _FASTEST,
                 f'numbers above 1, up to {_FASTEST:g}'),
                ('share', lambda x: -1.0 < x < 1.0, 'numbers between -1 and 1'),
                ('damping_ratio', lambda x: 0.0 <= x < 1.0, 'numbers from 0 to below 1'),
                ('ratio_exponent', lambda x: abs(x) <= _STEEPEST,
                 f'numbers from {-_STEEPEST:g} to {_STEEPEST:g}'),
                ('share_exponent', lambda x: abs(x) <= _MOST_GRADED,
                 f'numbers from {-_MOST_GRADED:g} to {_MOST_GRADED:g}')):
            for value in named.get(name, ()):
                if not holds(value):
                    raise BadInputError(f'modes.{name} has {value:g}: expected {expected}')
        if any(self.share_exponents) and not sum(map(abs, self.shares)) < 1.0:
            raise BadInputError(
                f'magnitudes of modes.share add up to {sum(map(abs, self.shares)):g}: expected '
                'less than 1 with modes.share_exponent')
        if not self.first > 0.0:
            raise BadInputError(
                f'modes.share adds up to {sum(self.shares):g}: expected less than 1, as the first '
                'mode has the rest')

    @property
    def first(self) -> float:
        """Share of the first mode."""
        return 1.0 - sum(self.shares)

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters that describe the modes; none without secondary modes."""
        return {
            'modes.frequency_ratio': list(self.ratios), 'modes.share': list(self.shares),
            'modes.damping_ratio': list(self.dampings),
            'modes.ratio_exponent': list(self.exponents),
            'modes.share_exponent': list(self.share_exponents)} if self.ratios else {}

    @property
    def numbers(self) -> list[tuple[float, ...]]:
        """Ratio, share, damping ratio and exponents of ratio and share of each mode."""
        none = (0.0,) * len(self.ratios)
        return [*zip(
            self.ratios, self.shares, self.dampings, self.exponents or none,
            self.share_exponents or none, strict=True)]

    @classmethod
    def of_numbers(cls, rows: Sequence[Sequence[float]]) -> 'Modes':
        """Return the modes with such numbers, the inverse of `numbers`."""
        if not rows:
            return cls()
        ratios, shares, dampings, *exponents = (tuple(x) for x in zip(*rows, strict=True))
        return cls(ratios, shares, dampings, *(x if any(x) else () for x in exponents))

    def at(self, stretch: float) -> tuple[float, ...]:
        """Return the shares of all modes in small motion about a stretch, from the first on."""
        if not any(self.share_exponents):
            return (self.first, *self.shares)
        grown, total = self._grown(stretch)
        shares = tuple(float(x / total) for x in grown)
        return (1.0 - sum(shares), *shares)

    def _grown(self, stretch: Any) -> tuple[list[Any], Any]:
        """Return shares relative to a sum at a stretch, and this sum."""
        grown = [x * stretch ** y for x, y in zip(
            self.shares, self.share_exponents, strict=True)]
        return grown, 1.0 + sum(map(abs, grown)) - sum(map(abs, self.shares))

    def _graded(self, stretch: Any) -> tuple[list[Any], Any, Any]:
        """Return shares relative to a sum at a stretch, this sum, and its relative slope."""
        grown, total = self._grown(stretch)
        return grown, total, sum(abs(x) * y for x, y in zip(
            grown, self.share_exponents, strict=True)) / (stretch * total)

    def observed(self, stretch: Any, rate: Any, others: Sequence[Any]) -> tuple[Any, Any]:
        """
        Return position and rate of all modes together, numbers or arrays of one shape.

        Those of the first mode come first, then positions and rates of the others in turns.
        """
        positions, rates = others[::2], others[1::2]
        if not any(self.share_exponents):
            seen, speed = (self.first * x + sum(
                z * w for z, w in zip(self.shares, y, strict=True))
                for x, y in ((stretch, positions), (rate, rates)))
            return seen, speed
        grown, total, slope = self._graded(stretch)
        seen, speed = stretch, rate
        for here, exponent, z, v in zip(
                grown, self.share_exponents, positions, rates, strict=True):
            share, beside = here / total, z - stretch
            seen = seen + share * beside
            speed = speed + share * (v - rate + (exponent / stretch - slope) * rate * beside)
        return seen, speed

    def rows(self) -> list[list[float]]:
        """Return two rows for each mode as arguments of `hmsa.motion`, with a state of 0."""
        return [
            [share, ratio, kind, damping, exponent, 0.0]
            for ratio, share, damping, exponent, _ in self.numbers
            for kind in (_POSITION, _RATE)]

    @cached_property
    def ringing(self) -> tuple[int, ...]:
        """Indices of the modes that ring, with a damping ratio below `BROAD`."""
        return tuple(i for i, x in enumerate(self.dampings) if x < BROAD)

    def slowest_decay(self) -> float:
        """Return the slowest decay rate, in units of the natural frequency of the first mode."""
        return min(
            (x * y for x, y in zip(self.ratios, self.dampings, strict=True)), default=math.inf)
