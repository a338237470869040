"""The planning model of an actuator, from the arguments of `Actuator` or node parameters."""

from collections.abc import Mapping
from dataclasses import replace
import math
from typing import Any

from hmsa.api.arguments import columns_of, mapping_of, number, several
from hmsa.errors import BadInputError, check_choice, check_number, excerpt, meant
from hmsa.interfaces.actuator import actuator_from, along_elastica, model_from
from hmsa.interfaces.parameters import (
    ACTUATOR,
    BULK_RATIO,
    COIL_TIME_CONSTANT,
    CREEP_TOLERANCE,
    LAW_NAME,
    PLANNED,
    THERMAL,
    VISCOELASTIC,
)
from hmsa.interfaces.topics import PLANNER
from hmsa.model.continuum import check_mount, clamped, mounted
from hmsa.model.delivery import IDEAL
from hmsa.model.equations import critical_zeta
from hmsa.model.laws import LAWS
from hmsa.model.modes import MOUNTS
from hmsa.model.parameters import ActuatorParameters
from hmsa.planning.timeline import JointModel
from hmsa.runs.parameters import values_of

#: Arguments of `Actuator` of which one describes the damping.
DAMPED = ('zeta', 'damping_ratio', 'damping_coefficient')
# Arguments of `Actuator` that are single numbers, and those that may be None.
_NUMBERS = {x.name.rpartition('.')[2]: x for x in (*ACTUATOR, BULK_RATIO, COIL_TIME_CONSTANT)}
_OPTIONAL = ('shear_modulus', 'half_thickness', *DAMPED, 'constants', 'thermal')
# Plans made here need not be sent, so the levels are very fine unless a file sets the tolerance.
_SPECS = (*PLANNED, *VISCOELASTIC, replace(CREEP_TOLERANCE, default=IDEAL.ripple))
_PAPER, *_BLOCK, CLAMPED = MOUNTS


def parameters_in(given: Mapping[str, Any], law: str = 'gent') -> dict[str, Any]:
    """
    Return the node parameters for arguments of `Actuator`, except zeta and the damping ratio.

    The constants belong to the model in ``given``, else to ``law``.

    Raises
    ------
    BadInputError
        If an argument has the wrong type, or some of them exclude each other.

    """
    given = {x: y for x, y in given.items() if y is not None or x not in _OPTIONAL}
    damped = [x for x in DAMPED if x in given]
    if len(damped) > 1:
        raise BadInputError(f'both {" and ".join(damped)} are given: expected one of them')
    values: dict[str, Any] = {
        x.name: number(given[name], name, x.unit) for name, x in _NUMBERS.items() if name in given}
    values |= _law_values(
        given.get('law', law), given.get('constants'), 'shear_modulus' in given)
    if 'creep' in given:
        values |= _creep_values(given['creep'])
    if 'thermal' in given:
        values |= _thermal_values(given['thermal'])
    if 'flux_density_limits' in given:
        values['flux_density_min'], values['flux_density_max'] = limits_of(
            given['flux_density_limits'])
    if 'slew_limit' in given:
        slew = number(given['slew_limit'], 'slew_limit', 'T/s')
        check_number('slew_limit', slew, 'T/s', above=0.0, endless=True)
        values['slew_limit'] = 0.0 if math.isinf(slew) else slew
    return values


def _law_values(name: Any, constants: Any, modulus_given: bool) -> dict[str, Any]:
    """Return the parameters of a model; a number is accepted for a constant that is a list."""
    check_choice('law', name, LAWS)
    law = LAWS[name]
    constants = mapping_of(constants, 'constants', "'mu': 5e3")
    names = {x.name.partition('.')[2]: x for x in law.constants}
    unknown = [x for x in constants if x not in names]
    if unknown:
        raise BadInputError(
            f'law {name} has no constant {unknown[0]!r}: expected '
            + (', '.join(names) or 'none') + meant(unknown[0], names))
    if modulus_given and law.scaled is not None:
        raise BadInputError(
            f'shear_modulus is given with law {name}, whose constants it follows from: expected '
            f'constants={{...}} of {", ".join(names)} alone')
    values: dict[str, Any] = {LAW_NAME.name: name}
    for key, value in constants.items():
        kind = names[key].kind
        values[names[key].name] = (
            number(value, key, names[key].unit) if kind is float
            else [number(x, key, names[key].unit) for x in several(value)] if kind is list
            else str(value))
    return values


def _creep_values(creep: Any) -> dict[str, Any]:
    """Return the parameters of viscoelastic branches, pairs of stiffness ratio and time."""
    if isinstance(creep, (tuple, list)) and not creep:
        return {}
    ratios, times = columns_of(creep, ('ratio', 'time'), 'branches of creep')
    return {'viscoelastic.ratio': ratios.tolist(), 'viscoelastic.time': times.tolist()}


def _thermal_values(thermal: Any) -> dict[str, Any]:
    """Return the parameters ``thermal.*`` of values by name."""
    known = {x.name.partition('.')[2]: x for x in THERMAL}
    values = {}
    for name, value in mapping_of(thermal, 'thermal coefficients', "'remanence': -1e-3").items():
        check_choice('a thermal coefficient', name, known)
        values[known[name].name] = number(value, f'thermal {name}', known[name].unit)
    return values


def limits_of(limits: Any) -> tuple[float, float]:
    """
    Return the minimum and the maximum flux density in T.

    Raises
    ------
    BadInputError
        If they are no numbers or not in increasing order.

    """
    given = [number(x, 'a flux density limit', 'T') for x in several(limits)]
    if len(given) not in (1, 2):
        raise BadInputError(
            f'limits are {excerpt(limits)}: expected minimum and maximum flux density '
            'in T, or one number for both directions')
    low, high = given if len(given) == 2 else (-given[0], given[0])
    if not low < high:
        raise BadInputError(
            f'flux densities from {low:g} to {high:g} T: expected the minimum below the maximum')
    return low, high


def model_of(
        values: Mapping[str, Any], zeta: float | None = None, ratio: float | None = None,
        mount: Any = _PAPER) -> JointModel:
    """
    Return the planning model of parameters; zeta or a ratio replace the damping coefficient.

    A mount adds the factors and the modes of the actuator as a continuum; ``ratio`` is then the
    damping ratio of the first mode. Raise `BadInputError` if a value is out of range, or the mount
    unknown or one of another actuator.
    """
    if ratio is not None:
        undamped = model_of(values, 0.0).material
        zeta = number(ratio, 'damping_ratio', least=0.0) * float(
            critical_zeta(undamped.rest, undamped))
    if zeta is not None:
        unit = actuator_from(checked(values)).damping_unit
        values = {**values, 'actuator.damping_coefficient': unit * number(
            zeta, 'zeta', least=0.0)}
    model = model_from(checked(values))
    check_mount(mount)
    return model if mount == _PAPER else JointModel(
        _mounted(model.actuator, mount, ratio), model.options)


def checked(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return all parameters that a plan needs, checked and with defaults."""
    return values_of({f'{PLANNER}.{x}': y for x, y in values.items()}, PLANNER, _SPECS)


def _mounted(actuator: ActuatorParameters, mount: str, ratio: float | None) -> ActuatorParameters:
    """Return an actuator with the modes of its mount; without a ratio, the damping stays."""
    if (actuator.rest == 0.0) is not (mount == CLAMPED):
        form, others = ('beam', [CLAMPED]) if actuator.rest == 0.0 else ('block', _BLOCK)
        raise BadInputError(
            f'mount {mount} is given for a {form}: expected {", ".join([_PAPER, *others])}')
    if actuator.modes.ratios or any(x != 1.0 for x in actuator.factors.values()):
        raise BadInputError(
            f'mount {mount} is given for an actuator that already has modes: expected mount '
            'alone, which computes them')
    return clamped_beam(actuator, ratio) if mount == CLAMPED else _held(actuator, mount, ratio)


def _held(block: ActuatorParameters, mount: str, ratio: float | None) -> ActuatorParameters:
    """Return a block with its modes."""
    shape = block.half_thickness / block.half_length
    given = math.inf if block.law is not None else block.chain_limit

    def made(damping_ratio: float) -> ActuatorParameters:
        found = mounted(shape, mount, given, damping_ratio, block.bulk_ratio)
        return replace(
            block, shear_modulus=block.shear_modulus * found.stiffness,
            mass_factor=found.mass_factor, transverse_mass_factor=found.transverse_mass_factor,
            transverse_mass_exponent=found.transverse_mass_exponent, modes=found.modes)

    ratio, coefficient = _damped(made(0.0), ratio)
    return replace(made(ratio), damping_coefficient=coefficient)


def clamped_beam(beam: ActuatorParameters, ratio: float | None = None) -> ActuatorParameters:
    """Return a beam along its elastica, with its second mode."""
    made = along_elastica(beam)
    ratio, coefficient = _damped(made, ratio)
    return replace(made, damping_coefficient=coefficient, modes=clamped(ratio))


def _damped(made: ActuatorParameters, ratio: float | None) -> tuple[float, float]:
    """Return damping ratio and coefficient for a given ratio, by default for the coefficient."""
    material = made.nondimensional
    critical = float(critical_zeta(material.rest, material))
    if ratio is None:
        return material.zeta / critical, made.damping_coefficient
    return ratio, ratio * critical * made.damping_unit
