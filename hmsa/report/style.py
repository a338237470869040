"""
One style for all figures.

Figures are created without pyplot: the caller's matplotlib (backend, settings, open windows) has
no influence and does not change, and the same data always produce the same bytes.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import csv
import io
from itertools import zip_longest
from pathlib import Path
from typing import Any

from matplotlib import rcParams, style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import AutoMinorLocator, NullLocator
import numpy as np

from hmsa.files import replacing
from hmsa.report import looks
from hmsa.report.looks import BLACK
from hmsa.report.paper import kind_of, Paper

SHAPED, UNSHAPED, TARGET, ARRIVAL = (
    x.line() for x in (looks.RECORDED, looks.PLAIN, looks.TARGET, looks.ARRIVAL))
EQUILIBRIUM: dict[str, Any] = {
    'color': BLACK, 'linestyle': 'none', 'marker': 'o', 'markersize': 4.5, 'zorder': 5}
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


class Picture(Figure):
    """A figure that also keeps plotted data other than lines, to export them."""

    def __init__(self, **more: Any) -> None:
        super().__init__(**more)
        self.others: list[tuple[Axes, str, list[Any]]] = []

    def _repr_png_(self) -> bytes:
        """Return the PNG that a notebook shows."""
        file = io.BytesIO()
        with style.context(['default', _SETTINGS]):
            self.savefig(file, format='png', dpi=_NOTEBOOK, metadata=_METADATA['png'])
        return file.getvalue()

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
    """Yield a figure of a height in inches; the end of the block writes it to each path."""
    paper = paper or Paper()
    paths = [paths] if isinstance(paths, Path) else list(paths)
    kinds = [kind_of(x) for x in paths]
    settings = {'font.size': paper.letters, 'savefig.dpi': paper.dpi}
    with style.context(['default', _SETTINGS, settings]):
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
            with replacing(path) as beside, beside.open('w', newline='', encoding='utf-8') as file:
                rows = list(figure.rows())
                writer = csv.writer(file, lineterminator='\n')
                size = max((len(x) for x in rows), default=len(_COLUMNS))
                writer.writerow((*_COLUMNS, 'z')[:size])
                writer.writerows(rows)


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
    for one in (axes.xaxis, axes.yaxis):
        if not isinstance(one.get_major_locator(), NullLocator):
            one.set_minor_locator(AutoMinorLocator(2))
    axes.grid(visible=True, color='#E4E4E4', linewidth=0.5, zorder=0)
    axes.set_axisbelow(True)


def legend_below(figure: Figure, *panels: Axes, most: int = 9, title: str = '') -> None:
    """Put one legend for several panels below them, in at most ``most`` columns."""
    entries: dict[str, Any] = {}
    for axes in panels or figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if not entries:
        return
    # Entries that fit side by side; a handle is about as wide as eight letters.
    letters = figure.get_figwidth() * 72.0 / (0.46 * float(rcParams['font.size']))
    fits = int(letters // (max(len(_plain(x)) for x in entries) + 8))
    columns = max(1, min(len(entries), most, fits))
    figure.legend(
        _by_rows(list(entries.values()), columns), _by_rows(list(entries), columns),
        loc='outside lower center', ncols=columns, columnspacing=1.6, title=title or None,
        title_fontsize='small')


def _plain(label: str) -> str:
    """Return a label without TeX markup, about as long as the drawn label."""
    return label.replace(r'\mathrm', '').replace(r'\dot', 'd').translate(
        {ord(x): None for x in '\\${}'})


def _by_rows(entries: list[Any], columns: int) -> list[Any]:
    """Reorder entries so that a legend, which fills columns first, shows them row by row."""
    rows = [entries[i:i + columns] for i in range(0, len(entries), columns)]
    return [x for column in zip_longest(*rows, fillvalue=None) for x in column if x is not None]


def note(axes: Axes, text: str, place: tuple[Any, Any], offset: Any, **more: Any) -> None:
    """Write a text at an offset in points from a position."""
    axes.annotate(text, place, xytext=offset, textcoords='offset points', **more)
