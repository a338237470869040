"""Maxwell branches of the simulated plant, against SciPy's integration of the equations."""

from dataclasses import replace
import math

import creep_oracle
from creep_oracle import elastic, yeoh
import numpy as np
import pytest

from hmsa.errors import BadInputError
from hmsa.interfaces.actuator import actuator_from, creep_from, parameters_of
from hmsa.model.actuators import Actuators, Setup
from hmsa.model.creep import Creep
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation

MS = 1_000_000
GENT = paper_actuator()
YEOH = actuator_from({
    **parameters_of(GENT), 'law.name': 'yeoh', 'law.c10': 5e3, 'law.c20': -200.0, 'law.c30': 40.0})
UNIT = GENT.time_unit
# One as fast as the actuator, one slower, one that is much slower.
THREE = Creep((0.1, 0.3, 0.05), (0.4 * UNIT, 3.0 * UNIT, 0.5))
LEVELS = ((0, 0.05), (13_456_789, -0.02), (60 * MS, 0.06))


def judged(block, law, creep, levels, end, lag=0.0):
    """Return stretch and rate in 1/s at a time in ns, by the oracle."""
    unit = block.time_unit
    in_units = [(time / 1e9 / unit, level / block.flux_density_unit) for time, level in levels]
    state = creep_oracle.judged(
        in_units, replace(creep, times=tuple(x / unit for x in creep.times)), end / 1e9 / unit,
        lag=lag / unit, law=law)[2]
    return state[0], state[1] / unit


def driven(block, creep, end, **options):
    simulation = ActuatorSimulation(block, creep=creep, **options)
    for stamp, level in LEVELS:
        simulation.command(stamp, level)
    for time in range(MS, end + 1, MS):
        simulation.advance(time)
    return simulation


@pytest.mark.parametrize(('block', 'force', 'creep'), [
    (GENT, elastic, THREE), (GENT, elastic, Creep((0.1,), (2.0 * UNIT,))),
    (YEOH, yeoh, THREE)])
def test_motion_with_branches_is_that_of_scipy(block, force, creep):
    simulation = driven(block, creep, 100 * MS)
    stretch, rate = judged(block, force, creep, LEVELS, 100 * MS)
    assert simulation.stretch == pytest.approx(stretch, abs=1e-10)
    assert simulation.rate == pytest.approx(rate, abs=1e-7)


def test_after_a_step_the_block_creeps_to_where_the_law_holds_it():
    creep = Creep((0.2,), (0.1,))
    simulation = ActuatorSimulation(GENT, creep=creep)
    simulation.command(0, 0.05)
    end = simulation.schedule.at(1) / GENT.flux_density_unit
    reached = []
    for time in (60 * MS, 120 * MS, 240 * MS, 4_000 * MS):
        simulation.advance(time)
        reached.append(simulation.stretch)
    # Soon it has rung down where law and branch hold it together, and then goes on alone.
    assert np.all(np.diff(reached) > 0.0)
    assert reached[0] < simulation.equilibrium() - 0.003
    assert simulation.stretch == pytest.approx(simulation.equilibrium(), abs=1e-9)
    assert elastic(simulation.stretch)[0] == pytest.approx(end, rel=1e-9)


def test_a_branch_that_holds_nothing_changes_no_bit():
    plain, same = driven(GENT, None, 90 * MS), driven(GENT, Creep((0.0,), (1.0,)), 90 * MS)
    assert (plain.stretch, plain.rate) == (same.stretch, same.rate)


def test_steps_of_time_and_a_pause_leave_the_motion_as_it_is():
    whole, halved = (ActuatorSimulation(GENT, creep=THREE) for _ in range(2))
    for simulation in (whole, halved):
        simulation.command(0, 0.05)
        simulation.advance(7 * MS)
    # Time that is skipped is no time in which the branches relax.
    halved.time = 500 * MS
    whole.advance(17 * MS)
    for time in range(500 * MS, 510 * MS, 100_000):
        halved.advance(time + 100_000)
    assert halved.stretch == pytest.approx(whole.stretch, abs=1e-11)
    assert halved.rate == pytest.approx(whole.rate, abs=1e-8)


def test_a_reset_begins_relaxed():
    simulation = driven(GENT, THREE, 90 * MS)
    simulation.reset()
    fresh = ActuatorSimulation(GENT, creep=THREE, time=90 * MS)
    held = ActuatorSimulation(GENT, creep=THREE, stretch=1.3)
    for each in (simulation, fresh):
        each.command(90 * MS, 0.03)
        each.advance(120 * MS)
    assert (simulation.stretch, simulation.rate) == (fresh.stretch, fresh.rate)
    held.advance(1_000 * MS)
    assert held.stretch == pytest.approx(1.3, abs=1e-12)


def test_each_of_several_moves_bit_for_bit_as_it_does_alone():
    blocks = [
        Setup(replace(GENT, creep=THREE), 1.1), Setup(GENT),
        Setup(replace(YEOH, creep=THREE), 1.0, 20.0),
        Setup(replace(GENT, creep=Creep((0.5,), (0.01,))), 1.0, 30.0, 0.002)]
    together, alone = Actuators(blocks), [Actuators([x]) for x in blocks]
    for time in range(MS, 40 * MS, MS):
        if time == 5 * MS:
            for i, one in enumerate(alone):
                together.command(i, time + 300_000, 0.04)
                one.command(0, time + 300_000, 0.04)
        together.advance(time)
        for i, one in enumerate(alone):
            one.advance(time)
            assert (together.stretch[i], together.rate[i]) == (one.stretch[0], one.rate[0])


def test_through_a_slow_coil_branches_are_integrated_as_exactly():
    lag, creep = 0.002, Creep((0.2,), (0.01,))
    simulation = ActuatorSimulation(GENT, creep=creep, coil_time_constant=lag)
    simulation.command(0, 0.05)
    simulation.advance(20 * MS)
    stretch, _ = judged(GENT, elastic, creep, [(0, 0.05)], 20 * MS, lag)
    assert simulation.stretch == pytest.approx(stretch, abs=1e-10)


@pytest.mark.parametrize(('ratio', 'time', 'sentence'), [
    ([0.1, 0.2], [1.0], 'ratio has 2 values and viscoelastic.time 1: expected one of each'),
    ([0.1] * 4, [1.0] * 4, 'have 4 values: expected at most 3 branches'),
    ([-0.1], [1.0], 'viscoelastic.ratio is -0.1: expected 0 to 1000'),
    ([math.nan], [1.0], 'viscoelastic.ratio is nan: expected 0 to 1000'),
    ([0.1], [0.0], 'viscoelastic.time is 0 s: expected a finite number above 0'),
    ([0.1], [math.inf], 'viscoelastic.time is inf s: expected a finite number above')])
def test_branches_of_no_elastomer_are_refused_in_a_sentence(ratio, time, sentence):
    with pytest.raises(BadInputError) as refused:
        creep_from({'viscoelastic.ratio': ratio, 'viscoelastic.time': time})
    assert sentence in str(refused.value)


def test_a_branch_that_only_damps_is_refused_with_what_to_set_instead():
    with pytest.raises(BadInputError, match=r'at least 4\.36e-06 s.*damping_coefficient'):
        replace(GENT, creep=Creep((0.1,), (1e-6,)))
    replace(GENT, half_length=1e-3, creep=Creep((0.1,), (1e-6,)))
