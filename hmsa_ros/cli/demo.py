"""``hmsa demo``: the paper's sequence on real ROS 2 processes."""

import argparse
from datetime import datetime
import os
from pathlib import Path
from typing import Any, TYPE_CHECKING

from hmsa_ros.cli.options import add_options
from hmsa_ros.cli.progress import progress
from hmsa_ros.cli.tables import table
from hmsa_ros.ending import ENDING
from hmsa_ros.files import json_text

if TYPE_CHECKING:
    from hmsa_ros.lab.demo import DemoResult


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        'demo', help="run the paper's sequence on real ROS 2 processes",
        description="Start planner, plant and recorder, send the paper's sequence, and print "
                    'the residual vibration. Then move a block that is 20 % stiffer than the '
                    "planner's model, in open loop and with feedback. Writes a bag, two figures "
                    'and the logs.',
        epilog='example: hmsa demo --out my_first_run')
    add_options(
        parser,
        ('--out', 'DIR', Path, 'output folder (default hmsa_demo/ plus date and time)'),
        ('--json', 'print the result as JSON'))


def run(arguments: argparse.Namespace) -> int:
    """Run the demo."""
    from rich.console import Console

    from hmsa_ros.lab.processes import local_environment

    folder = arguments.out or Path('hmsa_demo') / datetime.now().strftime('%Y-%m-%d_%H-%M-%S')
    # Set before anything of ROS is imported: this process joins the nodes' domain.
    os.environ.update(local_environment())
    from hmsa_ros.lab.demo import run_demo
    from hmsa_ros.lab.experiment import prepare

    prepare(folder)
    ENDING.note()
    console = Console(stderr=True)
    console.print(
        f'ROS_DOMAIN_ID {os.environ["ROS_DOMAIN_ID"]}, output in {folder}', highlight=False)
    try:
        with progress() as update:
            result = run_demo(folder, dict(os.environ), update)
            ENDING.check()
    except KeyboardInterrupt:
        console.print(f'interrupted; the bag so far: {folder / "run"}', highlight=False)
        return ENDING.status
    if arguments.json:
        print(json_text(result.as_json()))
    else:
        _print_table(result)
    return 0 if result.succeeded else 1


def _print_table(result: 'DemoResult') -> None:
    from rich.console import Console

    from hmsa_ros.model.residual import percent

    console = Console()
    moves = table(
        'b and tau nondimensional as in the paper; arrival from the begin of the move; residual: '
        'peak-to-peak stretch after arrival, in % of the step; unshaped: simulated on the same '
        'plant',
        ('target', 'b_p', 'tau_p', 'b_1', 'arrival ms', 'residual %', 'unshaped %'), 'verdict')
    for x in result.setpoints:
        moves.add_row(
            f'{x.stretch:g}', f'{x.b_p:.5f}', f'{x.tau_p:.5f}', f'{x.b_1:.5f}',
            f'{x.arrival * 1e3:.3f}', percent(x.residual), percent(x.residual_unshaped),
            str(x.finding['verdict']).replace('_', ' '))
    console.print(moves)
    adapted = table(
        'a larger block, simulated in this process, whose shear modulus is 20 % above that '
        'planned with; vibration after the arrival and rest beside the target, share of the step',
        ('feedback', 'target', 'arrival ms', 'vibration', 'offset'))
    for y in result.adapting.results:
        adapted.add_row(
            y.feedback, f'{y.stretch:g}', f'{y.arrival * 1e3:.1f}', f'{y.vibration:.2%}',
            f'{y.offset:+.2%}')
    console.print(adapted)
    for line in (
            f'bag      {result.bag}', f'picture  {result.picture}',
            f'         {result.adapting.picture}'):
        console.print(line, highlight=False, soft_wrap=True)
