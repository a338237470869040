"""Options of commands as table rows, and setpoints on the command line."""

import argparse
from collections.abc import Callable, Iterable
import inspect
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING, TypeVar

from hmsa.errors import assume, BadInputError, check_choice, check_number, excerpt

if TYPE_CHECKING:
    from hmsa.api.actuator import Actuator

T = TypeVar('T')
#: Names, metavar, type, help and any further settings of argparse; for a flag, name and help; for
#: a group, its title and a list of its rows.
Row = tuple[Any, ...]

JSON: Row = ('--json', 'print one JSON object')
NAMESPACE: Row = ('--namespace', 'NS', str, 'namespace of the planner', {'default': ''})
JOINTS: Row = (
    '--joint', 'NAMES', str, 'joint, or several separated by commas (default actuator)',
    {'default': 'actuator'})
EXAMPLE: Row = (
    '--params-file', 'YAML', Path, 'parameter file of the actuator (default: the example block)')
TIMEOUT: Row = (
    '--timeout', 'S', float, 'seconds to wait for a reply (default 10 s)', {'default': 10.0})
#: Dimensionless parameters of a block: option, metavar and description.
MATERIAL = (
    ('--zeta', 'Z', 'dimensionless damping, at least 0 (default 0.2)'),
    ('--j-lim', 'J', 'Gent limiting extensibility J_lim, above 0 (default 5)'),
    ('--c1', 'C', 'shape 2 H^2/L^2, above 0 (default 2)'))

LAW_OPTION: Row = (
    '--law', 'NAME:KEY=VALUE,...', str,
    'hyperelastic model and its constants (moduli in Pa or with a unit, in dimensionless plans in '
    'any common unit; values of a list separated by /), such as yeoh:c10=15kPa,c20=500 or '
    'ogden:mu=6e3/100,alpha=1.3/5')


def law_of(text: str) -> tuple[str, dict[str, Any]]:
    """Return name and constants of `LAW_OPTION`; raise `BadInputError` if invalid."""
    from hmsa.interfaces.quantities import quantity_of
    from hmsa.model.laws import LAWS

    name, _, rest = text.partition(':')
    check_choice('--law', name, LAWS)
    known = {x.name.partition('.')[2]: x for x in LAWS[name].constants}
    constants: dict[str, Any] = {}
    for part in filter(None, rest.split(',')):
        key, equals, value = (x.strip() for x in part.partition('='))
        if not equals or key not in known:
            raise BadInputError(
                f'--law {name} has {excerpt(part)}: expected KEY=VALUE with a key of '
                f'{", ".join(known) or "none, since it has no constants"}')
        kind, unit = known[key].kind, known[key].unit
        constants[key] = value if kind is str else [
            quantity_of(x, unit, key) for x in value.split('/')] if kind is list else quantity_of(
                value, unit, key)
    # Other constants, such as those of a beam, are in a parameter file.
    if known and not constants and {x.unit for x in known.values()} <= {'Pa', ''}:
        raise BadInputError(
            f'--law {name} has no constants: expected {", ".join(known)}, as in --law '
            f'{name}:{next(iter(known))}=VALUE')
    return name, constants


def argument(read: Callable[[str], T]) -> Callable[[str], T]:
    """Return an argument type for argparse that shows a `BadInputError` unchanged."""
    def read_argument(text: str) -> T:
        try:
            return read(text)
        except BadInputError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return read_argument


def of_unit(option: str, unit: str, text: str) -> Row:
    """Return an option for a number above 0, in SI or with another unit."""
    def read(words: str) -> float:
        from hmsa.interfaces.quantities import quantity_of

        name = option.removeprefix('--').replace('-', ' ')
        value = quantity_of(words, unit, name)
        check_number(name, value, unit, above=0.0)
        return value

    return option, 'X', argument(read), f'{text} [{unit}]'


def temperature_option(text: str) -> Row:
    """Return the option for a temperature in degrees Celsius, with or without the unit."""
    def read(words: str) -> float:
        from hmsa.interfaces.quantities import quantity_of
        from hmsa.model.thermal import checked_temperature

        return checked_temperature(quantity_of(words, 'degC', 'temperature'))

    return '--temperature', 'T', argument(read), text


def frequency(option: str, text: str, **settings: Any) -> Row:
    """Return an option for a frequency in Hz or with a unit."""
    def read(words: str) -> float:
        from hmsa.interfaces.quantities import quantity_of

        return quantity_of(words, 'Hz', option.removeprefix('--'))

    return option, 'HZ', argument(read), text, settings


def actuator_of(path: Path | None) -> 'Actuator':
    """Return the actuator of a parameter file, or the example block, which is said."""
    from hmsa.api.actuator import Actuator

    if path is not None:
        return Actuator.from_yaml(path)
    assume_example()
    return Actuator()


def assume_example() -> None:
    """State that a command without a parameter file assumes the example block."""
    from hmsa.model.parameters import paper_actuator

    block = paper_actuator()
    assume(
        'without --params-file the actuator is the example block: '
        f'{2e3 * block.half_length:g} mm x {2e3 * block.half_length:g} mm x '
        f'{2e3 * block.half_thickness:g} mm, shear modulus {1e-3 * block.shear_modulus:g} kPa, '
        f'remanence {1e3 * block.remanence:g} mT, natural frequency about '
        f'{1.0 / block.period:.3g} Hz')


# What a parameter file says of planning: the option for it, if there is one, and the defaults.
_PLANNING: dict[str, tuple[Any, ...]] = {
    'shaper': ('shaper', 'two_step'), 'robust_order': ('order', 2),
    'minimax_errors': ('errors', [0.1, 0.1, 0.1]), 'minimax_file': ('', ''),
    'smooth_periods': ('periods', 1.0), 'stretch_rate_max': ('max_rate', 0.0),
    'initial_stretch': ('start', 1.0, 0.0), 'command_mode': ('', 'continuous'),
    'short_spell': ('', 'refuse')}


def assume_options(arguments: argparse.Namespace) -> None:
    """
    State what a parameter file says of planning and a command without ROS does not use.

    Such a command takes actuator and coil from the file, and how to plan from its options.
    """
    from hmsa.interfaces.topics import PLANNER
    from hmsa.runs.parameters import read_parameter_file

    known = {action.dest: action for action in arguments.parser._actions}
    values, unused = read_parameter_file(arguments.params_file), []
    for name, (option, *defaults) in _PLANNING.items():
        value = values.get(f'{PLANNER}.{name}')
        given = option in known and getattr(arguments, option) != known[option].default
        if not (given or value is None or value in defaults):
            unused.append(f'{name} {value}' + (
                f' (see --{option.replace("_", "-")})' if option in known else ''))
    if unused:
        assume(
            f'{arguments.params_file}: {", ".join(unused)} {"is" if len(unused) == 1 else "are"} '
            'not used, since options, not the file, determine how to plan')


def timeout_of(arguments: argparse.Namespace) -> float:
    """Return the time limit in s; raise `BadInputError` if invalid."""
    timeout: float = arguments.timeout
    check_number('timeout', timeout, 's', above=0.0, endless=True)
    return timeout


def add_command(
        subparsers: Any, name: str, text: str | None, *rows: Row,
        run: Callable[[argparse.Namespace], int] | None = None) -> Any:
    """
    Add a command described by a docstring, and return its parser.

    ``run`` carries out a subcommand; a module has a function of that name.

    The first line of the docstring is the help in the list of commands. Its last paragraph, which
    begins with ``example:``, keeps its line breaks. ``name`` may be the name of a module.
    """
    what, _, rest = inspect.cleandoc(text or '').partition('\n\n')
    description, _, example = rest.rpartition('example: ')
    what = what.rstrip('.')
    parser = subparsers.add_parser(
        name.rpartition('.')[2].replace('_', '-'), help=what[:1].lower() + what[1:],
        description=description or f'{what}.', epilog=f'example: {example}')
    add_options(parser, *rows)
    if run is not None:
        parser.set_defaults(parser=parser, run=run)
    return parser


def bags(name: str) -> Row:
    """Return the argument for one or more bags."""
    return name, 'BAG', Path, 'folder of a bag, or one of its files', {'nargs': '+'}


def add_options(parser: Any, *rows: Row, needs: tuple[str, ...] = ()) -> None:
    """
    Add arguments in the order of the help.

    Each option may need one of others, as in ``{'needs': ('--shaper robust',)}``, or a group.
    """
    for names, *texts in rows:
        settings = dict(texts.pop()) if isinstance(texts[-1], dict) else {}
        if isinstance(texts[0], list):
            add_options(parser.add_argument_group(names), *texts[0], **settings)
            continue
        needed = settings.pop('needs', needs)
        if len(texts) == 1:
            action = parser.add_argument(names, action='store_true', help=texts[0])
        else:
            metavar, kind, text = texts
            action = parser.add_argument(
                *names.split(), metavar=metavar, type=kind, help=text, **settings)
        action.needs = needed


def check_needs(arguments: argparse.Namespace) -> None:
    """Raise `BadInputError` for an option that has no effect without another one."""
    actions = {y: x for x in arguments.parser._actions for y in x.option_strings}

    def given(option: str, value: str = '') -> bool:
        found = getattr(arguments, actions[option].dest)
        return found == value if value else found not in (None, False, actions[option].default)

    for option, needs in given_with_needs(arguments):
        if not any(given(*x.split()) for x in needs):
            raise BadInputError(f'{option} needs {" or ".join(needs)}')


def given_with_needs(arguments: argparse.Namespace) -> list[tuple[str, tuple[str, ...]]]:
    """Return the given options that need others, and these."""
    return [
        (action.option_strings[0], needs) for action in arguments.parser._actions
        if (needs := getattr(action, 'needs', ()))
        and getattr(arguments, action.dest) not in (None, False, action.default)]


def show(
        arguments: argparse.Namespace, record: dict[str, Any], *lines: object,
        written: Iterable[Path | None] = ()) -> int:
    """Print a result as JSON with --json, otherwise as lines with the files written; return 0."""
    from hmsa.cli.terminal import show_notes, under_way, with_notes
    from hmsa.files import json_text

    show_notes()
    with under_way():  # a pager takes the lines when it likes
        for line in [json_text(with_notes(record))] if arguments.json else [
                *lines, *(f'{x} written' for x in written if x is not None)]:
            print(line)
    return 0


def sequence_of(
        arguments: argparse.Namespace) -> tuple[list[tuple[float, float]], list[list[float]]]:
    """
    Return times in s and flux densities in T of --levels, and the points of --path.

    Each point contains time in s, stretch, rate and acceleration. Raises `BadInputError` unless
    exactly one of setpoints, levels and path is given and valid.
    """
    given = [x for x, y in (
        ('setpoints', arguments.setpoints), ('--levels', arguments.levels),
        ('--path', arguments.path)) if y]
    if len(given) != 1:
        raise BadInputError(
            (f'both {" and ".join(given[:2])} are given' if given
             else 'neither setpoints nor --levels nor --path are given')
            + ': expected STRETCH:SECONDS ..., or --levels CSV, or --path CSV')
    if arguments.path is not None:
        from hmsa.api.paths import read_path, smooth_points

        return [], smooth_points(*read_path(arguments.path)).tolist()
    if arguments.levels is None:
        return [], []
    if arguments.levels.suffix.lower() in ('.yaml', '.yml'):
        from hmsa.identification.learning import levels_in

        rows = levels_in(arguments.levels)
    else:
        from hmsa.identification.measurement import read_levels

        times, levels = read_levels(arguments.levels)
        rows = list(zip(times.tolist(), levels.tolist(), strict=True))
    return [(x - rows[0][0], y) for x, y in rows], []


def setpoint(text: str) -> tuple[float, float]:
    """Read stretch and duration from ``'1.10:10'``; raise `BadInputError` if invalid."""
    stretches, span = setpoint_of_joints(text)
    if len(stretches) > 1:
        raise _no_setpoint(text)
    return stretches[0], span


def setpoint_of_joints(text: str) -> tuple[tuple[float, ...], float]:
    """Read stretches and duration from ``'1.10,1.20:10'``; raise `BadInputError` if invalid."""
    from hmsa.model.moves import Setpoint

    stretches, _, span = text.partition(':')
    try:
        found = [Setpoint(float(stretch), float(span)) for stretch in stretches.split(',')]
        if math.isinf(found[0].span):
            raise BadInputError('duration is inf: expected a finite number')
    except BadInputError as error:
        raise BadInputError(f'{text!r}: {error}') from error
    except ValueError:
        raise _no_setpoint(text) from None
    return tuple(x.stretch for x in found), found[0].span


def _no_setpoint(text: str) -> BadInputError:
    return BadInputError(f'{text!r}: expected STRETCH:DURATION, two numbers such as 1.10:10')


#: Options for the sequence: setpoints, or a file of levels or of a path.
SEQUENCE: tuple[Row, ...] = (
    ('setpoints', 'STRETCH:SECONDS', argument(setpoint_of_joints),
     'target stretch, or deflection of a beam, and its duration in s (move plus hold); with '
     'several joints, one stretch for all or one per joint, as in 1.10,1.20:2', {'nargs': '*'}),
    ('--levels', 'CSV', Path,
     'instead of setpoints: CSV with the columns time and flux_density, as hmsa excite writes it, '
     'or YAML of hmsa learn. The levels are sent unchanged if they respect the limits of coil and '
     'block; levels that do not end at rest are followed by a shaped move to rest'),
    ('--path', 'CSV', Path,
     'instead of setpoints: CSV with the columns time and stretch, as hmsa wave --path writes it. '
     'The planner, whose trajectory_mode must be path, follows it from rest to rest. With '
     'feedback: adapt, the planner corrects the path in progress'))
