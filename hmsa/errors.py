"""
Errors shown to the user.

Every message is one sentence with the problem, the value found, the value expected and, if not
obvious, the remedy.
"""

from collections.abc import Iterable
import math
import reprlib
import sys
import warnings

# Long enough for a mistyped value, short enough not to flood a log.
_EXCERPT = reprlib.Repr()
_EXCERPT.maxstring = _EXCERPT.maxother = 80
_EXCERPT.maxlist = 4
# A compared name may come from anyone, and a long one would take seconds.
_LONGEST_NAME = 200
_PACKAGES = ('hmsa.', 'hmsa_ros.', 'hmsa_lab.', 'hmsa_studies.')


class HmsaError(Exception):
    """
    Base class of all errors raised by this package.

    A run that fails for a reason other than its input raises this class or a subclass other than
    `BadInputError`; the exit status of the command line is 1.
    """


class BadInputError(HmsaError, ValueError):
    """
    Invalid input.

    The exit status of the command line is 2.
    """


class BagError(HmsaError):
    """A recording that cannot be read or written."""


def add_words(error: HmsaError, *more: str) -> None:
    """Add likely reasons or remedies to the message of an error."""
    error.args = ('; '.join((str(error), *more)),)


class AssumedWarning(UserWarning):
    """
    An assumption about ambiguous input, such as which of its columns is the time.

    ``warnings.simplefilter('ignore', hmsa.AssumedWarning)`` accepts all of them; commands show
    each as one line.
    """


class UnusualWarning(UserWarning):
    """
    A parameter that is possible but unusual, such as 45 Pa where 45 kPa may be meant.

    ``warnings.simplefilter('ignore', hmsa.UnusualWarning)`` accepts all of them.
    """


class MissingWarning(UserWarning):
    """
    Messages that are missing from a recording, which is used without them.

    ``warnings.simplefilter('ignore', hmsa.MissingWarning)`` accepts all of them.
    """


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the known names that end in another one, or else the closest, however far it is."""
    names = sorted(set(known))
    same = [x for x in names if x.rpartition('.')[2] == name]
    return listed(same or _close(name[:_LONGEST_NAME], names, 0.0))


def _close(word: str, names: list[str], least: float = 0.6) -> list[str]:
    """Return the name closest to a word, or nothing if none is as similar as ``least``."""
    from difflib import get_close_matches  # slow to import

    return get_close_matches(word, names, 1, least)


def meant(word: object, known: Iterable[str]) -> str:
    """Return ``; did you mean NAME?`` with the known name closest to a word, or nothing."""
    near = _close(str(word), list(known))
    return f'; did you mean {near[0]}?' if near else ''


def check_choice(what: str, value: object, choices: Iterable[str]) -> None:
    """Raise `BadInputError`, with the closest name, if a value is not one of some names."""
    names = list(choices)
    if not isinstance(value, str) or value not in names:
        raise BadInputError(
            f'{what} is {excerpt(value)}: expected one of {", ".join(names)}{meant(value, names)}')


def check_number(
        what: str, value: float, unit: str = '', *, least: float = -math.inf,
        above: float = -math.inf, most: float = math.inf, endless: bool = False) -> None:
    """
    Raise `BadInputError` if a number is out of bounds, or not finite.

    The bounds ``least`` and ``most`` are allowed, ``above`` is not; ``endless`` allows inf.
    """
    if least <= value <= most and above < value and (endless or math.isfinite(value)):
        return
    unit = f' {unit}' if unit else ''
    if least > -math.inf and most < math.inf:
        expected = f'{least:g} to {most:g}{unit}'
    else:
        expected = 'a finite number' + (
            f' of at least {least:g}{unit}' if least > -math.inf
            else f' above {above:g}{unit}' if above > -math.inf else '') + (
            f' and at most {most:g}{unit}' if most < math.inf else '') + (
            ', or inf' if endless else '')
    raise BadInputError(f'{what} is {value:g}{unit}: expected {expected}')


def assume(text: str, kind: type[Warning] = AssumedWarning) -> None:
    """State an assumption or a doubt, as a warning at the line outside this package behind it."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get('__name__', '').startswith(
            _PACKAGES):
        frame, level = frame.f_back, level + 1
    warnings.warn(text, kind, stacklevel=level)


def complain(
        error: Exception, status: int | None = None, *, notes: Iterable[str] = ()) -> int:
    """
    Print an error, with notes, as one line.

    Return the exit status, by default 2 for bad input, else 1.
    """
    line = ' '.join('; note: '.join((str(error), *notes)).split())
    print(f'hmsa: error: {printable(line)}', file=sys.stderr)
    if status is None:
        return 2 if isinstance(error, BadInputError) else 1
    return status


def printable(text: str) -> str:
    """Return a text with control and invalid characters replaced by escape codes."""
    if text.isprintable():
        return text
    return ''.join(
        character if character.isprintable()
        else character.encode('unicode_escape').decode() for character in text)


def listed(names: Iterable[str], most: int = 4) -> str:
    """Return the first names of a list for a message, and the number of the others."""
    every = list(names)
    more = f' and {len(every) - most} more' if len(every) > most else ''
    return ', '.join(every[:most]) + more


def excerpt(value: object) -> str:
    """Return a value's ``repr`` in one line, shortened in the middle."""
    return ' '.join(_EXCERPT.repr(value).split())
