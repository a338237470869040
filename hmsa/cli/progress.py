"""
Progress of long operations, on standard error.

On a terminal a bar, removed at the end; elsewhere, for operations of many seconds, a line for each
activity.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import math
import sys
import threading

#: Seconds of silence after which `progress` says what is under way.
PATIENCE = 1.5


@contextmanager
def progress(
        what: str = 'starting', *, lines: float = math.inf
) -> Iterator[Callable[[str, float | None], None]]:
    """
    Yield a function of the current activity and the completed fraction or None.

    Where no bar can be shown, a line says the activity that is under way after ``lines`` s, and
    each later one: what fails at once leaves its error alone.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    # Tested with the file, since FORCE_COLOR in notebooks makes Rich assume a terminal.
    bar = sys.stderr.isatty() and not console.is_dumb_terminal
    present, begun = what, False

    def say() -> None:
        nonlocal begun
        begun = True
        print(f'{present} ...', file=sys.stderr, flush=True)

    def change(what: str) -> None:
        nonlocal present
        # Figures in parentheses change all the time.
        new = what.partition(' (')[0] != present.partition(' (')[0]
        present = what
        if new and begun:
            say()

    timer = None if bar or math.isinf(lines) else threading.Timer(lines, say)
    if timer is not None:
        timer.daemon = True
        timer.start()
    with Progress(
            TextColumn('{task.description:<28}'), BarColumn(), TextColumn('{task.fields[share]}'),
            TimeElapsedColumn(), console=console, transient=True, disable=not bar) as shown:
        # Without a total, the bar only shows activity.
        task = shown.add_task(what, total=None, share='     ')

        def update(what: str, share: float | None) -> None:
            change(what)
            if share is None:
                shown.update(task, description=what, total=None, share='     ')
            else:
                shown.update(
                    task, description=what, total=1.0, completed=share,
                    share=f'{100.0 * share:>3.0f} %')

        try:
            yield update
        finally:
            if timer is not None:
                timer.cancel()
