"""
Rest of the first mode and of all secondary modes, for actuators that are continua.

A move has two free levels for the first mode and two more for each secondary one, and further ones
on real hardware as in `free`. They have equal durations. A command that is as short as possible
would excite the modes that no model contains: by default it takes two half periods of the first
mode.
"""

from collections.abc import Iterator
import math

from hmsa.model import law
from hmsa.model.moves import Level, Move
from hmsa.model.simulation import followed_by
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.free import at_rest
from hmsa.planning.shapers.request import AT_REST, MoveRequest
from hmsa.planning.shapers.two_step import two_step
from hmsa.planning.shooting import Attempt, heights, solve, within_limits

# Durations to try, in units of the wanted one: near solutions that swing back and forth there are
# others without (benchmarks continuum).
_LENGTHS = (1.0, 1.06, 0.94, 1.14, 1.25, 1.4, 1.6, 2.0)
# Largest load beyond those of start and end, in units of the largest change that the motion needs.
_BEYOND = 0.3


def modal(request: MoveRequest) -> Move:
    """
    Come to rest with all modes, in ``request.order`` half periods of the first mode.

    Without secondary modes, the two-step command does so, and is returned. Raise `RefusedError` if
    no such command keeps the limits.
    """
    if not request.material.modes:
        return two_step(request)
    holding = request.holding_load()
    if at_rest(request) and _modes_rest(request):
        return Move(Code.HOLD, (Level(0.0, holding),), 0.0)
    reach = _BEYOND * _largest_change(request, holding)
    limits = min(request.load, holding) - reach, max(request.load, holding) + reach
    widest: Attempt = None
    for found in _solutions(request, holding):
        loads = [x.load for x in found[0]]
        if limits[0] <= min(loads) and max(loads) <= limits[1]:
            return Move(Code.MODAL, *found)
        widest = widest or found
    if widest is None:
        raise RefusedError(
            Code.NO_TWO_STEP if request.delivery.period > 0.0 else Code.FLUX_LIMIT,
            f'no levels within the limits bring all modes to rest at {request.named_target}: '
            'expected wider limits, a smaller move, or another shaper')
    return Move(Code.MODAL, *widest)


def _modes_rest(request: MoveRequest) -> bool:
    """Return whether the secondary modes are at rest at the target."""
    material = request.material
    states = followed_by(request.state, material)[len(material.branches):]
    return all(abs(x - request.target) <= AT_REST for x in states[::2]) and all(
        abs(x) <= AT_REST * request.frequency for x in states[1::2])


def _largest_change(request: MoveRequest, holding: float) -> float:
    """Return the largest change of load of the move, or the amplitude of the present motion."""
    state, packed = request.state, request.material.packed
    force = float(law.elastic_force(state.stretch, packed))
    stiffness = float(law.elastic_stiffness(state.stretch, packed))
    return max(
        abs(holding - request.load), abs(holding - force), abs(request.load - force),
        abs(state.rate) * stiffness / request.frequency)


def _solutions(request: MoveRequest, holding: float) -> Iterator[tuple[tuple[Level, ...], float]]:
    """Yield commands that end at rest within the limits."""
    delivery = request.delivery
    count = request.unknowns + 2 * len(request.material.modes.ratios)
    whole = request.order * math.pi / request.frequency
    hardware, before = delivery.lag + delivery.ramp(holding - request.load), 0.0
    for length in _LENGTHS:
        each = (length * whole + hardware) / count
        if delivery.period > 0.0:
            each = math.ceil(each / delivery.period - 1e-9) * delivery.period
        each = delivery.rounded(each)
        if each == before:
            continue
        before = each
        # From the present load to the last one as a raised cosine.
        guess = [
            Level(i * each, request.load + (holding - request.load) * 0.5 * (
                1.0 - math.cos(math.pi * (i + 1) / (count + 1)))) for i in range(count)]
        found = within_limits(solve(
            heights([*guess, Level(count * each, holding)]), request, modes=True), request)
        if found is not None:
            yield found
