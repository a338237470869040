"""Law beam: its mode, statics and plans against independent equations."""

from dataclasses import replace
import json
import math

from beam_oracle import (
    AREA,
    BENDING,
    DAMPING,
    DENSITY,
    follow,
    LENGTH,
    mode,
    REMANENCE,
    silicone,
    THICKNESS,
    WIDTH,
    YOUNGS,
)
import numpy as np
import pytest
from scipy.integrate import solve_bvp

from benchmarks.beam_segments import Chain
from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.interfaces.actuator import actuator_from, parameters_of
from hmsa.interfaces.parameters import BLOCK
from hmsa.model import equations
from hmsa.model.creep import Creep
from hmsa.model.laws import bending
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import MU_0
from hmsa.planning.planner import Options, Planner
from hmsa.planning.two_step import plan_two_step


def test_the_first_frequency_is_that_of_euler_and_bernoulli():
    beam = silicone()
    frequency = equations.natural_frequency(0.0, beam.nondimensional) / beam.time_unit
    wanted = mode()[4] ** 2 * math.sqrt(BENDING / (DENSITY * AREA * LENGTH ** 4))
    assert frequency == pytest.approx(wanted, rel=1e-10)


@pytest.mark.parametrize('deflection', [0.05, 0.3, -0.55, 0.7, 0.78])
def test_a_field_holds_the_deflection_that_the_full_elastica_has_within_3_percent(deflection):
    beam = silicone()
    flux = float(equations.elastic_force(deflection, beam.nondimensional)) * beam.flux_density_unit
    force = REMANENCE * flux / MU_0 * AREA * LENGTH ** 2 / BENDING
    s = np.linspace(0.0, 1.0, 30)
    angle = float(bending.angle_of(deflection))
    solved = solve_bvp(
        lambda _, z: np.vstack([z[1], -force * np.cos(z[0]), np.sin(z[0])]),
        lambda a, b: np.array([a[0], b[1], a[2]]), s,
        np.vstack([angle * np.sin(np.pi * s / 2), angle * (1.0 - s), deflection * s ** 2]),
        tol=1e-6)
    assert solved.success
    assert deflection == pytest.approx(solved.y[2, -1], rel=0.03)


@pytest.mark.parametrize(('start', 'target'), [
    (0.0, 0.3), (0.3, -0.2), (-0.1, 0.0), (0.2, 0.78), (0.75, -0.75)])
def test_a_two_step_plan_ends_at_rest_by_the_equation_of_the_angle(start, target):
    beam = silicone()
    plan = plan_two_step(start, target, beam.nondimensional)
    assert plan.code is Code.TWO_STEP
    unit, time = beam.flux_density_unit, beam.time_unit
    deflection, rate = follow(start, [(plan.tau_p * time, plan.beta_p * unit)])
    assert (deflection, rate * time) == pytest.approx((target, 0.0), abs=1e-10)
    # What holds the target: its plant stays there.
    _, held = follow(target, [(0.05, plan.beta_1 * unit)])
    assert abs(held * time) < 1e-8


def test_the_plant_swings_as_the_equation_of_the_angle_does():
    beam = silicone()
    plant = ActuatorSimulation(beam, stretch=0.1)
    flux = 0.7 * plant.flux_density * 4.0
    plant.command(0, flux)
    plant.advance(230_000_000)
    deflection, rate = follow(0.1, [(0.23, flux)])
    assert plant.stretch == pytest.approx(deflection, abs=1e-9)
    assert plant.rate * beam.time_unit == pytest.approx(rate * beam.time_unit, abs=1e-8)


@pytest.mark.parametrize(('changes', 'creep'), [
    ({'coil_time_constant': 2e-3}, Creep()), ({'slew_limit': 1.0}, Creep()),
    ({'period': 10_000_000}, Creep()), ({'shaper': 'robust'}, Creep()),
    ({'shaper': 'minimum_time'}, Creep()), ({'shaper': 'smooth'}, Creep()),
    ({'creep_tolerance': 1e-5}, Creep((0.1,), (0.2,)))])
def test_every_delivery_and_shaper_moves_a_beam_through_0_to_rest(changes, creep):
    beam = replace(silicone(), creep=creep)
    options = Options(flux_density_min=-0.02, flux_density_max=0.02, **changes)
    planner, plant = Planner(beam, options), ActuatorSimulation(
        beam, creep=creep, slew_limit=changes.get('slew_limit', math.inf),
        coil_time_constant=changes.get('coil_time_constant', 0.0))
    plan = planner.request([(0.3, 500_000_000), (-0.4, 1_500_000_000)], 0, 0)
    for level in plan.levels:
        plant.command(level.stamp, level.flux_density)
    plant.advance(plan.segments[-1].arrival + 1)
    assert plant.stretch == pytest.approx(-0.4, abs=1e-6)
    plant.advance(1_500_000_000)
    # The staircase that follows creep leaves what it was allowed.
    assert plant.stretch == pytest.approx(-0.4, abs=1e-5 if creep else 1e-6)


def test_parameters_of_a_beam_give_the_same_beam_and_modulus_and_geometry_scale_it():
    beam = silicone()
    again = actuator_from({x.name: x.default for x in BLOCK} | parameters_of(beam))
    assert again.shear_modulus == pytest.approx(beam.shear_modulus, rel=1e-14)
    assert again.nondimensional.zeta == pytest.approx(beam.nondimensional.zeta, rel=1e-14)
    stiffer = silicone(**{'mismatch.shear_modulus': 1.21, 'mismatch.half_thickness': 1.5})
    assert stiffer.shear_modulus == pytest.approx(1.21 * 1.5 ** 2 * beam.shear_modulus)


@pytest.mark.parametrize(('changes', 'message'), [
    ({'law.width': 0.0}, 'law.width is 0 m: expected a finite number above 0'),
    ({'law.youngs_modulus': 0.0}, 'constants of law beam'),
    ({'actuator.half_thickness': 0.004}, '0.008 m thick: expected a thickness of at most 0.25')])
def test_what_is_no_beam_is_refused_in_a_sentence(changes, message):
    with pytest.raises(BadInputError, match=message):
        silicone(**changes)


@pytest.mark.parametrize(('points', 'message'), [
    ([(0.9, 10 ** 9)], 'target deflection is 0.9: expected a deflection between'),
    ([(0.75, 10 ** 9)], 'deflection 0.75 needs a flux density of 0.01052 T')])
def test_refusals_speak_of_the_deflection(points, message):
    planner = Planner(silicone(), Options(flux_density_min=-0.01, flux_density_max=0.01))
    with pytest.raises(RefusedError, match=message):
        planner.request(points, 0, 0)
    with pytest.raises(BadInputError, match='^reset_stretch is 0.9: expected a deflection'):
        silicone().nondimensional.check(0.9, 'reset_stretch')


def test_the_law_of_a_running_planner_does_not_turn_stretches_into_deflections():
    planner = Planner(paper_actuator(), Options())
    with pytest.raises(BadInputError, match='would turn stretches into deflections'):
        planner.checked_model(Options(), silicone())


def test_the_tangent_of_a_bent_beam_is_the_slope_of_its_centreline():
    along, across = bending.centreline(0.4, 2001)
    for i in (500, 1000, 1500):
        slope = (across[i + 1] - across[i - 1]) / (along[i + 1] - along[i - 1])
        assert math.tan(float(bending.tangent(0.4, i / 2000))) == pytest.approx(slope, abs=1e-6)


def test_a_target_beyond_what_one_mode_describes_is_refused():
    with pytest.raises(BadInputError, match='a deflection between the limits -0.7862 and 0.7862'):
        ActuatorSimulation(silicone(), stretch=0.8)


@pytest.mark.parametrize(('target', 'offset'), [(0.1, 0.03), (0.6, 0.001)])
def test_other_modes_keep_little_of_a_two_step_move_on_a_chain_of_20_links(target, offset):
    beam = silicone()
    chain = Chain(
        20, LENGTH, WIDTH, THICKNESS, DENSITY, YOUNGS, REMANENCE, DAMPING)
    plan = plan_two_step(0.0, target, beam.nondimensional)
    unit, period = beam.flux_density_unit, chain.first_period
    _, deflection = chain.follow([
        (plan.tau_p * beam.time_unit, plan.beta_p * unit), (2.0 * period, plan.beta_1 * unit)],
        200)
    first, second = deflection[200:300], deflection[300:]
    # The static field bends more than one mode; the second mode rings, and is soon gone.
    assert second.mean() == pytest.approx((1.0 + offset) * target, abs=0.004 * target)
    assert np.ptp(first) < 0.025 * target
    assert np.ptp(second) < 0.01 * target


def test_a_parameter_file_of_a_beam_plans_its_deflection_to_both_sides(tmp_path, capsys, refusal):
    file = tmp_path / 'beam.yaml'
    words = ['init', '--beam', '--length', '25mm', '--thickness', '1mm', '--width', '5mm',
             '--shear-modulus', '333333.3333333333', '--density', '2g/cm3', '--remanence', '0.1',
             '--damping', '2e-4', '--flux-max', '10mT', '--out', str(file)]
    assert main([*words, '--joint', 'tip']) == 0
    told = capsys.readouterr()
    assert 'coil holds deflections     -0.74295 to 0.74295' in told.out
    assert 'a horizontal beam sags by 0.46 of its length' in told.err
    assert main(['plan', '-0.2:1', '0.3:1', '--params-file', str(file), '--json']) == 0
    first, second = json.loads(capsys.readouterr().out)['segments']
    beam = silicone()
    plan = plan_two_step(0.0, -0.2, beam.nondimensional)
    assert first['time_p'] == pytest.approx(plan.tau_p * beam.time_unit, rel=1e-8)
    assert second['flux_density_1'] == pytest.approx(
        float(equations.elastic_force(0.3, beam.nondimensional)) * beam.flux_density_unit,
        rel=1e-9)
    assert main(['plan', '-0.2:1', '--params-file', str(file)]) == 0
    assert 'deflection' in capsys.readouterr().out
    # From rest, which is not stretch 1.
    assert main(['sweep', '--params-file', str(file), '--target=-0.2']) == 0
    start, target, status, *found = capsys.readouterr().out.splitlines()[1].split(',')
    assert (start, target, status) == ('0.0', '-0.2', 'two_step')
    assert float(found[1]) == pytest.approx(first['time_p'], rel=1e-8)
    for wrong, said in (
            (['--half-length', '5mm'], 'expected sizes of a beam'),
            (['--youngs-modulus', '1MPa'], 'both --shear-modulus and --youngs-modulus')):
        assert said in refusal('', *words, *wrong, '--force')
    assert 'expected --beam with it' in refusal(
        'init --width 5mm --yes --out', tmp_path / 'x.yaml')
