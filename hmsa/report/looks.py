"""
Line styles of each kind of curve, for all pages and figures.

Curves differ in colour and in dash or marker. The colours remain distinct with deuteranopia and
protanopia.
"""

from dataclasses import dataclass, replace
from typing import Any

BLACK, GREY, BLUE, VERMILION = '#000000', '#717171', '#0072B2', '#D55E00'
GREEN, SKY_BLUE, ORANGE, PURPLE = '#264825', '#58BFFC', '#FFA900', '#590058'
INDIGO, SILVER = '#2B098B', '#B0B0B0'
#: Replacements of colours in dark mode.
DARK = {
    BLUE: '#4DABE8', ORANGE: '#F2B93B', GREEN: '#7DB07C', PURPLE: '#E08FE0',
    SKY_BLUE: '#B5E2FF', VERMILION: '#FF8A4A', BLACK: '#F0F0F0', GREY: '#9A9A9A'}


@dataclass(frozen=True)
class LineStyle:
    """The style of a curve."""

    colour: str
    width: float = 1.4  #: in pt
    dash: tuple[float, ...] = ()  #: on and off in line widths; empty for a solid line
    marker: str = ''  #: matplotlib's name
    order: int = 2  #: curves of higher order are drawn on top

    def line(self, **more: Any) -> dict[str, Any]:
        """Return matplotlib's line properties, without the marker."""
        return {
            'color': self.colour, 'linewidth': self.width, 'zorder': self.order,
            'linestyle': (0, self.dash) if self.dash else '-', **more}

    def plotly(self) -> dict[str, Any]:
        """Return Plotly's line properties."""
        dash = ','.join(f'{x * max(self.width, 1.0):g}px' for x in self.dash)
        return {'color': self.colour, 'width': 1.3 * self.width} | (
            {'dash': dash} if dash else {})


RECORDED = LineStyle(BLUE, 1.6, order=3)
PLAIN = LineStyle(VERMILION, 1.0, (4.0, 1.5))
PLAN = LineStyle(BLACK, 1.1, (1.0, 2.0), order=4)
FIELD = LineStyle(ORANGE, 1.1, (6.0, 1.5, 1.0, 1.5))
TARGET = LineStyle(GREY, 0.9, (2.0, 2.0), order=1)
ARRIVAL = LineStyle(BLACK, 0.8, (1.0, 1.5), order=1)

#: Styles of the shapers, by name.
SHAPERS = {
    'two_step': LineStyle(BLUE, 1.8, (), 'o', 6),
    'robust': LineStyle(GREEN, 1.3, (5.0, 1.5), 's', 5),
    'minimax': LineStyle(SKY_BLUE, 1.5, (5.0, 1.0, 1.0, 1.0), 'D', 5),
    'minimum_time': LineStyle(ORANGE, 1.5, (8.0, 2.0), '^', 4),
    'smooth': LineStyle(INDIGO, 1.3, (1.0, 1.0), 'P', 4),
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
RUNS = tuple(x.colour for x in CASES)


def case(number: int) -> LineStyle:
    """Return the style of a curve by its index: `CASES`, then the same with other dashes."""
    turn, place = divmod(number, len(CASES))
    other = CASES[(place + 3 * turn) % len(CASES)]
    return replace(CASES[place], dash=other.dash, marker=other.marker)
