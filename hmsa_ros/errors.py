"""
Errors that a user can meet.

Every message is one sentence that says what was wrong, what was got, what was expected and,
where it is not obvious, how to mend it.
"""

from collections.abc import Iterable
import reprlib
import sys

# Long enough for what a user may have mistyped, too short to flood a log.
_EXCERPT = reprlib.Repr()
_EXCERPT.maxstring = _EXCERPT.maxother = 80
_EXCERPT.maxlist = 4


class HmsaError(Exception):
    """
    Base of all errors raised by this package.

    A run that failed for a reason outside the caller's input raises this class itself or a
    subclass other than `BadInputError`; the command line answers it with exit status 1.
    """


class BadInputError(HmsaError, ValueError):
    """
    Input that cannot be used as given.

    The command line answers it with exit status 2.
    """


class BagError(HmsaError):
    """A recording that cannot be read or written."""


def complain(error: Exception, status: int | None = None) -> int:
    """Print an error as one line; return the exit status, by default 2 for bad input, else 1."""
    line = ' '.join(str(error).split())
    print(f'hmsa: error: {printable(line)}', file=sys.stderr)
    if status is None:
        return 2 if isinstance(error, BadInputError) else 1
    return status


def printable(text: str) -> str:
    """Return a text with control characters, and what is no character, written as codes."""
    if text.isprintable():
        return text
    return ''.join(
        character if character.isprintable()
        else character.encode('unicode_escape').decode() for character in text)


def listed(names: Iterable[str], most: int = 4) -> str:
    """Return names for a sentence, the first of many."""
    every = list(names)
    more = f' and {len(every) - most} more' if len(every) > most else ''
    return ', '.join(every[:most]) + more


def excerpt(value: object) -> str:
    """Return a value's ``repr`` in one line, its middle left out where it is long."""
    return ' '.join(_EXCERPT.repr(value).split())
