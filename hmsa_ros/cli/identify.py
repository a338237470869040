"""``hmsa identify``: the parameters of an actuator out of a recording."""

import argparse
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from hmsa_ros.cli.options import add_options, JSON
from hmsa_ros.cli.progress import progress
from hmsa_ros.errors import BadInputError
from hmsa_ros.files import json_text, write_text

if TYPE_CHECKING:
    from hmsa_ros.identification import Identification, Recording
    from hmsa_ros.identification.files import Belief


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        'identify', help="identify the actuator's parameters from a recording",
        description="Identify the actuator's parameters from a recording of its motion, with 95 "
                    '% intervals, or report why the recording cannot determine them. RUN is a '
                    'bag, or a CSV with a header and the columns time (s), stretch and, without '
                    '--commands, flux_density (T). No start values are needed.',
        epilog='example: hmsa identify camera.csv --commands levels.csv --out actuator.yaml')
    parser.add_argument(
        'recording', type=Path, metavar='RUN', help='a bag, or a CSV of samples')
    add_options(
        parser,
        ('--commands', 'CSV', Path,
         'CSV of time, flux_density: the level in force from that time on'),
        ('--params-file', 'YAML', Path,
         'parameter file with what is known, such as geometry and density'),
        ('--free', 'NAME,...', str,
         'parameters to identify (default shear_modulus, damping_coefficient, chain_limit, '
         'remanence, stretch_bias); others: density, time_unit, stretch_gain, sensor_latency, '
         'coil_time_constant, constant_force, initial_stretch, initial_rate, '
         'viscoelastic_ratio and viscoelastic_time, for more branches with _2 and _3 after them; '
         'with a law its constants, such as law.c10 and law.c01', {'default': ''}),
        ('--joint', 'NAME', str, 'joint to identify, if the bag has several', {'default': ''}),
        ('--profile', 'NAME', str, 'also print the profile likelihood of this parameter',
         {'default': ''}),
        ('--out', 'YAML', Path,
         'parameter file to write for planner and plant, only if identified; an existing file is '
         'replaced'),
        ('--report', 'HTML', Path,
         'HTML page to write: data, fit, residuals and intervals; an existing file is replaced'),
        JSON)


def run(arguments: argparse.Namespace) -> int:
    """Read, identify and print."""
    _check_targets(arguments)

    from hmsa_ros.identification.files import file_text, read_belief
    from hmsa_ros.identification.identify import identify, profile
    from hmsa_ros.identification.quantities import DEFAULT_FREE

    belief = read_belief(arguments.params_file)
    free = [x for x in arguments.free.split(',') if x] or DEFAULT_FREE
    with progress('reading') as update:
        recording, belief = _read(arguments, belief)
        update('fitting', None)
        found = identify(recording, free=free, actuator=belief.actuator, known=belief.others)
        curve = profile(found, arguments.profile) if arguments.profile else []
    good = found.verdict == 'identified'
    written = []
    if arguments.out is not None and good:
        from datetime import datetime

        now = datetime.now().astimezone()
        write_text(arguments.out, file_text(found, belief, str(arguments.recording), now))
        written.append(arguments.out)
    if arguments.report is not None:
        from hmsa_ros.report.identified import page

        write_text(arguments.report, page(found))
        written.append(arguments.report)
    if arguments.json:
        record = found.record()
        if curve:
            record['profile'] = {'name': arguments.profile, 'points': curve}
        print(json_text(record))
    else:
        for line in table(found):
            print(line)
        for value, deviance in curve:
            print(f'profile {arguments.profile} {value:.8g} deviance {deviance:.4g}')
        for path in written:
            print(f'{path} written')
    if not good:
        refused = f'; {arguments.out} was not written' if arguments.out is not None else ''
        print(f'hmsa: {found.verdict}: {found.reason}{refused}', file=sys.stderr)
    return 0 if good else 1


def _check_targets(arguments: argparse.Namespace) -> None:
    """Refuse what cannot be written before anything is read."""
    targets = [x for x in (arguments.out, arguments.report) if x is not None]
    sources = [x.resolve() for x in (
        arguments.recording, arguments.commands) if x is not None]
    for target in targets:
        if target.is_dir() or target.resolve() in sources or not (
                target.resolve().parent.is_dir()):
            raise BadInputError(
                f'cannot write {target}: expected a file of its own in a folder that exists')


def _read(
        arguments: argparse.Namespace, belief: 'Belief') -> 'tuple[Recording, Belief]':
    """Return the recording, and what is known with what the bag says of it."""
    from dataclasses import replace
    import math

    path: Path = arguments.recording
    if path.is_dir() or path.suffix == '.mcap':
        from hmsa_ros.identification.runs import read_bag

        if arguments.commands is not None:
            raise BadInputError(
                f'--commands {arguments.commands} is given for the bag {path}: a bag has its '
                'own commands; expected a CSV of samples with it')
        given = belief.actuator if arguments.params_file is not None else None
        recording, actuator, known = read_bag(path, joint=arguments.joint, actuator=given)
        return recording, replace(
            belief, actuator=actuator, others={**known, **belief.others})
    from hmsa_ros.identification.tables import read_csv

    slew = belief.number('slew_limit', 0.0) or math.inf
    return read_csv(
        path, arguments.commands, slew_limit=slew,
        coordinate=belief.actuator.coordinate), belief


def table(found: 'Identification') -> list[str]:
    """Return the result, aligned, a line each."""
    lines = [f'{"parameter":<22}{"value":>14}{"std":>11}{"95 % interval":>28}  unit']
    for key in found.names:
        name, x = found.shown(key)
        if x.value != x.value:
            lines.append(f'{name:<22}{"not identifiable":>53}  {x.unit}')
            continue
        interval = f'{x.low:.6g} to {x.high:.6g}'
        lines.append(f'{name:<22}{x.value:>14.7g}{x.std:>11.2g}{interval:>28}  {x.unit}')
    lines.append(
        f'noise {found.noise_std:.3g}, residual rms {found.residual_rms:.3g}, '
        f'{found.samples} samples')
    if found.verdict == 'identified':
        lines += [f'{one} and {other} are confounded: correlation {x:.3f}'
                  for one, other, x in found.confounded()]
        lines.append(f'identified: {found.reason}')
    return [*lines, *(f'note: {x}' for x in found.warnings)]
