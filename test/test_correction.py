"""Corrections from samples, applied to a block simulated with SciPy."""

from dataclasses import replace
import math

from beam_oracle import silicone
from bench_oracle import Plant
import identification_oracle as oracle
import numpy as np
import pytest
from scipy.optimize import brentq

from hmsa.identification.quantities import Known
from hmsa.model.sensor import Sample
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options as PlannerOptions
from hmsa.planning.planner import Planner
from hmsa_lab.adapt.corrections import course_of
from hmsa_lab.adapt.estimator import Estimator, EstimatorOptions
from hmsa_lab.adapt.expected_error import CandidateLevels, expect
from hmsa_lab.adapt.motion import follow, Levels
from hmsa_lab.adapt.prior import Prior
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import Settings, StretchRequest
from hmsa_studies.commanders import scenario_of, SCENARIOS, STRATEGIES, Strategy
from hmsa_studies.feedback import trial
from hmsa_studies.linear import Linearised

TARGET, BEGIN, MS = 1.4, 50_000_000, 1_000_000


class Bench:
    """A block as a device, sampled at 1 kHz, 2 ms late, by a sensor with a bias."""

    def __init__(self, block, noise, seed):
        self.block, self.time, self.next_sample = block, MS, MS
        self._noise, self._random = noise, np.random.default_rng(seed)
        self._changes, self._waiting, self._samples = [(0, 0, 0.0)], [], []

    def receive(self, joint, stamp, level):
        self.block.command(stamp, level)

    def advance(self, time):
        self._changes += [(0, *x) for x in self.block.levels if self.time < x[0] <= time]
        while self.next_sample <= time:
            shown = self.block.advance(self.next_sample)[0] + 1e-3 + (
                self._noise * self._random.standard_normal())
            self._waiting.append(Sample(self.next_sample, *(np.array([x]) for x in (
                shown, math.nan, math.nan))))
            self.next_sample += MS
        late = len([x for x in self._waiting if x[0] <= time - 2 * MS])
        self._samples += self._waiting[:late]
        del self._waiting[:late]
        self.time = time

    def changes(self):
        found, self._changes = self._changes, []
        return found

    def samples(self):
        found, self._samples = self._samples, []
        return found


def closed_loop(factor, noise=1e-3, seed=0, **settings):
    """Move to the target with the controller in simulated time; return the block."""
    block = Plant(replace(oracle.BLOCK, shear_modulus=factor * oracle.BLOCK.shear_modulus), time=0)
    loop = Loop(
        PlannerGroup({'a': Planner(oracle.BLOCK, PlannerOptions(
            flux_density_min=-0.25, flux_density_max=0.25, lead_time=300_000))}),
        Settings(takeover_timeout=0, heartbeat_period=0, feedback='adapt',
                 feedback_cautious=True, feedback_tolerance=1e-3, **settings),
        Bench(block, noise, seed))
    loop.run(BEGIN)
    loop.runtime.request(StretchRequest('a', TARGET))
    loop.run(90 * MS)
    return block


def left(block):
    """Return peak-to-peak and mean error over the next 15 ms, as fractions of the step."""
    seen = np.array([block.advance((90 + 0.2 * i) * MS)[0] for i in range(75)])
    level = block.levels[-1][1] * block.block.remanence / oracle.mu_0 / block.block.shear_modulus
    rest = brentq(lambda x: oracle.force_of(x, 5.0) - level, 1.01, 2.0)
    return np.ptp(seen) / 0.4, (rest - TARGET) / 0.4


@pytest.mark.parametrize('factor', [0.8, pytest.param(1.2, marks=pytest.mark.slow)])
def test_a_block_that_is_a_fifth_softer_or_stiffer_than_known_comes_to_rest_at_its_target(factor):
    blocks = [closed_loop(factor, seed=x) for x in range(3)]
    # Open loop leaves 17 to 26 % of both.
    vibration, offset = np.median(np.abs([left(x) for x in blocks]), axis=0)
    assert vibration < 1.5e-3
    assert offset < 2.5e-3
    assert all(abs(level) <= 0.25 for x in blocks for _, level in x.levels)


def test_a_block_that_is_known_exactly_is_left_alone():
    names = 'shear_modulus', 'damping_coefficient'
    block = closed_loop(1.0, known={'a': Known(names, (), np.diag([1e-4, 1e-10]))})
    assert len(block.levels) == 3
    vibration, offset = left(block)
    assert vibration < 1e-5
    assert abs(offset) < 1e-5


def test_what_a_course_is_expected_to_leave_is_what_errors_drawn_from_the_covariance_leave():
    prior = Prior.nominal(oracle.BLOCK, ('shear_modulus',), deviations={'shear_modulus': 0.01})
    estimator = Estimator(prior, EstimatorOptions(noise=1e-3))
    estimator.set_levels([(0, 0.0)])
    estimator.sample(0, 1.0)
    estimate = estimator.update(MS)
    plan = Planner(oracle.BLOCK, PlannerOptions(lead_time=0)).setpoint(TARGET, MS)
    course = CandidateLevels(
        tuple((x.stamp, x.flux_density) for x in plan.levels if x.stamp >= MS),
        plan.segments[-1].arrival, TARGET)
    expected = expect(estimate, course).size
    sizes = []
    for sign in (-1.0, 1.0):
        modulus = math.exp(sign * 0.01) * oracle.BLOCK.shear_modulus
        block = Plant(replace(oracle.BLOCK, shear_modulus=modulus), time=0)
        for level in course.levels:
            block.command(*level)
        ends = np.array([block.advance(course.arrival + i * MS // 10)[0] for i in range(101)])
        level = course.holding * oracle.BLOCK.remanence / oracle.mu_0 / block.block.shear_modulus
        rest = brentq(lambda x, level=level: oracle.force_of(x, 5.0) - level, 1.01, 2.0)
        sizes.append(math.hypot(np.max(np.abs(ends - rest)), rest - TARGET))
    assert expect(replace(
        estimate, covariance=np.zeros_like(estimate.covariance)), course).size < 1e-6
    assert expected == pytest.approx(np.sqrt(np.mean(np.square(sizes))), rel=0.1)


def test_the_field_of_a_coil_that_lags_remembers_the_levels_before_a_correction():
    lag = 1e-3
    prior = Prior.nominal(
        oracle.BLOCK, ('shear_modulus',), others={'coil_time_constant': lag})
    planner = Planner(oracle.BLOCK, PlannerOptions(lead_time=0, coil_time_constant=lag))
    levels = planner.setpoint(TARGET, MS).levels
    begin = levels[-1].stamp + 1000
    motion = follow(prior.values, prior.free, (1.0, 0.0), Levels(
        np.array([0.0, *(1e-9 * x.stamp for x in levels if x.stamp > 0)]),
        np.array([0.0, *(x.flux_density for x in levels if x.stamp > 0)])), 0.0,
        np.array([1e-9 * begin]))
    estimator = Estimator(prior, EstimatorOptions(noise=1e-3))
    estimator.sample(0, 1.0)
    estimate = replace(
        estimator.update(0), time=begin, stretch=motion.stretch[0], rate=motion.rate[0])
    course, _ = course_of(planner.plan, begin, 0.0)
    assert np.linalg.norm(expect(estimate, course).misses) < 1e-5


def test_a_block_is_linearised_as_it_moves_under_small_changes_of_a_level_that_comes_late():
    block = oracle.BLOCK
    unit = block.flux_density_unit
    holding = block.shear_modulus * oracle.force_of(1.2, block.chain_limit) / (
        block.remanence / oracle.mu_0)
    loads = 1e-4 * np.array([1.0, -2.0, 0.5, 0.0, 0.0, 3.0, 0.0, 0.0])
    model = Linearised.at(block, 1.2, holding, MS, 2 * MS + 300_000)
    real = Plant(block, time=0)
    real.state = np.array([1.2, 0.0, 0.0, 0.0])
    real.levels = [(0, holding)] + [
        (i * MS + 2 * MS + 300_000, holding + x * unit) for i, x in enumerate(loads)]
    z = np.zeros(5)
    for i, load in enumerate(loads):
        z = model.a @ z + model.b * load
        assert z[0] == pytest.approx(real.advance((i + 1) * MS)[0] - 1.2, abs=3e-8)
    assert np.max(np.abs(z)) > 1e-5


@pytest.mark.parametrize('name', ['learning', 'LQR', 'MPC'])
def test_others_that_use_samples_take_the_offset_away_and_leave_more_vibration(name):
    strategy, = (x for x in STRATEGIES if x.name == name)
    found = trial(SCENARIOS[0], strategy, 0.2, 0)
    # Open loop leaves an offset of 18 %, and feedback below 0.3 % of vibration.
    assert abs(found[2].offset) < 0.01
    assert found[0].vibration > 0.003


def test_open_loop_in_the_study_leaves_what_the_study_of_shapers_says():
    from hmsa.model.moves import State
    from hmsa.model.parameters import NondimensionalParameters
    from hmsa.planning.shapers import get_shaper
    from hmsa.planning.shapers.request import MoveRequest
    from hmsa_studies.robustness import Actual, Errors

    material = NondimensionalParameters()
    move = get_shaper('two_step')(MoveRequest(State(1.0), 1.4, material))
    found = trial(SCENARIOS[0], Strategy('', 'two_step'), 0.2, 0)[0]
    assert found.vibration == pytest.approx(
        Actual.off(material, Errors(0.2)).residual(move, 1.0, 1.4, move.duration), rel=2e-3)
    # A cycle is two thirds of a period.
    assert 0.7 * found.vibration < found.motion < 1.01 * found.vibration


def test_corrections_of_a_beam_leave_what_those_of_a_block_leave():
    scenario = scenario_of(silicone())
    adapt, = (x for x in STRATEGIES if x.kind == 'adapt')
    alone = trial(scenario, Strategy('', 'two_step'), 0.1, 0)[0]
    assert alone.vibration > 0.05
    for left in trial(scenario, adapt, 0.1, 0):
        assert left.vibration < 0.0012
        assert abs(left.offset) < 0.0012
