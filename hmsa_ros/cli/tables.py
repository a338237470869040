"""Tables of results on a terminal."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table


def table(caption: str, numbers: Sequence[str], word: str = '') -> 'Table':
    """Return an empty table with columns of numbers and, if it has a name, one of words."""
    from rich.box import SIMPLE
    from rich.table import Table

    made = Table(box=SIMPLE, collapse_padding=True, pad_edge=False, caption=caption)
    for name in numbers:
        made.add_column(name, justify='right', no_wrap=True)
    if word:
        made.add_column(word, no_wrap=True)
    return made
