"""
Execute a whole experiment: check, record, send, measure.

Execute an experiment with the running planner and plant or driver, or with simulated ones: check
that the nodes run and agree, record, send the sequence, close the bag, and measure whether each
setpoint was reached. Ctrl-C brings the actuator to rest and closes the bag.

example: hmsa run 1.10:0.2 1.20:0.2 1.00:0.2 --simulate
"""

import argparse
from dataclasses import asdict
from functools import partial
from importlib import import_module
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import (
    add_command,
    assume_example,
    JOINTS,
    JSON,
    NAMESPACE,
    SEQUENCE,
    sequence_of,
)
from hmsa.cli.terminal import progress, show_notes, with_notes
from hmsa.ending import ENDING
from hmsa.errors import BadInputError, check_number
from hmsa.files import json_text, write_text
from hmsa_ros.cli.send import SLOW

if TYPE_CHECKING:
    from collections.abc import Callable

    from hmsa.judge.records import Finding, Tolerances
    from hmsa.report.comparison import Part
    from hmsa.report.evaluation import LevelResult
    from hmsa_ros.clients.experiment import Conducted, Experiment

NOT_MEASURED = 'predicted, not measured'
_MOST_REPEATS = 10_000


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        *SEQUENCE,
        ('--simulate',
         'start a planner and a plant for this run, in simulated time'),
        ('--params-file', 'YAML', Path,
         'parameter file; with --simulate, used for the nodes started; otherwise the running '
         'nodes are checked against it'),
        ('--feedback', 'MODE', str,
         'feedback mode: off, observe, adapt or cautious. With a running planner, fails unless '
         'the planner is in this mode (default: do not check; off with --simulate)',
         {'choices': ('off', 'observe', 'adapt', 'cautious')}),
        ('--tolerance', 'X', float,
         'steady-state error and residual vibration that count as arrived, as a fraction of the '
         "step (default: the planner's arrival_tolerance, vibration_tolerance and "
         'stretch_tolerance, which also apply to the end of --levels)'),
        ('--repeat', 'N', int, 'number of executions, with statistics (default 1)',
         {'default': 1}),
        ('--report', 'also write report.html'),
        ('--out', 'DIR', Path, 'folder for the output (default hmsa_run/ plus date and time)'),
        JSON,
        NAMESPACE,
        JOINTS)


def run(arguments: argparse.Namespace) -> int:
    """Run the experiment as often as requested; raise `BadInputError` for an invalid number."""
    tolerances = _tolerances(arguments)
    check_number('--repeat', arguments.repeat, least=1, most=_MOST_REPEATS)
    from hmsa_ros.clients.processes import dated, stay_local

    folder = arguments.out or dated('hmsa_run')
    if arguments.simulate:
        stay_local()
        if arguments.params_file is None:
            assume_example()
    from hmsa_ros.clients.experiment import prepare

    # Each repeat has its own folder.
    folders = [folder] if arguments.repeat == 1 else [
        folder / str(i + 1) for i in range(arguments.repeat)]
    with progress('reading the sequence'):
        experiments = [_experiment(arguments, x) for x in folders]
    for x in folders:
        prepare(x)
    show_notes()
    records: list[dict[str, Any]] = []
    each: list[list[Finding]] = []
    whole = True
    try:
        for experiment in experiments:
            with progress() as update:
                done, parts, report = _carried_out(arguments, experiment, tolerances, update)
            from hmsa.report.evaluation import level_results

            levels = [y for x in parts for y in level_results(x.run)] if experiment.levels else []
            findings = [y for x in parts for y in x.evaluation.findings] if (
                experiment.setpoints) else []
            verdict, reason = _verdict(experiment, findings, done, parts)
            each.append(findings)
            # A recorder that lost messages ends with 1; a note names them.
            whole = whole and not any(done.exits.values())
            records.append({
                'verdict': verdict, 'reason': reason,
                'setpoints': [x.to_dict() for x in findings],
                **({'levels': [asdict(x) for x in levels]} if experiment.levels else {}),
                'notes': done.notes, 'exits': done.exits, 'bag': experiment.bag,
                'report': report})
            if not arguments.json:
                _print(experiment, parts, levels, reason, done, report)
    except KeyboardInterrupt:
        so_far = f'; the bag so far: {experiment.bag}' if experiment.bag.exists() else ''
        print(f'interrupted{so_far}', file=sys.stderr)
        return ENDING.status
    finally:
        # Also of the repeats before an interrupt or an error.
        if records:
            _print_all(arguments, records, each)
    return 0 if whole and all(x['verdict'] in ('arrived', NOT_MEASURED) for x in records) else 1


def _print_all(
        arguments: argparse.Namespace, records: list[dict[str, Any]],
        each: 'list[list[Finding]]') -> None:
    """Print the records as JSON, or the statistics of the repeats that have ended."""
    from hmsa.report.comparison import statistics, statistics_table

    if arguments.json:
        print(json_text(with_notes(records[0] if arguments.repeat == 1 else {
            'repeats': records, 'statistics': statistics(each)})))
    elif arguments.repeat > 1 and any(each):
        print(statistics_table({'': statistics(each)}))


def _carried_out(
        arguments: argparse.Namespace, experiment: 'Experiment', tolerances: 'Tolerances | None',
        update: 'Callable[[str, float | None], None]'
) -> 'tuple[Conducted, list[Part], Path | None]':
    """Conduct an experiment, and judge the setpoints of each joint from its bag."""
    from hmsa_ros.clients.experiment import conduct

    ENDING.note()  # since nodes are to be stopped
    done = conduct(experiment, partial(_show, update))
    ENDING.check()
    ENDING.interrupt()
    if not done.measured:
        return done, [], None
    update('evaluating the bag', None)
    from hmsa.report.comparison import Part
    from hmsa.runs.bags import read_runs

    parts = [Part.of(x, tolerances=tolerances) for x in read_runs(
        experiment.bag, joints=experiment.joints if len(experiment.joints) > 1 else ())]
    if not arguments.report or not parts:
        return done, parts, None
    from hmsa.report.page import page

    report = experiment.folder / 'report.html'
    write_text(report, page(parts))
    return done, parts, report


def _show(update: 'Callable[[str, float | None], None]', what: str, share: float) -> None:
    """Show the current activity; import modules of the evaluation during the sequence."""
    update(what, share)
    if share > 0.0:
        import_module('hmsa.report.evaluation')
        import_module('hmsa.report.comparison')


def _tolerances(arguments: argparse.Namespace) -> 'Tolerances | None':
    """Return the tolerances, None for the planner's; raise `BadInputError` if invalid."""
    from hmsa.judge.records import Tolerances

    tolerance = arguments.tolerance
    if tolerance is None:
        return None
    if arguments.levels is not None or arguments.path is not None:
        given = 'levels' if arguments.path is None else 'path'
        raise BadInputError(
            f'--tolerance is given with --{given}: expected setpoints with it; for the '
            "end, the planner's arrival_tolerance and vibration_tolerance count")
    check_number('tolerance', tolerance, above=0.0)
    return Tolerances(tolerance, tolerance, 0.0)


def _experiment(arguments: argparse.Namespace, folder: Path) -> 'Experiment':
    from hmsa.runs.parameters import read_parameter_file
    from hmsa_ros.clients.experiment import Experiment, simulated_node

    expected = {} if arguments.params_file is None else dict(read_parameter_file(
        arguments.params_file))
    if arguments.feedback is not None:
        expected['planner.feedback'] = arguments.feedback
    if arguments.path is not None:
        expected['planner.trajectory_mode'] = 'path'
    nodes = (simulated_node(
        expected, str(arguments.params_file or ''), arguments.namespace),
    ) if arguments.simulate else ()
    return Experiment(
        folder, tuple(arguments.setpoints), nodes, arguments.namespace,
        tuple(arguments.joint.split(',')), expected, *sequence_of(arguments))


def _verdict(
        experiment: 'Experiment', findings: 'list[Finding]', done: 'Conducted',
        parts: 'list[Part]') -> tuple[str, str]:
    """Return the verdict on all setpoints, or on the end of levels, and its reason."""
    from hmsa.judge.records import worst
    from hmsa.report.comparison import ringing

    if not experiment.setpoints or not done.measured:
        reason = ('the levels or the path end at rest' if done.measured
                  else 'no node publishes joint_states')
        if done.verdict.failure:
            return done.verdict.measured or done.verdict.code, done.verdict.failure
        return done.verdict.measured or NOT_MEASURED, (
            done.verdict.finding or f'{NOT_MEASURED}: {reason}')
    count = len(experiment.setpoints) * len(experiment.joints)
    found = worst(findings)
    if found is None or len(findings) < count:
        return 'unobserved', (
            f'the bag shows {len(findings)} of {count} setpoints: expected all, with samples')
    if found.arrived:
        moves = f'all {count} moves' if count > 1 else 'the move'
        return 'arrived', f'{moves} arrived and stayed within tolerance{ringing(parts)}'
    others = sum(not x.arrived for x in findings) - 1
    return str(found.verdict), found.message + (
        f'; {others} more of {count} did not arrive' if others else '')


def _print(
        experiment: 'Experiment', parts: 'list[Part]', levels: 'list[LevelResult]', reason: str,
        done: 'Conducted', report: Path | None) -> None:
    from hmsa.report.comparison import setpoints
    from hmsa.report.evaluation import level_table

    if levels:
        print(level_table(levels))
    elif not experiment.path and any(x.evaluation.findings for x in parts):
        print(setpoints(parts))
    seconds = [f'{key} {x:.1f} s' for key, x in done.seconds.items()]
    if done.pace < SLOW:
        seconds[1] += f' (simulated time at {done.pace:.2g} of real time)'
    for line in (
            *(f'note     {x}' for x in done.notes), f'time     {", ".join(seconds)}',
            f'verdict  {reason}', f'bag      {experiment.bag}',
            *([] if report is None else [f'report   {report}'])):
        print(line)
