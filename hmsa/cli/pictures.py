"""Options common to all commands that draw figures."""

import argparse
from collections.abc import Iterable
from pathlib import Path

from hmsa.cli.options import Row
from hmsa.files import check_targets
from hmsa.report.looks import kind_of, KINDS, kinds_in, PANELS, Paper, WIDE

_ENDS = f'{", ".join(f".{x}" for x in KINDS[:-1])} or .{KINDS[-1]}'


def picture_options(
        named: str = '', *, formats: str = '', data: bool = True,
        panels: bool = False) -> tuple[Row, ...]:
    """
    Return the options for figures.

    Parameters
    ----------
    named : str
        Description of the figures in the help of ``--picture``; without it, the option is omitted.
    formats : str
        Default formats of figures in a folder; without them, the option is omitted.
    data : bool
        Whether to add ``--data``, which a command that always writes the data does not need.
    panels : bool
        Whether to add ``--panels``, for figures of runs.

    """
    standard = Paper()
    rows: list[Row] = [
        ('--format', 'NAME,...', str, f'formats, of {", ".join(KINDS)} (default %(default)s)',
         {'default': formats})] if formats else []
    rows += [
        ('--width', 'MM', float,
         'width in mm: 85 for a column, 120, or 183 for two (default %(default)g); panels that '
         'do not fit side by side are stacked',
         {'default': standard.width}),
        ('--height', 'MM', float, 'height in mm (default: one that suits the panels)'),
        ('--font-size', 'PT', float, 'font size in pt (default %(default)g)',
         {'default': standard.letters}),
        ('--dpi', 'N', float, 'dots per inch of PNG (default %(default)g)',
         {'default': standard.dpi})]
    if panels:
        rows.append((
            '--panels', 'NAME,...', str,
            f'panels, of {", ".join(PANELS)} (default: {", ".join(WIDE)}; without phase in a '
            'single column)', {'default': ''}))
    if data:
        rows.append(('--data', 'also write the plotted values as CSV, under the same name'))
    files: tuple[Row, ...] = (
        ('--picture', 'FILE', Path, f'{named}; each name ends in {_ENDS}',
         {'nargs': '+', 'default': []}),) if named else ()
    # A folder always has figures.
    needs = ('--picture', *(('--out',) if formats else ())) if named else ()
    return *files, ('pictures', rows, {'needs': needs})


def paper_of(
        arguments: argparse.Namespace, *targets: Path | None,
        sources: Iterable[Path | None] = ()) -> Paper:
    """
    Return the paper format of the options; raise `BadInputError` if invalid.

    Figures and their data must not replace other targets or the sources of the command.
    """
    pictures: list[Path] = getattr(arguments, 'picture', [])
    for picture in pictures:
        kind_of(picture)
    paper = Paper(arguments.width, arguments.font_size, arguments.dpi,
                  getattr(arguments, 'data', False), arguments.height,
                  [x.strip() for x in getattr(arguments, 'panels', '').split(',') if x.strip()])
    check_targets(*targets, *pictures, *paper.tables(pictures), sources=sources)
    return paper


def formats_of(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the formats of figures in a folder; raise `BadInputError` for unknown ones."""
    return kinds_in(arguments.format)
