"""Plans through the lag of a coil: stretch, rate and field arrive together."""

import math

from creep_oracle import follow
import numpy as np
import pytest

from hmsa.model.delivery import Delivery
from hmsa.model.equations import elastic_force
from hmsa.model.moves import Level, Limits, Setpoint, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import sampled
from hmsa.model.status import Code, RefusedError
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest

PAPER = NondimensionalParameters()
LIMITS = Limits(-2.5, 2.5)
# Distance from rest as a share of the move, by an integration of another kind.
AT_REST = 1e-9
MS = 1_000_000
HARDWARE = [{}, {'period': 0.11}, {'period': 0.4}, {'slew': 1.5}, {'slew': 0.4},
            {'period': 0.11, 'slew': 1.5}]


def end_of(move, request):
    """Return the state at the predicted rest of a command, by SciPy."""
    delivery, state = request.delivery, request.state
    return follow(
        [(x.time, x.load) for x in move.levels if x.time < move.duration], [move.duration],
        slew=delivery.slew, lag=delivery.lag, start=(state.stretch, state.rate),
        output=request.load, field=request.field)[-1]


@pytest.mark.parametrize('hardware', HARDWARE, ids=str)
@pytest.mark.parametrize('shaper', ['two_step', 'robust', 'minimum_time'])
def test_stretch_rate_and_field_arrive_together_from_any_state_within_the_limits(
        shaper, hardware):
    random = np.random.default_rng(16)
    for number in range(3):
        start, target = random.uniform(0.75, 1.5, 2)
        held = float(elastic_force(start, PAPER))
        state = (
            State(start, 0.0, held),
            State(start, random.uniform(-0.4, 0.4), held + random.uniform(-0.4, 0.4), held),
            State(start, 0.0, held + random.uniform(-0.3, 0.3), held))[number % 3]
        request = MoveRequest(
            state, target, PAPER, LIMITS,
            Delivery(lag=10.0 ** random.uniform(-3.0, -0.3), **hardware))
        move = get_shaper(shaper)(request)
        stretch, rate, field = end_of(move, request)
        off = max(abs(stretch - target), abs(rate), abs(field - elastic_force(target, PAPER)))
        assert off < AT_REST * max(abs(target - start), 0.02)
        assert request.keeps(move.levels)
        assert move.code is not Code.STEP
        period = hardware.get('period', 0.0)
        for level in move.levels if period else ():
            assert level.time / period == pytest.approx(round(level.time / period), abs=1e-9)


@pytest.mark.parametrize('slew', [math.inf, 1.5])
def test_with_less_and_less_lag_the_plan_becomes_the_one_without(slew):
    plain = get_shaper('two_step')(
        MoveRequest(State(1.0), 1.3, PAPER, delivery=Delivery(slew=slew)))
    for lag in (1e-2, 1e-4, 1e-6):
        move = get_shaper('two_step')(
            MoveRequest(State(1.0), 1.3, PAPER, delivery=Delivery(slew=slew, lag=lag)))
        assert len(move.levels) == 3
        assert move.levels[0].load == pytest.approx(plain.levels[0].load, abs=10.0 * lag)
        assert move.duration == pytest.approx(plain.duration, abs=3.0 * lag)


def test_a_field_that_has_not_settled_is_no_rest():
    held = float(elastic_force(1.2, PAPER))
    shaper = get_shaper('two_step')
    delivery = Delivery(lag=0.1)
    assert shaper(
        MoveRequest(State(1.2, 0.0, held), 1.2, PAPER, delivery=delivery)).code is Code.HOLD
    request = MoveRequest(State(1.2, 0.0, held + 0.1), 1.2, PAPER, LIMITS, delivery)
    stretch, rate, field = end_of(shaper(request), request)
    assert (stretch, rate, field) == pytest.approx((1.2, 0.0, held), abs=1e-10)


def test_limits_that_leave_no_room_to_settle_the_field_are_named():
    held = float(elastic_force(1.3, PAPER))
    with pytest.raises(RefusedError, match='coil time constant.*flux density limits') as refusal:
        get_shaper('two_step')(MoveRequest(
            State(1.0), 1.3, PAPER, Limits(-1.0, held), Delivery(lag=0.1)))
    assert refusal.value.code is Code.FLUX_LIMIT


@pytest.mark.parametrize('slew', [math.inf, 1.5])
def test_predicted_motion_under_a_lag_is_that_of_the_independent_integration(slew):
    delivery = Delivery(slew=slew, lag=0.2)
    segments = plan_sequence(
        [Setpoint(1.2, 0.7), Setpoint(0.9, math.inf)], MoveRequest.of(PAPER, delivery=delivery),
        short_spell='continue')
    request = MoveRequest(segments[1].start, 0.9, PAPER, delivery=delivery)
    assert segments[1].start.load != segments[1].start.amplifier
    assert np.max(np.abs(np.subtract(
        end_of(segments[1].move, request), (0.9, 0.0, elastic_force(0.9, PAPER))))) < 1e-9
    late = sampled(
        [Level(0.0, 1.0)], State(1.0, load=0.0), np.ones(1), PAPER, Delivery(lag=0.2))[0]
    assert late[0] == pytest.approx(follow([(0.0, 1.0)], [1.0], lag=0.2)[-1, 0], abs=1e-10)
