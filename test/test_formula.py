"""Energies that are written as Python functions: their programs against other derivatives."""

import math

import numpy as np
import pytest

from hmsa.errors import BadInputError
from hmsa.model.law import elastic_energy, elastic_force, elastic_stiffness, pack
from hmsa.model.laws.formula import _EXP, _LOG, _PART, exp, expm1, law_of, log, log1p
from hmsa.model.laws.record import Constant

MODULUS, EXPONENT = Constant('law.mu', 'modulus'), Constant('law.n', 'exponent', '', above=0.0)
VALUES = {'law.mu': 2e3, 'law.n': 1.5}


def law(energy):
    return law_of('trial', 'energy', 'none', (MODULUS, EXPONENT), energy)


# Each uses other operations; all are convex about rest.
@pytest.mark.parametrize('energy', [
    lambda strain, mu, n: mu * (exp(n * strain.first) - 1.0),
    lambda strain, mu, n: mu * expm1(n * strain.first) / n - strain.second * mu / -4.0,
    lambda strain, mu, n: mu * strain.over_stretches(lambda x: x ** n / n - log(x)),
    lambda strain, mu, n: -mu * log1p(-strain.first / (2.0 + n)) + 3.0 * mu * strain.second,
    lambda strain, mu, n: mu * ((1.0 + strain.first) ** n - 1.0) * 2.0 / (2.0 + strain.second),
    lambda strain, mu, n: mu * (1.0 - (n + strain.second) ** -2 * n ** 2) + mu * strain.first])
def test_force_and_stiffness_are_derivatives_of_the_energy(energy):
    modulus, elastic = law(energy).scaled(VALUES)
    packed = pack(0.1, math.inf, 2.0, elastic)
    assert elastic_stiffness(1.0, packed) == pytest.approx(3.0, rel=1e-14)
    for stretch in (0.8, 1.0, 1.3):
        beside = 0.05 * np.cos(np.pi * (np.arange(16) + 0.5) / 16)
        series = np.polynomial.chebyshev.Chebyshev.fit(
            beside, [elastic_energy(stretch + x, packed) for x in beside], 15)
        assert elastic_force(stretch, packed) == pytest.approx(
            series.deriv()(0.0), rel=1e-10, abs=1e-10)
        assert elastic_stiffness(stretch, packed) == pytest.approx(
            series.deriv(2)(0.0), rel=1e-7)
    assert modulus > 0.0


def test_force_takes_one_logarithm_and_one_exponential_for_both_stretches():
    _, elastic = law(lambda strain, mu, n: mu * strain.over_stretches(
        lambda x: x ** n / n - log(x))).scaled(VALUES)
    known, fixed, force, _ = map(int, elastic.constants[:4])
    begin = 4 + known + fixed
    operations = [int(x) // _PART ** 2 for x in elastic.constants[begin:begin + force]]
    assert [operations.count(x) for x in (_LOG, _EXP)] == [1, 1]


def test_energy_and_force_are_nan_where_a_logarithm_has_no_value():
    _, elastic = law(lambda strain, mu, n: -mu * log(1.0 - n * strain.first)).scaled(VALUES)
    packed = pack(0.1, math.inf, 2.0, elastic)
    for of in (elastic_force, elastic_stiffness, elastic_energy):
        assert [math.isnan(of(x, packed)) for x in (-1.0, 0.5, 1.0, 1.3, 1.6)] == [
            True, True, False, False, True]


def test_a_constant_outside_an_open_range_is_refused():
    trial = law(lambda strain, mu, n: mu * n * strain.first)
    with pytest.raises(BadInputError, match='law.n is 0: expected more than 0'):
        trial.scaled({**VALUES, 'law.n': 0.0})


def test_an_energy_with_too_many_steps_is_refused():
    trial = law(lambda strain, mu, n: mu * sum(
        (exp(i * strain.first) for i in range(1, 60)), strain.first * n))
    with pytest.raises(BadInputError, match=r'energy takes \d+ steps: expected 96'):
        trial.scaled(VALUES)
