"""
What a command prints besides its result: progress and notes; and its output in any locale.

Progress of long operations is on standard error: on a terminal a bar, removed at the end;
elsewhere, for operations of many seconds, a line for each activity, and for one that lasts a line
about every two seconds. Assumptions and doubts of a command are told once each: as a line, and as
a note in its JSON. Characters that the encoding of standard output lacks must not end a command.
"""

import codecs
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from io import TextIOWrapper
import math
import sys
import threading
import time
from typing import Any, TextIO
import warnings

from hmsa.errors import AssumedWarning, MissingWarning, printable, UnusualWarning

#: Seconds of silence after which `progress` says what is under way.
PATIENCE = 1.5

_KINDS = AssumedWarning, UnusualWarning, MissingWarning
_said: list[str] = []
_shown: list[str] = []

_PLAIN = {
    '─': '-', '–': '-', '−': '-', '∞': 'inf', '±': '+-', 'µ': 'u', 'μ': 'u', 'Ω': 'ohm',
    'λ': 'lambda', 'Δ': 'd', '·': '*', '×': 'x', '²': '^2', '³': '^3',
    '’': '`', '…': '...', '°': 'deg'}
_NAME = 'hmsa_plain'


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


@contextmanager
def collecting(*, at_once: bool) -> Iterator[None]:
    """Collect the assumptions of a command, to show each as a line, at once or by `show_notes`."""
    _said.clear()
    _shown.clear()
    with warnings.catch_warnings():
        for kind in _KINDS:
            warnings.simplefilter('always', kind)
        other = warnings.showwarning

        def collect(
                message: Warning | str, category: type[Warning], filename: str, lineno: int,
                file: TextIO | None = None, line: str | None = None) -> None:
            if not issubclass(category, _KINDS):
                other(message, category, filename, lineno, file, line)
                return
            if str(message) not in _said:
                _said.append(str(message))
            if at_once:
                show_notes()

        warnings.showwarning = collect
        yield


def show_notes() -> None:
    """Print the assumptions so far: before a run begins, and before results are printed."""
    for text in _said[len(_shown):]:
        _shown.append(text)
        print(f'hmsa: note: {printable(text)}', file=sys.stderr)


def unshown() -> list[str]:
    """Return the assumptions that were not shown."""
    return _said[len(_shown):]


def with_notes(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a record for JSON with the assumptions so far, if any, added to its notes."""
    return {**record, 'notes': [*record.get('notes', ()), *_said]} if _said else record


def plain(error: UnicodeError) -> tuple[bytes, int]:
    """
    Return what replaces characters that cannot be encoded, for `codecs.register_error`.

    Raise `UnicodeError` unless it is an error of encoding.
    """
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return b''.join(
        # A byte of a file name that is no text.
        bytes([ord(x) - 0xdc00]) if '\udc80' <= x <= '\udcff' else _PLAIN.get(x, '?').encode()
        for x in error.object[error.start:error.end]), error.end


def tolerate() -> None:
    """Let standard output replace characters that its encoding lacks."""
    out = sys.stdout
    # The C locale has surrogateescape, which does not encode other characters either.
    if isinstance(out, TextIOWrapper) and out.errors in ('strict', 'surrogateescape'):
        codecs.register_error(_NAME, plain)
        out.reconfigure(errors=_NAME)
