"""Sweeps over laws, shapers, samples and SI parameters, compared with individual plans."""

import csv
import json
import math

from extras import needs
from matplotlib.axes import Axes
import numpy as np
from plants import acceleration_si
import pytest
from scipy.integrate import solve_ivp
import yaml

from hmsa.errors import BadInputError
from hmsa.interfaces.parameters import PLANNED
from hmsa.model.laws import LAWS
from hmsa.model.moves import State
from hmsa.model.parameters import ActuatorParameters
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.shapers.two_step import two_step
from hmsa.planning.two_step import Groups, plan_two_step_batch
from hmsa.runs.parameters import read_parameter_file, values_of
from hmsa_studies.axes import (
    draw,
    InSI,
    Nondimensional,
    NormalColumns,
    NOTHING,
    parse_values,
    Spread,
)
from hmsa_studies.robustness import Actual, Errors
from hmsa_studies.sweep import Sweep

ACTUATOR = {
    'actuator.shear_modulus': 12e3, 'actuator.density': 1800.0, 'actuator.half_length': 0.008,
    'actuator.half_thickness': 0.009, 'actuator.remanence': 0.12, 'actuator.chain_limit': 6.0,
    'actuator.damping_coefficient': 0.6}
LAW_CONSTANTS = {
    'law.c10': 5e3, 'law.c01': 1e3, 'law.c20': 300.0, 'law.c30': 20.0, 'law.mu': [9e3],
    'law.alpha': [2.5], 'law.lambda_m': 3.0, 'law.gc': 6e3, 'law.ge': 3e3, 'law.delta': 0.2,
    'law.beta': 0.5,
    'law.stretch': [0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7],
    'law.flux_density': []}
STRETCH = np.array(LAW_CONSTANTS['law.stretch'])
LAW_CONSTANTS['law.flux_density'] = (0.12 * (STRETCH - STRETCH ** -2)).tolist()
COVARIANCE = [[1e4, -0.02, 0.0], [-0.02, 1e-6, 0.0], [0.0, 0.0, 1e-10]]


@pytest.fixture
def params_file(tmp_path):
    """Return a writer of parameter files, with the constants of all laws."""
    def write(**more):
        path = tmp_path / 'actuator.yaml'
        path.write_text(yaml.safe_dump({'/**': {'ros__parameters': {
            **ACTUATOR, **LAW_CONSTANTS, **more}}}))
        return path
    return write


@pytest.fixture
def run(command, tmp_path, monkeypatch):
    """Return a runner of commands in an empty folder: status, rows or output, and error."""
    monkeypatch.chdir(tmp_path)

    def run_words(*words):
        status, out, err = command(*words)
        return status, list(csv.DictReader(out.splitlines())) if words[0] == 'sweep' else out, err

    return run_words


def planned(run, path, target, shaper):
    """Return the move planned by hmsa plan, None if refused."""
    status, out, _ = run('plan', f'{target}:100', '--params-file', path, '--shaper', shaper,
                         '--json')
    return None if status else json.loads(out)['segments'][0]


@pytest.mark.parametrize('more', [
    {}, {'slew_limit': 40.0}, {'coil_time_constant': 3e-4}, {'flux_density_max': 0.06},
    {'viscoelastic.ratio': [0.1], 'viscoelastic.time': [0.05]}],
    ids=['ideal', 'ramps', 'lag', 'weak coil', 'creep'])
def test_rows_in_si_units_are_the_plans_of_hmsa_plan_for_every_law_and_shaper(
        run, params_file, more):
    # A beam has sizes of its own.
    laws = [x for x in LAWS if x != 'beam'] if not more else ['gent', 'yeoh']
    shapers = ['two_step', 'minimum_time', 'step'] if not more else [
        'two_step', 'robust']
    status, rows, _ = run(
        'sweep', '--params-file', params_file(**more), '--target', '1.1,0.9,2.5',
        '--law', ','.join(laws), '--shaper', ','.join(shapers))
    assert status == 0
    assert len(rows) == 3 * len(laws) * len(shapers)
    for law in laws:
        path = params_file(law=law, **more)
        for row in (x for x in rows if x['law'] == law):
            plan = planned(run, path, row['target'], row['shaper'])
            assert (plan is None) == (row['status'] in (
                'flux_limit', 'out_of_range', 'slew_limit', 'no_two_step', 'not_converged')), row
            if plan is None:
                continue
            assert row['status'] == plan['status']
            for name in ('flux_density_p', 'time_p', 'flux_density_1'):
                expected = math.nan if plan[name] is None else plan[name]
                assert float(row[name]) == pytest.approx(
                    expected, rel=1e-6, abs=1e-9, nan_ok=True), name


def test_parameters_in_si_units_are_varied_one_by_one(run, params_file):
    path = params_file(law='yeoh')
    _, rows, _ = run(
        'sweep', '--params-file', path, '--vary', 'law.c20=100,900', '--vary',
        'actuator.density=1000:3000:2', '--vary', 'slew_limit=0,60', '--target', 1.2)
    assert len({x['time_p'] for x in rows}) == 8
    for row in rows:
        path = params_file(law='yeoh', **{
            x: float(row[x]) for x in ('law.c20', 'actuator.density', 'slew_limit')})
        plan = planned(run, path, 1.2, 'two_step')
        assert float(row['time_p']) == pytest.approx(plan['time_p'], rel=1e-6)
        assert float(row['flux_density_p']) == pytest.approx(plan['flux_density_p'], rel=1e-6)


def test_nondimensional_laws_limits_and_ramps_are_columns(run):
    _, rows, _ = run(
        'sweep', '--law', 'neo_hookean,mooney_rivlin', '--vary', 'law.c10=3', '--vary',
        'law.c01=0,1', '--vary', 'load_max=0.2,1', '--vary', 'slew=2,inf', '--shaper',
        'two_step,robust')
    assert len(rows) == 32
    assert {x['status'] for x in rows if x['load_max'] == '0.2'} == {'flux_limit'}
    plain = [x for x in rows
             if (x['load_max'], x['slew'], x['law.c01']) == ('1.0', 'inf', '0.0')]
    # Without its second constant Mooney and Rivlin's law is the neo-Hookean one.
    for shaper in ('two_step', 'robust'):
        one, other = (x for x in plain if x['shaper'] == shaper)
        assert {one['law'], other['law']} == {'neo_hookean', 'mooney_rivlin'}
        assert float(one['tau_p']) == pytest.approx(float(other['tau_p']), rel=1e-9)
    assert len({x['tau_p'] for x in rows if x['status'] != 'flux_limit'}) > 8


def test_samples_of_an_identification_have_its_mean_and_covariance(run, params_file):
    from scipy import stats
    names = ['shear_modulus', 'damping_coefficient', 'stretch_bias']
    path = params_file(**{
        'identification.names': names,
        'identification.covariance': np.ravel(COVARIANCE).tolist()})
    status, rows, _ = run('sweep', '--params-file', path, '--identified', '--samples', 4096)
    assert (status, len(rows)) == (0, 4096)
    drawn = np.array([
        [float(x['actuator.shear_modulus']), float(x['actuator.damping_coefficient'])]
        for x in rows])
    assert drawn.mean(axis=0) == pytest.approx([12e3, 0.6], rel=1e-5)
    assert np.cov(drawn.T) == pytest.approx(np.array(COVARIANCE)[:2, :2], rel=0.02)
    whitened = np.linalg.solve(np.linalg.cholesky(np.array(COVARIANCE)[:2, :2]),
                               (drawn - [12e3, 0.6]).T)
    for values in whitened:
        assert stats.kstest(values, 'norm').pvalue > 0.5
    assert 'no covariance of the block' in run(
        'sweep', '--params-file', params_file(), '--identified')[2]


def test_samples_are_those_of_sobol_and_follow_from_number_and_seed_alone(run):
    from scipy import stats
    spreads = {'zeta': Spread(False, 0.1, 0.3), 'j_lim': Spread(True, 5.0, 0.1)}
    found = draw(spreads, NOTHING, 600, 3)
    points = stats.qmc.Sobol(2, seed=np.random.default_rng(3)).random(1024)[:600]
    assert found['zeta'] == pytest.approx(0.1 + 0.2 * points[:, 0], rel=1e-12)
    assert found['j_lim'] == pytest.approx(stats.norm(5.0, 0.1).ppf(points[:, 1]), rel=1e-9)
    words = ('sweep', '--zeta', 'sobol:0.1:0.3', '--j-lim', 'normal:5:0.1', '--target', '1.1,1.2',
             '--samples', 8)
    first = run(*words, '--seed', 3)
    assert [float(x['zeta']) for x in first[1][::2]] == found['zeta'][:8].tolist()
    assert run(*words, '--seed', 3) == first
    assert run(*words, '--seed', 4) != first
    digests = {Sweep({}, samples=draw(spreads, NOTHING, 8, seed)).digest for seed in (3, 3, 4)}
    assert len(digests) == 2


@pytest.mark.slow
def test_chunks_of_samples_shapers_and_laws_merge_to_the_table_of_one_process(run, tmp_path):
    needs('pyarrow')
    words = ('sweep', '--zeta', 'sobol:0.1:0.3', '--samples', 200, '--shaper', 'two_step,robust',
             '--law', 'gent,neo_hookean')
    assert run(*words, '--workers', 1, '--out', 'a')[0] == 0
    assert len(list((tmp_path / 'a' / 'chunks').iterdir())) == 2
    assert run(*words, '--workers', 2, '--out', 'b.parquet')[0] == 0
    assert run(*words, '--out', 'c.parquet')[0] == 0
    tables = [(tmp_path / x).read_bytes() for x in ('a/table.parquet', 'b.parquet')]
    assert tables[0] == tables[1]


def test_a_law_of_many_constants_takes_no_room_for_each_row(monkeypatch):
    from hmsa.model import law
    from hmsa.planning import two_step

    sizes = []
    pack = law.pack
    monkeypatch.setattr(law, 'pack', lambda *x: sizes.append((y := pack(*x)).size) or y)
    monkeypatch.setattr(two_step, '_MOST_NUMBERS', 1000)
    curve = LAWS['yeoh'].scaled({'law.c10': 1.0, 'law.c20': 0.1, 'law.c30': 0.0})[1]
    targets = np.linspace(0.9, 1.3, 500)
    zeta = np.linspace(0.0, 0.1, 500)
    found = plan_two_step_batch(1.0, targets, Groups(zeta=zeta, elastic=curve))
    assert max(sizes) <= 1000 < sum(sizes)
    monkeypatch.undo()
    again = plan_two_step_batch(1.0, targets, Groups(zeta=zeta, elastic=curve))
    assert np.array_equal(found.tau_p, again.tau_p, equal_nan=True)


@pytest.mark.parametrize(('words', 'message'), [
    ('--law silk', "law is 'silk': expected one of"), ('--law ogden', 'law.mu has 0 values'),
    ('--shaper two', "shaper is 'two': expected one of"), ('--vary mass=1', "a column is 'mass'"),
    ('--vary slew', 'expected NAME=GRID'), ('--zeta 1 --vary zeta=1', 'each name once'),
    ('--vary slew=0', 'greater than 0'), ('--zeta sobol:1:1', 'LOW below HIGH'),
    ('--zeta normal:1', 'sobol:LOW:HIGH'), ('--zeta normal:1:nan', 'STD above 0'),
    ('--samples 4', '--samples is given without a random column'),
    ('--seed 4', '--seed is given without a random column'),
    *((f'--out sweep.csv {x}', f'{x.split()[0]} needs --picture or a folder as --out')
      for x in ('--width 85', '--format svg', '--data', '--show b_p')),
    ('--zeta sobol:0:1 --samples 0', '0 samples'),
    ('--zeta sobol:0:1 --seed -1', 'seed of the samples is -1'),
    ('--identified', '--identified without --params-file'),
    ('--params-file none.yaml', 'none.yaml')])
def test_axes_that_do_not_exist_are_refused_in_one_line(refusal, words, message):
    assert message in refusal(f'sweep {words}')


def test_what_a_file_says_of_planning_and_options_decide_is_said(run, params_file):
    path = params_file(shaper='robust', robust_order=3, smooth_periods=1, command_mode='sampled')
    for words, unused in (
            (['plan', '1.1:0.1'],
             'shaper robust (see --shaper), robust_order 3 (see --order), command_mode sampled'),
            (['plan', '1.1:0.1', '--shaper', 'robust', '--order', 3], 'command_mode sampled'),
            (['sweep'], 'shaper robust (see --shaper), robust_order 3, command_mode sampled'),
            (['sweep', '--shaper', 'step'], 'robust_order 3, command_mode sampled')):
        status, _, err = run(*words, '--params-file', path)
        assert status == 0
        assert f'{path}: {unused} {"are" if "," in unused else "is"} not used' in err
    assert 'not used' not in run('plan', '1.1:0.1', '--params-file', params_file())[2]


def test_nondimensional_parameters_do_not_go_with_a_parameter_file(run, params_file):
    assert "a column is 'zeta'" in run(
        'sweep', '--params-file', params_file(), '--zeta', 1)[2]


def test_a_covariance_that_is_none_is_refused():
    with pytest.raises(BadInputError, match=r'is impossible at b: expected'):
        draw({}, NormalColumns(('a', 'b'), np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]])), 8, 0)


def test_values_are_grids_or_what_they_are_drawn_from():
    assert parse_values('sobol:1:2', 'zeta') == Spread(False, 1.0, 2.0)
    assert parse_values('normal:-1:2', 'zeta') == Spread(True, -1.0, 2.0)
    assert parse_values('1:2:2', 'zeta').tolist() == [1.0, 2.0]
    assert set(Nondimensional.columns) < set(Nondimensional.ranges)


# --- residuals


def test_a_plan_that_meets_another_actuator_leaves_what_another_solver_says(run, params_file):
    path = params_file(coil_time_constant=3e-4)
    status, rows, _ = run(
        'sweep', '--params-file', path, '--target', 1.3, '--vary', 'actual.shear_modulus=12.7e3',
        '--vary', 'actual.remanence=0.116', '--vary', 'actual.coil_time_constant=4e-4',
        '--shaper', 'two_step,robust')
    assert status == 0
    for row in rows:
        levels = planned(run, path, 1.3, row['shaper'])['levels']
        actual = ActuatorParameters(
            12.7e3, *(ACTUATOR[f'actuator.{x}'] for x in ('density', 'half_length',
                                                          'half_thickness')),
            0.116, *(ACTUATOR[f'actuator.{x}'] for x in ('chain_limit', 'damping_coefficient')))
        arrival = float(row['time_p'])
        ends = [*(x for x, _ in levels[1:]), arrival]
        state = [1.0, 0.0, 0.0]

        def motion(state, level, span, times=None, actual=actual):
            return solve_ivp(
                lambda _, y: [y[1], float(acceleration_si(y[0], y[1], y[2], actual)),
                              (level - y[2]) / 4e-4],
                (0.0, span), state, method='DOP853', rtol=1e-10, atol=1e-12, t_eval=times).y

        for (begin, level), end in zip(levels, ends, strict=True):
            if end > begin:
                state = motion(state, level, end - begin)[:, -1]
        later = motion(state, levels[-1][1], 0.4, np.linspace(0.0, 0.4, 8001))
        late = later[0, later.shape[1] - 1]
        ringing = later[0, :800]
        assert float(row['residual']) == pytest.approx(np.ptp(ringing) / 0.3, rel=2e-3)
        assert float(row['offset']) == pytest.approx((late - 1.3) / 0.3, abs=1e-5)


def test_samples_of_an_identification_are_actuators_and_the_plan_is_the_same(run, params_file):
    path = params_file(**{
        'identification.names': ['shear_modulus', 'damping_coefficient', 'stretch_bias'],
        'identification.covariance': np.ravel(COVARIANCE).tolist()})
    status, rows, _ = run(
        'sweep', '--params-file', path, '--identified', '--residual', '--samples', 16,
        '--shaper', 'two_step,robust', '--law', 'gent,yeoh')
    assert (status, len(rows)) == (0, 64)
    assert len({(x['law'], x['shaper'], x['time_p']) for x in rows}) == 4
    assert len({x['actual.shear_modulus'] for x in rows}) == 16
    left = {x: np.array([float(y['residual']) for y in rows if y['shaper'] == x])
            for x in ('two_step', 'robust')}
    assert np.max(left['robust']) < 0.1 * np.max(left['two_step']) < 0.01
    # As a study of errors says of the same error.
    row = next(x for x in rows if x['law'] == 'gent' and x['shaper'] == 'two_step')
    errors = Errors(float(row['actual.shear_modulus']) / 12e3 - 1.0,
                    float(row['actual.damping_coefficient']) / 0.6 - 1.0)
    model = InSI.of(values_of(read_parameter_file(path), 'planner', PLANNED)).setting(
        {}).material
    move = two_step(MoveRequest(State(1.0), 1.1, model))
    # Times of levels in SI units are whole nanoseconds.
    assert float(row['residual']) == pytest.approx(
        Actual.off(model, errors).residual(move, 1.0, 1.1, move.duration), abs=1e-6)


# --- pictures


@pytest.mark.slow
def test_a_folder_gets_the_map_of_its_table_and_other_pictures_are_named(run, tmp_path):
    assert run('sweep', '--zeta', '0:3:7', '--j-lim', 'log:0.1:100:6', '--out', 'map',
               '--show', 'tau_p')[0] == 0
    assert (tmp_path / 'map' / 'table.png').read_bytes().startswith(b'\x89PNG')
    assert (tmp_path / 'map' / 'table.pdf').read_bytes().startswith(b'%PDF')
    samples = ('sweep', '--zeta', 'normal:0.2:0.1', '--samples', 20, '--show', 'tau_p')
    for name, words in (('bands.png', ('--target', '1.1:1.4:6')),
                        ('shares.png', ('--shaper', 'two_step,zv'))):
        assert run(*samples, *words, '--picture', name)[0] == 0
        assert (tmp_path / name).read_bytes().startswith(b'\x89PNG')
    # What cannot be drawn is still computed.
    status, _, err = run('sweep', '--zeta', 0.3, '--out', 'study')
    assert (status, 'no picture' in err) == (0, True)
    assert sorted(x.name for x in (tmp_path / 'study').iterdir()) == [
        'chunks', 'study.json', 'table.parquet']


def test_no_number_of_a_contour_is_cut_off_at_the_edge_of_a_map(run, monkeypatch):
    needs('pyarrow')
    drawn, label = [], Axes.clabel
    monkeypatch.setattr(Axes, 'clabel', lambda *x, **y: drawn.extend(label(*x, **y)) or drawn)
    assert run('sweep', '--zeta', '0:3:7', '--j-lim', 'log:0.1:100:6', '--out', 'map',
               '--show', 'beta_p', '--format', 'png')[0] == 0
    assert drawn
    assert not any(x.get_clip_on() for x in drawn)


def test_a_view_puts_each_row_of_a_sweep_where_its_axes_say():
    sweep = Sweep(
        {'target': [1.1, 1.2], 'zeta': np.linspace(0.0, 3.0, 7), 'j_lim': np.linspace(1, 9, 6)},
        samples={'c1': [1.0, 2.0, 3.0]})
    view = sweep.view()
    table = sweep.rows(0, sweep.size).inputs
    assert (view.x.name, view.y.name, view.samples) == ('j_lim', 'zeta', 3)
    assert view.labels == ('target 1.1', 'target 1.2')
    for name, shape in (('j_lim', (6, 1)), ('zeta', (7, 1, 1)), ('c1', (3,)),
                        ('target', (2, 1, 1, 1))):
        values = np.unique(table[name]).reshape(shape)
        assert np.array_equal(view.arranged(table[name]), np.broadcast_to(values, (2, 7, 6, 3)))


@pytest.mark.parametrize(('words', 'message'), [
    (('--zeta', '0:1:9', '--picture', 'x.gif'), 'ends in .png, .pdf, .svg or .pgf'),
    (('--zeta', '0:1:9', '--picture', 'x.png', '--data', '--out', 'x.csv'), 'name the same file'),
    (('--zeta', '0:1:9', '--picture', 'x.png', '--width', '0'), 'expected 40 to 400 mm'),
    (('--zeta', '0:1:9', '--picture', 'x.png', '--show', 'zeta'), 'expected one of beta_p'),
    (('--zeta', '0:1:9', '--j-lim', '1:9:9', '--c1', '1:2:9', '--picture', 'x.png'),
     'one or two columns of several numbers'),
    (('--zeta', ','.join(['0.1'] * 2001), '--j-lim', '1:9:2000', '--picture', 'x.png'),
     'at most 4,000,000')])
def test_pictures_that_cannot_be_drawn_are_refused_before_anything_is_computed(
        run, words, message):
    status, rows, err = run('sweep', *words)
    assert (status, rows, err.count('\n')) == (2, [], 1)
    assert message in err
