"""
Engine of studies: computes the chunks of a study on any `concurrent.futures.Executor`.

A task is a number and a folder. The worker reads the study from the folder once, and writes the
chunks there. Tasks are therefore small, return nothing, and the table does not depend on where
or in which order its chunks were computed.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, CancelledError, Executor, FIRST_COMPLETED, Future
from concurrent.futures import wait as wait_for
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
import pickle
import shutil
from typing import cast
import uuid

from hmsa.errors import BadInputError, HmsaError
from hmsa_studies.chunks import Chunks, Study
from hmsa_studies.executors import given, held_signals, here, Start

#: Called with a sentence.
Say = Callable[[str], object]
#: Maximum number of restarts of a pool that loses workers without finishing a chunk.
MOST_LOSSES = 5
#: Seconds that the futures of a broken pool have to end.
PATIENCE = 10.0


@dataclass
class ChunkCounts:
    """Numbers of chunks of its shard that a call of `compute` kept and computed."""

    kept: int = 0
    computed: int = 0


def parse_shard(text: str) -> tuple[int, int]:
    """Parse ``I/N``, I from 0 or 1; return I from 0, and N, or raise `BadInputError`."""
    part, slash, parts = text.partition('/')
    if not (slash and part.isdecimal() and parts.isdecimal()
            and 0 <= int(part) <= int(parts) and int(parts) > 0):
        raise BadInputError(
            f'shard is {text!r}: expected I/N with I from 0 to N - 1 or from 1 to N, as in 3/20')
    return int(part) % int(parts), int(parts)


def compute(
        study: Study, folder: Path, executor: Executor | Start = here, *,
        shard: tuple[int, int] = (0, 1), resume: bool = False, say: Say = print,
        advance: Callable[[int], object] | None = None) -> ChunkCounts:
    """
    Compute the chunks of a study.

    Parameters
    ----------
    study : Study
        The study, which must be picklable.
    folder : Path
        Folder of the chunks; all workers must see it under the same path.
    executor : Executor or callable
        An executor, for example of mpi4py.futures or submitit, or a function that creates one,
        which is called again if workers die. Default: this process.
    shard : tuple of int
        Index, from 0, and number of parts.
    resume : bool
        Keep chunks that exist and are intact.
    say : callable
        Called with a message after an error from which the engine recovers.
    advance : callable, optional
        Called with the number of rows completed since the last call.

    Returns
    -------
    Outcome
        Numbers of chunks.

    Raises
    ------
    BadInputError
        If the folder belongs to another study.
    HmsaError
        If a chunk cannot be computed or written.

    """
    chunks = Chunks.of(study, folder)
    chunks.check()
    mine = list(range(chunks.count))[shard[0]::shard[1]]
    found = chunks.found() if resume else {}
    todo = [x for x in mine if not (x in found and chunks.sound(found[x]))]
    outcome = ChunkCounts(len(mine) - len(todo))
    start = (lambda: given(executor)) if isinstance(executor, Executor) else executor
    scratch = chunks.folder / f'.run-{uuid.uuid4().hex}'
    try:
        _compute(
            study, chunks, deque(todo), start, scratch, outcome, say,
            advance or (lambda _: None))
    except OSError as error:
        raise HmsaError(
            f'the study in {chunks.folder} stopped ({error.strerror or error}): expected a folder '
            'with write permission and room, and workers that answer; go on with --resume'
        ) from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return outcome


def _share(study: Study, chunks: Chunks, scratch: Path) -> None:
    """Create the folder of this run with the study in it, if it does not exist."""
    if scratch.exists():
        return
    chunks.prepare()
    scratch.mkdir()
    (scratch / 'study').write_bytes(pickle.dumps((study, chunks)))


@lru_cache(maxsize=2)
def _study(path: Path) -> tuple[Study, Chunks]:
    try:
        return cast(tuple[Study, Chunks], pickle.loads(path.read_bytes()))
    except FileNotFoundError:
        raise HmsaError(
            f'a worker does not find {path.parent.parent}: expected a folder that all workers '
            'share, under the same path') from None


def _work(scratch: str, index: int) -> None:
    """Compute a chunk."""
    study, chunks = _study(Path(scratch) / 'study')
    chunks.write(index, study.table(*chunks.span(index)), Path(scratch))


def _compute(
        study: Study, chunks: Chunks, waiting: deque[int], start: Start, scratch: Path,
        outcome: ChunkCounts, say: Say, advance: Callable[[int], object]) -> None:
    """Compute the waiting chunks; after a loss of workers, restart with the lost ones."""
    losses = 0
    while waiting:
        before = outcome.computed
        running: dict[Future[None], int] = {}
        try:
            # Write nothing before there is an executor.
            with start() as (executor, ahead):
                _share(study, chunks, scratch)
                _feed(chunks, waiting, running, executor, ahead, scratch, outcome, advance)
        except BrokenExecutor as error:
            lost = sorted(running.values())
            waiting.extendleft(reversed(lost))
            losses = losses + 1 if outcome.computed == before else 1
            if losses >= MOST_LOSSES:
                raise HmsaError(
                    f'workers died {losses} times without finishing a chunk (chunk {waiting[0]} '
                    'next): expected enough memory for --workers; take fewer, then --resume'
                ) from error
            say('a worker died; the pool starts again with the '
                f'{len(lost)} chunks that were under way or waiting in it')


def _feed(
        chunks: Chunks, waiting: deque[int], running: dict[Future[None], int],
        executor: Executor, ahead: int, scratch: Path, outcome: ChunkCounts,
        advance: Callable[[int], object]) -> None:
    """Keep an executor busy until no task is waiting or running."""
    while waiting or running:
        with held_signals():
            while waiting and len(running) < ahead:
                future = executor.submit(_work, str(scratch), waiting[0])
                running[future] = waiting.popleft()
        done = wait_for(running, return_when=FIRST_COMPLETED).done
        if any(isinstance(x.exception(), BrokenExecutor) for x in done if not x.cancelled()):
            # The others of a broken pool end at once, too; some have a result.
            done = wait_for(running, timeout=PATIENCE).done
        broken = None
        for future in done:
            index = running[future]
            try:
                future.result()
            except BrokenExecutor as error:
                broken = error
                continue
            except HmsaError:
                raise
            except (Exception, CancelledError) as error:
                raise HmsaError(
                    f'chunk {index} failed ({type(error).__name__}: {error}): expected workers '
                    'that have this package and see the folder; correct it, then continue with '
                    '--resume') from error
            del running[future]
            outcome.computed += 1
            begin, end = chunks.span(index)
            advance(end - begin)
        if broken is not None:
            raise broken
