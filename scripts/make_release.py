"""
Build the sdist and a wheel per Python into dist/, and test each in an empty environment.

    python scripts/make_release.py [PYTHON ...]

Used by ``make release``; needs the network. The tests run in a folder that contains the tests but
not the package, so that they import the installed one.
"""

from pathlib import Path
import shutil
import subprocess
import sys
import tempfile

ROOT = Path(__file__).resolve().parent.parent
# One or two of each part that read no sources, pages or launch files of the repository.
TESTS = (
    'test_core_two_step.py', 'test_core_sequence.py', 'test_core_simulation.py',
    'test_bag_format.py', 'test_bag_bad_input.py', 'test_device.py', 'test_init.py')


def run(*words: object, where: Path = ROOT) -> None:
    """Run a command, whose failure ends the release."""
    print('$', *words, flush=True)
    subprocess.run([str(x) for x in words], cwd=where, check=True)


def try_out(python: str, archive: Path, folder: Path) -> None:
    """Install an archive into an empty environment and run the tests on it."""
    run(python, '-m', 'venv', folder / 'venv')
    inside = folder / 'venv' / 'bin' / 'python'
    run(inside, '-m', 'pip', 'install', '--quiet', '--disable-pip-version-check',
        '-c', ROOT / 'constraints.txt', f'{archive}[ros,test,studies]')
    shutil.copytree(ROOT / 'test', folder / 'test')
    for name in ('benchmarks', 'config', 'pyproject.toml'):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, folder / name)
    run(inside.with_name('hmsa'), 'plan', '1.10:10', '1.00:10', where=folder)
    run(inside, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', '-m', 'not slow and not ros',
        *(folder / 'test' / x for x in TESTS), where=folder)


def main() -> int:
    """Build the archives, and test them with every Python given."""
    dist = ROOT / 'dist'
    shutil.rmtree(dist, ignore_errors=True)
    run(sys.executable, '-m', 'build', '--sdist', '--outdir', dist)
    sdist, = dist.iterdir()
    for python in sys.argv[1:] or [sys.executable]:
        before = set(dist.iterdir())
        # The motion is compiled, so that a wheel runs on one version of Python only.
        run(sys.executable, '-m', 'pip', '--python', python, 'wheel', '--quiet', '--no-deps',
            '--wheel-dir', dist, sdist)
        wheel, = set(dist.iterdir()) - before
        for archive in (wheel, sdist):
            with tempfile.TemporaryDirectory() as folder:
                try_out(python, archive, Path(folder))
    print('dist:', *sorted(x.name for x in dist.iterdir()))
    return 0


if __name__ == '__main__':
    sys.exit(main())
