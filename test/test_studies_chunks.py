"""Studies in chunks: the same table however it is computed, without losses."""

from functools import partial
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys

from extras import needs
import pytest

from hmsa.errors import BadInputError, HmsaError
from hmsa_studies import schedulers, study_folder
from hmsa_studies.commands.chunked import parse_shard
from hmsa_studies.study_folder import LEAST_ROWS, open_writer, RowStudy, StudyFolder
from hmsa_studies.sweep import parse_grid, Sweep

needs('pyarrow')
needs('dask')

#: Three chunks, the last one not full; some rows without a plan.
AXES = {'zeta': '0:2:400', 'target': '1.1,1.2,3.0', 'j_lim': '4:9:80'}
WORDS = [f'--{name.replace("_", "-")}={text}' for name, text in AXES.items()]


@pytest.fixture(scope='module')
def sweep():
    """Return a small sweep."""
    return Sweep({name: parse_grid(text, name) for name, text in AXES.items()})


@pytest.fixture(scope='module')
def expected(sweep, tmp_path_factory):
    """Return its table as Parquet and as CSV, planned without chunks on disk."""
    folder = tmp_path_factory.mktemp('expected')
    for name in ('t.parquet', 't.csv'):
        with open_writer(folder / name, sweep.columns) as write:
            for block in sweep.blocks(LEAST_ROWS):
                write(block)
    return (folder / 't.parquet').read_bytes(), (folder / 't.csv').read_bytes()


@pytest.fixture
def run(command, tmp_path, monkeypatch):
    """Return a runner of the sweep in an empty folder: status, standard output and error."""
    monkeypatch.chdir(tmp_path)
    return lambda *words: command('sweep', *WORDS, *words)


def chunk_files(folder):
    """Return the files of the chunks, in order."""
    return sorted((folder / 'chunks').iterdir())


@pytest.mark.slow
def test_two_workers_write_the_table_of_one_to_the_byte(run, tmp_path, expected):
    assert run('--workers=1', '--out=a')[:2] == (
        0, 'a/table.parquet\na/table.png\na/table.pdf\n')
    assert (tmp_path / 'a' / 'table.parquet').read_bytes() == expected[0]
    status, out, err = run('--workers=2', '--out=b.csv')
    assert (status, out) == (0, 'b.csv\n')
    # How many are told apart near critical damping is a matter of rounding.
    assert re.match(r'96,000 plans: 78,\d{3} two_step, 17,200 out_of_range, 360 too_damped, '
                    r'\d{3} indistinguishable\n', err)
    assert (tmp_path / 'b.csv').read_bytes() == expected[1]
    assert sorted(x.name for x in tmp_path.iterdir()) == ['a', 'b.csv']
    assert sorted(x.name for x in (tmp_path / 'a').iterdir()) == [
        'chunks', 'study.json', 'table.parquet', 'table.pdf', 'table.png']


@pytest.mark.slow
def test_shards_of_two_machines_merge_into_the_same_table(run, tmp_path, expected):
    # From 1 on one of them and in two folders, brought together afterwards.
    status, out, err = run('--workers=1', '--shard=1/2', '--out=one')
    assert (status, out) == (0, 'one\n')
    assert '1 of 3 are there' in err
    assert run('--workers=1', '--shard=2/2', '--out=two')[0] == 0
    for path in chunk_files(tmp_path / 'two'):
        path.rename(tmp_path / 'one' / 'chunks' / path.name)
    before = [x.stat().st_mtime_ns for x in chunk_files(tmp_path / 'one')]
    assert run('--workers=1', '--resume', '--out=one')[0] == 0
    assert (tmp_path / 'one' / 'table.parquet').read_bytes() == expected[0]
    assert [x.stat().st_mtime_ns for x in chunk_files(tmp_path / 'one')] == before
    # In one folder, the last shard writes the table.
    assert run('--workers=1', '--shard=0/2', '--out=both.parquet')[0] == 0
    assert not (tmp_path / 'both.parquet').exists()
    assert run('--workers=1', '--shard=1/2', '--out=both.parquet')[1] == 'both.parquet\n'
    assert (tmp_path / 'both.parquet').read_bytes() == expected[0]


@pytest.mark.slow
def test_resume_computes_what_is_missing_or_damaged_and_nothing_else(run, tmp_path, expected):
    run('--workers=1', '--out=a')
    missing, damaged, kept = chunk_files(tmp_path / 'a')
    missing.unlink()
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    (tmp_path / 'a' / 'table.parquet').unlink()
    before = kept.stat().st_mtime_ns
    assert run('--workers=1', '--shard=0/3', '--out=a')[0] == 1
    assert run('--workers=1', '--resume', '--out=a')[0] == 0
    assert (tmp_path / 'a' / 'table.parquet').read_bytes() == expected[0]
    assert chunk_files(tmp_path / 'a') == [missing, damaged, kept]
    assert kept.stat().st_mtime_ns == before


class Deadly:
    """A study whose worker is killed in one chunk, the first time."""

    size = 6 * LEAST_ROWS
    digest = 'deadly'

    def __init__(self, log):
        self.log = log

    def table(self, begin, end):
        import pyarrow

        log = self.log / f'{begin:06d}-{os.getpid()}'
        first = not list(self.log.glob(f'{begin:06d}-*'))
        log.touch()
        if begin == 2 * LEAST_ROWS and first:
            os.kill(os.getpid(), signal.SIGKILL)
        return pyarrow.table({'row': list(range(begin, end))})


@pytest.mark.slow
@pytest.mark.parametrize('workers', [1, 2])
def test_a_killed_worker_costs_its_chunk_and_nothing_that_was_done(tmp_path, workers):
    said, rows = [], []
    (tmp_path / 'log').mkdir()
    folder = StudyFolder(Deadly(tmp_path / 'log'), tmp_path / 'study')
    assert folder.compute(
        partial(schedulers.local_processes, workers), say=said.append,
        advance=rows.append) == (0, folder.count) == (0, 6)
    assert len(said) == 1
    assert 'a worker died' in said[0]
    assert sum(rows) == Deadly.size
    assert [x for table in folder.tables() for x in table['row'].to_pylist()] == list(
        range(Deadly.size))
    # Only what was in the workers' hands was begun twice.
    assert 1 <= len(list((tmp_path / 'log').iterdir())) - 6 <= workers
    assert sorted(x.name for x in (tmp_path / 'study').iterdir()) == ['chunks', 'study.json']


@pytest.mark.slow
def test_interrupt_leaves_whole_chunks_and_nothing_else(tmp_path):
    # A session of its own, so that the signal goes to all workers too, as on a terminal.
    process = subprocess.Popen(
        ['env', '--default-signal=INT', sys.executable, '-m', 'hmsa_ros', 'sweep',
         '--zeta=0:2:1000', '--j-lim=1:9:2000', '--workers=2', '--out=a'], cwd=tmp_path,
        stderr=subprocess.PIPE, text=True, start_new_session=True)
    while not list(tmp_path.glob('a/chunks/*.parquet')):
        assert process.poll() is None
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate()
    assert process.returncode == 128 + signal.SIGINT
    said, ended = err.splitlines()
    assert said.startswith('2,000,000 plans in 50 chunks of 40,000: about 0.1 GB')
    assert ended.endswith('of 50 chunks are in a: go on with --resume')
    assert sorted(x.name for x in (tmp_path / 'a').iterdir()) == ['chunks', 'study.json']
    sweep = Sweep({'zeta': parse_grid('0:2:1000', 'zeta'), 'j_lim': parse_grid('1:9:2000', 'j')})
    folder = StudyFolder(sweep, tmp_path / 'a')
    found = folder.found()
    assert len(found) == len(chunk_files(tmp_path / 'a'))
    assert folder.compute(partial(schedulers.local_processes, 2), resume=True) == (
        len(found), 50 - len(found))


@pytest.mark.slow
def test_a_dask_cluster_writes_the_same_table(run, tmp_path, expected):
    needs('distributed')
    assert run('--dask=local', '--workers=1', '--out=a.parquet')[:2] == (0, 'a.parquet\n')
    assert (tmp_path / 'a.parquet').read_bytes() == expected[0]


@pytest.mark.slow
def test_a_local_dask_cluster_leaves_the_cores_to_the_kernels():
    needs('distributed')
    dask = needs('dask')
    get = dask.config.get
    before, keys = get('distributed.worker.profile.enabled'), []
    with schedulers.cluster('local', 1) as compute:
        profile, threshold, handler = compute([
            dask.delayed(get)('distributed.worker.profile.enabled'),
            dask.delayed(os.getenv)('MALLOC_TRIM_THRESHOLD_'),
            dask.delayed(signal.getsignal)(signal.SIGINT)], keys.append)
    assert profile is False
    assert int(threshold) > 1e9
    # Ctrl-C is for the parent, which ends its workers.
    assert handler == signal.SIG_IGN
    assert len(keys) == 3
    assert get('distributed.worker.profile.enabled') is before


@pytest.mark.parametrize(('text', 'part'), [
    ('0/4', (0, 4)), ('3/4', (3, 4)), ('4/4', (0, 4)), ('1/1', (0, 1))])
def test_shards_are_numbered_from_0_or_from_1(text, part):
    assert parse_shard(text) == part


@pytest.mark.parametrize('text', ['5/4', '-1/4', '1/0', '0/0', '2', '1/', 'a/b', '1/2/3', '1.0/2'])
def test_shards_that_do_not_exist_are_refused(text):
    with pytest.raises(BadInputError, match='expected I/N'):
        parse_shard(text)


@pytest.mark.parametrize(('words', 'message'), [
    (['--workers=0', '--out=a'], '--workers is 0'), (['--workers=2'], '--workers without --out'),
    (['--shard=0/2'], '--shard without --out'), (['--shard=7/2', '--out=a'], "'7/2'"),
    (['--dask=tcp://x:1', '--workers=2', '--out=a'], 'one of them'),
    (['--workers=1', '--out=a.txt'], '.csv or .parquet'),
    (['--workers=1', '--out=none/a.csv'], 'cannot write none/a.csv')])
def test_options_that_do_not_fit_are_refused_in_one_line(refusal, run, tmp_path, words, message):
    assert message in refusal('sweep', *WORDS, *words)
    assert list(tmp_path.iterdir()) == []


def test_an_address_without_a_scheduler_is_refused(run, tmp_path, monkeypatch):
    needs('distributed')
    monkeypatch.setattr(schedulers, 'PATIENCE', 0.5)
    for address in ('tcp://127.0.0.1:9', 'none.json'):
        status, out, err = run(f'--dask={address}', '--out=a')
        assert (status, out, err.count('\n')) == (2, '', 1)
        assert f'no Dask scheduler answers at {address!r}' in err
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(('package', 'words'), [
    ('distributed', ['--dask=local', '--out=a']), ('dask', ['--workers=2', '--out=a.csv'])])
def test_a_missing_dask_is_said_with_how_to_get_it(run, tmp_path, monkeypatch, package, words):
    monkeypatch.setitem(sys.modules, package, None)
    status, _, err = run(*words)
    assert (status, err.count('\n')) == (2, 1)
    assert f'pip install {package}' in err
    assert list(tmp_path.iterdir()) == []


def test_chunks_of_other_code_have_other_names(sweep, tmp_path, monkeypatch):
    for name in ('hmsa', 'hmsa_lab', 'hmsa_ros', 'hmsa_studies'):
        shutil.copytree(
            Path(study_folder.__file__).parent.parent / name, tmp_path / name,
            ignore=shutil.ignore_patterns('__pycache__'))
    monkeypatch.setattr(study_folder, '__file__', str(tmp_path / 'hmsa_studies' / 'copy.py'))
    digests = [StudyFolder(sweep, tmp_path).path(0).name]
    for changed in (None, 'hmsa/motion/hmsa/law.hpp', 'hmsa_lab/adapt/motion.py'):
        if changed:
            with (tmp_path / changed).open('a') as source:
                source.write('\n')
        study_folder.code.cache_clear()
        digests.append(StudyFolder(sweep, tmp_path).path(0).name)
    study_folder.code.cache_clear()
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


def test_the_folder_of_another_study_is_refused_and_kept(run, tmp_path):
    assert run('--workers=1', '--shard=0/3', '--out=a')[0] == 0
    before = chunk_files(tmp_path / 'a')
    status, _, err = run('--c1=3', '--workers=1', '--resume', '--out=a')
    assert (status, err.count('\n')) == (2, 1)
    assert 'a contains another study' in err
    assert chunk_files(tmp_path / 'a') == before
    (tmp_path / 'a' / 'study.json').unlink()
    assert 'no study.json' in run('--workers=1', '--out=a')[2]


def reciprocal(name, value):
    """Return a row that cannot be computed for 0."""
    return {'name': name, 'value': 1.0 / value}


@pytest.mark.parametrize('workers', [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_chunk_that_fails_is_named_with_its_parameters(tmp_path, workers):
    study = RowStudy(
        reciprocal, [('a', 2.0), ('b', 4.0), ('c', 0.0), ('d', 1.0)],
        {'name': 'string', 'value': 'double'}, (2, 2))
    folder = StudyFolder(study, tmp_path / 'study')
    with pytest.raises(HmsaError) as failed:
        folder.compute(schedulers.local(workers))
    assert str(failed.value) == (
        'chunk 1 (c, 0.0; d, 1.0) failed (ZeroDivisionError: float division by zero): expected '
        'workers that can compute it; correct it, then continue with --resume')
    assert folder.found() in ([], [0])
    assert not list((tmp_path / 'study').glob('.run-*'))


def test_a_chunk_of_a_sweep_is_named_by_the_ranges_of_its_columns(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise MemoryError

    sweep = Sweep({'zeta': [0.1, 0.3, 0.2]}, shapers=['two_step', 'zv'])
    monkeypatch.setattr(Sweep, 'rows', fail)
    with pytest.raises(HmsaError, match=re.escape(
            'chunk 0 (start 1, target 1.1, zeta 0.1 to 0.3, j_lim 5, c1 2, shaper two_step or '
            'zv) failed (MemoryError)')):
        StudyFolder(sweep, tmp_path).compute()
