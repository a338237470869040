"""
High-precision reference solutions, sharing no code with the package.

Eq. 11 is integrated by its Taylor series in decimal arithmetic of 40 digits, using only the
standard library. Products and quotients of series follow from their recurrences, so the cost of a
step is quadratic in the order; at this precision few steps are needed.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import decimal
from decimal import Decimal

_DIGITS = 40
_ORDER = 36
_SMALL = Decimal('1e-32')

Series = list[Decimal]


@dataclass(frozen=True)
class Actuator:
    """Damping, J_lim and shape of Eq. 11; floats are taken at their exact binary values."""

    zeta: float = 0.2
    j_lim: float = 5.0
    c1: float = 2.0


def _product(a: Series, b: Series, n: int) -> Decimal:
    """Return coefficient n of a product of series."""
    return sum((a[k] * b[n - k] for k in range(n + 1)), Decimal(0))


def _quotient(numerator: Decimal, q: Series, denominator: Series, n: int) -> Decimal:
    """Return coefficient n of a quotient q, whose lower coefficients are known."""
    known = sum((q[k] * denominator[n - k] for k in range(n)), Decimal(0))
    return (numerator - known) / denominator[0]


def _expand(l0: Decimal, v0: Decimal, beta: Decimal, actuator: Actuator) -> tuple[Series, Series]:
    """Return the Taylor series in time of stretch and rate under a constant load."""
    zeta, j_lim, c1 = (Decimal(x) for x in (actuator.zeta, actuator.j_lim, actuator.c1))
    # Series of l, l', l^2, l^3, 1 + c1 l^3, l g, l^5 - l^2, (l^4 - l)/g and l'^2/l.
    stretch, rate = [l0], [v0]
    square: Series = []
    cube: Series = []
    inertia: Series = []
    room: Series = []
    lift: Series = []
    elastic: Series = []
    drift: Series = []
    bent: Series = []
    one = Decimal(1)
    for n in range(_ORDER):
        first = one if n == 0 else Decimal(0)
        square.append(_product(stretch, stretch, n))
        cube.append(_product(square, stretch, n))
        inertia.append(first + c1 * cube[n])
        room.append(stretch[n] - (cube[n] - 3 * stretch[n] + 2 * first) / j_lim)
        lift.append(_product(square, cube, n) - square[n])
        elastic.append(_quotient(lift[n], elastic, room, n))
        drift.append(_quotient(_product(rate, rate, n), drift, stretch, n))
        force = (Decimal('1.5') * drift[n] - 3 * zeta * c1 * _product(cube, rate, n)
                 - 6 * (elastic[n] - beta * cube[n]))
        bent.append(_quotient(force, bent, inertia, n))
        stretch.append(rate[n] / (n + 1))
        rate.append(bent[n] / (n + 1))
    return stretch, rate


def _value(series: Series, t: Decimal) -> Decimal:
    total = Decimal(0)
    for coefficient in reversed(series):
        total = total * t + coefficient
    return total


def _slope(series: Series, t: Decimal) -> Decimal:
    return _value([n * x for n, x in enumerate(series)][1:], t)


def _reach(stretch: Series, rate: Series) -> Decimal:
    """Return the time for which the last terms of both series stay below the precision."""
    lengths = []
    for series in (stretch, rate):
        for n in (len(series) - 2, len(series) - 1):
            if series[n] != 0:
                lengths.append((_SMALL / abs(series[n])) ** (Decimal(1) / n))
    return min(lengths, default=Decimal(1))


def _turn(l0: Decimal, beta: Decimal, actuator: Actuator) -> tuple[Decimal, Decimal]:
    """Return time and stretch of the first turning point from rest."""
    stretch, rate = l0, Decimal(0)
    time = Decimal(0)
    direction = 0
    for _ in range(200):
        series = _expand(stretch, rate, beta, actuator)
        step = _reach(*series)
        stretch, end = _value(series[0], step), _value(series[1], step)
        direction = direction or (1 if end > 0 else -1)
        if direction * end <= 0:
            break
        rate = end
        time += step
    else:
        raise ArithmeticError(f'no turning point under the load {beta}')
    low, high = Decimal(0), step
    if rate == 0:
        # The first step spans the whole swing: avoid the rest it starts from.
        low = step / 4
    root = high
    for _ in range(200):
        value = _value(series[1], root)
        if direction * value > 0:
            low = root
        else:
            high = root
        new = root - value / _slope(series[1], root)
        new = new if low < new < high else (low + high) / 2
        if abs(new - root) < _SMALL:
            break
        root = new
    return time + root, _value(series[0], root)


@contextmanager
def _precise() -> Iterator[None]:
    with decimal.localcontext() as context:
        context.prec = _DIGITS
        yield


def _holding_load(stretch: Decimal, j_lim: Decimal) -> Decimal:
    return (stretch - stretch ** -2) / (1 - (2 / stretch + stretch ** 2 - 3) / j_lim)


def two_step(start: float, target: float, actuator: Actuator) -> tuple[Decimal, Decimal]:
    """Solve Eq. 13 for one move from rest by the secant method, to about 28 digits."""
    with _precise():
        l0, l1, j_lim = Decimal(start), Decimal(target), Decimal(actuator.j_lim)
        low, high = _holding_load(l0, j_lim), _holding_load(l1, j_lim)
        # Without damping, the work of the load equals the change of elastic energy.
        energy = [-j_lim / 2 * (1 - (2 / x + x * x - 3) / j_lim).ln() for x in (l0, l1)]
        old = (energy[1] - energy[0]) / (l1 - l0)
        new = old + (high - old) / 10
        miss = _turn(l0, old, actuator)[1] - l1
        for _ in range(60):
            time, stretch = _turn(l0, new, actuator)
            if abs(stretch - l1) < 100 * _SMALL:
                return new, time
            slope = (stretch - l1 - miss) / (new - old)
            old, miss = new, stretch - l1
            new -= miss / slope
            if not min(low, high) < new < max(low, high):
                new = (old + high) / 2
        raise ArithmeticError(f'no solution found for the move {start} to {target}')


def response(
        switches: Sequence[float], loads: Sequence[float], times: Iterable[float],
        start: float, actuator: Actuator) -> list[Decimal]:
    """Sample the response from rest to a piecewise constant load."""
    with _precise():
        samples = []
        here, rate, now = Decimal(start), Decimal(0), Decimal(switches[0])
        ends = [Decimal(x) for x in switches[1:]] + [Decimal('Infinity')]
        piece = 0
        series = None
        for time in (Decimal(x) for x in times):
            while now < time:
                if now == ends[piece]:
                    piece += 1
                    series = None
                if series is None:
                    origin, series = now, _expand(here, rate, Decimal(loads[piece]), actuator)
                    reach = origin + _reach(*series)
                now = min(time, ends[piece], reach)
                here, rate = (_value(x, now - origin) for x in series)
                if now == reach:
                    series = None
            samples.append(here)
        return samples
