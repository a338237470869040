"""
Parameters shared by nodes, files and reports: name, default, unit, range and description.

`ParameterSpec` is one entry. Parameters of a single node are declared in its module. The sections
of a parameter file, and the nodes that read them, follow the rules of ROS 2.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
import math
import re
from typing import Any

from hmsa.errors import BadInputError, check_choice, excerpt
from hmsa.model.creep import CONSTANTS, FLOWS
from hmsa.model.laws import LAWS
from hmsa.model.thermal import COLDEST, HOTTEST, Thermal

#: Words that YAML reads as false or true unless quoted.
WORDS = {False: ('off', 'no'), True: ('on', 'yes')}

Value = bool | int | float | str | list[str] | list[float]


# Numbers that PyYAML reads as text, and ROS 2 as numbers.
_POWER = re.compile(r'[+-]?(\d+\.?\d*|\.\d+)[eE][+-]?\d+', re.ASCII)

_KEY = 'ros__parameters'


def number_of(value: object) -> float | None:
    """Return a number as a float; None for other types, NaN and numbers that are too large."""
    if isinstance(value, str) and _POWER.fullmatch(value):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return None if math.isnan(number) else number


@dataclass(frozen=True)
class ParameterSpec:
    """
    One parameter: name in snake case, default, and permitted values.

    The type of the default is that of the parameter; ``items`` is the type of list items. The
    description is a sentence without the unit, which is empty for a dimensionless value. Numbers
    and list items may have a closed range, strings may have choices. A ``read_only`` parameter is
    fixed at startup.
    """

    name: str
    default: Value
    description: str
    unit: str = ''
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = True
    items: type = str

    def taken(self, value: Any) -> Any:
        """
        Check a value and return it as used by the nodes; a single list item becomes a list.

        An unquoted word that YAML reads as a boolean is interpreted as the choice of that name.

        Raises
        ------
        BadInputError
            If it has the wrong type, is outside the range or is not one of the choices.

        """
        if isinstance(self.default, list):
            value = self._as_list(value)
            for item in value:
                self.check(item)
            return value
        if isinstance(value, bool):
            value = next((x for x in self.choices if x in WORDS[value]), value)
        if isinstance(self.default, str) and not isinstance(value, str):
            raise BadInputError(
                f'parameter {self.name} is {excerpt(value)}: expected a text')
        if isinstance(self.default, float):
            number = number_of(value)
            if number is None:
                raise BadInputError(
                    f'parameter {self.name} is {excerpt(value)}: expected a number, '
                    + self.range_text())
            value = number
        self.check(value)
        return value

    def _as_list(self, value: Any) -> list[Any]:
        if value is None:
            return []
        several = not isinstance(value, str) and (
            isinstance(value, Sequence) or hasattr(value, 'typecode'))
        values = list(value) if several else [value]
        if self.items is float:
            values, of = [number_of(x) for x in values], 'numbers'
        else:
            values, of = [x if isinstance(x, str) else None for x in values], 'strings'
        if None in values:
            raise BadInputError(
                f'parameter {self.name} is {excerpt(value)}: expected a list of {of}')
        return values

    def check(self, value: Any) -> None:
        """
        Check the range or the choices of a value.

        Raises
        ------
        BadInputError
            If it is not finite, outside the range or not one of the choices.

        """
        if isinstance(value, float) and not (math.isfinite(value) or value == self.maximum):
            raise BadInputError(
                f'parameter {self.name} is {value}: expected a finite number')
        if self.choices:
            check_choice(f'parameter {self.name}', value, self.choices)
        if isinstance(value, (int, float)) and not (
                (self.minimum is None or value >= self.minimum)
                and (self.maximum is None or value <= self.maximum)):
            raise BadInputError(
                f'parameter {self.name} is {value:g}: expected {self.range_text()}')

    def range_text(self) -> str:
        """Return the range in words, for example ``'at least 0 s'``."""
        unit = f' {self.unit}' if self.unit else ''
        if self.minimum is None and self.maximum is None:
            return 'any value'
        if self.maximum is None:
            return f'at least {self.minimum:g}{unit}'
        if self.minimum is None:
            return f'at most {self.maximum:g}{unit}'
        return f'{self.minimum:g} to {self.maximum:g}{unit}'


def duration_specs(
        name: str, seconds: int, description: str, least: int = 0, most: int | None = None, *,
        nanoseconds: int = 0) -> tuple[ParameterSpec, ParameterSpec]:
    """Return a duration in the style of rosbag2: whole seconds plus nanoseconds."""
    return (
        ParameterSpec(f'{name}.sec', seconds, description, 's', least, most),
        ParameterSpec(
            f'{name}.nsec', nanoseconds, 'Nanoseconds to add to the seconds.', 'ns',
            0, 999_999_999))


def duration_from(values: Mapping[str, Any], name: str) -> int:
    """Return a duration of `duration_specs` in ns, -1 for a negative one."""
    seconds: int = values[f'{name}.sec']
    nanoseconds: int = values[f'{name}.nsec']
    return -1 if seconds < 0 else seconds * 10**9 + nanoseconds


#: zeta of the example block.
ZETA = 0.2

#: Parameters of the block, common to planner and plant; the defaults are the example block's.
ACTUATOR = (
    ParameterSpec(
        'actuator.shear_modulus', 1e4, 'Shear modulus G.', 'Pa',
        1e-3, 1e12),
    ParameterSpec(
        'actuator.density', 1900.0, 'Density rho.', 'kg/m^3', 1e-3, 1e6),
    ParameterSpec(
        'actuator.half_length', 0.01,
        'Half length L of the block, across the field.', 'm', 1e-9, 1e3),
    ParameterSpec(
        'actuator.half_thickness', 0.01,
        'Half thickness H of the block, along the field.', 'm', 1e-9, 1e3),
    ParameterSpec(
        'actuator.remanence', 0.1, 'Remanence Br.', 'T', 1e-9, 1e3),
    ParameterSpec(
        'actuator.chain_limit', 5.0,
        'Gent limiting extensibility J_lim; .inf gives neo-Hookean.', '',
        1e-3, math.inf),
    ParameterSpec(
        'actuator.damping_coefficient', 8.0 * ZETA * 0.01 * 0.01 * math.sqrt(1900.0 * 1e4),
        'Damping coefficient c; zeta = c/(8 L H sqrt(rho G)).', 'N s/m', 0.0, 1e12),
)


def _of_laws() -> tuple[ParameterSpec, ...]:
    """Return the constants of all laws; laws share constants of the same name."""
    texts: dict[str, list[str]] = {}
    found: dict[str, ParameterSpec] = {}
    for law in LAWS.values():
        for x in law.constants:
            texts.setdefault(x.name, []).append(f'{law.name}: {x.symbol}')
            number = x.kind is not str
            found[x.name] = ParameterSpec(
                x.name, 0.0 if x.kind is float else x.kind(),
                f'Constant of law {"; ".join(texts[x.name])}.', x.unit,
                x.minimum if number else None, x.maximum if number else None,
                items=float if x.kind is list else str)
    return tuple(found.values())


LAW_NAME = ParameterSpec(
    'law.name', next(iter(LAWS)),
    'Hyperelastic model of the block. All but gent and neo_hookean have constants law.*, from '
    'which the shear modulus follows.', choices=tuple(LAWS))

#: The elastic law of the block and its constants.
LAW = (LAW_NAME, *_of_laws())

# Names in earlier versions. ROS tools cannot show a value and a group with the same name.
_FORMER = {'law': LAW_NAME.name}


def present_name(name: str) -> str:
    """Return the present name of a parameter with an earlier name, also of a joint."""
    joint, dot, rest = name.rpartition('.')
    return f'{joint}{dot}{_FORMER.get(rest, rest)}'


#: Constants of laws that are only read at startup.
FIXED = frozenset(x.name for law in LAWS.values() for x in law.constants if x.fixed)

#: Compressibility of a block.
BULK_RATIO = ParameterSpec(
    'actuator.bulk_ratio', math.inf,
    "Bulk over shear modulus of a compressible block, 1 to 1e6; .inf, as in the paper's model, "
    'for constant volume.', '', 1.0, math.inf)

#: Factors on the inertia, and secondary modes: what makes the block a continuum.
MODES = (
    ParameterSpec(
        'actuator.mass_factor', 1.0,
        "Factor on the inertia at rest: 1 for the paper's model, in which the block deforms "
        'uniformly; its first mode needs 1.2 to 1.5.', '', 1e-3, 1e3),
    ParameterSpec(
        'actuator.transverse_mass_factor', 1.0,
        'Factor on the inertia across the field relative to that along it, at the same inertia at '
        'rest: how the natural frequency changes with the stretch.', '', 1e-3, 1e3),
    ParameterSpec(
        'actuator.transverse_mass_exponent', 0.0,
        'Exponent of the inverse stretch by which the inertia across the field of a compressible '
        'block grows in addition; 0 with bulk_ratio .inf.', '', -10.0, 10.0),
    ParameterSpec(
        'modes.frequency_ratio', [],
        'Modes: natural frequencies of up to three secondary modes in units of that of the first; '
        "empty for none, as in the paper's model.", '', 1.0, 100.0, items=float),
    ParameterSpec(
        'modes.share', [],
        'Modes: share of the static stretch that each secondary mode has; the first has the rest.',
        '', -1.0, 1.0, items=float),
    ParameterSpec(
        'modes.damping_ratio', [], 'Modes: damping ratio of each secondary mode.', '', 0.0, 1.0,
        items=float),
    ParameterSpec(
        'modes.ratio_exponent', [],
        'Modes: exponent of the stretch at rest with which each frequency ratio grows; empty for '
        'constant ratios.', '', -5.0, 5.0, items=float),
    ParameterSpec(
        'modes.share_exponent', [],
        'Modes: exponent of the stretch with which each share grows relative to that of the first '
        'mode; empty for constant shares.', '', -10.0, 10.0, items=float),
)

_coefficient = partial(ParameterSpec, default=0.0, unit='1/K', minimum=-0.1, maximum=0.1)
_celsius = partial(ParameterSpec, unit='degC', minimum=COLDEST, maximum=HOTTEST)

#: Effect of the temperature, and warming by the coil.
THERMAL = (
    _celsius(
        'thermal.reference', Thermal.reference,
        'Temperature: at which all values of block and coil hold.'),
    _coefficient(
        'thermal.shear_modulus',
        description='Temperature: relative change of the shear modulus, and of all moduli with '
        'it, per K; 0 for none, as in the paper.'),
    _coefficient(
        'thermal.remanence',
        description='Temperature: reversible relative change of the remanence per K; -0.001 for '
        'NdFeB.'),
    _coefficient(
        'thermal.damping_coefficient',
        description='Temperature: relative change of the damping coefficient per K.'),
    _coefficient(
        'thermal.coil_resistance',
        description='Temperature: relative change of the resistance of the coil per K, 0.0039 for '
        'copper; coil_time_constant is its inductance over it.'),
    _celsius(
        'thermal.limit', Thermal.limit,
        'Temperature: above which the magnets may lose remanence for good, which is warned of.'),
    ParameterSpec(
        'thermal.rise', Thermal.rise,
        'Temperature: by which the coil warms the block at a level that is held for long, over '
        'the square of the level; 0 for a coil that does not.', 'K/T^2', 0.0, 1e9),
    ParameterSpec(
        'thermal.time_constant', Thermal.time_constant,
        'Temperature: time constant of this warming.', 's', 1e-3, 1e9),
    _celsius(
        'thermal.ambient', Thermal.ambient,
        'Temperature: without a field, until one is measured.'),
)

#: All parameters of a block.
BLOCK = (*ACTUATOR, *LAW, BULK_RATIO, *MODES, *THERMAL)

JOINT = ParameterSpec(
    'joint', 'actuator', 'Name of the joint in trajectories and joint states.')

INITIAL_STRETCH = ParameterSpec(
    'initial_stretch', 1.0,
    'Stretch at rest before the first command; the deflection of a beam, 0 unless given.', '',
    -1.0, 1e3)

SLEW_LIMIT = ParameterSpec(
    'slew_limit', 0.0,
    'Rate at which the amplifier ramps to a commanded level; 0 for steps.', 'T/s', 0.0, 1e12)

FLUX_DENSITY_MIN = ParameterSpec(
    'flux_density_min', -0.5, "Lower limit of the coil's flux density.", 'T', -1e3, 1e3)

FLUX_DENSITY_MAX = ParameterSpec(
    'flux_density_max', 0.5, "Upper limit of the coil's flux density.", 'T', -1e3, 1e3)

COIL_TIME_CONSTANT = ParameterSpec(
    'coil_time_constant', 0.0, 'Time constant of the first-order coil lag; 0 for none.', 's',
    0.0, 1e3)

#: Parameters that affect a plan.
PLANNED = (*BLOCK, FLUX_DENSITY_MIN, FLUX_DENSITY_MAX, SLEW_LIMIT, COIL_TIME_CONSTANT)

#: Viscoelastic branches in addition to the elastic law.
VISCOELASTIC = (
    ParameterSpec(
        'viscoelastic.ratio', [],
        'Creep: stiffness of up to three viscoelastic branches in units of that of the '
        'hyperelastic model, which describes the relaxed state; empty for none.', '', 0.0, 1e3,
        items=float),
    ParameterSpec(
        'viscoelastic.time', [], 'Creep: relaxation time of each viscoelastic branch.', 's',
        1e-9, 1e9, items=float),
    ParameterSpec(
        'viscoelastic.flow', next(iter(FLOWS)),
        'Creep: how the branches flow, in proportion to their overstress or not.',
        choices=tuple(FLOWS)),
    *(ParameterSpec(
        f'viscoelastic.{x.name}', [], f'Creep: {x.words}; one for each branch.', '', x.minimum,
        x.maximum, items=float) for x in CONSTANTS.values()),
)

#: Uncertainty of parameters, as written by ``hmsa identify --out`` and ``~/save_estimate``.
KNOWN = (
    ParameterSpec(
        'identification.names', [],
        'Identified parameters: the prior of feedback.'),
    ParameterSpec(
        'identification.values', [],
        'Their values in SI; parameters of the planner take them from there.',
        items=float),
    ParameterSpec(
        'identification.covariance', [],
        'Covariance of these values, row after row, in SI.', items=float),
)

CREEP_TOLERANCE = ParameterSpec(
    'creep_tolerance', 1e-4,
    'Maximum vibration, peak to peak, that the levels which follow creep may cause, as a fraction '
    'of the step; a smaller value needs more levels, up to 300 per move.', '', 1e-6, 1.0)

PUBLISH_RATE = ParameterSpec(
    'publish_rate', 1000.0, "Sample rate, in the plant's own time.", 'Hz', 1e-3, 1e6)

LATENESS_LIMIT = ParameterSpec(
    'lateness_limit', 0.1,
    'Largest lateness of a command that is still applied, at once; a later one is refused, '
    'and the planner sends the rest anew, from the state. One level that is late by a '
    'twentieth of the natural period leaves 20 % of the step.', 's', 1e-4, 1e6)

#: Factors by which the plant's parameters differ from the planner's.
MISMATCH = tuple(
    ParameterSpec(
        f'mismatch.{spec.name.partition(".")[2]}', 1.0,
        f"Factor on {spec.name}: the simulated actuator then differs from the planner's model.",
        '', 1e-3, 1e3)
    for spec in ACTUATOR)

#: Fields of `hmsa.model.parameters.ActuatorParameters` that are parameters.
ACTUATOR_FIELDS = tuple(spec.name.partition('.')[2] for spec in ACTUATOR)

#: What `hmsa identify` writes beside parameters of nodes.
SENSOR_LATENCY = 'sensor_latency'
#: Names without a dot of all nodes, so that a wrong one is found without importing any.
PLAIN_NAMES = frozenset((
    SENSOR_LATENCY,
    'after_cut_off', 'allow_partial_joints', 'arrival_tolerance', 'autostart',
    'coil_time_constant', 'command_delay', 'command_mode', 'command_period', 'command_source',
    'command_timeout', 'creep_tolerance', 'element', 'feedback', 'feedback_cautious',
    'feedback_file', 'feedback_frozen', 'feedback_parameters', 'feedback_tolerance',
    'feedback_trim', 'field', 'flux_density_limit', 'flux_density_max', 'flux_density_min',
    'frame_id', 'heartbeat_period', 'initial_stretch', 'interlock_required',
    'interlock_timeout', 'joint', 'joints', 'lateness_limit', 'lateness_tolerance',
    'lead_time', 'marker_rate', 'marker_scale', 'max_points', 'measurement_delay',
    'minimax_errors', 'minimax_file', 'path_tolerance', 'publish_clock', 'publish_rate',
    'publish_scalars', 'rate_noise', 'real_time_factor', 'reorder_time', 'replan_late',
    'reset_rate', 'reset_stretch', 'robust_order', 'safe_flux', 'safe_ramp_rate', 'seed',
    'shaper', 'short_spell', 'simultaneous_arrival', 'slew_limit', 'smooth_periods',
    'start_paused', 'start_time', 'step_count', 'stretch_bias', 'stretch_gain',
    'stretch_noise', 'stretch_rate_max', 'stretch_tolerance', 'takeover_max_age',
    'takeover_timeout', 'temperature_limit', 'temperature_max_age', 'topic', 'trajectory_mode',
    'type', 'vibration_tolerance'))
#: Parameters of all nodes of ROS, and first parts of names that describe no actuator.
FOREIGN = frozenset((
    'use_sim_time', 'start_type_description_service', 'qos_overrides', 'experiment', 'hardware',
    'identification', 'play', 'record', 'reference', 'sensor', 'storage'))


def sections_of(document: Any, name: str = '') -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the full name and the parameters of each section, such as ``/**`` or ``/planner``."""
    if not isinstance(document, Mapping):
        return
    for key, values in document.items():
        if key == _KEY:
            yield name or '/', values if isinstance(values, Mapping) else {}
        else:
            yield from sections_of(values, f'{name}/{str(key).strip("/")}')


def is_for(section: str, node: str) -> bool:
    """Return whether a node with this full name reads a section; ``*`` is any one name."""
    tokens = section.strip('/').split('/')
    return re.fullmatch(''.join(
        '(?:/[^/]+)*' if x == '**' else '/[^/]+' if x == '*' else f'/{re.escape(x)}'
        for x in tokens), node) is not None
