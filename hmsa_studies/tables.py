"""Tables of studies, written block by block, as CSV or Parquet."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack
import csv
from pathlib import Path
import sys
from typing import Any, Protocol, TextIO

from hmsa.errors import BadInputError
from hmsa.files import replacing, require_arrow


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
