"""Draw runs on paper: command, response, phase plane, and the largest errors at arrivals."""

from collections.abc import Sequence
from pathlib import Path

from hmsa.errors import BadInputError
from hmsa.report import charts, style
from hmsa.report.arrivals import Part
from hmsa.report.figures import Panel
from hmsa.report.paper import NARROW, Paper, WIDE

# Panels that share the axis of time, above each other; those beside them; and those below, beside
# each other.
_OVER_TIME, _BESIDE, _BELOW = ('command', 'response', 'plan', 'timing'), ('phase', 'residual'), (
    'error',)


def draw(
        paths: Path | Sequence[Path], parts: Sequence[Part],
        paper: Paper | None = None) -> style.Picture:
    """
    Draw runs with as many arrivals as fit side by side; return the figure.

    Raises
    ------
    BadInputError
        If the runs have no data for a panel, or a file cannot be written.

    """
    paper = paper or Paper()
    columns = paper.columns(3)
    panels = {
        x: charts.errors(parts, columns) if x == 'error' else charts.PANELS[x](parts)
        for x in paper.panels or (WIDE if columns > 1 else NARROW)}
    for name in paper.panels:
        if not panels[name]:
            raise BadInputError(
                f'{", ".join(x.run.label for x in parts)} have nothing to draw in the panel '
                f'{name}: expected setpoints, a plan that differs from the run, or times that '
                'vary; leave it out')
    return style.sheet(paths, _arranged(panels, columns), paper)


def _arranged(panels: dict[str, list[Panel]], columns: int) -> list[list[list[Panel]]]:
    """Return rows of columns of panels above each other."""
    if columns == 1:
        return [[[x for group in panels.values() for x in group]]]
    left, right, below = (
        [x for name, group in panels.items() if name in names for x in group]
        for names in (_OVER_TIME, _BESIDE, _BELOW))
    above = [x for x in (left, right) if x]
    return [*([above] if above else []), *([[[x] for x in below]] if below else [])]
