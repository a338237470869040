"""
Line styles of each kind of curve, for all pages and figures, and the size and format of a figure.

Curves differ in colour and in dash or marker. The colours remain distinct with deuteranopia and
protanopia.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hmsa.errors import BadInputError, check_choice, check_number

BLACK, GREY, BLUE, VERMILION = '#000000', '#717171', '#0072B2', '#D55E00'
GREEN, SKY_BLUE, ORANGE, PURPLE = '#264825', '#58BFFC', '#FFA900', '#590058'
INDIGO, SILVER, VIOLET = '#2B098B', '#B0B0B0', '#4411FF'
#: Replacements of colours in dark mode.
DARK = {
    BLUE: '#4DABE8', ORANGE: '#F2B93B', GREEN: '#7DB07C', PURPLE: '#E08FE0',
    SKY_BLUE: '#B5E2FF', VERMILION: '#FF8A4A', BLACK: '#F0F0F0', GREY: '#9A9A9A',
    SILVER: '#6A7076', VIOLET: '#9C85FF'}
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
class LineStyle:
    """The style of a curve."""

    colour: str
    width: float = 1.4  #: in pt
    dash: tuple[float, ...] = ()  #: on and off in line widths; empty for a solid line
    marker: str = ''  #: matplotlib's name
    order: int = 2  #: curves of higher order are drawn on top
    size: float = 5.0  #: of the marker, in pt
    filled: bool = True  #: the marker
    opacity: float = 1.0

    def line(self, **more: Any) -> dict[str, Any]:
        """Return matplotlib's line properties, without the marker."""
        return {
            'color': self.colour, 'linewidth': self.width, 'zorder': self.order,
            'linestyle': (0, self.dash) if self.dash else '-', **more}

    def points(self) -> dict[str, Any]:
        """Return matplotlib's properties of markers without a line."""
        return {
            'color': self.colour, 'zorder': self.order, 'linestyle': 'none',
            'marker': self.marker, 'markersize': self.size,
            'fillstyle': 'full' if self.filled else 'none'}

    def to_dict(self) -> dict[str, Any]:
        """Return the style for the page."""
        return {
            'colour': self.colour, 'width': self.width, 'dash': self.dash, 'order': self.order,
            'marker': self.marker, 'size': self.size, 'filled': self.filled,
            'opacity': self.opacity}


RECORDED = LineStyle(BLUE, 1.6, order=3)
PLAIN = LineStyle(VERMILION, 1.0, (4.0, 1.5))
PLAN = LineStyle(BLACK, 1.1, (1.0, 2.0), order=4)
FIELD = LineStyle(ORANGE, 1.1, (6.0, 1.5, 1.0, 1.5))
TARGET = LineStyle(GREY, 0.9, (2.0, 2.0), order=1)
#: A target that is held: broad, to be seen on both sides of the curve on it.
SETPOINT = LineStyle(SILVER, 4.0, order=1, opacity=0.7)
TOLERANCE = LineStyle(SILVER, order=0, opacity=0.35)
#: Solid, since the plan is dotted.
ARRIVAL = LineStyle(BLACK, 0.6, order=1)
EQUILIBRIUM = LineStyle(BLACK, marker='o', size=4.5, order=5)

#: Styles of the shapers, by name.
SHAPERS = {
    'two_step': LineStyle(BLUE, 1.8, (), 'o', 6),
    'robust': LineStyle(GREEN, 1.3, (5.0, 1.5), 's', 5),
    'minimax': LineStyle(SKY_BLUE, 1.5, (5.0, 1.0, 1.0, 1.0), 'D', 5),
    'minimum_time': LineStyle(ORANGE, 1.5, (8.0, 2.0), '^', 4),
    'smooth': LineStyle(INDIGO, 1.3, (1.0, 1.0), 'P', 4),
    'modal': LineStyle(VIOLET, 1.6, (3.0, 1.0, 1.0, 1.0), 'h', 5),
    'step': LineStyle(VERMILION, 1.2, (3.0, 2.0), 'X', 3),
    'zv': LineStyle(SILVER, 1.5, (8.0, 1.5, 1.0, 1.5), 'v', 3),
    'zvd': LineStyle(GREY, 1.2, (2.0, 1.0), '<', 3),
    'ei': LineStyle(BLACK, 1.0, (6.0, 1.0, 1.0, 1.0, 1.0, 1.0), '>', 3),
    'umzv': LineStyle(PURPLE, 1.2, (1.0, 2.5), 'p', 3),
}
#: Styles of unnamed curves, such as those of several runs, in order. The first is solid: dashed
#: curves on top of it remain distinguishable.
CASES = tuple(replace(SHAPERS[x], order=RECORDED.order) for x in (
    'two_step', 'step', 'robust', 'minimum_time', 'umzv', 'ei', 'minimax', 'zvd'))


def case(number: int) -> LineStyle:
    """Return the style of a curve by its index: `CASES`, then the same with other dashes."""
    turn, place = divmod(number, len(CASES))
    other = CASES[(place + 3 * turn) % len(CASES)]
    return replace(CASES[place], dash=other.dash, marker=other.marker)


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
