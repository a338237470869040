"""The law of the actuator: one packed argument, a second law, derivatives by its constants."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from hmsa_ros.core import law
from hmsa_ros.core.model import elastic_energy, elastic_force, equilibrium_stretch, stretch_limits
from hmsa_ros.core.parameters import NondimensionalParameters
from hmsa_ros.core.simulation import simulate
from hmsa_ros.core.status import Code
from hmsa_ros.core.two_step import plan_two_step, plan_two_step_batch

NEO_HOOKEAN = NondimensionalParameters(j_lim=math.inf)
STATES = ((1.3, 0.4, 0.2), (0.7, -0.8, -1.0), (2.1, 1.5, 3.0))


def slopes(material, state):
    found = np.empty(5)
    law.acceleration_slopes(*state, material, found)
    return found


def accelerate(state, material):
    out = np.empty(1)
    law.accelerations(*(np.array([x]) for x in state), material, out)
    return out[0]


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
        def motion(_, y):
            x, v = y
            inertia = (x ** -3 + 2.0) / 6.0
            return v, (beta - (x - x ** -2) - 0.2 * v + 0.25 * v * v * x ** -4) / inertia
        back = lambda _, y: y[1]  # noqa: E731
        back.terminal, back.direction = True, -1.0 if target > start else 1.0
        away = 1e-9 * (target - start)
        done = solve_ivp(
            motion, (0.0, 100.0), (start, away), method='DOP853', rtol=1e-12, atol=1e-13,
            events=back)
        return done.t[-1], done.y[0, -1]

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
    batch = plan_two_step_batch(1.0, 1.3, j_lim=[5.0, 1e14, math.inf])
    assert batch.beta_p[0] != batch.beta_p[2]
    assert batch.beta_p[1] == pytest.approx(batch.beta_p[2], rel=1e-11)


@pytest.mark.parametrize('state', STATES)
def test_slopes_by_the_constants_are_those_of_finite_differences(state):
    zeta, j_lim, c1, step = 0.3, 5.0, 1.4, 1e-6
    found = slopes(law.pack(zeta, j_lim, c1), state)

    def difference(make):
        high, low = (accelerate(*make(x)) for x in (step, -step))
        return (high - low) / (2.0 * step)

    pack = law.pack
    stretch, rate, load = state
    expected = [
        difference(lambda x: ((stretch, rate, load + x), pack(zeta, j_lim, c1))),
        # A stiffer block at the same acceleration of the rest: the force alone grows.
        difference(lambda x: ((stretch, rate, load - x * float(elastic_force(stretch, j_lim))),
                              pack(zeta, j_lim, c1))),
        difference(lambda x: (state, pack(zeta + x, j_lim, c1))),
        difference(lambda x: (state, pack(zeta, j_lim, c1 + x))),
        difference(lambda x: (state, pack(zeta, 1.0 / (1.0 / j_lim + x), c1)))]
    assert found == pytest.approx(expected, rel=1e-7, abs=1e-8)


@pytest.mark.parametrize('j_lim', [5.0, math.inf])
@pytest.mark.parametrize('state', STATES)
def test_the_derivatives_of_the_motion_are_those_of_finite_differences(state, j_lim):
    material = law.pack(0.3, j_lim, 1.4)
    step = 1e-6
    found = law.motion(*state, material, law.ANY)
    for column in range(3):
        ends = []
        for sign in (1.0, -1.0):
            moved = list(state)
            moved[column] += sign * step
            ends.append(accelerate(moved, material))
        assert found[1 + column] == pytest.approx(
            (ends[0] - ends[1]) / (2.0 * step), rel=1e-7, abs=1e-8)
