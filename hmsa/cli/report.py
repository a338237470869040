"""
Write an HTML report of a run from its bag.

Write a report of a run as one self-contained HTML page: response, command, phase plane, residual
vibration compared with unshaped steps, plan compared with run, timing and losses. Any bag with
joint states works, in any namespace; several bags share one page.

example: hmsa report hmsa_demo/run --out run.html --picture run.pdf --width 85
"""

import argparse
from pathlib import Path
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import add_command, bags, show
from hmsa.cli.pictures import paper_of, picture_options
from hmsa.cli.terminal import progress
from hmsa.files import write_text

if TYPE_CHECKING:
    from hmsa.runs.record import Run


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        bags('bags'),
        ('--out', 'FILE', Path,
         'page to write; an existing file is replaced (default: NAME_report.html in this folder, '
         'NAME being the first bag)'),
        ('--json', 'print the results of each setpoint, and the files, as JSON'),
        ('--params-file --params', 'YAML', Path,
         'parameter file (YAML) of the actuator (default: the parameters in the bag)'),
        ('--joint', 'NAME', str,
         'joint to show, or several separated by commas (default: those with commands)',
         {'default': ''}),
        *picture_options('figures to write in addition', panels=True))


def run(arguments: argparse.Namespace) -> int:
    """Read, evaluate and write; raise `BadInputError` if a file cannot be written."""
    out = arguments.out or Path(f'{arguments.bags[0].resolve().stem}_report.html')
    pictures: list[Path] = arguments.picture
    paper = paper_of(arguments, out, sources=arguments.bags)
    targets = [out, *pictures, *paper.tables(pictures)]

    from hmsa.report.comparison import parts_of
    from hmsa.report.page import page
    from hmsa.runs.bags import read_runs
    from hmsa.runs.parameters import read_parameter_file

    joints = [x for x in arguments.joint.split(',') if x]
    parameters = None if arguments.params_file is None else read_parameter_file(
        arguments.params_file)
    with progress() as update:
        runs: list[Run] = []
        for bag in arguments.bags:
            runs += read_runs(
                bag, parameters=parameters, joints=joints, progress=update)
        update('evaluating', None)
        parts = parts_of(runs)
        update('writing', None)
        write_text(out, page(parts))
        if pictures:
            from hmsa.report.picture import draw
            draw(pictures, parts, paper)
    return show(arguments, {
        'runs': [{
            'run': x.run.label, 'bag': x.run.path, 'joint': x.run.joint,
            'setpoints': [y.to_dict() for y in x.evaluation.findings]} for x in parts],
        'files': targets}, *targets)
