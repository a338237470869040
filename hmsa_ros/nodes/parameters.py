"""
Declaration of ROS parameters: each once, with default, unit, range and description.

`ParameterSpec` is one entry; the tuples below are what each node declares. The files under
``config/`` are held against them by a test.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
import math
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node

from hmsa_ros.core.parameters import ActuatorParameters, paper_actuator
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

    def descriptor(self) -> ParameterDescriptor:
        """
        Return the descriptor that ``ros2 param describe`` shows.

        Returns
        -------
        rcl_interfaces.msg.ParameterDescriptor
            With description, range and additional constraints.

        """
        text = f'{self.description} [{self.unit}]' if self.unit else self.description
        descriptor = ParameterDescriptor(description=text, read_only=self.read_only)
        # An empty list says nothing of its type: rclpy would take it for one of bytes and
        # refuse every list of strings. `declare` checks instead.
        descriptor.dynamic_typing = isinstance(self.default, list)
        if self.choices:
            descriptor.additional_constraints = 'one of: ' + ', '.join(self.choices)
        if self.minimum is None and self.maximum is None:
            return descriptor
        if isinstance(self.default, int):
            descriptor.integer_range = [IntegerRange(
                from_value=int(-2**63 if self.minimum is None else self.minimum),
                to_value=int(2**63 - 1 if self.maximum is None else self.maximum), step=0)]
        else:
            descriptor.floating_point_range = [FloatingPointRange(
                from_value=-math.inf if self.minimum is None else self.minimum,
                to_value=math.inf if self.maximum is None else self.maximum, step=0.0)]
        return descriptor

    def check(self, value: Any) -> None:
        """
        Refuse a value outside the range or the choices.

        Parameters
        ----------
        value : object
            Value of the parameter's own type.

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
        """
        Return the range in words.

        Returns
        -------
        str
            For example ``'at least 0 s'``.

        """
        unit = f' {self.unit}' if self.unit else ''
        if self.minimum is None and self.maximum is None:
            return 'any value'
        if self.maximum is None:
            return f'at least {self.minimum:g}{unit}'
        if self.minimum is None:
            return f'at most {self.maximum:g}{unit}'
        return f'{self.minimum:g} to {self.maximum:g}{unit}'


def declare(node: Node, specs: Iterable[ParameterSpec]) -> Mapping[str, Any]:
    """
    Declare parameters on a node and return their values.

    Parameters
    ----------
    node : rclpy.node.Node
        Node to declare on.
    specs : iterable of ParameterSpec
        What to declare.

    Returns
    -------
    mapping of str to object
        Values by name.

    Raises
    ------
    BadInputError
        If a value from the command line or a file has the wrong type or is out of range.

    """
    values: dict[str, Any] = {}
    for spec in specs:
        try:
            # The range is checked by `check`, whose message names what was expected; rclpy's
            # does not.
            value = node.declare_parameter(
                spec.name, spec.default, spec.descriptor()).value
            if isinstance(spec.default, list):
                value = _as_list(spec.name, value)
        except ParameterException as error:
            raise refusal(node, spec) from error
        spec.check(value)
        values[spec.name] = value
    return values


def refusal(node: Node, spec: ParameterSpec) -> BadInputError:
    """
    Return the error for a start value that rclpy has refused.

    Parameters
    ----------
    node : rclpy.node.Node
        On which it was to be declared.
    spec : ParameterSpec
        What was to be declared.

    Returns
    -------
    BadInputError
        To raise.

    """
    override = node._parameter_overrides.get(spec.name)
    got = 'a value of another kind' if override is None else repr(override.value)
    expected = type(spec.default).__name__
    if spec.minimum is not None or spec.maximum is not None:
        expected += f', {spec.range_text()}'
    return BadInputError(f'parameter {spec.name} is {got}: expected {expected}')


def _as_list(name: str, value: Any) -> list[str]:
    """Return a list of strings; one string is a list of one, an unset value is empty."""
    if value is None:
        return []
    values = list(value) if isinstance(value, Sequence) and not isinstance(value, str) \
        else [value]
    if not all(isinstance(item, str) for item in values):
        raise BadInputError(f'parameter {name} is {excerpt(value)}: expected a list of strings')
    return values


_DEFAULT = paper_actuator()

#: The block that planner and plant have in common.
ACTUATOR = (
    ParameterSpec(
        'actuator.shear_modulus', _DEFAULT.shear_modulus, 'Shear modulus G.', 'Pa',
        1e-3, 1e12),
    ParameterSpec(
        'actuator.density', _DEFAULT.density, 'Density rho.', 'kg/m^3', 1e-3, 1e6),
    ParameterSpec(
        'actuator.half_length', _DEFAULT.half_length,
        'Half length L of the block, across the field.', 'm', 1e-9, 1e3),
    ParameterSpec(
        'actuator.half_thickness', _DEFAULT.half_thickness,
        'Half thickness H of the block, along the field.', 'm', 1e-9, 1e3),
    ParameterSpec(
        'actuator.remanence', _DEFAULT.remanence, 'Residual flux density Br.', 'T', 1e-9, 1e3),
    ParameterSpec(
        'actuator.chain_limit', _DEFAULT.chain_limit,
        "Limit of the chains' extension J_lim of the Gent model; .inf for neo-Hookean.", '',
        1e-3, math.inf),
    ParameterSpec(
        'actuator.damping_coefficient', _DEFAULT.damping_coefficient,
        'Damping coefficient c; zeta = c/(8 L H sqrt(rho G)).', 'N s/m', 0.0, 1e12),
)

JOINT = ParameterSpec(
    'joint', 'actuator', 'Name of the joint in trajectories and joint states.')

INITIAL_STRETCH = ParameterSpec(
    'initial_stretch', 1.0, 'Stretch at rest before the first command.', '', 1e-3, 1e3)


def actuator_from(values: Mapping[str, Any]) -> ActuatorParameters:
    """
    Return the block that declared parameters describe.

    Parameters
    ----------
    values : mapping of str to object
        As `declare` returns them.

    Returns
    -------
    ActuatorParameters
        In SI units.

    Raises
    ------
    BadInputError
        If a value is out of range.

    """
    return ActuatorParameters(**{
        spec.name.partition('.')[2]: values[spec.name] for spec in ACTUATOR})
