"""
Chunks of a study: one file each, in one folder that any number of processes may share.

The name of a file contains the number of its chunk, a hash of the input and of the code that
computes it, and a checksum of the content. The folder thus shows which chunks exist and whether
they are complete; no list is needed.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
import hashlib
import io
from itertools import chain
import json
import os
from pathlib import Path
import re
from typing import Any, Protocol
import uuid
import zlib

from hmsa import __version__
from hmsa.errors import BadInputError, HmsaError
from hmsa.files import make_folder, require_arrow, write_text
from hmsa_studies.tables import open_writer, repeating

#: Rows of a chunk: a thousandth of the study, at least 0.1 s and at most about 100 MB of work; a
#: study with slower rows sets its own limits (``chunk_rows``).
SHARE, LEAST_ROWS, MOST_ROWS = 1000, 40_000, 500_000

_SOURCES = ('.py', '.hpp', '.cpp')
_NAME = re.compile(r'(\d{7,})-([0-9a-f]{16})-([0-9a-f]{8})\.parquet')


class Study(Protocol):
    """A table whose rows can be computed in any order and anywhere."""

    @property
    def size(self) -> int:
        """Number of rows."""

    @property
    def digest(self) -> str:
        """A hash of all data that determine the rows, except the code."""

    def table(self, begin: int, end: int) -> Any:
        """Return rows as a `pyarrow.Table`, with the same columns in every block."""


@dataclass(frozen=True)
class Chunks:
    """The chunks of a study, and their folder."""

    folder: Path  #: absolute
    digest: str  #: of the study and of the code that computes it
    size: int  #: rows of the study, at least 1
    bounds: tuple[int, int] = (LEAST_ROWS, MOST_ROWS)  #: minimum and maximum rows of a chunk

    @classmethod
    def of(cls, study: Study, folder: Path) -> 'Chunks':
        """Return the chunks of a study without writing anything."""
        made = hashlib.sha256(f'{code()} {study.digest} {study.size}'.encode())
        return cls(
            Path(folder).resolve(), made.hexdigest(), study.size,
            getattr(study, 'chunk_rows', (LEAST_ROWS, MOST_ROWS)))

    @property
    def rows(self) -> int:
        """Return the number of rows of a chunk; the last one may have fewer."""
        return min(max(-(-self.size // SHARE), self.bounds[0]), self.bounds[1])

    @property
    def count(self) -> int:
        """Return the number of chunks."""
        return -(-self.size // self.rows)

    def span(self, index: int) -> tuple[int, int]:
        """Return the first row of a chunk, and the row after its last."""
        return index * self.rows, min((index + 1) * self.rows, self.size)

    def check(self) -> None:
        """Raise `BadInputError` if the folder belongs to other data; write nothing."""
        described = self._described
        if described.exists():
            try:
                found = json.loads(described.read_text(encoding='utf-8'))['digest']
            except (OSError, ValueError, KeyError, TypeError):
                found = None
            if found != self.digest:
                raise BadInputError(
                    f'{self.folder} holds another study, or the same of another version of this '
                    'package: expected an empty folder or that of this study; name another with '
                    '--out, or remove it')
        elif any((self.folder / x).exists() for x in ('chunks', 'table.parquet')):
            raise BadInputError(
                f'{self.folder} has chunks or a table but no study.json: expected an empty '
                'folder or that of this study; name another with --out')

    def prepare(self) -> None:
        """Create the folder if needed; raise `BadInputError` if it belongs to other data."""
        self.check()
        make_folder(self.folder / 'chunks')
        if not self._described.exists():
            write_text(self._described, json.dumps({
                'digest': self.digest, 'version': __version__, 'rows': self.size,
                'chunks': self.count, 'rows_of_a_chunk': self.rows}, indent=2) + '\n')

    def found(self) -> dict[int, list[Path]]:
        """Return the files of this study's chunks by number, without a check of their content."""
        files: dict[int, list[Path]] = {}
        for path in sorted((self.folder / 'chunks').glob('*.parquet')):
            name = _NAME.fullmatch(path.name)
            if name and int(name[1]) < self.count and name[2] == self._hash(int(name[1])):
                files.setdefault(int(name[1]), []).append(path)
        return files

    def sound(self, paths: list[Path]) -> bool:
        """Return whether one file of a chunk is intact; remove damaged ones."""
        good = False
        for path in paths:
            if self._content(path) is None:
                path.unlink(missing_ok=True)
            else:
                good = True
        return good

    def write(self, index: int, table: Any, beside: Path) -> None:
        """Write a chunk via another folder of the same file system, or raise `HmsaError`."""
        _, parquet = require_arrow()
        made = io.BytesIO()
        parquet.write_table(
            table, made, row_group_size=max(1, table.num_rows), write_statistics=False,
            use_dictionary=repeating(table), compression='lz4')
        content = made.getbuffer()
        name = f'{index:07d}-{self._hash(index)}-{zlib.crc32(content):08x}.parquet'
        part = beside / f'{name}.{uuid.uuid4().hex}.part'
        try:
            part.write_bytes(content)
            os.replace(part, self.folder / 'chunks' / name)
        except OSError as error:
            raise HmsaError(
                f'cannot write chunk {index} to {self.folder}: {error.strerror or error}; '
                'expected a folder with room that all workers can write to') from error

    def tables(self) -> Iterator[Any]:
        """Yield the tables of all chunks in order; raise `HmsaError` if one is missing or bad."""
        _, parquet = require_arrow()
        files = self.found()
        for index in range(self.count):
            for path in files.get(index, []):
                content = self._content(path)
                if content is not None:
                    yield parquet.read_table(io.BytesIO(content), use_threads=False)
                    break
            else:
                raise HmsaError(
                    f'chunk {index} of {self.folder} is missing or damaged: run the study again '
                    'with --resume, which computes it')

    def merge(
            self, path: Path, look: Callable[[Any], object] | None = None) -> dict[str, int]:
        """
        Write the whole table, in the order of its rows; return the count of each status.

        Parameters
        ----------
        path : Path
            File to write, CSV or Parquet.
        look : callable, optional
            Called with the pyarrow table of each chunk.

        Returns
        -------
        dict of str to int
            Counts by status.

        """
        counts: Counter[str] = Counter()
        tables = self.tables()
        first = next(tables)
        with open_writer(path, first.column_names) as write:
            for table in chain([first], tables):
                write(table)
                if 'status' in table.column_names:
                    counts.update({
                        x['values']: x['counts']
                        for x in table['status'].value_counts().to_pylist()})
                if look is not None:
                    look(table)
        return dict(counts)

    def merge_rows(self, path: Path) -> list[dict[str, Any]]:
        """Write the whole table as `merge` does, and return its rows."""
        rows: list[dict[str, Any]] = []
        self.merge(path, lambda table: rows.extend(table.to_pylist()))
        return rows

    @property
    def _described(self) -> Path:
        return self.folder / 'study.json'

    def _hash(self, index: int) -> str:
        return hashlib.sha256(f'{self.digest} {self.span(index)}'.encode()).hexdigest()[:16]

    @staticmethod
    def _content(path: Path) -> bytes | None:
        """Return the content of a file, None if it does not match the checksum in its name."""
        try:
            content = path.read_bytes()
        except OSError:
            return None
        name = _NAME.fullmatch(path.name)
        return content if name and zlib.crc32(content) == int(name[3], 16) else None


@cache
def code() -> str:
    """Return a hash of the version, and of the sources that plan, simulate and estimate."""
    root = Path(__file__).resolve().parent.parent
    made = hashlib.sha256(__version__.encode())
    for folder in ('hmsa', 'hmsa_ros', 'hmsa_studies'):
        for path in sorted(x for x in (root / folder).rglob('*') if x.suffix in _SOURCES):
            made.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return made.hexdigest()
