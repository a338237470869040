"""``hmsa run``: a whole experiment with one command."""

import argparse
from dataclasses import asdict
from datetime import datetime
import math
import os
from pathlib import Path
from typing import Any, TYPE_CHECKING

from hmsa_ros.cli.options import add_options, NAMESPACE
from hmsa_ros.cli.progress import progress
from hmsa_ros.cli.setpoints import add_sequence, levels_of
from hmsa_ros.cli.tables import table
from hmsa_ros.ending import ENDING
from hmsa_ros.errors import BadInputError
from hmsa_ros.files import json_text

if TYPE_CHECKING:
    from rich.table import Table

    from hmsa_ros.report.outcome import Arrival, LevelResult
    from hmsa_ros.session.experiment import Conducted, Experiment

NOT_MEASURED = 'predicted, not measured'
# Rows of the table of levels.
_MOST_LEVELS = 12


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        'run', help='carry out a whole experiment: check, record, send, measure',
        description='Carry out an experiment with the planner and the plant or driver that run, '
                    'or with simulated ones: check that all are there and agree, start a '
                    'recorder and wait until it listens, send the sequence, close the bag, and '
                    'measure whether each setpoint was reached. Ctrl-C brings the actuator to '
                    'rest and closes the bag.',
        epilog='example: hmsa run 1.10:0.2 1.20:0.2 1.00:0.2 --simulate')
    add_sequence(parser)
    add_options(
        parser,
        ('--simulate',
         'start a planner and a simulated plant for this run, which lead simulated time'),
        ('--params-file', 'YAML', Path,
         'parameter file: of the nodes to start, or to hold those that run against'),
        ('--feedback', 'MODE', str,
         'off, observe or adapt: what the planner does with the samples; a planner that runs '
         'already must be set to it (default as it is; off)',
         {'choices': ('off', 'observe', 'adapt')}),
        ('--tolerance', 'X', float,
         'offset and residual vibration of a setpoint that counts as reached, as a share of the '
         'step, noise of the sensor apart (default 0.02); the end of --levels is judged by the '
         "planner's arrival_tolerance and vibration_tolerance"),
        ('--report', 'write report.html as well'),
        ('--out', 'DIR', Path, 'folder for the output (default hmsa_run/ and the time of day)'),
        ('--json', 'print the result as JSON'),
        NAMESPACE,
        ('--joint', 'NAMES', str, 'joint, or joints with commas between (default actuator)',
         {'default': 'actuator'}))


def run(arguments: argparse.Namespace) -> int:
    """Carry out the experiment."""
    from rich.console import Console

    tolerance = _tolerance(arguments)
    folder = arguments.out or Path('hmsa_run') / datetime.now().strftime('%Y-%m-%d_%H-%M-%S')
    if arguments.simulate:
        from hmsa_ros.session.processes import local_environment
        # Set before anything of ROS is imported: this process joins the nodes' domain.
        os.environ.update(local_environment())
    experiment = _experiment(arguments, folder)
    from hmsa_ros.session.experiment import conduct, prepare

    prepare(folder)
    ENDING.note()
    console = Console(stderr=True)
    try:
        with progress() as update:
            done = conduct(experiment, dict(os.environ), update)
            ENDING.check()
            update('evaluating the bag', None)
            measured, levels = _measure(experiment, tolerance) if done.measured else ([], [])
            report = _report(experiment.bag, folder / 'report.html') if (
                arguments.report and done.measured) else None
    except KeyboardInterrupt:
        console.print(
            f'interrupted; the bag so far: {experiment.bag}' if experiment.bag.exists()
            else 'interrupted', highlight=False, soft_wrap=True)
        return ENDING.status
    verdict, reason = _verdict(measured, done, levels=bool(experiment.levels))
    if arguments.json:
        print(json_text({
            'verdict': verdict, 'reason': reason, 'setpoints': [asdict(x) for x in measured],
            **({'levels': [asdict(x) for x in levels]} if experiment.levels else {}),
            'notes': done.notes, 'exits': done.exits, 'bag': str(experiment.bag),
            'report': None if report is None else str(report)}))
    else:
        _print(measured, levels, reason, done, experiment.bag, report)
    return 0 if verdict in ('arrived', NOT_MEASURED) else 1


def _tolerance(arguments: argparse.Namespace) -> float:
    """Return the tolerance; refuse what cannot be used."""
    from hmsa_ros.report.outcome import TOLERANCE

    if arguments.tolerance is not None and arguments.levels is not None:
        raise BadInputError(
            '--tolerance is given with --levels: expected setpoints with it; the end of levels is '
            "judged by the planner's arrival_tolerance and vibration_tolerance")
    tolerance = TOLERANCE if arguments.tolerance is None else arguments.tolerance
    if not 0.0 < tolerance < math.inf:
        raise BadInputError(f'tolerance is {tolerance:g}: expected a share above 0')
    return float(tolerance)


def _experiment(arguments: argparse.Namespace, folder: Path) -> 'Experiment':
    from hmsa_ros.runs.parameters import read_parameter_file
    from hmsa_ros.session.experiment import Experiment
    from hmsa_ros.session.simulated import simulated_nodes

    expected = {} if arguments.params_file is None else dict(read_parameter_file(
        arguments.params_file))
    if arguments.feedback is not None:
        expected['planner.feedback'] = arguments.feedback
    nodes = simulated_nodes(
        expected, str(arguments.params_file or ''), arguments.namespace
    ) if arguments.simulate else ()
    return Experiment(
        folder, tuple(arguments.setpoints), nodes, arguments.namespace,
        tuple(arguments.joint.split(',')), expected, levels_of(arguments))


def _measure(
        experiment: 'Experiment', tolerance: float) -> 'tuple[list[Arrival], list[LevelResult]]':
    """Read the bag and measure the moves or the levels of each joint."""
    from hmsa_ros.report.outcome import arrivals, level_results
    from hmsa_ros.runs.bags import read_runs

    several = len(experiment.joints) > 1
    runs = read_runs(experiment.bag, joints=experiment.joints if several else ())
    if experiment.levels:
        return [], [level for each in runs for level in level_results(each)]
    moves = []
    for each in runs:
        place = experiment.joints.index(each.joint) if several else 0
        targets = [x[place] if len(x) > 1 else x[0] for x, _ in experiment.setpoints]
        moves += arrivals(each, targets, tolerance)
    return moves, []


def _report(bag: Path, path: Path) -> Path:
    from hmsa_ros.files import write_text
    from hmsa_ros.report.charts import Part
    from hmsa_ros.report.evaluation import evaluate
    from hmsa_ros.report.page import page
    from hmsa_ros.report.timing import timing
    from hmsa_ros.runs.bags import read_runs

    write_text(path, page([Part(x, evaluate(x), timing(x), '') for x in read_runs(bag)]))
    return path


def _verdict(
        measured: 'list[Arrival]', done: 'Conducted', *, levels: bool) -> tuple[str, str]:
    """Return the verdict on all setpoints, or on the end of levels, and why."""
    if not done.measured:
        return NOT_MEASURED, f'{NOT_MEASURED}: nobody publishes joint_states'
    if levels:
        return done.verdict.measured or NOT_MEASURED, (
            done.verdict.finding or 'predicted, not measured: the levels end at rest')
    missed = [x for x in measured if x.verdict != 'arrived']
    if not missed:
        return 'arrived', f'all {len(measured)} moves arrived and stayed within tolerance'
    rest = f'; {len(missed) - 1} more of {len(measured)} failed' if len(missed) > 1 else ''
    return missed[0].verdict, f'{missed[0].sentence()}{rest}'


def _print(
        measured: 'list[Arrival]', levels: 'list[LevelResult]', reason: str, done: 'Conducted',
        bag: Path, report: Path | None) -> None:
    from rich.console import Console

    console = Console()
    if levels:
        console.print(_level_table(levels))
    if measured:
        moves = table(
            'measured after arrival: mean, its distance from the target, and vibration from peak '
            'to peak', ('target', 'reached', 'offset', 'residual', 'arrival ms'), 'verdict')
        for x in measured:
            moves.add_row(
                f'{x.joint} {x.stretch:g}' if len({y.joint for y in measured}) > 1
                else f'{x.stretch:g}', f'{x.reached:.5f}', f'{x.offset:+.1e}',
                f'{x.residual:.1e}', f'{x.arrival * 1e3:.3f}', x.verdict.replace('_', ' '))
        console.print(moves)
    for line in (
            *(f'note     {x}' for x in done.notes), f'verdict  {reason}', f'bag      {bag}',
            *([] if report is None else [f'report   {report}'])):
        console.print(line, highlight=False, soft_wrap=True)


def _level_table(levels: 'list[LevelResult]') -> 'Table':
    """Return the table of the levels that were in force for the longest."""
    longest = sorted(levels, key=lambda x: -x.duration)[:_MOST_LEVELS]
    chosen = [x for x in levels if x in longest or x is levels[-1]]
    short = len(levels) - len(chosen)
    few = f'; {short} short ones left out' if short else ''
    made = table(
        'rest: what the level holds by the parameters; then what was measured while it '
        f'was in force; the last row is the end{few}',
        ('level mT', 'times', 'in all ms', 'rest', 'mean', 'least', 'greatest'))
    for x in chosen:
        name = f'{x.joint} ' if len({y.joint for y in levels}) > 1 else ''
        made.add_row(
            f'{name}{x.flux_density * 1e3:.4g}', str(x.times), f'{x.duration * 1e3:.4g}', *(
                f'{y:.5f}' for y in (x.rest, x.mean, x.least, x.greatest)))
    return made
