"""
Run the paper's sequence on real ROS 2 processes.

Start planner, plant and recorder, send the paper's sequence, and print the residual vibration.
Then move a block that is 20 % stiffer than the planner's model, in open loop and with feedback.
Writes a bag, two figures and the logs.

example: hmsa demo --out my_first_run
"""

import argparse
import os
from pathlib import Path
import sys
from typing import Any

from hmsa.cli.options import add_command, JSON, show
from hmsa.cli.terminal import progress
from hmsa.ending import ENDING
from hmsa.table import Column, Table


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('--out', 'DIR', Path, 'output folder (default hmsa_demo/ plus date and time)'),
        JSON)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo."""
    from hmsa_ros.clients.processes import dated, stay_local

    folder = arguments.out or dated('hmsa_demo')
    stay_local()
    from hmsa_ros.clients.experiment import prepare

    prepare(folder)
    ENDING.note()
    print(f'ROS_DOMAIN_ID {os.environ["ROS_DOMAIN_ID"]}, output in {folder}', file=sys.stderr)
    try:
        with progress() as update:
            from hmsa_ros.clients.demo import run_demo

            result = run_demo(folder, update)
            ENDING.check()
    except KeyboardInterrupt:
        print(f'interrupted; the bag so far: {folder / "run"}', file=sys.stderr)
        return ENDING.status
    show(
        arguments, result.as_json(), Table((
            Column('target'), Column('b_p', '', '.5f'), Column('tau_p', '', '.5f'),
            Column('b_1', '', '.5f'), Column('arrival', 'ms', '.3f'),
            Column('residual', '%', '%'), Column('unshaped', '%', '%'), Column('verdict')),
            tuple((
                x.stretch, x.b_p, x.tau_p, x.b_1, x.arrival * 1e3, 100.0 * x.residual,
                100.0 * x.residual_unshaped, str(x.finding['verdict']).replace('_', ' '))
                for x in result.setpoints),
            'b and tau are nondimensional as in the paper, percentages of the step', legend=(
                ('arrival', 'time from the start of the move'),
                ('residual', 'peak-to-peak stretch after arrival'),
                ('unshaped', 'the same after unshaped steps, simulated on the same plant'))),
        Table((
            Column('feedback'), Column('target'), Column('arrival', 'ms', '.1f'),
            Column('vibration', '%', '.2f'), Column('offset', '%', '+.2f')),
            tuple((x.feedback, x.stretch, x.arrival * 1e3, 100.0 * x.vibration, 100.0 * x.offset)
                  for x in result.adapting),
            'a larger block, simulated in this process, whose shear modulus is 20 % higher than '
            'in the model of the planner; percentages are of the step', legend=(
                ('vibration', 'peak to peak after arrival'), ('offset', 'mean minus target'))),
        f'bag      {result.bag}', f'picture  {result.picture}', f'         {result.second}')
    return 0 if result.succeeded else 1
