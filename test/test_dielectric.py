"""Law dielectric: motions and plans against the equation of the in-plane stretch, in SI units."""

import json
import math

import numpy as np
import pytest
from scipy.constants import epsilon_0
from scipy.integrate import solve_ivp

from hmsa_ros import Actuator
from hmsa_ros.cli import main
from hmsa_ros.errors import BadInputError
from hmsa_ros.identification.quantities import check_free
from hmsa_ros.model.actuators import Setup
from hmsa_ros.model.parameters import paper_actuator
from hmsa_ros.model.simulation import ActuatorSimulation
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.planning.planner import Options, Planner
from hmsa_ros.planning.two_step import plan_two_step

# A stack of silicone, in SI.
MODULUS, DENSITY, LENGTH, HEIGHT, LAYER, PERMITTIVITY, DAMPING = (
    1e5, 1100.0, 5e-3, 2e-3, 5e-5, 3.0, 0.9)
EPSILON = PERMITTIVITY * epsilon_0


def stack(limit: float = math.inf, **more: float) -> Actuator:
    """Return the stack, with a limiting extensibility."""
    return Actuator.dielectric(**{
        'half_length': LENGTH, 'half_thickness': HEIGHT, 'layer_thickness': LAYER,
        'permittivity': PERMITTIVITY, 'shear_modulus': MODULUS, 'density': DENSITY,
        'chain_limit': limit, 'damping_coefficient': DAMPING, **more})


def follow(ratio, rate, levels, limit=math.inf, dense=None):
    """
    Follow pairs of duration and voltage from a capacitance ratio and its rate.

    Integrates Lagrange's equation of the in-plane stretch s, per volume: the thickness is s^-2,
    and the electrodes of a layer store the energy eps (V/h)^2 s^4/2.
    """
    def change(_, y, volts):
        s, v = y
        mass = DENSITY * (2 * LENGTH ** 2 + 4 * HEIGHT ** 2 * s ** -6) / 3
        half = -4 * DENSITY * HEIGHT ** 2 * s ** -7
        drag = DAMPING * HEIGHT / (8 * LENGTH ** 2) * 4 * s ** -6
        elastic = 2 * MODULUS * (s - s ** -5) / (1 - (2 * s ** 2 + s ** -4 - 3) / limit)
        return [v, (2 * EPSILON * (volts / LAYER) ** 2 * s ** 3 - elastic - drag * v
                    - half * v * v) / mass]

    state = np.array([ratio ** 0.25, 0.25 * ratio ** -0.75 * rate])
    for duration, volts in levels:
        solved = solve_ivp(
            change, (0.0, duration), state, args=(volts,), method='DOP853', rtol=1e-12,
            atol=1e-14, t_eval=dense)
        state = solved.y[:, -1]
    s, v = solved.y if dense is not None else state
    return s ** 4, 4 * s ** 3 * v


@pytest.mark.parametrize(('limit', 'start', 'target'), [
    (math.inf, 1.0, 1.1), (math.inf, 1.0, 2.5), (50.0, 1.4, 1.0), (5.0, 1.2, 3.0)])
def test_a_plan_ends_at_rest_by_the_equation_of_the_stretch_in_the_plane(limit, start, target):
    block = stack(limit).block
    plan = plan_two_step(start, target, block.nondimensional)
    assert plan.code is Code.TWO_STEP
    units = block.units
    push, hold = (float(units.level(x)) for x in (plan.beta_p, plan.beta_1))
    ratio, rate = follow(start, 0.0, [(plan.tau_p * units.time, push)], limit)
    assert ratio == pytest.approx(target, abs=1e-10)
    after, _ = follow(
        ratio, rate, [(20 * units.time, hold)], limit, dense=np.linspace(0, 20 * units.time, 400))
    # The longest of these moves lands where next to nothing brings it back.
    assert np.ptp(after) < (1e-8 if target == 2.5 else 1e-9) * abs(target - start)


def test_the_plant_swings_as_that_equation_says_and_either_sign_of_the_voltage_attracts():
    plants = [ActuatorSimulation(stack(50.0).block, stretch=1.2) for _ in range(2)]
    expected = follow(1.2, 0.0, [(3e-3, 900.0)], 50.0)
    for plant, volts in zip(plants, (900.0, -900.0), strict=True):
        assert plant.flux_density == pytest.approx(1434.14, abs=0.01)
        plant.command(0, volts)
        plant.advance(3_000_000)
        assert plant.stretch == pytest.approx(expected[0], abs=1e-11)
        assert plant.rate == pytest.approx(expected[1], rel=1e-9)


def test_it_pulls_in_at_the_voltage_and_the_stretch_of_the_literature():
    block = stack()
    # X. Zhao, Z. Suo 2007: a stretch of 2^(1/3) at sqrt(eps/G) V/h of 0.687.
    limit, volts = 4 ** (2 / 3), math.sqrt(
        MODULUS / EPSILON * (2 ** (-2 / 3) - 2 ** (-8 / 3))) * LAYER
    assert block.scales.stretch_limits[1] == pytest.approx(limit, rel=1e-7)
    assert block.flux_density(limit) == pytest.approx(volts, rel=1e-9)
    assert math.sqrt(EPSILON / MODULUS) * volts / LAYER == pytest.approx(0.687, abs=5e-4)
    # Hardly less is reached and held, and more is refused, by name.
    assert block.plan([(2.51, 0.1)]).report()['status'] == ['two_step']
    with pytest.raises(RefusedError, match=r'2\.5198, a stretch of 1\.2599 in the plane, the '
                                           'actuator pulls in'):
        block.plan([(2.53, 0.1)])
    # A step swings beyond what would hold it.
    assert block.plan([(1.5, 0.1)], 'step').report()['status'] == ['step']
    with pytest.raises(RefusedError, match='overshoots and pulls in'):
        block.plan([(2.2, 0.1)], 'step')
    # What is held until further notice swings as far.
    with pytest.raises(RefusedError, match='overshoots and pulls in'):
        Planner(block.block, Options(flux_density_max=1e4, shaper='step')).setpoint(2.2, 0)
    # Chains that lock early leave no way to pull in.
    assert stack(5.0).plan([(3.0, 0.1)]).report()['status'] == ['two_step']


@pytest.mark.parametrize('shaper', ['two_step', 'robust', 'minimum_time', 'smooth'])
def test_a_planner_sends_volts_and_the_plant_rests_between_its_limits(shaper):
    block = stack(50.0).block
    planner = Planner(block, Options(
        shaper=shaper, flux_density_min=-0.5, flux_density_max=2100.0))
    plan = planner.request([(1.4, 100_000_000), (1.0, 200_000_000)], 0, 0)
    plant = ActuatorSimulation(block)
    levels = [x for x in plan.levels if x.stamp >= 0]
    assert all(0.0 <= x.flux_density <= 2100.0 for x in levels)
    for level in levels:
        plant.command(level.stamp, level.flux_density)
    for segment in plan.segments:
        plant.advance(segment.arrival + 1)
        assert plant.stretch == pytest.approx(segment.stretch, abs=1e-6)
        assert abs(plant.rate * block.time_unit) < 1e-5


def test_a_wave_in_volts_is_followed_by_the_equation_of_the_stretch_in_the_plane():
    block = stack(50.0)
    plan = block.wave('sine', 50.0, 0.2, offset=1.4, cycles=3)
    times, volts = plan.levels.T
    assert 1800.0 < volts.max() < 2100.0
    assert volts.min() >= 0.0
    seen = plan.simulate()
    at = float(times[len(times) // 2])
    place = int(np.searchsorted(seen.times, at))
    spans = np.diff(np.append(times[times < seen.times[place]], seen.times[place]))
    ratio, _ = follow(1.0, 0.0, zip(spans.tolist(), volts.tolist(), strict=False), 50.0)
    assert seen.stretches[place] == pytest.approx(ratio, abs=1e-9)
    assert np.max(seen.stretches) == pytest.approx(1.6, abs=1e-4)


@pytest.mark.parametrize(('make', 'message'), [
    (lambda: stack(remanence=0.1), 'nothing in a dielectric elastomer is magnetised'),
    (lambda: stack(slew_limit=1e6), 'driven by steps of the voltage alone'),
    (lambda: stack(coil_time_constant=1e-3), 'driven by steps of the voltage alone'),
    (lambda: stack(creep=[(0.1, 0.1)]), '1 viscoelastic branches'),
    (lambda: Setup(stack().block, slew_limit=1e6), 'driven by steps'),
    (lambda: Setup(stack().block).check_force(0.1), 'expected 0 for law dielectric'),
    (lambda: stack(layer_thickness=0.0), 'layer_thickness is 0: expected more than 0'),
    (lambda: stack().plan([(0.9, 0.1)]), 'needs a voltage of -1303 V: expected 0 V to 5000 V'),
    (lambda: stack().amplifiers([(1.1, 0.1)]), 'driven by steps of the voltage alone'),
    (lambda: check_free(['shear_modulus'], stack().block.law), 'not identified with')])
def test_what_a_voltage_has_no_model_of_is_refused_with_a_sentence(make, message):
    with pytest.raises(BadInputError, match=message):
        make()


def test_the_law_of_a_running_planner_does_not_turn_stretches_into_capacitance_ratios():
    planner = Planner(paper_actuator(), Options())
    with pytest.raises(BadInputError, match='would turn stretches into capacitance ratios'):
        planner.checked_model(Options(), stack().block)


def test_the_page_of_a_run_shows_volts(tmp_path):
    path = tmp_path / 'page.html'
    assert stack(50.0).plan([(1.4, 0.1)]).simulate().report(path)['verdict'] == ['arrived']
    shown = path.read_text()
    for words in (
            'voltage U (V)', 'Above, the voltage commanded', 'U planned [V]', 'voltage of load 1',
            'Each change of level: voltage planned'):
        assert words in shown
    assert 'flux density' not in shown.partition('All parameters that were recorded')[0]


def test_the_parameters_of_an_actuator_give_it_again_and_scale_it():
    block = stack(50.0)
    assert Actuator.from_parameters(block.parameters) == block
    assert block.replace(density=1200.0).block.density == 1200.0
    stiffer = block.scaled(shear_modulus=1.21)
    assert stiffer.flux_density(1.3) == pytest.approx(1.1 * block.flux_density(1.3), rel=1e-12)
    assert stiffer.stretch(1.1 * block.flux_density(1.3)) == pytest.approx(1.3, rel=1e-12)


def test_init_writes_a_file_with_which_plan_shows_volts(tmp_path, capsys):
    path = tmp_path / 'stack.yaml'
    sizes = ['--half-length', '5mm', '--half-thickness', '2mm', '--layer-thickness', '50\u03bcm']
    assert main([
        'init', '--dielectric', *sizes, '--permittivity', '3', '--shear-modulus', '100kPa',
        '--j-lim', '50', '--voltage-max', '5kV', '--yes', '--out', str(path)]) == 0
    assert 'amplifier holds capacitance ratios' in capsys.readouterr().out
    assert 'remanence' not in path.read_text()
    assert main(['plan', '1.2:0.1', '--params-file', str(path)]) == 0
    assert 'voltage_1 (V)' in capsys.readouterr().out
    assert main(['plan', '1.2:0.1', '--params-file', str(path), '--json']) == 0
    segment, = json.loads(capsys.readouterr().out)['segments']
    assert segment['flux_density_1'] == pytest.approx(1434.14, abs=0.01)
    assert segment['levels'][-1] == [segment['time_p'], segment['flux_density_1']]
    for wrong, words in (
            (['--beam'], 'both --beam and --dielectric'), (['--remanence', '0.1'], '--remanence'),
            (['--law', 'yeoh:c10=1kPa'], 'with --dielectric')):
        assert main(['init', '--dielectric', *wrong, '--yes', '--out', str(path), '--force']) == 2
        assert words in capsys.readouterr().err
