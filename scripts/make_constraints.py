"""
Write the constraints of a ROS 2 distribution: install everything in each Python and pin what came.

Used by ``make constraints``; needs the network.
"""

import json
from pathlib import Path
import subprocess
import sys
import tempfile

ROOT = Path(__file__).resolve().parent.parent
EXTRAS = 'test,lint,sweep,panel,pandas,xarray,units,bench,docs,release'
HEADER = """\
# What the package was last tested with, all of it, for Python {first} to {last}: written by
#     make constraints {choice}PYTHONS='{commands}'
# which installs hmsa_ros[{extras}] in a fresh environment of each of these Pythons,
# without constraints, and pins the versions that pip chose.
"""
# Runs inside the environment. What pip did not install itself (the message packages inside the
# ROS wheels carry metadata of their own) cannot be asked of pip and must not be pinned.
LIST = """\
import importlib.metadata, json
print(json.dumps({
    distribution.name.lower().replace('_', '-').replace('.', '-'): distribution.version
    for distribution in importlib.metadata.distributions()
    if (distribution.read_text('INSTALLER') or '').strip() == 'pip'}))
"""
# The package itself, and what each environment brings along or colcon bounds by itself.
LEFT_OUT = ('hmsa-ros', 'pip', 'setuptools')


def version_of(python: str) -> tuple[int, int]:
    """Return the major and minor version of a Python."""
    code = 'import sys; print(*sys.version_info[:2])'
    major, minor = subprocess.check_output([python, '-I', '-c', code], text=True).split()
    return int(major), int(minor)


def installed_by(python: str, extras: str) -> dict[str, str]:
    """Install everything with one Python and return the versions by name."""
    with tempfile.TemporaryDirectory() as directory:
        subprocess.check_call([python, '-m', 'venv', directory])
        inside = str(Path(directory, 'bin', 'python'))
        subprocess.check_call(
            [inside, '-m', 'pip', 'install', '--quiet', f'{ROOT}[{extras}]'],
            stdout=sys.stderr)
        versions: dict[str, str] = json.loads(
            subprocess.check_output([inside, '-I', '-c', LIST], text=True))
    return {name: version for name, version in versions.items() if name not in LEFT_OUT}


def lines(name: str, versions: list[str | None], pythons: list[str]) -> list[str]:
    """
    Return the lines that pin one package.

    Parameters
    ----------
    name : str
        Of the package.
    versions : list of str or None
        One a Python, None where it was not installed.
    pythons : list of str
        Versions of the Pythons, ascending.

    Returns
    -------
    list of str
        One line a version, with a marker if there are several.

    """
    # (version, first Python that has it), without the gaps.
    runs: list[tuple[str, str]] = []
    for version, python in zip(versions, pythons, strict=True):
        if version is not None and (not runs or runs[-1][0] != version):
            runs.append((version, python))
    result = []
    for index, (version, first) in enumerate(runs):
        bounds = []
        if index > 0:
            bounds.append(f"python_version >= '{first}'")
        if index + 1 < len(runs):
            bounds.append(f"python_version < '{runs[index + 1][1]}'")
        marker = ' and '.join(bounds)
        result.append(f'{name}=={version}' + (f' ; {marker}' if marker else ''))
    return result


def main(arguments: list[str]) -> int:
    """Write the file; return the exit status."""
    distro, *commands = arguments or ('',)
    if not commands:
        print('make_constraints.py: expected a distribution and at least one Python, as in '
              'jazzy python3.12', file=sys.stderr)
        return 2
    # The first distribution has the plain names.
    first = distro == 'jazzy'
    extras = f'{"ros" if first else distro},{EXTRAS}'
    commands = sorted(commands, key=version_of)
    pythons = ['{}.{}'.format(*version_of(command)) for command in commands]
    found = [installed_by(command, extras) for command in commands]
    text = HEADER.format(first=pythons[0], last=pythons[-1], extras=extras,
                         choice='' if first else f'ROS={distro} ',
                         commands=' '.join(f'python{python}' for python in pythons))
    for name in sorted(set().union(*found)):
        for line in lines(name, [versions.get(name) for versions in found], pythons):
            text += line + '\n'
    file = ROOT / f'constraints{"" if first else f"-{distro}"}.txt'
    file.write_text(text, encoding='utf-8')
    print(f'wrote {file}')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
