"""Assumptions and doubts of a command, each once: a line, and a note in its JSON."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import sys
from typing import Any, TextIO
import warnings

from hmsa.errors import AssumedWarning, MissingWarning, printable, UnusualWarning

_KINDS = AssumedWarning, UnusualWarning, MissingWarning
_said: list[str] = []
_shown: list[str] = []


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
