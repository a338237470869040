"""A run as a record: parameters from files, verification, tables, and intact files."""

import csv
from dataclasses import replace
import json
import math
from pathlib import Path

from beam_oracle import silicone
import numpy as np
import pytest

from hmsa.bag.info import BagSummary
from hmsa.cli import main
from hmsa.columns import write_table
from hmsa.errors import BadInputError
from hmsa.files import json_text, replacing, write_text
from hmsa.interfaces.actuator import parameters_of
from hmsa.interfaces.parameters import number_of
from hmsa.model.creep import Creep
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation
from hmsa.model.units import NANOSECONDS
from hmsa.runs import bags
from hmsa.runs.parameters import actuators, read_parameter_file, recorded, values_of
from hmsa.runs.record import lateness_of, levels_of, RecordedLevel, Run, samples_of
from hmsa.runs.topics import APPLIED, COMMAND
from hmsa.runs.verify import verify_run

BEGIN = NANOSECONDS
STEP = 1_000_000


def moved(*, applied=True, commands=((10, 0.01),), creep=None, told=None):
    """Return a run of 100 samples whose commands, (sample, T), were obeyed or not."""
    simulation = ActuatorSimulation(paper_actuator(), time=BEGIN, creep=creep)
    levels = [RecordedLevel(BEGIN + at * STEP, flux, BEGIN) for at, flux in commands]
    rows = []
    for level in levels if applied else ():
        simulation.command(level.stamp, level.flux_density)
    for k in range(100):
        simulation.advance(BEGIN + k * STEP)
        rows.append((simulation.stretch, simulation.rate, simulation.flux_density))
    time = BEGIN + STEP * np.arange(100)
    stretch, rate, field = np.array(rows).T
    in_force = [RecordedLevel(BEGIN, 0.0, BEGIN), *(levels if applied else ())]
    return Run(
        'run', 'actuator', Path('run'), time, time, stretch, rate, field,
        commands=tuple(levels), applied=tuple(in_force), parameters_known=True,
        parameters=told or {},
        topics={COMMAND: '/flux_density_command', APPLIED: '/flux_density_applied'})


def test_a_command_that_nobody_applied_is_said_though_the_motion_fits():
    found = verify_run(moved(applied=False))
    assert (found.largest_difference, found.unapplied_count) == (0.0, 1)
    assert 'no node applied them' in found.note
    found = verify_run(moved())
    assert (found.unapplied_count, found.note) == (0, '')
    assert found.largest_difference < 1e-12


@pytest.mark.parametrize('text', [
    '/**:\n  ros__parameters:\n    actuator.density: 1.0\n    actuator.density: 2.0\n',
    2 * '/**:\n  ros__parameters:\n    actuator.density: 1.0\n'])
def test_a_parameter_file_with_a_key_twice_is_refused(tmp_path, text):
    file = tmp_path / 'twice.yaml'
    file.write_text(text)
    with pytest.raises(BadInputError, match='begins a mapping with several .*each key once'):
        read_parameter_file(file)


def test_samples_of_a_clock_that_was_set_back_are_no_run_to_compare():
    run = moved()
    # The second half repeats times of the first.
    stamps = run.time - np.where(np.arange(100) < 50, 0, 200 * STEP)
    order = np.argsort(stamps)
    back = {x: getattr(run, x)[order] for x in ('logged', 'stretch', 'rate', 'flux_density')}
    with pytest.raises(BadInputError, match=r'samples in run jump back by 0\.199 s'):
        verify_run(replace(run, time=stamps[order], **back))


def test_a_recording_that_begins_in_the_middle_begins_with_what_it_shows():
    # Held at 10 mT when the recording begins, moved to 20 mT later; both are sent again.
    run = moved(commands=((0, 0.01), (60, 0.01), (80, 0.02)))
    run = replace(run, commands=run.commands[1:], applied=run.applied[-1:], **{
        x: getattr(run, x)[50:] for x in ('time', 'logged', 'stretch', 'rate', 'flux_density')})
    found = verify_run(run)
    assert (found.unapplied_count, found.largest_difference < 1e-12) == (0, True)
    # A driver that measures no field, and one that reports no level.
    flux_density = np.full(len(run.time), np.nan)
    held = replace(run, applied=(), flux_density=flux_density, stretch=np.full(
        len(run.time), run.stretch[0]), rate=0.0 * run.rate, commands=())
    assert verify_run(held).largest_difference < 1e-9


CREEP = Creep((0.1, 0.2), (0.005, 0.05))
TOLD = {'plant.viscoelastic.ratio': [0.1, 0.2], 'plant.viscoelastic.time': [0.005, 0.05]}


def test_a_plant_that_creeps_comes_out_again_if_its_branches_are_known():
    found = verify_run(moved(creep=CREEP, told=TOLD))
    assert found.largest_difference < 1e-12
    assert found.note == ''
    assert verify_run(moved(creep=CREEP)).largest_difference > 1e-4


def test_a_creeping_plant_recorded_from_the_middle_of_a_motion_on_is_said_to_be():
    run = moved(creep=CREEP, told=TOLD)
    late = replace(run, **{x: getattr(run, x)[40:] for x in (
        'time', 'logged', 'stretch', 'rate', 'flux_density')})
    found = verify_run(late)
    assert found.largest_difference > 1e-4
    assert 'the first sample is not at rest' in found.note
    with pytest.raises(BadInputError, match='ratio has 1 values and viscoelastic.time 2'):
        verify_run(moved(told={**TOLD, 'plant.viscoelastic.ratio': 0.1}))


def test_notes_say_that_a_plant_creeps_or_that_nobody_could_creep_so():
    def notes(told):
        return ' '.join(actuators(told, {}, 'one')[3])

    assert 'creeps' not in notes({'plant.viscoelastic.ratio': []})
    assert 'The elastomer of the plant creeps' in notes({
        'plant.one.viscoelastic.ratio': [0.1], 'plant.one.viscoelastic.time': [0.05]})
    assert 'creep cannot be used: viscoelastic.ratio has 2 values' in notes({
        **TOLD, 'plant.viscoelastic.time': 0.05})


def test_the_file_of_a_beam_for_the_recording_of_a_block_and_the_reverse_are_refused():
    def told(actuator):
        return {f'plant.{name}': value for name, value in parameters_of(actuator).items()}

    block, beam = told(paper_actuator()), told(silicone())
    assert [actuators(x, {}, '')[0].coordinate.name for x in (block, beam)] == [
        'stretch', 'deflection']
    with pytest.raises(BadInputError, match='file has deflections, that of the plant in the bag '
                                            'stretches: expected the file of the recorded'):
        actuators(block, beam, '')
    with pytest.raises(BadInputError, match='file has stretches, that of the plant in the bag '):
        actuators(beam, block, '')
    with pytest.raises(BadInputError, match='first sample of run is not of the actuator that the '
                                            'parameters describe: deflection is 1: .*-0.7862'):
        verify_run(replace(moved(), plant=silicone()))


def test_a_level_that_was_in_force_already_is_no_command_without_effect():
    earlier = RecordedLevel(BEGIN - 2 * STEP, 0.02, BEGIN), RecordedLevel(
        BEGIN - STEP, 0.01, BEGIN)
    commands = RecordedLevel(BEGIN, 0.01, BEGIN), RecordedLevel(BEGIN + STEP, 0.03, BEGIN)
    lateness, unapplied = lateness_of(
        commands, (*earlier, RecordedLevel(BEGIN + STEP, 0.03, BEGIN)), BEGIN + 9 * STEP)
    assert unapplied == 0
    assert lateness[1] == 0.0


def test_levels_that_a_board_rounds_took_effect():
    asked = np.array([0.0201004, 0.0345398, 0.0648543, 0.0291936, 0.0])
    commands = [RecordedLevel(BEGIN + i * STEP, x, BEGIN) for i, x in enumerate(asked.tolist())]
    # It counts in us, and sets multiples of 5 uT.
    off = [445, -237, 1854, -435, 493]
    applied = [RecordedLevel(x.stamp + late, round(x.flux_density / 5e-6) * 5e-6, BEGIN)
               for x, late in zip(commands, off, strict=True)]
    lateness, unapplied = lateness_of(commands, applied, BEGIN + 9 * STEP)
    assert unapplied == 0
    assert lateness == pytest.approx(np.array(off) * 1e-9)
    assert lateness_of(commands, applied[:2], BEGIN + 9 * STEP)[1] == 3


def test_the_levels_of_a_long_path_are_paired_within_a_second():
    """Compared one by one, they take minutes, and this test ends at its time limit."""
    commands = [
        RecordedLevel(BEGIN + k * STEP, 1e-6 * (7919 * k % 50_021), BEGIN)
        for k in range(30_000)]
    applied = [replace(x, stamp=x.stamp + 2000) for x in commands if x.stamp % (5 * STEP)]
    lateness, unapplied = lateness_of(commands, applied, BEGIN + 10**6 * STEP)
    assert unapplied == len(commands) - len(applied)
    assert np.nanmax(np.abs(lateness - 2e-6)) < 1e-12


def test_a_late_command_that_the_next_one_replaced_at_once_is_late_and_not_lost():
    commands = [RecordedLevel(BEGIN + i * STEP, 0.01 * (i + 1), BEGIN + 3 * STEP)
                for i in range(2)]
    applied = [RecordedLevel(BEGIN + 3 * STEP, 0.02, BEGIN + 3 * STEP)]
    lateness, unapplied = lateness_of(commands, applied, BEGIN + 9 * STEP)
    assert (lateness.tolist(), unapplied) == ([math.inf, 2 * STEP / NANOSECONDS], 0)


@pytest.mark.parametrize('reports', [True, False])
@pytest.mark.parametrize('anew', [0.01, 0.02])
def test_a_command_that_came_too_late_is_paired_with_nothing_that_is_sent_later(anew, reports):
    """The rejected level is sent again at a later time, by itself or after another one."""
    begin, *levels = moved(commands=((5, 0.02), (60, anew), (80, 0.02))).applied
    late = replace(levels[0], sent=levels[0].stamp + 25 * STEP)
    run = moved(commands=((60, anew), (80, 0.02)))
    run = replace(
        run, commands=(late, *levels[1:]), parameters={'plant.lateness_limit': 0.02},
        **({} if reports else {'applied': (), 'topics': {COMMAND: run.topics[COMMAND]}}))
    found = verify_run(run)
    assert (found.unapplied_count, found.late_count, found.rejected_count) == (0, 0, 1)
    assert found.largest_difference < 1e-12
    assert '1 commands came later than lateness_limit and were rejected' in found.note
    # One that the recorder alone received late was applied.
    assert replace(run, applied=(begin, *levels)).rejected == 0


def test_a_table_has_the_samples_in_full_precision_and_the_levels_at_their_times(tmp_path):
    run = moved()
    for columns, name in ((samples_of(run), 'a.csv'), (levels_of(run), 'b.csv')):
        write_table(tmp_path / name, columns)
        with (tmp_path / name).open(encoding='utf-8', newline='') as file:
            rows = list(csv.DictReader(file))
        for key, values in columns.items():
            assert [float(row[key]) for row in rows] == values.tolist()
    assert [float(row['time']) for row in rows] == [0.0, 0.01]


@pytest.mark.parametrize('text', [
    'a: &a {b: *a}',
    '\n'.join(['a0: &a0 [x, x]', *(f'a{i}: &a{i} [*a{i - 1}, *a{i - 1}]' for i in range(1, 27))]),
    '[' * 3000, '{a: ' * 100 + '1' + '}' * 100, 'actuator.density: ' + '1' * 5000,
    'a: 2001-99-99', 'actuator.density: [1]', 'actuator.density: ' + '1' * 400,
    'actuator.density: .nan'], ids=[
        'loop', 'bomb', 'deep list', 'deep map', 'endless number', 'bad date', 'list',
        'large number', 'NaN'])
def test_parameter_files_that_are_none_are_refused_in_a_sentence(tmp_path, text):
    file = tmp_path / 'bad.yaml'
    file.write_text(text)
    from hmsa.interfaces.parameters import ACTUATOR
    with pytest.raises(BadInputError, match='expected'):
        values_of(read_parameter_file(file), 'plant', ACTUATOR)


def test_a_parameter_file_sets_what_a_node_has_above_what_all_have(tmp_path):
    file = tmp_path / 'ours.yaml'
    file.write_text(
        'plant:\n  ros__parameters:\n    actuator.density: 2.0\n'
        '/**:\n  ros__parameters:\n    actuator: {density: 1.0, remanence: 0.2}\n')
    found = read_parameter_file(file)
    assert (found['plant.actuator.density'], found['planner.actuator.density']) == (2.0, 1.0)
    assert found['plant.actuator.remanence'] == 0.2


@pytest.mark.parametrize(('text', 'message'), [
    ('/**: {ros__parameters: {actuator.half_lenght: 0.005, actuator.remanence: 0.1}}',
     "'actuator.half_lenght' does not exist: .* such as actuator.half_length"),
    ('/**: {ros__parameters: {half_length: 0.005, actuator.remanence: 0.1}}',
     "'half_length' does not exist: .* such as actuator.half_length"),
    ('/**: {ros__parameters: {shear_modulus: 1e4, actuator.remanence: 0.1}}',
     'such as actuator.shear_modulus, mismatch.shear_modulus, thermal.shear_modulus$'),
    ('actuator: {zeta: 0.1, remanence: 0.1}', "'actuator.zeta' does not exist"),
    ('planner: {ros__parameters: {flux_max: 0.3, actuator.remanence: 0.1}}',
     "'flux_max' does not exist: .* such as flux_density_max"),
    ('/**: {ros__parameters: {joints: [left], left.flux_max: 0.3, actuator.remanence: 0.1}}',
     "'left.flux_max' does not exist"),
    ('/**: {ros__parameters: {viscoelstic.ratio: [0.1], actuator.remanence: 0.1}}',
     "'viscoelstic.ratio' does not exist: .* such as viscoelastic.ratio"),
    ('/**: {ros__parameters: {left.actuator.remanance: 0.1, actuator.remanence: 0.1}}',
     "'left.actuator.remanance' does not exist"),
    ('/**: {ros_parameters: {actuator.remanence: 0.1}}', "no ros__parameters .*'ros_parameters'"),
    ('planner: {actuator.remanence: 0.1}', "in its section 'planner'")])
def test_a_parameter_file_with_a_wrong_name_is_refused_rather_than_read_without(
        tmp_path, text, message):
    file = tmp_path / 'typo.yaml'
    file.write_text(text)
    with pytest.raises(BadInputError, match=message):
        read_parameter_file(file)


def test_names_of_joints_drivers_and_earlier_versions_are_no_wrong_ones(tmp_path):
    file = tmp_path / 'it.yaml'
    file.write_text(
        '/**: {ros__parameters: {joints: [actuator], actuator.actuator.remanence: 0.1, law: gent, '
        'actuator.slew_limit: 1.0, hardware.thermal.probe: 1, identification.noise_std: 0.1, '
        'third.lead_time: 0.1, use_sim_time: true, start_type_description_service: false, '
        'qos_overrides./parameter_events.publisher.depth: 100, play.rate: 2.0}}')
    assert read_parameter_file(file)['plant.actuator.actuator.remanence'] == 0.1


@pytest.mark.parametrize('text', ['9' * 400, '9' * 5000, '[' * 200_000, 'NaN', '"x"'])
def test_recorded_parameters_that_are_no_numbers_are_no_numbers(text):
    found = recorded({'/plant.use_sim_time': 'false', '/plant.slew_limit': text}, '/')
    assert number_of(found['plant.slew_limit']) is None


def test_a_file_that_fails_half_way_leaves_the_old_one(tmp_path):
    path = tmp_path / 'x.txt'
    write_text(path, 'old')

    def fail():
        with replacing(path) as beside:
            beside.write_text('half')
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == 'old'
    assert list(tmp_path.iterdir()) == [path]
    link = tmp_path / 'link'
    link.symlink_to(tmp_path / 'nowhere')
    with pytest.raises(BadInputError, match='a link to nothing'):
        write_text(link, 'x')
    assert not (tmp_path / 'nowhere').exists()


def test_plan_in_seconds_and_tesla_is_the_nondimensional_plan(tmp_path, capsys):
    block = paper_actuator()
    file = tmp_path / 'a.yaml'
    file.write_text(
        f'/**:\n  ros__parameters:\n    actuator.shear_modulus: {block.shear_modulus}\n')
    assert main(['plan', f'1.1:{10 * block.time_unit}', '--params-file', str(file), '--json']) == 0
    found, = json.loads(capsys.readouterr().out)['segments']
    assert main(['plan', '1.1:10', '--json']) == 0
    plain, = json.loads(capsys.readouterr().out)['segments']
    assert found['time_p'] == pytest.approx(plain['tau_p'] * block.time_unit, rel=1e-6)
    assert found['flux_density_1'] == pytest.approx(
        plain['beta_1'] * block.flux_density_unit, rel=1e-9)
    assert found['levels'][1] == [found['time_p'], found['flux_density_1']]


def test_an_unknown_option_points_to_the_help_of_its_command(capsys):
    with pytest.raises(SystemExit):
        main(['report', '--nonsense', 'x'])
    assert capsys.readouterr().err.endswith('see hmsa report --help\n')


def test_json_has_null_for_what_is_no_number():
    document = {'a': math.nan, 'b': [1.5, -math.inf], 'c': ({'d': True},)}
    assert json.loads(json_text(document)) == {'a': None, 'b': [1.5, None], 'c': [{'d': True}]}


@pytest.mark.parametrize('fault', ['chunk', 'nobody', 'nan'])
def test_what_is_not_verified_whole_is_no_success(tmp_path, monkeypatch, capsys, fault):
    run = moved(applied=fault != 'nobody')
    problems = ('run_0.mcap: a chunk is damaged and passed over',) if fault == 'chunk' else ()
    run = replace(run, summary=BagSummary(
        'run', (), None, None, (), {}, {}, 0, True, not problems, problems))
    if fault == 'nan':
        stretch = run.stretch.copy()
        stretch[50] = math.nan
        run = replace(run, stretch=stretch)
    monkeypatch.setattr(bags, 'read_runs', lambda *_, **__: [run])
    assert main(['bag', 'verify', 'run', '--json']) == 1
    found = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert not found['passed']
    actuator, = found['actuators']
    assert found['problems'] == [*problems]
    assert (actuator['unapplied_count'], actuator['largest_difference'] is None) == (
        int(fault == 'nobody'), fault == 'nan')
