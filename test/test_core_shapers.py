"""Shapers against an independent integration: at rest at the target, or a reason."""

from collections import Counter
from contextlib import suppress
from dataclasses import replace
import math
import re

from conftest import ROOT
from core_oracle import ended, equation
from hypothesis import example, given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from hmsa import motion
from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.model.creep import Creep
from hmsa.model.delivery import Delivery, ramps
from hmsa.model.equations import (
    critical_zeta,
    elastic_force,
    natural_frequency,
    stretch_limits,
)
from hmsa.model.moves import Limits, Move, Setpoint, State
from hmsa.model.parameters import NondimensionalParameters, paper_actuator
from hmsa.model.simulation import ActuatorSimulation, follow
from hmsa.model.status import Code, RefusedError
from hmsa.planning.planner import Options, Planner
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers import get_shaper, SHAPERS
from hmsa.planning.shapers.request import MoveRequest
from hmsa.report import looks

PAPER = NondimensionalParameters()
WIDE = Limits(-20.0, 20.0)
# Distance from rest at the target, as a share of the move, by an integration of our own.
AT_REST = 1e-8
INTEGRATION = 1e-12
# What rounding of the stretch adds to the rate, in units of stretch times natural frequency where
# that is the largest: of 1500 moves that turn close to a limiting stretch, by an integration with
# mantissas of 64 bits, a plan was off by at most 15. Our own integration may be, too.
ROUNDED = 2.0 * 20.0 * np.finfo(float).eps
MILLISECOND = 1_000_000


def end_state(move: Move, request: MoveRequest) -> tuple[float, float, float]:
    """Integrate a move with SciPy; return its end, and the largest stretch times frequency."""
    pieces, last = ramps(move.levels, request.load, move.duration, request.delivery.slew)
    switches, loads, slopes = np.array(pieces).T
    assert last == pytest.approx(move.levels[-1].load, rel=1e-12)
    state, passed = [request.state.stretch, request.state.rate], []
    ends = [*switches[1:], move.duration]
    for begin, end, load, slope in zip(switches, ends, loads, slopes, strict=True):
        if end > begin:
            x = request.material
            state = ended(
                equation(load, x.zeta, x.j_lim, x.c1, slope), state, end - begin,
                rtol=INTEGRATION, atol=INTEGRATION, seen=lambda _, y: passed.append(y[0]) or 0)
    stretch = np.array(passed)
    return float(state[0]), float(state[1]), np.nanmax(
        stretch * natural_frequency(stretch, request.material), initial=0.0)


def distance_from_rest(move: Move, request: MoveRequest) -> float:
    """Return the deviation from rest at the target after a move, as a fraction of the move."""
    stretch, rate, largest = end_state(move, request)
    frequency = float(natural_frequency(request.target, request.material))
    size = abs(request.target - request.state.stretch) + abs(request.state.rate) / frequency
    # SciPy's own error is about INTEGRATION, however small the move.
    size = max(size, 10.0 * INTEGRATION / AT_REST, ROUNDED * largest / frequency / AT_REST)
    return (abs(stretch - request.target) + abs(rate) / frequency) / size


@pytest.mark.parametrize('name', ['two_step', 'robust', 'minimum_time'])
@pytest.mark.parametrize(('start', 'target'), [(1.0, 1.1), (1.2, 1.4), (1.0, 0.6), (2.2, 0.5)])
@pytest.mark.parametrize('delivery', [
    Delivery(), Delivery(period=0.01), Delivery(period=0.13), Delivery(period=0.3),
    Delivery(slew=200.0), Delivery(period=0.1, slew=400.0)], ids=str)
def test_every_exact_shaper_comes_to_rest_at_the_target(name, start, target, delivery):
    request = MoveRequest(State(start), target, PAPER, WIDE, delivery)
    move = get_shaper(name)(request)
    assert move.code is not Code.STEP
    assert distance_from_rest(move, request) < AT_REST


@pytest.mark.parametrize('slew', [5.0, 1.0, 0.3, 0.1, 0.05])
def test_a_slow_amplifier_is_planned_through_its_ramps(slew):
    request = MoveRequest(State(1.0), 1.1, PAPER, WIDE, Delivery(slew=slew))
    for name in ('two_step', 'robust'):
        move = get_shaper(name)(request)
        assert distance_from_rest(move, request) < AT_REST
        assert move.duration >= (move.levels[-1].load - request.load) / slew


@pytest.mark.parametrize(('start', 'target'), [
    (State(1.0), 1.1), (State(1.0), 0.9), (State(1.1, 2e-14), 1.3)])
def test_a_slow_amplifier_costs_its_ramp_and_half_a_period_at_most(start, target):
    ideal = get_shaper('two_step')(MoveRequest(start, target, PAPER, WIDE)).duration
    for slew in np.geomspace(0.05, 50.0, 40).tolist():
        request = MoveRequest(start, target, PAPER, WIDE, Delivery(slew=slew))
        move, fast = (get_shaper(x)(request) for x in ('two_step', 'minimum_time'))
        ramp = abs(move.levels[-1].load - request.load) / slew
        assert fast.duration <= move.duration < ramp + ideal
        # Fast ramps turn before any level is reached.
        if ramp < 0.05 * ideal:
            assert fast.duration < 0.6 * move.duration
            assert distance_from_rest(fast, request) < AT_REST


# A search by SciPy over level and hold had found a plan for each where ours had found none.
@pytest.mark.parametrize(('state', 'target', 'slew'), [
    (State(1.2595, 0.0085, 0.8159), 0.6331, 0.0694), (State(1.2046, 0.0, 0.5271), 0.6201, 0.0694),
    (State(0.9770, -0.1044, 0.0888), 0.9757, 0.0694),
    (State(1.7542, 0.7372, 1.9849), 0.6713, 0.1734),
    (State(0.9918, -0.5374, -0.1842), 0.7103, 0.1734),
    (State(1.6848, 0.1070, 1.1937), 1.4412, 0.3469),
    (State(1.0068, -0.4092, 0.2448), 0.9611, 0.3469)])
def test_moves_through_slow_ramps_are_found(state, target, slew):
    request = MoveRequest(state, target, PAPER, Limits(-4.0, 4.0), Delivery(slew=slew))
    assert distance_from_rest(get_shaper('two_step')(request), request) < AT_REST


@pytest.mark.parametrize('share', [0.01, 0.1, 0.2, 0.27, 1.0 / 3.0])
def test_a_plan_on_the_grid_is_exact_for_any_period_up_to_a_third_of_the_move(share):
    for start, target in ((1.0, 1.1), (1.2, 1.4), (1.0, 0.6)):
        ideal = get_shaper('two_step')(MoveRequest(State(start), target, PAPER))
        period = share * ideal.duration
        request = MoveRequest(State(start), target, PAPER, WIDE, Delivery(period=period))
        move = get_shaper('two_step')(request)
        for level in move.levels:
            assert level.time / period == pytest.approx(round(level.time / period), abs=1e-9)
        assert move.duration < ideal.duration + period * (1 + 1e-9)
        assert distance_from_rest(move, request) < AT_REST


@pytest.mark.parametrize('order', [1, 2, 3, 4])
def test_a_chain_has_one_level_more_than_its_order_and_takes_about_as_many_half_periods(order):
    request = MoveRequest(State(1.0), 1.4, PAPER, WIDE, order=order)
    move = get_shaper('robust')(request)
    single = get_shaper('two_step')(request)
    assert len(move.levels) == order + 1
    assert move.duration == pytest.approx(order * single.duration, rel=0.03)
    assert distance_from_rest(move, request) < AT_REST


def test_chains_of_a_small_undamped_move_have_binomial_levels():
    # On a linear oscillator a chain of order n is n convolved ZV shapers.
    material = NondimensionalParameters(zeta=0.0)
    step = 1e-3
    full = float(elastic_force(1.0 + step, material.j_lim))
    for order, shares in ((2, [1, 3, 4]), (3, [1, 4, 7, 8])):
        move = get_shaper('robust')(
            MoveRequest(State(1.0), 1.0 + step, material, WIDE, order=order))
        assert [x.load / full for x in move.levels] == pytest.approx(
            [x / shares[-1] for x in shares], abs=1e-2)


def test_minimum_time_is_faster_than_two_step_and_keeps_the_limits():
    limits = Limits(-0.5, 1.2 * float(elastic_force(1.4, 5.0)))
    request = MoveRequest(State(1.0), 1.4, PAPER, limits)
    move = get_shaper('minimum_time')(request)
    assert move.duration < get_shaper('two_step')(request).duration
    for level in move.levels:
        assert limits.minimum <= level.load <= limits.maximum


@pytest.mark.parametrize('zeta', [2.2, 3.0, 6.0])
def test_minimum_time_arrives_above_critical_damping_where_two_step_does_not(zeta):
    material = NondimensionalParameters(zeta=zeta)
    assert zeta > critical_zeta(1.1, material)
    request = MoveRequest(State(1.0), 1.1, material, WIDE)
    assert get_shaper('two_step')(request).code is Code.TOO_DAMPED
    move = get_shaper('minimum_time')(request)
    assert math.isfinite(move.duration)
    assert distance_from_rest(move, request) < AT_REST


def plan_or_reason(name: str, request: MoveRequest) -> tuple[Move, RefusedError | None]:
    """Return a shaper's move, or an empty one with the refusal."""
    try:
        return get_shaper(name)(request), None
    except RefusedError as error:
        return Move(error.code, (), math.inf), error


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    place=st.tuples(st.floats(0.05, 0.95), st.floats(0.05, 0.95)),
    rate=st.floats(-4.0, 4.0),
    zeta=st.one_of(st.just(0.0), st.floats(0.0, 4.0)),
    j_lim=st.floats(0.5, 60.0),
    room=st.floats(0.5, 20.0))
# It turns 2.5e-9 from the lower limiting stretch.
@example(place=(0.0508, 0.5), rate=-3.25, zeta=1.0, j_lim=0.5, room=4.0)
def test_from_any_state_a_plan_is_at_rest_at_the_target_or_carries_a_reason(
        place, rate, zeta, j_lim, room):
    material = NondimensionalParameters(zeta, j_lim)
    lower, upper = stretch_limits(j_lim)
    start, target = (lower + (upper - lower) * x for x in place)
    loads = [float(elastic_force(x, j_lim)) for x in (start, target)]
    request = MoveRequest(
        State(start, rate), target, material, Limits(min(loads) - room, max(loads) + room))
    move, refusal = plan_or_reason('two_step', request)
    if refusal is not None:
        assert refusal.code in (Code.FLUX_LIMIT, Code.NOT_CONVERGED)
        return
    for level in move.levels:
        assert request.limits.minimum <= level.load <= request.limits.maximum
    if move.code in (Code.TWO_STEP, Code.MINIMUM_TIME):
        assert distance_from_rest(move, request) < AT_REST
    else:
        assert move.code in (Code.HOLD, Code.TOO_DAMPED, Code.INDISTINGUISHABLE)
        assert move.reason or move.code is Code.HOLD


def test_too_little_room_for_the_grid_or_the_ramps_is_refused_with_what_is_needed():
    tight = Limits(-0.011, 0.805)
    moving = State(0.9998, 0.3189)
    assert get_shaper('two_step')(MoveRequest(moving, 1.32375, PAPER, tight)).code is Code.TWO_STEP
    with pytest.raises(RefusedError, match='or a command period of 0.4'):
        get_shaper('two_step')(MoveRequest(moving, 1.32375, PAPER, tight, Delivery(period=4.0)))
    slow = MoveRequest(State(1.0), 0.6, PAPER, WIDE, Delivery(slew=0.02))
    assert distance_from_rest(get_shaper('two_step')(slow), slow) < AT_REST
    with pytest.raises(RefusedError, match='expected no slew limit'):
        get_shaper('two_step')(replace(slow, delivery=Delivery(slew=1e-4)))
    with pytest.raises(RefusedError, match='needs a flux density of'):
        get_shaper('minimum_time')(MoveRequest(
            State(1.0), 1.4, PAPER, Limits(-0.1, 0.5), Delivery(slew=1e-307, resolution=1e-6)))
    with pytest.raises(RefusedError, match='needs a flux density of'):
        get_shaper('zvd')(MoveRequest(State(1.0), 1.4, PAPER, Limits(-0.1, 0.5)))
    holding = get_shaper('step')(MoveRequest(State(1.0), 1.1, PAPER)).levels[-1].load
    assert get_shaper('minimum_time')(
        MoveRequest(State(1.0), 1.1, PAPER, Limits(-1.0, holding))).code is Code.TWO_STEP
    with pytest.raises(RefusedError, match='room on both sides'):
        get_shaper('minimum_time')(MoveRequest(State(1.0, 2.0), 1.1, PAPER, Limits(-1.0, holding)))


def drawn(random: np.random.Generator) -> MoveRequest:
    """Return a random move, with limits of which some are tight."""
    start, target = random.uniform(0.7, 1.8, 2)
    material = NondimensionalParameters(zeta=float(random.choice([0.05, 0.2, 1.0, 2.5])))
    loads = sorted(float(elastic_force(x, material)) for x in (start, target))
    span = loads[1] - loads[0]
    room = span * random.choice([0.02, 0.1, 0.5, 2.0, 10.0], 2) + 1e-3
    half = np.pi / float(natural_frequency(target, material))
    period, slew, lag = random.integers(0, 2, 3)
    rate = random.normal() * 0.3 * (target - start) * random.integers(0, 2)
    return MoveRequest(
        State(start, rate, float(elastic_force(start, material))), target, material,
        Limits(loads[0] - room[0], loads[1] + room[1]),
        Delivery(
            period * half * random.uniform(0.02, 1.2),
            span / half * np.exp(random.uniform(-1.5, 4.0)) if slew else math.inf,
            1e-6 * random.integers(0, 2), lag * half * random.uniform(0.01, 0.3)))


def test_minimum_time_finds_what_two_step_finds_and_is_never_slower():
    random = np.random.default_rng(1)
    for _ in range(500):
        request = drawn(random)
        (slow, refusal), (fast, _) = (
            plan_or_reason(name, request) for name in ('two_step', 'minimum_time'))
        if refusal is None:
            assert fast.levels
            assert fast.duration <= slow.duration
            assert request.keeps(fast.levels)
            assert fast.reason or fast.code in (Code.MINIMUM_TIME, Code.HOLD)


def eased(request: MoveRequest, advice: str) -> MoveRequest:
    """Return a request with the limits that a refusal advises."""
    limits, delivery = request.limits, request.delivery
    for part in advice.split(' and '):
        numbers = [float(x) for x in re.findall(r'-?\d[\d.e+-]*', part)]
        if 'flux' in part:
            limits = Limits(*numbers)
        elif 'slew' in part:
            delivery = replace(delivery, slew=(*numbers, math.inf)[0])
        else:
            name = 'period' if part.startswith('a command period of') else 'lag'
            delivery = replace(delivery, **{name: numbers[0]})
    return replace(request, limits=limits, delivery=delivery)


def test_a_refusal_names_limits_with_each_of_which_a_command_is_found():
    random = np.random.default_rng(2)
    named: Counter[str] = Counter()
    refused = 0
    while refused < 5:
        request = drawn(random)
        if not (request.delivery.period and request.delivery.slew < math.inf):
            continue  # seldom refused
        _, refusal = plan_or_reason('two_step', request)
        if refusal is None:
            continue
        refused += 1
        first, *others = str(refusal).partition(': expected ')[2].split(', or ')
        for advice in (first, *others):
            assert plan_or_reason('two_step', eased(request, advice))[1] is None, refusal
            named[advice.partition(' of ')[0]] += 1
        by_word = {'flux': Code.FLUX_LIMIT, 'slew': Code.SLEW_LIMIT}
        assert refusal.code is next(
            (code for word, code in by_word.items() if word in first), Code.NO_TWO_STEP)
    assert len(named) >= 2


def test_a_refusal_costs_no_more_than_its_searches_and_one_for_advice(monkeypatch):
    spent, solve = [], motion.solve

    def counted(*arguments):
        found = solve(*arguments)
        spent.append(found[2])
        return found

    monkeypatch.setattr(motion, 'solve', counted)
    creep = Creep((0.1, 0.2, 0.1), (0.2, 4.0, 100.0))
    request = MoveRequest(
        State(0.8861966254382365, -0.00023701158342467364, 0.5361491154517042),
        0.8861926210099953, replace(PAPER, creep=creep), Limits(-0.0928, 6.558),
        Delivery(slew=0.0002451145879390747), order=4)
    with pytest.raises(RefusedError, match='expected no flux density limits and no slew limit'):
        get_shaper('minimum_time')(request)
    assert sum(spent) < 700_000


def test_every_shaper_has_a_style_and_is_named_where_one_is_chosen(capsys):
    assert looks.SHAPERS.keys() == SHAPERS.keys()
    with suppress(SystemExit):
        main(['plan', '--help'])
    told, page = capsys.readouterr().out, (ROOT / 'docs/explanation/which-shaper.md').read_text()
    for name in SHAPERS:
        assert re.search(rf'\b{name}\b', told), name
        assert f'`{name}`' in page, name


@pytest.mark.parametrize('name', list(SHAPERS))
def test_every_shaper_refuses_targets_out_of_range(name):
    for target in (0.1, 3.0, math.nan):
        with pytest.raises(RefusedError, match='between the limits') as refusal:
            get_shaper(name)(MoveRequest(State(1.0), target, PAPER))
        assert refusal.value.code is Code.OUT_OF_RANGE


def test_an_unknown_shaper_is_refused_with_the_known_ones():
    with pytest.raises(BadInputError, match='expected one of two_step, robust'):
        get_shaper('nothing')
    with pytest.raises(BadInputError, match='order is 0'):
        get_shaper('robust')(MoveRequest(State(1.0), 1.1, PAPER, order=0))
    with pytest.raises(BadInputError, match='command period is -1'):
        Delivery(period=-1.0)
    with pytest.raises(BadInputError, match='slew limit is 0'):
        Delivery(slew=0.0)


def test_linear_shapers_leave_vibration_and_the_exact_ones_do_not():
    for name, least, most in (('zv', 1e-2, 0.3), ('zvd', 3e-3, 0.3), ('ei', 3e-3, 0.3)):
        request = MoveRequest(State(1.0), 1.4, PAPER)
        move = get_shaper(name)(request)
        assert move.code is Code.LINEAR
        assert least < distance_from_rest(move, request) < most


def test_full_on_off_and_on_again_leaves_nothing_of_a_small_move_in_a_third_of_a_period():
    for zeta, creep in (
            (0.0, Creep()), (0.2, Creep()), (1.0, Creep()), (0.2, Creep((0.2,), (1.0,)))):
        request = MoveRequest(
            State(1.0), 1.0001, NondimensionalParameters(zeta=zeta, creep=creep), Limits())
        move, slower, step = (get_shaper(x)(request) for x in ('umzv', 'zv', 'step'))
        assert move.duration < 0.95 * slower.duration
        full = move.levels[-1].load
        assert [x.load for x in move.levels] == pytest.approx([full, 0.0, full], abs=1e-12)
        left = [distance_from_rest(x, request) for x in (
            move, Move(step.code, step.levels, move.duration))] if not creep else [0.0, 1.0]
        assert left[0] < 2e-3 * left[1]
    undamped = NondimensionalParameters(zeta=0.0)
    small = get_shaper('umzv')(MoveRequest(State(1.0), 1.0 + 1e-7, undamped))
    third = 2.0 * math.pi / 3.0 / float(natural_frequency(1.0, undamped))
    assert small.duration == pytest.approx(third, rel=1e-5)


def test_a_sequence_begins_each_move_where_the_last_one_really_ended():
    # The first spell is too short: the second move starts from a moving state.
    first = get_shaper('two_step')(MoveRequest(State(1.0), 1.3, PAPER))
    setpoints = [Setpoint(1.3, 0.5 * first.duration), Setpoint(1.1, 10.0)]
    with pytest.raises(RefusedError, match='its setpoint lasts'):
        plan_sequence(setpoints, PAPER)
    segments = plan_sequence(setpoints, MoveRequest.of(PAPER, limits=WIDE), short_spell='continue')
    assert segments[0].move.code is Code.SPELL_TOO_SHORT
    assert abs(segments[1].start.rate) > 0.01
    request = MoveRequest(segments[1].start, 1.1, PAPER, WIDE)
    assert distance_from_rest(segments[1].move, request) < AT_REST


@pytest.mark.parametrize('options', [
    {}, {'period': MILLISECOND}, {'slew_limit': 20.0}, {'shaper': 'robust'},
    {'shaper': 'minimum_time'}, {'period': MILLISECOND, 'slew_limit': 60.0}, *(
        {'coil_time_constant': 5e-4, **x} for x in (
            {}, {'period': MILLISECOND}, {'slew_limit': 60.0}, {'shaper': 'robust'},
            {'shaper': 'minimum_time'}, {'shaper': 'minimum_time', 'period': MILLISECOND}))],
    ids=str)
def test_pre_emption_and_stop_leave_no_vibration_behind(options):
    settings_ = Options(
        flux_density_min=-0.5, flux_density_max=0.5, lead_time=MILLISECOND, **options)
    planner = Planner(paper_actuator(), settings_)
    plant = ActuatorSimulation(
        paper_actuator(), slew_limit=options.get('slew_limit', math.inf),
        coil_time_constant=options.get('coil_time_constant', 0.0))
    requests = {0: 1.4, 3: 0.9, 7: 1.2, 8: 1.2, 60: 1.3, 63: 'stop'}
    samples = []
    for time in range(0, 160):
        now = time * MILLISECOND
        request = requests.get(time)
        if request == 'stop':
            planner.stop(now)
        elif request is not None:
            planner.setpoint(request, now)
        for level in planner.due(now):
            assert plant.command(level.stamp, level.flux_density) == 0
            assert level.stamp % options.get('period', 1) == 0
            assert -0.5 <= level.flux_density <= 0.5
        plant.advance(now)
        predicted = planner.state(now)
        assert predicted.stretch == pytest.approx(plant.stretch, abs=1e-9)
        assert predicted.load * paper_actuator().flux_density_unit == pytest.approx(
            plant.flux_density, abs=1e-9)
        samples.append(plant.stretch)
    arrivals = [x.arrival for x in planner.plan.segments]
    assert arrivals[-1] is not None
    assert np.ptp(samples[58:60]) < 1e-6
    assert np.ptp(samples[-40:]) < 1e-6


def test_through_ramps_every_moving_start_finds_rest_within_the_limits():
    model = paper_actuator()
    load, time = model.flux_density_unit, model.time_unit
    limits, slew = Limits(-0.5 / load, 0.5 / load), 50.0 / load * time
    random = np.random.default_rng(2)
    for _ in range(400):
        start, target = random.uniform(0.6, 1.8, 2)
        held = float(elastic_force(start, 5.0)) + random.normal(0.0, 0.3)
        state = State(
            start, random.normal(0.0, 0.3),
            float(np.clip(held, limits.minimum, limits.maximum)))
        request = MoveRequest(state, target, model.nondimensional, limits, Delivery(slew=slew))
        move = get_shaper('two_step')(request)
        assert all(limits.minimum <= x.load <= limits.maximum for x in move.levels)
        end = follow(
            move.levels, state, move.duration, model.nondimensional, request.delivery)
        assert math.hypot(end.stretch - target, end.rate) < 1e-9
