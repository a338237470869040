"""Write PGF figures for LaTeX without a LaTeX installation."""

import io
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.backends.backend_mixed import MixedModeRenderer
from matplotlib.backends.backend_pgf import RendererPgf
from matplotlib.figure import Figure


class _Words(RendererPgf):
    """A PGF renderer that measures text with Agg instead of LaTeX."""

    def __init__(self, figure: Figure, file: Any) -> None:
        super().__init__(figure, file)  # type: ignore[no-untyped-call]
        self._ruler = RendererAgg(1, 1, figure.dpi)  # type: ignore[no-untyped-call]

    def get_text_width_height_descent(
            self, s: str, prop: Any, ismath: Any) -> tuple[float, float, float]:
        """Return the size of a text in dots."""
        size: tuple[float, float, float] = self._ruler.get_text_width_height_descent(  # type: ignore[no-untyped-call]
            s, prop, ismath)
        return size


class _File(io.StringIO):
    """A text buffer with a file name; the backend writes images of the figure next to it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.name = str(path)


def pgf(figure: Figure, path: Path) -> str:
    """Return a figure as PGF; images in it are written next to the path."""
    file = _File(path)
    width, height = (float(x) for x in figure.get_size_inches())
    file.write(
        f'% \\usepackage{{pgf}}, and \\input{{{path.name}}}\n\\begingroup\n\\makeatletter\n'
        '\\begin{pgfpicture}\n\\pgfpathrectangle{\\pgfpointorigin}'
        f'{{\\pgfqpoint{{{width:.6f}in}}{{{height:.6f}in}}}}\n'
        '\\pgfusepath{use as bounding box, clip}\n')
    renderer: Any = MixedModeRenderer(  # type: ignore[no-untyped-call]
        figure, width, height, figure.dpi, _Words(figure, file))
    figure.draw(renderer)
    return f'{file.getvalue()}\\end{{pgfpicture}}\n\\makeatother\n\\endgroup\n'
