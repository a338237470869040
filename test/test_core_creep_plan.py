"""Plans for an elastomer that creeps, judged by SciPy's integration of the equations."""

from dataclasses import replace
import math

from creep_oracle import elastic, ended, judged
import numpy as np
import pytest

from hmsa.errors import BadInputError
from hmsa.model.creep import Creep
from hmsa.model.delivery import Delivery, IDEAL
from hmsa.model.moves import Limits, Setpoint, State
from hmsa.model.parameters import NondimensionalParameters, paper_actuator
from hmsa.model.simulation import follow
from hmsa.model.status import Code, RefusedError
from hmsa.planning.planner import Options, Planner
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.two_step import plan_two_step

MS = 1_000_000
# Times in units of time: about as fast as the block, and from faster to much slower.
ONE = NondimensionalParameters(creep=Creep((0.1,), (2.0,)))
THREE = NondimensionalParameters(creep=Creep((0.1, 0.2, 0.05), (0.4, 3.0, 100.0)))
# A fifth of what a move takes.
SAMPLED = Delivery(0.27)


def left(segments, creep, longest=40.0, delivery=IDEAL):
    """Return the deviation from the target after each move, and its predicted value."""
    end = segments[-1].begin + longest
    levels = [(x.begin + y.time, y.load) for x in segments for y in x.move.levels]
    times, stretch, _ = judged(
        [x for x in levels if x[0] < end], creep, end, delivery.slew, delivery.lag)
    shares = []
    for x, until in zip(segments, [*(x.begin for x in segments[1:]), end], strict=True):
        if math.isinf(x.move.duration):
            continue
        here = stretch[(times >= x.begin + x.move.duration) & (times <= until)]
        target = x.setpoint.stretch
        step = abs(target - x.start.stretch)
        shares.append((
            max(np.ptp(here), np.max(np.abs(here - target))) / step, x.move.vibration / step))
    return shares


@pytest.mark.parametrize(('material', 'shaper', 'delivery', 'wanted'), [
    (ONE, 'two_step', SAMPLED, 3e-4), (THREE, 'robust', Delivery(), 1e-3),
    (ONE, 'two_step', Delivery(lag=0.12), 1e-6), (ONE, 'robust', Delivery(slew=0.6), 1.1e-6),
    *(pytest.param(*x, marks=pytest.mark.slow) for x in (
        (ONE, 'two_step', Delivery(), 1e-6),
        (THREE, 'two_step', SAMPLED, 1e-3),
        (THREE, 'robust', Delivery(lag=0.02), 1e-3),
        (THREE, 'two_step', replace(SAMPLED, lag=0.1), 1.1e-3),
        (THREE, 'two_step', Delivery(slew=2.0), 1e-3),
        (ONE, 'two_step', replace(SAMPLED, slew=2.0), 1e-3),
        (ONE, 'two_step', Delivery(slew=2.0, lag=0.1), 1.4e-6),
        (ONE, 'smooth', Delivery(slew=2.0, lag=0.1), 1.1e-6)))])
def test_a_creeping_block_rests_after_a_move_and_after_the_next_one_right_away(
        material, shaper, delivery, wanted):
    segments = plan_sequence(
        [Setpoint(1.4, 24 * 0.27), Setpoint(1.1, 100 * 0.27), Setpoint(0.9, math.inf)],
        MoveRequest.of(material, delivery=delivery), shaper=shaper)
    assert segments[1].start.followed != ()
    for share, said in left(segments, material.creep, delivery=delivery):
        assert share <= said
        assert said <= 1.01 * wanted
    assert max(len(x.move.levels) for x in segments) <= 330


@pytest.mark.parametrize('delivery', [
    Delivery(lag=0.12), Delivery(slew=2.0), Delivery(slew=1.0, lag=0.3)], ids=str)
def test_stretch_rate_and_field_arrive_as_branches_need_them(delivery):
    move = get_shaper('two_step')(MoveRequest(State(1.0), 1.4, THREE, delivery=delivery))
    end = ended([(x.time, x.load) for x in move.levels], THREE.creep, move.duration, delivery)
    needed = elastic(1.4)[0] + end[3:].sum()
    assert (*end[:2], end[2] - needed) == pytest.approx((1.4, 0.0, 0.0), abs=1e-9)


def test_a_move_that_is_interrupted_goes_on_from_where_the_branches_are():
    segments = plan_sequence(
        [Setpoint(1.4, 0.7), Setpoint(1.7, math.inf)], THREE, short_spell='continue')
    assert abs(segments[1].start.rate) > 0.1
    (share, said), = left(segments, THREE.creep)
    assert share <= said <= 2e-3


def test_a_planner_follows_creep_over_requests_and_a_stop():
    block = replace(
        paper_actuator(), creep=Creep((0.1, 0.05), (2.0 * paper_actuator().time_unit, 0.1)))
    planner = Planner(block, Options(lead_time=0))
    levels = []
    for now, ask in ((0, 1.4), (9 * MS, 1.2), (40 * MS, 1.5), (43 * MS, None)):
        levels = [x for x in levels if x.stamp < now]
        plan = planner.stop(now) if ask is None else planner.setpoint(ask, now)
        levels += [x for x in plan.ahead(now) if x.stamp >= now]
    assert max(b.stamp - a.stamp for a, b in zip(levels, levels[1:], strict=False)) > 0
    stop = plan.segments[-1]
    assert 1.2 < stop.stretch < 1.5
    unit, load = block.time_unit, block.flux_density_unit
    end = (stop.arrival + 150 * MS) / 1e9 / unit
    times, stretch, _ = judged(
        [(x.stamp / 1e9 / unit, x.flux_density / load) for x in levels
         if x.stamp < stop.arrival + 150 * MS], block.nondimensional.creep, end)
    after = times > stop.arrival / 1e9 / unit
    assert np.max(np.abs(stretch[after] - stop.stretch)) <= 1e-3 * 0.2
    # What is predicted between two levels is where it is.
    middle = 41 * MS + 234_567
    assert planner.state(middle).stretch == pytest.approx(
        np.interp(middle / 1e9 / unit, times, stretch), abs=1e-4)


def test_once_relaxed_the_next_plan_is_one_from_rest():
    here = plan_sequence([Setpoint(1.4, 4000.0), Setpoint(1.1, math.inf)], ONE)[1]
    fresh, = plan_sequence([Setpoint(1.1, math.inf)], MoveRequest.of(ONE, State(1.4)))
    assert here.move.levels[0].load == pytest.approx(fresh.move.levels[0].load, rel=1e-9)
    assert here.move.duration == pytest.approx(fresh.move.duration, rel=1e-9)


def test_branches_that_hold_nothing_change_no_plan():
    points = [Setpoint(1.4, 5.0), Setpoint(1.1, math.inf)]
    none = replace(ONE, creep=Creep((0.0,), (2.0,)))
    plain, same = (
        plan_sequence(points, x) for x in (NondimensionalParameters(), none))
    assert [x.move for x in plain] == [x.move for x in same]


def test_levels_that_follow_creep_keep_inside_the_coil():
    segment, = plan_sequence([Setpoint(1.4, math.inf)], ONE)
    highest = max(x.load for x in segment.move.levels)
    assert highest > segment.move.levels[-1].load
    with pytest.raises(RefusedError, match='stretch 1.4 needs a flux density of'):
        plan_sequence(
            [Setpoint(1.4, math.inf)], MoveRequest.of(ONE, limits=Limits(-1.0, 0.999 * highest)))


@pytest.mark.parametrize('delivery', [
    IDEAL, Delivery(slew=2.0), Delivery(lag=0.2), Delivery(slew=2.0, lag=0.1),
    replace(SAMPLED, slew=2.0)], ids=str)
def test_the_fastest_move_of_a_creeping_block_ends_at_rest_within_the_limits(delivery):
    request = MoveRequest(State(1.0), 1.4, THREE, Limits(-3.0, 3.0), delivery)
    move, slower = (get_shaper(x)(request) for x in ('minimum_time', 'two_step'))
    assert move.duration <= slower.duration
    assert all(-3.0 <= x.load <= 3.0 for x in move.levels)
    end = ended([(x.time, x.load) for x in move.levels], THREE.creep, move.duration, delivery)
    needed = elastic(1.4)[0] + end[3:].sum()
    field = end[2] - needed if delivery.lag else 0.0
    assert (*end[:2], field) == pytest.approx((1.4, 0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize('delivery', [IDEAL, Delivery(slew=1.0), Delivery(lag=0.2)], ids=str)
def test_of_a_creeping_block_in_error_minimax_leaves_less_than_the_chain(delivery):
    worst = []
    for shaper in ('robust', 'minimax'):
        move = plan_sequence(
            [Setpoint(1.4, math.inf)], MoveRequest.of(THREE, delivery=delivery),
            shaper=shaper)[0].move
        assert str(move.code) == shaper
        left = []
        for error in (-0.1, 0.1):
            # In units of the block in error.
            stiffer, faster = 1.0 + error, math.sqrt(1.0 + error)
            arrived = move.duration * faster
            times, stretch, _ = judged(
                [(x.time * faster, x.load / stiffer) for x in move.levels
                 if x.time < move.duration + 2.6],
                replace(THREE.creep, times=tuple(x * faster for x in THREE.creep.times)),
                arrived + 2.6 * faster, delivery.slew / stiffer / faster, delivery.lag * faster,
                zeta=0.2 / faster)
            # Off by as much, it creeps on meanwhile.
            after = times >= arrived
            drift = np.polyfit(times[after], stretch[after], 1)
            left.append(np.ptp(stretch[after] - np.polyval(drift, times[after])))
        worst.append(max(left))
    assert worst[1] < 0.7 * worst[0]


@pytest.mark.parametrize('delivery', [IDEAL, Delivery(slew=2.0), Delivery(lag=0.1)], ids=str)
@pytest.mark.parametrize('name', ['zv', 'zvd', 'ei', 'minimax'])
def test_what_rings_on_after_a_move_is_predicted_at_the_levels_that_follow_creep(name, delivery):
    move = plan_sequence(
        [Setpoint(1.2, math.inf)], MoveRequest.of(THREE, delivery=delivery), shaper=name)[0].move
    levels = [(x.time, x.load) for x in move.levels]
    place = len(levels) - len(move.tail)
    for number in (place, place + 3, place + 9):
        state = move.tail[number - place]
        end = ended(levels[:number], THREE.creep, levels[number][0], delivery)
        assert (state.stretch, state.rate, state.load) == pytest.approx(end[:3], abs=1e-9)
        held = np.array(THREE.creep.ratios) * (elastic(state.stretch)[0] - np.array(
            state.followed))
        assert held == pytest.approx(end[3:], abs=1e-9)


def test_a_shaped_step_of_a_creeping_block_leaves_less_than_a_step_and_holds_the_target():
    left = {}
    for name in ('step', 'zv', 'zvd', 'ei'):
        move = plan_sequence([Setpoint(1.05, math.inf)], THREE, shaper=name)[0].move
        arrived = min(move.duration, 3.0)
        times, stretch, _ = judged(
            [(x.time, x.load) for x in move.levels if x.time < 60.0], THREE.creep, 60.0)
        left[name] = np.ptp(stretch[(times >= arrived) & (times < arrived + 2.6)]) / 0.05
        if name != 'step':
            assert stretch[-1] == pytest.approx(1.05, abs=1e-5)
    assert max(left['zv'], left['zvd']) < 0.1 * left['step']
    assert left['ei'] < 0.2 * left['step']


def test_one_plan_from_two_ends_says_what_creep_is_not_planned_for():
    with pytest.raises(BadInputError, match='expected one without'):
        plan_two_step(1.0, 1.1, ONE)


@pytest.mark.parametrize('start', [State(1.0), State(1.1, 0.2, 0.3)], ids=['rest', 'moving'])
@pytest.mark.parametrize('creep', [Creep(), ONE.creep, THREE.creep], ids=['none', 'one', 'three'])
@pytest.mark.parametrize('lag', [0.0, 0.1, 0.5])
def test_one_search_finds_two_levels_and_another_ends_where_they_do(
        lag, creep, start, monkeypatch):
    request = MoveRequest(start, 1.25, replace(ONE, creep=creep), delivery=Delivery(lag=lag))
    with monkeypatch.context() as alone:
        alone.setattr('hmsa.motion.solve', None)
        move = get_shaper('two_step')(request)
    assert move.code is Code.TWO_STEP
    with monkeypatch.context() as without:
        without.setattr('hmsa.motion.two_step_late', lambda *_: (5, *[math.nan] * 5))
        slowly = get_shaper('two_step')(request)
    for found in (move, slowly):
        end = follow(
            found.levels[:-1], request.start, found.duration, request.material, request.delivery)
        assert (end.stretch, end.rate) == pytest.approx((1.25, 0.0), abs=1e-10)
