"""Types of the package, checked with mypy as a test, in parallel with the others."""

from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.long
@pytest.mark.xdist_group('heavy')
@pytest.mark.timeout(600)
def test_types_of_the_package_are_right():
    checked = subprocess.run(
        [sys.executable, '-m', 'mypy'], cwd=ROOT, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout + checked.stderr
