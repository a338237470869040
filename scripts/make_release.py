"""
Build the sdist and a wheel per Python into dist/, and test each in an empty environment.

    python scripts/make_release.py python3.12 python3.13

Used by ``make release``; needs the network. The sdist is installed without ROS, the wheel with it.
The tests run in a folder that contains the tests but not the package, so that they import the
installed one. Pythons that this machine lacks are named at the end.
"""

import os
from pathlib import Path
import shutil
import subprocess
import sys
import tempfile

from find_python import find

ROOT = Path(__file__).resolve().parent.parent
# One or two of each part that read no sources, pages or launch files of the repository.
TESTS = (
    'test_core_two_step.py', 'test_core_sequence.py', 'test_core_simulation.py',
    'test_bag_format.py', 'test_bag_bad_input.py', 'test_device.py', 'test_init.py')

# Where the libraries of ROS are: its wheels set both when a Python starts, unless they are set.
ENVIRONMENT = {name: value for name, value in os.environ.items()
               if name not in ('LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE')}


def run(*words: object, where: Path = ROOT) -> None:
    """Run a command, whose failure ends the release."""
    print('$', *words, flush=True)
    subprocess.run([str(x) for x in words], cwd=where, env=ENVIRONMENT, check=True)


def install(python: str, archive: str, folder: Path) -> Path:
    """Install an archive into an empty environment, and plan with it; return its Python."""
    run(python, '-m', 'venv', folder / 'venv')
    inside = folder / 'venv' / 'bin' / 'python'
    run(inside, '-m', 'pip', 'install', '--quiet', '--disable-pip-version-check',
        '-c', ROOT / 'constraints.txt', archive)
    run(inside.with_name('hmsa'), 'plan', '1.1:10', where=folder)
    return inside


def try_out(inside: Path, folder: Path) -> None:
    """Run the demo and the tests on an installed wheel."""
    run(inside.with_name('hmsa'), 'demo', where=folder)
    shutil.copytree(ROOT / 'test', folder / 'test')
    for name in ('benchmarks', 'config', 'pyproject.toml'):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, folder / name)
    run(inside, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', '-m', 'not slow and not ros',
        *(folder / 'test' / x for x in TESTS), where=folder)


def main() -> int:
    """Build the archives, and test them with every Python given."""
    pythons = {name: find(name) for name in sys.argv[1:]}
    dist = ROOT / 'dist'
    shutil.rmtree(dist, ignore_errors=True)
    run(sys.executable, '-m', 'build', '--sdist', '--outdir', dist)
    sdist, = dist.iterdir()
    for python in filter(None, pythons.values()):
        before = set(dist.iterdir())
        # The motion is compiled, so that a wheel runs on one version of Python only.
        run(sys.executable, '-m', 'pip', '--python', python, 'wheel', '--quiet', '--no-deps',
            '--wheel-dir', dist, sdist)
        wheel, = set(dist.iterdir()) - before
        with tempfile.TemporaryDirectory() as folder:
            install(python, str(sdist), Path(folder))
        with tempfile.TemporaryDirectory() as folder:
            try_out(install(python, f'{wheel}[ros,test,sweep]', Path(folder)), Path(folder))
    print('dist:', *sorted(x.name for x in dist.iterdir()))
    for name in (x for x, python in pythons.items() if python is None):
        print(f'{name} is not on this machine: NOT tried')
    return 0


if __name__ == '__main__':
    sys.exit(main())
