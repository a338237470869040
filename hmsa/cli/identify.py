"""
Identify the actuator's parameters from a recording.

Identify the actuator's parameters from a recording of its motion, with 95 % intervals, or report
why the recording cannot determine them. RUN is a bag, or a CSV with a header and the columns time
(s), stretch and, without --commands, flux_density (T). No start values are needed.

example: hmsa identify camera.csv --commands levels.csv --out actuator.yaml
"""

import argparse
from dataclasses import replace
from datetime import datetime
import math
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import add_command, JSON, of_unit, show, temperature_option
from hmsa.cli.terminal import progress
from hmsa.errors import BadInputError, meant
from hmsa.files import check_targets, may_be_bag, write_text
from hmsa.interfaces.quantities import quantity_of

if TYPE_CHECKING:
    from hmsa.identification.files import Belief
    from hmsa.identification.measurement import Measurement


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('recording', 'RUN', Path, 'a bag, or a CSV of samples'),
        ('--commands', 'CSV', Path,
         'CSV of time, flux_density: the level in force from that time on'),
        of_unit('--rest-length', 'm', 'length at rest, by which a column of lengths in the CSV, '
                'such as length [mm], is divided to obtain the stretch'),
        ('--params-file', 'YAML', Path,
         'parameter file with the known values, such as geometry and density'),
        ('--free', 'NAME,...', str,
         'parameters to identify (default shear_modulus, damping_coefficient, chain_limit, '
         'remanence, stretch_bias). +NAME adds to these, and --free=-NAME removes one. Others are '
         'density, time_unit, stretch_gain, sensor_latency, coil_time_constant, constant_force, '
         'initial_stretch, initial_rate, viscoelastic_ratio, viscoelastic_time and '
         'viscoelastic_exponent (further branches with _2 and _3), and constants of a '
         'hyperelastic model, such as law.c10. "modes" frees as many secondary modes as the '
         'recording shows, with mass_factor in place of shear_modulus',
         {'default': ''}),
        ('--known', 'NAME=VALUE[+-STD],...', str,
         'fixed values, such as sensor_latency=2ms or half_length=5mm+-1%%; the intervals include '
         'the effect of a standard deviation', {'default': ''}),
        temperature_option(
            'temperature of the actuator in the recording in degrees Celsius, for which the file '
            'is then valid (thermal.reference; default: as recorded)'),
        ('--joint', 'NAME', str, 'joint to identify, if the bag has several', {'default': ''}),
        ('--profile', 'NAME', str, 'also print the profile likelihood of this parameter',
         {'default': ''}),
        ('--out', 'YAML', Path,
         'parameter file to write for planner and plant, only if identified or with --accept; '
         'replaces an existing file'),
        ('--accept',
         'also write the file if the model is rejected for a defect that leaves at most 5 %% of a '
         'step; the exit status is then 3', {'needs': ('--out',)}),
        ('--report', 'HTML', Path,
         'HTML page to write: data, fit, residuals and intervals; an existing file is replaced'),
        JSON)


def run(arguments: argparse.Namespace) -> int:
    """Read, identify and print."""
    check_targets(
        arguments.out, arguments.report, sources=(arguments.recording, arguments.commands))

    from hmsa.identification.files import file_text, read_belief
    from hmsa.identification.identify import identify
    from hmsa.identification.intervals import profile
    from hmsa.identification.quantities import free_of

    belief = read_belief(arguments.params_file)
    known, uncertain = known_of(arguments.known)
    with progress('reading') as update:
        recording, belief, given = _read(arguments, belief)
        if arguments.temperature is not None:
            recording = replace(recording, temperature=arguments.temperature)
            belief = belief.at_temperature(arguments.temperature)
        belief = replace(belief, others={**belief.others, **known})
        update('fitting', None)
        found = identify(
            recording, free=free_of(arguments.free, belief.actuator.law, known),
            actuator=belief.actuator if given else None, known=belief.others,
            uncertain=uncertain)
        curve = profile(found, arguments.profile) if arguments.profile else []
    identified = found.verdict == 'identified'
    good = identified or arguments.accept and found.acceptable
    if arguments.out is not None and good:
        now = datetime.now().astimezone()
        write_text(arguments.out, file_text(found, belief, str(arguments.recording), now))
    if arguments.report is not None:
        from hmsa.report.identified import page

        write_text(arguments.report, page(found))
    show(
        arguments, found.record() | ({'profile': {
            'name': arguments.profile, 'points': curve}} if curve else {}),
        found.report(), *([f'identified: {found.reason}'] if identified else []),
        *(f'profile {arguments.profile} {x:.8g} deviance {y:.4g}' for x, y in curve),
        written=(arguments.out if good else None, arguments.report))
    if identified:
        return 0
    note = ''
    if good:
        note = f'; accepted: what the model lacks costs {100.0 * found.cost:.2g} % of a step'
    elif arguments.out is not None:
        note = f'; {arguments.out} was not written' + (
            f'; --accept writes it: what the model lacks costs {100.0 * found.cost:.2g} % of a '
            'step' if found.acceptable else '')
    print(f'hmsa: {found.verdict}: {found.reason}{note}', file=sys.stderr)
    return 3 if good else 1


def known_of(text: str) -> tuple[dict[str, float], dict[str, float]]:
    """Return values and standard deviations of --known by name; raise `BadInputError`."""
    from hmsa.identification.quantities import QUANTITIES

    values, deviations = {}, {}
    for part in filter(None, (x.strip() for x in text.split(','))):
        name, equals, rest = (x.strip() for x in part.partition('='))
        name = name.removeprefix('actuator.')
        if not equals or name not in QUANTITIES:
            raise BadInputError(
                f'--known has {part!r}: expected NAME=VALUE or NAME=VALUE+-STD, with a name of '
                f'{", ".join(QUANTITIES)}' + (meant(name, QUANTITIES) if equals else ''))
        unit = QUANTITIES[name].unit
        value, known, std = (x.strip() for x in rest.partition('+-'))
        values[name] = quantity_of(value, unit, name)
        if std.endswith('%'):
            deviations[name] = 0.01 * abs(values[name]) * quantity_of(std[:-1], '', name)
        elif known:
            deviations[name] = quantity_of(std, unit, name)
    return values, deviations


def _read(
        arguments: argparse.Namespace, belief: 'Belief') -> 'tuple[Measurement, Belief, bool]':
    """Return the recording, prior knowledge with values of a bag, and whether there is any."""
    path: Path = arguments.recording
    if may_be_bag(path):
        from hmsa.identification.measurement import recording_of
        from hmsa.runs.bags import read_run

        if arguments.commands is not None:
            raise BadInputError(
                f'--commands {arguments.commands} is given for the bag {path}: a bag has its '
                'own commands; expected a CSV of samples with it')
        if arguments.rest_length is not None:
            raise BadInputError(
                f'--rest-length is given for the bag {path}: a bag contains stretches, to which '
                'driver or sense node converts lengths; expected a CSV of lengths with it')
        given = belief.actuator if arguments.params_file is not None else None
        recording, actuator, known = recording_of(
            read_run(path, joint=arguments.joint), given)
        if math.isfinite(recording.temperature):
            belief = belief.at_temperature(recording.temperature)
        return recording, replace(
            belief, actuator=actuator, others={**known, **belief.others}), True
    from hmsa.identification.measurement import read_csv

    slew = belief.number('slew_limit', 0.0) or math.inf
    return read_csv(
        path, arguments.commands, slew_limit=slew,
        coordinate=belief.actuator.coordinate, rest_length=arguments.rest_length
    ), belief, arguments.params_file is not None
