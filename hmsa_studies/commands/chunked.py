"""Common parts of commands that compute a study in chunks: options, executor, progress, end."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from hmsa.cli.options import Row
from hmsa.errors import BadInputError

if TYPE_CHECKING:
    from hmsa_studies.chunks import Chunks, Study
    from hmsa_studies.engine import ChunkCounts
    from hmsa_studies.executors import Start


def options(workers: str) -> tuple[Row, ...]:
    """Return the options of the engine."""
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
    if arguments.workers is not None and arguments.workers < 1:
        raise BadInputError(f'--workers is {arguments.workers}: expected at least 1')
    if arguments.dask is not None and arguments.workers is not None and arguments.dask != 'local':
        raise BadInputError('--workers and --dask ADDRESS: expected one of them')
    return [f'--{x}' for x in ('shard', 'dask', 'resume') if getattr(arguments, x)]


def engine(arguments: argparse.Namespace, workers: int) -> 'tuple[Start, int]':
    """Return the executor, by default on the given number of cores, and the number of cores."""
    from hmsa_studies.executors import cores, dask, local

    if arguments.dask is not None:
        return (partial(dask, arguments.dask, arguments.workers),
                arguments.workers or (cores() if arguments.dask == 'local' else 1))
    return local(arguments.workers or workers), arguments.workers or workers


def shard_of(arguments: argparse.Namespace) -> tuple[int, int]:
    """Return the index, from 0, and the number of parts."""
    from hmsa_studies.engine import parse_shard

    return (0, 1) if arguments.shard is None else parse_shard(arguments.shard)


def compute_chunks(
        study: 'Study', folder: Path, arguments: argparse.Namespace, start: 'Start', words: str,
        finish: 'Callable[[Chunks, ChunkCounts], int]') -> int:
    """Compute the requested chunks of a study, and `finish` it if all chunks exist."""
    from hmsa.files import require_arrow
    from hmsa_studies.chunks import Chunks
    from hmsa_studies.engine import compute

    require_arrow()
    shard = shard_of(arguments)
    chunks = Chunks.of(study, folder)
    try:
        with progress(words, -(-study.size // shard[1])) as advance:
            outcome = compute(
                study, folder, start, shard=shard, resume=arguments.resume, say=say,
                advance=advance)
        if len(chunks.found()) == chunks.count:
            return finish(chunks, outcome)
    except KeyboardInterrupt:
        say(f'{len(chunks.found()):,} of {chunks.count:,} chunks are in {folder}: go on with '
            '--resume')
        raise
    say(f'{outcome.computed:,} chunks computed, {outcome.kept:,} kept; {len(chunks.found()):,} '
        f'of {chunks.count:,} are there, and the table is written when all are')
    print(folder)
    return 0


def say(sentence: str) -> None:
    """Print a message on standard error."""
    print(sentence, file=sys.stderr)


@contextmanager
def progress(words: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show rows completed, rate and remaining time, only on a terminal."""
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

    console = Console(stderr=True)
    with Progress(
            TextColumn(words), BarColumn(), MofNCompleteColumn(), Rate(''),
            TimeRemainingColumn(), console=console, transient=True,
            disable=not console.is_terminal) as shown:
        task = shown.add_task('', total=total)
        yield lambda rows: shown.advance(task, rows)
