"""Write files completely or not at all."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
import csv
import json
import math
import os
from pathlib import Path
import stat
from typing import Any

from hmsa.errors import BadInputError

#: Endings of the files of bags: MCAP, SQLite, ROS 1.
BAG_SUFFIXES = '.mcap', '.db3', '.bag'


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """
    Yield a temporary file that replaces ``path`` once complete; on failure, keep the old file.

    Links are followed, devices are written to directly. Raises `BadInputError` if the file cannot
    be written, is write-protected, or is a broken link.
    """
    with _beside(path) as (beside, target):
        yield beside
        if beside != target:
            os.replace(beside, target)


@contextmanager
def _beside(path: Path) -> Iterator[tuple[Path, Path]]:
    """Yield a temporary name beside the file that a path means, and the file; devices are both."""
    try:
        if path.is_symlink() and not path.exists():
            raise BadInputError(
                f'cannot write {path}: it is a link to nothing; remove it or name another file')
        target = path.resolve()
        if target.exists() and not os.access(target, os.W_OK):
            raise BadInputError(
                f'cannot write {path}: it is write-protected; expected another name')
        if target.exists() and not stat.S_ISREG(target.stat().st_mode):
            yield target, target
            return
        import uuid  # slow to import

        # Processes on two hosts may have the same number.
        beside = target.with_name(f'.{target.name}.{uuid.uuid4().hex}.part')
        try:
            yield beside, target
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise BadInputError(
            f'cannot write {path}: {error.strerror or error}; expected a folder with write '
            'permission and room') from error


def write_rows(path: Path, rows: Iterable[Iterable[object]]) -> None:
    """Write rows as CSV in UTF-8, numbers in full precision, or change nothing."""
    with replacing(path) as beside, beside.open('w', newline='', encoding='utf-8') as file:
        csv.writer(file, lineterminator='\n').writerows(rows)


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8, replacing invalid characters, or change nothing."""
    with replacing(path) as beside:
        beside.write_bytes(text.encode('utf-8', 'replace'))


def check_targets(*targets: Path | None, sources: Iterable[Path | None] = ()) -> None:
    """Raise `BadInputError` for a target that cannot be written, or is a source or named twice."""
    read = {x.resolve() for x in sources if x is not None}
    written: set[Path] = set()
    for target in filter(None, targets):
        place = target.resolve()
        why = ('it is a folder; expected a file' if target.is_dir() else
               f'{target.parent} is no folder; expected one that exists'
               if not place.parent.is_dir() else
               'the command reads it; expected another name' if place in read else
               'it may be part of a bag; expected another name'
               if target.suffix in BAG_SUFFIXES or target.name == 'metadata.yaml' else
               'two outputs name the same file; expected different files'
               if place in written else '')
        if why:
            raise BadInputError(f'cannot write {target}: {why}')
        with _beside(target) as (beside, file):
            if beside != file:
                beside.touch()  # now, not after the work
        written.add(place)


def may_be_bag(path: Path) -> bool:
    """Return whether a path is given as a bag, not as a table."""
    return path.is_dir() or path.suffix in BAG_SUFFIXES


def make_folder(folder: Path) -> None:
    """Create an output folder unless it exists; raise `BadInputError` if it is not writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / '.writable'
        probe.touch()
        probe.unlink(missing_ok=True)
    except OSError as error:
        raise BadInputError(
            f'cannot write to the folder {folder}: {error.strerror or error}; expected a folder '
            'with write permission (--out)') from error


def json_text(document: object) -> str:
    """Return a document as JSON, with paths as text and null for non-finite numbers."""
    return json.dumps(finite(document), indent=2, allow_nan=False)


def finite(value: Any) -> Any:
    """Return a document with values that JSON can represent, None for non-finite numbers."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: finite(x) for key, x in value.items()}
    if isinstance(value, Path):
        return str(value)
    value = value.tolist() if hasattr(value, 'tolist') else value  # of NumPy
    return [finite(x) for x in value] if isinstance(value, (list, tuple)) else value


def read_at_most(path: Path, size: int, expected: str) -> bytes:
    """Return the content of a file or device; raise `BadInputError` if it is too large."""
    with path.open('rb') as file:
        content = file.read(size + 1)
    if len(content) > size:
        raise BadInputError(f'{path} has more than {size} bytes: expected {expected}')
    return content


def require_arrow() -> tuple[Any, Any]:
    """Return ``pyarrow`` and ``pyarrow.parquet``; raise `BadInputError` if not installed."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise BadInputError(
            'pyarrow, which writes Parquet, is not installed: install it (pip install '
            'pyarrow) or write to a file that ends in .csv') from error
    return pyarrow, parquet


def yaml_text(value: Any) -> str:
    """Return a value in YAML that all readers interpret alike; floats have a decimal point."""
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, float):
        if not math.isfinite(value):
            return '.nan' if math.isnan(value) else '.inf' if value > 0.0 else '-.inf'
        text = repr(value)
        mantissa, letter, exponent = text.partition('e')
        return f'{mantissa}.0e{exponent}' if letter and '.' not in mantissa else text
    if isinstance(value, list):
        return f'[{", ".join(yaml_text(x) for x in value)}]'
    if isinstance(value, str):
        return "'" + value.replace("'", "''") + "'"
    return str(value)
