"""The fastest command found within the load limits."""

from dataclasses import replace
import math

from hmsa.model.moves import Move
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.push_brake import push_brake
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.shapers.shooting import free_levels
from hmsa.planning.shapers.two_step import two_step

# Work limit of the search for full push and full brake.
_PUSHING = 400_000


def minimum_time(request: MoveRequest) -> Move:
    """
    Push with the load limit on one side, brake with the other, then hold.

    With ramps that do not reach the limits, reverse earlier. On a command grid, with ramps or
    with a field that lags, the two-step command can be at rest earlier, or be the only one within
    the limits; it is then used, and the move's reason reports it. Raise `RefusedError` if none is
    found.
    """
    found: list[Move] = []
    refusals: list[RefusedError] = []
    # Separate work limits ensure that two_step finds here all that it finds alone.
    pushing = request.work.more(_PUSHING)
    shapers = [(push_brake, pushing), (two_step, request.work)]
    if request.delivery.period == 0.0 and request.delivery.slew < math.inf:
        shapers.append((free_levels, pushing))
    for shaper, work in shapers:
        try:
            found.append(shaper(replace(request, work=work)))
        except RefusedError as error:
            refusals.append(error)
    if not found:
        raise refusals[0]
    fastest = min(found, key=lambda x: x.duration)
    if fastest.code is Code.TWO_STEP:
        return fastest._replace(reason=(
            'no full push and full brake within the limits are found that are sooner at rest at '
            f'{request.target:g} than the two-step command, which is used'))
    if refusals and math.isinf(fastest.duration):
        return fastest._replace(
            reason=f'{refusals[0]}: the unshaped step approaches without overshoot')
    return fastest
