"""Compiled kernels start from any cache: none, a broken one, one of other sources."""

import os
from pathlib import Path
import subprocess
import sys

import pytest

# The one kernel that needs few others, in a package folder that takes no cache.
PROGRAM = """
from pathlib import Path
import sys
from hmsa_ros.core import compiling
compiling._HERE = type('Elsewhere', (type(Path()),), {})('/proc/nowhere')
compiling.stamp = lambda: sys.argv[1]
from hmsa_ros.core import law
print(law.elastic_force(1.4, law.pack(0.2, 5.0, 2.0)),
      sum(law.elastic_force.stats.cache_hits.values()))
"""
FORCE = 0.9647725261108159


def run(cache: Path | None, stamp: str = 'a') -> 'tuple[float, int, str]':
    """Return the force, how often the cache gave it, and what was said."""
    environment = {**os.environ, 'HOME': '/proc/nowhere', 'XDG_CACHE_HOME': '/proc/nowhere'}
    environment.pop('NUMBA_CACHE_DIR', None)
    if cache is not None:
        environment['NUMBA_CACHE_DIR'] = str(cache)
    done = subprocess.run(
        [sys.executable, '-W', 'error', '-c', PROGRAM, stamp], capture_output=True, text=True,
        env=environment, check=True)
    force, hits = done.stdout.split()
    return float(force), int(hits), done.stderr


def test_where_no_folder_can_be_written_kernels_compile_and_it_is_said_once():
    force, hits, said = run(None)
    assert (force, hits) == (pytest.approx(FORCE, rel=1e-14), 0)
    assert said.count('cannot write to') == 1


@pytest.mark.parametrize('damage', [
    lambda data: b'', lambda data: b'nonsense', lambda data: data[:len(data) // 2],
    lambda data: data[:-100] + bytes([data[-100] ^ 1]) + data[-99:]])
def test_a_broken_entry_is_compiled_anew(tmp_path, damage):
    run(tmp_path)
    entries = list(tmp_path.rglob('*.hmsa'))
    assert run(tmp_path)[1] == 1
    for entry in entries:
        entry.write_bytes(damage(entry.read_bytes()))
    assert run(tmp_path)[:2] == (pytest.approx(FORCE, rel=1e-14), 0)
    assert run(tmp_path)[1] == 1
    assert list(tmp_path.rglob('*.hmsa')) == entries


def test_an_entry_of_other_sources_is_replaced(tmp_path):
    run(tmp_path)
    assert run(tmp_path, 'b')[1] == 0
    assert run(tmp_path, 'b')[1] == 1
    assert len(list(tmp_path.rglob('law.elastic_force*.hmsa'))) == 1
