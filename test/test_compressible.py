"""A compressible block, against its Lagrangian, the modes of a continuum, and finite elements."""

from dataclasses import replace
from datetime import datetime
import json
import math
import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from benchmarks.block_elements import Block
from hmsa import Actuator
from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.identification.files import Belief, file_text
from hmsa.identification.identify import identify
from hmsa.identification.measurement import Measurement
from hmsa.identification.quantities import actuator_of, DEFAULT_FREE, Known, values_of
from hmsa.identification.response import difference, respond
from hmsa.model import equations
from hmsa.model.actuators import Actuators, Setup
from hmsa.model.compressible import condensed
from hmsa.model.continuum import mounted, spectrum
from hmsa.model.delivery import Delivery
from hmsa.model.laws import LAWS
from hmsa.model.moves import Level, State
from hmsa.model.parameters import ActuatorParameters, NondimensionalParameters, paper_actuator
from hmsa.model.simulation import follow, sampled
from hmsa.planning.shapers import get_shaper, SHAPERS
from hmsa.planning.shapers.request import MoveRequest
from hmsa_lab.adapt.prior import Prior

RATIOS = (1.0, 3.0, 10.0, 100.0, 1000.0, 1e6)
J_LIM = 5.0
# Energies at constant volume of three principal stretches, in units of the shear modulus.
YEOH = LAWS['yeoh'].scaled({'law.c10': 5e3, 'law.c20': -200.0, 'law.c30': 40.0})[1]
OGDEN = LAWS['ogden'].scaled({'law.mu': [6e3, 100.0], 'law.alpha': [1.3, 5.0]})[1]
NONAFFINE = LAWS['nonaffine'].scaled({'law.gc': 7e3, 'law.ge': 3e3, 'law.lambda_m': 3.0})[1]


def gent(*stretches, log=np.log):
    left = 1.0 - (sum(x * x for x in stretches) - 3.0) / J_LIM
    return -0.5 * J_LIM * log(left)


def yeoh(*stretches):
    x = sum(x * x for x in stretches) - 3.0
    return 0.5 * (x - 0.04 * x ** 2 + 0.008 * x ** 3)


def ogden(*stretches):
    unit = 0.5 * (6e3 * 1.3 + 100.0 * 5.0)
    return sum(mu / unit / a * (sum(x ** a for x in stretches) - 3.0)
               for mu, a in ((6e3, 1.3), (100.0, 5.0)))


def nonaffine(*stretches):
    unit = 7e3 * (1.0 + 2.0 / (3.0 * 8.0)) + 3e3
    square = sum(x * x for x in stretches)
    return (7e3 * (square / 6.0 - 9.0 * np.log((27.0 - square) / 24.0) - 0.5)
            + 3e3 * (sum(x + 1.0 / x for x in stretches) - 6.0)) / unit


MODELS = {'gent': (gent, None), 'yeoh': (yeoh, YEOH), 'ogden': (ogden, OGDEN),
          'nonaffine': (nonaffine, NONAFFINE)}
# Small motion of a free Gent block on explicit finite elements: bricks with mean dilatation, of
# the same energy. By H/L and K/G: stretch at rest, load that holds it, and frequency of the first
# mode, extrapolated from two meshes, of 2 to 6 elements along each edge and of twice as many.
ELEMENTS = {
    (1.0, 3.0): [(0.9, -0.303789, 2.22580), (0.95, -0.142719, 2.24585), (1, 0.000000, 2.22247),
        (1.1, 0.245807, 2.14438), (1.2, 0.456343, 2.07503)],
    (1.0, 10.0): [(0.9, -0.326475, 2.24597), (0.95, -0.153348, 2.24452), (1, 0.000000, 2.22208),
        (1.1, 0.265294, 2.16575), (1.2, 0.495590, 2.12659)],
    (1.0, 100.0): [(0.9, -0.335697, 2.25052), (1, 0.000000, 2.22197), (1.2, 0.514328, 2.15138)],
    (1.0, 1000.0): [(0.9, -0.336634, 2.25091), (1, 0.000000, 2.22196), (1.2, 0.516349, 2.15407)],
    (0.5, 3.0): [(0.9, -0.303789, 2.80252), (0.95, -0.142719, 2.84412), (1, 0.000000, 2.88718),
        (1.1, 0.245807, 2.98048), (1.2, 0.456343, 3.08508)],
    (0.5, 10.0): [(0.9, -0.326475, 2.98999), (1, 0.000000, 3.02912), (1.2, 0.495590, 3.19932)],
    (0.5, 100.0): [(0.9, -0.335697, 3.05673), (1, 0.000000, 3.08003), (1.2, 0.514328, 3.24754)],
    (0.5, 1000.0): [(0.9, -0.336634, 3.06318), (1, 0.000000, 3.08498), (1.2, 0.516349, 3.25256)],
    (2.0, 3.0): [(0.9, -0.303789, 1.39086), (1, 0.000000, 1.25428), (1.2, 0.456343, 1.09127)],
    (2.0, 10.0): [(0.9, -0.326475, 1.40741), (1, 0.000000, 1.28041), (1.2, 0.495590, 1.13840)],
    (2.0, 100.0): [(0.9, -0.335697, 1.41229), (1, 0.000000, 1.29005), (1.2, 0.514328, 1.16172)],
    (2.0, 1000.0): [(0.9, -0.336634, 1.41274), (1, 0.000000, 1.29100), (1.2, 0.516349, 1.16427)]}


def energy(of, bulk, stretch, side):
    """Return the energy of a block by both stretches, of real or complex numbers."""
    volume = stretch * side * side
    scale = volume ** (-1.0 / 3.0)
    return of(scale * stretch, scale * side, scale * side) + 0.5 * bulk * (volume - 1.0) ** 2


def slope(f, x, h=1e-30):
    """Return a derivative by a complex step, exact to rounding."""
    return f(x + 1j * h).imag / h


def side_at(of, bulk, stretch):
    """Return the transverse stretch in equilibrium."""
    return brentq(  # for volumes of 0.5 to 2
        lambda q: slope(lambda z: energy(of, bulk, stretch, z), q), math.sqrt(0.5 / stretch),
        math.sqrt(2.0 / stretch), xtol=1e-16, rtol=1e-15)


def block(bulk, **more):
    return NondimensionalParameters(
        **{'zeta': 0.2, 'j_lim': J_LIM, 'law': condensed(None, J_LIM, bulk)} | more)


# -- statics and inertia ------------------------------------------------------------------------

@pytest.mark.parametrize('bulk', RATIOS)
@pytest.mark.parametrize('name', MODELS)
def test_sides_are_free_of_stress_at_each_stretch(name, bulk):
    of, law = MODELS[name]
    material = NondimensionalParameters(law=condensed(law, J_LIM, bulk), c1=2.0)
    lower, upper = material.limits
    for stretch in (0.75, 0.9, 0.999, 1.0, 1.001, 1.1, 1.3, 1.6):
        assert lower < stretch < upper
        q = side_at(of, bulk, stretch)
        force = slope(lambda z, q=q: energy(of, bulk, z, q), stretch)
        assert float(equations.elastic_force(stretch, material)) == pytest.approx(
            force, rel=1e-11, abs=1e-14 * bulk)
        assert float(equations.elastic_energy(stretch, material)) == pytest.approx(
            energy(of, bulk, stretch, q), rel=1e-11, abs=1e-13)
        # The inertia contains dq/dl, here by differences.
        h = 1e-4
        change = (8.0 * (side_at(of, bulk, stretch + h) - side_at(of, bulk, stretch - h))
                  - side_at(of, bulk, stretch + 2 * h) + side_at(of, bulk, stretch - 2 * h)) / (
                      12.0 * h)
        assert float(equations.mass(stretch, material)) == pytest.approx(
            (4.0 * change ** 2 + 2.0) / 6.0, rel=1e-9)


@pytest.mark.parametrize('bulk', RATIOS)
def test_stiffness_and_inertia_at_rest_are_those_of_hooke(bulk):
    material = block(bulk)
    nu = (3.0 * bulk - 2.0) / (6.0 * bulk + 2.0)
    young = 2.0 * (1.0 + nu)
    assert float(equations.elastic_force(1.0, material)) == 0.0
    assert float(equations.elastic_stiffness(1.0, material)) == pytest.approx(young, rel=1e-11)
    assert float(equations.mass(1.0, material)) == pytest.approx(
        (4.0 * nu ** 2 + 2.0) / 6.0, rel=1e-11)


def test_large_bulk_modulus_is_constant_volume():
    still, stretches = NondimensionalParameters(zeta=0.2, j_lim=J_LIM), np.linspace(0.6, 1.8, 50)
    for bulk in (1e4, 1e6):
        for of in (equations.elastic_force, equations.mass, equations.natural_frequency):
            assert of(stretches, block(bulk)) == pytest.approx(
                of(stretches, still), rel=20.0 / bulk)


def test_infinite_bulk_modulus_leaves_the_model_of_the_paper_untouched():
    given, plain = Actuator(bulk_ratio=math.inf), Actuator()
    assert given.block.nondimensional.law is None
    one, other = (x.block.nondimensional.packed.tobytes() for x in (given, plain))
    assert one == other
    assert given.parameters == plain.parameters
    assert 'actuator.bulk_ratio' not in plain.parameters


@pytest.mark.parametrize('bulk', [1.0, 1e6])
def test_tables_are_no_longer_than_needed(bulk):
    law = condensed(None, J_LIM, bulk)
    assert law.constants[0] < 400
    assert law.limits[0] < 0.7
    assert law.limits[1] > 2.5


# -- motion and plans ---------------------------------------------------------------------------

def gent_stress(s):
    """Return s psi' and its derivative by s."""
    left = 1.0 - (s * s + 2.0 / s - 3.0) / J_LIM
    stress = (s * s - 1.0 / s) / left
    return stress, (2.0 * s + 1.0 / s ** 2) / left + stress * 2.0 * (
        s - 1.0 / s ** 2) / J_LIM / left


class Lagrangian:
    """
    The block by the stretch s at constant volume, of which length and side are given functions.

    L = (c1/12 l'^2 + q'^2/3) - W + beta l, with the dissipation zeta c1/4 l'^2, and with the
    overstress of branches of ratios and times.
    """

    def __init__(
            self, bulk, zeta=0.2, c1=2.0, exponent=0.0, stress=gent_stress, ratios=(), times=()):
        self.bulk, self.zeta, self.c1, self.exponent = bulk, zeta, c1, exponent
        self.stress, self.ratios, self.times = stress, np.array(ratios), np.array(times)

    def shape(self, s):
        """Return length, side, their derivatives by s, force, and its; of complex s, too."""
        stress, by_s = self.stress(s)
        volume = 0.5 + np.sqrt(0.25 + stress / (3.0 * self.bulk))
        grows = by_s / (3.0 * self.bulk * (2.0 * volume - 1.0))
        root = volume ** (1.0 / 3.0)
        change = root / volume * grows / 3.0
        length, by_length = s * root, root + s * change
        return (length, root / np.sqrt(s), by_length,
                change / np.sqrt(s) - 0.5 * root * s ** -1.5, stress / length,
                by_s / length - stress * by_length / length ** 2)

    def inertia(self, s):
        stretch, _, length, side, *_ = self.shape(s)
        return self.c1 / 6.0 * length ** 2 + 2.0 / 3.0 * side ** 2 * stretch ** -self.exponent

    def follow(self, levels, end, start=1.0, rate=0.0, followed=None):
        """Return stretch and rate at an end time, by default from rest with relaxed branches."""
        def motion(_, y, load):
            s, v, held = y[0], y[1], y[2:]
            _, _, by_s, _, force, by_force = self.shape(s)
            push = (load - force - held.sum()) * by_s - (
                0.5 * self.zeta * self.c1 * by_s ** 2 * v + 0.5 * slope(self.inertia, s) * v * v)
            return [v, push / self.inertia(s), *(self.ratios * by_force * v - held / self.times)]

        s = 1.0 if start == 1.0 else brentq(
            lambda x: self.shape(x)[0] - start, 0.8 * min(1.0, start), 1.2 * max(1.0, start),
            xtol=1e-15)
        _, _, by_s, _, force, _ = self.shape(s)
        relaxed = force if followed is None else np.array(followed)
        y = np.array([s, rate / by_s, *(self.ratios * (force - relaxed))])
        for x, until in zip(levels, [*(x.time for x in levels[1:]), end], strict=True):
            if until > x.time:
                y = solve_ivp(motion, (x.time, until), y, method='DOP853', rtol=3e-14, atol=1e-15,
                              args=(x.load,)).y[:, -1]
        length, _, by_s, *_ = self.shape(y[0])
        return length, by_s * y[1]


@pytest.mark.parametrize('bulk', [1.0, 3.0, 10.0, 100.0, 1000.0, 1e6])
def test_two_step_command_brings_its_lagrangian_to_rest(bulk):
    for start, target in ((1.0, 1.1), (1.0, 0.8), (1.1, 1.6)):
        move = get_shaper('two_step')(MoveRequest(State(start), target, block(bulk)))
        stretch, rate = Lagrangian(bulk).follow(move.levels, move.duration, start)
        assert (stretch, rate) == pytest.approx((target, 0.0), abs=1e-10)


@pytest.mark.parametrize('exponent', [-1.0, 5.7])
def test_transverse_inertia_may_change_with_a_power_of_the_stretch(exponent):
    material = block(3.0, law=condensed(None, J_LIM, 3.0, exponent))
    for start, target in ((1.0, 0.9), (0.9, 1.2)):
        move = get_shaper('two_step')(MoveRequest(State(start), target, material))
        assert Lagrangian(3.0, exponent=exponent).follow(
            move.levels, move.duration, start) == pytest.approx((target, 0.0), abs=1e-10)


@pytest.mark.parametrize('name', SHAPERS)
def test_commands_of_all_shapers_move_it_as_its_lagrangian(name):
    material, bulk = block(10.0), 10.0
    move = get_shaper(name)(MoveRequest(State(1.0), 1.3, material))
    end = min(move.duration, 20.0) if math.isfinite(move.duration) else 4.0
    found = follow(move.levels, State(1.0), end, material, Delivery())
    assert (found.stretch, found.rate) == pytest.approx(
        Lagrangian(bulk).follow([x for x in move.levels if x.time < end], end), abs=1e-10)


def test_plant_moves_as_the_lagrangian():
    actuator = replace(paper_actuator(), bulk_ratio=3.0)
    plant, unit, load = Actuators([Setup(actuator)]), actuator.time_unit, actuator.units.load
    plant.command(0, 0, 0.3 * load)
    plant.advance(round(1.5 * unit * 1e9))
    time = round(1.5 * unit * 1e9) / 1e9 / unit
    stretch, rate = Lagrangian(3.0).follow([Level(0.0, 0.3)], time)
    assert plant.stretch[0] == pytest.approx(stretch, abs=1e-9)
    assert plant.rate[0] * unit == pytest.approx(rate, abs=1e-9)


def test_motion_beyond_the_tables_ends_and_says_so():
    material = block(3.0)
    assert material.limits[1] < 10.0
    assert 'law gent with bulk_ratio 3' in material.beyond(9.9)
    assert math.isnan(float(equations.elastic_force(9.9, material)))


# -- continuum ----------------------------------------------------------------------------------

@pytest.mark.parametrize('bulk', [3.0, 10.0, 100.0])
def test_lame_mode_of_the_cube_does_not_depend_on_the_bulk_modulus(bulk):
    found = spectrum(1.0, 'free', bulk_ratio=bulk)
    assert np.min(abs(found.frequencies - math.pi / math.sqrt(2.0))) < 1e-4 * found.frequencies[0]


@pytest.mark.parametrize('bulk', [3.0, 30.0])
def test_slender_block_is_a_bar_with_youngs_modulus(bulk):
    found = spectrum(10.0, 'free', bulk_ratio=bulk)
    young = 9.0 * bulk / (3.0 * bulk + 1.0)
    assert found.frequencies[found.first] == pytest.approx(
        0.5 * math.pi / 10.0 * math.sqrt(young), rel=5e-3)
    assert found.compliance == pytest.approx(3.0 / young, rel=1e-3)


def test_first_mode_is_followed_where_another_one_has_a_larger_share():
    # Of a compressible cube about 0.9, the second mode has the larger share.
    there = spectrum(1.0, 'free', 0.9, J_LIM, 3.0)
    first = spectrum(1.0, 'free', bulk_ratio=3.0)
    at_rest = first.frequencies[first.first]
    assert there.frequencies[there.first] > 1.15 * at_rest
    assert there.frequencies[there.like(at_rest)] == pytest.approx(at_rest, rel=0.01)
    found = mounted(1.0, 'free', J_LIM, 0.05, 3.0)
    assert 0.3 < found.transverse_mass_factor < 5.0


# Where the second mode approaches the first, too; of a cube of K/G 3, most.
@pytest.mark.parametrize(('shape', 'bulk'), [(1.0, 3.0), *(
    pytest.param(*x, marks=pytest.mark.slow) for x in ((0.2, 10.0), (0.5, 3.0)))])
def test_first_mode_has_one_frequency_between_compression_and_tension(shape, bulk):
    free = free_block(shape, bulk)
    first = spectrum(shape, 'free', bulk_ratio=bulk)
    at_rest = first.frequencies[first.first]
    for stretch in (0.9, 0.93, 0.97, 1.05, 1.15, 1.2):
        there = spectrum(shape, 'free', stretch, J_LIM, bulk)
        assert frequency(free, stretch) == pytest.approx(
            there.frequencies[there.like(at_rest)], rel=4e-3)


@pytest.mark.parametrize('stretch', [0.9, 1.2])
def test_statics_of_the_continuum_about_a_stretch_are_those_of_the_model(stretch):
    found = spectrum(0.7, 'free', stretch, J_LIM, 5.0)
    stiffness = float(equations.elastic_stiffness(stretch, block(5.0)))
    assert found.compliance / 3.0 * stiffness == pytest.approx(1.0, abs=1e-6)


def free_block(shape, bulk):
    return Actuator(
        half_thickness=0.01 * shape, bulk_ratio=bulk, chain_limit=J_LIM, mount='free').block


def frequency(actuator, stretch):
    """Return the frequency of the first mode about a stretch, in units of sqrt(G/rho)/L."""
    unit = actuator.half_length * math.sqrt(actuator.density / actuator.shear_modulus)
    return float(equations.natural_frequency(
        stretch, actuator.nondimensional)) * unit / actuator.time_unit


@pytest.mark.parametrize('case', [pytest.param(x, marks=() if x in (
    (1.0, 3.0), (0.5, 10.0)) else pytest.mark.slow) for x in ELEMENTS])
def test_free_block_rests_and_vibrates_as_explicit_finite_elements(case):
    free = free_block(*case)
    for stretch, load, exact in ELEMENTS[case]:
        rest = equations.equilibrium_stretch(load, free.nondimensional)
        assert float(rest) == pytest.approx(stretch, abs=2e-3 * abs(stretch - 1.0) + 1e-9)
        assert frequency(free, stretch) == pytest.approx(exact, rel=5e-3)


def test_finite_elements_rest_and_vibrate_as_the_model():
    bulk, shape, squared = 10.0, 0.5, []
    free = Actuator(half_thickness=5e-3, bulk_ratio=bulk, chain_limit=J_LIM, mount='free').block
    load = float(equations.elastic_force(1.2, free.nondimensional))
    for cells in ((3, 3, 2), (6, 6, 4)):
        mesh = Block(shape, J_LIM, 0.0, cells, bulk=bulk)
        frequencies, shares = mesh.modes()
        squared.append(frequencies[np.argmax(shares)] ** 2)
    mesh = Block(shape, J_LIM, 0.0, (3, 3, 2), bulk=bulk)
    mesh.settle(load)
    assert mesh.stretch == pytest.approx(1.2, abs=0.2 * 1e-6)
    unit = free.half_length * math.sqrt(free.density / free.shear_modulus)
    assert 2.0 * math.pi / free.period * unit == pytest.approx(
        math.sqrt((4.0 * squared[1] - squared[0]) / 3.0), rel=5e-3)


# -- parameters ---------------------------------------------------------------------------------

def test_mounted_block_survives_a_parameter_file(tmp_path):
    free = Actuator(bulk_ratio=3.0, mount='free')
    assert free.parameters['actuator.transverse_mass_exponent'] == pytest.approx(5.7, abs=0.1)
    free.to_yaml(tmp_path / 'free.yaml')
    assert Actuator.from_yaml(tmp_path / 'free.yaml') == free
    assert actuator_of(values_of(free.block)) == free.block
    with pytest.raises(BadInputError, match='transverse_mass_exponent is 2: expected 0 without'):
        replace(paper_actuator(), transverse_mass_exponent=2.0)
    with pytest.raises(BadInputError, match='transverse_mass_exponent is 20: expected -10 to 10'):
        replace(free.block, transverse_mass_exponent=20.0)


@pytest.mark.parametrize(('more', 'said'), [
    ({'bulk_ratio': 0.5}, 'bulk_ratio is 0.5: expected 1 to 1e\\+06, or inf'),
    ({'bulk_ratio': 1e8}, 'bulk_ratio is 1e\\+08: expected 1 to'),
    ({'bulk_ratio': math.nan}, 'bulk_ratio is nan'),
    ({'bulk_ratio': 5.0, 'law': 'beam'}, 'bulk_ratio is 5 for a beam'),
    ({'bulk_ratio': 5.0, 'law': 'table'}, 'bulk_ratio is 5 for a table, whose levels contain')])
def test_bulk_ratio_that_an_actuator_cannot_have_is_refused(more, said):
    laws = {
        'beam': lambda: Actuator.beam(
            length=10e-3, thickness=1e-3, width=5e-3, youngs_modulus=2e6).block,
        'table': lambda: Actuator(law='table', constants={
            'stretch': [0.8, 0.9, 1.0, 1.1, 1.2, 1.3],
            'flux_density': [-0.1, -0.05, 0.0, 0.05, 0.1, 0.15]}).block}
    given: ActuatorParameters = laws.get(more.get('law'), paper_actuator)()
    with pytest.raises(BadInputError, match=said):
        replace(given, bulk_ratio=more['bulk_ratio'])


def test_file_keeps_a_compressible_block_and_says_what_it_changes(tmp_path, capsys):
    path = tmp_path / 'block.yaml'
    assert main(['init', '--half-length', '10mm', '--zeta', '0.2', '--flux-max', '400mT', '--yes',
                 '--bulk-ratio', '10', '--law', 'yeoh:c10=5kPa,c20=-200,c30=40',
                 '--out', str(path)]) == 0
    out = capsys.readouterr().out
    assert re.search("Poisson's ratio +0\\.4516\n", out)
    assert re.search(r'two_step, constant volume +leaves \d', out)
    # The first mode of a cube is its Lame mode, at any bulk modulus.
    rows = dict(re.findall(r'(with constant volume|first mode, mount free) +([\d.]+) Hz', out))
    assert float(rows['first mode, mount free']) == pytest.approx(
        float(rows['with constant volume']) * math.pi / math.sqrt(12.0), rel=1e-4)
    assert '; uniform deformation is 12 % above' in out
    assert '    actuator.bulk_ratio: 10.0' in path.read_text()
    made = Actuator.from_yaml(path)
    assert made.block.bulk_ratio == 10.0
    assert main(['plan', '1.1:0.2', '--params-file', str(path), '--json']) == 0
    row, = json.loads(capsys.readouterr().out)['segments']
    assert row['flux_density_1'] == pytest.approx(made.flux_density(1.1), rel=1e-9)


def test_plan_in_units_of_the_paper_takes_a_bulk_modulus(capsys, refusal):
    assert main(['plan', '1.2:10', '--bulk-ratio', '10', '--json']) == 0
    row, = json.loads(capsys.readouterr().out)['segments']
    assert row['beta_1'] == pytest.approx(
        float(equations.elastic_force(1.2, block(10.0))), rel=1e-12)
    assert 'bulk_ratio is 0.1: expected 1 to 1e+06' in refusal('plan 1.2:10 --bulk-ratio 0.1')


def test_dimensionless_group_gives_the_block_back():
    given = replace(paper_actuator(), bulk_ratio=7.0)
    assert ActuatorParameters.from_nondimensional(
        given.nondimensional, shear_modulus=1.0e4, density=1900.0, half_length=0.01,
        remanence=0.1) == given


def test_mass_factors_keep_the_inertia_at_rest():
    plain = Actuator(bulk_ratio=5.0).block
    wide = replace(plain, transverse_mass_factor=3.0)
    assert wide.period == pytest.approx(plain.period, rel=1e-9)
    assert replace(plain, mass_factor=4.0).period == pytest.approx(2.0 * plain.period, rel=1e-12)


def test_drawn_block_has_the_side_of_its_rest():
    marked = pytest.importorskip('hmsa_ros.nodes.markers').MarkerBlock.of(
        'joint', Actuator(bulk_ratio=3.0).block)
    assert marked.size(1.2)[0] == pytest.approx(0.02 * side_at(gent, 3.0, 1.2), rel=1e-12)


# -- identification -----------------------------------------------------------------------------

def recorded(actuator, stretches=(1.3, 0.7, 1.5, 1.0), seed=2, noise=1e-3):
    unit, load = actuator.time_unit, actuator.units.load
    material = actuator.nondimensional
    loads = np.append(0.0, equations.elastic_force(np.array(stretches), material))
    times = np.arange(len(loads)) * 12.0
    at = np.linspace(0.0, times[-1] + 12.0, 1000)
    stretch = sampled([Level(*x) for x in zip(times.tolist(), loads.tolist(), strict=True)],
                      State(1.0), at, material)[0]
    random = np.random.default_rng(seed)
    return Measurement(
        at * unit, stretch + noise * random.normal(size=len(at)), times * unit, loads * load)


def test_derivative_by_differences_is_that_of_the_compiled_motion():
    recording, free = recorded(paper_actuator()), ('chain_limit',)
    values = values_of(paper_actuator())
    compiled = respond(recording, values, free).jacobian[:, 0]
    found = difference(values, 'chain_limit', lambda x: respond(recording, x, ()).stretch)
    assert found == pytest.approx(compiled, abs=1e-4 * np.max(np.abs(compiled)))


def test_large_steps_tell_bulk_modulus_and_chain_limit_apart(tmp_path):
    actual = replace(paper_actuator(), bulk_ratio=10.0)
    found = identify(recorded(actual), (*DEFAULT_FREE, 'bulk_ratio'), actuator=paper_actuator())
    assert found.verdict == 'identified'
    for name, true in (('bulk_ratio', 10.0), ('chain_limit', 5.0), ('shear_modulus', 1e4)):
        estimate = found.parameters[name]
        assert abs(estimate.value - true) < 4.0 * estimate.std
        assert estimate.std < 0.01 * true
    path = tmp_path / 'block.yaml'
    path.write_text(file_text(
        found, Belief(paper_actuator(), {}, {}, Known()), 'a run', datetime(2026, 1, 1)))
    assert '  # standard deviation' in next(
        x for x in path.read_text().splitlines() if 'actuator.bulk_ratio' in x)
    assert Actuator.from_yaml(path).block.bulk_ratio == pytest.approx(10.0, rel=0.01)


def test_small_steps_tell_no_bulk_modulus():
    actual = replace(paper_actuator(), bulk_ratio=100.0)
    free = ('shear_modulus', 'damping_coefficient', 'remanence', 'stretch_bias', 'bulk_ratio')
    found = identify(
        recorded(actual, (1.01, 0.99, 1.01, 1.0)), free, actuator=paper_actuator())
    assert found.verdict == 'not_identifiable'
    assert 'bulk_ratio' in found.reason


def test_feedback_keeps_the_chain_limit_of_a_compressible_block():
    actuator = replace(paper_actuator(), bulk_ratio=10.0)
    assert 'chain_limit' not in Prior.nominal(actuator, suspects=True).free
    with pytest.raises(BadInputError, match='chain_limit cannot be tracked with a finite bulk'):
        Prior.nominal(actuator, ('shear_modulus', 'chain_limit'))
