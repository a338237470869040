"""The benchmarks run, and their comparisons are correct; their speed is not tested."""

from dataclasses import replace
from decimal import Decimal
import json
import math

from identification_oracle import Extras, simulate
import numpy as np
import pytest
from rich.console import Console
from scipy.integrate import solve_ivp

from benchmarks import __main__ as program
from benchmarks import (
    bench_defects,
    bench_harm,
    bench_judge,
    bench_laboratory,
    bench_line,
    bench_plant,
    contenders,
)
from benchmarks.bounds import bound
from benchmarks.laboratory import Change, Device, drawn, KINDS, Plant
from benchmarks.measure import Contender, loosest, race, Row, table, text_of_time
from benchmarks.reference import Actuator, response, two_step
from benchmarks.sheet import Sheet

ACTUATOR = Actuator(zeta=0.2, j_lim=5.0, c1=2.0)


def energy(stretch, j_lim):
    return -j_lim / 2 * (1 - (2 / stretch + stretch ** 2 - 3) / j_lim).ln()


@pytest.mark.parametrize(('start', 'target'), [(1.0, 1.1), (1.2, 1.4), (0.9, 0.7)])
def test_reference_agrees_with_the_energy_balance_without_damping(start, target):
    load, _ = two_step(start, target, Actuator(zeta=0.0))
    j_lim = Decimal(5)
    exact = (energy(Decimal(target), j_lim) - energy(Decimal(start), j_lim)) / (
        Decimal(target) - Decimal(start))
    assert abs(load / exact - 1) < Decimal('1e-24')


def test_reference_agrees_with_scipy_on_the_damped_response():
    loads = [contenders.holding_load(1.3, 5.0), contenders.holding_load(0.8, 5.0)]
    times = [0.5, 1.0, 1.7, 2.0, 3.1]
    found = response([0.0, 1.7], loads, times, 1.1, ACTUATOR)
    state = [1.1, 0.0]
    expected = []
    for load, samples, begin in ((loads[0], times[:3], 0.0), (loads[1], times[3:], 1.7)):
        solution = solve_ivp(
            lambda _, y, load=load: (y[1], contenders.acceleration(*y, load, ACTUATOR)),
            (begin, samples[-1]), state, method='DOP853', t_eval=samples, rtol=1e-13,
            atol=1e-13)
        expected += list(solution.y[0])
        state = solution.y[:, -1]
    np.testing.assert_allclose([float(x) for x in found], expected, rtol=0.0, atol=1e-11)


def test_reference_gives_up_where_the_load_never_turns():
    with pytest.raises(ArithmeticError, match='no turning point'):
        two_step(1.0, 1.1, Actuator(zeta=20.0))


def test_quick_run_prints_and_writes_what_it_measured(tmp_path, capsys):
    file, page = tmp_path / 'figures.json', tmp_path / 'page.md'
    page.write_text('<!-- begin plant -->\n<!-- end plant -->\n')
    assert program.main(
        ['plant', '--quick', '--json', str(file), '--page', str(page)]) == 0
    record = json.loads(file.read_text())['plant']
    rows = record['figures']['rows']
    assert rows
    assert all(x['error'] <= bench_plant.LIMIT and 0.0 < x['least'] <= x['median'] for x in rows)
    assert record['title'] in page.read_text()
    assert record['title'] in capsys.readouterr().out


def test_tables_of_a_page_are_renewed_and_nothing_else():
    page = 'a\n<!-- begin x -->\nold\n<!-- end x -->\nb <!-- begin y --> c\n'
    assert program.renewed(page, {'x': 'new\n', 'y': 'lost', 'z': 'lost'}) == (
        'a\n<!-- begin x -->\n\nnew\n\n<!-- end x -->\nb <!-- begin y --> c\n')


@pytest.mark.parametrize('name', [
    'machine', 'planner', 'plant', 'start', 'choices', 'recorder', 'player', 'crash', 'joints',
    'adapting'])
def test_page_on_speed_has_marks_for_each_table(name):
    page = (contenders.HERE.parent / 'docs' / 'validation' / 'speed.md').read_text(
        encoding='utf-8')
    assert page.count(f'<!-- begin {name} -->') == page.count(f'<!-- end {name} -->') == 1


def test_unknown_benchmark_is_refused_in_one_line(capsys):
    with pytest.raises(SystemExit) as error:
        program.main(['plan'])
    assert error.value.code == 2
    assert "no benchmark 'plan'" in capsys.readouterr().err


def test_race_takes_turns_and_keeps_the_least():
    turns = []

    def clock(name, times):
        def run():
            turns.append(name)
            return times.pop(0)
        return run

    rows = race([
        Contender('a', '', clock('a', [(2.0, 3.0), (1.0, 4.0), (5.0, 9.0)]), 0.0),
        Contender('b', '', clock('b', [(7.0, 8.0)] * 3), 0.0)], 3)
    assert turns == ['a', 'b'] * 3
    assert [(x.least, x.median) for x in rows] == [(1.0, 4.0), (7.0, 8.0)]


def test_loosest_tolerance_keeps_the_error_and_the_next_one_does_not():
    tolerance = loosest(lambda x: 3.0 * x, 1e-9)
    assert 3.0 * tolerance <= 1e-9 < 3.0 * tolerance * 10.0 ** (1.0 / 3.0)


def test_loosest_tolerance_says_when_there_is_none():
    with pytest.raises(ArithmeticError, match='no tolerance'):
        loosest(lambda _: math.nan, 1e-9)


def test_verdicts_on_runs_drawn_at_random_are_never_wrong_and_mostly_given():
    sheet = bench_judge.compare(quick=True)
    assert sheet.figures['failures'] == []
    assert sheet.passed
    kinds = sheet.figures['kinds'].values()
    clear, undecided = (sum(x[key] for x in kinds) for key in ('clear', 'clear_undecided'))
    assert clear > 50
    assert undecided < 0.1 * clear


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_fit_of_what_the_model_lacks_is_never_called_identified_with_wrong_intervals():
    sheet = bench_defects.compare(quick=False, runs=10)
    assert sheet.passed, sheet.figures


def test_the_plant_of_a_laboratory_moves_as_scipy_says():
    bench = replace(
        drawn(1), lag=0.05 * drawn(1).unit, ratio=0.05, relaxation=2.0 * drawn(1).unit, force=0.02)
    unit = bench.unit
    switches, levels = [0.0, unit, 2.3 * unit], [0.0, 0.08, 0.12]
    times = np.linspace(0.0, 12.0 * unit, 60)
    plant = Plant(bench, 0)
    for time, level in zip(switches, levels, strict=True):
        plant.command(round(1e9 * time), level)
    found = [plant.advance(round(1e9 * x)) for x in times]
    expected = simulate(times, switches, levels, bench.block, Extras(
        coil=bench.lag, ratio=bench.ratio, time=bench.relaxation, force=bench.force))
    assert found == pytest.approx(expected, abs=1e-6)


def test_a_laboratory_is_the_same_for_the_same_seed_and_in_open_loop_leaves_what_is_wrong():
    assert drawn(5) == drawn(5)
    assert {drawn(x).group for x in range(20)} == set(bench_harm.GROUPS)
    bench = replace(drawn(0), targets=(1.2,))
    exact, = bench_harm.run(bench, 'open loop')
    assert exact.size < 1e-4
    weak, = bench_harm.run(replace(
        bench, block=replace(bench.block, remanence=0.95 * bench.block.remanence)), 'open loop')
    assert 0.04 < weak.offset < 0.08
    assert bench_harm.harm({'open loop': [exact], 'adapt': [weak]}, 'adapt') == [
        weak.size - exact.size]
    assert Device(bench, 0).next_sample > 0


def test_a_laboratory_that_changes_leaves_as_much_as_its_change_from_then_on():
    assert {drawn(x, 6, changes=True).change is None for x in (0, 1)} == {True}
    # The sensor as it was at first decides what is left.
    for kind, size, shown in (
            ('modulus', 0.05, True), ('force', 0.02, True), ('bias', 0.02, False),
            ('gain', 0.02, False)):
        bench = replace(drawn(0), targets=(1.2, 1.4), change=Change(kind, size, 1, 'after'))
        first, second = bench_harm.run(bench, 'open loop')
        assert first.size < 1e-4
        assert second.offset > 0.01 if shown else second.offset < 1e-4


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_laboratory_behind_a_board_is_tuned_to_half_a_percent_of_a_step():
    found = bench_laboratory.run_one(bench_laboratory.SEEDS[False] + 3, iron=False)
    assert max(x.size for x in found.before) > 0.1
    assert found.last <= bench_laboratory.GOALS[False]
    assert (found.verdict, found.silent) == ('identified', 0)


@pytest.mark.slow
@pytest.mark.parametrize('fault', bench_line.FAULTS)
def test_faults_of_a_line_leave_the_coil_safe_and_the_next_move_arrives(fault):
    found = bench_line.run_one(bench_line.SEED, fault=fault)
    assert (found.reported, found.silent) == (True, 0)
    assert not found.off > 0.51
    assert found.next.size <= bench_line.GOAL


def test_a_laboratory_bounds_what_the_second_move_leaves_by_what_may_be_wrong():
    bench = replace(drawn(1), noise=1e-4)
    found = [bound(x, y) for x in (bench, replace(bench, noise=1e-3))
             for y in ((), ('force',), tuple(KINDS))]
    # A bias alone leaves nothing, and more noise or more to be known leaves more.
    assert found[0] == found[3] == 0.0
    assert found[0] < found[1] < found[2] < found[5]
    assert 5.0 < found[4] / found[1] < 20.0


@pytest.mark.parametrize(('within', 'verdict', 'said'), [
    (False, 'arrived', 'wrong arrived'), (True, 'off_target', 'wrong missed'),
    (True, 'arrived', ''), (False, 'vibrating', ''), (None, 'arrived', ''),
    (True, 'undecided', ''), (False, 'unobserved', '')])
def test_a_verdict_is_wrong_where_the_truth_is_the_reverse(within, verdict, said):
    trial = replace(bench_judge.draw(1, 'white'), within=within)
    assert bench_judge.wrong(trial, verdict) == said


def test_table_compares_to_its_first_row_and_leaves_empty_columns_out():
    sheet = table('x', 'Title', 'time', 'error', [
        Row('ours', 'fine', 2e-6, 3e-6), Row('theirs', 'coarse', 5e-3, 6e-3),
        Row('other', note='not installed')])
    assert sheet.markdown().splitlines() == [
        '**Title**', '',
        '|  | setting | time | median | ratio | remark |',
        '| --- | --- | --: | --: | --: | --- |',
        '| ours | fine | 2 us | 3 us | 1 |  |',
        '| theirs | coarse | 5 ms | 6 ms | 2,500 |  |',
        '| other |  | - | - | - | not installed |']


def test_sheet_has_its_own_headings_on_a_page_and_in_print():
    sheet = Sheet('x', 'Title', ['', 'lost'], [['ours', '0'], ['theirs', '1,000']], {'a': 1.5})
    assert sheet.markdown().splitlines() == [
        '**Title**', '', '|  | lost |', '| --- | --: |', '| ours | 0 |', '| theirs | 1,000 |']
    console = Console(record=True, width=40)
    sheet.show(console)
    assert '1,000' in console.export_text()
    assert json.loads(json.dumps(sheet.record()))['figures'] == {'a': 1.5}


@pytest.mark.parametrize(('seconds', 'text'), [
    (None, '-'), (1.5, '1.5 s'), (0.0123, '12.3 ms'), (7.61e-6, '7.61 us'), (3e-8, '30 ns')])
def test_times_are_written_with_a_unit_that_suits_them(seconds, text):
    assert text_of_time(seconds) == text
