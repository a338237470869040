"""
Line styles of each kind of curve, for all pages and figures.

Curves differ in colour and in dash or marker. The colours remain distinct with deuteranopia and
protanopia.
"""

from dataclasses import dataclass, replace
from typing import Any

BLACK, GREY, BLUE, VERMILION = '#000000', '#717171', '#0072B2', '#D55E00'
GREEN, SKY_BLUE, ORANGE, PURPLE = '#264825', '#58BFFC', '#FFA900', '#590058'
INDIGO, SILVER, VIOLET = '#2B098B', '#B0B0B0', '#4411FF'
#: Replacements of colours in dark mode.
DARK = {
    BLUE: '#4DABE8', ORANGE: '#F2B93B', GREEN: '#7DB07C', PURPLE: '#E08FE0',
    SKY_BLUE: '#B5E2FF', VERMILION: '#FF8A4A', BLACK: '#F0F0F0', GREY: '#9A9A9A',
    SILVER: '#6A7076', VIOLET: '#9C85FF'}


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
