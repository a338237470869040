"""The shaper smooth, judged by SciPy's integration of the equation of motion."""

from dataclasses import replace
from itertools import pairwise
import json
import math

from creep_oracle import elastic, follow, yeoh
import numpy as np
import pytest

from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.model.creep import Creep
from hmsa.model.delivery import Delivery
from hmsa.model.laws.record import Elastic, OGDEN, POLYNOMIAL
from hmsa.model.moves import Limits, Setpoint, State
from hmsa.model.parameters import NondimensionalParameters, paper_actuator
from hmsa.model.status import Code, RefusedError
from hmsa.planning.planner import Options, Planner
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest, SmoothLimits

MS = 1_000_000
ZETA, C1 = 0.2, 2.0
PAPER = NondimensionalParameters(ZETA, 5.0, C1)
WIDE = Limits(-30.0, 30.0)
# Distance from rest, as a share of the move.
AT_REST = 1e-9


def ogden(x):
    """Return psi' and psi'' for mu = 2 and alpha = 1."""
    return 2.0 * (1.0 - x ** -1.5), 3.0 * x ** -2.5


YEOH = replace(PAPER, law=Elastic('yeoh', POLYNOMIAL, (0.0, 0.5, -0.02, 0.004, 0.0, 0.0), ()))
OGDEN_1 = replace(PAPER, law=Elastic('ogden', OGDEN, (1.0, 2.0, 1.0), ()))


def judged(levels, state, end, law=elastic, slew=math.inf, lag=0.0, creep=None):
    """Return times and states of SciPy under levels (time, load) from a state."""
    times = np.unique([x for (begin, _), (until, _) in pairwise([*levels, (end, 0.0)])
                       for x in np.linspace(begin, until, 9 + int(6.0 * (until - begin)))])
    start = law(state.stretch)[0] if math.isnan(state.load) else state.load
    return times, follow(
        levels, times, creep, slew, lag, law=law, start=(state.stretch, state.rate),
        output=start if state.amplifier is None else state.amplifier, field=start)


def left(move, request, law=elastic):
    """Return the deviation from rest after a move, and its states."""
    end = max(move.duration, move.levels[-1].time)
    _, path = judged(
        [(x.time, x.load) for x in move.levels], request.state, end + 1e-6, law,
        request.delivery.slew, request.delivery.lag)
    held = move.levels[-1].load
    _, after = judged([(0.0, held)], State(*path[-1, :2].tolist(), held), 2.0 * math.pi, law)
    step = abs(request.target - request.state.stretch) or 0.1
    return np.max(np.abs(after[:, 0] - request.target)) / step, path


@pytest.mark.parametrize(('material', 'force'), [(PAPER, elastic), (YEOH, yeoh), (OGDEN_1, ogden)])
@pytest.mark.parametrize(('state', 'target', 'delivery'), [
    (State(1.0), 1.4, Delivery()),
    (State(1.0), 0.6, Delivery(0.27)),
    (State(1.2, 0.4, 0.8), 1.4, Delivery(slew=3.0)),
    (State(1.2, -0.4, 0.8, 0.5), 0.9, Delivery(0.1, lag=0.115)),
    (State(1.0), 1.3, Delivery(slew=1.0, lag=0.115)),
    (State(1.0), 0.6, Delivery(0.13, slew=0.06))], ids=[
        'any time', 'grid', 'ramps, moving', 'grid and lag, moving', 'ramps and lag',
        'grid and slow ramps'])
def test_the_block_is_at_rest_after_a_move_without_a_step_of_the_level(
        state, target, delivery, material, force):
    request = MoveRequest(state, target, material, WIDE, delivery)
    move = get_shaper('smooth')(request)
    assert move.code is Code.SMOOTH
    assert left(move, request, force)[0] < AT_REST
    loads = [request.load, *(x.load for x in move.levels)]
    times = [x.time for x in move.levels]
    # No change is more than the largest of a smooth path of as many levels.
    assert np.max(np.abs(np.diff(loads))) < 6.0 * np.ptp(loads) / len(times)
    if delivery.period:
        periods = np.array(times) / delivery.period
        assert periods == pytest.approx(np.round(periods), abs=1e-9)


def test_a_move_takes_the_shortest_time_that_its_limits_allow():
    free = get_shaper('smooth')(MoveRequest(State(1.0), 1.4, PAPER, WIDE, pace=SmoothLimits(0.3)))
    for limits, delivery, pace in (
            (Limits(-0.1, 1.1), Delivery(), SmoothLimits(0.3)),
            (WIDE, Delivery(slew=0.5), SmoothLimits(0.3)),
            (WIDE, Delivery(), SmoothLimits(0.3, rate=0.2))):
        request = MoveRequest(State(1.0), 1.4, PAPER, limits, delivery, pace=pace)
        move = get_shaper('smooth')(request)
        rest, path = left(move, request)
        assert rest < AT_REST
        assert move.duration > 1.2 * free.duration
        loads = np.array([x.load for x in move.levels])
        assert limits.minimum <= loads.min()
        assert loads.max() <= limits.maximum
        rates = np.diff(loads) / np.diff([x.time for x in move.levels])
        # One of the limits is nearly reached, none is passed.
        assert np.max(np.abs(path[:, 1])) < 1.02 * pace.rate
        assert max(loads.max() / limits.maximum, np.max(np.abs(rates)) / delivery.slew,
                   np.max(np.abs(path[:, 1])) / pace.rate) > 0.9


def test_a_slower_move_forgives_more():
    shares = []
    for periods in (0.5, 1.0, 2.0):
        request = MoveRequest(State(1.0), 1.4, PAPER, pace=SmoothLimits(periods))
        move = get_shaper('smooth')(request)
        times, states = judged(
            [(x.time, x.load) for x in move.levels], State(1.0), move.duration + 7.0,
            lambda x: (1.1 * elastic(x)[0], 0.0))
        shares.append(np.ptp(states[times > move.duration, 0]) / 0.4)
    assert shares[0] > 0.05
    assert shares[1] < 0.8 * shares[0]
    assert shares[2] < 0.01


@pytest.mark.parametrize('delivery', [Delivery(), Delivery(0.1, slew=3.0), Delivery(lag=0.1)])
def test_a_move_may_be_as_small_as_rounding(delivery):
    for away in (1e-4, 1e-8):
        request = MoveRequest(State(1.4 + away), 1.4, PAPER, WIDE, delivery)
        move = get_shaper('smooth')(request)
        assert left(move, request)[0] < 1e-3


def test_what_cannot_be_had_is_refused_with_the_limits():
    # Ramps of so little would take thousands of periods.
    with pytest.raises(RefusedError, match='ramps of') as error:
        get_shaper('smooth')(MoveRequest(State(1.0), 1.4, PAPER, WIDE, Delivery(slew=1e-4)))
    assert error.value.code is Code.SLEW_LIMIT
    with pytest.raises(BadInputError, match='smooth_periods is 0'):
        SmoothLimits(0.0)
    with pytest.raises(BadInputError, match='stretch_rate_max'):
        SmoothLimits(rate=-1.0)
    assert get_shaper('smooth')(MoveRequest(State(1.4), 1.4, PAPER)).code is Code.HOLD


@pytest.mark.parametrize('delivery', [Delivery(), Delivery(slew=3.0), Delivery(0.1, slew=3.0)])
def test_a_creeping_block_is_moved_smoothly_and_held_after(delivery):
    creep = Creep((0.1, 0.2), (0.4, 3.0))
    segments = plan_sequence(
        [Setpoint(1.4, 4.0), Setpoint(1.1, math.inf)],
        MoveRequest.of(replace(PAPER, creep=creep), delivery=delivery), shaper='smooth')
    end = segments[1].begin + 12.0
    levels = [(x.begin + y.time, y.load) for x in segments for y in x.move.levels]
    times, states = judged(
        [x for x in levels if x[0] < end], State(1.0), end, slew=delivery.slew, creep=creep)
    for segment, until in zip(segments, (4.0, end), strict=True):
        assert segment.move.code is Code.SMOOTH
        here = states[(times >= segment.begin + segment.move.duration) & (times <= until), 0]
        step = abs(segment.setpoint.stretch - segment.start.stretch)
        assert np.max(np.abs(here - segment.setpoint.stretch)) < segment.move.vibration
        assert segment.move.vibration < 1e-3 * step


def test_the_planner_goes_on_smoothly_from_a_move_and_stops_so():
    planner = Planner(paper_actuator(), Options(
        lead_time=0, period=MS // 2, shaper='smooth', flux_density_min=-0.5,
        flux_density_max=0.5))
    levels = []
    for now, ask in ((0, 1.4), (5 * MS, 1.2), (24 * MS, 1.5), (30 * MS, None)):
        levels = [x for x in levels if x.stamp < now]
        plan = planner.stop(now) if ask is None else planner.setpoint(ask, now)
        levels += [x for x in plan.ahead(now) if x.stamp >= now]
    stop = plan.segments[-1]
    assert stop.code is Code.SMOOTH
    assert 1.2 < stop.stretch < 1.5
    block = paper_actuator()
    loads = np.array([x.flux_density for x in levels]) / block.flux_density_unit
    times = np.array([x.stamp for x in levels]) / 1e9 / block.time_unit
    assert np.max(np.abs(np.diff([0.0, *loads]))) < 0.25
    end = stop.arrival / 1e9 / block.time_unit
    found, states = judged(
        list(zip(times.tolist(), loads.tolist(), strict=True)), State(1.0), end + 7.0)
    assert np.max(np.abs(states[found >= end, 0] - stop.stretch)) < 1e-7


def test_the_command_plans_smoothly_with_its_own_pace(capsys):
    durations = []
    for more in ([], ['--periods', '2'], ['--max-rate', '0.05']):
        assert main(['plan', '1.1:20', '--shaper', 'smooth', '--json', *more]) == 0
        segment, = json.loads(capsys.readouterr().out)['segments']
        assert segment['status'] == 'smooth'
        durations.append(segment['tau_p'])
    assert durations[1] == pytest.approx(2.0 * durations[0])
    assert durations[2] > 1.2 * durations[0]
