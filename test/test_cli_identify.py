"""``hmsa identify``: files in, numbers, files and exit codes out."""

import json
import math
import re

from identification_oracle import BLOCK, simulate, steps
import numpy as np
import pytest
import yaml

from benchmarks.defects import measured, motion, plants, Sensor, sequence
from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.identification.files import read_belief
from hmsa.identification.measurement import read_csv
from hmsa.model.simulation import ActuatorSimulation

TIMES = np.arange(500) * 1e-3
LEVELS = steps((1.1, 1.4, 1.0), 0.0444, 3)
STRETCH = simulate(TIMES, *LEVELS) + 1e-3 * np.random.default_rng(0).standard_normal(500)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with a recording, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    write('camera.csv', 'time,stretch', zip(TIMES, STRETCH, strict=True))
    write('levels.csv', 'time,flux_density', zip(*LEVELS, strict=True))
    return tmp_path


def write(name, header, rows, separator=','):
    """Write a CSV file."""
    lines = [separator.join(f'{x:.12g}' for x in row) for row in rows]
    with open(name, 'w', encoding='utf-8') as file:
        file.write('\n'.join([header, *lines]) + '\n')


def identify(capsys, *arguments):
    """Run the command; return status, standard output and standard error."""
    status = main(['identify', *arguments])
    return (status, *capsys.readouterr())


def test_json_has_what_the_interface_promises(folder, capsys):
    status, out, err = identify(capsys, 'camera.csv', '--commands', 'levels.csv', '--json')
    assert (status, err) == (0, '')
    found = json.loads(out)
    assert {'verdict', 'reason', 'parameters', 'names', 'covariance', 'noise_std', 'samples',
            'residual_rms'} <= set(found)
    assert found['verdict'] == 'identified'
    assert found['samples'] == 500
    matrix = np.array(found['covariance'])
    assert matrix.shape == (len(found['names']),) * 2
    for name, variance in zip(found['names'], np.diag(matrix), strict=True):
        x = found['parameters'][name]
        assert set(x) == {'value', 'std', 'low', 'high', 'unit', 'free'}
        assert x['low'] < x['value'] < x['high']
        assert x['std'] ** 2 == pytest.approx(variance, rel=1e-9)
    assert found['parameters']['shear_modulus']['unit'] == 'Pa'
    assert not found['parameters']['density']['free']


def test_file_written_is_that_of_the_nodes_and_keeps_the_covariance(folder, capsys):
    with open('known.yaml', 'w', encoding='utf-8') as file:
        file.write('/**:\n  ros__parameters:\n    actuator.density: 1900.0\n'
                   '    flux_density_max: 0.2\n    joint: tip\n')
    status, _, _ = identify(
        capsys, 'camera.csv', '--commands', 'levels.csv', '--params-file', 'known.yaml',
        '--out', 'found.yaml', '--report', 'page.html')
    assert status == 0
    text = (folder / 'found.yaml').read_text(encoding='utf-8')
    assert 'standard deviation' in text
    assert 'Verdict: identified' in text
    settings = yaml.safe_load(text)['/**']['ros__parameters']
    assert settings['flux_density_max'] == 0.2
    assert settings['joint'] == 'tip'
    assert settings['actuator.shear_modulus'] == pytest.approx(BLOCK.shear_modulus, rel=2e-3)
    known = read_belief(folder / 'found.yaml').known
    assert known.names[0] == 'shear_modulus'
    assert known.value('shear_modulus') == settings['actuator.shear_modulus']
    assert np.all(np.linalg.eigvalsh(known.covariance / np.sqrt(np.outer(
        np.diag(known.covariance), np.diag(known.covariance)))) > 0.0)
    page = (folder / 'page.html').read_text(encoding='utf-8')
    for words in ('identified', 'shear_modulus', 'Autocorrelation', 'confounded'):
        assert words in page
    assert 'src="http' not in page


@pytest.mark.parametrize('slew', [20.0, 8.0])
def test_a_measured_field_that_ramps_is_not_limited_again(folder, capsys, slew):
    plant = ActuatorSimulation(BLOCK, slew_limit=slew)
    for time, level in zip(*LEVELS, strict=True):
        plant.command(round(1e9 * time), level)
    rows = []
    for time in TIMES:
        plant.advance(round(1e9 * time))
        rows.append((time, plant.stretch, plant.flux_density))
    noise = 1e-3 * np.random.default_rng(1).standard_normal(len(rows))
    write('ramps.csv', 'time,stretch,flux_density', np.array(rows) + np.outer(noise, (0, 1, 0)))
    write('steps.csv', 'time,stretch,flux_density', [
        (x, y + z, LEVELS[1][np.searchsorted(LEVELS[0], x + 1e-9) - 1])
        for (x, y, _), z in zip(rows, noise, strict=True)])
    with open('slew.yaml', 'w', encoding='utf-8') as file:
        file.write(
            f'/**:\n  ros__parameters:\n    actuator.density: 1900.0\n    slew_limit: {slew}\n')
    for name, count in (('ramps.csv', 1), ('steps.csv', 0)):
        status, out, err = identify(capsys, name, '--params-file', 'slew.yaml', '--json')
        assert status == 0, err
        found = json.loads(out)
        modulus = found['parameters']['shear_modulus']
        assert modulus['low'] < BLOCK.shear_modulus < modulus['high']
        assert found['noise_std'] < 1.2e-3
        assert sum('already ramps' in x for x in found['warnings']) == count


def test_what_is_not_identified_is_not_written_and_ends_with_1(folder, capsys):
    status, out, err = identify(
        capsys, 'camera.csv', '--commands', 'levels.csv', '--out', 'found.yaml', '--json',
        '--free', 'shear_modulus,density,damping_coefficient,chain_limit,remanence')
    assert status == 1
    assert json.loads(out)['parameters']['density']['value'] is None
    assert err.startswith('hmsa: not_identifiable: ')
    assert 'found.yaml was not written' in err
    assert not (folder / 'found.yaml').exists()


def lagging(name, hysteresis):
    """Write a recording with hysteresis and a late camera; return arguments and delay."""
    given = plants(1, 3, hysteresis=(hysteresis, 1.0001 * hysteresis), latency=(0.045, 0.0450001))
    switches, levels, end = sequence(given)
    seen = motion(given, switches, levels, end)
    found = measured(0, given, seen, switches, levels, end, Sensor(25.0, 5e-4), 1)
    write(f'{name}.csv', 'time,stretch', zip(found.time, found.stretch, strict=True))
    write(f'{name}_levels.csv', 'time,flux_density', zip(
        found.level_times, found.levels, strict=True))
    return (f'{name}.csv', '--commands', f'{name}_levels.csv'), (
        0.045 * given.block(0).time_unit)


def test_a_small_defect_that_nothing_is_free_for_is_accepted_on_request(folder, capsys):
    run, late = lagging('core', 0.004)
    known = '--known', f'sensor_latency={late:.9g}'
    status, out, err = identify(capsys, *run, *known, '--out', 'found.yaml')
    assert status == 1
    assert 'hysteresis' in err
    assert re.search(r'--accept writes it: what the model lacks costs [\d.]+ % of a step', err)
    assert not (folder / 'found.yaml').exists()
    status, out, err = identify(capsys, *run, *known, '--out', 'found.yaml', '--accept')
    assert status == 3
    assert 'found.yaml written' in out
    assert 'accepted: what the model lacks costs' in err
    assert read_belief(folder / 'found.yaml').others['sensor_latency'] == pytest.approx(late)


def test_what_is_free_can_be_added_and_what_is_known_is_kept(folder, capsys):
    run, late = lagging('late', 1e-6)
    status, _, err = identify(capsys, *run)
    assert status == 1
    assert '--free +sensor_latency' in err
    status, out, _ = identify(capsys, *run, '--free', '+sensor_latency', '--json')
    assert status == 0
    found = json.loads(out)
    assert found['names'][-1] == 'sensor_latency'
    assert found['parameters']['sensor_latency']['value'] == pytest.approx(late, rel=0.05)
    for known, sentence in (
            ('sensor_latency', 'expected NAME=VALUE'), ('weight=2', "'weight=2'"),
            ('sensor_latency=fast', 'expected a number')):
        status, _, err = identify(capsys, *run, '--known', known)
        assert status == 2
        assert sentence in err
    status, _, err = identify(
        capsys, *run, '--known', 'remanence=0.1', '--free', '+remanence')
    assert status == 2
    assert 'remanence is free and known' in err


def test_levels_sampled_beside_the_stretch_serve_with_semicolons_and_units(folder, capsys):
    place = np.searchsorted(LEVELS[0], TIMES, side='right') - 1
    rows = zip(1e3 * TIMES, STRETCH, 1e3 * LEVELS[1][place], strict=True)
    write('all.csv', 'time [ms];stretch;flux_density [mT]', rows, ';')
    text = (folder / 'all.csv').read_text(encoding='utf-8')
    (folder / 'all.csv').write_text(text.replace('.', ','), encoding='utf-8')
    status, out, _ = identify(capsys, 'all.csv', '--json')
    assert status == 0
    found = json.loads(out)
    x = found['parameters']['shear_modulus']
    assert abs(x['value'] - BLOCK.shear_modulus) < 4.0 * x['std']
    for word in ("column 'time [ms]' was", "column 'flux_density [mT]' was", 'is estimated too'):
        assert any(word in note for note in found['warnings'])


@pytest.mark.parametrize(('text', 'message'), [
    ('', 'camera.csv is empty: expected a header'), ('time,stretch\n', 'has a header and no row'),
    ('0.0,1.0\n0.1,1.1\n', 'begins with numbers .*expected a header'),
    ('time,length\n0,1\n', 'has no column stretch'),
    ('time,time,stretch\n0,0,1\n', "has two columns 'time': expected one"),
    ('t\0i\0m\0e\0,\0', 'zero bytes in its header: .*UTF-8'),
    ('time,strain\n0,0\n', 'has no column stretch: .*stretch is strain plus 1'),
    ('time,stretch [%]\n0,100\n', 'gives stretch in %: .*percent by 100'),
    ('time,stretch\n0,1\n0,1,1,02\n', 'line 3 has 4 cells in 2 columns .*need semicolons'),
    ('time,stretch\n"0,1","1,02"\n', "line 2 has '0,1' in column time: .*need semicolons"),
    ('time,stretch [mm]\n0,1\n', 'gives stretch in mm: expected no unit: divide'),
    ('time,stretch\n0,1\n0.1,abc\n', "line 3 has 'abc' in column stretch"),
    ('time,stretch\n' + 2 * ''.join(f'{x / 10},1\n' for x in range(12)),
     'line 14 jumps back in time from 1.1 to 0 s.*clock was set.*sort'),
    ('time,stretch\n0,1\n0,1\n0,1\n0.1,1\n', '2 of 4 rows .* different timestamp'),
    ('time,stretch\n0,1\n0.1,\n0.2,\n0.3,1\n', r'2 of 4 rows .*\(2 without a number, 0 with'),
    ('time,stretch\n0,1\n1e-3,1.001\n2e-3,0.999\n', 'has 3 samples: expected 12 or more')])
def test_bad_samples_end_with_2_and_a_sentence(folder, capsys, text, message):
    (folder / 'camera.csv').write_text(text, encoding='utf-8')
    status, out, err = identify(capsys, 'camera.csv', '--commands', 'levels.csv')
    assert (status, out, err.count('\n')) == (2, '', 1)
    assert re.search(message, err)


@pytest.mark.parametrize(('factor', 'offset', 'first', 'message'), [
    (100.0, 0.0, 0.0, '99.99 without field: .* if it is percent, divide it by 100'),
    (1.0, -1.0, 0.0, 'if it is strain, add 1'),
    (100.0, -100.0, 0.0, 'if it is strain in percent, divide it by 100 and add 1'),
    (10.0, 0.0, 0.0, 'if it is ten times the stretch, divide it by 10'),
    (10.0, 0.0, 0.05, 'if it is ten times the stretch, divide it by 10'),
    (3.0, 0.0, 0.0, 'if it is a length, in mm or m perhaps, divide it by the length at rest'),
    (0.02, 0.0, 0.0, 'if it is a length, in mm or m perhaps, divide it by the length at rest')])
def test_what_is_no_stretch_is_refused_with_what_it_looks_like(
        folder, capsys, factor, offset, first, message):
    rows = [(t, factor * y + offset) for t, y in zip(TIMES, STRETCH, strict=True) if t >= first]
    write('camera.csv', 'time,stretch', rows)
    status, out, err = identify(capsys, 'camera.csv', '--commands', 'levels.csv')
    assert (status, out, err.count('\n')) == (2, '', 1)
    assert re.search(message, err)


def test_samples_of_a_sensor_that_lost_the_actuator_are_refused_until_they_are_missing(
        folder, capsys):
    rows = [(t, 0.0 if 0.1 < t < 0.14 else y) for t, y in zip(TIMES, STRETCH, strict=True)]
    write('camera.csv', 'time,stretch', rows)
    status, _, err = identify(capsys, 'camera.csv', '--commands', 'levels.csv')
    assert status == 2
    assert re.search(r' samples that are no stretch, such as 0 at 0\.1.*: expected 0\.', err)
    assert 'leave their cells empty' in err
    write('camera.csv', 'time,stretch', ((t, y or math.nan) for t, y in rows))
    assert identify(capsys, 'camera.csv', '--commands', 'levels.csv')[0] == 0


def test_a_sensor_that_counts_the_other_way_is_named_as_the_reason(folder, capsys):
    write('camera.csv', 'time,stretch', zip(TIMES, 2.0 - STRETCH, strict=True))
    status, _, err = identify(capsys, 'camera.csv', '--commands', 'levels.csv')
    assert status == 1
    assert 'the stretch falls where the flux density rises: change the sign of the levels' in err


def test_a_length_at_rest_in_another_unit_is_refused_with_what_was_taken(folder, capsys):
    write('camera.csv', 'time,length [mm]', zip(TIMES, 20.0 * STRETCH, strict=True))
    status, _, err = identify(
        capsys, 'camera.csv', '--commands', 'levels.csv', '--rest-length', '20')
    assert status == 2
    assert "'length [mm]' was divided by the length at rest, 20 m: check their units" in err
    assert 'if it is' not in err


def test_levels_in_mt_without_a_unit_are_refused_with_the_name_of_their_file(folder, capsys):
    write('levels.csv', 'time,flux_density', zip(LEVELS[0], 1e3 * LEVELS[1], strict=True))
    status, _, err = identify(capsys, 'camera.csv', '--commands', 'levels.csv')
    assert status == 2
    assert 'levels.csv has flux densities up to' in err
    assert 'write "flux_density [mT]" in the header' in err


@pytest.mark.parametrize(('samples', 'levels', 'wrong'), [
    (1e3, 1.0, 'camera.csv were in ms'), (1.0, 1e3, 'levels.csv were in ms'),
    (1e6, 1.0, 'camera.csv were in us')])
def test_times_in_two_units_are_refused_with_which_is_which(
        folder, capsys, samples, levels, wrong):
    write('camera.csv', 'time,stretch', zip(samples * TIMES, STRETCH, strict=True))
    write('levels.csv', 'time,flux_density', zip(levels * LEVELS[0], LEVELS[1], strict=True))
    status, out, err = identify(capsys, 'camera.csv', '--commands', 'levels.csv')
    assert (status, out, err.count('\n')) == (2, '', 1)
    assert wrong in err


def test_points_in_any_order_are_sorted_and_that_is_said(folder, capsys):
    order = np.random.default_rng(1).permutation(500)
    write('camera.csv', 'time,stretch', zip(TIMES[order], STRETCH[order], strict=True))
    status, out, _ = identify(capsys, 'camera.csv', '--commands', 'levels.csv', '--json')
    found = json.loads(out)
    assert status == 0
    assert abs(found['parameters']['shear_modulus']['value'] / BLOCK.shear_modulus - 1.0) < 2e-3
    assert any('not in the order of time' in x for x in found['warnings'])


@pytest.mark.parametrize(('encoding', 'micro'), [
    ('utf-16', 'µ'), ('utf-8-sig', '\N{GREEK SMALL LETTER MU}'), ('cp1252', 'µ')])
def test_files_of_spreadsheets_are_read(folder, capsys, encoding, micro):
    rows = (f'{1e6 * t:.9g},{y:.12g}' for t, y in zip(TIMES, STRETCH, strict=True))
    text = '\n'.join([f'time [{micro}s],stretch', *rows])
    (folder / 'camera.csv').write_text(text, encoding=encoding)
    status, out, _ = identify(capsys, 'camera.csv', '--commands', 'levels.csv', '--json')
    assert status == 0
    assert f"column 'time [{micro}s]' was converted" in json.loads(out)['warnings'][0]


def test_lengths_are_divided_by_the_length_at_rest(folder, capsys):
    rows = zip(TIMES, 20.0 * STRETCH, strict=True)
    write('lengths.csv', 'time,length [mm]', rows)
    own = identify(capsys, 'camera.csv', '--commands', 'levels.csv', '--json')
    status, out, err = identify(
        capsys, 'lengths.csv', '--commands', 'levels.csv', '--rest-length', '20mm', '--json')
    assert (status, err) == (0, '')
    found = json.loads(out)
    assert found['parameters']['shear_modulus']['value'] == pytest.approx(
        json.loads(own[1])['parameters']['shear_modulus']['value'], rel=1e-6)
    assert "'length [mm]' was divided by the length at rest, 0.02 m" in found['warnings'][0]


@pytest.mark.parametrize(('file', 'message'), [
    ('camera.csv', "column 'stretch': expected a unit of length in its header"),
    ('.', 'a bag contains stretches')])
def test_a_length_at_rest_needs_lengths(folder, capsys, file, message):
    status, _, err = identify(
        capsys, file, *['--commands', 'levels.csv'] * (file != '.'), '--rest-length', '0.02')
    assert status == 2
    assert message in err


def test_a_few_samples_of_nothing_are_no_other_unit(folder, capsys):
    stretch = np.where(np.arange(500) % 100 == 7, 0.0, STRETCH)
    write('camera.csv', 'time,stretch', zip(TIMES, stretch, strict=True))
    status, out, _ = identify(capsys, 'camera.csv', '--commands', 'levels.csv', '--json')
    x = json.loads(out)['parameters']['shear_modulus']
    assert status == 0
    assert abs(x['value'] - BLOCK.shear_modulus) < 4.0 * x['std']


@pytest.mark.parametrize(('arguments', 'message'), [
    ('nowhere.csv', 'nowhere.csv cannot be read'), ('camera.csv', 'no column flux_density'),
    ('camera.csv --commands levels.csv --free mass', "free parameter 'mass'"),
    ('camera.csv --commands levels.csv --free=-density', 'removes a parameter'),
    ('camera.csv --commands levels.csv --known half_length=5mm+-',
     "half_length is '': expected a number"),
    ('camera.csv --commands levels.csv --known half_length=-1mm',
     'half_length is -0.001: expected a finite number greater than 0'),
    ('camera.csv --commands levels.csv --out camera.csv', 'cannot write'),
    ('camera.csv --commands levels.csv --params-file camera.csv', 'has no ros__parameters'),
    ('camera.csv --commands camera.csv', 'no column flux_density')])
def test_bad_arguments_end_with_2_and_a_sentence(folder, refusal, arguments, message):
    assert message in refusal(f'identify {arguments}')


def test_rows_without_numbers_and_gaps_are_said(folder, capsys):
    keep = (TIMES < 0.2) | (TIMES > 0.25)
    stretch = np.where(np.arange(500) % 100 == 7, np.nan, STRETCH)
    write('camera.csv', 'time,stretch', zip(TIMES[keep], stretch[keep], strict=True))
    status, out, _ = identify(capsys, 'camera.csv', '--commands', 'levels.csv', '--json')
    assert status == 0
    notes = json.loads(out)['warnings']
    assert any('4 rows without a number' in x for x in notes)
    assert any('gap of 0.052 s' in x for x in notes)


def test_seconds_of_an_epoch_are_as_good_as_those_of_the_run(folder, capsys):
    epoch = 1.7e9
    for name, head, rows in (('camera.csv', 'time,stretch', zip(TIMES, STRETCH, strict=True)),
                             ('levels.csv', 'time,flux_density', zip(*LEVELS, strict=True))):
        with open(name, 'w', encoding='utf-8') as file:
            file.write('\n'.join([head, *(f'{epoch + t:.6f},{y:.9f}' for t, y in rows)]) + '\n')
    status, out, err = identify(capsys, 'camera.csv', '--commands', 'levels.csv')
    assert (status, err) == (0, '')
    assert 'identified' in out


@pytest.mark.parametrize(('time', 'field', 'message'), [
    (1e3, 1.0, 'a shear_modulus of 0.01 Pa, with samples 1 s apart: .*"time [ms]"'),
    (1e6, 1.0, 'shear_modulus of 1.*e-08 Pa, with samples 1e.03 s apart: .*"time [us]"'),
    (1.0, 1e-3, 'a remanence of 100 T, .*flux densities in T')])
def test_numbers_of_no_elastomer_are_refused_with_the_unit_that_would_explain_them(
        folder, capsys, time, field, message):
    # Both files alike, and nothing says so.
    write('camera.csv', 'time,stretch', zip(time * TIMES, STRETCH, strict=True))
    write('levels.csv', 'time,flux_density', zip(
        time * LEVELS[0], field * LEVELS[1], strict=True))
    status, out, err = identify(
        capsys, 'camera.csv', '--commands', 'levels.csv', '--report', 'page.html')
    assert (status, out, err.count('\n')) == (2, '', 1)
    assert re.search(message.replace('[', r'\['), err)
    assert not (folder / 'page.html').exists()


def test_times_of_the_day_beside_levels_that_begin_at_zero_are_named_as_clocks(tmp_path):
    samples, levels = tmp_path / 'camera.csv', tmp_path / 'levels.csv'
    samples.write_text('time,stretch\n' + ''.join(
        f'{1.7e9 + 0.001 * k:.3f},{1.0 + 0.01 * (k % 7)}\n' for k in range(2000)))
    levels.write_text('time,flux_density\n0.0,0.0\n0.5,0.05\n1.0,0.02\n')
    with pytest.raises(BadInputError, match='expected times of one clock, not seconds since'):
        read_csv(samples, levels)


def test_of_more_switches_than_can_be_estimated_the_first_are_used_and_a_measured_field_is_kept(
        folder):
    time = np.arange(40_000) * 5e-4
    moves = 1.0 + 0.1 * (np.arange(40_000) // 100 % 2)
    seen = moves + 1e-3 * np.random.default_rng(0).standard_normal(40_000)
    write('moves.csv', 'time,stretch,flux_density', zip(time, seen, 0.3 * moves, strict=True))
    found = read_csv(folder / 'moves.csv')
    assert len(found.time) == 30_000
    assert len(found.uncertain) == 299
    note, = (x for x in found.notes if 'are used' in x)
    assert 'has 399 switches: the first 299, up to 15 s' in note
    # With the levels, all samples are used.
    write('all.csv', 'time,flux_density', ((k * 0.05, 0.3 + 0.03 * (k % 2)) for k in range(400)))
    assert len(read_csv(folder / 'moves.csv', folder / 'all.csv').time) == 40_000
    # The converter of a probe flickers.
    probe = 0.3 * moves + 1e-4 * (np.arange(40_000) // 7 % 2)
    write('probe.csv', 'time,stretch,flux_density', zip(time, seen, probe, strict=True))
    found = read_csv(folder / 'probe.csv')
    assert (len(found.time), found.earlier) == (40_000, 0.0)
    assert any('taken as measured' in x for x in found.notes)
