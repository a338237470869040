"""Temperature: parameters, plans and the simulated block at it, and ten minutes of warming."""

from dataclasses import replace
import math

from core_oracle import holding_load
import numpy as np
import pytest
import yaml

from benchmarks.warming import block, DURATION, TARGETS, WARMING, warming
import hmsa
from hmsa.cli import main
from hmsa.errors import BadInputError, UnusualWarning
from hmsa.interfaces.actuator import actuator_from, parameters_of
from hmsa.model.actuators import Actuators, Setup
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation
from hmsa.model.thermal import Thermal
from hmsa.model.units import NANOSECONDS
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa_lab.adapt.motion import follow, Levels
from hmsa_lab.adapt.prior import Prior
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import (
    Note,
    Settings,
    Severity,
    StatusChanged,
    StretchRequest,
    Trajectory,
)

pytestmark = pytest.mark.thorough

COEFFICIENTS = {'shear_modulus': 3e-3, 'remanence': -1e-3, 'damping_coefficient': -5e-3}
THERMAL = Thermal(**COEFFICIENTS)
WARM = replace(paper_actuator(), thermal=THERMAL)
MOVES = [(1.1, 0.2), (1.3, 0.2), (1.2, 0.2)]


# -- parameters ----------------------------------------------------------------------------------

def test_parameters_follow_their_coefficients_from_the_reference():
    hot = WARM.at_temperature(40.0)
    assert hot.shear_modulus == pytest.approx(10450.0)
    assert hot.remanence == pytest.approx(0.0985)
    assert hot.damping_coefficient == pytest.approx(0.925 * WARM.damping_coefficient)
    assert (hot.density, hot.chain_limit) == (WARM.density, WARM.chain_limit)
    # The level that holds a stretch is G/Br times the force.
    assert Setup(hot).holding(1.2) / Setup(WARM).holding(1.2) == pytest.approx(1.045 / 0.985)


def test_all_moduli_of_a_law_follow_the_shear_modulus():
    yeoh = hmsa.Actuator(
        law='yeoh', constants={'c10': 5e3, 'c20': 200.0}, thermal={'shear_modulus': 3e-3})
    hot = yeoh.at_temperature(35.0).parameters
    assert [hot[f'law.{x}'] for x in ('c10', 'c20')] == pytest.approx([5150.0, 206.0])


def test_a_second_temperature_leads_where_the_first_alone_would():
    twice, once = WARM.at_temperature(60.0).at_temperature(33.0), WARM.at_temperature(33.0)
    assert twice.numbers == pytest.approx(once.numbers, rel=1e-14)
    assert vars(twice.thermal) == pytest.approx(vars(once.thermal), rel=1e-13)
    assert vars(twice.at_temperature(25.0).thermal) == pytest.approx(vars(THERMAL), abs=1e-15)


def test_plans_without_coefficients_and_at_the_reference_have_the_same_bits():
    plain, plan = paper_actuator(), hmsa.Actuator().plan(MOVES)
    assert plain.at_temperature(60.0) is plain
    for thermal in (None, {}, COEFFICIENTS, {**COEFFICIENTS, 'reference': 31.0}):
        levels = hmsa.Actuator(thermal=thermal).plan(MOVES).levels
        assert levels.tobytes() == plan.levels.tobytes()
    assert hmsa.Actuator(thermal=COEFFICIENTS).plan(
        MOVES, temperature=25.0).levels.tobytes() == plan.levels.tobytes()


def test_planner_at_the_reference_sends_the_same_bits():
    points = [(1.2, NANOSECONDS), (1.1, 2 * NANOSECONDS)]
    plans = [Planner(x, Options()).request(points, None, 0) for x in (paper_actuator(), WARM)]
    one, other = ([(y.stamp, y.flux_density) for y in x.levels] for x in plans)
    assert one == other


def test_plan_at_a_temperature_brings_the_block_to_rest_there_and_only_there():
    silicone = hmsa.Actuator(thermal=COEFFICIENTS)
    plan = silicone.plan(MOVES, temperature=40.0)
    assert plan.simulate().report()['verdict'] == ['arrived'] * 3
    cold = silicone.simulate(plan.levels, until=0.2)
    assert float(cold.stretches[-1]) == pytest.approx(
        silicone.stretch(plan.flux_densities[1]), abs=1e-6)
    assert float(cold.stretches[-1]) > 1.104


def test_the_coil_is_faster_as_its_resistance_grows():
    warm = hmsa.Actuator(coil_time_constant=2e-3, thermal={'coil_resistance': 4e-3})
    assert warm.at_temperature(75.0).parameters['coil_time_constant'] == pytest.approx(2e-3 / 1.2)


def test_coefficients_survive_a_parameter_file(tmp_path):
    silicone = hmsa.Actuator(thermal={**COEFFICIENTS, 'reference': 31.0})
    silicone.to_yaml(tmp_path / 'a.yaml')
    assert hmsa.Actuator.from_yaml(tmp_path / 'a.yaml') == silicone
    assert actuator_from(parameters_of(WARM)) == WARM
    assert not any(x.startswith('thermal') for x in hmsa.Actuator().parameters)
    assert silicone.replace(thermal={'remanence': -2e-3}).block.thermal == Thermal(
        remanence=-2e-3)


@pytest.mark.parametrize(('temperature', 'words'), [
    (298.0, 'degrees Celsius, not kelvin.*298 K are 24.85 degrees Celsius'),
    (math.nan, 'temperature is nan'), (-273.0, 'from -60 to 200$'), (1e9, 'from -60 to 200$')])
def test_impossible_temperature_is_refused_with_the_unit(temperature, words):
    with pytest.raises(BadInputError, match=words):
        hmsa.Actuator(thermal=COEFFICIENTS).plan(MOVES, temperature=temperature)


def test_temperature_of_an_actuator_without_coefficients_is_refused():
    with pytest.raises(BadInputError, match='no temperature coefficients'):
        hmsa.Actuator().plan(MOVES, temperature=40.0)


@pytest.mark.parametrize(('thermal', 'words'), [
    ({'shear_modulus': 0.3}, r'thermal.shear_modulus is 0.3.*-0.1 to 0.1'),
    ({'remanance': -1e-3}, "coefficient is 'remanance'.*did you mean remanence"),
    ({'reference': 298.15}, 'thermal.reference is 298.15.*not kelvin|thermal.reference'),
    ({'rise': -1.0}, 'thermal.rise'), (3e-3, 'thermal coefficients are 0.003')])
def test_impossible_coefficient_is_refused(thermal, words):
    with pytest.raises(BadInputError, match=words):
        hmsa.Actuator(thermal=thermal)


def test_parameters_that_would_vanish_are_refused():
    with pytest.raises(BadInputError, match='5 % of the parameter is left'):
        hmsa.Actuator(thermal={'remanence': -0.01}).at_temperature(120.0)


def test_magnets_above_their_limit_are_warned_of():
    silicone = hmsa.Actuator(thermal={**COEFFICIENTS, 'limit': 60.0})
    with pytest.warns(UnusualWarning, match='above thermal.limit 60.*identify the remanence'):
        silicone.at_temperature(70.0)


def test_hmsa_plan_takes_a_temperature(capsys, tmp_path, refusal):
    file = str(tmp_path / 'a.yaml')
    hmsa.Actuator(thermal=COEFFICIENTS).to_yaml(file)
    assert main(['plan', '1.1:0.2', '--params-file', file, '--temperature', '40 C']) == 0
    assert 'at 40 degrees Celsius' in capsys.readouterr().out
    assert 'not kelvin' in refusal('plan 1.1:10 --temperature 298 --params-file', file)
    assert 'expected --params-file' in refusal('plan 1.1:10 --temperature 40')


# -- the simulated block -------------------------------------------------------------------------

def test_a_block_at_rest_moves_to_the_equilibrium_of_its_new_temperature():
    simulation = ActuatorSimulation(WARM, stretch=1.2)
    level = simulation.flux_density
    simulation.set_temperature(40.0)
    simulation.advance(4 * NANOSECONDS)
    assert simulation.flux_density == level
    hot = WARM.at_temperature(40.0)
    force = level / hot.flux_density_unit
    assert holding_load(simulation.stretch, hot.chain_limit) == pytest.approx(force, rel=1e-9)


@pytest.mark.parametrize('delivery', [
    {}, {'slew_limit': 5.0}, {'coil_time_constant': 2e-3},
    {'slew_limit': 5.0, 'coil_time_constant': 2e-3}])
def test_temperature_that_does_not_change_anything_leaves_a_motion_alone(delivery):
    still = replace(WARM, thermal=Thermal(remanence=1e-15))
    found = []
    for warms in (False, True):
        all_ = Actuators([Setup(still, 1.0, **delivery)])
        all_.command(0, 0, 0.03)
        for time in range(0, 20_000_000, 500_000):
            all_.advance(time)
            if warms:
                all_.set_temperature(0, Setup(still, 1.0, **delivery), 25.0 + time * 1e-6)
        found.append([float(x[0]) for x in (all_.stretch, all_.rate, all_.flux_density)])
    assert found[0] == pytest.approx(found[1], rel=1e-9)


def test_rate_of_a_block_in_motion_does_not_jump_with_the_temperature():
    simulation = ActuatorSimulation(WARM)
    simulation.command(0, 0.03)
    simulation.advance(2_000_000)
    before = simulation.stretch, simulation.rate
    simulation.set_temperature(60.0)
    assert (simulation.stretch, simulation.rate) == pytest.approx(before, rel=1e-14)


# -- plans over time -----------------------------------------------------------------------------

def test_setpoints_of_a_sequence_are_planned_for_the_temperature_foreseen():
    warm = block()
    planner = Planner(warm, Options())
    planner.take_temperature(25.0, 0)
    plan = planner.request(
        [(1.2, 100 * NANOSECONDS), (1.3, 200 * NANOSECONDS)], None, 0)
    # The coil warms the block by its own law.
    thermal = warm.thermal
    level = Setup(warm).holding(1.2)
    after = 25.0 + thermal.rise * level ** 2 * -math.expm1(-100.0 / thermal.time_constant)
    second = plan.segments[1].begin
    assert plan.level(second).model.temperature == pytest.approx(after, abs=0.4)
    # Until then the level follows, in steps that move the block by less than 1e-3 of the step.
    holding = np.array([x.flux_density for x in plan.levels if x.stamp < second][2:])
    assert np.max(np.abs(np.diff(holding))) < 3e-4 * holding[0]
    assert holding[-1] / holding[0] == pytest.approx(
        (1.0 + 0.0035 * (after - 25.0)) / (1.0 - 0.0011 * (after - 25.0)), rel=2e-3)


def test_temperature_without_a_field_is_what_the_coil_does_not_explain():
    warm = block()
    planner = Planner(warm, Options())
    for second in range(0, 2000, 10):
        planner.take_temperature(31.0, second * NANOSECONDS)
    assert planner.foreseen(10**13).temperature == pytest.approx(31.0, abs=0.1)


def test_measured_temperature_applies_from_the_next_plan_on():
    planner = Planner(WARM, Options())
    planner.setpoint(1.2, 0)
    before = planner.plan
    planner.take_temperature(40.0, NANOSECONDS)
    assert planner.plan is before
    plan = planner.setpoint(1.1, NANOSECONDS)
    assert plan.levels[-1].flux_density == pytest.approx(
        Setup(WARM.at_temperature(40.0)).holding(1.1))


def test_plan_that_is_held_follows_the_measured_temperature():
    planner = Planner(WARM, Options())
    planner.request([(1.2, 10 * NANOSECONDS), (1.1, 20 * NANOSECONDS)], None, 0)
    planner.take_temperature(40.0, 5 * NANOSECONDS)
    plan = planner.take(planner.draft_warmed(5 * NANOSECONDS), 5 * NANOSECONDS)
    hot = Setup(WARM.at_temperature(40.0))
    assert plan.level(6 * NANOSECONDS).flux_density == pytest.approx(hot.holding(1.2))
    assert plan.levels[-1].flux_density == pytest.approx(hot.holding(1.1))
    # The setpoints are as they were.
    assert [(x.stretch, x.since) for x in plan.segments] == [
        (1.2, 50_000_000), (1.1, 10_050_000_000)]


# -- ten minutes ---------------------------------------------------------------------------------

@pytest.mark.parametrize('way', [
    'measured', *(pytest.param(x, marks=pytest.mark.slow) for x in (
        'measured and foreseen', 'foreseen'))])
def test_block_that_warms_is_moved_right_for_ten_minutes_with_the_temperature_known(way):
    found = warming(way)
    assert found[-1].temperature - 25.0 == pytest.approx(WARMING, abs=2.0)
    assert max(x.vibration for x in found) < 5e-3
    assert max(x.worst for x in found) < 5e-3


@pytest.mark.slow
def test_temperature_that_is_ignored_leaves_vibration_and_offset():
    found = warming('ignored')[-len(TARGETS):]
    assert max(x.vibration for x in found) > 0.05
    assert max(x.worst for x in found) > 0.05


@pytest.mark.parametrize(('stiffer', 'duration'), [
    (0.0, 60.0), *(pytest.param(x, DURATION, marks=pytest.mark.slow) for x in (0.0, 0.1))])
def test_feedback_without_a_temperature_sensor_is_right_from_the_third_move_on(stiffer, duration):
    found = warming('feedback', stiffer=stiffer, duration=duration)[2:]
    assert max(x.vibration for x in found) < 5e-3
    assert max(x.worst for x in found) < 5e-3


@pytest.mark.parametrize(('coefficients', 'expansion', 'duration'), [
    (1.2, 3e-4, 60.0), *(
        pytest.param(*x, DURATION, marks=pytest.mark.slow) for x in (
            (0.8, 0.0), (1.0, 3e-4)))])
def test_feedback_with_a_temperature_sensor_corrects_coefficients_and_an_expanding_length(
        coefficients, expansion, duration):
    found = warming('measured and feedback', coefficients=coefficients, expansion=expansion,
                    duration=duration)[2:]
    assert max(x.vibration for x in found) < 5e-3
    assert max(x.worst for x in found) < 5e-3


@pytest.mark.slow
def test_feedback_does_not_learn_again_what_a_measured_temperature_explains():
    found = warming('measured and feedback', stiffer=0.1)[1:]
    assert max(x.vibration for x in found) < 5e-3
    assert max(x.worst for x in found) < 5e-3
    # Of the modulus, 15 K change 5 %.
    assert abs(found[-1].modulus - 1.0) < 5e-3


def test_motion_has_its_derivatives_by_the_temperature():
    block = replace(paper_actuator(), thermal=replace(THERMAL, coil_resistance=4e-3))
    prior = Prior.nominal(block, others={'coil_time_constant': 1e-3})
    levels, times = Levels(np.array([0.0]), np.array([0.03])), np.linspace(0.0, 0.02, 9)

    def motion(celsius):
        return follow({**prior.values, 'temperature': celsius}, prior.free, (1.01, 0.5), levels,
                      0.0, times)

    place, (low, here, high) = prior.free.index('temperature'), map(motion, (37.5, 38.0, 38.5))
    assert here.by[:, place] == pytest.approx(high.stretch - low.stretch, rel=1e-3, abs=1e-9)
    assert here.rate_by[:, place] == pytest.approx(high.rate - low.rate, rel=1e-3, abs=1e-6)
    # The same motion as that of the block whose parameters hold there.
    hot = Prior.nominal(block.at_temperature(38.0), others={
        'coil_time_constant': block.thermal.coil_time_constant(1e-3, 38.0)})
    there = follow({**hot.values, 'temperature': 38.0}, (), (1.01, 0.5), levels, 0.0, times)
    assert here.stretch == pytest.approx(there.stretch, abs=1e-9)


# -- identification ------------------------------------------------------------------------------

def test_identified_values_hold_at_the_temperature_of_the_recording(tmp_path):
    true = hmsa.Actuator(thermal=COEFFICIENTS)
    hot = true.at_temperature(45.0)
    levels = [(0.0, 0.0), (0.05, 0.03), (0.2, -0.02), (0.35, 0.02), (0.5, 0.0)]
    motion = hot.simulate(levels, until=0.7, noise=1e-5)
    found = hmsa.identify(
        (motion.times, motion.stretches), levels, actuator=true, temperature=45.0,
        free=['shear_modulus', 'damping_coefficient'])
    assert found.verdict == 'identified'
    found.to_yaml(tmp_path / 'found.yaml')
    values = yaml.safe_load((tmp_path / 'found.yaml').read_text())['/**']['ros__parameters']
    assert values['thermal.reference'] == 45.0
    assert values['actuator.remanence'] == pytest.approx(0.098)
    # Plans correct from there, and agree with the true actuator everywhere.
    again = hmsa.Actuator.from_yaml(tmp_path / 'found.yaml')
    for temperature in (15.0, 45.0, 60.0):
        assert again.at_temperature(temperature).flux_density(1.2) == pytest.approx(
            true.at_temperature(temperature).flux_density(1.2), rel=1e-3)


# -- a planner at work ---------------------------------------------------------------------------

def controller(actuator, **settings):
    """Return a loop of a controller and a device, with the notes of the controller."""
    device = SimulatedDevice(
        [SimulatedJoint(Setup(actuator))], period=10_000_000, time=NANOSECONDS)
    loop = Loop(PlannerGroup({'a': Planner(actuator, Options(lead_time=5_000_000))}), Settings(
        takeover_timeout=0, **settings), device)
    outputs = []
    loop.deliver = outputs.append
    return loop, device, outputs


def test_temperature_that_is_not_one_is_refused_and_the_last_one_stays():
    loop, _, outputs = controller(WARM)
    loop.runtime.temperature('a', 0, 40.0)
    for absurd in (math.nan, math.inf, 298.15, -300.0):
        loop.runtime.temperature('a', 0, absurd)
    assert loop.runtime.group.planners['a'].model.temperature == 40.0
    loop.run(loop.now + 1_000_000)
    notes = [x.message for x in outputs if isinstance(x, Note)]
    assert len(notes) == 1
    assert notes[0].startswith('joint a: temperature ignored: temperature is nan: expected')


def test_status_names_a_temperature_that_is_missing_or_old():
    loop, _, outputs = controller(WARM, temperature_max_age=NANOSECONDS)

    def accepted(stretch):
        loop.runtime.request(StretchRequest('a', stretch))
        loop.serve()
        return next(x.verdict.message for x in reversed(outputs) if isinstance(x, StatusChanged))

    assert accepted(1.1) == (
        'accepted; the temperature of joint a has not been measured: plans take 25 degrees '
        'Celsius, from thermal.ambient')
    loop.runtime.temperature('a', 0, 31.0)
    assert accepted(1.2) == 'accepted'
    loop.run(4 * NANOSECONDS)
    assert accepted(1.1) == (
        'accepted; the temperature of joint a is 3 s old: plans take 31 degrees Celsius, expected '
        'one within temperature_max_age')
    severity, message, values = loop.runtime.report()
    assert severity is Severity.WARN
    assert message.startswith('the temperature of joint a is 3 s old')
    assert values['temperature'] == '31.00'


def test_controller_without_coefficients_says_nothing_of_the_temperature():
    loop, _, _ = controller(paper_actuator())
    loop.runtime.temperature('a', 0, 60.0)
    loop.runtime.request(StretchRequest('a', 1.2))
    loop.run(2 * NANOSECONDS)
    assert not loop.runtime.temperatures.joints
    assert not any('temperature' in x for x in loop.runtime.report()[2])
    assert loop.runtime.group.planners['a'].plan.levels[-1].flux_density == Setup(
        paper_actuator()).holding(1.2)


def test_sequence_under_way_follows_the_measured_temperature():
    loop, device, _ = controller(WARM)
    loop.runtime.temperature('a', 0, 25.0)
    loop.runtime.request(Trajectory(('a',), [
        ((x,), round(t * NANOSECONDS)) for x, t in ((1.2, 2.0), (1.1, 4.0), (1.3, 6.0))], 3))
    loop.run(2 * NANOSECONDS)
    device.set_temperature(0, 40.0)
    loop.runtime.temperature('a', 0, 40.0)
    for end, target in ((2.9, 1.2), (4.9, 1.1), (6.9, 1.3)):
        loop.run(round(end * NANOSECONDS))
        assert float(device.stretch[0]) == pytest.approx(target, abs=1e-5)
    assert loop.runtime.report()[2]['replanned_for_temperature'] == 1


def test_magnets_that_get_too_hot_are_logged_once():
    loop, _, outputs = controller(replace(WARM, thermal=replace(THERMAL, limit=60.0)))
    for _ in range(4):
        loop.runtime.temperature('a', 0, 70.0)
    loop.run(loop.now + 1_000_000)
    assert ['above thermal.limit' in x.message for x in outputs if isinstance(x, Note)] == [True]
