"""
Compute and draw the paper's Figures 2 to 10.

Compute the paper's Figures 2 to 10 and write each as PNG and CSV (figure_02.png, figure_02.csv,
...). Existing files are replaced.

example: hmsa figures --out figures
"""

import argparse
from pathlib import Path
from typing import Any

from hmsa.cli.options import add_command
from hmsa.cli.pictures import formats_of, paper_of, picture_options
from hmsa.cli.terminal import progress
from hmsa.files import make_folder


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('--out', 'DIR', Path, 'output folder, created if missing (default figures)',
         {'default': Path('figures')}),
        *picture_options(formats='png', data=False))


def run(arguments: argparse.Namespace) -> int:
    """Write the figures and print their files."""
    folder: Path = arguments.out
    paper, kinds = paper_of(arguments), formats_of(arguments)
    # Before the slow imports: a bad folder is reported immediately.
    make_folder(folder)

    from hmsa_studies.paper import FIGURES, write_figure

    written: list[Path] = []
    with progress() as update:
        for i, (number, figure) in enumerate(FIGURES.items()):
            update(f'Figure {number}', i / len(FIGURES))
            written += write_figure(figure, folder, paper=paper, kinds=kinds)
    for path in written:
        print(path)
    return 0
