"""A strip chart of characters: dots of Braille where they can be had, else plain ones."""

from dataclasses import dataclass

import numpy as np

from hmsa_ros.model.equations import Array

# Bits of a Braille cell, by row from above and column.
_BITS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_BRAILLE = 0x2800


@dataclass(frozen=True)
class Strip:
    """
    A chart of one value and its target, by rows from above.

    ``targets`` are the columns of each row that show the target alone, for another colour.
    """

    rows: tuple[str, ...]
    targets: tuple[tuple[int, ...], ...]


def dots(braille: bool) -> tuple[int, int]:
    """Return how many columns and rows of dots a character has."""
    return (2, 4) if braille else (1, 1)


def limits(*values: Array, least: float) -> tuple[float, float]:
    """Return the ends of an axis, with some room around the values; NaN values do not count."""
    known = np.concatenate([x[np.isfinite(x)] for x in values])
    if not len(known):
        return 1.0 - 0.5 * least, 1.0 + 0.5 * least
    low, high = float(known.min()), float(known.max())
    room = max(0.05 * (high - low), 0.5 * (least - (high - low)), 0.0)
    return low - room, high + room


def strip(
        value: tuple[Array, Array], target: tuple[Array, Array], height: int,
        edges: tuple[float, float], *, braille: bool) -> Strip:
    """Draw the least and largest value in each column of dots (NaN for none) between two edges."""
    across, down = dots(braille)
    columns = len(value[0])
    lines = height * down
    width = -(-columns // across)
    low, high = edges

    # Padded to whole characters; of each kind which dots are set.
    shown = np.zeros((2, lines, width * across), dtype=bool)
    place = np.arange(lines)[:, None]
    for kind, (least, largest) in enumerate((value, target)):
        known = np.isfinite(least) & np.isfinite(largest)
        top, bottom = (
            np.clip(np.rint((1.0 - (np.where(known, x, low) - low) / (high - low))
                            * (lines - 1)), 0, lines - 1) for x in (largest, least))
        if kind == 0:
            hit = (place >= top) & (place <= bottom)
        else:
            hit = (place == top) | (place == bottom)
            if braille:
                # Broken, so that it is told apart without colour.
                hit &= np.arange(columns) % 3 > 0
        shown[kind, :, :columns] = hit & known
    cells = shown.reshape(2, height, down, width, across)
    ours, theirs = cells[0].any(axis=(1, 3)), cells[1].any(axis=(1, 3))
    if braille:
        # Where both meet, the value is what is seen.
        dot = np.where(ours[:, None, :, None], cells[0], cells[1])
        codes = _BRAILLE + np.einsum('hdwa,da->hw', dot, np.array(_BITS))
        rows = [''.join(map(chr, row)) for row in codes.tolist()]
    else:
        marks = np.where(ours, '*', np.where(theirs, '-', ' '))
        rows = [''.join(row) for row in marks.tolist()]
    alone = theirs & ~ours
    return Strip(
        tuple(rows), tuple(tuple(np.flatnonzero(x).tolist()) for x in alone))
