"""
The one decorator of what Numba compiles, with a cache that follows all of its sources.

Numba renews a cached function when its own file changes, not when a function that it calls
does. Here an entry belongs to a hash of all modules with kernels and of the versions that
compiled it. An entry that cannot be read is compiled anew, and where no folder can be written
the kernels are compiled in memory.
"""

from collections.abc import Callable, Iterator
import contextlib
from functools import cache
import hashlib
import logging
import os
from pathlib import Path
import pickle
import sys
from typing import Any
import zlib

import numba
from numba import njit
from numba.core import caching, serialize
import numpy as np

# Fused multiply-add, but nothing that would treat NaN as impossible: it ends bad steps.
_OPTIONS = {'error_model': 'numpy', 'fastmath': {'contract', 'nsz'}}
_SOURCES = (
    'compiling', 'dop853', 'kernels', 'law', 'laws/kernels', 'laws/record', 'lockstep_kernel',
    'response_kernel', 'shooting_kernel', 'tail_kernel', 'two_step_kernel',
    '../identification/kernels')
_HERE = Path(__file__).resolve().parent
_listeners: list[Callable[[str], object]] = []


def compiled(
        *, inline: bool = False, parallel: bool = False, allocates: bool = True
) -> Callable[..., Any]:
    """Return Numba's decorator: cached, ``inline`` before types, ``parallel`` over ``prange``."""
    options = {**_OPTIONS, 'parallel': parallel, 'inline': 'always' if inline else 'never'}
    if not allocates:
        # Neither it nor what it calls makes an array. Counting references to those passed, a
        # dozen for each array at each call that is copied in, can take most of the time.
        options['_nrt'] = False

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = njit(**options)(function)
        if _folder() is not None:
            # As `Dispatcher.enable_caching` does, with a cache of our own.
            dispatcher._cache = _Cache(function)
        return dispatcher

    return decorate


@contextlib.contextmanager
def announced(say: Callable[[str], object]) -> Iterator[None]:
    """Call a function with a sentence once, before this block compiles its first kernel."""
    _listeners.append(say)
    try:
        yield
    finally:
        _listeners.clear()


@cache
def stamp() -> str:
    """Return the hash of the sources of all kernels and of what compiles them."""
    made = hashlib.sha256()
    for name in _SOURCES:
        made.update((_HERE / f'{name}.py').read_bytes())
    for version in (sys.version, numba.__version__, np.__version__):
        made.update(version.encode())
    return made.hexdigest()


@cache
def _folder() -> str | None:
    """Return where compiled kernels are kept, or None where nothing can be written."""
    owner = hashlib.sha256(str(_HERE).encode()).hexdigest()[:16]
    home = os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')
    wanted = [_HERE / '__pycache__', Path(home) / 'hmsa_ros' / owner]
    if numba.config.CACHE_DIR:
        wanted.insert(0, Path(numba.config.CACHE_DIR) / f'hmsa_ros-{owner}')
    for folder in wanted:
        probe = folder / f'.writable-{os.getpid()}'
        try:
            folder.mkdir(parents=True, exist_ok=True)
            probe.touch()
            probe.unlink()
        except (OSError, RuntimeError):
            continue
        return str(folder)
    logging.getLogger('hmsa_ros').warning(
        'cannot write to %s: the numerical kernels are compiled at each start, for some '
        'seconds; expected a folder that can be written, which NUMBA_CACHE_DIR may name',
        ' or '.join(str(x) for x in wanted))
    return None


class _Locator(caching._CacheLocator):
    """Where the cache of a function is, and what it belongs to."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._py_file = function.__code__.co_filename

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(_folder())

    def get_source_stamp(self) -> str:
        """Return what an entry must have been made from."""
        return stamp()

    def get_disambiguator(self) -> str:
        """Return nothing: names are unique in the modules of kernels."""
        return ''

    @classmethod
    def from_function(cls, function: Callable[..., Any], _: str) -> '_Locator':
        """Return the locator of a function."""
        return cls(function)


class _Implementation(caching.CompileResultCacheImpl):
    _locator_classes = (_Locator,)


class _Entries:
    """The compiled versions of a function, a file each: a checksum, then what it holds."""

    def __init__(self, folder: str, name: str) -> None:
        self._folder, self._name = Path(folder), name

    def _file(self, key: Any) -> str:
        # Without the hash of the code, so that a new version takes the place of the old one.
        made = hashlib.sha256(repr(key[:2]).encode()).hexdigest()[:16]
        return f'{self._name}-{made}.hmsa'

    def load(self, key: Any) -> Any:
        """Return the compiled function, None where there is none, or an old or damaged one."""
        # What was compiled with the installation serves a folder that is still empty too.
        for folder in dict.fromkeys((self._folder, _HERE / '__pycache__')):
            try:
                data = (folder / self._file(key)).read_bytes()
            except OSError:
                continue
            # Damaged machine code would crash the process.
            if zlib.crc32(data[4:]).to_bytes(4, 'little') != data[:4]:
                continue
            made, kept, compiled_function = pickle.loads(data[4:])
            if (made, kept) == (stamp(), repr(key)):
                return compiled_function
        return None

    def save(self, key: Any, compiled_function: Any) -> None:
        """Keep a compiled function."""
        data = serialize.dumps((stamp(), repr(key), compiled_function))
        path = self._folder / self._file(key)
        beside = path.with_suffix(f'.{os.getpid()}')
        try:
            beside.write_bytes(zlib.crc32(data).to_bytes(4, 'little') + data)
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)


class _Cache(caching.FunctionCache):
    """A cache that never keeps a kernel from running."""

    _impl_class = _Implementation

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _Entries(self._cache_path, self._impl.filename_base)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the cached function, or None where it must be compiled."""
        found = None
        with contextlib.suppress(Exception):  # a damaged pickle may raise anything
            found = super().load_overload(sig, target_context)
        while found is None and _listeners:
            _listeners.pop()('compiling the numerical kernels (once, some seconds) ...')
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled function where the disk takes it."""
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)
