"""
Studies in chunks of rows, which Dask computes in any order and anywhere.

Each chunk is a Parquet file in one folder that all workers share. The name of a file contains the
number of its chunk, and a hash of the input and of the code that computes it: the folder shows
which chunks are there. A task is a number and a folder, and returns nothing; the study is read
from the folder once. The table therefore does not depend on what computed it.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager, ExitStack
import csv
from functools import cache, cached_property, lru_cache
import hashlib
from itertools import chain, islice
import json
import os
from pathlib import Path
import pickle
import shutil
import sys
from typing import Any, cast, Protocol, TextIO
import uuid

from hmsa import __version__
from hmsa.errors import BadInputError, HmsaError
from hmsa.files import make_folder, replacing, require_arrow, write_text
from hmsa_studies.schedulers import here, require_dask, Start

#: Rows of a chunk: a thousandth of the study, at least 0.1 s and at most about 100 MB of work; a
#: study with slower rows sets its own limits (``chunk_rows``).
SHARE, LEAST_ROWS, MOST_ROWS = 1000, 40_000, 500_000
#: Maximum number of restarts of workers that die without finishing a chunk.
MOST_LOSSES = 5
# Chunks in one graph. Dask takes 1 ms to order each of 10,000, and ever more for each of more.
_GRAPH = 10_000

_SOURCES = ('.py', '.hpp', '.cpp')


class TableBlock(Protocol):
    """Some rows: a pyarrow table, or an object with ``arrow()``."""

    def to_pydict(self) -> Mapping[str, list[Any]]:
        """Return the columns as lists."""


def repeating(table: Any) -> list[str]:
    """Return the columns with repeating values, which a dictionary compresses."""
    head = table.slice(0, 1000)
    return [x.name for x in head.schema if not x.type.num_fields
            and len(head[x.name].unique()) <= max(1, head.num_rows // 2)]


@contextmanager
def open_writer(
        path: Path | None, columns: Sequence[str]) -> Iterator[Callable[[TableBlock], None]]:
    """Yield a function that writes blocks to a file or stdout, or raise `BadInputError`."""
    if path is None:
        yield _csv_writer(sys.stdout, columns)
        sys.stdout.flush()
        return
    kind = path.suffix.lower()
    if kind not in {'.csv', '.parquet'}:
        raise BadInputError(
            f'the format of {path} is unknown: expected a name that ends in .csv or .parquet')
    if path.is_dir():
        raise BadInputError(f'{path} is a folder: expected the name of a file')
    if kind == '.parquet':
        require_arrow()
    with replacing(path) as beside, ExitStack() as stack:
        if kind == '.csv':
            yield _csv_writer(
                stack.enter_context(beside.open('w', newline='', encoding='utf-8')), columns)
        else:
            yield _parquet_writer(beside, stack)


def _csv_writer(file: TextIO, columns: Sequence[str]) -> Callable[[TableBlock], None]:
    """Return a function that writes blocks as CSV in full double precision, after a header."""
    writer = csv.writer(file, lineterminator='\n')
    writer.writerow(columns)
    return lambda block: writer.writerows(zip(*block.to_pydict().values(), strict=True))


def _parquet_writer(path: Path, stack: ExitStack) -> Callable[[TableBlock], None]:
    """Return a function that writes blocks as Parquet row groups; the stack writes the footer."""
    arrow, parquet = require_arrow()
    writer: Any = None

    def write(block: Any) -> None:
        nonlocal writer
        table = block if isinstance(block, arrow.Table) else block.arrow()
        if writer is None:
            writer = stack.enter_context(parquet.ParquetWriter(
                path, table.schema, use_dictionary=repeating(table)))
        writer.write_table(table, row_group_size=max(1, table.num_rows))

    return write


class Study(Protocol):
    """A table whose rows can be computed in any order and anywhere; it must be picklable."""

    @property
    def size(self) -> int:
        """Number of rows."""

    @property
    def digest(self) -> str:
        """A hash of all data that determine the rows, except the code."""

    def table(self, begin: int, end: int) -> Any:
        """Return rows as a `pyarrow.Table`, with the same columns in every block."""

    def named(self, begin: int, end: int) -> str:
        """Return the parameters of rows, for a message."""


class RowStudy:
    """
    A study of a function, with a row for each of many arguments.

    Parameters
    ----------
    function : callable
        Returns a row, values by column, for some arguments. Function and arguments must be
        picklable.
    arguments : sequence of tuple
        Arguments; ``repr`` must show all data that a row depends on.
    columns : mapping of str to str
        Types of the columns, in order: ``string``, ``int64``, ``double``, or ``doubles`` for a
        list of them.
    chunk_rows : tuple of int
        Minimum and maximum rows of a chunk.

    """

    def __init__(
            self, function: Callable[..., Mapping[str, Any]], arguments: Sequence[tuple[Any, ...]],
            columns: Mapping[str, str], chunk_rows: tuple[int, int]) -> None:
        self._function, self._arguments = function, list(arguments)
        self._columns = dict(columns)
        self.size, self.chunk_rows = len(self._arguments), chunk_rows

    @cached_property
    def digest(self) -> str:
        """Return a hash of all inputs."""
        name = f'{self._function.__module__}.{self._function.__qualname__}'
        return hashlib.sha256(f'{name} {self._columns} {self._arguments!r}'.encode()).hexdigest()

    def table(self, begin: int, end: int) -> Any:
        """Compute rows; return a pyarrow table."""
        arrow, _ = require_arrow()
        return arrow.Table.from_pylist(
            [self._function(*x) for x in self._arguments[begin:end]],
            schema=arrow.schema([
                (name, arrow.list_(arrow.float64()) if kind == 'doubles'
                 else arrow.type_for_alias(kind)) for name, kind in self._columns.items()]))

    def named(self, begin: int, end: int) -> str:
        """Return the arguments of rows, for a message."""
        names = [', '.join(str(getattr(x, 'name', x)) for x in given)
                 for given in self._arguments[begin:end]]
        return '; '.join(names if len(names) <= 4 else [*names[:2], '...', names[-1]])


class StudyFolder:
    """
    A study and the folder of its chunks.

    Parameters
    ----------
    study : Study
        The study.
    folder : Path
        Folder of the chunks; all workers must see it under the same path. Nothing is written
        before `compute`.

    Attributes
    ----------
    shown : Path
        The folder as it was given.
    digest : str
        A hash of the study and of the code that computes it.
    rows, count : int
        Rows of a chunk, of which the last one may have fewer, and number of chunks.

    """

    def __init__(self, study: Study, folder: Path) -> None:
        self.study, self.shown, self.folder = study, folder, Path(folder).resolve()
        self.digest = hashlib.sha256(
            f'{code()} {study.digest} {study.size}'.encode()).hexdigest()
        least, most = getattr(study, 'chunk_rows', (LEAST_ROWS, MOST_ROWS))
        self.rows = min(max(-(-study.size // SHARE), least), most, study.size)
        self.count = -(-study.size // self.rows)

    def span(self, index: int) -> tuple[int, int]:
        """Return the first row of a chunk, and the row after its last."""
        return index * self.rows, min((index + 1) * self.rows, self.study.size)

    def path(self, index: int) -> Path:
        """Return the file of a chunk."""
        return self.folder / 'chunks' / f'{index:07d}-{self.digest[:16]}.parquet'

    def found(self) -> list[int]:
        """Return the chunks whose files are there, in order."""
        names = {x.name for x in (self.folder / 'chunks').glob('*.parquet')}
        return [x for x in range(self.count) if self.path(x).name in names]

    def compute(
            self, start: Start = here, *, shard: tuple[int, int] = (0, 1), resume: bool = False,
            say: Callable[[str], object] = print,
            advance: Callable[[int], object] = lambda _: None) -> tuple[int, int]:
        """
        Compute chunks.

        Parameters
        ----------
        start : callable
            Starts the workers, as in `hmsa_studies.schedulers`; it is called again if workers
            die. Default: this process.
        shard : tuple of int
            Index, from 0, and number of parts: every so many chunks.
        resume : bool
            Keep chunks that are there and intact.
        say : callable
            Called with a sentence after an error that is recovered from.
        advance : callable
            Called with the number of rows completed since the last call.

        Returns
        -------
        tuple of int
            Numbers of chunks of the shard that were kept and computed.

        Raises
        ------
        BadInputError
            If the folder belongs to another study, or Dask is not installed.
        HmsaError
            If a chunk cannot be computed or written; it names the parameters of the chunk.

        """
        require_dask()
        self.check()
        mine = range(self.count)[shard[0]::shard[1]]
        found = set(self.found()) if resume else set()
        todo = [x for x in mine if x not in found or self._read(x) is None]
        scratch = self.folder / f'.run-{uuid.uuid4().hex}'
        try:
            self._compute(todo, start, scratch, say, advance)
        except OSError as error:
            raise HmsaError(
                f'the study in {self.folder} stopped ({error.strerror or error}): expected a '
                'folder with write permission and room, and workers that answer; go on with '
                '--resume') from error
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
        return len(mine) - len(todo), len(todo)

    def _compute(
            self, todo: Sequence[int], start: Start, scratch: Path, say: Callable[[str], object],
            advance: Callable[[int], object]) -> None:
        """Compute chunks; after a loss of workers, start again with those that are missing."""
        # Dask takes equal keys for one result, also those of another run on a cluster.
        waiting = {f'chunk-{x}-{scratch.name}': x for x in todo}
        losses = 0

        def done(key: str) -> None:
            begin, end = self.span(waiting.pop(key))
            advance(end - begin)

        while waiting:
            before = len(waiting)
            try:
                # Write nothing before there are workers.
                with start() as compute:
                    from dask import delayed

                    self._share(scratch)
                    write = delayed(_write, pure=False)
                    while waiting:
                        compute([
                            write(str(scratch), index, dask_key_name=key)
                            for key, index in islice(waiting.items(), _GRAPH)], done)
            except BrokenExecutor as error:
                losses = 1 if len(waiting) < before else losses + 1
                if losses >= MOST_LOSSES:
                    raise HmsaError(
                        f'workers died {losses} times without finishing a chunk (chunk '
                        f'{min(waiting.values())} next): expected enough memory for --workers; '
                        'take fewer, then --resume') from error
                say(f'a worker died; the pool starts again, {len(waiting)} chunks to go')
            except (HmsaError, OSError):
                raise
            except Exception as error:
                raise HmsaError(
                    f'the workers failed ({type(error).__name__}: {error}): expected workers '
                    'that have this package and see the folder; correct it, then continue with '
                    '--resume') from error

    def _share(self, scratch: Path) -> None:
        """Create the folder of this run with the study in it, if it does not exist."""
        if scratch.exists():
            return
        make_folder(self.folder / 'chunks')
        if not self._described.exists():
            write_text(self._described, json.dumps({
                'digest': self.digest, 'version': __version__, 'rows': self.study.size,
                'chunks': self.count, 'rows_of_a_chunk': self.rows}, indent=2) + '\n')
        scratch.mkdir()
        (scratch / 'study').write_bytes(pickle.dumps(self))

    def write(self, index: int, scratch: Path) -> None:
        """Compute a chunk and write it completely or not at all, or raise `HmsaError`."""
        _, parquet = require_arrow()
        begin, end = self.span(index)
        try:
            table = self.study.table(begin, end)
        except Exception as error:
            why = str(error) if isinstance(error, HmsaError) else (
                f'{type(error).__name__}: {error}'.removesuffix(': '))
            raise HmsaError(
                f'chunk {index} ({self.study.named(begin, end)}) failed ({why}): expected workers '
                'that can compute it; correct it, then continue with --resume') from error
        part = scratch / f'{index}.{uuid.uuid4().hex}.part'
        try:
            parquet.write_table(
                table, part, row_group_size=max(1, table.num_rows), write_statistics=False,
                use_dictionary=repeating(table), compression='lz4', write_page_checksum=True)
            os.replace(part, self.path(index))
        except OSError as error:
            raise HmsaError(
                f'cannot write chunk {index} to {self.folder}: {error.strerror or error}; '
                'expected a folder with room that all workers can write to') from error

    def check(self) -> None:
        """Raise `BadInputError` if the folder belongs to other data; write nothing."""
        if self._described.exists():
            try:
                found = json.loads(self._described.read_text(encoding='utf-8'))['digest']
            except (OSError, ValueError, KeyError, TypeError):
                found = None
            if found != self.digest:
                raise BadInputError(
                    f'{self.folder} contains another study, or the same of another version of '
                    'this package: expected an empty folder or that of this study; name another '
                    'with --out, or remove it')
        elif any((self.folder / x).exists() for x in ('chunks', 'table.parquet')):
            raise BadInputError(
                f'{self.folder} has chunks or a table but no study.json: expected an empty '
                'folder or that of this study; name another with --out')

    def tables(self) -> Iterator[Any]:
        """Yield the tables of all chunks in order; raise `HmsaError` if one is missing or bad."""
        schema = None
        for index in range(self.count):
            table = self._read(index)
            if table is None or schema not in (None, table.schema):
                raise HmsaError(
                    f'chunk {index} of {self.folder} is missing or damaged: remove '
                    f'{self.path(index).name} if it is there, and run the study again with '
                    '--resume, which computes it')
            schema = table.schema
            yield table

    def merge(
            self, path: Path, look: Callable[[Any], object] = lambda _: None) -> dict[str, int]:
        """
        Write the whole table, in the order of its rows; return the count of each status.

        Parameters
        ----------
        path : Path
            File to write, CSV or Parquet.
        look : callable
            Called with the pyarrow table of each chunk.

        Returns
        -------
        dict of str to int
            Number of rows of each status.

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

    def _read(self, index: int) -> Any:
        """Return the table of a chunk, None if it is missing or damaged."""
        _, parquet = require_arrow()
        begin, end = self.span(index)
        try:
            with parquet.ParquetFile(
                    self.path(index), page_checksum_verification=True) as file:
                table = file.read(use_threads=False)
        except (OSError, ValueError):
            return None
        return table if table.num_rows == end - begin else None


def _write(scratch: str, index: int) -> None:
    """Compute and write a chunk of the study of a run."""
    _shared(scratch).write(index, Path(scratch))


@lru_cache(maxsize=2)
def _shared(scratch: str) -> StudyFolder:
    try:
        return cast(StudyFolder, pickle.loads((Path(scratch) / 'study').read_bytes()))
    except FileNotFoundError:
        raise HmsaError(
            f'a worker does not find {Path(scratch).parent}: expected a folder that all workers '
            'share, under the same path') from None


@cache
def code() -> str:
    """Return a hash of the version, and of the sources that plan, simulate and estimate."""
    root = Path(__file__).resolve().parent.parent
    made = hashlib.sha256(__version__.encode())
    for folder in ('hmsa', 'hmsa_lab', 'hmsa_ros', 'hmsa_studies'):
        for path in sorted(x for x in (root / folder).rglob('*') if x.suffix in _SOURCES):
            made.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return made.hexdigest()
