"""Compiled kernels start from any cache: none, a broken one, one of other sources."""

import os
from pathlib import Path
import subprocess
import sys

import pytest

# A kernel of its own, with the cache anywhere but in the package.
PROGRAM = """
from pathlib import Path
import sys
from hmsa_ros.core import compiling
compiling._HERE = Path(sys.argv[2])
compiling.stamp = lambda: sys.argv[1]

@compiling.compiled()
def double(x):
    return 2.0 * x

with compiling.announced(lambda text: print(text, file=sys.stderr)):
    double(1.0)
print(double(2.1), sum(double.stats.cache_hits.values()))
"""


def run(
        cache: Path | None, stamp: str = 'a', package: str | Path = '/proc/nowhere',
) -> 'tuple[float, int, str]':
    """Return the result, how often the cache gave it, and what was said."""
    environment = {**os.environ, 'HOME': '/proc/nowhere', 'XDG_CACHE_HOME': '/proc/nowhere'}
    environment.pop('NUMBA_CACHE_DIR', None)
    if cache is not None:
        environment['NUMBA_CACHE_DIR'] = str(cache)
    done = subprocess.run(
        [sys.executable, '-W', 'error', '-c', PROGRAM, stamp, package], capture_output=True,
        text=True, env=environment, check=True)
    result, hits = done.stdout.split()
    return float(result), int(hits), done.stderr


def test_where_no_folder_can_be_written_kernels_compile_and_it_is_said_once():
    result, hits, said = run(None)
    assert (result, hits) == (4.2, 0)
    assert said.count('cannot write to') == 1


@pytest.mark.slow
@pytest.mark.parametrize('damage', [
    lambda data: b'', lambda data: data[:len(data) // 2],
    lambda data: data[:-100] + bytes([data[-100] ^ 1]) + data[-99:]])
def test_a_broken_entry_is_compiled_anew(tmp_path, damage):
    assert 'compiling the numerical kernels' in run(tmp_path)[2]
    entry, = tmp_path.rglob('*.hmsa')
    good = entry.read_bytes()
    assert run(tmp_path)[1:] == (1, '')
    entry.write_bytes(damage(good))
    assert run(tmp_path)[:2] == (4.2, 0)
    assert run(tmp_path)[1] == 1


@pytest.mark.slow
def test_an_entry_of_other_sources_is_replaced(tmp_path):
    run(tmp_path)
    assert run(tmp_path, 'b')[1] == 0
    assert run(tmp_path, 'b')[1] == 1
    assert len(list(tmp_path.rglob('*.hmsa'))) == 1


@pytest.mark.slow
def test_what_came_with_the_package_is_used_where_the_folder_is_empty(tmp_path):
    package, folder = tmp_path / 'package', tmp_path / 'folder'
    assert run(None, package=package)[1] == 0
    assert run(folder, package=package)[1:] == (1, '')
    assert list(folder.rglob('*.hmsa')) == []
    assert run(folder, 'b', package)[1] == 0
