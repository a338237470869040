r"""
Write a parameter file for your own actuator.

Write a parameter file of your own actuator for planner and plant (--params-file), and print the
resulting times, damping, flux densities and reachable stretches. Numbers are
in SI units unless a unit follows: 10mm, "50 kPa".

example: hmsa init --half-length 5mm --half-thickness 5mm --density 1.9g/cm3 \
    --shear-modulus 30kPa --j-lim 20 --zeta 0.1 --remanence 80mT \
    --flux-max 200mT --out my_actuator.yaml
"""

import argparse
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
import math
from pathlib import Path
from shlex import quote
import sys
from typing import Any, cast, TYPE_CHECKING

from hmsa.cli.options import (
    add_command,
    argument,
    JSON,
    law_of,
    LAW_OPTION,
    Row,
    show,
)
from hmsa.errors import BadInputError
from hmsa.files import check_targets, write_text, yaml_text
from hmsa.interfaces.parameters import BULK_RATIO, LAW, LAW_NAME, MODES, PUBLISH_RATE
from hmsa.interfaces.quantities import (
    DAMPING,
    default_of,
    EVERY,
    FORMS,
    GivenNumber,
    joint_names,
    OPTIONAL,
    QUANTITIES,
)
from hmsa.model.modes import MOUNTS

if TYPE_CHECKING:
    from hmsa.api.actuator import Actuator
    from hmsa.model.parameters import ActuatorParameters

_JOINT = 'actuator'
# Quantities of the coil, and those with another name in `Actuator`.
_COIL = ('flux_max', 'flux_min', 'slew_limit')
# Forms with their own sizes and constants.
_OF_THEIR_OWN = ('beam',)
_ARGUMENTS = {'j_lim': 'chain_limit', 'damping': 'damping_coefficient'}
# One of these is given; a block has the first one, a beam the second one by default.
_DAMPED = ('zeta', 'damping_ratio', DAMPING.key)
_FILE = Path('actuator.yaml')
_FOLLOWS = {'half_thickness': 'as --half-length', 'flux_min': 'minus --flux-max'}
# Full sizes, of a beam or a block, and the quantities of a block whose doubles they are.
_FULL = {'length': 'half_length', 'thickness': 'half_thickness'}
# Sample rate in Hz that one plant sustains, together with its planner, on two cores.
_KEPT_UP = 4000.0


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('--beam',
         'a beam that is clamped at one end, magnetised along its length, in a field across it; '
         'its setpoints are deflections of the tip over the length'),
        *map(_option, (*QUANTITIES, *(x for x in EVERY if x not in QUANTITIES), DAMPING)),
        LAW_OPTION,
        ('--mount', 'MOUNT', str,
         'how the actuator is held: free or glued (one face on a rigid support) for a block, '
         "clamped for a beam, each with its modes; or paper (the paper's model: uniform "
         'deformation, or the shape of the first mode of a beam; default)',
         {'default': MOUNTS[0], 'choices': MOUNTS}),
        ('--joint', 'NAME', str,
         f'joint name (default {_JOINT}), or several separated by commas for identical actuators',
         {'default': ''}),
        ('--out', 'FILE', Path, f'file to write (default {_FILE})', {'default': _FILE}),
        ('--force', 'replace an existing file'),
        ('--yes', 'use the defaults for values without an option, as guesses'),
        JSON)


def _option(quantity: GivenNumber) -> Row:
    """Return the option of a quantity."""
    note = ', in place of --zeta or --damping-ratio; with --beam of its tip'
    if quantity is not DAMPING:
        note = f' (default {_FOLLOWS.get(quantity.key) or format(quantity.default, "g")})'
        if quantity not in QUANTITIES:
            note += ', with ' + ' or '.join(
                f'--{x}' for x in _OF_THEIR_OWN if quantity.key in {y.key for y in FORMS[x]})
        if quantity.key == 'damping_ratio':
            note += '; of a block, in place of --zeta'
        if quantity.key in _FULL:
            note += f'; of a block, twice --{_FULL[quantity.key].replace("_", "-")}'
    unit = f' [{quantity.unit}]' if quantity.unit else ''
    return quantity.option, 'X', argument(quantity.parse), f'{quantity.text}{unit}{note}'


def run(arguments: argparse.Namespace) -> int:
    """Write and print; raise `BadInputError` for invalid input."""
    path: Path = arguments.out
    if not arguments.force and path.exists():
        raise BadInputError(f'{path} exists: name another file with --out, or add --force')
    check_targets(path)
    form, wanted = _wanted(arguments)
    given = _given(arguments, form, wanted)
    joints = joint_names(arguments.joint) or [_JOINT]
    missing = [x for x in wanted if x.key not in OPTIONAL and not _known(x.key, given)]
    if missing and not arguments.yes:
        raise BadInputError(
            f'{", ".join(x.option for x in missing)} {"is" if len(missing) == 1 else "are"} not '
            f'given: expected {"it" if len(missing) == 1 else "them"}, or --yes for the defaults')
    for quantity in wanted:
        if not _known(quantity.key, given):
            given[quantity.key] = default_of(quantity, given)
    from hmsa.api.facts import doubts as doubts_of
    from hmsa.api.facts import facts

    made = _actuator(form, given, arguments.law, arguments.mount)
    found = made.scales
    given.setdefault('shear_modulus', made.block.shear_modulus)
    doubts = doubts_of(made, arguments.mount)
    if missing:
        shown = [f'{x.words} {x.show(given[x.key])}' + (
            ', as the half length' if x.key == 'half_thickness' else '') for x in missing]
        doubts.append(
            f'{"; ".join(shown)} {"is a guess" if len(missing) == 1 else "are guesses"}: a plan '
            'is only as exact as its parameters; measure them and pass the values')
    parameters = _parameters(made)
    table = [f'{name:<26} {value}' for name, value in facts(found, made.block)]
    write_text(path, '\n'.join([
        '# Parameters of an actuator for planner and plant, written by hmsa init:',
        *(f'#   {x}' for x in _starting(path.name, made)),
        '#', '# What follows from them (computed by hmsa init when it wrote this file):',
        *(f'#   {line}' for line in table), '/**:', '  ros__parameters:',
        *_lines(form, parameters, {x.parameter or DAMPING.parameter for x in missing},
                glued=arguments.mount == 'glued'),
        *_joints(joints, made.block), *_sampling(made.block)]) + '\n')
    for doubt in doubts:
        print(f'hmsa: warning: {doubt}', file=sys.stderr)
    return show(
        arguments, {
            'file': path, 'joints': joints, 'parameters': parameters,
            'scales': asdict(found), 'warnings': doubts},
        *table, f'\n{path} written; to use it:',
        *(f'  {x}' for x in _starting(str(path), made)))


def _starting(file: str, made: 'Actuator') -> list[str]:
    """Return the commands that start plant and planner with a parameter file."""
    shaper = ' -p shaper:=modal' if made.block.modes.ratios else ''
    return [f'hmsa {x} --ros-args --params-file {quote(file)}{y}' for x, y in (
        ('plant', ''), ('planner', shaper))]


def _wanted(arguments: argparse.Namespace) -> tuple[str, tuple[GivenNumber, ...]]:
    """Return form and quantities of the actuator; a hyperelastic model has its own constants."""
    form = 'beam' if arguments.beam else 'block'
    if arguments.law is None:
        return form, FORMS[form]
    from hmsa.model.laws import LAWS

    law = LAWS[law_of(arguments.law)[0]]
    if form != 'block' or law.name in _OF_THEIR_OWN:
        own = law.name if form == 'block' else form
        raise BadInputError(
            f'--law {law.name} is given{"" if form == "block" else f" with --{form}"}: expected '
            f'--{own} for a {own}, which has a law of its own, and --law for a block')
    none = ('shear_modulus', 'j_lim') if law.scaled else ('j_lim',) if law.endless else ()
    return form, tuple(x for x in QUANTITIES if x.key not in none)


def _given(
        arguments: argparse.Namespace, form: str,
        wanted: Sequence[GivenNumber]) -> dict[str, float]:
    """Return the values of the options, after checking their combination."""
    given = {x.key: value for x in (*EVERY, DAMPING)
             if (value := getattr(arguments, x.key)) is not None}
    for full, half in _FULL.items() if form == 'block' else ():
        if full in given and half in given:
            raise BadInputError(
                f'both --{full} and --{half.replace("_", "-")} are given: expected one of them')
        if full in given:
            given[half] = 0.5 * given.pop(full)
    damped = [f'--{x.replace("_", "-")}' for x in _DAMPED if x in given]
    if len(damped) > 1:
        raise BadInputError(f'both {" and ".join(damped[:2])} are given: expected one of them')
    if form == 'beam' and 'shear_modulus' in given:
        if 'youngs_modulus' in given:
            raise BadInputError(
                'both --shear-modulus and --youngs-modulus are given: expected one of them, '
                'since E is 3 G')
        given['youngs_modulus'] = 3.0 * given.pop('shear_modulus')
    # zeta is of a block only.
    if others := given.keys() - {x.key for x in wanted} - {*_DAMPED[1:]}:
        own = [x for x in _OF_THEIR_OWN if others <= {y.key for y in FORMS[x]}]
        raise BadInputError(
            f'{", ".join(sorted("--" + x.replace("_", "-") for x in others))} is given: expected '
            + (f'constants of --law {arguments.law.partition(":")[0]} in its place'
               if arguments.law is not None and others <= {x.key for x in QUANTITIES}
               else f'--{own[0]} with it' if form == 'block' and own
               else f'sizes of a {form}, or others of {", ".join(x.option for x in wanted)}'))
    return given


def _known(key: str, given: Mapping[str, float]) -> bool:
    """Return whether a value is given, or another one of damping instead."""
    return key in given or (key in _DAMPED and any(x in given for x in _DAMPED))


def _actuator(
        form: str, given: Mapping[str, float], law: str | None, mount: str) -> 'Actuator':
    """Return the actuator with its coil."""
    from hmsa.api.actuator import Actuator
    from hmsa.api.facts import unquestioned

    values: dict[str, Any] = {
        _ARGUMENTS.get(x, x): given[x]
        for x in (*(y.key for y in FORMS[form] if y.key not in (*_COIL, *_DAMPED)), *_DAMPED)
        if x in given}
    if mount != MOUNTS[0]:
        values['mount'] = mount
    values |= {'flux_density_limits': (given['flux_min'], given['flux_max']),
               'slew_limit': given['slew_limit'] or math.inf}
    if law is not None:
        values['law'], values['constants'] = law_of(law)
    with unquestioned():  # of which `run` prints the doubts
        return (Actuator.beam if form == 'beam' else Actuator)(**values)


def _lines(
        form: str, parameters: Mapping[str, Any], guessed: Collection[str], *, glued: bool
) -> list[str]:
    """Return the nodes' parameters in YAML, each below its description, which marks guesses."""
    texts = {x.name: (x.description.rstrip('.'), x.unit) for x in (*LAW, BULK_RATIO, *MODES)} | {
        x.parameter: (x.text, x.unit) for x in (*QUANTITIES, DAMPING)}
    if form == 'beam':
        texts |= {
            x.parameter: (('half of the ' if 'half_' in x.parameter else '') + x.text, x.unit)
            for x in FORMS['beam']} | {
            LAW_NAME.name: ('a beam: positions are deflections of the tip over the length', ''),
            DAMPING.parameter: ('damping coefficient of the tip', DAMPING.unit)}
    if glued:
        name = 'actuator.shear_modulus'
        text, unit = texts[name]
        texts[name] = (
            f'{text} of the material, times the relative stiffness of a glued block', unit)
    lines = []
    for name, value in parameters.items():
        text, unit = texts[name]
        lines += [f'    # {text[0].upper()}{text[1:]}{f" [{unit}]" if unit else ""}'
                  f'{", a guess" if name in guessed else ""}.',
                  f'    {name}: {yaml_text(value)}']
    return lines


def _joints(joints: list[str], block: 'ActuatorParameters') -> list[str]:
    """Return the lines with the joint names."""
    if len(joints) == 1:
        return ['    # Name of the joint in trajectories and joint states.',
                f'    joint: {yaml_text(joints[0])}']
    return [
        '    # Names of the joints; all are identical except for what is set for one, such as',
        f'    # {joints[0]}.actuator.remanence: {yaml_text(block.remanence)}',
        f'    joints: {yaml_text(joints)}']


def _sampling(actuator: 'ActuatorParameters') -> list[str]:
    """Return lines with the plant's sample rate if the default misses the actuator's peaks."""
    from hmsa.interfaces.actuator import enough_samples

    default, largest = cast(float, PUBLISH_RATE.default), cast(float, PUBLISH_RATE.maximum)
    # Twice the rate that just resolves the peaks, if a plant sustains it in real time.
    least = enough_samples(actuator)
    enough = max(least, min(2.0 * least, _KEPT_UP))
    if enough <= default:
        return []
    digits = 10 ** (math.floor(math.log10(enough)) - 1)
    rate = min(math.ceil(enough / digits) * digits, largest)
    slower = [] if rate <= 1.1 * _KEPT_UP else [
        '    # A plant may not keep up with it in real time: set publish_clock and',
        '    # real_time_factor to simulate more slowly.']
    return [
        '    # Sample rate of the plant: at least 10 samples per period of the actuator [Hz].',
        *slower, f'    publish_rate: {rate:.1f}']


def _parameters(made: 'Actuator') -> dict[str, Any]:
    """Return the nodes' parameters by name."""
    values = made.parameters
    del values['coil_time_constant']
    if made.block.law is not None:
        # They follow from other parameters, or have no effect.
        del values['actuator.shear_modulus'], values['actuator.chain_limit']
    return values
