"""Advice after a failed search: relaxed limits for which a command exists."""

from collections.abc import Sequence
from dataclasses import replace
from functools import wraps
from itertools import combinations
import math

from hmsa.model.moves import Limits, Move
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.request import MoveRequest, Shaper, StepBudget

# Codes of refusals that may be due to a limit.
_SEARCHED = (Code.FLUX_LIMIT, Code.SLEW_LIMIT, Code.NO_TWO_STEP, Code.NOT_CONVERGED)
# Codes by the limiting quantity; those most often set wrongly come first.
_CODES = {'flux': Code.FLUX_LIMIT, 'slew': Code.SLEW_LIMIT, 'period': Code.NO_TWO_STEP,
          'lag': Code.NO_TWO_STEP}
# Work limit of the search for advice.
_ADVISING = 400_000
# Factors by which limits are relaxed.
_FACTORS = (1.5, 3.0, 10.0, 30.0, math.inf)


def advised(
        shaper: Shaper, factors: Sequence[float] = _FACTORS,
        sooner: Shaper | None = None) -> Shaper:
    """
    Return a shaper whose refusals name the relaxed limits for which it finds a command.

    ``sooner`` is a faster shaper for this search that succeeds for the same requests.
    """
    asked = sooner or shaper

    @wraps(shaper)
    def shape(request: MoveRequest) -> Move:
        try:
            return shaper(request)
        except RefusedError as error:
            there = replace(request, work=StepBudget(_ADVISING, advising=True))
            ways = _ways(asked, there) if error.code in _SEARCHED else []
            what, _, advice = str(error).partition(': expected ')
            if not ways or (advice and ways == [('flux',)] and error.code is Code.FLUX_LIMIT):
                raise
            raise RefusedError(
                _CODES[ways[0][0]],
                f'{what}: expected ' + ', or '.join(
                    _advice(asked, there, x, factors) for x in ways)) from error
    return shape


def _ways(shaper: Shaper, request: MoveRequest) -> list[tuple[str, ...]]:
    """Return the smallest sets of limits whose removal makes a command possible."""
    delivery, limits = request.delivery, request.limits
    there = [name for name, limited in (
        ('flux', limits != Limits()), ('slew', delivery.slew < math.inf),
        ('period', delivery.period > 0.0), ('lag', delivery.lag > 0.0)) if limited]
    for count in range(1, len(there) + 1):
        ways = [x for x in combinations(there, count)
                if _succeeds(shaper, eased(request, x, math.inf))]
        if ways:
            return ways
    return []


def _advice(
        shaper: Shaper, request: MoveRequest, names: Sequence[str],
        factors: Sequence[float]) -> str:
    """Return relaxed values of some limits for which a command exists, as text."""
    factor = next(x for x in factors if x == math.inf or _succeeds(
        shaper, eased(request, names, x)))
    there, units = eased(request, names, factor), request.units
    limits, delivery = there.limits, there.delivery
    words = {
        'flux': 'flux density limits of ' + ' to '.join(
            map(units.load_text, (limits.minimum, limits.maximum))),
        'slew': f'a slew limit of {units.slew_text(delivery.slew)}',
        'period': f'a command period of {units.time_text(delivery.period)}',
        'lag': f'a coil time constant of {units.time_text(delivery.lag)}'}
    if factor == math.inf:
        words |= {'flux': 'no flux density limits', 'slew': 'no slew limit'}
    return ' and '.join(words[x] for x in names)


def eased(request: MoveRequest, names: Sequence[str], factor: float) -> MoveRequest:
    """Return a request with limits (flux, slew, period, lag) relaxed by a factor, or removed."""
    delivery, limits = request.delivery, request.limits
    if 'flux' in names:
        width = limits.maximum - limits.minimum
        more = (factor - 1.0) * (width if width < math.inf else max(
            abs(x) for x in (limits.minimum, limits.maximum) if math.isfinite(x)))
        limits = Limits(limits.minimum - more, limits.maximum + more)
    return replace(request, limits=limits, delivery=replace(
        delivery, slew=delivery.slew * (factor if 'slew' in names else 1.0),
        period=delivery.period / (factor if 'period' in names else 1.0),
        lag=delivery.lag / (factor if 'lag' in names else 1.0)))


def _succeeds(shaper: Shaper, request: MoveRequest) -> bool:
    try:
        shaper(request)
    except RefusedError:
        return False
    return True
