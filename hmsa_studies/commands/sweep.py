"""
Plan over ranges, tables and samples of parameters.

Plan a move for all combinations of values, dimensionless as in the paper, or in SI units with
--params-file. GRID is a value, FIRST:LAST:POINTS or log:FIRST:LAST:POINTS, or several of these
separated by commas; or sobol:LOW:HIGH or normal:MEAN:STD for random samples. A case that cannot be
planned contains the reason in its status. The table is identical, byte for byte, for any number of
workers or shards.

example: hmsa sweep --zeta 0:2:1000 --j-lim log:0.1:100:50 --out sweep.csv
"""

import argparse
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
import shutil
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import add_command, assume_options, given_with_needs, MATERIAL
from hmsa.cli.pictures import formats_of, paper_of, picture_options
from hmsa.cli.terminal import progress
from hmsa.errors import BadInputError, check_choice
from hmsa.report.looks import named, Paper
from hmsa_studies.commands import chunked

if TYPE_CHECKING:
    from hmsa.model.equations import Array
    from hmsa_studies.axes import View
    from hmsa_studies.study_folder import StudyFolder
    from hmsa_studies.sweep import Sweep

#: Time on one core, in s, up to which a sweep is planned at once, without chunks.
_SMALL = 3.4
#: Number of points above which the cost of a sweep is announced.
_LARGE = 1_000_000
# Options of columns, with descriptions.
_AXES = (
    ('--start', 'initial stretch, at rest (default 1; for a beam 0)'),
    ('--target', 'target stretch (default 1.1)'),
    *((option, text) for option, _, text in MATERIAL),
)


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        *((option, 'GRID', str, text) for option, text in _AXES),
        ('--vary', 'NAME=GRID', str,
         'another column: load_min, load_max, period, slew, lag or a constant of the law '
         '(law.c10, ...); with --params-file a parameter, such as actuator.shear_modulus, '
         'flux_density_max, slew_limit, coil_time_constant or command_period. The simulated '
         'actuator may differ from the model in error.shear_modulus, error.zeta, error.j_lim and '
         'error.remanence (relative errors); with --params-file in actual.shear_modulus, '
         'actual.remanence, actual.coil_time_constant and so on (SI)',
         {'action': 'append', 'default': []}),
        ('--residual',
         'also simulate each plan, for the columns residual (residual vibration, peak to peak) '
         'and offset (steady-state error), as fractions of the step. Columns of the simulated '
         'actuator imply it. With --identified the samples are actuators, and the plans use the '
         'file'),
        ('--law', 'NAME,...', str, 'hyperelastic models to compare, separated by commas'),
        ('--shaper', 'NAME,...', str,
         'shapers to compare, separated by commas (default two_step)'),
        ('--params-file', 'YAML', Path,
         'parameter file (YAML) of planner and plant: plans in seconds and tesla, within the '
         'limits of its coil'),
        ('--identified',
         'sample the normal distribution that hmsa identify stored in --params-file'),
        ('--samples', 'N', int, 'number of random samples (default 1024)'),
        ('--seed', 'S', int, 'seed of the random samples (default 0)'),
        ('--cases', 'FILE.csv', Path,
         'CSV with a header of columns; each row is combined with the samples, and with the '
         'grids of the other columns'),
        ('--out', 'FILE|DIR', Path,
         'file to write, ending in .csv or .parquet; an existing file is replaced. Or a folder, '
         'which keeps the chunks and gets table.parquet at the end (default: CSV on '
         'standard output)'),
        ('--show', 'COLUMN,...', str,
         'columns to draw (default: duration and first level, or residual and offset)',
         {'needs': ('--picture', '--out')}),
        *chunked.options(
            'processes; 1 computes in this one (default: one a core for large sweeps)'),
        *picture_options(
            'also draw the results: curves over one numeric column, a map with contours over two, '
            'bands of quantiles for samples; hatching marks points without a plan. A folder as '
            '--out always '
            'gets figures, named table', formats='png,pdf'))


def run(arguments: argparse.Namespace) -> int:
    """Plan the sweep and write its table."""
    sweep = _sweep(arguments)
    in_chunks = _in_chunks(sweep, arguments)
    picture = _SweepPicture(sweep, arguments)
    return _plan_in_chunks(sweep, arguments, picture) if in_chunks \
        else _plan_at_once(sweep, arguments.out, picture)


class _SweepPicture:
    """The figures of a sweep: columns to draw, and files."""

    def __init__(self, sweep: 'Sweep', arguments: argparse.Namespace) -> None:
        """Check the options before anything is computed."""
        import numpy as np

        self._sweep = sweep
        self._view: View | None = None
        self._columns: dict[str, Array] = {}
        self._added = 0
        self._paths: list[Path] = arguments.picture
        names = list(sweep.shown) if arguments.show is None else _names(arguments.show)
        for name in names:
            check_choice('--show', name, sweep.results)
        out: Path | None = arguments.out
        self._paper = paper_of(
            arguments, None if out is None or _is_folder(out) else out,
            sources=(arguments.cases, arguments.params_file))
        asked = bool(self._paths)
        self._default = arguments.show is None and self._paper == Paper()
        if out is not None and _is_folder(out) and not asked:
            self._paths = named(out, 'table', formats_of(arguments))
        self._tables = self._paper.tables(self._paths)
        if not self._paths:
            for option, needed in given_with_needs(arguments):
                if '--picture' in needed:
                    raise BadInputError(f'{option} needs --picture or a folder as --out')
            return
        try:
            self._view = sweep.view()
        except BadInputError as error:
            if asked:
                raise
            chunked.say(str(error))
            return
        self._columns = {name: np.full(sweep.size, np.nan) for name in names}

    def add(self, table: Any) -> None:
        """Take the next rows, by column."""
        begin = self._added
        for name, column in self._columns.items():
            self._added = begin + len(table[name])
            column[begin:self._added] = table[name]

    def draw(self, *, changed: bool = True) -> list[Path]:
        """Draw all rows unless they are drawn already; return the files."""
        if self._view is None:
            return []
        written = [*self._paths, *self._tables]
        if not changed and self._default and all(x.exists() for x in written):
            return written
        from hmsa_studies.pictures import draw_sweep

        draw_sweep(self._paths, self._view, self._columns, self._sweep.fixed, self._paper)
        return written


def _sweep(arguments: argparse.Namespace) -> 'Sweep':
    """Return the sweep of the arguments."""
    from hmsa_studies.axes import (
        ACTUAL,
        belief_of,
        BLOCK_OF,
        draw,
        InSI,
        Nondimensional,
        NOTHING,
        parse_values,
        read_cases,
        Spread,
        System,
    )
    from hmsa_studies.sweep import Sweep

    system: System = Nondimensional()
    belief = NOTHING
    if arguments.params_file is not None:
        from hmsa.identification.files import errors_of, read_belief
        from hmsa.interfaces.parameters import PLANNED, VISCOELASTIC
        from hmsa.interfaces.topics import PLANNER
        from hmsa.planning.shapers.request import ERRORS
        from hmsa.runs.parameters import entries_of, read_parameter_file, values_of

        path = arguments.params_file
        entries = entries_of(path)
        known = read_belief(path, entries)
        system = InSI.of(
            values_of(read_parameter_file(path, entries), PLANNER, (*PLANNED, *VISCOELASTIC)),
            errors_of(known, ERRORS))
        assume_options(arguments)
        if arguments.identified:
            belief = belief_of(known, path)
            if arguments.residual:
                belief = replace(belief, names=tuple(
                    f'{ACTUAL}{x.removeprefix(BLOCK_OF)}' for x in belief.names))
    elif arguments.identified:
        raise BadInputError(
            '--identified without --params-file: expected the file that hmsa identify --out wrote')
    columns = [option.removeprefix('--').replace('-', '_') for option, _ in _AXES]
    texts = {x: y for x in columns if (y := getattr(arguments, x)) is not None}
    if arguments.residual and f'{ACTUAL}shear_modulus' in belief.names:
        # Under any law, plans are made with the modulus about which the samples are.
        texts[f'{BLOCK_OF}shear_modulus'] = repr(
            float(belief.mean[belief.names.index(f'{ACTUAL}shear_modulus')]))
    for text in arguments.vary:
        name, sign, grid = text.partition('=')
        if not sign or name in texts:
            raise BadInputError(f'--vary {text!r}: expected NAME=GRID, each name once')
        texts[name] = grid
    values = {name: parse_values(text, name) for name, text in texts.items()}
    spreads = {name: x for name, x in values.items() if isinstance(x, Spread)}
    samples = None
    if spreads or belief.names:
        samples = draw(
            spreads, belief, 1024 if arguments.samples is None else arguments.samples,
            arguments.seed or 0)
    elif without := [x for x in ('samples', 'seed') if getattr(arguments, x) is not None]:
        raise BadInputError(
            f'--{without[0]} is given without a random column: expected sobol:LOW:HIGH or '
            'normal:MEAN:STD, or --identified')
    return Sweep(
        {name: x for name, x in values.items() if not isinstance(x, Spread)},
        None if arguments.cases is None else read_cases(
            arguments.cases, {**system.ranges, **system.actual}),
        samples=samples, laws=_names(arguments.law), shapers=_names(arguments.shaper),
        system=system, residual=arguments.residual)


def _names(text: str | None) -> list[str]:
    return [] if text is None else [x.strip() for x in text.split(',')]


def _in_chunks(sweep: 'Sweep', arguments: argparse.Namespace) -> bool:
    """Return whether to use chunks; raise `BadInputError` for options that exclude each other."""
    asked = [*(['--workers'] if arguments.workers is not None else []), *chunked.asked(arguments)]
    out: Path | None = arguments.out
    if out is None:
        if asked:
            raise BadInputError(
                f'{asked[0]} without --out: expected --out with a file or a folder')
        return False
    if _is_folder(out) or asked:
        return True
    # Outputs that could not be written are rejected at the start, without chunks.
    return sweep.size > _SMALL * sweep.rate and out.suffix.lower() in {'.csv', '.parquet'} and \
        not out.is_dir() and out.parent.is_dir() and all(map(find_spec, ('dask', 'pyarrow')))


def _is_folder(out: Path) -> bool:
    return not out.suffix or (out.is_dir() and out.suffix.lower() not in {'.csv', '.parquet'})


def _plan_at_once(sweep: 'Sweep', out: Path | None, picture: _SweepPicture) -> int:
    from hmsa_studies.study_folder import open_writer, StudyFolder

    counts: Counter[str] = Counter()
    with open_writer(out, sweep.columns) as write, \
            chunked.progress('planning', sweep.size) as advance:
        for block in sweep.blocks(StudyFolder(sweep, Path()).rows):
            write(block)
            picture.add(block.results)
            counts.update(block.status.tolist())
            advance(block.status.size)
    _report(sweep.size, counts)
    with progress('drawing'):
        pictures = picture.draw()
    if out is not None:
        print(out, *pictures, sep='\n')
    return 0


def _plan_in_chunks(
        sweep: 'Sweep', arguments: argparse.Namespace, picture: _SweepPicture) -> int:
    from hmsa.files import require_arrow
    from hmsa.planning.two_step import available_cores
    from hmsa_studies.study_folder import StudyFolder

    require_arrow()
    table, place = _places(arguments.out)
    small = sweep.size <= _SMALL * sweep.rate
    start, known = chunked.workers_of(arguments, 1 if small else available_cores())
    folder = StudyFolder(sweep, place)
    _estimate(sweep, folder, known, chunked.parse_shard(arguments.shard))

    def finish(computed: int) -> int:
        _report(sweep.size, folder.merge(table, picture.add))
        with progress('drawing'):
            pictures = picture.draw(changed=computed > 0)
        if table.parent.resolve() != folder.folder and arguments.shard is None:
            shutil.rmtree(folder.folder, ignore_errors=True)
        print(table, *pictures, sep='\n')
        return 0

    return chunked.compute_chunks(folder, arguments, start, 'planning', finish)


def _places(out: Path) -> tuple[Path, Path]:
    """Return the path of the table and the folder of the chunks."""
    if _is_folder(out):
        return out / 'table.parquet', out
    if out.suffix.lower() not in {'.csv', '.parquet'}:
        raise BadInputError(
            f'the format of {out} is unknown: expected a name that ends in .csv or .parquet, or a '
            'folder')
    return out, out.with_name(f'{out.name}.chunks')


def _estimate(
        sweep: 'Sweep', folder: 'StudyFolder', cores: int, shard: tuple[int, int]) -> None:
    """Announce the cost of a large sweep, and refuse one that exceeds the free disk space."""
    from hmsa_studies.sweep import ROW_BYTES

    if sweep.size < _LARGE:
        return
    size = sweep.size * ROW_BYTES
    seconds = sweep.size / shard[1] / (sweep.rate * cores)
    time = f'{seconds / 3600:,.1f} h' if seconds > 3600 else f'{seconds / 60:.1f} min'
    chunked.say(f'{sweep.size:,} plans in {folder.count:,} chunks of {folder.rows:,}: about '
         f'{size / 1e9:.3g} GB, the table as much again'
         f'{f"; part {shard[0] + 1} of {shard[1]}" if shard[1] > 1 else ""}; about {time} on '
         f'{cores} core{"s" if cores > 1 else ""}')
    place = folder.folder
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if free < size / shard[1]:
        raise BadInputError(
            f'{place} has {free / 1e9:.3g} GB of free space: expected some '
            f'{size / shard[1] / 1e9:.3g} GB for the chunks; take fewer points or another disk')


def _report(size: int, counts: Mapping[str, int]) -> None:
    words = ', '.join(
        f'{count:,} {status}' for status, count in Counter(counts).most_common())
    chunked.say(f'{size:,} plans: {words}')
