"""Standard output in any locale: characters that its encoding lacks must not end a command."""

import codecs
from io import TextIOWrapper
import sys

_PLAIN = {
    '─': '-', '–': '-', '−': '-', '∞': 'inf', '±': '+-', 'µ': 'u', 'μ': 'u', 'Ω': 'ohm',
    'λ': 'lambda', 'Δ': 'd', '·': '*', '×': 'x', '²': '^2', '³': '^3',
    '’': '`', '…': '...', '°': 'deg'}
_NAME = 'hmsa_plain'


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
