"""Studies: residuals for parameter errors, sampled hardware, heavy damping, sweeps."""

import csv
from dataclasses import replace
import math
from pathlib import Path
import re

from extras import needs
import numpy as np
from plants import acceleration_si
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from benchmarks.damped_sampled import (
    damped_study,
    draw_damped,
    draw_sampled,
    ideal_move,
    sampled_study,
    settling_time,
)
from benchmarks.robustness import tables
from hmsa.errors import BadInputError, HmsaError
from hmsa.model.creep import Creep
from hmsa.model.delivery import Delivery
from hmsa.model.equations import critical_zeta, elastic_force, natural_frequency
from hmsa.model.moves import Level, Limits, Move
from hmsa.model.parameters import ActuatorParameters, NondimensionalParameters, paper_actuator
from hmsa.model.status import Code
from hmsa.planning.two_step import plan_two_step
from hmsa.table import percent
from hmsa_studies.axes import MOST_VALUES, parse_grid, read_cases
from hmsa_studies.pictures import draw_front, draw_robustness
from hmsa_studies.robustness import (
    Actual,
    arrival_of,
    Candidate,
    candidates,
    Case,
    Errors,
    PARAMETERS,
    study,
    write_csv,
)
from hmsa_studies.study_folder import open_writer
from hmsa_studies.sweep import Sweep

COLUMNS = Sweep({}).columns
DOCS = Path(__file__).resolve().parent.parent / 'docs' / 'validation' / 'robustness.md'
MATERIAL = NondimensionalParameters()
#: What is asked of the residual where there is no error.
EXACT = 1e-8
PNG = b'\x89PNG\r\n\x1a\n'


def at(case, result, name, error):
    """Return the residual of a study at one error, in percent."""
    return 100.0 * result.curves[name][np.argmin(np.abs(case.errors() - error))]


@pytest.fixture(scope='module')
def small():
    """Return all shapers' residuals for stretch 1 to 1.1, by name."""
    case = Case(1.0, 1.1)
    return case, {x.name: study(case, x) for x in candidates()}


@pytest.fixture(scope='module')
def large():
    """Return all shapers' residuals for stretch 1 to 1.4, by name."""
    case = Case(1.0, 1.4)
    return case, {x.name: study(case, x) for x in candidates()}


# --- errors of the model


@pytest.mark.parametrize('errors', [
    Errors(), Errors(shear_modulus=0.1), Errors(shear_modulus=-0.15), Errors(zeta=0.2),
    Errors(j_lim=-0.2), Errors(-0.1, 0.15, 0.1)])
@pytest.mark.parametrize(('start', 'target'), [(1.2, 1.5), (1.1, 0.7)])
def test_response_in_error_is_that_of_another_actuator_in_si_units(start, target, errors):
    # The flux density goes on as planned; what changes is the actuator. Nothing nondimensional
    # enters here, and another solver integrates.
    model = paper_actuator(MATERIAL)
    actual = ActuatorParameters(
        model.shear_modulus * (1.0 + errors.shear_modulus), model.density, model.half_length,
        model.half_thickness, model.remanence, model.chain_limit * (1.0 + errors.j_lim),
        model.damping_coefficient * (1.0 + errors.zeta))
    move = ideal_move(start, target, MATERIAL)
    first, last = (x.load * model.flux_density_unit for x in move.levels)
    before = float(elastic_force(start, MATERIAL.j_lim)) * model.flux_density_unit
    tau_p = move.duration * model.time_unit

    def balance(stretch, flux_density):
        return float(acceleration_si(stretch, 0.0, flux_density, actual))

    def motion(flux_density, state, end, times):
        return solve_ivp(
            lambda _, y: [y[1], float(acceleration_si(y[0], y[1], flux_density, actual))],
            (0.0, end), state, method='DOP853', rtol=1e-11, atol=1e-12, t_eval=times).y

    begin = brentq(balance, 0.5, 2.0, args=(before,), xtol=1e-13)
    middle = motion(first, [begin, 0.0], tau_p, [tau_p])[:, -1]
    later = np.linspace(0.0, 3.0 * tau_p, 31)
    expected = motion(last, middle, later[-1], later)[0]
    times = (tau_p + later) / model.time_unit
    plant = Actual.off(MATERIAL, errors)
    assert plant.response(move, start, times) == pytest.approx(expected, abs=1e-8)
    assert plant.response(move, start, np.array([0.0])) == pytest.approx(begin)
    assert plant.rest(move) == pytest.approx(
        brentq(balance, 0.5, 2.0, args=(last,), xtol=1e-13))
    peaks = plant.residual(move, start, target, move.duration)
    fine = motion(last, middle, 4.0 * tau_p, np.linspace(0.0, 4.0 * tau_p, 4001))[0]
    assert peaks == pytest.approx(np.ptp(fine) / abs(target - start), rel=1e-3, abs=EXACT)


def test_creep_behind_a_lagging_coil_in_error_is_that_of_another_actuator_in_si_units():
    # Ratio, relaxation time and the coil's time constant in s stay; the modulus is another.
    ratio, relaxation, lag, stiffer = 0.3, 0.02, 0.001, 1.2
    actual = replace(paper_actuator(), shear_modulus=stiffer * paper_actuator().shear_modulus)
    model = replace(paper_actuator(), creep=Creep((ratio,), (relaxation,)))
    time, unit = model.time_unit, model.flux_density_unit

    def slope(_, y, flux_density):
        stretch, rate, followed, field = y
        force = float(elastic_force(stretch, actual.chain_limit))
        held = field - stiffer * unit * ratio * (force - followed)
        return [rate, float(acceleration_si(stretch, rate, held, actual)),
                (force - followed) / relaxation, (flux_density - field) / lag]

    move = Move(Code.TWO_STEP, (Level(0.0, 0.3), Level(1.2, 0.6)), 1.2)
    state, expected = [1.0, 0.0, 0.0, 0.0], []
    for load, span in ((0.3, 1.2), (0.6, 9.0)):
        motion = solve_ivp(
            slope, (0.0, span * time), state, method='DOP853', rtol=1e-11, atol=1e-12,
            args=(load * unit,), t_eval=[0.5 * span * time, span * time]).y
        state = motion[:, -1]
        expected += motion[0].tolist()
    plant = Actual.off(model.nondimensional, Errors(stiffer - 1.0), Delivery(lag=lag / time))
    found = plant.response(move, 1.0, np.array([0.6, 1.2, 5.7, 10.2]))
    assert found == pytest.approx(expected, abs=1e-8)


@pytest.mark.slow
def test_creep_after_arrival_is_followed_and_leaves_nothing_without_errors():
    case = Case(
        1.0, 1.2, replace(MATERIAL, creep=Creep((0.2,), (11.0,))), delivery=Delivery(lag=0.2))
    found = study(case, Candidate('two_step'))
    assert found.nominal < 1e-4
    assert 0.05 < found.worst.residual < 0.2


@pytest.mark.parametrize('step', ['small', pytest.param('large', marks=pytest.mark.slow)])
def test_shapers_that_know_the_model_leave_nothing_without_errors(step, request):
    _, results = request.getfixturevalue(step)
    for name in ('two-step', 'robust, order 2', 'robust, order 3', 'minimum time'):
        assert results[name].nominal < EXACT
        assert results[name].reason == ''
    for name in ('ZV', 'ZVD', 'EI'):
        assert results[name].nominal > 1e-2
        assert 'linear, designed at the target' in results[name].candidate.label
    assert results['unshaped step'].nominal > 1.0


def test_two_step_leaves_one_percent_for_five_in_zeta_and_five_and_a_half_for_five_in_g(small):
    case, results = small
    both = [(at(case, results['two-step'], name, -0.05), at(case, results['two-step'], name, 0.05))
            for name in ('zeta', 'G')]
    assert np.mean(both[0]) == pytest.approx(1.1, abs=0.1)
    assert np.mean(both[1]) == pytest.approx(5.5, abs=0.1)
    assert at(case, results['two-step'], 'G', -0.1) == pytest.approx(12.3, abs=0.1)


@pytest.mark.slow
def test_each_order_of_the_chain_forgives_more(small, large):
    for _, results in (small, large):
        worst = [results[x].worst.residual for x in (
            'two-step', 'robust, order 2', 'robust, order 3')]
        assert worst[1] < 0.3 * worst[0]
        assert worst[2] < 0.5 * worst[1]


@pytest.mark.slow
def test_steady_offset_is_no_residual(small):
    _, results = small
    result = results['robust, order 3']
    offset = abs(Actual.off(MATERIAL, Errors(0.1)).offset(result.move, 1.0, 1.1))
    assert offset > 0.09
    assert 100.0 * offset > 100.0 * at(_, result, 'G', 0.1)


def left(result, case, errors):
    """Return the residual of a result's move for parameter errors."""
    return Actual.off(MATERIAL, errors).residual(
        result.move, case.start, case.target, result.arrival)


@pytest.mark.slow
def test_worst_in_the_box_holds_everywhere_in_the_box(large):
    case, results = large
    points = np.random.default_rng(7).uniform(-case.box, case.box, (100, 3)).tolist()
    for result in results.values():
        values = [left(result, case, Errors(*x)) for x in points]
        # Between the points of the grid it may be a little worse.
        assert max(values) <= 1.02 * result.worst.residual
        assert result.worst.residual >= max(
            result.nominal, *(x.residual for x in result.alone.values())) - 1e-15
        assert left(result, case, result.worst.errors) == result.worst.residual


def test_worst_alone_is_on_the_curve_and_within_the_box():
    case = Case(1.0, 1.2, box=0.07, span=0.2)
    errors = case.errors()
    assert {-0.2, -0.07, 0.0, 0.07, 0.2} <= set(errors.tolist())
    assert np.all(np.diff(errors) > 1e-9)
    result = study(case, Candidate('two_step'))
    for name, attribute in PARAMETERS.items():
        worst = result.alone[name]
        assert abs(getattr(worst.errors, attribute)) == 0.07
        assert worst.residual == max(result.curves[name][np.abs(errors) <= 0.07])


def test_plain_step_counts_from_when_the_two_step_command_arrives(small):
    _, results = small
    assert results['unshaped step'].arrival == results['two-step'].arrival
    damped = NondimensionalParameters(3.0)
    move = Move(Code.STEP, (Level(0.0, 0.3),), math.inf)
    assert arrival_of(move, 1.0, 1.1, damped) == pytest.approx(
        math.pi / natural_frequency(1.1, damped))


def test_shapers_that_fall_back_or_refuse_say_so():
    damped = study(Case(1.0, 1.1, NondimensionalParameters(3.0)), Candidate('two_step'))
    assert damped.code is Code.TOO_DAMPED
    assert 'too damped' in damped.reason
    refused = study(Case(1.0, 1.1, limits=Limits(-0.1, 0.1)), Candidate('two_step'))
    assert (refused.code, refused.move) == (Code.FLUX_LIMIT, None)
    assert 'flux density' in refused.reason
    assert math.isnan(refused.worst.residual)


@pytest.fixture
def lost(monkeypatch):
    """Return a study in which the simulation fails if zeta is too large."""
    case = Case(1.0, 1.1)
    whole = Actual.residual

    def losing(plant, *words):
        stiffer = plant.load
        if plant.material.zeta * math.sqrt(stiffer) > case.material.zeta * (1.0 + 1e-12):
            raise HmsaError('the integration ran out of steps')
        return whole(plant, *words)

    monkeypatch.setattr(Actual, 'residual', losing)
    return case, study(case, Candidate('step'))


def test_motion_that_cannot_be_followed_is_no_number(lost):
    case, result = lost
    assert math.isnan(result.worst.residual)
    assert math.isnan(result.alone['zeta'].residual)
    assert np.array_equal(np.isnan(result.curves['zeta']), case.errors() > 0.0)
    assert result.alone['G'].residual > 1.0
    assert percent(result.worst.residual) == '?'


def test_robustness_table_has_a_row_for_every_number(tmp_path, small):
    case, results = small
    refused = study(Case(1.0, 1.1, limits=Limits(-0.1, 0.1)), Candidate('zv'))
    path = tmp_path / 'r.csv'
    write_csv(path, [(case, [*results.values(), refused])])
    rows = list(csv.DictReader(path.read_text().splitlines()))
    assert len(rows) == len(results) * (3 * len(case.errors()) + 1) + 1
    worst = [x for x in rows if x['varied'] == 'box' and x['shaper'] == 'robust']
    assert [x['order'] for x in worst] == ['2', '3']
    assert float(worst[0]['residual']) == results['robust, order 2'].worst.residual
    assert rows[-1]['status'] == 'flux_limit'
    offsets = {float(x['error_G']): float(x['offset']) for x in rows if x['varied'] == 'G'}
    assert offsets[0.0] == pytest.approx(0.0, abs=1e-12)
    assert offsets[0.1] == pytest.approx(-0.098, abs=1e-3)


@pytest.mark.parametrize(('make', 'message'), [
    (lambda: Errors(shear_modulus=-1.0), 'shear_modulus'), (lambda: Errors(zeta=math.nan), 'zeta'),
    (lambda: Errors(j_lim=math.inf), 'j_lim'), (lambda: Candidate('robust', 101), '101'),
    (lambda: Case(0.1, 1.0), 'start stretch'), (lambda: Case(1.0, 1.2, box=0.3), '0.3'),
    (lambda: Case(1.0, 1.2, span=1.0), '0.9')])
def test_studies_refuse_what_is_out_of_range(make, message):
    with pytest.raises(BadInputError, match=message):
        make()


def test_shapers_are_compared_once_each_and_robust_with_each_order():
    assert [x.name for x in candidates()] == [
        'two-step', 'robust, order 2', 'robust, order 3', 'minimax, order 2',
        'minimax, order 3', 'minimum time', 'smooth', 'unshaped step', 'ZV', 'ZVD', 'EI', 'UM-ZV']
    assert candidates(['robust', 'zv', 'robust', 'zv'], [4, 1]) == (
        Candidate('robust', 4), Candidate('robust', 1), Candidate('zv'))


# --- sampled hardware, heavy damping


@pytest.mark.parametrize(('start', 'target'), [(1.0, 1.1), (1.0, 1.6), (1.3, 0.8)])
def test_command_solved_on_the_grid_is_exact_and_a_rounded_one_is_not(start, target):
    periods = np.array([0.013, 0.031, 0.057, 0.114, 0.19, 0.27, 1.0 / 3.0])
    found = sampled_study(start, target, MATERIAL, periods)
    assert np.all(found.solved < EXACT)
    assert np.all(found.rounded <= 1.01 * found.bound)
    # In proportion to the period.
    assert found.bound[:4] / periods[:4] == pytest.approx(
        found.bound[0] / periods[0], rel=0.02)
    assert found.bound[0] > 0.01


def test_sampled_study_needs_a_two_step_command():
    with pytest.raises(HmsaError, match='too_damped'):
        sampled_study(1.0, 1.1, NondimensionalParameters(4.0), np.array([0.1]))


def test_plain_step_settles_as_the_linear_oscillator_for_small_moves():
    target = 1.0 + 1e-5
    material = NondimensionalParameters(4.0)
    frequency = float(natural_frequency(1.0, material))
    ratio = material.zeta / float(critical_zeta(1.0, material))
    root = math.sqrt(ratio * ratio - 1.0)
    slow, fast = frequency * (ratio - root), frequency * (ratio + root)

    def away(time):
        return (fast * math.exp(-slow * time) - slow * math.exp(-fast * time)) / (fast - slow)

    move = Move(Code.STEP, (Level(0.0, float(elastic_force(target, 5.0))),), math.inf)
    assert settling_time(move, 1.0, target, material) == pytest.approx(
        brentq(lambda t: away(t) - 0.01, 0.1, 100.0), rel=1e-4)


def test_minimum_time_arrives_long_before_the_plain_step_settles():
    found = damped_study(1.0, 1.1, np.array([2.2, 4.0, 6.0]))
    assert np.all(np.diff(found.step) > 0.0)
    assert np.all(found.arrival[0] < 0.5 * found.step)
    assert np.all(found.arrival[1] < found.arrival[0])
    assert np.all(found.settled <= found.arrival)


def test_settling_refuses_a_command_that_leads_elsewhere():
    move = Move(Code.STEP, (Level(0.0, 0.1),), math.inf)
    with pytest.raises(HmsaError, match='has not settled'):
        settling_time(move, 1.0, 1.1, MATERIAL)


# --- pictures and documentation


@pytest.mark.slow
def test_tables_of_the_documentation_are_what_is_computed():
    found = [
        [[cell.strip() for cell in line.strip('|').split('|')] for line in block.splitlines()
         if '---' not in line]
        for block in re.findall(r'(?:^\|.*\n)+', DOCS.read_text(encoding='utf-8'), re.M)]
    # Those of feedback take minutes.
    found = [x for x in found if x[0][0] not in ('samples', '')]
    for shown, made in zip(found, tables(), strict=True):
        assert [x[0] for x in shown] == [x[0] for x in made]
        assert shown[0] == list(made[0])
        for shown_row, made_row in zip(shown[1:], made[1:], strict=True):
            for cell, expected in zip(shown_row[1:], made_row[1:], strict=True):
                if re.fullmatch(r'[\d.]+', expected):
                    # Rounding may fall either way.
                    last = 10.0 ** -len(expected.partition('.')[2])
                    assert float(cell) == pytest.approx(float(expected), abs=1.01 * last)
                else:
                    assert cell == expected


@pytest.mark.slow
def test_pictures_take_what_is_missing(tmp_path, lost):
    case, result = lost
    refused = study(Case(1.0, 1.1, limits=Limits(-0.1, 0.1)), Candidate('two_step'))
    draw_robustness(tmp_path / 'r.png', case, [result, refused])
    draw_front(tmp_path / 'f.png', [(case, [result, refused])] * 4)
    assert (tmp_path / 'r.png').read_bytes().startswith(PNG)
    with pytest.raises(BadInputError, match='cannot write'):
        draw_robustness(tmp_path / 'none' / 'r.png', case, [])
    with pytest.raises(BadInputError, match='cannot write'):
        draw_damped(tmp_path / 'none' / 'd.png', damped_study(1.0, 1.1, np.array([2.2, 4.0])))
    with pytest.raises(BadInputError, match='cannot write'):
        draw_sampled(tmp_path / 'none' / 's.png', sampled_study(
            1.0, 1.1, MATERIAL, np.array([0.1, 0.3])))


# --- sweeps


def rows_of(sweep, rows=10_000):
    """Return a sweep's columns, joined over the blocks."""
    blocks = list(sweep.blocks(rows))
    columns = {name: np.concatenate([x.inputs[name] for x in blocks]) for name in blocks[0].inputs}
    columns['status'] = np.concatenate([x.status for x in blocks])
    return columns | {
        name: np.concatenate([x.results[name] for x in blocks]) for name in blocks[0].results}


def test_grids_are_values_lines_and_logarithms():
    assert parse_grid('0.2', 'zeta').tolist() == [0.2]
    assert parse_grid('0:2:5', 'zeta').tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert parse_grid('2:0:3', 'zeta').tolist() == [2.0, 1.0, 0.0]
    assert parse_grid('log:0.1:10:3', 'j_lim') == pytest.approx([0.1, 1.0, 10.0])
    assert parse_grid('log:0.1:10:3', 'j_lim')[[0, -1]].tolist() == [0.1, 10.0]
    assert parse_grid(' 1.1, 1.2:1.4:2 ,1', 'target').tolist() == [1.1, 1.2, 1.4, 1.0]


@pytest.mark.parametrize(('text', 'message'), [
    ('', 'expected VALUE'), ('a', 'expected VALUE'), ('1:2', 'expected VALUE'),
    ('1:2:3:4', 'expected VALUE'), ('1:2:x', 'expected VALUE'), ('1:2:2.5', 'expected VALUE'),
    ('log', 'expected VALUE'), ('log:1:2', 'expected VALUE'), ('1,,2', 'expected VALUE'),
    ('ln:1:2:3', 'expected VALUE'), ('1:2:1', 'at least 2'), ('1:2:-5', 'at least 2'),
    ('nan', 'finite'), ('1:inf:4', 'finite ends'), ('nan:1:4', 'finite ends'), ('inf', 'finite'),
    ('-1', '-1: expected'), ('0:1:3', 'value 0'), ('log:0:1:3', 'logarithmic'),
    ('log:-1:1:3', 'logarithmic'), ('1:2:10000001', '10,000,001'),
    ('1:2:6000000,1:2:6000000', '12,000,000'), ('1:2:' + '9' * 30, '999,999')])
def test_malformed_grids_are_refused(text, message):
    with pytest.raises(BadInputError, match=message):
        Sweep({'c1': parse_grid(text, 'c1')})


def test_sweep_is_the_product_of_its_columns_with_the_last_one_fastest():
    sweep = Sweep({'zeta': np.array([0.1, 0.3]), 'start': np.array([1.0, 1.2])},
                  {'target': np.array([1.1, 1.3, 0.9]), 'c1': np.array([2.0, 1.0, 2.0])})
    found = rows_of(sweep)
    assert sweep.size == 12
    assert found['target'].tolist() == [1.1] * 4 + [1.3] * 4 + [0.9] * 4
    assert found['c1'].tolist() == [2.0] * 4 + [1.0] * 4 + [2.0] * 4
    assert found['start'].tolist() == [1.0, 1.0, 1.2, 1.2] * 3
    assert found['zeta'].tolist() == [0.1, 0.3] * 6
    assert found['j_lim'].tolist() == [5.0] * 12
    assert tuple(found) == COLUMNS


def test_sweep_rows_are_the_plans_of_single_moves_whatever_the_blocks():
    grids = {'zeta': np.array([0.0, 0.4, 1.1]), 'target': np.array([1.1, 0.7, 1.4, 1.0]),
             'j_lim': np.array([1.0, 5.0])}
    found = rows_of(Sweep(grids), rows=5)
    for name, column in rows_of(Sweep(grids)).items():
        assert np.array_equal(column, found[name], equal_nan=name != 'status')
    for i in range(24):
        plan = plan_two_step(
            found['start'][i], found['target'][i],
            NondimensionalParameters(found['zeta'][i], found['j_lim'][i], found['c1'][i]))
        assert found['status'][i] == str(plan.code)
        assert found['tau_p'][i] == pytest.approx(plan.tau_p, rel=1e-11, nan_ok=True)
        assert found['beta_p'][i] == pytest.approx(plan.beta_p, rel=1e-11, nan_ok=True)
        assert found['b_p'][i] == pytest.approx(
            math.copysign(math.sqrt(abs(plan.beta_p)), plan.beta_p), rel=1e-11, nan_ok=True)
        assert found['b_1'][i] * abs(found['b_1'][i]) == pytest.approx(plan.beta_1)


def test_bad_rows_say_why_and_do_not_spoil_the_others():
    good = rows_of(Sweep({}))
    found = rows_of(Sweep({}, {
        'target': np.array([1.1, math.nan, 3.0, 1.1, 1.1, 1.0, 1.1]),
        'zeta': np.array([0.2, 0.2, 0.2, -1.0, 3.0, 0.2, 0.2])}))
    assert found['status'].tolist() == [
        'two_step', 'bad_input', 'out_of_range', 'bad_input', 'too_damped', 'hold', 'two_step']
    assert [found['tau_p'][i] for i in (0, 6)] == [good['tau_p'][0]] * 2
    assert np.isnan(found['tau_p'][1:5]).all()
    assert found['beta_1'][4] == good['beta_1'][0]


@pytest.mark.parametrize(('arguments', 'message'), [
    (({'damping': np.ones(2)},), 'damping'),
    (({'zeta': np.ones(2)}, {'zeta': np.ones(2)}), 'zeta is a column of the cases'),
    (({}, {'zeta': np.ones(2), 'c1': np.ones(3)}), 'differ in length'),
    (({'zeta': np.ones(0)},), 'empty')])
def test_sweep_refuses_columns_that_do_not_fit(arguments, message):
    with pytest.raises(BadInputError, match=message):
        Sweep(*arguments)


def test_cases_are_read_by_column_in_full_precision(tmp_path):
    path = tmp_path / 'cases.csv'
    path.write_text('\ufefftarget, zeta\n1.1000000000000001,0.2\n\nnan,-1\n', encoding='utf-8')
    found = read_cases(path, COLUMNS)
    assert list(found) == ['target', 'zeta']
    assert found['target'][0] == 1.1000000000000001
    assert math.isnan(found['target'][1])
    assert found['zeta'].tolist() == [0.2, -1.0]


@pytest.mark.parametrize(('content', 'message'), [
    (b'', 'is empty'), (b'target\n', 'header only'), (b'target,load\n1,2\n', "'load'"),
    (b'target,target\n1,2\n', 'two columns'), (b'target\n1.1,2\n', 'line 2: 2 cells'),
    (b'target,zeta\n1.1,0.2\n1.2\n', 'line 3: 1 cells'), (b'target\nfar\n', "'far'"),
    (b'target\n""\n', "''"), (b'target\n"1.1\n', 'no CSV'), (b'\xff\xfe\x00', 'UTF-8')])
def test_tables_of_cases_that_are_none_are_refused(tmp_path, content, message):
    path = tmp_path / 'cases.csv'
    path.write_bytes(content)
    with pytest.raises(BadInputError, match=message):
        read_cases(path, COLUMNS)


@pytest.mark.parametrize('name', ['sweep.csv', 'sweep.PARQUET'])
def test_a_table_has_every_digit_of_the_columns(tmp_path, name):
    sweep, path = Sweep({'target': np.array([1.1, 3.0, 0.7])}), tmp_path / name
    if name != 'sweep.csv':
        parquet = needs('pyarrow.parquet')
    with open_writer(path, COLUMNS) as write:
        for block in sweep.blocks(2):
            write(block)
    if name == 'sweep.csv':
        rows = list(csv.DictReader(path.read_text().splitlines()))
        columns = {x: [y[x] if x == 'status' else float(y[x]) for y in rows] for x in rows[0]}
    else:
        columns = parquet.read_table(path).to_pydict()
    assert tuple(columns) == COLUMNS
    for key, values in rows_of(sweep).items():
        assert np.array_equal(columns[key], values, equal_nan=key != 'status')
    assert [x.name for x in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize('name', ['sweep.csv', 'sweep.parquet'])
def test_sweep_that_is_broken_off_leaves_the_old_file(tmp_path, name):
    if name.endswith('.parquet'):
        needs('pyarrow')
    path = tmp_path / name
    path.write_text('old')

    def break_off():
        with open_writer(path, COLUMNS) as write:
            write(next(Sweep({}).blocks(1)))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        break_off()
    assert path.read_text() == 'old'
    assert [x.name for x in tmp_path.iterdir()] == [name]


def test_sweep_of_any_size_is_planned_without_being_held_in_memory():
    axis = np.linspace(1.05, 1.5, MOST_VALUES // 1000)
    sweep = Sweep({'zeta': axis, 'target': axis, 'j_lim': 4.0 + axis, 'c1': axis})
    assert sweep.size == 10**16
    block = next(sweep.blocks(3))
    assert block.inputs['target'].tolist() == [1.05] * 3
    assert block.status.tolist() == ['two_step'] * 3
