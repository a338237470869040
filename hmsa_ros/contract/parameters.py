"""
Parameters that nodes, files and reports share: name, default, unit, range and description.

`ParameterSpec` is one entry. What only one node has is declared with that node.
"""

from dataclasses import dataclass
import math
from typing import Any

from hmsa_ros.errors import BadInputError, excerpt

Value = bool | int | float | str | list[str]


@dataclass(frozen=True)
class ParameterSpec:
    """
    One parameter: name, default, unit, range and description.

    Attributes
    ----------
    name : str
        Snake case, groups separated by dots.
    default : bool, int, float, str or list of str
        Its type is the parameter's type.
    description : str
        One sentence without the unit.
    unit : str
        Unit in plain text, empty for a dimensionless value.
    minimum, maximum : float, optional
        Closed range of a number.
    choices : tuple of str
        Admissible values of a string, empty for any.
    read_only : bool
        Whether the value is fixed at the start.

    """

    name: str
    default: Value
    description: str
    unit: str = ''
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = True

    def check(self, value: Any) -> None:
        """
        Refuse a value outside the range or the choices.

        Raises
        ------
        BadInputError
            If it is not finite, outside the range or not one of the choices.

        """
        if isinstance(value, float) and not (math.isfinite(value) or value == self.maximum):
            raise BadInputError(
                f'parameter {self.name} is {value}: expected a finite number')
        if self.choices and value not in self.choices:
            raise BadInputError(
                f'parameter {self.name} is {excerpt(value)}: expected one of '
                + ', '.join(self.choices))
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


#: zeta of the example block, which nobody can look up for a block of their own.
ZETA = 0.2

#: The block that planner and plant have in common; the defaults are the example block's.
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
        'actuator.remanence', 0.1, 'Residual flux density Br.', 'T', 1e-9, 1e3),
    ParameterSpec(
        'actuator.chain_limit', 5.0,
        'Chain extensibility limit J_lim of the Gent model; .inf gives neo-Hookean.', '',
        1e-3, math.inf),
    ParameterSpec(
        'actuator.damping_coefficient', 8.0 * ZETA * 0.01 * 0.01 * math.sqrt(1900.0 * 1e4),
        'Damping coefficient c; zeta = c/(8 L H sqrt(rho G)).', 'N s/m', 0.0, 1e12),
)

JOINT = ParameterSpec(
    'joint', 'actuator', 'Name of the joint in trajectories and joint states.')

INITIAL_STRETCH = ParameterSpec(
    'initial_stretch', 1.0, 'Stretch at rest before the first command.', '', 1e-3, 1e3)

SLEW_LIMIT = ParameterSpec(
    'slew_limit', 0.0,
    'Rate at which the amplifier ramps to a commanded level; 0 for steps.', 'T/s', 0.0, 1e12)

FLUX_DENSITY_MIN = ParameterSpec(
    'flux_density_min', -0.5, "Lower limit of the coil's flux density.", 'T',
    -1e3, 1e3)

FLUX_DENSITY_MAX = ParameterSpec(
    'flux_density_max', 0.5, "Upper limit of the coil's flux density.", 'T',
    -1e3, 1e3)

COIL_TIME_CONSTANT = ParameterSpec(
    'coil_time_constant', 0.0, 'Time constant of the first-order coil lag; 0 for none.', 's',
    0.0, 1e3)

PUBLISH_RATE = ParameterSpec(
    'publish_rate', 1000.0, "Sample rate, in the plant's own time.", 'Hz', 1e-3, 1e6)

#: Factors on the actuator's parameters, by which a plant differs from what the planner knows.
MISMATCH = tuple(
    ParameterSpec(
        f'mismatch.{spec.name.partition(".")[2]}', 1.0,
        f"Factor on {spec.name}: the simulated actuator then differs from the planner's model.",
        '', 1e-3, 1e3)
    for spec in ACTUATOR)

#: Fields of `hmsa_ros.core.parameters.ActuatorParameters`, as the parameters name them.
ACTUATOR_FIELDS = tuple(spec.name.partition('.')[2] for spec in ACTUATOR)
