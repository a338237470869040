"""Viscoelastic branches with power-law flow, compared with SciPy and closed forms."""

from dataclasses import replace
import math

from creep_oracle import elastic, ended, judged
import identification_oracle as oracle
import numpy as np
import pytest
from test_core_creep_plan import left
from test_estimation import LEVELS, measured, run, SAMPLED, TIMES

from hmsa import motion
from hmsa.errors import BadInputError
from hmsa.identification.identify import identify
from hmsa.identification.measurement import Measurement
from hmsa.interfaces.actuator import creep_from
from hmsa.model.creep import Creep, FLOWS
from hmsa.model.delivery import Delivery, IDEAL
from hmsa.model.moves import Level, Setpoint, State
from hmsa.model.parameters import NondimensionalParameters, paper_actuator
from hmsa.model.simulation import ActuatorSimulation, follow, sampled, with_followed
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers.request import MoveRequest
from hmsa_lab.adapt.estimator import EstimatorOptions
from hmsa_lab.adapt.prior import Prior

MS = 1_000_000
ONE = NondimensionalParameters(creep=Creep((0.2,), (2.0,), 'power_law', ((4.0,), (0.3,))))
# A Maxwell branch, and one that flows.
TWO = NondimensionalParameters(
    creep=Creep((0.1, 0.3), (0.4, 10.0), 'power_law', ((1.0, 3.0), (1.0, 0.2))))
SAMPLED_PERIOD = Delivery(0.27)


def test_under_a_constant_stretch_a_branch_fades_by_its_closed_form():
    times, began = np.append(0.0, np.geomspace(1e-3, 1e7, 60)), 0.8
    out = np.empty((len(times), 2))
    assert motion.trail(times, np.ones(len(times)), with_followed(TWO, 1.0 - began), out)
    assert 1.0 - out[:, 0] == pytest.approx(began * np.exp(-times / 0.4), rel=1e-12, abs=1e-15)
    # x' = -(x/tau) (x/s)^2.
    faded = began / np.sqrt(1.0 + 2.0 / 10.0 * (began / 0.2) ** 2 * times)
    assert 1.0 - out[:, 1] == pytest.approx(faded, rel=1e-11)


def test_the_plant_moves_as_scipy_says_and_the_nearer_the_smaller_the_tolerance():
    block = replace(paper_actuator(), creep=Creep())
    creep = replace(TWO.creep, times=tuple(x * block.time_unit for x in TWO.creep.times))
    simulation = ActuatorSimulation(block, creep=creep)
    levels = [(0.0, 0.8), (6.5, -0.3), (9.0, 0.5)]
    for time, load in levels:
        simulation.command(round(1e9 * time * block.time_unit), load * block.flux_density_unit)
    end = simulation.time + round(14.0 * 1e9 * block.time_unit)
    simulation.advance(end)
    _, _, state = judged(levels, TWO.creep, end / 1e9 / block.time_unit)
    # Stamps are rounded to nanoseconds.
    assert simulation.stretch == pytest.approx(state[0], abs=1e-7)
    _, _, state = judged(levels, TWO.creep, 14.0)
    errors = []
    for rtol in (1e-6, 1e-8, 1e-10, 1e-12):
        found = sampled(
            [Level(*x) for x in levels], State(1.0), np.array([14.0]), TWO, rtol=rtol)[:, 0]
        errors.append(abs(found[0] - state[0]))
    assert errors[-1] < 1e-9
    # Of order 8: a step a tenth of the tolerance's eighth root.
    assert all(b < 0.2 * a for a, b in zip(errors[:3], errors[1:3], strict=False))


def test_after_the_vibration_branches_relax_alone_as_they_do_in_the_motion():
    level, end = 0.6, 400.0
    found = follow((Level(0.0, level),), State(1.0), end, TWO, IDEAL)
    _, _, state = judged([(0.0, level)], TWO.creep, end)
    assert found.stretch == pytest.approx(state[0], abs=1e-6)


@pytest.mark.parametrize(('material', 'shaper', 'delivery', 'wanted'), [
    (TWO, 'minimum_time', IDEAL, 1e-6), (ONE, 'robust', SAMPLED_PERIOD, 4e-4),
    *(pytest.param(*x, marks=pytest.mark.slow) for x in (
        (ONE, 'two_step', IDEAL, 1e-6),
        (TWO, 'robust', Delivery(lag=0.1), 1e-6),
        (ONE, 'smooth', Delivery(slew=2.0, lag=0.1), 1.5e-6),
        (TWO, 'two_step', Delivery(slew=2.0), 1.5e-6),
        (TWO, 'two_step', replace(SAMPLED_PERIOD, lag=0.1), 1.1e-3)))])
def test_a_block_whose_branches_flow_rests_after_a_move_and_after_the_next_one(
        material, shaper, delivery, wanted):
    segments = plan_sequence(
        [Setpoint(1.4, 24 * 0.27), Setpoint(1.1, math.inf)],
        MoveRequest.of(material, delivery=delivery), shaper=shaper)
    move = segments[0].move
    levels = move.levels[:len(move.levels) - len(move.tail)]
    end = ended([(x.time, x.load) for x in levels], material.creep, move.duration, delivery)
    assert end[:2] == pytest.approx((1.4, 0.0), abs=1e-9)
    (first, said), (last, later) = left(segments, material.creep, delivery=delivery)
    assert first <= said <= 1.01 * wanted
    # 300 levels follow a branch whose flow never ends for a million half periods.
    assert last <= later <= 2e-3
    assert max(len(x.move.levels) for x in segments) <= 330


@pytest.mark.parametrize('name', ['zv', 'ei', 'umzv', 'minimax'])
def test_what_shapers_leave_is_predicted_at_the_levels_that_follow(name):
    move = plan_sequence([Setpoint(1.2, 40.0)], ONE, shaper=name)[0].move
    levels = [(x.time, x.load) for x in move.levels]
    place = len(levels) - len(move.tail)
    for number in (place, place + 3, place + 9):
        end = ended(levels[:number], ONE.creep, levels[number][0], IDEAL)
        state = move.tail[number - place]
        assert (state.stretch, state.rate) == pytest.approx(end[:2], abs=1e-9)
        held = ONE.creep.ratios[0] * (elastic(state.stretch)[0] - state.followed[0])
        assert held == pytest.approx(end[3], abs=1e-9)


def test_with_an_exponent_of_one_it_is_a_maxwell_branch():
    points = [Setpoint(1.4, 8.0), Setpoint(1.1, math.inf)]
    plans = [
        plan_sequence(points, NondimensionalParameters(creep=x), shaper='robust') for x in (
            Creep((0.2,), (2.0,)), Creep((0.2,), (2.0,), 'power_law', ((1.0,), (0.3,))))]
    for one, other in zip(*plans, strict=True):
        assert [(x.time, x.load) for x in one.move.levels] == [
            pytest.approx((x.time, x.load), abs=1e-9) for x in other.move.levels]


def test_the_exponent_is_found_blind():
    true = {'viscoelastic_ratio': 0.3, 'viscoelastic_time': 0.02, 'viscoelastic_exponent': 2.5,
            'shear_modulus': oracle.BLOCK.shear_modulus}
    extras = oracle.Extras(ratio=0.3, time=0.02, power=(2.5, 0.2))
    level_times, levels = oracle.steps((1.3, 1.0, 1.1, 0.9, 1.0), 0.25)
    times = np.arange(0.0, 1.27, 1e-3)
    stretch = oracle.simulate(times, level_times, levels, extras=extras)
    found = identify(
        Measurement(times, stretch + 3e-4 * np.random.default_rng(3).standard_normal(len(times)),
                  level_times, levels),
        free=['shear_modulus', 'damping_coefficient', 'stretch_bias', *list(true)[:3]],
        actuator=replace(oracle.BLOCK, shear_modulus=1.1e4),
        known={'viscoelastic_stress': 0.2})
    assert found.verdict == 'identified', found.reason
    for name, value in true.items():
        estimate = found.parameters[name]
        assert abs(estimate.value - value) < 4.0 * estimate.std < 0.4 * value


def test_feedback_follows_what_such_a_branch_holds():
    extras = oracle.Extras(ratio=0.2, time=0.01, power=(3.0, 0.2))
    block = replace(oracle.BLOCK, shear_modulus=9e3)
    given = replace(oracle.BLOCK, creep=Creep((0.2,), (0.01,), 'power_law', ((3.0,), (0.2,))))
    prior = Prior.nominal(given, ('shear_modulus', 'damping_coefficient'))
    end = SAMPLED[-1] + 2e-3
    state = oracle.simulate(np.append(SAMPLED, end), TIMES, LEVELS, block, extras)[-1]
    _, found = run(
        measured(block, extras, noise=1e-5), prior=prior, options=EstimatorOptions(window=40))
    assert found.trusted
    assert found.values['shear_modulus'] == pytest.approx(9e3, rel=1e-3)
    assert found.stretch == pytest.approx(state, abs=5e-5)
    assert found.actuator.creep == given.creep


@pytest.mark.parametrize(('values', 'sentence'), [
    ({'viscoelastic.exponent': [4.0]},
     'viscoelastic.stress has 0 values and viscoelastic.ratio 1: expected one of each for every '
     'branch with viscoelastic.flow power_law'),
    ({'viscoelastic.exponent': [0.5], 'viscoelastic.stress': [0.1]},
     'viscoelastic.exponent is 0.5: expected 1 to 20'),
    ({'viscoelastic.flow': 'sinh'}, 'expected one of maxwell, power_law')])
def test_a_flow_without_its_constants_is_refused_in_a_sentence(values, sentence):
    with pytest.raises(BadInputError) as refused:
        creep_from({'viscoelastic.ratio': [0.1], 'viscoelastic.time': [0.02],
                    'viscoelastic.flow': 'power_law', **values})
    assert sentence in str(refused.value)


def test_a_flow_that_only_damps_is_refused():
    unit = paper_actuator().time_unit
    with pytest.raises(BadInputError, match='viscoelastic.time has'):
        replace(paper_actuator(), creep=Creep(
            (0.1,), (2.0 * unit,), 'power_law', ((6.0,), (0.1,))))


def test_constants_that_the_flow_does_not_have_are_without_effect():
    assert creep_from({
        'viscoelastic.ratio': [0.1], 'viscoelastic.time': [0.02],
        'viscoelastic.exponent': [4.0]}) == Creep((0.1,), (0.02,))


@pytest.mark.parametrize('creep', [Creep(), Creep((0.1,), (0.02,)), TWO.creep], ids=str)
def test_parameters_describe_the_branches_whole(creep):
    assert creep_from(creep.parameters) == creep


def test_each_flow_has_the_number_that_the_compiled_motion_gives_it():
    assert [x.kind for x in FLOWS.values()] == list(range(len(FLOWS)))
