"""
What a command prints besides its result: progress and notes; and its output in any locale.

Progress is on standard error. No command is silent for long: from its start on, a thread says in a
line what is under way, after each `PATIENCE` s without such a line. On a terminal, an operation
whose share is known has a bar instead, removed at the end. Assumptions and doubts of a command are
told once each: as a line, and as a note in its JSON. Characters that the encoding of standard
output lacks must not end a command.
"""

import codecs
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from io import TextIOWrapper
import os
import sys
import threading
import time
from typing import Any, TextIO
import warnings

from hmsa.errors import AssumedWarning, MissingWarning, printable, UnusualWarning

#: Time in s of silence after which it is said what is under way: with the start of Python below
#: 2 s. What lasts more than a minute is told less often, by a share of the time it has lasted.
PATIENCE = 1.5
_SHARE = 0.025

_KINDS = AssumedWarning, UnusualWarning, MissingWarning
_said: list[str] = []
_shown: list[str] = []

_PLAIN = {
    '─': '-', '–': '-', '−': '-', '∞': 'inf', '±': '+-', 'µ': 'u', 'μ': 'u', 'Ω': 'ohm',
    'λ': 'lambda', 'Δ': 'd', '·': '*', '×': 'x', '²': '^2', '³': '^3',
    '’': '`', '…': '...', '°': 'deg'}
_NAME = 'hmsa_plain'


@dataclass(eq=False)
class _Activity:
    """What is under way since a time; nothing is said of it without words."""

    words: str
    since: float = field(default_factory=time.monotonic)


class _Teller:
    """A thread that says what is under way."""

    def __init__(self) -> None:
        self.activities: list[_Activity] = []  # each within the one before
        self._spoken, self._begun = time.monotonic(), False
        # The thread must not say an activity that its beginning is about to say.
        self._lock = threading.Lock()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._wait, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def end(self) -> None:
        """Say no more, so that no line comes after the result."""
        self._done.set()
        self._thread.join()

    def begin(self, activity: _Activity) -> None:
        """Begin an activity within the others; say it if others were said."""
        with self._lock:
            self.activities.append(activity)
            if self._begun:
                self._say()

    def change(self, activity: _Activity, words: str) -> None:
        """Change the words of an activity."""
        # Figures in parentheses change all the time.
        new = words.partition(' (')[0] != activity.words.partition(' (')[0]
        with self._lock:
            activity.words = words
            if new:
                activity.since = time.monotonic()
                if self._begun:
                    self._say()

    def _say(self, after: str = '') -> None:
        self._spoken = time.monotonic()
        if (words := self.activities[-1].words) and sys.stderr is not None:
            self._begun = True
            with suppress(OSError, ValueError):  # nobody reads it any more
                print(f'{words}{after} ...', file=sys.stderr, flush=True)

    def _wait(self) -> None:
        while True:
            if self._done.wait(max(self._due() - time.monotonic(), 0.0)):
                return
            with self._lock:
                if time.monotonic() >= self._due():
                    since = self.activities[-1].since
                    self._say(f', {time.monotonic() - since:.0f} s' if self._begun else '')

    def _due(self) -> float:
        lasted = time.monotonic() - self.activities[-1].since
        return self._spoken + max(PATIENCE, _SHARE * lasted)


_tellers: list[_Teller] = []


@contextmanager
def under_way(words: str = '') -> Iterator[Callable[[str], None]]:
    """
    Print what is under way at intervals; yield a function that changes the words.

    An activity within another one takes its place until it ends. Without words nothing is printed:
    the command prints its own lines.
    """
    own = not _tellers
    if own:
        _tellers.append(_Teller())
    teller, activity = _tellers[0], _Activity(words)
    teller.begin(activity)
    if own:
        teller.start()
    try:
        yield partial(teller.change, activity)
    finally:
        if own:
            _tellers.clear()
            teller.end()
        teller.activities.remove(activity)


@contextmanager
def progress(what: str = 'starting') -> Iterator[Callable[[str, float | None], None]]:
    """Yield a function of the current activity and the completed fraction or None."""
    # Not asked of Rich, which takes a notebook with FORCE_COLOR for a terminal.
    if not (sys.stderr is not None and sys.stderr.isatty()) or os.environ.get('TERM') == 'dumb':
        with under_way(what) as change:
            yield lambda what, share: change(what)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    with under_way(), Progress(
            TextColumn('{task.description:<28}'), BarColumn(), TextColumn('{task.fields[share]}'),
            TimeElapsedColumn(), console=Console(stderr=True), transient=True) as shown:
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
