"""The law of a table, compared with the sampled Gent block and SciPy, and its files."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import CubicSpline, make_interp_spline
from test_core_laws import record

from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.identification.excitation import excite
from hmsa.identification.files import read_belief
from hmsa.interfaces.actuator import actuator_from, parameters_of
from hmsa.interfaces.parameters import BLOCK
from hmsa.model.equations import (
    elastic_energy,
    elastic_force,
    elastic_stiffness,
    equilibrium_stretch,
    stretch_limits,
)
from hmsa.model.laws.curve import fitted
from hmsa.model.moves import Setpoint
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import simulate
from hmsa.model.status import Code, RefusedError
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.two_step import plan_two_step
from hmsa.runs.bags import read_runs

GENT = paper_actuator()
UNIT = GENT.flux_density_unit


def sampled(count=60, low=0.75, high=1.6):
    """Return stretches, and the levels in T that hold a Gent block there."""
    stretch = np.linspace(low, high, count)
    return stretch, elastic_force(stretch, GENT.nondimensional) * UNIT


def text_of(stretch, flux, header='stretch,flux_density'):
    """Return points as the text of a file."""
    return f'{header}\n' + ''.join(
        f'{x!r},{y!r}\n' for x, y in zip(
            np.asarray(stretch).tolist(), np.asarray(flux).tolist(), strict=True))


def block(**values):
    """Return the block of a table."""
    names = {'file': 'law.file', 'stretch': 'law.stretch', 'flux': 'law.flux_density'}
    return actuator_from({x.name: x.default for x in BLOCK} | {'law.name': 'table'} | {
        names[key]: value for key, value in values.items()})


def of_points(stretch, flux):
    """Return the block of some points."""
    return block(stretch=np.asarray(stretch).tolist(), flux=np.asarray(flux).tolist())


def test_a_table_of_a_gent_block_has_its_scale_and_its_plans(tmp_path):
    path = tmp_path / 'gent.csv'
    path.write_text(text_of(*sampled()))
    found = block(file=str(path))
    assert found.shear_modulus == pytest.approx(GENT.shear_modulus, rel=1e-6)
    assert found.time_unit == pytest.approx(GENT.time_unit, rel=1e-6)
    for start, target in ((1.0, 1.1), (1.1, 1.5), (1.5, 0.8), (0.8, 1.0)):
        plans = [plan_two_step(start, target, x.nondimensional) for x in (found, GENT)]
        assert plans[0].code is plans[1].code is Code.TWO_STEP
        assert plans[0].beta_p == pytest.approx(plans[1].beta_p, rel=1e-5, abs=1e-6)
        assert plans[0].tau_p == pytest.approx(plans[1].tau_p, rel=1e-5)


@pytest.mark.parametrize('make', [CubicSpline, lambda x, y: make_interp_spline(x, y, 5)])
def test_a_motion_is_that_of_scipy_through_the_same_points(make):
    found = of_points(*sampled(40)).nondimensional
    # The cubic differs from the curve of degree 5 by what is between the points.
    tolerance = 2e-5 if make is CubicSpline else 1e-10
    x, y = sampled(40)
    spline = make(x, y - make(x, y)(1.0))
    unit = float(spline(1.0, 1)) / 3.0

    def slope(_, state):
        l, v = state  # noqa: E741
        inertia = (l ** -3 + found.c1) / 6.0
        return v, (beta - float(spline(l)) / unit - found.zeta * found.c1 / 2.0 * v
                   + v * v * l ** -4 / 4.0) / inertia

    plan = plan_two_step(1.0, 1.4, found)
    beta = plan.beta_p
    end = solve_ivp(slope, (0.0, plan.tau_p), (1.0, 0.0), 'DOP853', rtol=1e-13, atol=1e-14,
                    max_step=0.02).y[:, -1]
    assert end == pytest.approx([1.4, 0.0], abs=tolerance)
    stretch, rate = simulate(
        [0.0, plan.tau_p], [plan.beta_p, plan.beta_1], np.linspace(0.0, plan.tau_p + 20.0, 50),
        found)
    assert abs(stretch[-1] - 1.4) < 1e-10
    assert abs(rate[-1]) < 1e-10


def test_force_stiffness_and_energy_belong_together_inside_and_beyond_the_ends():
    found = of_points(*sampled(30)).nondimensional
    for stretch in (0.735, 0.75, 0.7513, 0.9, 1.0, 1.234, 1.6, 1.62, 1.65):
        work = quad(lambda x: float(elastic_force(x, found)), 1.0, stretch,
                    points=[0.75, 1.6], limit=400)[0]
        assert elastic_energy(stretch, found) == pytest.approx(work, rel=1e-9, abs=1e-10)
        ends = [float(elastic_force(stretch + h, found)) for h in (1e-6, -1e-6)]
        assert elastic_stiffness(stretch, found) == pytest.approx(
            (ends[0] - ends[1]) / 2e-6, rel=1e-4)
    inside = np.linspace(0.751, 1.599, 200)
    assert equilibrium_stretch(elastic_force(inside, found), found) == pytest.approx(inside)
    assert abs(elastic_force(1.0, found)) < 1e-15
    assert elastic_stiffness(1.0, found) == pytest.approx(3.0, rel=1e-12)
    # The stop is a tenth of the way farther.
    assert math.isnan(elastic_force(1.6601, found))
    assert math.isnan(elastic_energy(0.7249, found))


@pytest.mark.parametrize('count', [6, 7, 8, 9, 41, 100])
def test_a_few_points_and_many_on_a_parabola_give_the_parabola(count):
    stretch = 0.8 + 0.8 * np.linspace(0.0, 1.0, count) ** 1.3
    curve = fitted(tuple(stretch.tolist()), tuple((0.2 * (stretch - 1.0) * (
        1.5 - 0.4 * stretch)).tolist()))
    for x in np.linspace(0.8, 1.6, 37):
        assert float(curve.level(x)) == pytest.approx(0.2 * (x - 1.0) * (1.5 - 0.4 * x), abs=1e-10)
    assert curve.slope == pytest.approx(0.22, rel=1e-8)


@pytest.mark.parametrize('scatter', [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize('count', [15, 60, 300])
def test_a_curve_through_scatter_rises_and_is_near_the_true_one(scatter, count):
    stretch, true = sampled(count)
    height = true[-1] - true[0]
    levels = true + scatter * height * np.random.default_rng(count).standard_normal(count)
    found = of_points(stretch, levels)
    look = np.linspace(stretch[0], stretch[-1], 3000)
    force = elastic_force(look, found.nondimensional) * found.flux_density_unit
    assert np.all(np.diff(force) > 0.0)
    exact = elastic_force(look, GENT.nondimensional) * UNIT
    assert np.max(np.abs(force - exact)) < (3.0 * scatter + 3e-3) * height
    curve = fitted(tuple(stretch.tolist()), tuple(levels.tolist()))
    assert curve.scatter < 2.0 * scatter * height + 1e-3 * height


def test_what_is_beyond_the_table_is_refused_and_the_block_stops_there():
    found = of_points(*sampled()).nondimensional
    assert stretch_limits(found) == (0.75, 1.6)
    for target in (0.74, 1.6, 1.7):
        with pytest.raises(RefusedError, match='between the limits 0.7500 and 1.6000 of law tab'):
            plan_sequence([Setpoint(target, 50.0)], found)
    # An unshaped step overshoots by nearly its height.
    with pytest.raises(RefusedError, match=r'swings to 1\.6\d+: expected a motion between') as got:
        plan_sequence([Setpoint(1.5, 50.0)], found, shaper='step')
    assert got.value.code is Code.OUT_OF_RANGE
    assert plan_sequence([Setpoint(1.2, 50.0)], found, shaper='step')
    for load in (-30.0, 30.0):
        stretch, rate = simulate([0.0], [load], np.linspace(0.0, 40.0, 2000), found)
        assert np.all(np.isfinite(rate))
        assert np.min(stretch) > 0.725
        assert np.max(stretch) < 1.66
    assert equilibrium_stretch([-30.0, 30.0], found) == pytest.approx([0.75, 1.6])


def test_parameters_of_a_table_are_its_points_and_scale_with_the_block(tmp_path):
    path = tmp_path / 'points.csv'
    path.write_text(text_of(*sampled()))
    found = block(file=str(path))
    path.unlink()
    given = parameters_of(found)
    assert given['law.flux_density'] == pytest.approx(sampled()[1].tolist(), rel=1e-14)
    again = actuator_from({x.name: x.default for x in BLOCK} | given)
    assert again.shear_modulus == pytest.approx(found.shear_modulus, rel=1e-12)
    look = np.linspace(0.76, 1.59, 50)
    assert elastic_force(look, again.nondimensional) == pytest.approx(
        elastic_force(look, found.nondimensional), rel=1e-11)
    # A magnet twice as strong needs the same levels for a block twice as stiff.
    other = actuator_from(
        {x.name: x.default for x in BLOCK} | given | {'actuator.remanence': 0.2})
    assert other.shear_modulus == pytest.approx(2.0 * found.shear_modulus, rel=1e-12)
    assert other.flux_density_unit == pytest.approx(found.flux_density_unit, rel=1e-12)


GOOD = text_of(*sampled(12))
LINES = GOOD.splitlines(keepends=True)
REFUSED = {
    'empty': ('', 'is empty: expected a header and rows of numbers'),
    'no header': (''.join(LINES[1:]), 'begins with numbers .* expected a header'),
    'wrong header': (GOOD.replace('stretch', 'length'), 'has no column stretch: expected'),
    'no row': (LINES[0], 'has 0 rows: expected 6 to 2000 rows'),
    'one row': (LINES[0] + LINES[5], 'has 1 rows: expected 6 to 2000 rows'),
    'NaN': (LINES[0] + '0.7,nan\n' + ''.join(LINES[1:]), 'line 2 has flux density nan T: exp'),
    'no stretch': (GOOD + ',0.2\n', 'line 14 has stretch nan: expected 0.1 to 10'),
    'infinite': (GOOD + '1.7,inf\n', 'line 14 has flux density inf T: expected at most 5 T'),
    'words': (GOOD + '1.7,much\n', "line 14 has 'much' in column flux_density: expected a numb"),
    'mT': (text_of(sampled(12)[0], 1e3 * sampled(12)[1]),
           r'line 2 has flux density -\d+.* T: expected at most 5 T; levels in mT need a column '
           r'flux_density \[mT\]'),
    'mm': (text_of(10.0 * sampled(12)[0], sampled(12)[1]), 'expected 0.1 to 10, the length over'),
    'unsorted': (LINES[0] + ''.join(LINES[:0:-1]), 'line 3 has stretch .* after 1.6: expected in'),
    'duplicate': (GOOD + LINES[-1], 'line 14 has stretch 1.6 again: expected increasing'),
    'separators': (GOOD.replace(',', ' ').replace(' ', ',', 1), 'line 2 has .*: expected a number'
                   '|line 2 has flux density nan'),
    'one side': (text_of(*sampled(12, 1.0)), 'has stretches 1 to 1.6: expected some on both si'),
    'reversed': (text_of(sampled(12)[0], -sampled(12)[1]), 'expected increasing ones; a level'),
    'offset': (text_of(sampled(12)[0], sampled(12)[1] + 0.01), 'T at stretch 1: expected 0 with'),
    'falling': (text_of(sampled(40)[0], sampled(40)[1] - 0.1 * np.exp(
        -(20.0 * (sampled(40)[0] - 1.3)) ** 2)), r'does not rise beyond its scatter .* near row '),
    'noise': (text_of(sampled(40)[0], sampled(40)[1] + 0.05 * np.random.default_rng(
        3).standard_normal(40)), 'has a scatter of .*: expected at most .*, 5% of its range'),
    'binary': (b'\x89PNG\xff\xfe\x00\x01', 'is no text: expected a CSV'),
    'zeros': (b'\x00' * 4096, 'has zero bytes in its header: expected a CSV'),
}


@pytest.mark.parametrize('name', REFUSED)
def test_a_file_that_is_no_table_is_refused_in_a_sentence(name, tmp_path):
    content, message = REFUSED[name]
    path = tmp_path / 'table.csv'
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content)
    with pytest.raises(BadInputError, match=message) as got:
        block(file=str(path))
    assert '\n' not in str(got.value)


def test_what_names_no_file_or_half_of_the_points_is_refused(tmp_path, monkeypatch, refusal):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadInputError, match='has neither law.file nor points: expected the path'):
        block()
    missing = f'{tmp_path}/none.csv cannot be read .No such file or directory.: expected a CSV'
    with pytest.raises(BadInputError, match=missing):
        block(file='none.csv')
    with pytest.raises(BadInputError, match='cannot be read .Is a directory'):
        block(file='.')
    with pytest.raises(BadInputError, match='/dev/zero is a device or a pipe: expected a CSV'):
        block(file='/dev/zero')
    assert '/dev/zero has more than' in refusal('plan 1.1:0.1 --params-file /dev/zero')
    with pytest.raises(BadInputError, match='has 12 stretches and 0 levels rows: expected'):
        block(stretch=sampled(12)[0].tolist())
    # Relative to the working directory, and in the unit that the header names.
    stretch, flux = sampled()
    Path('table.csv').write_text(text_of(stretch, 1e3 * flux, 'stretch,flux_density [mT]'))
    assert block(file='table.csv').shear_modulus == pytest.approx(GENT.shear_modulus, rel=1e-6)


@pytest.mark.slow
def test_a_sequence_to_record_keeps_inside_the_table_and_seeks_no_chain_limit():
    found = of_points(*sampled(20, 0.8, 1.25))
    program = excite(found, duration=0.4).best
    assert 0.8 < program.reach[0] < 1.0 < program.reach[1] < 1.25
    assert program.ends_at_rest
    assert 'chain_limit' not in program.std


def test_a_plan_and_an_identification_take_a_table_from_a_parameter_file(tmp_path, capsys):
    stretch, flux = sampled()
    (tmp_path / 'table.csv').write_text(text_of(stretch, flux))
    known, made, data = (tmp_path / x for x in ('known.yaml', 'found.yaml', 'data.csv'))
    known.write_text(
        f'/**:\n  ros__parameters:\n    law.name: table\n    law.file: {tmp_path}/table.csv\n')
    assert main(['plan', '1.2:0.1', '--params-file', str(known)]) == 0
    assert '1.2' in capsys.readouterr().out
    # A block of another mass and damping: the table is known, these two are not.
    true = actuator_from(
        {x.name: x.default for x in BLOCK} | {'actuator.density': 2100.0} | {
            'actuator.damping_coefficient': 0.5})
    record(true, (1.1, 1.25, 1.0), 0.06, data)
    assert main([
        'identify', str(data), '--params-file', str(known), '--out', str(made), '--free',
        'density,damping_coefficient,stretch_bias']) == 0
    found = read_belief(made).actuator
    assert found.density == pytest.approx(2100.0, rel=2e-3)
    assert found.damping_coefficient == pytest.approx(0.5, rel=2e-2)
    assert parameters_of(found)['law.flux_density'] == pytest.approx(flux.tolist(), rel=1e-9)


@pytest.mark.slow
@pytest.mark.ros
def test_the_bag_of_a_table_is_verified_and_reported_without_its_file(start, tmp_path):
    table, file, out = tmp_path / 'table.csv', tmp_path / 'block.yaml', tmp_path / 'out'
    table.write_text(text_of(*sampled()))
    file.write_text(f'/**:\n  ros__parameters:\n    law.name: table\n    law.file: {table}\n')
    run = start.hmsa('run', '1.10:0.1', '1.30:0.1', '1.00:0.1', '--simulate', '--params-file',
                     str(file), '--out', str(out), '--json')
    assert run.wait(300.0) == 0, run.output
    assert all(abs(x['offset']) < 1e-6 for x in json.loads(run.stdout)['setpoints'])
    table.unlink()
    found, = read_runs(out / 'run')
    assert found.parameters_known
    assert found.plant.law.law == found.planner.law.law == 'table'
    assert found.plant.shear_modulus == pytest.approx(GENT.shear_modulus, rel=1e-6)
    assert main(['bag', 'verify', str(out / 'run')]) == 0
    assert main(['report', str(out / 'run'), '--out', str(tmp_path / 'report.html')]) == 0
    assert '60 values, 0.75 to 1.6' in (tmp_path / 'report.html').read_text()
