"""A run as tables: its samples, and the levels that drove it."""

from collections.abc import Mapping
import csv
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmsa.errors import BadInputError
from hmsa.files import replacing, require_arrow
from hmsa.model.equations import Array
from hmsa.model.units import NANOSECONDS
from hmsa.runs.record import held_at, Run

SUFFIXES = ('.csv', '.parquet', '.mat')


#: Units of the columns of samples and levels.
UNITS = {'time': 's', 'stretch': '1', 'stretch_rate': '1/s', 'flux_density': 'T'}


def samples_of(run: Run) -> dict[str, Array]:
    """
    Return the samples of a run by column name.

    The columns are ``time`` in s from the first sample, ``stretch``, ``stretch_rate`` in 1/s and
    ``flux_density`` in T: measured, else the present level, else NaN.
    """
    field = run.flux_density
    if not np.isfinite(field).any():
        field = held_at(run.levels, run.time)
    return {'time': _seconds(run, run.time), 'stretch': run.stretch, 'stretch_rate': run.rate,
            'flux_density': field}


def levels_of(run: Run) -> dict[str, Array]:
    """
    Return the levels that drove a run by column name.

    The columns are ``time`` in s from the first sample and ``flux_density`` in T from that time
    on: applied, else commanded, else measured.
    """
    stamps = np.array([x.stamp for x in run.levels], dtype=np.int64)
    return {'time': _seconds(run, stamps),
            'flux_density': np.array([x.flux_density for x in run.levels])}


def _seconds(run: Run, stamps: NDArray[np.int64]) -> Array:
    return np.asarray((stamps - run.time[0]) / NANOSECONDS, dtype=np.float64)


def write_run(path: Path, run: Run) -> list[Path]:
    """
    Write samples and levels; return the files.

    The levels go to a file whose name ends in _levels, or into the same Matlab file as
    ``level_time`` and ``level_flux_density``. Errors are those of `write_table`.
    """
    samples, levels = samples_of(run), levels_of(run)
    if path.suffix.lower() == '.mat':
        write_table(path, samples | {f'level_{x}': y for x, y in levels.items()})
        return [path]
    write_table(path, samples)
    if not run.levels:
        return [path]
    write_table(levels_beside(path), levels)
    return [path, levels_beside(path)]


def levels_beside(path: Path) -> Path:
    """Return the path of the table of levels that belongs to a file of samples."""
    return path.with_name(f'{path.stem}_levels{path.suffix}')


def write_table(path: Path, columns: Mapping[str, Array]) -> None:
    """
    Write columns as CSV, Parquet or Matlab file, by the suffix of the name, in full precision.

    NaN is left empty in CSV. Raise `BadInputError` if the suffix is unknown, pyarrow is missing,
    or the file cannot be written.
    """
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise BadInputError(
            f'the format of {path} is unknown: expected a name that ends in '
            + ' or '.join(SUFFIXES))
    if kind == '.parquet':
        arrow, parquet = require_arrow()
        with replacing(path) as beside:
            parquet.write_table(arrow.table(dict(columns)), beside)
        return
    if kind == '.mat':
        from scipy.io import savemat  # slow to import

        # Open the file here, since errors of savemat do not give the reason.
        with replacing(path) as beside, beside.open('wb') as matrix:
            savemat(matrix, dict(columns), oned_as='column')
        return
    with replacing(path) as beside, beside.open('w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(
            ['' if math.isnan(value) else repr(value) for value in row]
            for row in zip(*(x.tolist() for x in columns.values()), strict=True))
