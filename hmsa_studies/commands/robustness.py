"""
Compare the shapers under parameter errors.

Plan moves with each shaper and the nominal parameters, simulate them with errors in shear modulus
G, damping zeta and J_lim, and compare the residual vibration: peak-to-peak stretch after arrival
as a fraction of the step, without the steady-state error. Minimax plans for these errors. Prints a
table and writes robustness.csv, a figure of each move, and front.png, the worst residual vibration
over the move time; replaces existing files.

example: hmsa robustness --move 1.0:1.4 1.2:0.8 --errors 0.05 --order 2 3 4
"""

import argparse
from collections.abc import Iterator
from dataclasses import asdict
from itertools import product
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import add_command, MATERIAL
from hmsa.cli.pictures import formats_of, paper_of, picture_options
from hmsa.cli.plan import nominal
from hmsa.cli.terminal import progress
from hmsa.errors import BadInputError, check_number
from hmsa.files import json_text, make_folder
from hmsa_studies.commands import chunked

if TYPE_CHECKING:
    from hmsa_studies.feedback import Row
    from hmsa_studies.robustness import Case, Result
    from hmsa_studies.schedulers import Start

_MOVES = ((1.0, 1.1), (1.0, 1.4), (1.0, 0.7))
# Default moves of a beam, which rests at 0.
_BENDS = ((0.0, 0.1), (0.0, 0.4))


def _move(text: str) -> tuple[float, float]:
    start, _, target = text.partition(':')
    try:
        return float(start), float(target)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f'{text!r}: expected START:TARGET, two stretches such as 1.0:1.4') from None


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('--move', 'START:TARGET', _move,
         'moves from one stretch at rest to another (default 1.0:1.1 1.0:1.4 1.0:0.7; of a beam '
         '0:0.1 0:0.4)', {'nargs': '+'}),
        ('--shapers', 'NAME,...', str,
         'shapers, separated by commas (default all)'),
        ('--errors', 'E', float,
         'maximum relative error in the table and the box (default 0.1); the curves extend to '
         'twice that', {'default': 0.1}),
        ('--order', 'N', int, 'orders of robust and minimax (default 2 3)', {'nargs': '+'}),
        *((option, metavar, float, text if option == '--c1' else f'nominal {text}')
          for option, metavar, text in MATERIAL),
        ('--out', 'DIR', Path,
         'output folder, created if missing (default robustness; with --feedback feedback)'),
        ('--feedback',
         'compare open loop with feedback instead (takes minutes). Can be combined only with '
         '--params-file, --seeds, --out, --json, --workers, --shard, --dask, --resume'),
        ('--params-file', 'YAML', Path,
         'actuator and coil instead of --zeta, --j-lim and --c1, with any hyperelastic model; '
         'with --feedback a camera samples it (default: a list of blocks and sensors)'),
        ('--seeds', 'N', int, 'runs with different noise for --feedback (default 10)',
         {'default': 10, 'needs': ('--feedback',)}),
        *chunked.options('processes (default 1)'),
        ('--json', 'print JSON in full precision'),
        *picture_options(formats='png,pdf'))


def run(arguments: argparse.Namespace) -> int:
    """Run the study, print its results and write the files."""
    paper_of(arguments), formats_of(arguments)
    in_chunks = bool(chunked.asked(arguments))
    start, _ = chunked.workers_of(arguments, 1)
    return (_feedback if arguments.feedback else _shapers)(arguments, start, in_chunks)


def _shapers(arguments: argparse.Namespace, start: 'Start', in_chunks: bool) -> int:
    """Compare the shapers."""
    from hmsa_studies.robustness import (
        candidates,
        Case,
        comparison,
        LARGEST,
        ORDERS,
        result_of,
        study,
    )
    from hmsa_studies.schedulers import in_order
    from hmsa_studies.study_folder import StudyFolder

    material, limits, delivery, units = nominal(arguments)
    unit = None if arguments.params_file is None else units.time
    shapers = None
    if arguments.shapers is not None:
        shapers = tuple(name.strip() for name in arguments.shapers.split(','))
    compared = candidates(shapers, arguments.order or ORDERS)
    cases = [
        Case(begin, target, material, limits, delivery, arguments.errors,
             max(arguments.errors, min(2.0 * arguments.errors, LARGEST)))
        for begin, target in dict.fromkeys(
            arguments.move or (_MOVES if material.rest else _BENDS))]
    tasks = list(product(cases, compared))
    folder: Path = arguments.out or Path('robustness')

    def finish(results: 'list[Result]', *files: Path) -> int:
        count = len(compared)
        studies = [(x, results[i * count:(i + 1) * count]) for i, x in enumerate(cases)]
        files = (*files, *_write(folder, studies, arguments))
        return _show(studies, list(files), unit, as_json=arguments.json)

    if in_chunks:
        table = folder / 'table.parquet'
        chunks = StudyFolder(comparison(tasks), folder)
        return chunked.compute_chunks(
            chunks, arguments, start, 'studying', lambda _: finish([
                result_of(*task, row)
                for task, row in zip(tasks, chunks.merge_rows(table), strict=True)], table))
    make_folder(folder)
    with chunked.progress('studying', len(tasks)) as advance:
        found = list(in_order(start, study, tasks, advance))
    return finish(found)


def _show(
        studies: 'list[tuple[Case, list[Result]]]', files: list[Path], unit: float | None, *,
        as_json: bool) -> int:
    """Print the results, also in seconds if the time scale is known, and the files."""
    if as_json:
        print(json_text({
            'moves': [_record(case, results, unit) for case, results in studies],
            'files': files}))
        return 0
    for case, results in studies:
        _print_table(case, results, unit)
    print(*files, sep='\n')
    return 0


def _write(
        folder: Path, studies: 'list[tuple[Case, list[Result]]]',
        arguments: argparse.Namespace) -> list[Path]:
    """Write the numbers and the figures."""
    from hmsa.report.looks import named
    from hmsa_studies.pictures import draw_front, draw_robustness
    from hmsa_studies.robustness import write_csv

    paper, kinds = paper_of(arguments), formats_of(arguments)
    files = [folder / 'robustness.csv']
    write_csv(files[0], studies)
    drawn = [named(folder, f'robustness_{case.start:g}_to_{case.target:g}', kinds)
             for case, _ in studies]
    with progress('drawing') as update:
        for i, (paths, study) in enumerate(zip(drawn, studies, strict=True)):
            update('drawing', i / (len(studies) + 1))
            draw_robustness(paths, *study, paper)
        drawn.append(named(folder, 'front', kinds))
        draw_front(drawn[-1], studies, paper)
    for paths in drawn:
        files += [*paths, *paper.tables(paths)]
    return files


def _record(
        case: 'Case', results: 'list[Result]', unit: float | None) -> dict[str, Any]:
    """Return a case for the JSON output; null for missing values."""
    from hmsa_studies.robustness import ORDERED, PARAMETERS

    errors = case.errors().tolist()
    records = []
    for result in results:
        record: dict[str, Any] = {
            'shaper': result.candidate.shaper,
            'order': result.candidate.order if result.candidate.shaper in ORDERED else None,
            'label': result.candidate.label,
            'status': str(result.code),
            'reason': result.reason,
        }
        if result.move is not None:
            record |= {
                'levels': [[x.time, x.load] for x in result.move.levels],
                'arrival': result.arrival,
                **({} if unit is None else {'arrival_seconds': result.arrival * unit}),
                'arrives': math.isfinite(result.move.duration),
                'residual': result.nominal,
                'worst': {
                    **{name: {
                        'residual': worst.residual,
                        'error': getattr(worst.errors, PARAMETERS[name])}
                        for name, worst in result.alone.items()},
                    'box': {
                        'residual': result.worst.residual,
                        'errors': {
                            name: getattr(result.worst.errors, attribute)
                            for name, attribute in PARAMETERS.items()}},
                },
                'curves': {
                    name: {'errors': errors, 'residuals': curve.tolist()}
                    for name, curve in result.curves.items()},
            }
        records.append(record)
    return {
        'start': case.start, 'target': case.target, 'zeta': case.material.zeta,
        'j_lim': case.material.j_lim, 'c1': case.material.c1, 'box': case.box,
        'shapers': records}


def _print_table(case: 'Case', results: 'list[Result]', unit: float | None) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from hmsa.table import percent

    error = f'{100.0 * case.box:g}'
    table = Table(
        box=SIMPLE_HEAD,
        title=f'{case.material.coordinate.name} {case.start:g} to {case.target:g}, '
              f'{case.nominal}',
        caption=f'nominal: residual vibration, the peak-to-peak {case.material.coordinate.name} '
                'after arrival in % of the step, without the steady-state error\n'
                f'parameters, all: its worst case for errors of up to {error} % in one parameter, '
                'and in all at once\narrival: in '
                + ('ms' if unit else 'L sqrt(rho/G)' if case.material.law is None
                   else 'units of time'), caption_justify='left')
    table.add_column('shaper', no_wrap=True)
    for name in ('arrival', 'nominal', *case.parameters, 'all'):
        table.add_column(name, justify='right', no_wrap=True)
    for result in results:
        if result.move is None:
            table.add_row(result.candidate.name, *'---', *'-' * len(case.parameters))
            continue
        arrival = f'{result.arrival * (1e3 * unit if unit else 1.0):.3f}'
        table.add_row(
            result.candidate.name,
            arrival if math.isfinite(result.move.duration) else f'({arrival})',
            percent(result.nominal), *(percent(x.residual) for x in result.alone.values()),
            percent(result.worst.residual))
    console = Console()
    console.print(table)
    notes = [f'{x.candidate.name}: {x.reason}' for x in results if x.reason]
    linear = [x.candidate.name for x in results if x.candidate.linear]
    if linear:
        notes.append(f'{", ".join(linear)}: linear, designed at the target')
    if any(x.move is not None and math.isinf(x.move.duration) for x in results):
        notes.append('unshaped steps have no arrival time; the residual is measured from the '
                     'arrival of the two-step command (in brackets), or from half a natural '
                     'period if there is none')
    if any(math.isnan(x.worst.residual) for x in results if x.move is not None):
        notes.append('a question mark marks a motion too close to a limiting stretch to '
                     'integrate')
    for note in notes:
        console.print(f'note: {note}', highlight=False, soft_wrap=True)


def _feedback(arguments: argparse.Namespace, start: 'Start', in_chunks: bool) -> int:
    """Compare open loop with feedback."""
    from hmsa.identification.files import read_belief
    from hmsa_studies.commanders import scenario_of
    from hmsa_studies.feedback import left_of, Matrix, trial
    from hmsa_studies.schedulers import in_order
    from hmsa_studies.study_folder import StudyFolder

    check_number('--seeds', arguments.seeds, least=1)
    matrix = Matrix(arguments.seeds)
    if arguments.params_file is not None:
        belief = read_belief(arguments.params_file)
        for key, name in (
                ('coil_time_constant', 'coil_time_constant'),
                ('viscoelastic_ratio', 'viscoelastic.ratio')):
            if belief.others.get(key):
                raise BadInputError(
                    f'{arguments.params_file} gives {name} {belief.others[key]:g}: expected 0 '
                    'with --feedback, which compares actuators without coil lag and creep; leave '
                    'it out of the file')
        matrix = Matrix(arguments.seeds, [scenario_of(belief.actuator)])
    if not in_chunks and arguments.out is None:
        return _show_matrix(
            matrix.seeds, matrix.rows(in_order(start, trial, matrix.tasks)),
            as_json=arguments.json)
    folder = StudyFolder(matrix.study, arguments.out or Path('feedback'))
    table = folder.shown / 'table.parquet'
    return chunked.compute_chunks(
        folder, arguments, start, 'moving', lambda _: _show_matrix(
            matrix.seeds, matrix.rows(map(left_of, folder.merge_rows(table))),
            as_json=arguments.json, table=table))


_LEGEND = """\
Peak-to-peak vibration (steady-state error) in % of the step, root mean square.
* columns: after the first move (0.4 from rest), one and two cycles later, and after the next move
  (to 0.1); the error that remains if nothing is corrected from then on
* G: error of the shear modulus
* robust: order 2
* learning: the four columns are four trials of the first move
* LQR, MPC: measured in the cycle that follows, with the loop closed
* worst: largest vibration after the first move
* no worse: no vibration exceeds 1.2 times that of robust or, if the model is exact, half of that
  which noise alone shows"""


def _show_matrix(
        seeds: int, rows: 'Iterator[Row]', *, as_json: bool, table: Path | None = None) -> int:
    """Print rows as they are computed."""
    if as_json:
        found = {'seeds': seeds, 'rows': [asdict(x) for x in rows]}
        print(json_text(found if table is None else {**found, 'files': [table]}))
        return 0
    print(_LEGEND)
    before = ''
    for row in rows:
        if row.scenario != before:
            print(f'\n{row.scenario}\n{"G":>6} {"strategy":<9} {"after the move":>16} '
                  f'{"a cycle later":>16} {"two cycles":>16} {"next move":>16} {"worst":>7} '
                  'no worse')
            before = row.scenario
        cells = ' '.join(
            f'{100.0 * x.vibration:>7.3f} ({100.0 * x.offset:6.3f})' for x in row.left)
        verdict = {None: '', True: 'yes', False: 'no'}[row.no_worse]
        line = (f'{100.0 * row.error:>4g} % {row.strategy:<9} {cells} '
                f'{100.0 * row.worst[0]:>7.3f} {verdict}')
        print(line.rstrip(), flush=True)
    if table is not None:
        print(table)
    return 0
