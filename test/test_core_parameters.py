"""Parameter records: invalid values are refused, extreme ones are accepted."""

from dataclasses import fields, FrozenInstanceError, replace
import math

import pytest
from scipy.constants import mu_0

from hmsa.errors import BadInputError
from hmsa.model.parameters import (
    ActuatorParameters,
    NondimensionalParameters,
    paper_actuator,
)

ACTUATOR = {
    'shear_modulus': 1e4, 'density': 1900.0, 'half_length': 0.01, 'half_thickness': 0.02,
    'remanence': 0.1, 'chain_limit': 5.0, 'damping_coefficient': 1.0}
GROUP = {'zeta': 0.2, 'j_lim': 5.0, 'c1': 2.0}
RECORDS = [(ActuatorParameters, ACTUATOR), (NondimensionalParameters, GROUP)]
# An exponent, of a compressible block.
EXPONENT = 'transverse_mass_exponent'
EVERY_FIELD = [
    (record, good | {'bulk_ratio': 10.0} if field.name == EXPONENT else good, field.name)
    for record, good in RECORDS for field in fields(record)
    if field.name not in ('law', 'creep', 'modes', 'thermal')]


@pytest.mark.parametrize(('record', 'good', 'name'), EVERY_FIELD)
@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, -1.0, -1e-300])
def test_numbers_out_of_range_are_refused_by_name(record, good, name, value):
    if value == math.inf and name in ('j_lim', 'chain_limit', 'bulk_ratio'):
        # Neo-Hookean, or of constant volume.
        assert getattr(record(**(good | {name: value})), name) == value
        return
    if math.isfinite(value) and name == EXPONENT:
        assert getattr(record(**(good | {name: value})), name) == value
        return
    with pytest.raises(BadInputError, match=rf'^{name} is {value!r}: expected a finite'):
        record(**(good | {name: value}))


@pytest.mark.parametrize(('record', 'good', 'name'), EVERY_FIELD)
@pytest.mark.parametrize('value', ['1', None, True, [1.0], 1j])
def test_what_is_no_number_is_refused_by_name(record, good, name, value):
    with pytest.raises(BadInputError, match=rf'^{name} is .*: expected a number'):
        record(**(good | {name: value}))


@pytest.mark.parametrize(('record', 'good', 'name'), EVERY_FIELD)
def test_zero_is_a_damping_and_nothing_else(record, good, name):
    if name in ('zeta', 'damping_coefficient', EXPONENT):
        assert getattr(record(**(good | {name: 0})), name) == 0.0
    else:
        with pytest.raises(BadInputError, match=f'^{name} is 0: .*greater than 0'):
            record(**(good | {name: 0}))


@pytest.mark.parametrize(('record', 'good', 'name'), EVERY_FIELD)
def test_whole_numbers_become_floats_and_stay(record, good, name):
    made = record(**(good | {name: 3}))
    assert type(getattr(made, name)) is float
    assert made == record(**(good | {name: 3.0}))
    with pytest.raises(FrozenInstanceError):
        setattr(made, name, 4.0)


@pytest.mark.parametrize(('record', 'good', 'name'), EVERY_FIELD)
def test_a_whole_number_beyond_floats_is_refused(record, good, name):
    with pytest.raises(BadInputError, match=f'^{name} is '):
        record(**(good | {name: 10 ** 400}))


@pytest.mark.parametrize(('name', 'value'), [
    ('shear_modulus', 1e-320), ('shear_modulus', 1e308), ('remanence', 1e-300),
    ('half_length', 1e-200), ('half_thickness', 1e300), ('density', 1e-310)])
def test_parameters_that_no_equation_can_be_scaled_by_are_refused(name, value):
    with pytest.raises(BadInputError, match=r'expected values of a block|expected a finite'):
        replace(paper_actuator(), **{name: value})


def test_the_scales_are_those_of_the_paper():
    made = ActuatorParameters(**ACTUATOR)
    assert made.time_unit == pytest.approx(0.01 * math.sqrt(1900.0 / 1e4), rel=1e-15)
    assert made.flux_density_unit == pytest.approx(mu_0 * 1e4 / 0.1, rel=1e-15)
    group = made.nondimensional
    assert group.c1 == pytest.approx(2.0 * 0.02 ** 2 / 0.01 ** 2, rel=1e-15)
    assert group.j_lim == 5.0
    assert group.zeta == pytest.approx(
        1.0 / 8.0 * math.sqrt(1.0 / (0.01 ** 2 * 0.02 ** 2 * 1900.0 * 1e4)), rel=1e-15)


@pytest.mark.parametrize('name', ['shear_modulus', 'density', 'half_length', 'remanence'])
@pytest.mark.parametrize('value', [0.0, -1.0, math.nan])
def test_a_scale_out_of_range_is_refused_by_name(name, value):
    scale = {'shear_modulus': 1e4, 'density': 1900.0, 'half_length': 0.01, 'remanence': 0.1}
    with pytest.raises(BadInputError, match=f'^{name} is '):
        ActuatorParameters.from_nondimensional(
            NondimensionalParameters(), **(scale | {name: value}))


def test_the_default_is_the_papers_group_in_a_cube():
    assert NondimensionalParameters() == NondimensionalParameters(**GROUP)
    made = paper_actuator()
    assert made.half_length == made.half_thickness
    assert made.nondimensional.zeta == pytest.approx(0.2, rel=1e-15)
    other = paper_actuator(NondimensionalParameters(zeta=1.1, j_lim=3.0))
    assert other.nondimensional.zeta == pytest.approx(1.1, rel=1e-15)
    assert other.chain_limit == 3.0
