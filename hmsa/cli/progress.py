"""
Progress of long operations, on standard error.

On a terminal a bar, removed at the end; elsewhere, for operations of many seconds, a line for each
activity, and for one that lasts a line about every two seconds.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import math
import sys
import threading
import time

#: Seconds of silence after which `progress` says what is under way.
PATIENCE = 1.5


@contextmanager
def progress(
        what: str = 'starting', *, lines: float = math.inf, at_once: bool = False
) -> Iterator[Callable[[str, float | None], None]]:
    """
    Yield a function of the current activity and the completed fraction or None.

    Where no bar can be shown, a line says the activity that is under way after ``lines`` s, each
    later one, and how long one has lasted after every ``lines`` s more: what fails at once leaves
    its error alone. With ``at_once`` the first activity gets its line immediately.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    # Tested with the file, since FORCE_COLOR in notebooks makes Rich assume a terminal.
    bar = sys.stderr.isatty() and not console.is_dumb_terminal
    present, begun = what, False
    since = spoken = time.monotonic()
    done = threading.Event()

    def say(after: str = '') -> None:
        nonlocal begun, spoken
        begun, spoken = True, time.monotonic()
        print(f'{present}{after} ...', file=sys.stderr, flush=True)

    def wait() -> None:
        while not done.wait(max(spoken + lines - time.monotonic(), 0.0)):
            now = time.monotonic()
            if now >= spoken + lines:
                say(f', {now - since:.0f} s' if begun else '')

    def change(what: str) -> None:
        nonlocal present, since
        # Figures in parentheses change all the time.
        new = what.partition(' (')[0] != present.partition(' (')[0]
        present = what
        if new:
            since = time.monotonic()
            if begun:
                say()

    waiter = None if bar or math.isinf(lines) else threading.Thread(target=wait, daemon=True)
    if waiter is not None:
        if at_once:
            say()
        waiter.start()
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
            done.set()
            if waiter is not None:
                waiter.join()  # no line after the result
