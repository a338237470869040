"""The width, font size and format of a figure."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hmsa.errors import BadInputError, check_choice, check_number

#: Formats of figures; ``pgf`` is for LaTeX.
KINDS = ('png', 'pdf', 'svg', 'pgf')
#: Widths of journal figures in mm: one, one and a half, and two columns.
WIDTHS = (85.0, 120.0, 183.0)
#: Panels of a figure of runs, and those drawn by default: side by side, and in a column.
PANELS = ('command', 'response', 'phase', 'error', 'residual', 'plan', 'timing')
WIDE, NARROW = ('command', 'response', 'phase', 'error'), ('command', 'response', 'error')
#: In mm.
INCH = 25.4
# Minimum width of a panel in mm, at 8 pt.
_PANEL = 55.0


@dataclass(frozen=True)
class Paper:
    """
    The size of a figure, its panels, and whether its data is written to a CSV file.

    Raises
    ------
    BadInputError
        If a number is out of range.

    """

    width: float = WIDTHS[-1]  #: in mm, 40 to 400
    letters: float = 8.0  #: font size in pt, 4 to 24
    dpi: float = 600.0  #: of PNG, 50 to 1200
    data: bool = False  #: whether the plotted data are also written as CSV
    height: float | None = None  #: in mm, 20 to 400; None for one that suits the panels
    panels: Sequence[str] = ()  #: of runs, of `PANELS`; by default, those that fit

    def __post_init__(self) -> None:
        for name, value, unit, least, most in (
                ('width', self.width, 'mm', 40.0, 400.0),
                ('height', 100.0 if self.height is None else self.height, 'mm', 20.0, 400.0),
                ('font size', self.letters, 'pt', 4.0, 24.0),
                ('dpi', self.dpi, '', 50.0, 1200.0)):
            check_number(f'the {name} of a picture', value, unit, least=least, most=most)
        for panel in self.panels:
            check_choice('a panel', panel, PANELS)

    @property
    def inches(self) -> float:
        """Width in inches."""
        return self.width / INCH

    def columns(self, most: int) -> int:
        """Return how many panels fit side by side, 1 to ``most``."""
        return max(1, min(most, int(self.width * 8.0 / self.letters // _PANEL)))

    def tables(self, pictures: Sequence[Path]) -> list[Path]:
        """Return the CSV files with the data of figures; none without ``data``."""
        return list(dict.fromkeys(x.with_suffix('.csv') for x in pictures if self.data))


#: Figures of the documentation.
SCREEN = Paper(dpi=200.0)


def kind_of(path: Path) -> str:
    """
    Return the format of a figure by the suffix of its path.

    Raises
    ------
    BadInputError
        If the suffix is not one of `KINDS`.

    """
    kind = path.suffix.lower().removeprefix('.')
    if kind not in KINDS:
        raise BadInputError(
            f'the format of {path} is unknown: expected a name that ends in '
            f'{", ".join(f".{x}" for x in KINDS[:-1])} or .{KINDS[-1]}')
    return kind


def kinds_in(text: str) -> tuple[str, ...]:
    """
    Return the formats in a comma-separated list.

    Raises
    ------
    BadInputError
        If one is none of `KINDS`.

    """
    return tuple(dict.fromkeys(kind_of(Path(f'picture.{x.strip()}')) for x in text.split(',')))


def named(folder: Path, name: str, kinds: Sequence[str]) -> list[Path]:
    """Return the paths of a figure in a folder, one for each format."""
    return [folder / f'{name}.{x}' for x in kinds]
