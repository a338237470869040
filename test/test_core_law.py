"""The law of the actuator: one packed argument, a second law, derivatives by its constants."""

import math

from core_oracle import turning_point
import numpy as np
import pytest
from scipy.optimize import brentq

from hmsa.model import law
from hmsa.model.equations import (
    elastic_energy,
    elastic_force,
    equilibrium_stretch,
    stretch_limits,
)
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import simulate
from hmsa.model.status import Code
from hmsa.motion.derivatives import CONSTANT, DRIVE, FIRST_BRANCH, rest, STIFFNESS
from hmsa.planning.two_step import Groups, plan_two_step, plan_two_step_batch

NEO_HOOKEAN = NondimensionalParameters(j_lim=math.inf)


def test_without_a_chain_limit_the_law_is_neo_hookean():
    stretch = np.array([1e-3, 0.4, 1.0, 1.7, 30.0])
    assert elastic_force(stretch, math.inf) == pytest.approx(stretch - stretch ** -2, rel=1e-14)
    assert elastic_energy(stretch, math.inf) == pytest.approx(
        0.5 * (stretch ** 2 + 2.0 / stretch - 3.0), rel=1e-14, abs=1e-15)
    assert stretch_limits(math.inf) == (0.0, math.inf)
    assert equilibrium_stretch(elastic_force(stretch, math.inf), math.inf) == pytest.approx(
        stretch, rel=1e-14)


@pytest.mark.parametrize(('start', 'target'), [(1.0, 1.1), (1.2, 4.0), (1.0, 0.2), (6.0, 1.0)])
def test_a_neo_hookean_plan_is_that_of_an_independent_solution(start, target):
    def turn(beta):
        return turning_point(
            (start, 0.0), beta, math.copysign(1.0, target - start), 0.2, math.inf, 2.0)

    plan = plan_two_step(start, target, NEO_HOOKEAN)
    assert plan.code is Code.TWO_STEP
    beta_0 = start - start ** -2
    beta = brentq(
        lambda x: turn(x)[1] - target, beta_0 + 0.05 * (plan.beta_1 - beta_0), plan.beta_1,
        xtol=1e-12)
    assert plan.beta_p == pytest.approx(beta, rel=1e-7)
    assert plan.tau_p == pytest.approx(turn(beta)[0], rel=1e-6)
    stretch, rate = simulate(
        [0.0, plan.tau_p], [plan.beta_p, plan.beta_1], np.linspace(0.0, plan.tau_p + 20.0, 50),
        NEO_HOOKEAN, stretch=start)
    assert abs(stretch[-1] - target) < 1e-9 * abs(target - start)
    assert abs(rate[-1]) < 1e-9 * abs(target - start)


def test_a_batch_plans_both_laws_side_by_side():
    batch = plan_two_step_batch(1.0, 1.3, Groups(j_lim=[5.0, 1e14, math.inf]))
    assert batch.beta_p[0] != batch.beta_p[2]
    assert batch.beta_p[1] == pytest.approx(batch.beta_p[2], rel=1e-11)


@pytest.mark.parametrize('stretch', [0.7, 1.3, 2.1])
def test_the_slope_of_the_force_by_the_chain_limit_is_that_of_finite_differences(stretch):
    high, low = (
        law.elastic_force(stretch, law.pack(0.3, 1.0 / (0.2 + x), 1.4)) for x in (1e-6, -1e-6))
    material, slope = law.pack(0.3, 5.0, 1.4), np.empty(1)
    theta = np.zeros(FIRST_BRANCH)
    theta[[STIFFNESS, DRIVE]] = 1.0
    held = rest(
        theta, material, law.elastic_force(stretch, material), np.array([CONSTANT]), slope)
    assert held == pytest.approx(stretch, rel=1e-14)
    # Where it is held moves as far as the force grows less.
    assert -slope[0] * law.elastic_stiffness(stretch, material) == pytest.approx(
        (high - low) / 2e-6, rel=1e-8)


def test_arrays_of_another_type_are_refused():
    packed = NEO_HOOKEAN.packed
    with pytest.raises(TypeError, match='expected one of d'):
        law.evaluate(law.FORCE, np.arange(3), packed, np.empty(3))
    with pytest.raises(ValueError, match='fit each other'):
        law.evaluate(law.FORCE, np.ones(2), packed, np.empty(3))
    with pytest.raises(TypeError, match='expected 2 arguments'):
        law.elastic_force(1.0)
