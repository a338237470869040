"""
One style for all figures.

Figures are created without pyplot: the caller's matplotlib (backend, settings, open windows) has
no influence and does not change, and the same data always produce the same bytes.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
import io
import itertools
from pathlib import Path
from string import ascii_lowercase
from typing import Any

from matplotlib import rcParams, style
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import (
    AutoMinorLocator,
    FixedFormatter,
    FixedLocator,
    NullLocator,
    StrMethodFormatter,
)
import numpy as np

from hmsa.files import replacing, write_rows
from hmsa.report import looks
from hmsa.report.figures import Axis, Curve, Panel
from hmsa.report.looks import INCH, kind_of, Paper

SHAPED, UNSHAPED, TARGET, ARRIVAL = (
    x.line() for x in (looks.RECORDED, looks.PLAIN, looks.TARGET, looks.ARRIVAL))
EQUILIBRIUM = looks.EQUILIBRIUM.points()
#: Annotations of curves.
SOFT: dict[str, Any] = {'fontsize': 'small', 'color': '#555555'}

# Omits the entries with matplotlib's version and the time.
_METADATA: dict[str, dict[str, Any]] = {
    'png': {'Software': None},
    'pdf': {'Creator': None, 'Producer': None, 'CreationDate': None},
    'svg': {'Creator': None, 'Date': None}}
_SETTINGS = str(Path(__file__).with_name('style.mplstyle'))
# Resolution in notebooks, in dots per inch.
_NOTEBOOK = 150.0
_COLUMNS = ('panel', 'curve', 'x_axis', 'y_axis', 'x', 'y')
# Height of a panel of height 1, in inches at 8 pt; and in a column of a journal, where three
# panels and their legend are less than 120 mm tall.
_PANEL, _NARROW = 1.35, 1.0
# The same of the margins, and of a row of the legend.
_AROUND, _ROW = 0.3, 0.14
# Letters of 8 pt beside a panel of height 1 inch, less its title and the labels below it.
_LETTERS = 13.0
# The linear part of a symmetrical logarithmic axis is as long as a decade.
_LINEAR = 0.9


class Picture(Figure):
    """A figure that also keeps plotted data other than lines, to export them."""

    def __init__(self, **more: Any) -> None:
        super().__init__(**more)
        self.others: list[tuple[Axes, str, list[Any]]] = []
        self.unlisted: list[Any] = []  #: lines without an entry in the legend

    def _repr_png_(self) -> bytes:
        """Return the PNG that a notebook shows."""
        file = io.BytesIO()
        with style.context(['default', _SETTINGS]):
            self.savefig(file, format='png', dpi=_NOTEBOOK, metadata=_METADATA['png'])
        return file.getvalue()

    def draw(self, renderer: RendererBase) -> None:
        """Draw it; only lay it out where `savefig` does so before it draws."""
        layout = self.get_layout_engine()
        if self.canvas.is_saving() and isinstance(layout, ConstrainedLayoutEngine):
            with suppress(ValueError):  # as where it is drawn
                layout.execute(self)
        else:
            super().draw(renderer)

    def remember(self, axes: Axes, curve: str, *columns: Any) -> None:
        """Keep columns of data, or a grid (x, y, and z of shape (len(y), len(x))), for export."""
        if len(columns) == 3:
            x, y = np.meshgrid(*columns[:2])
            columns = x, y, columns[2]
        self.others.append((axes, curve, [np.ravel(x) for x in columns]))

    def rows(self) -> Iterator[tuple[Any, ...]]:
        """Yield the plotted data: panel, curve, names of both axes, x, y, and z of a map."""
        for number, axes in enumerate(x for x in self.axes if x.get_label() != '<colorbar>'):
            letter = axes.get_title(loc='left').strip('()') or str(number + 1)
            fixed = letter, *(_plain(x) for x in (axes.get_xlabel(), axes.get_ylabel()))
            # Lines across a whole panel and unnamed lines are guides to the eye.
            drawn = [
                (str(line.get_label()), [line.get_xdata(orig=True), line.get_ydata(orig=True)])
                for line in axes.get_lines()
                if line.get_transform() == axes.transData
                and not str(line.get_label()).startswith('_')]
            for curve, columns in [*drawn, *(x[1:] for x in self.others if x[0] is axes)]:
                for row in zip(*(np.asarray(x).tolist() for x in columns), strict=True):
                    yield fixed[0], curve, *fixed[1:], *row


@contextmanager
def picture(
        paths: Path | Sequence[Path], height: float, paper: Paper | None = None
) -> Iterator[Picture]:
    """
    Yield a figure; the end of the block writes it to each path.

    Its height is in inches, unless the paper has one of its own.
    """
    paper = paper or Paper()
    paths = [paths] if isinstance(paths, Path) else list(paths)
    kinds = [kind_of(x) for x in paths]
    settings = {'font.size': paper.letters, 'savefig.dpi': paper.dpi}
    with style.context(['default', _SETTINGS, settings]):
        if paper.height is not None:
            height = paper.height / INCH
        figure = Picture(figsize=(paper.inches, height), layout='constrained')
        FigureCanvasAgg(figure)
        yield figure
        for path, kind in zip(paths, kinds, strict=True):
            with replacing(path) as beside:
                if kind == 'pgf':
                    from hmsa.report.latex import pgf  # slow to import
                    beside.write_text(pgf(figure, path), encoding='utf-8')
                else:
                    figure.savefig(beside, format=kind, metadata=_METADATA[kind])
        for path in paper.tables(paths):
            rows = list(figure.rows())
            size = max((len(x) for x in rows), default=len(_COLUMNS))
            write_rows(path, [(*_COLUMNS, 'z')[:size], *rows])


def axis(quantity: str, symbol: str = '', unit: str = '') -> str:
    """Return the label of an axis: quantity, symbol, and unit if given."""
    return ' '.join(x for x in (quantity, f'${symbol}$' if symbol else '',
                                f'({unit})' if unit else '') if x)


def finish(axes: Axes, x_label: str, y_label: str, letter: str = '') -> None:
    """Label the axes of a panel and write its letter above it."""
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    if letter:
        axes.set_title(f'({letter})', loc='left', fontweight='bold')
    for one, scale in ((axes.xaxis, axes.get_xscale()), (axes.yaxis, axes.get_yscale())):
        if scale == 'linear' and not isinstance(
                one.get_major_locator(), (FixedLocator, NullLocator)):
            one.set_minor_locator(AutoMinorLocator(2))
    axes.grid(visible=True, color='#E4E4E4', linewidth=0.5, zorder=0)
    axes.set_axisbelow(True)


def sheet(
        paths: Path | Sequence[Path], rows: Sequence[Sequence[Sequence[Panel]]],
        paper: Paper) -> Picture:
    """
    Draw panels in rows of columns, each of which is a stack of panels; return the figure.

    Neighbours in a stack share the labels of an equal x axis.
    """
    heights = [max(sum(x.height for x in stack) for stack in row) for row in rows]
    size = _PANEL if max(map(len, rows)) > 1 else _NARROW
    height = _AROUND + size * sum(heights)
    letters = iter(ascii_lowercase if sum(map(len, itertools.chain(*rows))) > 1 else '')
    with picture(paths, height, paper) as figure:
        # Half a number at the end of an axis.
        figure.set_layout_engine('constrained', w_pad=0.08)
        grid = figure.add_gridspec(len(rows), 1, height_ratios=heights)
        for i, row in enumerate(rows):
            columns = grid[i].subgridspec(1, len(row))
            drawn = [_stack(
                figure, columns[j].subgridspec(
                    len(stack), 1, height_ratios=[x.height for x in stack]),
                stack, letters, size) for j, stack in enumerate(row)]
            for stack, other in zip(drawn[1:], row, strict=False):
                # Panels of one row need their label of y once.
                if len(stack) == len(other) == 1 and (
                        stack[0].get_ylabel() == drawn[0][0].get_ylabel()):
                    stack[0].set_ylabel('')
        lines = legend_below(figure)
        if paper.height is None:
            figure.set_figheight((height + _ROW * lines) * paper.letters / 8.0)
    return figure


def _stack(
        figure: Picture, grid: Any, stack: Sequence[Panel], letters: Iterator[str],
        size: float) -> list[Axes]:
    """Draw the panels of a column; ``size`` is the height of one of height 1, in inches."""
    drawn = []
    for place, panel in enumerate(stack):
        axes = figure.add_subplot(grid[place])
        draw(figure, axes, panel, next(letters, ''))
        drawn.append(axes)
        if len(panel.y.label) > _LETTERS * size * panel.height:
            axes.set_ylabel(_label(panel.y, '\n'))
        if place + 1 < len(stack) and stack[place + 1].x == panel.x:
            axes.tick_params(labelbottom=False)
            axes.xaxis.label.set_visible(False)
    figure.align_ylabels(drawn)
    return drawn


def draw(figure: Picture, axes: Axes, panel: Panel, letter: str = '') -> None:
    """Draw a panel."""
    for curve in panel.curves:
        if not curve.hidden:
            _draw_curve(figure, axes, curve)
    for name, own in (('x', panel.x), ('y', panel.y)):
        along = getattr(axes, f'{name}axis')
        if own.scale != 'linear':
            more = {'linthresh': 1.0, 'linscale': _LINEAR} if own.scale == 'symlog' else {}
            getattr(axes, f'set_{name}scale')(own.scale, **more)
        if name == 'y' and not panel.curves:
            # Ticks from 0 to 1 would look like data.
            along.set_major_locator(NullLocator())
        elif own.ticks:
            along.set_major_locator(FixedLocator([x for x, _ in own.ticks]))
            along.set_major_formatter(FixedFormatter([x for _, x in own.ticks]))
        elif own.scale == 'symlog':
            powers = [10.0 ** x for x in range(int(np.log10(panel.limits(name)[1])) + 1)]
            places = [*(-x for x in reversed(powers)), 0.0, *powers]
            along.set_major_locator(FixedLocator(places))
            along.set_major_formatter(FixedFormatter([f'{x:g}'.replace('-', '−') for x in places]))
            along.set_minor_locator(NullLocator())
        elif own.scale == 'log':
            along.set_major_formatter(StrMethodFormatter('{x:g}'))
        getattr(axes, f'set_{name}lim')(*panel.limits(name))
    finish(axes, _label(panel.x), _label(panel.y), letter)
    axes.set_title(panel.title, loc='right', fontsize='small')


def _label(own: Axis, break_: str = ' ') -> str:
    """Return the label of an axis, in two lines with a line break."""
    symbol = axis('', own.tex or own.symbol, own.unit)
    return f'{own.quantity}{break_}{symbol}' if symbol else own.quantity


def _draw_curve(figure: Picture, axes: Axes, curve: Curve) -> None:
    look, label = curve.look, curve.name if curve.listed else ''
    line = look.line(alpha=look.opacity)
    if curve.form == 'points':
        axes.plot(curve.x, curve.y, label=label, **look.points())
    elif curve.form == 'bars':
        axes.bar(curve.x, curve.y, 0.9 * float(np.min(np.diff(curve.x))), color=look.colour,
                 label=label)
        figure.remember(axes, curve.name, curve.x, curve.y)
    elif curve.lower is not None:
        axes.fill_between(
            curve.x, curve.y, curve.lower, color=look.colour, alpha=look.opacity, lw=0.0,
            zorder=look.order, label=label)
        for sign, y in (('-', curve.lower), ('+', curve.y)):
            figure.remember(axes, curve.name.replace('±', sign), curve.x, y)
    elif curve.form in ('vertical', 'horizontal'):
        across = axes.axvline if curve.form == 'vertical' else axes.axhline
        for i, place in enumerate(curve.x if curve.form == 'vertical' else curve.y):
            across(place, label='' if i else label, **line)
    else:
        # The name is kept for the table of the data.
        drawn, = axes.plot(curve.x, curve.y, label=curve.name, drawstyle=(
            'steps-post' if curve.form == 'steps' else 'default'), **line)
        if not curve.listed:
            figure.unlisted.append(drawn)


def legend_below(figure: Figure, *panels: Axes, most: int = 9, title: str = '') -> int:
    """Put a legend for several panels below them, in ``most`` columns or less; return its rows."""
    entries: dict[str, Any] = {}
    for axes in panels or figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            if handle not in getattr(figure, 'unlisted', ()):
                entries.setdefault(label, handle)
    if not entries:
        return 0
    # Entries that fit side by side; a handle is about as wide as eight letters.
    letters = figure.get_figwidth() * 72.0 / (0.46 * float(rcParams['font.size']))
    fits = int(letters // (max(len(_plain(x)) for x in entries) + 8))
    columns = max(1, min(len(entries), most, fits))
    figure.legend(
        _by_rows(list(entries.values()), columns), _by_rows(list(entries), columns),
        loc='outside lower center', ncols=columns, columnspacing=1.6, title=title or None,
        title_fontsize='small')
    return -(-len(entries) // columns)


def _plain(label: str) -> str:
    """Return a label without TeX markup, about as long as the drawn label."""
    return label.replace(r'\mathrm', '').replace(r'\dot', 'd').translate(
        {ord(x): None for x in '\\${}'})


def _by_rows(entries: list[Any], columns: int) -> list[Any]:
    """Reorder entries so that a legend, which fills columns first, shows them row by row."""
    rows = [entries[i:i + columns] for i in range(0, len(entries), columns)]
    return [x for column in itertools.zip_longest(*rows) for x in column if x is not None]


def note(axes: Axes, text: str, place: tuple[Any, Any], offset: Any, **more: Any) -> None:
    """Write a text at an offset in points from a position."""
    axes.annotate(text, place, xytext=offset, textcoords='offset points', **more)
