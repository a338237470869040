"""Plans for an elastomer that creeps, judged by SciPy's integration of the equations."""

from dataclasses import replace
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hmsa_ros.errors import BadInputError
from hmsa_ros.model.creep import Creep
from hmsa_ros.model.delivery import Delivery, IDEAL
from hmsa_ros.model.moves import Limits, State
from hmsa_ros.model.parameters import NondimensionalParameters, paper_actuator
from hmsa_ros.model.status import RefusedError
from hmsa_ros.planning.planner import Options, Planner
from hmsa_ros.planning.sequence import plan_sequence
from hmsa_ros.planning.setpoint import Setpoint
from hmsa_ros.planning.shapers import get_shaper, SHAPERS
from hmsa_ros.planning.shapers.request import Request
from hmsa_ros.planning.two_step import plan_two_step

MS = 1_000_000
J, ZETA, C1 = 5.0, 0.2, 2.0
# Times in units of time: about as fast as the block, and from faster to much slower.
ONE = NondimensionalParameters(creep=Creep((0.1,), (2.0,)))
THREE = NondimensionalParameters(creep=Creep((0.1, 0.2, 0.05), (0.4, 3.0, 100.0)))
# A fifth of what a move takes.
SAMPLED = Delivery(0.27)


def elastic(x):
    """Return psi' and psi'' of a Gent block."""
    above = x - x ** -2
    g = 1.0 - (x * x + 2.0 / x - 3.0) / J
    return above / g, ((1.0 + 2.0 * x ** -3) + 2.0 * above ** 2 / (J * g)) / g


def motion(t, y, load, slope, lag, ratios, speeds):
    """Return the derivative of stretch, rate, field and what the branches hold; t in a piece."""
    x, v, field, held = y[0], y[1], y[2], y[3:]
    field = field if lag else load + slope * t
    force, stiffness = elastic(x)
    mass = (x ** -3 + C1) / 6.0
    return [v, (field - force - held.sum() - 0.5 * ZETA * C1 * v + 0.25 * x ** -4 * v * v) / mass,
            (load + slope * t - field) / lag if lag else 0.0,
            *(ratios * stiffness * v - speeds * held)]


def ended(levels, creep, end, delivery):
    """Return the state at the end; the field is that of the amplifier if it does not lag."""
    levels = [x for x in levels if x[0] < end]
    state = judged(levels, creep, end, delivery.slew, delivery.lag)[2]
    if delivery.lag == 0.0:
        state[2] = levels[-1][1]
    return state


def judged(levels, creep, end, slew=math.inf, lag=0.0):
    """Return times and stretches under levels (time, load) from rest at 1, by SciPy; the end."""
    state = np.zeros(3 + len(creep.ratios))
    state[0], output = 1.0, 0.0
    times, stretches = [], []
    for (begin, load), until in zip(levels, [x[0] for x in levels[1:]] + [end], strict=True):
        reached = min(begin + abs(load - output) / slew, until)
        ramp = math.copysign(slew, load - output) if reached > begin else 0.0
        after = output + ramp * (reached - begin) if reached == until else load
        for start, stop, first, slope in (
                (begin, reached, output, ramp), (reached, until, after, 0.0)):
            if stop <= start:
                continue
            found = solve_ivp(
                motion, (0.0, stop - start), state, method='DOP853', rtol=1e-11, atol=1e-12,
                t_eval=np.linspace(0.0, stop - start, 9 + int(6 * (stop - start))),
                # In longer steps it does not see a field that decays within some lags.
                max_step=max(lag, (stop - start) / 1000.0) if lag else math.inf,
                args=(first, slope, lag, np.array(creep.ratios), 1.0 / np.array(creep.times)))
            times.append(start + found.t)
            stretches.append(found.y[0])
            state = found.y[:, -1]
        output = after
    return np.concatenate(times), np.concatenate(stretches), state


def left(segments, creep, longest=40.0, delivery=IDEAL):
    """Return how far from its target each move leaves the stretch, and what it is said to."""
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
    (ONE, 'two_step', Delivery(), 1e-6),
    (ONE, 'two_step', SAMPLED, 3e-4),
    (THREE, 'two_step', SAMPLED, 1e-3),
    (THREE, 'robust', Delivery(), 1e-3),
    (ONE, 'two_step', Delivery(lag=0.12), 1e-6),
    (THREE, 'robust', Delivery(lag=0.02), 1e-3),
    (THREE, 'two_step', replace(SAMPLED, lag=0.1), 1.1e-3),
    (THREE, 'two_step', Delivery(slew=2.0), 1e-3),
    (ONE, 'robust', Delivery(slew=0.6), 1.1e-6),
    (ONE, 'two_step', replace(SAMPLED, slew=2.0), 1e-3),
    (ONE, 'two_step', Delivery(slew=2.0, lag=0.1), 1.4e-6),
    (ONE, 'smooth', Delivery(slew=2.0, lag=0.1), 1.1e-6)])
def test_a_creeping_block_rests_after_a_move_and_after_the_next_one_right_away(
        material, shaper, delivery, wanted):
    segments = plan_sequence(
        [Setpoint(1.4, 24 * 0.27), Setpoint(1.1, 100 * 0.27), Setpoint(0.9, math.inf)],
        material, shaper=shaper, delivery=delivery)
    assert segments[1].start.followed != ()
    for share, said in left(segments, material.creep, delivery=delivery):
        assert share <= said
        assert said <= 1.01 * wanted
    assert max(len(x.move.levels) for x in segments) <= 330


@pytest.mark.parametrize('delivery', [
    Delivery(lag=0.12), Delivery(slew=2.0), Delivery(slew=1.0, lag=0.3)], ids=str)
def test_stretch_rate_and_field_arrive_as_branches_need_them(delivery):
    move = get_shaper('two_step')(Request(State(1.0), 1.4, THREE, delivery=delivery))
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
    fresh, = plan_sequence([Setpoint(1.1, math.inf)], ONE, start=State(1.4))
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
            [Setpoint(1.4, math.inf)], ONE, limits=Limits(-1.0, 0.999 * highest))


@pytest.mark.parametrize('name', SHAPERS)
def test_a_shaper_called_directly_knows_of_creep_or_refuses_it(name):
    request = Request(State(1.0), 1.1, ONE, delivery=Delivery(slew=2.0, lag=0.1))
    if name in ('two_step', 'robust', 'smooth', 'step'):
        assert get_shaper(name)(request).levels
        return
    with pytest.raises(BadInputError, match=r'viscoelastic\.ratio'):
        get_shaper(name)(request)


def test_what_creep_is_not_planned_for_yet_is_refused():
    sentence = 'shaper minimum_time does not know of viscoelastic.ratio'
    with pytest.raises(BadInputError, match=sentence):
        plan_sequence([Setpoint(1.4, math.inf)], ONE, shaper='minimum_time')
    with pytest.raises(BadInputError, match='expected one without'):
        plan_two_step(1.0, 1.1, ONE)
