"""Common parts of commands that compute a study in chunks: options, workers, progress, end."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
import sys
from typing import TYPE_CHECKING

from hmsa.cli.options import Row
from hmsa.cli.terminal import under_way
from hmsa.errors import BadInputError, check_number

if TYPE_CHECKING:
    from hmsa_studies.schedulers import Start
    from hmsa_studies.study_folder import StudyFolder


def options(workers: str) -> tuple[Row, ...]:
    """Return the options of a study in chunks."""
    return (
        ('--workers', 'N', int, workers),
        ('--shard', 'I/N', str,
         'compute part I of N only, for array jobs; I from 0 to N-1 or from 1 to N'),
        ('--dask', 'ADDRESS', str,
         'compute on a Dask cluster: its address, its scheduler file (.json), or "local"; all '
         'workers must see the folder of --out'),
        ('--resume', 'reuse the complete chunks of an earlier run'))


def asked(arguments: argparse.Namespace) -> list[str]:
    """Return the given chunk options; raise `BadInputError` if they exclude each other."""
    if arguments.workers is not None:
        check_number('--workers', arguments.workers, least=1)
    if arguments.dask is not None and arguments.workers is not None and arguments.dask != 'local':
        raise BadInputError('--workers and --dask ADDRESS: expected one of them')
    return [f'--{x}' for x in ('shard', 'dask', 'resume') if getattr(arguments, x)]


def workers_of(arguments: argparse.Namespace, count: int) -> 'tuple[Start, int]':
    """Return the workers, by default as many as given, and the number of cores."""
    from hmsa.planning.two_step import available_cores
    from hmsa_studies.schedulers import cluster, local

    if arguments.dask is not None:
        return (partial(cluster, arguments.dask, arguments.workers),
                arguments.workers or (available_cores() if arguments.dask == 'local' else 1))
    return local(arguments.workers or count), arguments.workers or count


def parse_shard(text: str | None) -> tuple[int, int]:
    """Parse ``I/N``, I from 0 or 1; return I from 0, and N, or raise `BadInputError`."""
    if text is None:
        return 0, 1
    part, slash, parts = text.partition('/')
    if not (slash and part.isdecimal() and parts.isdecimal()
            and 0 <= int(part) <= int(parts) and int(parts) > 0):
        raise BadInputError(
            f'shard is {text!r}: expected I/N with I from 0 to N - 1 or from 1 to N, as in 3/20')
    return int(part) % int(parts), int(parts)


def compute_chunks(
        folder: 'StudyFolder', arguments: argparse.Namespace, start: 'Start', words: str,
        finish: Callable[[int], int]) -> int:
    """Compute the requested chunks; if all are there, `finish` with the number computed."""
    from hmsa.files import require_arrow

    require_arrow()
    shard = parse_shard(arguments.shard)

    def there() -> str:
        return f'{len(folder.found()):,} of {folder.count:,}'

    try:
        with progress(words, -(-folder.study.size // shard[1])) as advance:
            kept, computed = folder.compute(
                start, shard=shard, resume=arguments.resume, say=say, advance=advance)
        if len(folder.found()) == folder.count:
            return finish(computed)
    except KeyboardInterrupt:
        say(f'{there()} chunks are in {folder.shown}: go on with --resume')
        raise
    say(f'{computed:,} chunks computed, {kept:,} kept; {there()} are there, and the table is '
        'written when all are')
    print(folder.shown)
    return 0


def say(sentence: str) -> None:
    """Print a message on standard error."""
    print(sentence, file=sys.stderr)


@contextmanager
def progress(words: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show rows completed, on a terminal with rate and remaining time."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(TextColumn):
        def render(self, task: Task) -> Text:
            return Text(f'{task.speed:,.{0 if task.speed > 10.0 else 1}f}/s' if task.speed else '')

    console, done = Console(stderr=True), 0
    with under_way('' if console.is_terminal else words) as change, Progress(
            TextColumn(words), BarColumn(), MofNCompleteColumn(), Rate(''),
            TimeRemainingColumn(), console=console, transient=True,
            disable=not console.is_terminal) as shown:
        task = shown.add_task('', total=total)

        def advance(rows: int) -> None:
            nonlocal done
            done += rows
            shown.advance(task, rows)
            if not console.is_terminal:
                change(f'{words} ({done:,} of {total:,})')

        yield advance
