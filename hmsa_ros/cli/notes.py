"""Assumptions of a command, each shown once: a line on standard error, and a note in its JSON."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import sys
from typing import Any, TextIO
import warnings

from hmsa_ros.errors import AssumedWarning, printable

_shown: list[str] = []


@contextmanager
def notes_shown() -> Iterator[None]:
    """Show each assumption of the commands within as a line."""
    _shown.clear()
    with warnings.catch_warnings():
        warnings.simplefilter('always', AssumedWarning)
        other = warnings.showwarning

        def show(
                message: Warning | str, category: type[Warning], filename: str, lineno: int,
                file: TextIO | None = None, line: str | None = None) -> None:
            if not issubclass(category, AssumedWarning):
                other(message, category, filename, lineno, file, line)
            elif str(message) not in _shown:
                _shown.append(str(message))
                print(f'hmsa: note: {printable(str(message))}', file=sys.stderr)

        warnings.showwarning = show
        yield


def with_notes(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a record for JSON with the assumptions so far, if any, added to its notes."""
    return {**record, 'notes': [*record.get('notes', ()), *_shown]} if _shown else record
