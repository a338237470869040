"""The simulated actuator and its command stream, against SciPy and naive models."""

import math

from core_oracle import equation, follow, holding_load, samples, SEQUENCES, UPPER_LIMIT
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.integrate import solve_ivp, trapezoid

from hmsa.errors import BadInputError, HmsaError
from hmsa.model.delivery import CommandSchedule
from hmsa.model.equations import damping, elastic_force, energy, equilibrium_stretch, mass
from hmsa.model.moves import Setpoint
from hmsa.model.parameters import NondimensionalParameters, paper_actuator
from hmsa.model.simulation import ActuatorSimulation, longest_motion, simulate
from hmsa.planning.sequence import plan_sequence

PAPER = NondimensionalParameters()
ACTUATOR = paper_actuator()
SPAN = 10.0
# Error in stretch against SciPy at 1e-13.
ACCURACY = 1e-8
SAMPLES = np.array([0.31, 1.1, 3.7, 9.9, 10.0, 10.6, 13.3, 19.2, 20.0, 20.2, 21.7, 26.0, 30.0])


def shaped_command(stretches, material):
    """Return switches and loads of the shaped sequence."""
    switches, loads = [], []
    for segment in plan_sequence([Setpoint(x, SPAN) for x in stretches], material):
        switches += [segment.begin + x.time for x in segment.move.levels]
        loads += [x.load for x in segment.move.levels]
    return switches, loads


# -- sampled response ---------------------------------------------------------------------------


@pytest.mark.parametrize(('figure', 'zeta', 'j_lim', 'stretches'), SEQUENCES)
def test_the_shaped_response_is_scipys(figure, zeta, j_lim, stretches):
    material = NondimensionalParameters(zeta=zeta, j_lim=j_lim)
    switches, loads = shaped_command(stretches, material)
    # SciPy takes seconds to hold a stretch close to the limit: there a part of it is enough.
    times = SAMPLES[SAMPLES < 21.0] if figure == 'fig_9' else SAMPLES
    stretch, rate = simulate(switches, loads, times, material)
    expected = samples((1.0, 0.0), switches, loads, times, zeta, j_lim, 2.0)
    assert np.max(np.abs(stretch - expected[0])) < ACCURACY
    assert np.max(np.abs(rate - expected[1])) < 1e3 * ACCURACY


@pytest.mark.parametrize(('figure', 'zeta', 'j_lim', 'stretches'), SEQUENCES)
def test_the_unshaped_response_is_scipys(figure, zeta, j_lim, stretches):
    material = NondimensionalParameters(zeta=zeta, j_lim=j_lim)
    begins = SPAN * np.arange(3)
    loads = [holding_load(x, j_lim) for x in stretches]
    # An unshaped step to 0.999 of the limit throws the actuator against it, where SciPy stops: see
    # below. Everything before is compared.
    times = SAMPLES[SAMPLES <= 20.0] if figure == 'fig_9' else SAMPLES
    stretch, _ = simulate(begins, elastic_force(stretches, material), times, material)
    expected = samples((1.0, 0.0), begins, loads, times, zeta, j_lim, 2.0)
    assert np.max(np.abs(stretch - expected[0])) < ACCURACY


def test_the_response_does_not_depend_on_the_sampling():
    switches, loads = shaped_command((1.1, 1.2, 1.4), PAPER)
    coarse = np.linspace(0.0, 30.0, 31)
    fine = np.linspace(0.0, 30.0, 3001)
    few = np.array(simulate(switches, loads, coarse, PAPER))
    many = np.array(simulate(switches, loads, fine, PAPER))[:, ::100]
    assert np.max(np.abs(few - many)) < 1e-11
    last = np.array(simulate(switches, loads, 30.0, PAPER))[:, 0]
    assert np.max(np.abs(last - few[:, -1])) < 1e-11


def test_samples_at_a_switch_and_repeated_ones_are_taken_there():
    stretch, rate = simulate([0.0, 1.0, 1.0], [0.5, 7.0, -0.5], [0.0, 1.0, 1.0, 2.0], PAPER)
    assert (stretch[0], rate[0]) == (1.0, 0.0)
    assert stretch[1] == stretch[2]
    expected = follow((1.0, 0.0), [(1.0, 0.5), (1.0, -0.5)], 0.2, 5.0, 2.0)
    assert (stretch[3], rate[3]) == pytest.approx(expected, abs=1e-11)


def test_ramps_are_followed():
    def motion(time, state):
        return equation(0.3 + 0.4 * time, 0.2, 5.0, 2.0)(time, state)
    end = solve_ivp(motion, (0.0, 2.0), (1.0, 0.0), method='DOP853', rtol=1e-13, atol=1e-13)
    stretch, rate = simulate([0.0], [0.3], 2.0, PAPER, slopes=[0.4])
    assert (stretch[0], rate[0]) == pytest.approx(tuple(end.y[:, -1]), abs=1e-11)


def test_numbers_below_the_least_normal_one_are_zero_in_the_motion_alone():
    # x86 takes ten times as long with them.
    least = np.finfo(float).tiny
    for rate, same in ((0.5 * least, False), (2.0 * least, True)):
        _, after = simulate([0.0], [0.0], [0.01], PAPER, rate=rate)
        assert bool(after[0] > 0.0) == same
    assert 0.5 * least > 0.0


def test_an_equilibrium_is_kept():
    for start in (0.3, 0.8, 1.0, 1.4, 2.6):
        load = float(elastic_force(start, 5.0))
        stretch, rate = simulate([0.0], [load], [50.0], PAPER, stretch=start)
        assert stretch[0] == pytest.approx(start, abs=1e-13)
        assert abs(rate[0]) < 1e-11


@pytest.mark.parametrize(('arguments', 'said'), [
    *((x, 'one-dimensional arrays') for x in (
        {'switches': [0.0, 1.0]}, {'loads': [[1.0]]}, {'slopes': [0.0, 1.0]},
        {'switches': [], 'loads': []}, {'times': [[1.0]]})),
    *(({name: [value]}, 'finite') for name in ('switches', 'loads', 'times', 'slopes')
      for value in (math.nan, math.inf)),
    *(({'switches': switches, 'loads': [0.1, 0.2], 'times': times}, 'must not decrease')
      for switches, times in (
          ([1.0, 0.0], [2.0]), ([0.0, 1.0], [2.0, 1.0]), ([0.0, 1.0], [-1.0])))])
def test_arrays_that_do_not_fit_are_refused(arguments, said):
    good = {'switches': [0.0], 'loads': [1.0], 'times': [1.0]}
    with pytest.raises(BadInputError, match=said):
        simulate(**(good | arguments), material=PAPER)


@pytest.mark.parametrize('stretch', [0.0, -1.0, 0.25, 2.7, math.nan, math.inf])
def test_starts_outside_the_limits_are_refused(stretch):
    with pytest.raises(BadInputError, match='between the limits 0.2520 and 2.6940'):
        simulate([0.0], [0.1], [1.0], PAPER, stretch=stretch)
    with pytest.raises(BadInputError, match='between the limits'):
        ActuatorSimulation(ACTUATOR, stretch=stretch)


def test_a_load_too_large_to_follow_is_said_to_be():
    with pytest.raises(HmsaError, match='too large to follow'):
        simulate([0.0], [1e12], [10.0], PAPER)


@pytest.mark.parametrize('gap', [1e-4, 1e-6])
def test_motion_close_to_a_limit_is_followed(gap):
    # Rounding of the stretch, not the tolerance, bounds what a step there can keep.
    stretch = 2.693994817055548 - gap
    load = float(elastic_force(stretch, 5.0))
    found, rate = simulate([0.0], [load], [1e3 * gap], PAPER, stretch=stretch)
    assert found[0] == pytest.approx(stretch, abs=1e-4 * gap)
    assert abs(rate[0]) < 1e-3


@pytest.mark.parametrize(('j_lim', 'start', 'load'), [
    (1.0, 1.4, holding_load(0.999 * UPPER_LIMIT[1.0], 1.0)),
    (5.0, 1.4, holding_load(0.999 * UPPER_LIMIT[5.0], 5.0)),
    (5.0, 1.0, 60.0), (5.0, 1.0, -60.0), (5.0, 1.0, 800.0)])
def test_thrown_against_a_limit_it_comes_back_with_its_energy(j_lim, start, load):
    # It turns at a distance of the limit that no double resolves, down to 1e-150.
    times = np.linspace(0.0, 3.0, 401)
    material = NondimensionalParameters(zeta=0.0, j_lim=j_lim)
    stretch, rate = simulate([0.0], [load], times, material, stretch=start)
    total = energy(stretch, rate, load, material)
    kinetic = 0.5 * mass(stretch, 2.0) * rate ** 2
    assert np.max(np.abs(total - total[0])) < 1e-6 * np.max(kinetic)
    assert np.count_nonzero(np.diff(np.sign(rate)) != 0.0) > 10
    # With damping, what is lost is what the damper takes.
    material = NondimensionalParameters(zeta=0.2, j_lim=j_lim)
    times = np.linspace(0.0, 1.0, 20001)
    stretch, rate = simulate([0.0], [load], times, material, stretch=start)
    total = energy(stretch, rate, load, material)
    taken = trapezoid(damping(material) * rate ** 2, times)
    assert total[0] - total[-1] == pytest.approx(taken, rel=2e-3)


# -- how long a motion lasts --------------------------------------------------------------------


@pytest.mark.parametrize('zeta', [0.05, 0.2, 1.1, 5.0, 30.0])
@pytest.mark.parametrize('load', [-2.0, 0.0, 1.5])
def test_after_the_longest_motion_nothing_is_left(zeta, load):
    material = NondimensionalParameters(zeta=zeta)
    longest = longest_motion(load, material)
    stretch, rate = simulate([0.0], [load], [longest], material, stretch=1.2, rate=0.5)
    assert stretch[0] == pytest.approx(float(equilibrium_stretch(load, 5.0)), abs=1e-13)
    assert abs(rate[0]) < 1e-12


def test_undamped_motion_is_not_followed_for_ever():
    assert 1e3 < longest_motion(0.0, NondimensionalParameters(zeta=0.0)) < 1e4


# -- the command stream -------------------------------------------------------------------------


class NaiveSchedule:
    """Stores all commands and searches them."""

    def __init__(self, current):
        self.commands = [(-math.inf, current)]
        self.time = -math.inf

    def insert(self, stamp, value):
        self.commands = [
            x for x in self.commands if x[0] < stamp or x[0] <= self.time]
        # What repeats the level of its time is no change.
        if self.commands[-1][1] != value:
            self.commands.append((stamp, value))

    def at(self, time):
        self.time = time
        return [value for stamp, value in self.commands if stamp <= time][-1]

    def ahead(self, time):
        return sum(stamp > time for stamp, _ in self.commands)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(
    st.integers(0, 6), st.integers(0, 12), st.floats(-1.0, 1.0)), max_size=40))
def test_the_schedule_supersedes_as_a_naive_one_does(steps):
    schedule = CommandSchedule(0.5)
    naive = NaiveSchedule(0.5)
    now = 0
    for wait, ahead, value in steps:
        now += wait
        while schedule.next_stamp is not None and schedule.next_stamp <= now:
            schedule.apply_next()
        assert schedule.current == naive.at(now)
        assert len(schedule) == naive.ahead(now)
        if ahead:
            schedule.insert(now + ahead, value)
            naive.insert(now + ahead, value)
        assert len(schedule) == naive.ahead(now)


# -- the actuator over time ---------------------------------------------------------------------


def expected_state(begin, end, commands, stretch=1.0, actuator=ACTUATOR):
    """Return the state in SI units after (stamp, flux density) commands, in one simulation."""
    unit = actuator.time_unit
    material = actuator.nondimensional
    switches = [0.0] + [(stamp - begin) / 1e9 / unit for stamp, _ in commands]
    loads = [float(elastic_force(stretch, material.j_lim))] + [
        value / actuator.flux_density_unit for _, value in commands]
    found, rate = simulate(
        switches, loads, [(end - begin) / 1e9 / unit], material, stretch=stretch)
    return found[0], rate[0] / unit


def test_it_starts_at_rest_held_by_its_flux_density():
    simulation = ActuatorSimulation(ACTUATOR, time=7, stretch=1.3)
    assert simulation.flux_density == pytest.approx(
        holding_load(1.3, 5.0) * ACTUATOR.flux_density_unit, rel=1e-13)
    assert simulation.equilibrium() == pytest.approx(1.3, rel=1e-15)
    simulation.advance(10 ** 9)
    assert simulation.stretch == pytest.approx(1.3, abs=1e-12)
    assert simulation.time == 10 ** 9


def test_a_command_applies_at_its_stamp_inside_a_step():
    simulation = ActuatorSimulation(ACTUATOR)
    assert simulation.command(1_234_567, 0.03) == 0
    assert simulation.command(4_000_001, -0.01) == 0
    simulation.advance(1_000_000)
    assert (simulation.stretch, simulation.rate, simulation.flux_density) == (1.0, 0.0, 0.0)
    simulation.advance(10_000_000)
    expected = expected_state(0, 10_000_000, [(1_234_567, 0.03), (4_000_001, -0.01)])
    assert (simulation.stretch, simulation.rate) == pytest.approx(expected, rel=1e-11)
    assert simulation.flux_density == -0.01


def test_a_late_command_applies_at_once_and_says_how_late_it_is():
    simulation = ActuatorSimulation(ACTUATOR, time=1_000_000)
    simulation.command(6_000_000, 0.05)
    simulation.advance(3_000_000)
    assert simulation.command(2_500_000, 0.02) == 500_000
    # It supersedes what is stamped after it too.
    assert len(simulation.schedule) == 1
    simulation.advance(9_000_000)
    expected = expected_state(1_000_000, 9_000_000, [(3_000_000, 0.02)])
    assert (simulation.stretch, simulation.rate) == pytest.approx(expected, rel=1e-11)


def test_a_time_that_is_not_ahead_changes_nothing():
    simulation = ActuatorSimulation(ACTUATOR)
    simulation.command(0, 0.05)
    simulation.advance(3_000_000)
    before = (simulation.time, simulation.stretch, simulation.rate, simulation.flux_density)
    simulation.advance(2_000_000)
    simulation.advance(3_000_000)
    assert before == (
        simulation.time, simulation.stretch, simulation.rate, simulation.flux_density)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(
    st.integers(0, 3_000_000), st.integers(-2_000_000, 4_000_000), st.floats(-0.1, 0.15)),
    max_size=12))
def test_any_stream_of_commands_is_followed_as_the_naive_timeline(steps):
    simulation = ActuatorSimulation(ACTUATOR)
    naive = NaiveSchedule(0.0)
    now = 0
    for wait, ahead, value in steps:
        now += wait
        simulation.advance(now)
        assert simulation.flux_density == naive.at(now)
        late = simulation.command(now + ahead, value)
        before = list(naive.commands)
        if ahead <= 0:
            naive.commands = [x for x in naive.commands if x[0] < now]
            naive.time = -math.inf
        naive.insert(max(now + ahead, now), value)
        # A repetition is not late, since nothing comes late.
        assert late == (max(-ahead, 0) if naive.commands != before else 0)
    end = now + 5_000_000
    simulation.advance(end)
    commands = [x for x in naive.commands if math.isfinite(x[0])]
    expected = expected_state(0, end, commands)
    assert simulation.stretch == pytest.approx(expected[0], abs=1e-10)
    assert simulation.rate == pytest.approx(expected[1], abs=1e-7)


def test_many_small_steps_do_not_drift():
    # 1/3 ms is no number of nanoseconds: the end still is exactly the end.
    many = ActuatorSimulation(ACTUATOR)
    one = ActuatorSimulation(ACTUATOR)
    for simulation in (many, one):
        simulation.command(1_000_003, 0.04)
        simulation.command(60_000_007, 0.06)
    steps = 3000
    for i in range(1, steps + 1):
        many.advance(i * 100_000_000 // steps)
    one.advance(100_000_000)
    assert many.time == one.time == 100_000_000
    assert many.stretch == pytest.approx(one.stretch, abs=1e-11)
    assert many.rate == pytest.approx(one.rate, abs=1e-8)


def test_stamps_of_this_century_lose_nothing():
    # Seconds as doubles resolve a tenth of a microsecond there; nanoseconds do not suffer.
    now = 1_760_000_000_123_456_789
    far = ActuatorSimulation(ACTUATOR, time=now)
    near = ActuatorSimulation(ACTUATOR)
    for simulation, begin in ((far, now), (near, 0)):
        simulation.command(begin + 1_234_567, 0.05)
        simulation.command(begin + 3_234_568, 0.03)
        simulation.advance(begin + 20_000_001)
    assert (far.stretch, far.rate) == (near.stretch, near.rate)


def test_reset_returns_to_the_start_and_time_goes_on():
    simulation = ActuatorSimulation(ACTUATOR, stretch=1.2)
    held = simulation.flux_density
    simulation.command(1_000_000, 0.1)
    simulation.command(9_000_000, 0.2)
    simulation.advance(5_000_000)
    assert simulation.stretch != 1.2
    simulation.reset()
    assert (simulation.stretch, simulation.rate, simulation.flux_density) == (1.2, 0.0, held)
    assert len(simulation.schedule) == 0
    assert simulation.time == 5_000_000
    simulation.advance(20_000_000)
    assert simulation.stretch == pytest.approx(1.2, abs=1e-12)


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 1e30])
def test_a_flux_density_nobody_can_follow_is_refused(value):
    simulation = ActuatorSimulation(ACTUATOR)
    simulation.command(10, 0.01)
    with pytest.raises(BadInputError, match='flux density is'):
        simulation.command(5, value)
    # The refused command superseded nothing.
    assert len(simulation.schedule) == 1


def test_a_failed_step_leaves_the_state_as_it_was():
    simulation = ActuatorSimulation(ACTUATOR)
    simulation.command(0, 1e8 * ACTUATOR.flux_density_unit)
    with pytest.raises(HmsaError, match='stopped at 0 ns'):
        simulation.advance(1_000_000_000)
    assert (simulation.time, simulation.stretch, simulation.rate) == (0, 1.0, 0.0)


def test_a_command_in_the_wrong_unit_is_survived():
    # A hundred tesla instead of a hundred millitesla.
    simulation = ActuatorSimulation(ACTUATOR)
    simulation.command(0, 100.0)
    for time in range(1_000_000, 100_000_001, 1_000_000):
        simulation.advance(time)
    assert 1.0 < simulation.stretch < UPPER_LIMIT[5.0]
    simulation.command(100_000_000, 0.0)
    for time in range(101_000_000, 900_000_001, 1_000_000):
        simulation.advance(time)
    assert simulation.stretch == pytest.approx(1.0, abs=1e-6)


def test_a_ramping_amplifier_takes_its_time():
    slow = ActuatorSimulation(ACTUATOR, slew_limit=10.0)
    slow.command(1_000_000, 0.05)
    slow.advance(3_500_000)
    assert slow.flux_density == pytest.approx(0.025, rel=1e-12)
    slow.command(3_500_000, 0.0)
    slow.advance(5_000_000)
    assert slow.flux_density == pytest.approx(0.010, rel=1e-12)
    slow.advance(7_000_000)
    assert slow.flux_density == 0.0
    unit, load = ACTUATOR.time_unit, ACTUATOR.flux_density_unit
    switches = np.array([0.0, 1.0, 3.5, 6.0]) * 1e-3 / unit
    slope = 10.0 / load * unit
    stretch, rate = simulate(
        switches, [0.0, 0.0, 0.025 / load, 0.0], [7e-3 / unit], PAPER,
        slopes=[0.0, slope, -slope, 0.0])
    assert slow.stretch == pytest.approx(stretch[0], abs=1e-11)
    assert slow.rate == pytest.approx(rate[0] / unit, abs=1e-8)
    with pytest.raises(BadInputError, match='slew limit is 0'):
        ActuatorSimulation(ACTUATOR, slew_limit=0.0)
