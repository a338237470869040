"""Packages that not every environment has: without one, the tests that need it are skipped."""

from importlib.util import find_spec
from typing import Any

import pytest

# Of a module that the extra `test` does not bring, the smallest extra that does.
EXTRAS = {
    'dask': 'sweep', 'distributed': 'sweep', 'pandas': 'pandas', 'pint': 'units',
    'pyarrow': 'sweep', 'rclpy': 'ros', 'sphinx': 'docs', 'tornado': 'panel',
    'xarray': 'xarray'}


def needs(module: str) -> Any:
    """
    Return a module, or skip the test by the name of the package that is missing.

    Called while a module of tests is imported, it skips the whole module.
    """
    package = module.partition('.')[0]
    extra = EXTRAS.get(package, 'test')
    return pytest.importorskip(
        module, reason=f"{package} is not installed: pip install '.[{extra}]'")


def has(package: str) -> bool:
    """Return whether a package is installed."""
    return find_spec(package) is not None
