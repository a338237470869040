"""Studies whose rows are tasks: results of a function for each of many arguments."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
import hashlib
from typing import Any

from hmsa.files import require_arrow


class Tasks:
    """
    A table with a row for each of many tasks, as a `hmsa_studies.chunks.Study`.

    Parameters
    ----------
    function : callable
        Returns a row, values by column, for the arguments of a task. Function and arguments
        must be picklable.
    tasks : sequence of tuple
        Arguments; ``repr`` must show all data that a row depends on.
    columns : mapping of str to str
        Types of the columns, in order: ``string``, ``int64``, ``double``, or ``doubles`` for a
        list of them.
    chunk_rows : tuple of int
        Minimum and maximum rows of a chunk.

    """

    def __init__(
            self, function: Callable[..., Mapping[str, Any]], tasks: Sequence[tuple[Any, ...]],
            columns: Mapping[str, str], chunk_rows: tuple[int, int]) -> None:
        self._function, self._tasks, self._columns = function, list(tasks), dict(columns)
        self.size, self.chunk_rows = len(self._tasks), chunk_rows

    @cached_property
    def digest(self) -> str:
        """Return a hash of all inputs."""
        name = f'{self._function.__module__}.{self._function.__qualname__}'
        return hashlib.sha256(f'{name} {self._columns} {self._tasks!r}'.encode()).hexdigest()

    def table(self, begin: int, end: int) -> Any:
        """Carry out a range of tasks; return a pyarrow table."""
        arrow, _ = require_arrow()
        rows = [self._function(*x) for x in self._tasks[begin:end]]
        return arrow.table({
            name: arrow.array(
                [x[name] for x in rows], arrow.list_(arrow.float64()) if kind == 'doubles'
                else arrow.type_for_alias(kind))
            for name, kind in self._columns.items()})
