"""Elastic laws: each against SymPy, finite differences and plans of 40 digits."""

from dataclasses import replace
from functools import cache
import json
import math

from extras import needs
import numpy as np
import pytest

from hmsa import motion
from hmsa.cli import main
from hmsa.columns import write_table
from hmsa.errors import AssumedWarning, BadInputError
from hmsa.identification.files import read_belief
from hmsa.identification.identify import identify
from hmsa.identification.measurement import Measurement
from hmsa.interfaces.actuator import actuator_from, parameters_of
from hmsa.interfaces.parameters import ACTUATOR, BLOCK
from hmsa.model.actuators import unheld
from hmsa.model.delivery import Delivery
from hmsa.model.equations import (
    elastic_energy,
    elastic_force,
    elastic_stiffness,
    equilibrium_stretch,
    stretch_limits,
)
from hmsa.model.laws import LAWS
from hmsa.model.moves import Setpoint, State
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import simulate
from hmsa.model.status import Code, RefusedError
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.two_step import Groups, plan_two_step, plan_two_step_batch
from hmsa.runs.parameters import read_parameter_file, recorded

mpmath = needs('mpmath')

# Constants and energy of each law, typed from the literature, by the stretch and two invariants.
CASES = {
    'neo_hookean': ({'actuator.shear_modulus': 9e3}, '4500 * (I1 - 3)'),
    'mooney_rivlin': ({'law.c10': 3e3, 'law.c01': 2e3}, '3000 * (I1 - 3) + 2000 * (I2 - 3)'),
    'yeoh': (
        {'law.c10': 5e3, 'law.c20': -200.0, 'law.c30': 40.0},
        '5000 * (I1 - 3) - 200 * (I1 - 3)**2 + 40 * (I1 - 3)**3'),
    'ogden': (
        {'law.mu': [6e3, -1500.0, 10.0], 'law.alpha': [1.5, -3.0, 8.0]},
        '4000 * (l**(3/2) + 2*l**(-3/4) - 3) + 500 * (l**-3 + 2*l**(3/2) - 3)'
        '+ 10/8 * (l**8 + 2*l**-4 - 3)'),
    'arruda_boyce': (
        {'law.mu': [9e3], 'law.lambda_m': 2.0},
        '9000 * (1/2 * (I1 - 3) + 1/20 / 4 * (I1**2 - 9) + 11/1050 / 16 * (I1**3 - 27)'
        '+ 19/7000 / 64 * (I1**4 - 81) + 519/673750 / 256 * (I1**5 - 243))'),
    'nonaffine': (
        {'law.gc': 6e3, 'law.ge': 3e3, 'law.lambda_m': 3.0},
        '1000 * (I1 - 3) - 54000 * log((27 - I1) / 24) + 3000 * (l + 2/sqrt(l) - 3)'
        '+ 3000 * (1/l + 2*sqrt(l) - 3)'),
    'extended_tube': (
        {'law.gc': 6e3, 'law.ge': 3e3, 'law.delta': 0.25, 'law.beta': 0.5},
        '3000 * (15/16 * (I1 - 3) / (1 - (I1 - 3)/16) + log(1 - (I1 - 3)/16))'
        '+ 24000 * (1/sqrt(l) + 2*l**(1/4) - 3)'),
}
STRETCHES = (0.3, 0.7, 0.999, 1.0, 1.0001, 1.4, 2.5)
# The pieces of a move, and the extrapolations of each: the end is converged to 1e-17.
PIECES, COLUMNS = 12, 10
every_law = pytest.mark.parametrize('name', CASES)


def block(name, constants=None):
    """Return the block of a law."""
    return actuator_from({x.name: x.default for x in BLOCK} | {'law.name': name} | (
        CASES[name][0] if constants is None else constants))


@cache
def in_units_of_the_modulus(name):
    """Return the modulus of a law, and its energy and force in units of it, by SymPy."""
    sympy = needs('sympy')
    stretch = sympy.Symbol('l', positive=True)
    energy = sympy.sympify(CASES[name][1], {
        'l': stretch, 'I1': stretch ** 2 + 2 / stretch, 'I2': 2 * stretch + stretch ** -2})
    modulus = sympy.simplify(sympy.diff(energy, stretch, 2).subs(stretch, 1) / 3)
    return float(modulus), [sympy.lambdify(
        stretch, sympy.diff(energy / modulus, stretch, order), 'mpmath') for order in range(3)]


def test_each_law_of_the_table_is_tested():
    # The others have tests of their own.
    assert CASES.keys() | {'gent', 'table', 'beam'} == LAWS.keys()


@every_law
def test_force_and_stiffness_are_derivatives_of_the_energy(name):
    actuator = block(name)
    modulus, derivatives = in_units_of_the_modulus(name)
    assert actuator.shear_modulus == pytest.approx(modulus, rel=1e-14)
    found = actuator.nondimensional
    for quantity, derivative, least in zip(
            (elastic_energy, elastic_force, elastic_stiffness), derivatives, (1e-15, 1e-14, 0.0),
            strict=True):
        with mpmath.workdps(40):
            exact = [float(derivative(mpmath.mpf(x))) for x in STRETCHES]
        assert quantity(STRETCHES, found) == pytest.approx(exact, rel=1e-12, abs=least)


@every_law
def test_derivatives_of_a_turning_point_are_those_of_finite_differences(name):
    packed = block(name).nondimensional.packed

    def turn(load):
        return motion.turning_point(1.1, 0.2, 1.0, load, 0.1, packed, 1e-13)

    status, _, _, by_load, time_by_load = turn(0.5)
    assert status == motion.DONE
    high, low = (np.array(turn(0.5 + x)[1:3]) for x in (1e-5, -1e-5))
    time, stretch = (high - low) / 2e-5
    assert (by_load, time_by_load) == pytest.approx((stretch, time), rel=1e-7, abs=1e-8)


@every_law
def test_equilibrium_is_the_inverse_of_the_force(name):
    group = block(name).nondimensional
    assert equilibrium_stretch(elastic_force(STRETCHES, group), group) == pytest.approx(
        STRETCHES, rel=1e-12)


def end_of(force, start, zeta, c1, beta, tau):
    """Return stretch and rate after a load, by extrapolated midpoint steps with 40 digits."""
    def slope(x, v):
        inertia = (x ** -3 + c1) / 6
        return v, (beta - force(x) - zeta * c1 / 2 * v + v * v * x ** -4 / 4) / inertia

    def midpoint(state, n):
        h = tau / PIECES / n
        before, now = state, [x + h * d for x, d in zip(state, slope(*state), strict=True)]
        for _ in range(n - 1):
            before, now = now, [
                x + 2 * h * d for x, d in zip(before, slope(*now), strict=True)]
        return [(x + y + h * d) / 2 for x, y, d in zip(before, now, slope(*now), strict=True)]

    state = [mpmath.mpf(start), mpmath.mpf(0)]
    for _ in range(PIECES):
        table = []
        for k in range(1, COLUMNS + 1):
            row = [midpoint(state, 2 * k)]
            for j, old in enumerate(table, 1):
                share = mpmath.mpf(k) ** 2 / (k - j) ** 2 - 1
                row.append([x + (x - y) / share for x, y in zip(row[-1], old, strict=True)])
            table = row
        state = table[-1]
    return state


@every_law
@pytest.mark.parametrize(('start', 'target'), [
    (1.2, 1.6), *(pytest.param(1.0, x, marks=pytest.mark.slow) for x in (1.1, 0.8))])
def test_a_plan_is_that_of_a_solution_with_40_digits(name, start, target):
    group = block(name).nondimensional
    plan = plan_two_step(start, target, group)
    assert plan.code is Code.TWO_STEP
    with mpmath.workdps(40):
        force = in_units_of_the_modulus(name)[1][1]
        zeta, c1 = mpmath.mpf(group.zeta), mpmath.mpf(group.c1)
        beta, tau = mpmath.mpf(plan.beta_p), mpmath.mpf(plan.tau_p)
        small = mpmath.mpf(10) ** -15
        x, v = end_of(force, start, zeta, c1, beta, tau)
        other = end_of(force, start, zeta, c1, beta + small, tau)
        a = (beta - force(x)) * 6 / (x ** -3 + c1)
        # Newton on load and time: what is left of its error is that of the plan squared.
        by_load, by_time = ((other[0] - x) / small, (other[1] - v) / small), (v, a)
        off = (target - x, -v)
        scale = by_load[0] * by_time[1] - by_load[1] * by_time[0]
        d_beta = (off[0] * by_time[1] - off[1] * by_time[0]) / scale
        d_tau = (by_load[0] * off[1] - by_load[1] * off[0]) / scale
    assert abs(d_beta) < 1e-11
    assert abs(d_tau) < 1e-10
    assert plan.beta_1 == pytest.approx(float(force(mpmath.mpf(target))), rel=1e-12)
    stretch, rate = simulate(
        [0.0, plan.tau_p], [plan.beta_p, plan.beta_1], np.linspace(0.0, plan.tau_p + 20.0, 50),
        group, stretch=start)
    assert abs(stretch[-1] - target) < 1e-9 * abs(target - start)
    assert abs(rate[-1]) < 1e-9 * abs(target - start)


def test_a_batch_plans_a_law_as_single_plans_do():
    group = block('ogden').nondimensional
    targets = np.array([0.7, 1.1, 1.5])
    batch = plan_two_step_batch(
        1.0, targets, Groups(zeta=group.zeta, c1=group.c1, elastic=group.law))
    assert batch.beta_p.tolist() == [plan_two_step(1.0, x, group).beta_p for x in targets]


# Constants of a force that falls, on which side.
FALLING = {
    'mooney_rivlin': ({'law.c10': 9e3, 'law.c01': -3e3}, 0),
    'yeoh': ({'law.c10': 5e3, 'law.c20': -900.0, 'law.c30': 0.0}, 1),
    'ogden': ({'law.mu': [-2e4], 'law.alpha': [-1.0]}, 1)}


@pytest.mark.parametrize('name', FALLING)
def test_what_cannot_be_held_is_refused_where_the_force_falls(name):
    constants, side = FALLING[name]
    group = block(name, constants).nondimensional
    limits = stretch_limits(group)
    edge = limits[side]
    assert edge not in (1e-3, 1e3)
    assert elastic_stiffness(edge, group) == pytest.approx(0.0, abs=1e-9)
    beyond = edge + (edge - 1.0) * 1e-3
    assert elastic_stiffness(beyond, group) < 0.0
    inside = edge - 0.2 * (edge - 1.0)
    assert plan_two_step(1.0, inside, group).code is Code.TWO_STEP
    with pytest.raises(BadInputError, match=f'between the limits .* of law {name}'):
        group.check(beyond)
    assert f'{edge:.4f}, where law {name} has a falling force' in unheld(group)
    # A motion may pass there, and a load that no stretch balances gives the limit.
    stretch, _ = simulate(
        [0.0], [0.0], np.linspace(0.0, 40.0, 400), group, rate=math.copysign(0.3, edge - 1.0),
        stretch=edge - (edge - 1.0) * 1e-3)
    assert np.any((stretch - edge) * (edge - 1.0) > 0.0)
    assert stretch[-1] == pytest.approx(1.0, abs=0.05)
    assert equilibrium_stretch(10.0 * elastic_force(edge, group), group) == pytest.approx(edge)


def test_a_move_that_collapses_where_the_force_falls_is_refused_and_others_are_found():
    group = block('mooney_rivlin', {'law.c10': 5e3, 'law.c01': -300.0}).nondimensional
    request = MoveRequest(State(1.0, -0.5), 0.3, group, delivery=Delivery(slew=2.0))
    fast, slow = (get_shaper(x)(request) for x in ('minimum_time', 'two_step'))
    assert (fast.code, fast.levels) == (Code.TWO_STEP, slow.levels)
    with pytest.raises(RefusedError, match='overshoots .* such as two_step'):
        plan_sequence([Setpoint(0.2, math.inf)], group, 'step')
    assert plan_sequence([Setpoint(0.2, math.inf)], group)[0].move.code is Code.TWO_STEP


@pytest.mark.parametrize(('name', 'constants', 'message'), [
    ('yeoh', {}, r'2 c10 of 0.001 to 1e\+12 Pa, got 0 Pa'),
    ('mooney_rivlin', {'law.c10': 1e3, 'law.c01': -2e3}, 'got -2000 Pa'),
    ('ogden', {'law.mu': [1e3], 'law.alpha': [1.0, 2.0]}, 'has 1 values and law.alpha 2'),
    ('ogden', {'law.mu': [1.0] * 4, 'law.alpha': [1.0] * 4}, 'expected 1 to 3 of both'),
    ('ogden', {'law.mu': [1e3], 'law.alpha': [0.0]}, 'expected no 0'),
    ('arruda_boyce', {'law.mu': [], 'law.lambda_m': 2.0}, 'law.mu has 0 values: expected one'),
    ('arruda_boyce', {'law.mu': [1e3]}, 'law.lambda_m is 0: expected more than 1'),
    ('nonaffine', {'law.gc': 1e3, 'law.lambda_m': 1.0}, 'law.lambda_m is 1: expected more than 1'),
    ('extended_tube', {'law.gc': 1e3}, 'law.beta is 0: expected more than 0'),
    ('extended_tube', {'law.gc': 1e3, 'law.delta': 0.9, 'law.beta': 1.0}, 'got -620 Pa')])
def test_constants_of_no_solid_are_refused_in_a_sentence(name, constants, message):
    with pytest.raises(BadInputError, match=message):
        block(name, constants)


@every_law
def test_parameters_of_a_block_give_the_same_block(name):
    actuator = block(name)
    again = actuator_from({x.name: x.default for x in BLOCK} | parameters_of(actuator))
    stretch = np.array(STRETCHES)
    assert again.shear_modulus == pytest.approx(actuator.shear_modulus, rel=1e-15)
    assert elastic_force(stretch, again.nondimensional) == pytest.approx(
        elastic_force(stretch, actuator.nondimensional), rel=1e-13)
    # Another modulus scales the law.
    stiffer = replace(actuator, shear_modulus=2.0 * actuator.shear_modulus)
    if actuator.law is not None:
        given = parameters_of(stiffer)
        for constant in LAWS[name].constants:
            value, factor = CASES[name][0][constant.name], 2.0 if constant.unit == 'Pa' else 1.0
            assert given[constant.name] == pytest.approx(
                [factor * x for x in value] if isinstance(value, list) else factor * value)


def test_gent_has_no_constants_of_a_law():
    assert paper_actuator().law is None
    assert set(parameters_of(paper_actuator())) == {
        x.name for x in ACTUATOR}
    assert block('neo_hookean').chain_limit == math.inf


def test_file_and_bag_with_the_former_name_of_the_parameter_are_read(tmp_path):
    file = tmp_path / 'old.yaml'
    file.write_text(
        '/**:\n  ros__parameters:\n    law: neo_hookean\n    left.law: yeoh\n    law.c10: 1.0\n')
    assert read_parameter_file(file) == {
        f'{node}.{name}': value for node in ('planner', 'plant') for name, value in (
            ('law.name', 'neo_hookean'), ('left.law.name', 'yeoh'), ('law.c10', 1.0))}
    with pytest.warns(AssumedWarning, match='parameters of left are not used'):
        assert read_belief(file).actuator.chain_limit == math.inf
    stored = {'/plant.use_sim_time': 'false', '/plant.law': '"neo_hookean"'}
    assert recorded(stored, '/')['plant.law.name'] == 'neo_hookean'


def test_a_plan_as_json_has_null_for_a_chain_limit_that_there_is_not(tmp_path, capsys):
    file = tmp_path / 'law.yaml'
    file.write_text('/**:\n  ros__parameters:\n    law.name: neo_hookean\n    law.c10: 5000.0\n')
    assert main(['plan', '1.1:10', '--params-file', str(file), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['j_lim'] is None


def record(true, targets, dwell, path):
    """Write a recording of unshaped steps with noise to a file; return it as arrays."""
    unit, group = true.flux_density_unit, true.nondimensional
    begins = np.append(0.0, 0.02 + dwell * np.arange(3 * len(targets)))
    levels = np.append(0.0, np.tile(elastic_force(np.array(targets), group), 3) * unit)
    times = np.arange(round((begins[-1] + dwell) * 1e3)) * 1e-3
    stretch, _ = simulate(
        begins / true.time_unit, levels / unit, times / true.time_unit, group)
    noisy = stretch + 1e-4 * np.random.default_rng(2).standard_normal(len(times))
    write_table(path, {
        'time': times, 'stretch': noisy,
        'flux_density': levels[np.searchsorted(begins, times, 'right') - 1]})
    return times, noisy, begins, levels


def test_identification_scales_a_law_and_keeps_the_ratios_of_its_constants(tmp_path):
    true = block('ogden')
    data, known, made = tmp_path / 'data.csv', tmp_path / 'known.yaml', tmp_path / 'found.yaml'
    arrays = record(true, (1.1, 1.4, 1.0), 0.05, data)
    known.write_text(
        '/**:\n  ros__parameters:\n    law.name: ogden\n    law.mu: [7200.0, -1800.0, 12.0]\n'
        '    law.alpha: [1.5, -3.0, 8.0]\n')
    assert main([
        'identify', str(data), '--params-file', str(known), '--out', str(made)]) == 0
    found = read_belief(made).actuator
    assert found.shear_modulus == pytest.approx(true.shear_modulus, rel=2e-3)
    assert parameters_of(found)['law.mu'] == pytest.approx([6e3, -1500.0, 10.0], rel=2e-3)
    with pytest.raises(BadInputError, match='chain_limit is free: expected none for law ogden'):
        identify(Measurement(*arrays), free=('chain_limit',), actuator=true)
