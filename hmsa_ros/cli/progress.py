"""Progress of long operations, on standard error if it is a terminal, removed at the end."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import sys


@contextmanager
def progress(what: str = 'starting') -> Iterator[Callable[[str, float | None], None]]:
    """Yield a function of the current activity and the completed fraction or None."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    with Progress(
            TextColumn('{task.description:<28}'), BarColumn(), TextColumn('{task.fields[share]}'),
            TimeElapsedColumn(), console=console, transient=True,
            # Tested with the file, since FORCE_COLOR in notebooks makes Rich assume a terminal.
            disable=not sys.stderr.isatty() or console.is_dumb_terminal) as shown:
        # Without a total, the bar only shows activity.
        task = shown.add_task(what, total=None, share='     ')

        def update(what: str, share: float | None) -> None:
            if share is None:
                shown.update(task, description=what, total=None, share='     ')
            else:
                shown.update(
                    task, description=what, total=1.0, completed=share,
                    share=f'{100.0 * share:>3.0f} %')

        yield update
