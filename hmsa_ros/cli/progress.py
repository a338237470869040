"""Progress of what takes more than a moment: on a terminal, on standard error, gone at the end."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import sys


@contextmanager
def progress(what: str = 'starting') -> Iterator[Callable[[str, float | None], None]]:
    """Yield what shows progress: called with what is going on, and the share done or None."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    with Progress(
            TextColumn('{task.description:<28}'), BarColumn(), TextColumn('{task.fields[share]}'),
            TimeElapsedColumn(), console=console, transient=True,
            # Asked of the file: notebooks have Rich take any for a terminal (FORCE_COLOR).
            disable=not sys.stderr.isatty() or console.is_dumb_terminal) as shown:
        # Without a total the bar only says that something goes on.
        task = shown.add_task(what, total=None, share='     ')

        def update(what: str, share: float | None) -> None:
            if share is None:
                shown.update(task, description=what, total=None, share='     ')
            else:
                shown.update(
                    task, description=what, total=1.0, completed=share,
                    share=f'{100.0 * share:>3.0f} %')

        yield update
