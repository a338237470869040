"""Actuators advanced together, compared with each alone, and the coil and the force."""

from dataclasses import replace
import math

from creep_oracle import follow
import numpy as np
import pytest

from hmsa.errors import BadInputError
from hmsa.model.actuators import Actuators, Setup
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation

ACTUATOR = paper_actuator()
MS = 1_000_000
ACCURACY = 1e-10


def scipy_motion(level, seconds, lag, slew=math.inf):
    """Return stretch and rate in 1/s at a time under a level, by SciPy."""
    unit, load = ACTUATOR.time_unit, ACTUATOR.flux_density_unit
    stretch, rate, *_ = follow(
        [(0.0, level / load)], [seconds / unit], lag=lag / unit, slew=slew * unit / load)[-1]
    return stretch, rate / unit


def test_each_of_many_moves_bit_for_bit_as_it_does_alone():
    blocks = [
        Setup(replace(ACTUATOR, shear_modulus=1e4 * (1.0 + 0.1 * i)), 1.0 + 0.02 * i,
              20.0 if i % 3 == 1 else math.inf, 0.002 if i % 3 == 2 else 0.0)
        for i in range(7)]
    together = Actuators(blocks)
    alone = [Actuators([x]) for x in blocks]
    random = np.random.default_rng(4)
    for time in range(MS, 60 * MS, MS):
        for i in range(len(blocks)):
            if random.random() < 0.1:
                stamp, level = time + int(random.integers(-MS, 5 * MS)), random.normal(0.0, 0.05)
                together.command(i, stamp, level)
                alone[i].command(0, stamp, level)
        together.advance(time)
        for i, one in enumerate(alone):
            one.advance(time)
            assert together.stretch[i] == one.stretch[0]
            assert together.rate[i] == one.rate[0]
            assert together.flux_density[i] == one.flux_density[0]
    assert sorted((i, *x[1:]) for i, one in enumerate(alone) for x in one.changes) \
        == sorted(together.changes)


def test_repeated_levels_change_nothing_bit_for_bit():
    plain, beaten = (ActuatorSimulation(ACTUATOR, slew_limit=30.0) for _ in range(2))
    for time in range(0, 100 * MS, MS):
        for simulation in (plain, beaten):
            if time == 10 * MS:
                simulation.command(12_345_678, 0.05)
            if time == 30 * MS:
                simulation.command(33_333_333, -0.02)
        # Far ahead, and at the stamp of a change that is known.
        assert beaten.command(time + 50 * MS, beaten.schedule.at(time + 50 * MS)) == 0
        if 30 * MS <= time < 33 * MS:
            assert beaten.command(33_333_333, -0.02) == 0
        plain.advance(time + MS)
        beaten.advance(time + MS)
        assert (plain.stretch, plain.rate, plain.flux_density) == (
            beaten.stretch, beaten.rate, beaten.flux_density)
    assert len(beaten.schedule) == 0
    assert plain.stretch != 1.0


def test_a_change_is_told_when_it_takes_effect_and_only_then():
    actuators = Actuators([Setup(ACTUATOR)] * 2, time=MS)
    actuators.command(0, 2_345_678, 0.05)
    actuators.command(1, 0, 0.02)
    actuators.command(1, 0, 0.03)
    actuators.command(0, 3 * MS, 0.05)
    assert actuators.changes == []
    actuators.advance(5 * MS)
    assert sorted(actuators.changes) == [(0, 2_345_678, 0.05), (1, MS, 0.03)]


@pytest.mark.parametrize('constant', [1e-5, 1e-3, 0.02])
def test_a_lagging_coil_is_an_exponential(constant):
    slow = ActuatorSimulation(ACTUATOR, coil_time_constant=constant)
    slow.command(0, 0.05)
    for time in (7 * MS, 13 * MS, 20 * MS):
        slow.advance(time)
    expected = scipy_motion(0.05, 0.02, constant)
    assert slow.flux_density == pytest.approx(
        0.05 * (1.0 - math.exp(-0.02 / constant)), rel=1e-12)
    assert slow.stretch == pytest.approx(expected[0], abs=ACCURACY)
    assert slow.rate == pytest.approx(expected[1], abs=1e3 * ACCURACY)
    slow.advance(2_000 * MS)
    # It arrives in the end, exactly.
    assert slow.flux_density == 0.05


def test_a_lagging_coil_follows_a_ramping_amplifier():
    constant, rate, level = 0.002, 10.0, 0.05
    slow = ActuatorSimulation(ACTUATOR, slew_limit=rate, coil_time_constant=constant)
    slow.command(0, level)
    ramp = level / rate

    def field(t):
        end = rate * (ramp - constant * (1.0 - math.exp(-ramp / constant)))
        if t <= ramp:
            return rate * (t - constant * (1.0 - math.exp(-t / constant)))
        return level + (end - level) * math.exp(-(t - ramp) / constant)

    for time in (MS, 3_500_000, 5_200_000, 9 * MS, 20 * MS):
        slow.advance(time)
        assert slow.flux_density == pytest.approx(field(time / 1e9), abs=1e-14)
    assert slow.stretch == pytest.approx(
        scipy_motion(level, 0.02, constant, rate)[0], abs=1e-9)


def test_a_force_is_the_load_of_its_work():
    # F L^2-wise: the same motion as under the flux density of F/(4 L^2 G) units.
    force = 0.3
    level = force / (4.0 * ACTUATOR.half_length ** 2 * ACTUATOR.shear_modulus) \
        * ACTUATOR.flux_density_unit
    pulled, driven = ActuatorSimulation(ACTUATOR), ActuatorSimulation(ACTUATOR)
    pulled.force(1_234_567, force)
    driven.command(1_234_567, level)
    pulled.force(21_000_001, 0.0)
    driven.command(21_000_001, 0.0)
    for time in (20 * MS, 50 * MS):
        pulled.advance(time)
        driven.advance(time)
        assert pulled.stretch == pytest.approx(driven.stretch, abs=1e-13)
        assert pulled.stretch != 1.0
    assert pulled.flux_density == 0.0
    # Static: nominal stress against that of the material.
    pulled.force(50 * MS, force)
    pulled.advance(3_000 * MS)
    x = pulled.stretch
    stress = (x - x ** -2) / (1.0 - (2.0 / x + x * x - 3.0) / 5.0) * ACTUATOR.shear_modulus
    assert stress * 4.0 * ACTUATOR.half_length ** 2 == pytest.approx(force, rel=1e-9)
    with pytest.raises(BadInputError, match='disturbing force is inf'):
        pulled.force(0, math.inf)


def test_one_that_cannot_be_followed_leaves_the_others_alone():
    actuators = Actuators([Setup(ACTUATOR)] * 3)
    actuators.command(1, 0, 1e8 * ACTUATOR.flux_density_unit)
    actuators.command(2, 0, 0.05)
    assert actuators.advance(20 * MS) == [(1, 0)]
    single = ActuatorSimulation(ACTUATOR)
    single.command(0, 0.05)
    single.advance(20 * MS)
    assert actuators.stretch[2] == single.stretch
    actuators.reset(1)
    assert actuators.advance(21 * MS) == []


def test_a_reset_leads_to_the_state_asked_for():
    actuators = Actuators([Setup(ACTUATOR)])
    actuators.command(0, 5 * MS, 0.1)
    actuators.reset(0, 1.2)
    actuators.advance(50 * MS)
    assert actuators.stretch[0] == pytest.approx(1.2, abs=1e-12)
    actuators.reset(0, 1.1, 3.0)
    assert actuators.rate[0] == pytest.approx(3.0)
    with pytest.raises(BadInputError, match='expected a stretch between the limits'):
        actuators.reset(0, 3.0)
    with pytest.raises(BadInputError, match='time constant of the coil'):
        Setup(ACTUATOR, coil_time_constant=-1.0)


