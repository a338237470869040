"""
Measure an actuator, choose a shaper, and show before and after.

Make the moves, record an excitation, identify the actuator from it, compare the shapers for its
uncertainty, write the parameters, and make the moves again. Works with the running planner, which
gets the new parameters, and plant or driver, or with simulated ones. Ctrl-C brings the actuator to
rest.

example: hmsa tune 1.10:0.5 1.00:0.5 --simulate --params-file actuator.yaml
"""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any, TYPE_CHECKING

from hmsa.cli.identify import known_of
from hmsa.cli.options import (
    add_command,
    argument,
    assume_example,
    JSON,
    NAMESPACE,
    setpoint_of_joints,
    show,
)
from hmsa.cli.terminal import progress, show_notes
from hmsa.ending import ENDING
from hmsa.errors import BadInputError
from hmsa.files import check_targets, write_text

if TYPE_CHECKING:
    from hmsa.runs.parameters import Entries
    from hmsa_ros.clients.processes import NodeProcess


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('setpoints', 'STRETCH:SECONDS', argument(setpoint_of_joints),
         'moves to tune for: target stretch, or deflection of a beam, and duration in s',
         {'nargs': '+'}),
        ('--simulate', 'start a planner and a plant for each run, in simulated time'),
        ('--params-file', 'YAML', Path,
         'parameter file with known values (default: the parameters of the running planner, or '
         'the example block with --simulate)'),
        ('--duration', 'S', float,
         'duration of the excitation in s (default 180 periods of the actuator)'),
        ('--stretch-min', 'X', float,
         'minimum stretch of the excitation (default half the range of the moves below it)'),
        ('--stretch-max', 'X', float,
         'maximum stretch of the excitation (default half the range of the moves above it)'),
        ('--free', 'NAME,...', str,
         'parameters to identify, as in hmsa identify; effects in the fit residuals are added',
         {'default': ''}),
        ('--known', 'NAME=VALUE[+-STD],...', str, 'fixed values, as in hmsa identify',
         {'default': ''}),
        ('--accept', 'also continue if the model is rejected for a defect that leaves at most '
                     '5 %% of a step'),
        ('--out', 'YAML', Path,
         'parameter file to write (default actuator.yaml in the folder of the runs); an existing '
         'file is replaced'),
        ('--report', 'HTML', Path,
         'page to write, with the moves before and after; an existing file is replaced'),
        ('--folder', 'DIR', Path,
         'folder for the bags of the runs (default hmsa_tune/ plus date and time)'),
        JSON,
        NAMESPACE)


def run(arguments: argparse.Namespace) -> int:
    """Tune an actuator; raise `BadInputError` for setpoints of several joints."""
    if any(len(x) > 1 for x, _ in arguments.setpoints):
        raise BadInputError(
            'setpoints name several joints: expected one stretch each; tune one joint at a time, '
            'with a planner of its own')
    check_targets(arguments.out, arguments.report)
    known, uncertain = known_of(arguments.known)
    from hmsa_ros.clients.processes import dated, stay_local

    folder = arguments.folder or dated('hmsa_tune')
    if arguments.simulate:
        stay_local()
        if arguments.params_file is None:
            assume_example()
    from hmsa_lab.experiments.tuning import tune, Tuning
    from hmsa_ros.clients.experiment import prepare

    prepare(folder)
    ENDING.note()
    entries, node = _nodes(arguments)
    show_notes()
    tuning = Tuning(
        folder, tuple(arguments.setpoints), arguments.out or folder / 'actuator.yaml', entries,
        node, arguments.namespace, arguments.duration, arguments.stretch_min,
        arguments.stretch_max, arguments.free, known, uncertain, arguments.accept)
    try:
        with progress() as update:
            found = tune(tuning, update)
    except KeyboardInterrupt:
        return ENDING.status
    from hmsa.report.comparison import comparison

    if arguments.report is not None:
        from hmsa.report.page import page

        write_text(arguments.report, page(found.parts))
    verdict, reason = found.verdict
    show(
        arguments, {
            'verdict': verdict, 'reason': reason, 'identified': found.identified.record(),
            'shapers': [asdict(x) for x in found.shapers], 'shaper': found.shaper,
            **{x.run.label: [y.to_dict() for y in x.evaluation.findings] for x in found.parts},
            'file': found.file, 'folder': folder, 'report': arguments.report},
        found.identified.report(),
        *(f'shaper   {x.shaper:<12}' + (
            f'not possible: {x.reason}' if x.reason else
            f'vibration at most {100.0 * x.vibration:.2g} % of the step, moves take up to '
            f'{1e3 * x.move_time:.4g} ms') + ('  (chosen)' if x.shaper == found.shaper else '')
          for x in found.shapers),
        *([comparison(found.parts)] if found.parts[0].evaluation.findings else []),
        f'verdict  {verdict}: {reason}',
        *([] if found.file is None else [f'file     {found.file}']), f'runs     {folder}',
        *([] if arguments.report is None else [f'report   {arguments.report}']))
    return 0 if verdict == 'tuned' else 1


def _nodes(arguments: argparse.Namespace) -> 'tuple[Entries, NodeProcess | None]':
    """Return the given parameters, and planner and plant to start, if requested."""
    from hmsa.runs.parameters import entries_of, read_parameter_file
    from hmsa_lab.experiments.tuning import known_to
    from hmsa_ros.clients.experiment import simulated_node

    path: Path | None = arguments.params_file
    entries = [] if path is None else entries_of(path)
    if not arguments.simulate:
        return known_to(arguments.namespace) if path is None else entries, None
    # The tuning must not use the true parameters of the plant.
    return [x for x in entries if x[0] != 'plant'], simulated_node(
        {} if path is None else read_parameter_file(path), str(path or ''), arguments.namespace)
