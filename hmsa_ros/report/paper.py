"""What a picture is made for: its width on paper, the size of its letters, and its format."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hmsa_ros.errors import BadInputError

#: Formats of pictures: pixels, lines as PDF and SVG, and commands for LaTeX.
KINDS = ('png', 'pdf', 'svg', 'pgf')
#: What journals ask for, in mm: a column, one and a half, and two.
WIDTHS = (85.0, 120.0, 183.0)
_INCH = 25.4
# Width in mm that a panel needs at least, at 8 pt.
_PANEL = 55.0


@dataclass(frozen=True)
class Paper:
    """
    The size of a picture, and whether its data is written beside it.

    Raises
    ------
    BadInputError
        If a number is out of range.

    """

    width: float = WIDTHS[-1]  #: in mm, 40 to 400
    letters: float = 8.0  #: size of the letters in pt, 4 to 24
    dpi: float = 600.0  #: of PNG, 50 to 1200
    data: bool = False  #: whether what is drawn is written as CSV, too

    def __post_init__(self) -> None:
        for name, value, unit, least, most in (
                ('width', self.width, ' mm', 40.0, 400.0),
                ('font size', self.letters, ' pt', 4.0, 24.0),
                ('dpi', self.dpi, '', 50.0, 1200.0)):
            if not least <= value <= most:
                raise BadInputError(
                    f'the {name} of a picture is {value:g}{unit}: expected {least:g} to '
                    f'{most:g}{unit}')

    @property
    def inches(self) -> float:
        """Width in inches."""
        return self.width / _INCH

    def columns(self, most: int) -> int:
        """Return how many panels fit beside each other, 1 to ``most``."""
        return max(1, min(most, int(self.width * 8.0 / self.letters // _PANEL)))


#: Of the pictures that a page of the documentation shows.
SCREEN = Paper(dpi=200.0)


def kind_of(path: Path) -> str:
    """
    Return the format of a picture by the end of its name.

    Raises
    ------
    BadInputError
        If it is none of `KINDS`.

    """
    kind = path.suffix.lower().removeprefix('.')
    if kind not in KINDS:
        raise BadInputError(
            f'the format of {path} is unknown: expected a name that ends in '
            f'{", ".join(f".{x}" for x in KINDS[:-1])} or .{KINDS[-1]}')
    return kind


def kinds_in(text: str) -> tuple[str, ...]:
    """
    Return the formats in a text with commas between them.

    Raises
    ------
    BadInputError
        If one is none of `KINDS`.

    """
    return tuple(dict.fromkeys(kind_of(Path(f'picture.{x.strip()}')) for x in text.split(',')))


def named(folder: Path, name: str, kinds: Sequence[str]) -> list[Path]:
    """Return the files of a picture in a folder, one for each format."""
    return [folder / f'{name}.{x}' for x in kinds]
