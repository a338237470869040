"""
One look for all pictures.

Pictures are drawn on figures of their own, never through pyplot: nothing of the caller's
matplotlib (backend, settings, open windows) has a say or is changed, and the same data always
gives the same bytes.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import AutoMinorLocator, NullLocator

from hmsa_ros.files import replacing

# Okabe and Ito's palette, told apart with every kind of colour vision.
BLACK = '#000000'
ORANGE = '#E69F00'
SKY_BLUE = '#56B4E9'
GREEN = '#009E73'
BLUE = '#0072B2'
VERMILION = '#D55E00'
PURPLE = '#CC79A7'
GREY = '#8A8A8A'

# What each kind of curve looks like, everywhere. Colour is never alone: style or width differ.
SHAPED: dict[str, Any] = {'color': BLUE, 'linewidth': 1.8, 'zorder': 3}
UNSHAPED: dict[str, Any] = {
    'color': VERMILION, 'linewidth': 1.0, 'linestyle': (0, (4, 1.5)), 'zorder': 2}
TARGET: dict[str, Any] = {
    'color': GREY, 'linewidth': 0.8, 'linestyle': (0, (1, 1.5)), 'zorder': 1}
EQUILIBRIUM: dict[str, Any] = {
    'color': BLACK, 'linestyle': 'none', 'marker': 'o', 'markersize': 5, 'zorder': 5}

#: Width of a picture in inches: two columns of a journal.
WIDTH = 7.2
_METADATA: dict[str, dict[str, Any]] = {
    'png': {'Software': None},
    'pdf': {'Creator': None, 'Producer': None, 'CreationDate': None}}
_SETTINGS = str(Path(__file__).with_name('style.mplstyle'))


@contextmanager
def picture(
        paths: Path | Sequence[Path], height: float, *, width: float = WIDTH,
        kind: str = '') -> Iterator[Figure]:
    """Yield a figure (sizes in inches), which the end of the block writes as PNG or PDF."""
    with style.context(['default', _SETTINGS]):
        figure = Figure(figsize=(width, height), layout='constrained')
        FigureCanvasAgg(figure)
        yield figure
        for path in [paths] if isinstance(paths, Path) else paths:
            form = kind or ('pdf' if path.suffix.lower() == '.pdf' else 'png')
            with replacing(path) as beside:
                # Without the entries that name matplotlib's version and the time.
                figure.savefig(beside, format=form, metadata=_METADATA[form])


def finish(axes: Axes, x_label: str, y_label: str, letter: str = '') -> None:
    """Name a panel's axes (no name, no tick labels) and write its letter above it."""
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    if letter:
        axes.set_title(f'({letter})', loc='left', fontweight='bold')
    for axis in (axes.xaxis, axes.yaxis):
        if not isinstance(axis.get_major_locator(), NullLocator):
            axis.set_minor_locator(AutoMinorLocator(2))
    axes.grid(visible=True, color='#E4E4E4', linewidth=0.5, zorder=0)
    axes.set_axisbelow(True)


def legend_below(figure: Figure, *panels: Axes, most: int = 9) -> None:
    """Put one legend for all panels below them, each label once, in so many columns at most."""
    entries: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(
        entries.values(), entries.keys(), loc='outside lower center',
        ncols=min(len(entries), most), columnspacing=1.8)


def note(axes: Axes, text: str, place: tuple[Any, Any], offset: Any, **more: Any) -> None:
    """Write a text some points away from a place."""
    axes.annotate(text, place, xytext=offset, textcoords='offset points', **more)
