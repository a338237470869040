"""The actuator described by a set of parameters."""

from collections.abc import Mapping
from dataclasses import replace
import math
from typing import Any, TYPE_CHECKING

from hmsa.errors import add_words, BadInputError
from hmsa.interfaces.parameters import (
    ACTUATOR_FIELDS,
    BULK_RATIO,
    LAW,
    LAW_NAME,
    MODES,
    THERMAL,
    VISCOELASTIC,
)
from hmsa.interfaces.quantities import FORMS, mistakes
from hmsa.model.creep import Creep, FLOWS
from hmsa.model.laws import LAWS
from hmsa.model.laws.beam import ELASTIC_CURVE
from hmsa.model.laws.record import BEAM
from hmsa.model.modes import Modes
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.thermal import Thermal

if TYPE_CHECKING:
    from hmsa.planning.timeline import JointModel

# With fewer samples per period, peaks of a vibration are missed.
_SAMPLES_A_PERIOD = 10.0


def completed(values: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the constants of a law from a file named by the parameters, if any.

    Raises
    ------
    BadInputError
        If the file cannot be used.

    """
    values = {**{x.name: x.default for x in LAW}, **values}
    law = LAWS[values[LAW_NAME.name]]
    return law.completed(values) if law.completed is not None else {}


def actuator_from(
        values: Mapping[str, Any], modulus: float | None = None) -> ActuatorParameters:
    """
    Return the block of ``actuator.*``, times any ``mismatch.*``, with its law and ``modes.*``.

    ``modulus`` replaces the shear modulus that follows from the constants of a law. Raise
    `BadInputError`, with values that look like mistakes, for an impossible actuator.
    """
    try:
        return _actuator_from(values, modulus)
    except BadInputError as error:
        form = str(values.get(LAW_NAME.name))
        add_words(error, *mistakes(form if form in FORMS else 'block', values))
        raise


def _actuator_from(values: Mapping[str, Any], modulus: float | None) -> ActuatorParameters:
    numbers = {name: values[f'actuator.{name}'] for name in ACTUATOR_FIELDS}
    law, elastic = LAWS[values.get(LAW_NAME.name, 'gent')], None
    if law.endless:
        numbers['chain_limit'] = math.inf
    if law.scaled is not None:
        numbers['shear_modulus'], elastic = law.scaled(
            {**{x.name: x.default for x in LAW}, **values})
        if modulus is not None:
            numbers['shear_modulus'] = modulus
    continuum = {x.name: values.get(x.name, x.default) for x in (BULK_RATIO, *MODES)}
    modes = Modes(*(tuple(continuum.pop(f'modes.{x}')) for x in (
        'frequency_ratio', 'share', 'damping_ratio', 'ratio_exponent', 'share_exponent')))
    return ActuatorParameters(
        law=elastic, modes=modes, thermal=thermal_from(values),
        **{name.removeprefix('actuator.'): value for name, value in continuum.items()},
        **{name: value * values.get(f'mismatch.{name}', 1.0) for name, value in numbers.items()})


def along_elastica(beam: ActuatorParameters) -> ActuatorParameters:
    """Return a beam along its elastica; another actuator, or such a beam, does not change."""
    if beam.law is None or beam.law.family != BEAM:
        return beam
    return replace(
        actuator_from(parameters_of(beam) | {'law.shape': ELASTIC_CURVE}), creep=beam.creep)


def model_from(
        values: Mapping[str, Any], modulus: float | None = None, period: int = 0) -> 'JointModel':
    """Return the planning model of the parameters `PLANNED`, on a command grid in ns."""
    from hmsa.planning.timeline import JointModel, Options  # not always needed

    return JointModel(planned_from(values, modulus), Options(
        flux_density_min=values['flux_density_min'], flux_density_max=values['flux_density_max'],
        period=period, slew_limit=values['slew_limit'] or math.inf,
        coil_time_constant=values['coil_time_constant'],
        creep_tolerance=values.get('creep_tolerance', Options.creep_tolerance)))


def planned_from(
        values: Mapping[str, Any], modulus: float | None = None) -> ActuatorParameters:
    """Return the block for planning, including its viscoelastic branches."""
    return replace(actuator_from(values, modulus), creep=creep_from(values))


def thermal_from(values: Mapping[str, Any]) -> Thermal:
    """Return the effect of the temperature by ``thermal.*``; none if there are no such values."""
    return Thermal(**{
        x.name.partition('.')[2]: values.get(x.name, x.default) for x in THERMAL})


def creep_from(values: Mapping[str, Any]) -> Creep:
    """Return the branches of ``viscoelastic.*``; none if there are no such values."""
    given = {x.name: values.get(x.name, x.default) for x in VISCOELASTIC}
    flow = given['viscoelastic.flow']
    constants = FLOWS[flow].constants if flow in FLOWS else ()
    return Creep(
        tuple(given['viscoelastic.ratio']), tuple(given['viscoelastic.time']), flow,
        tuple(tuple(given[f'viscoelastic.{x.name}']) for x in constants))


def parameters_of(actuator: ActuatorParameters) -> dict[str, Any]:
    """Return the parameters of a block, the inverse of `actuator_from`."""
    values: dict[str, Any] = {
        f'actuator.{name}': value for name, value in actuator.numbers.items()}
    # What is as in the paper's model is not said.
    values |= actuator.modes.parameters | actuator.thermal.parameters | {
        f'actuator.{name}': value for name, value in actuator.factors.items() if value != 1.0}
    if math.isfinite(actuator.bulk_ratio):
        values[BULK_RATIO.name] = actuator.bulk_ratio
    if actuator.transverse_mass_exponent:
        values['actuator.transverse_mass_exponent'] = actuator.transverse_mass_exponent
    if actuator.law is None:
        return values
    units = {x.name: x.unit for x in LAWS[actuator.law.law].constants}
    scales = {'Pa': actuator.shear_modulus, 'T': actuator.flux_density_unit}

    def in_si(name: str, value: Any) -> Any:
        factor = scales.get(units[name], 1.0)
        if isinstance(value, tuple):
            return [factor * x for x in value]
        return value if isinstance(value, str) else factor * value

    return values | {LAW_NAME.name: actuator.law.law} | {
        name: in_si(name, value) for name, value in actuator.law.given}


def enough_samples(actuator: ActuatorParameters) -> float:
    """Return the smallest sampling rate in Hz that resolves the actuator's small vibration."""
    return _SAMPLES_A_PERIOD / actuator.period


def too_few_samples(actuator: ActuatorParameters, rate: float) -> str:
    """Return a warning if a sampling rate in Hz is too low for an actuator; else empty."""
    enough = enough_samples(actuator)
    if rate >= enough:
        return ''
    return (f'publish_rate {rate:g} Hz gives {_SAMPLES_A_PERIOD * rate / enough:.1f} samples in '
            'a period of the actuator, and peaks of its vibration are missed: expected at least '
            f'{_SAMPLES_A_PERIOD:g}, a publish_rate of {math.ceil(enough):d}')
