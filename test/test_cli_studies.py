"""``hmsa robustness`` and ``hmsa sweep``: input, output and files."""

import builtins
import csv
import errno
import io
import json
import math
import os
from pathlib import Path
import signal
import subprocess
import sys

from conftest import without_progress
from extras import needs
import pytest

from hmsa.cli import terminal
from hmsa.errors import BadInputError
from hmsa.planning.shapers import SHAPERS
from hmsa_studies import feedback, paper_data, robustness
from hmsa_studies.commanders import SCENARIOS, STRATEGIES
from hmsa_studies.feedback import trial
from hmsa_studies.schedulers import here, in_order, local

ROOT = Path(__file__).resolve().parent.parent
PNG = b'\x89PNG\r\n\x1a\n'
HEADER = 'start,target,zeta,j_lim,c1,status,beta_p,b_p,tau_p,beta_1,b_1'
# Pictures that are not looked at.
QUICKLY = '--dpi', 50, '--format', 'png'


@pytest.fixture
def run(command, tmp_path, monkeypatch):
    """Return `command` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return command


@pytest.fixture
def refused(run, refusal):
    """Return `refusal` in an empty folder."""
    return refusal


# --- robustness


@pytest.mark.slow
def test_robustness_prints_a_table_and_names_its_files(run, tmp_path):
    status, out, err = run(
        'robustness', '--move', '1.0:1.4', '1:0.9', '--shapers', 'two_step,robust,zv',
        '--order', 2, 4, '--out', 'new/folder')
    assert (status, err) == (0, '')
    for words in ('stretch 1 to 1.4', 'stretch 1 to 0.9', 'two-step', 'robust, order 2',
                  'robust, order 4', 'ZV', 'errors of up to 10 %', 'without the',
                  'ZV: linear, designed at the target'):
        assert words in out
    assert 'robust, order 3' not in out
    files = out.split()[-7:]
    assert files == ['new/folder/robustness.csv', *(
        f'new/folder/{x}.{kind}' for x in ('robustness_1_to_1.4', 'robustness_1_to_0.9', 'front')
        for kind in ('png', 'pdf'))]
    rows = list(csv.DictReader((tmp_path / files[0]).read_text().splitlines()))
    assert {x['shaper'] for x in rows} == {'two_step', 'robust', 'zv'}
    for path in files[1:]:
        assert (tmp_path / path).read_bytes().startswith(PNG if path[-3:] == 'png' else b'%PDF')


@pytest.mark.parametrize(('name', 'words'), [
    ('robustness', ('--move', '1:1.1', '--shapers', 'two_step', '--errors', 0.02, *QUICKLY)),
    ('sweep', ('--zeta', '0:1:3', '--out', 'a.csv', '--picture', 'a.png'))])
def test_a_study_that_draws_for_long_says_so(run, monkeypatch, name, words):
    monkeypatch.setattr(terminal, 'PATIENCE', 0.01)
    status, _, err = run(name, *words)
    assert (status, 'drawing ...' in err.splitlines()) == (0, True)


@pytest.mark.slow
def test_robustness_as_json_has_everything_in_full_precision(run):
    status, out, err = run(
        'robustness', '--move', '1:1.1', '--shapers', 'two_step,step', '--errors', 0.05, '--json')
    assert (status, err) == (0, '')
    made = json.loads(out)
    move = made['moves'][0]
    assert (move['start'], move['target'], move['zeta'], move['box']) == (1.0, 1.1, 0.2, 0.05)
    shaped, plain = move['shapers']
    assert shaped['levels'][0] == [0.0, pytest.approx(0.160094186, abs=1e-9)]
    assert shaped['arrival'] == pytest.approx(1.315749737, abs=1e-9)
    assert shaped['residual'] < 1e-8
    assert 100.0 * shaped['worst']['G']['residual'] == pytest.approx(5.8, abs=0.05)
    assert shaped['worst']['G']['error'] == -0.05
    curve = shaped['curves']['zeta']
    assert len(curve['errors']) == len(curve['residuals'])
    assert (curve['errors'][0], curve['errors'][-1]) == (-0.1, 0.1)
    assert (plain['arrives'], shaped['arrives']) == (False, True)
    assert plain['arrival'] == shaped['arrival']
    assert [Path(x).name for x in made['files']] == [
        'robustness.csv', 'robustness_1_to_1.1.png', 'robustness_1_to_1.1.pdf', 'front.png',
        'front.pdf']


@pytest.mark.slow
def test_robustness_in_chunks_is_the_same_whatever_computes_it(run, tmp_path):
    needs('pyarrow')
    words = ('robustness', '--move', '1:1.1', '--shapers', 'two_step,zv,step', '--errors', 0.05,
             '--zeta', 2.0, '--json')
    plain = json.loads(run(*words, '--out', 'plain')[1])
    one = json.loads(run(*words, '--resume', '--out', 'one')[1])
    assert one['moves'] == plain['moves']
    assert one['files'] == [
        'one/table.parquet', *(x.replace('plain/', 'one/') for x in plain['files'])]
    for name in ('robustness.csv', 'front.png'):
        assert (tmp_path / 'one' / name).read_bytes() == (tmp_path / 'plain' / name).read_bytes()
    # Two shards on two processes, and a chunk that got lost.
    table = (tmp_path / 'one' / 'table.parquet').read_bytes()
    for shard in ('1/2', '2/2'):
        status, out, err = run(*words, '--shard', shard, '--workers', 2, '--out', 'two')
        assert (status, out == 'two\n') == (0, shard == '1/2')
        assert ('1 of 3 are there' in err) is (shard == '1/2')
    assert (tmp_path / 'two' / 'table.parquet').read_bytes() == table
    chunks = sorted((tmp_path / 'two' / 'chunks').iterdir())
    before = [x.stat().st_mtime_ns for x in chunks]
    chunks[1].unlink()
    (tmp_path / 'two' / 'table.parquet').unlink()
    assert json.loads(run(*words, '--resume', '--out', 'two')[1])['moves'] == plain['moves']
    assert (tmp_path / 'two' / 'table.parquet').read_bytes() == table
    changed = [x.stat().st_mtime_ns != y for x, y in zip(chunks, before, strict=True)]
    assert changed == [False, True, False]
    assert 'another study' in run(*words, '--zeta', 0.3, '--resume', '--out', 'two')[2]


@pytest.mark.slow
def test_robustness_says_what_could_not_be_had(run):
    status, out, _ = run(
        'robustness', '--move', '1:1.1', '--shapers', 'two_step,zv', '--zeta', 3, *QUICKLY)
    assert status == 0
    assert 'note: two-step: zeta 3 is too damped' in out
    assert 'arrival of the two-step command (in brackets)' in out


@pytest.mark.slow
def test_robustness_of_what_creeps_compares_all_shapers(run, tmp_path):
    (tmp_path / 'creep.yaml').write_text(
        '/**:\n  ros__parameters:\n    actuator.shear_modulus: 10000.0\n'
        '    viscoelastic.ratio: 0.2\n    viscoelastic.time: 0.05\n')
    status, out, err = run(
        'robustness', '--params-file', 'creep.yaml', '--move', '1:1.2', '--order', 2, '--json')
    assert (status, err) == (0, '')
    found = {x['shaper']: x for x in json.loads(out)['moves'][0]['shapers']}
    assert set(found) == set(SHAPERS) - {'modal'}
    # Impulses of a linear model, and what is to be robust rather than exact, leave more.
    exact = set(found) - {'step', 'zv', 'zvd', 'umzv', 'ei', 'minimax'}
    assert max(found[x]['residual'] for x in exact) < 1e-4


def test_robustness_takes_the_actuator_of_a_file_with_its_law_and_its_coil(
        run, refused, tmp_path):
    file = tmp_path / 'own.yaml'
    file.write_text('/**:\n  ros__parameters:\n    law.name: yeoh\n    law.c10: 5000.0\n'
                    '    law.c20: 500.0\n    coil_time_constant: 0.0005\n')
    status, out, _ = run(
        'robustness', '--params-file', file, '--move', '1:1.3', '--shapers', 'two_step', '--json',
        *QUICKLY)
    assert status == 0
    found, = json.loads(out)['moves'][0]['shapers']
    # In seconds, too: G is 2 c10 = 10 kPa, and L sqrt(rho/G) 4.359 ms.
    assert found['arrival_seconds'] == pytest.approx(
        found['arrival'] * 0.01 * math.sqrt(1900.0 / 1e4), rel=1e-9)
    # Known, neither law nor lag leaves anything; and there is no J_lim to be in error.
    assert found['residual'] < 1e-8
    assert found['worst']['G']['residual'] > 0.05
    assert list(found['curves']) == ['G', 'zeta']
    assert 'both --params-file and --zeta' in refused(
        'robustness', '--params-file', file, '--zeta', 0.1)
    assert 'coil_time_constant 0.0005: expected 0 with --feedback' in refused(
        'robustness', '--feedback', '--params-file', file)


@pytest.mark.parametrize(('words', 'message'), [
    ('--move 1.4', "'1.4': expected START:TARGET"), ('--move a:b', "'a:b'"),
    ('--move 1:1', 'two stretches that differ'), ('--move 1:9', 'target stretch is 9'),
    ('--move 1:nan', 'target stretch is nan'),
    ('--shapers zvdd', "shaper is 'zvdd': expected one of"),
    ("--shapers ''", "shaper is '': expected one of"), ('--errors 0', 'expected numbers above 0'),
    ('--errors 1', 'to 0.9'), ('--errors nan', 'nan'), ('--order 0', 'expected 1 to 100'),
    ('--order 2.5', "'2.5'"), ('--zeta -1', 'zeta is -1'), ('--j-lim 0', 'j_lim is 0')])
def test_robustness_refuses_bad_input_in_one_line(refused, tmp_path, words, message):
    assert message in refused(f'robustness {words}')
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('module', [paper_data, robustness])
def test_a_table_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch, module):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / 'table.csv'
    path.write_text('old')
    monkeypatch.setattr(csv, 'writer', full)
    with pytest.raises(BadInputError, match=r'cannot write .*table.csv: No space left'):
        module.write_csv(path, ())
    assert path.read_text() == 'old'
    assert list(tmp_path.iterdir()) == [path]


def test_a_sweep_that_is_ended_leaves_its_chunks_and_one_into_a_full_device_says_so(tmp_path):
    needs('pyarrow')
    words = [
        sys.executable, '-m', 'hmsa_ros', 'sweep', '--zeta', '0:2:3000', '--j-lim', '1:9:3000']
    process = subprocess.Popen([*words, '--out', 'sweep.csv'], cwd=tmp_path)
    while not list(tmp_path.glob('sweep.csv.chunks/.run-*')):
        assert process.poll() is None
    process.terminate()
    assert process.wait() == 128 + signal.SIGTERM
    assert [x.name for x in tmp_path.iterdir()] == ['sweep.csv.chunks']
    assert sorted(x.name for x in (tmp_path / 'sweep.csv.chunks').iterdir()) == [
        'chunks', 'study.json']
    with Path('/dev/full').open('w') as full:
        ended = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert ended.returncode == 1
    error, = without_progress(ended.stderr).splitlines()
    assert error.startswith('hmsa: error: cannot write to standard output (No space left')


def test_robustness_needs_a_folder_it_can_write_to(refused, tmp_path):
    (tmp_path / 'file').write_text('')
    assert '--out' in refused('robustness', '--out', 'file')
    (tmp_path / 'folder' / 'robustness.csv').mkdir(parents=True)
    assert 'cannot write folder/robustness.csv' in refused(
        'robustness', '--move', '1:1.1', '--shapers', 'step', '--out', 'folder')


# --- sweep


def test_sweep_writes_csv_to_standard_output(run):
    status, out, err = run('sweep', '--zeta', '0:0.4:3', '--target', '1.1,3')
    assert status == 0
    assert out.splitlines()[0] == HEADER
    rows = list(csv.DictReader(io.StringIO(out)))
    assert [x['status'] for x in rows] == ['two_step', 'two_step', 'two_step'] + [
        'out_of_range'] * 3
    assert rows[1]['beta_p'] == repr(float(rows[1]['beta_p']))
    assert float(rows[1]['beta_p']) == pytest.approx(0.160094186, abs=1e-9)
    assert rows[4]['tau_p'] == 'nan'
    assert err == '6 plans: 3 two_step, 3 out_of_range\n'


def test_sweep_of_cases_writes_a_file_and_names_it(run, tmp_path):
    (tmp_path / 'cases.csv').write_text('target,start\n1.4,1.2\n0.9,1.0\n')
    status, out, _ = run('sweep', '--cases', 'cases.csv', '--zeta', '0.2,0.3', '--out', 'o.csv')
    assert (status, out) == (0, 'o.csv\n')
    rows = list(csv.DictReader((tmp_path / 'o.csv').read_text().splitlines()))
    assert [(x['start'], x['target'], x['zeta']) for x in rows] == [
        ('1.2', '1.4', '0.2'), ('1.2', '1.4', '0.3'), ('1.0', '0.9', '0.2'),
        ('1.0', '0.9', '0.3')]
    assert float(rows[0]['tau_p']) == pytest.approx(1.351529739, abs=1e-9)


def test_sweep_says_how_to_get_parquet_where_it_is_missing(refused, tmp_path, monkeypatch):
    real = builtins.__import__

    def without_pyarrow(name, *rest):
        if name.partition('.')[0] == 'pyarrow':
            raise ModuleNotFoundError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, '__import__', without_pyarrow)
    line = refused('sweep', '--out', 'o.parquet')
    assert 'pip install pyarrow' in line
    assert '.csv' in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(('words', 'message'), [
    ('--zeta 0:2', "zeta is '0:2'"), ('--target 0', 'greater than 0'),
    ('--cases none.csv', 'cannot read none.csv: No such file'),
    ('--cases .', 'cannot read .: Is a directory'), ('--out o.txt', '.csv or .parquet'),
    ('--out none/o.csv', 'cannot write none/o.csv: none is no folder'),
    ('--out none/o.parquet', 'none/o.parquet'), ('--rate 1', '--rate')])
def test_sweep_refuses_bad_input_in_one_line(refused, tmp_path, words, message):
    if 'none/o.parquet' in words:
        needs('pyarrow')
    assert message in refused(f'sweep {words}')
    assert list(tmp_path.iterdir()) == []


def test_sweep_refuses_a_grid_of_a_column_of_the_cases_and_a_folder_as_file(refused, tmp_path):
    (tmp_path / 'cases.csv').write_text('target\n1.1\n')
    assert 'target is a column of the cases' in refused(
        'sweep', '--cases', 'cases.csv', '--target', '1.2')
    (tmp_path / 'folder.csv').mkdir()
    assert 'is a folder' in refused('sweep', '--out', 'folder.csv')


def test_sweep_ends_quietly_when_its_reader_has_gone():
    # A real process: the pipe is closed after the first line.
    with subprocess.Popen(
            [sys.executable, '-m', 'hmsa_ros', 'sweep', '--zeta', '0:1.9:50000'], cwd=ROOT,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == HEADER + '\n'
        process.stdout.close()
        assert without_progress(process.stderr.read()) == ''
    assert process.returncode == 0


# --- feedback


def test_robustness_with_feedback_compares_open_loop_with_corrections(run, monkeypatch):
    needs('pyarrow')
    monkeypatch.setattr(feedback, 'ERRORS', ((-0.2, 0.2),))
    monkeypatch.setattr(feedback.Matrix.__init__, '__defaults__', (
        SCENARIOS[1:2], STRATEGIES[1::5]))
    status, out, err = run('robustness', '--feedback', '--seeds', 1, '--json')
    assert (status, err) == (0, '')
    rows = json.loads(out)['rows']
    assert [x['strategy'] for x in rows] == ['robust', 'adapt']
    cascaded, adapted = ([y['vibration'] + abs(y['offset']) for y in x['left']] for x in rows)
    assert min(cascaded) > 0.05
    assert max(adapted) < 0.002
    words = 'robustness', '--feedback', '--seeds', 2
    status, out, err = run(*words)
    assert (status, err) == (0, '')
    assert out.splitlines()[-1].startswith('  20 % adapt')
    # In parts, what they print together is the same.
    assert run(*words, '--shard', '2/2')[:2] == (0, 'feedback\n')
    assert run(*words, '--shard', '1/2')[:2] == (0, f'{out}feedback/table.parquet\n')


@pytest.mark.slow
def test_trials_in_two_processes_make_the_same_matrix():
    needs('dask')
    made = feedback.Matrix(2, SCENARIOS[:1], STRATEGIES[:2])
    done = []
    found = list(made.rows(in_order(local(2), trial, made.tasks, done.append)))
    assert found == list(made.rows(in_order(here, trial, made.tasks)))
    assert len(done) == len(made.tasks)


def test_robustness_with_feedback_needs_a_seed(refused):
    assert '--seeds is 0' in refused('robustness', '--feedback', '--seeds', 0)
    assert '--workers is 0' in refused('robustness', '--feedback', '--workers', 0)
