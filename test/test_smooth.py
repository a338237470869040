"""The shaper smooth, judged by SciPy's integration of the equation of motion."""

from dataclasses import replace
import json
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

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


def gent(x):
    """Return psi' of the paper's block."""
    return (x - x ** -2) / (1.0 - (x * x + 2.0 / x - 3.0) / 5.0)


def yeoh(x):
    """Return psi' for c10 = 0.5, c20 = -0.02 and c30 = 0.004."""
    i = x * x + 2.0 / x - 3.0
    return (0.5 - 0.04 * i + 0.012 * i * i) * (2.0 * x - 2.0 / x ** 2)


def ogden(x):
    """Return psi' for mu = 2 and alpha = 1."""
    return 2.0 * (1.0 - x ** -1.5)


YEOH = replace(PAPER, law=Elastic('yeoh', POLYNOMIAL, (0.0, 0.5, -0.02, 0.004, 0.0, 0.0), ()))
OGDEN_1 = replace(PAPER, law=Elastic('ogden', OGDEN, (1.0, 2.0, 1.0), ()))


def judged(levels, state, end, force=gent, slew=math.inf, lag=0.0, creep=None):
    """Return times, stretches and rates under levels (time, load), each piece by SciPy."""
    ratios = np.array(creep.ratios if creep else [])
    speeds = 1.0 / np.array(creep.times if creep else [])

    def motion(t, y, load, slope, begin):
        x, v, field, held = y[0], y[1], y[2], y[3:]
        output = load + slope * (t - begin)
        acting = field if lag > 0.0 else output
        stiffness = (force(x + 1e-6) - force(x - 1e-6)) / 2e-6
        a = (acting - force(x) - held.sum() - 0.5 * ZETA * C1 * v + 0.25 * x ** -4 * v * v) / (
            (x ** -3 + C1) / 6.0)
        return [v, a, (output - field) / lag if lag > 0.0 else 0.0,
                *(ratios * stiffness * v - speeds * held)]

    start = force(state.stretch) if math.isnan(state.load) else state.load
    load = start if state.amplifier is None else state.amplifier
    pieces = []
    for (begin, level), until in zip(levels, [x[0] for x in levels[1:]] + [end], strict=True):
        ramp = begin + abs(level - load) / slew
        assert ramp <= until + 1e-9
        pieces += [(begin, load, math.copysign(min(slew, 1e9), level - load), ramp),
                   (ramp, level, 0.0, until)]
        load = level
    y = np.array([state.stretch, state.rate, start, *(0.0 * ratios)])
    rows = []
    for begin, load, slope, until in pieces:
        if until > begin:
            found = solve_ivp(
                motion, (begin, until), y, method='DOP853', rtol=1e-12, atol=1e-13,
                args=(load, slope, begin))
            y = found.y[:, -1]
            rows.append(np.vstack([found.t, found.y[:2]])[:, 1:])
    return np.hstack(rows)


def left(move, request, force=gent):
    """Return the deviation from rest after a move, and its path."""
    end = max(move.duration, move.levels[-1].time)
    path = judged(
        [(x.time, x.load) for x in move.levels], request.state, end + 1e-6, force,
        request.delivery.slew, request.delivery.lag)
    period = 2.0 * math.pi
    after = judged([(0.0, move.levels[-1].load)], State(
        path[1, -1], path[2, -1], move.levels[-1].load), period, force)
    step = abs(request.target - request.state.stretch) or 0.1
    return np.max(np.abs(after[1] - request.target)) / step, path


@pytest.mark.parametrize(('material', 'force'), [(PAPER, gent), (YEOH, yeoh), (OGDEN_1, ogden)])
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
        assert np.max(np.abs(path[2])) < 1.02 * pace.rate
        assert max(loads.max() / limits.maximum, np.max(np.abs(rates)) / delivery.slew,
                   np.max(np.abs(path[2])) / pace.rate) > 0.9


def test_a_slower_move_forgives_more():
    shares = []
    for periods in (0.5, 1.0, 2.0):
        request = MoveRequest(State(1.0), 1.4, PAPER, pace=SmoothLimits(periods))
        move = get_shaper('smooth')(request)
        path = judged(
            [(x.time, x.load) for x in move.levels], State(1.0), move.duration + 7.0,
            lambda x: 1.1 * gent(x))
        shares.append(np.ptp(path[1][path[0] > move.duration]) / 0.4)
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
    times, stretch, _ = judged(
        [x for x in levels if x[0] < end], State(1.0), end, slew=delivery.slew, creep=creep)
    for segment, until in zip(segments, (4.0, end), strict=True):
        assert segment.move.code is Code.SMOOTH
        here = stretch[(times >= segment.begin + segment.move.duration) & (times <= until)]
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
    found, stretch, _ = judged(
        list(zip(times.tolist(), loads.tolist(), strict=True)), State(1.0), end + 7.0)
    assert np.max(np.abs(stretch[found >= end] - stop.stretch)) < 1e-7


def test_the_command_plans_smoothly_with_its_own_pace(capsys):
    durations = []
    for more in ([], ['--periods', '2'], ['--max-rate', '0.05']):
        assert main(['plan', '1.1:20', '--shaper', 'smooth', '--json', *more]) == 0
        segment, = json.loads(capsys.readouterr().out)['segments']
        assert segment['status'] == 'smooth'
        durations.append(segment['tau_p'])
    assert durations[1] == pytest.approx(2.0 * durations[0])
    assert durations[2] > 1.2 * durations[0]
