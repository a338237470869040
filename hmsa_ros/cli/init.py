"""``hmsa init``: a parameter file for one's own actuator, with what follows from it."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import asdict
import json
import math
from pathlib import Path
import sys
from typing import Any, cast, TYPE_CHECKING

from hmsa_ros.cli.quantities import (
    BY_KEY,
    DAMPING,
    default_of,
    joint_names,
    NEEDED,
    QUANTITIES,
    Quantity,
)
from hmsa_ros.contract.parameters import PUBLISH_RATE
from hmsa_ros.errors import BadInputError
from hmsa_ros.files import write_text

if TYPE_CHECKING:
    from hmsa_ros.core.parameters import ActuatorParameters
    from hmsa_ros.core.scales import Coil, Scales

_JOINT = 'actuator'
_FILE = Path('actuator.yaml')
_FOLLOWS = {'half_thickness': 'as --half-length', 'flux_min': 'minus --flux-max'}
# What differs much from one elastomer to another, and no data sheet gives.
_GUESSES = ('zeta', 'j_lim')
# The coil's reach that is hardly a motion.
_HARDLY = 0.01


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        'init', help='write a parameter file for your own actuator',
        description='Write a parameter file of your own actuator for planner and plant '
                    '(--params-file), and print what follows from it: times, damping, flux '
                    'densities and reach. Asks for each value that no option gives. Numbers are '
                    'in SI units unless a unit follows: 10mm, "50 kPa".',
        epilog='example: hmsa init --half-length 5mm --half-thickness 5mm --density 1.9g/cm3 \\\n'
               '    --shear-modulus 30kPa --j-lim 20 --zeta 0.1 --remanence 80mT \\\n'
               '    --flux-max 200mT --out my_actuator.yaml')
    for quantity in QUANTITIES:
        unit = f' [{quantity.unit}]' if quantity.unit else ''
        default = _FOLLOWS.get(quantity.key) or f'{quantity.default:g}'
        parser.add_argument(
            quantity.option, type=_reader(quantity), metavar='X', dest=quantity.key,
            help=f'{quantity.text}{unit} (default {default})')
    parser.add_argument(
        DAMPING.option, type=_reader(DAMPING), metavar='X', dest=DAMPING.key,
        help=f'{DAMPING.text} [{DAMPING.unit}], in place of --zeta')
    parser.add_argument(
        '--joint', default='', metavar='NAME',
        help=f'joint name (default {_JOINT}), or several separated by commas for identical '
             'actuators')
    parser.add_argument(
        '--out', type=Path, default=_FILE, metavar='FILE',
        help=f'file to write (default {_FILE})')
    parser.add_argument('--force', action='store_true', help='replace an existing file')
    parser.add_argument(
        '--yes', action='store_true', help='do not ask; use the defaults for values that are '
                                           'not given')
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    parser.set_defaults(run=run)


def _reader(quantity: Quantity) -> Callable[[str], float]:
    """Return the reader of an option's value."""
    def read(text: str) -> float:
        try:
            return quantity.parse(text)
        except BadInputError as error:
            raise argparse.ArgumentTypeError(str(error)) from error
    return read


def run(arguments: argparse.Namespace) -> int:
    """
    Ask, write and print.

    Raises
    ------
    BadInputError
        If a number is missing or out of range, or the file exists or cannot be written.

    """
    path: Path = arguments.out
    if not arguments.force and path.exists():
        raise BadInputError(f'{path} exists: name another file with --out, or add --force')
    if not path.resolve().parent.is_dir():
        raise BadInputError(
            f'cannot write {path}: {path.parent} is no folder; expected one that exists (--out)')
    if arguments.zeta is not None and arguments.damping is not None:
        raise BadInputError('both --zeta and --damping are given: expected one of them')
    given = {key: getattr(arguments, key) for key in (*BY_KEY, DAMPING.key)
             if getattr(arguments, key) is not None}
    joints = joint_names(arguments.joint)
    missing = [key for key in NEEDED
               if key not in given and not (key == 'zeta' and DAMPING.key in given)]
    if missing and not arguments.yes:
        if not sys.stdin.isatty():
            raise BadInputError(
                'standard input is not a terminal, and '
                f'{", ".join(BY_KEY[x].option for x in missing)} '
                f'{"is" if len(missing) == 1 else "are"} not given: give them, or add --yes for '
                'the defaults')
        given, joints = _ask(given, joints)
    guessed = [key for key in _GUESSES if key in missing and arguments.yes]
    for key, quantity in BY_KEY.items():
        if key not in given and not (key == 'zeta' and DAMPING.key in given):
            given[key] = default_of(quantity, given)
    actuator, coil = _records(given)

    from hmsa_ros.core.scales import scales

    found = scales(actuator, coil)
    doubts = _doubts(given, found)
    if guessed:
        doubts.append(
            f'{" and ".join(f"{BY_KEY[x].words} {given[x]:g}" for x in guessed)} '
            f'{"is a guess" if len(guessed) == 1 else "are guesses"}: a plan is only as exact '
            'as its parameters; measure them and pass the values')
    joints = joints or [_JOINT]
    write_text(path, file_text(path, actuator, coil, joints, found))
    for doubt in doubts:
        print(f'hmsa: warning: {doubt}', file=sys.stderr)
    if arguments.json:
        print(json.dumps({
            'file': str(path), 'joints': joints, 'parameters': _parameters(actuator, coil),
            'scales': {key: None if isinstance(x, float) and math.isnan(x) else x
                       for key, x in asdict(found).items()},
            'warnings': doubts}, indent=2))
        return 0
    for line in table(found):
        print(line)
    print(f'\n{path} written; to use it:')
    for node in ('plant', 'planner'):
        print(f'  hmsa {node} --ros-args --params-file {path}')
    return 0


def _ask(
        given: Mapping[str, float], joints: list[str]) -> tuple[dict[str, float], list[str]]:
    """Ask for what is not given."""
    answers = dict(given)
    print(
        'Numbers are in the unit shown unless another unit follows: 10 mm, 50 kPa. Press Enter '
        'for the value in brackets.', file=sys.stderr)
    for quantity in QUANTITIES:
        key = quantity.key
        if key in answers or (key == 'zeta' and DAMPING.key in answers):
            continue
        default = default_of(quantity, answers)
        while True:
            words = quantity.text + (', or c in N s/m with its unit' if key == 'zeta' else '')
            text = _answer(f'{words} [{quantity.show(default)}]: ')
            try:
                if key == 'zeta' and text.replace(' ', '').endswith('Ns/m'):
                    answers[DAMPING.key] = DAMPING.parse(text)
                    break
                value = quantity.parse(text) if text else default
            except BadInputError as error:
                print(f'  {error}', file=sys.stderr)
                continue
            doubt = quantity.doubt(value)
            if doubt and text:
                # Once more, with the number as it is for what Enter takes.
                print(f'  {doubt}', file=sys.stderr)
                default = value
                continue
            answers[key] = value
            break
    while not joints:
        text = _answer(f'joint name, or several separated by commas [{_JOINT}]: ')
        try:
            joints = joint_names(text) or [_JOINT]
        except BadInputError as error:
            print(f'  {error}', file=sys.stderr)
    return answers, joints


def _answer(question: str) -> str:
    """Ask on the terminal; what is printed there is no result."""
    print(question, end='', file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        print(file=sys.stderr)
        raise BadInputError('the input ended before the last question: nothing was written')
    return line.strip()


def _records(given: Mapping[str, float]) -> 'tuple[ActuatorParameters, Coil]':
    """Return the block and its coil."""
    from hmsa_ros.core.creep import Creep
    from hmsa_ros.core.parameters import ActuatorParameters
    from hmsa_ros.core.scales import Coil

    damping = given.get(DAMPING.key)
    if damping is None:
        damping = (
            8.0 * given['zeta'] * given['half_length'] * given['half_thickness']
            * math.sqrt(given['density'] * given['shear_modulus']))
    block = {x.parameter.partition('.')[2]: given[x.key] for x in QUANTITIES
             if x.parameter.startswith('actuator.')}
    return (
        ActuatorParameters(
            damping_coefficient=damping, law=None, creep=Creep(), **block),
        Coil(given['flux_min'], given['flux_max'], given['slew_limit']))


def _doubts(given: Mapping[str, float], found: 'Scales') -> list[str]:
    """Return what is implausible, a sentence each."""
    values = {**given, 'zeta': found.zeta}
    doubts = [x for quantity in QUANTITIES if (x := quantity.doubt(values[quantity.key]))]
    if found.zeta >= found.critical_zeta:
        doubts.append(
            f'zeta {found.zeta:g} is above the critical {found.critical_zeta:g}: small motion '
            'about rest does not oscillate, and there is no two-step command for it')
    if max(abs(x - 1.0) for x in found.held) < _HARDLY:
        doubts.append(
            f'the coil only reaches stretches from {found.held[0]:.6g} to {found.held[1]:.6g}: '
            f'a stretch of 1.1 or 0.9 needs about {0.3 * found.flux_density_unit:.3g} T')
    ratio = given['half_thickness'] / given['half_length']
    if not 0.05 <= ratio <= 20.0:
        doubts.append(
            f'half thickness over half length is {ratio:.3g}: the model describes a block with '
            'sides of similar length; a thin film or a long rod bends instead')
    return doubts


def table(found: 'Scales') -> list[str]:
    """Return what follows from the parameters, aligned, a line each."""
    rows = [
        ('time unit L sqrt(rho/G)', _time(found.time_unit)),
        ('natural frequency at rest', f'{found.frequency:.5g} Hz'),
        ('damping', f'{found.damping:.4g} N s/m, zeta {found.zeta:.4g}'),
        ('critical damping at rest',
         f'{found.critical_damping:.4g} N s/m, zeta {found.critical_zeta:.4g}'),
        ('limiting stretches', '{:.4f} and {:.4f}'.format(*found.stretch_limits)),
        ('shape c1', f'{found.c1:.4g}'),
        *((f'flux density for {stretch:.6g}', f'{1e3 * flux:.4g} mT')
          for stretch, flux in found.flux_densities),
        ('coil holds stretches', _range(found.held)),
        ('two steps reach from rest',
         'nothing' if found.reached == (1.0, 1.0) else _range(found.reached)),
        ('a move from rest', 'none in two steps' if math.isnan(found.duration)
         else f'{_time(found.duration)} to {found.target:.6g}'),
    ]
    return [f'{name:<26} {value}' for name, value in rows]


def _range(ends: tuple[float, float]) -> str:
    return f'{ends[0]:.6g} to {ends[1]:.6g}'


def _time(seconds: float) -> str:
    """Return a time in a unit that suits it."""
    for size, unit in ((1.0, 's'), (1e-3, 'ms')):
        if seconds >= size:
            return f'{seconds / size:.4g} {unit}'
    return f'{seconds * 1e6:.4g} us'


def file_text(
        path: Path, actuator: 'ActuatorParameters', coil: 'Coil', joints: list[str],
        found: 'Scales') -> str:
    """Return the parameter file in ROS 2's YAML; its name and the scales go into comments."""
    lines = [
        '# Parameters of an actuator for planner and plant, written by hmsa init:',
        f'#   hmsa plant --ros-args --params-file {path.name}',
        f'#   hmsa planner --ros-args --params-file {path.name}',
        '#', '# What follows from them (computed by hmsa init when it wrote this file):',
        *(f'#   {line}' for line in table(found)),
        '/**:', '  ros__parameters:']
    texts = {x.parameter: (x.text, x.unit) for x in (*QUANTITIES, DAMPING)}
    for name, value in _parameters(actuator, coil).items():
        text, unit = texts[name]
        lines += [f'    # {text[0].upper()}{text[1:]}{f" [{unit}]" if unit else ""}.',
                  f'    {name}: {_number(value)}']
    if len(joints) == 1:
        lines += ['    # Name of the joint in trajectories and joint states.',
                  f"    joint: '{joints[0]}'"]
    else:
        names = ', '.join(f"'{x}'" for x in joints)
        lines += [
            '    # Names of the joints; all are identical except for what is set for one, such '
            'as',
            f'    # {joints[0]}.actuator.remanence: {_number(actuator.remanence)}',
            f'    joints: [{names}]']
    return '\n'.join(lines + _sampling(actuator)) + '\n'


def _sampling(actuator: 'ActuatorParameters') -> list[str]:
    """Return lines with the plant's sample rate, if its default misses the actuator's peaks."""
    from hmsa_ros.device.health import enough_samples

    default, largest = cast(float, PUBLISH_RATE.default), cast(float, PUBLISH_RATE.maximum)
    # Twice what just shows the peaks.
    enough = 2.0 * enough_samples(actuator)
    if enough <= default:
        return []
    digits = 10 ** (math.floor(math.log10(enough)) - 1)
    rate = min(math.ceil(enough / digits) * digits, largest)
    return [
        '    # Sample rate of the plant: at least 20 samples per period of the actuator [Hz].',
        f'    publish_rate: {_number(rate)}']


def _parameters(actuator: 'ActuatorParameters', coil: 'Coil') -> dict[str, float]:
    """Return the nodes' parameters by name."""
    return {
        **{f'actuator.{name}': value for name, value in actuator.numbers.items()},
        **asdict(coil)}


def _number(value: float) -> str:
    """Return a number that every reader of YAML takes for a float."""
    text = repr(float(value))
    mantissa, letter, exponent = text.partition('e')
    return f'{mantissa}.0e{exponent}' if letter and '.' not in mantissa else text
