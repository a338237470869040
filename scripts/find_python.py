"""
Print the path of a Python that makes environments and has its headers, or nothing.

    python scripts/find_python.py python3.12

Used by ``.ci/run`` and ``make release``. The Pythons of pyenv count before the one on the PATH,
where pyenv puts names of all its Pythons, even of those that do not start.
"""

from glob import glob
import os
import shutil
import subprocess
import sys

PROBE = """\
import ensurepip, os, sys, sysconfig, venv
open(os.path.join(sysconfig.get_path('include'), 'Python.h'))
print('python{}.{}'.format(*sys.version_info))
"""


def find(name: str) -> str | None:
    """Return the path of a Python, such as ``'python3.12'``, or None."""
    root = os.environ.get('PYENV_ROOT') or os.path.expanduser('~/.pyenv')
    version = name.removeprefix('python')
    for path in (*sorted(glob(f'{root}/versions/{version}.*/bin/python'), reverse=True),
                 shutil.which(name)):
        if path is not None:
            probe = subprocess.run(
                [path, '-I', '-c', PROBE], capture_output=True, text=True, check=False)
            if probe.stdout.strip() == name:
                return path
    return None


if __name__ == '__main__':
    print(find(sys.argv[1]) or '')
