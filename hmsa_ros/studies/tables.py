"""Tables of studies, written a block at a time, as CSV or Parquet."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import csv
from pathlib import Path
import sys
from types import TracebackType
from typing import Any, Protocol, TextIO

from hmsa_ros.errors import BadInputError
from hmsa_ros.files import replacing, require_arrow


class Block(Protocol):
    """Some rows of a table."""

    def lists(self) -> list[list[Any]]:
        """Return the columns as lists."""

    def arrow(self) -> Any:
        """Return the columns as a table of pyarrow."""


class ArrowBlock:
    """Rows that are a table of pyarrow already."""

    def __init__(self, table: Any) -> None:
        self._table = table

    def lists(self) -> list[list[Any]]:
        """Return the columns as lists."""
        return [x.to_pylist() for x in self._table.columns]

    def arrow(self) -> Any:
        """Return the table."""
        return self._table


class CsvWriter:
    """Writes blocks as CSV, numbers in full double precision."""

    def __init__(self, file: TextIO, columns: Sequence[str]) -> None:
        """Write the header."""
        self._writer = csv.writer(file, lineterminator='\n')
        self._writer.writerow(columns)

    def write(self, block: Block) -> None:
        """Write a block of rows."""
        self._writer.writerows(zip(*block.lists(), strict=True))


class ParquetWriter:
    """Writes blocks as Parquet, a row group each, through pyarrow."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writer: Any = None

    def __enter__(self) -> 'ParquetWriter':
        """Return the writer."""
        return self

    def __exit__(
            self, kind: type[BaseException] | None, error: BaseException | None,
            trace: TracebackType | None) -> None:
        """Write the footer."""
        if self._writer is not None:
            self._writer.close()

    def write(self, block: Block) -> None:
        """Write a block of rows."""
        table = block.arrow()
        if self._writer is None:
            _, parquet = require_arrow()
            self._writer = parquet.ParquetWriter(
                self._path, table.schema, use_dictionary=repeating(table))
        self._writer.write_table(table, row_group_size=max(1, table.num_rows))


def repeating(table: Any) -> list[str]:
    """Return the columns whose values repeat, which a dictionary makes smaller."""
    head = table.slice(0, 1000)
    return [x.name for x in head.schema if not x.type.num_fields
            and len(head[x.name].unique()) <= max(1, head.num_rows // 2)]


@contextmanager
def open_writer(
        path: Path | None, columns: Sequence[str]) -> Iterator[Callable[[Block], None]]:
    """
    Open what the blocks of a study are written to.

    Parameters
    ----------
    path : Path or None
        A file that ends in .csv or .parquet, None for standard output. A file of that name is
        replaced when all is written, and left alone otherwise.
    columns : sequence of str
        Names of the columns.

    Yields
    ------
    callable
        Writes a `Block`.

    Raises
    ------
    BadInputError
        If the name ends otherwise, pyarrow is missing, or the file cannot be written.

    """
    if path is None:
        yield CsvWriter(sys.stdout, columns).write
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
    with replacing(path) as beside:
        if kind == '.csv':
            with beside.open('w', newline='', encoding='utf-8') as file:
                yield CsvWriter(file, columns).write
        else:
            with ParquetWriter(beside) as writer:
                yield writer.write
