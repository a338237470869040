"""The estimator, compared with motions simulated with SciPy."""

from dataclasses import replace

import identification_oracle as oracle
import numpy as np
import pytest

from hmsa.errors import BadInputError
from hmsa.identification.files import read_belief
from hmsa.identification.quantities import Known
from hmsa.model.creep import Creep
from hmsa.motion import subset_inverses, subsets
from hmsa.planning.planner import Options as PlannerOptions
from hmsa_lab.adapt.estimator import Estimator, EstimatorOptions
from hmsa_lab.adapt.hypotheses import Evidence, Hypotheses
from hmsa_lab.adapt.learnt import sensor_of
from hmsa_lab.adapt.messages import confounded, sentence
from hmsa_lab.adapt.motion import follow, Levels
from hmsa_lab.adapt.prior import Prior

pytestmark = pytest.mark.thorough

# Rest without field, a push, rest near 1.4, and back to rest near 1.1; in s and T.
TIMES = np.array([0.0, 0.03, 0.036, 0.09])
LEVELS = np.array([0.0, 0.06, oracle.level_of(1.4), oracle.level_of(1.1)])
SAMPLED = np.arange(0.0, 0.15, 1e-3)
NOISE = 1e-3


def ns(seconds):
    return round(float(seconds) * 1e9)


def run(samples, free=None, options=None, prior=None, times=SAMPLED, levels=LEVELS):
    """Pass samples one by one, each 2 ms late; return the estimator and its last estimate."""
    prior = prior or Prior.nominal(oracle.BLOCK, free or ('shear_modulus', 'damping_coefficient',
                                                          'stretch_bias'))
    estimator = Estimator(prior, options)
    for time, level in zip(TIMES, levels, strict=True):
        estimator.set_levels([(ns(time), level)])
    estimate = None
    for time, value in zip(times, samples, strict=True):
        estimator.sample(ns(time), value)
        estimate = estimator.update(ns(time) + 2_000_000)
    return estimator, estimate


def measured(block, extras=None, seed=0, noise=NOISE):
    clean = oracle.simulate(SAMPLED, TIMES, LEVELS, block, extras)
    return clean + noise * np.random.default_rng(seed).standard_normal(len(SAMPLED))


@pytest.mark.parametrize('factor', [0.8, 1.2])
def test_modulus_damping_bias_and_state_are_found_within_their_deviations(factor):
    block = replace(oracle.BLOCK, shear_modulus=factor * oracle.BLOCK.shear_modulus)
    extras = oracle.Extras(bias=4e-3)
    end = SAMPLED[-1] + 2e-3
    state = oracle.simulate(
        np.append(SAMPLED, [end - 1e-5, end, end + 1e-5]), TIMES, LEVELS, block)[-3:]
    errors = []
    for seed in range(4):
        _, found = run(measured(block, extras, seed))
        assert found.trusted
        assert 0.8 * NOISE < found.noise < 1.25 * NOISE
        assert found.deviations['shear_modulus'] < 2e-3 * block.shear_modulus
        size = np.sqrt(np.diag(found.covariance))
        errors += [
            (found.values['shear_modulus'] - block.shear_modulus)
            / found.deviations['shear_modulus'],
            (found.values['damping_coefficient'] - block.damping_coefficient)
            / found.deviations['damping_coefficient'],
            (found.values['stretch_bias'] - 4e-3) / found.deviations['stretch_bias'],
            (found.stretch - state[1]) / size[-2],
            (found.rate - (state[2] - state[0]) / 2e-5) / size[-1]]
    # Twenty errors, in part of the same cause, in their own deviations.
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 1.8
    assert np.max(np.abs(errors)) < 4.5


@pytest.mark.parametrize(('coil', 'tau'), [
    pytest.param(0.0, 0.01, marks=pytest.mark.slow), (5e-4, 0.05)])
def test_branches_that_are_given_are_followed_over_many_windows(coil, tau):
    extras = oracle.Extras(coil=coil, ratio=0.1, time=tau)
    block = replace(oracle.BLOCK, shear_modulus=9e3)
    given = replace(oracle.BLOCK, creep=Creep((0.1,), (tau,)))
    prior = Prior.nominal(given, ('shear_modulus', 'damping_coefficient'), others={
        'coil_time_constant': coil})
    end = SAMPLED[-1] + 2e-3
    state = oracle.simulate(
        np.append(SAMPLED, [end - 1e-5, end, end + 1e-5]), TIMES, LEVELS, block, extras)[-3:]
    estimator, found = run(
        measured(block, extras, noise=1e-5), prior=prior, options=EstimatorOptions(window=40))
    assert estimator._window.begin + estimator._origin > 0
    assert found.trusted
    assert found.values['shear_modulus'] == pytest.approx(9e3, rel=1e-3)
    assert found.stretch == pytest.approx(state[1], abs=5e-5)
    assert found.actuator.creep == given.creep
    # Without them it does not fit.
    _, lost = run(measured(block, extras, noise=1e-5), ('shear_modulus', 'damping_coefficient'),
                  EstimatorOptions(window=40))
    assert abs(lost.values['shear_modulus'] - 9e3) > 20.0


@pytest.mark.parametrize('tau', [1e-5, 1e-4])
def test_derivatives_keep_right_while_a_fast_branch_has_nothing_more_to_do(tau):
    block = replace(oracle.BLOCK, creep=Creep((0.3,), (tau,)))
    values, unit = Prior.nominal(block).values, block.flux_density_unit
    levels = Levels(np.array([0.0, 0.02]), np.array([0.5, 0.2]) * unit)
    times = np.linspace(0.0, 0.5, 101)

    def motion(free=(), factor=1.0):
        modulus = factor * values['shear_modulus']
        return follow(
            {**values, 'shear_modulus': modulus}, free, (1.0, 0.0), levels, 0.0, times)

    differences = (motion(factor=1.0001).stretch - motion(factor=0.9999).stretch) / 2e-4
    assert motion(('shear_modulus',)).by[:, 0] == pytest.approx(differences, abs=1e-5)


def test_remanence_and_coil_lag_are_found_beside_the_modulus():
    block = replace(oracle.BLOCK, shear_modulus=9e3, remanence=1.05 * oracle.BLOCK.remanence)
    _, found = run(
        measured(block, oracle.Extras(coil=5e-4), noise=1e-4),
        ('shear_modulus', 'damping_coefficient', 'remanence', 'coil_time_constant',
         'stretch_bias'))
    for name, value in (('shear_modulus', 9e3), ('remanence', block.remanence),
                        ('coil_time_constant', 5e-4)):
        assert found.values[name] == pytest.approx(value, abs=4.5 * found.deviations[name])
        assert found.deviations[name] < 0.02 * value


def test_samples_that_are_late_double_or_no_numbers_change_nothing():
    samples = measured(oracle.BLOCK)
    _, wanted = run(samples)
    order = np.arange(len(samples))
    order[60:63] = 62, 60, 61
    times = np.insert(SAMPLED[order], [20, 80], [SAMPLED[15], SAMPLED[79]])
    values = np.insert(samples[order], [20, 80], [7.0, np.nan])
    estimator, found = run(values, times=times)
    assert (estimator.screening.repeated, estimator.screening.unreadable) == (1, 1)
    assert found.values['shear_modulus'] == pytest.approx(
        wanted.values['shear_modulus'], abs=wanted.deviations['shear_modulus'])


def test_a_few_outliers_are_rejected_and_trust_remains():
    samples = measured(oracle.BLOCK)
    samples[[50, 70, 71, 120]] += 0.1
    estimator, found = run(samples)
    assert found.trusted
    assert estimator.screening.rejected == 4
    assert found.values['shear_modulus'] == pytest.approx(
        oracle.BLOCK.shear_modulus, abs=4.5 * found.deviations['shear_modulus'])


def test_a_sensor_that_jumps_or_freezes_is_not_trusted_and_the_estimate_stays():
    good = measured(oracle.BLOCK)
    jumped, frozen = good.copy(), good.copy()
    jumped[70:] += 0.05
    frozen[88:] = frozen[88]
    for samples, word in ((jumped, 'jump'), (frozen, 'repeats')):
        _, found = run(samples)
        assert not found.trusted
        assert word in found.trouble
        assert found.values['shear_modulus'] == pytest.approx(
            oracle.BLOCK.shear_modulus, rel=0.01)


def test_a_sensor_that_freezes_at_rest_is_told_from_one_without_noise():
    times = np.arange(-0.1, 0.02, 1e-3)
    for noise, factor, trusted in ((NOISE, 1.0, False), (0.0, 1.0, True), (0.0, 1.2, True)):
        ringing = 0.01 * (factor - 1.0) * np.exp(-40.0 * (times + 0.1)) * np.cos(700.0 * times)
        samples = 1.0 + ringing + noise * np.random.default_rng(0).standard_normal(len(times))
        samples[-12:] = samples[-12]
        estimator, found = run(samples, times=times)
        assert found.trusted is trusted
        assert ('without its noise' in found.trouble, estimator.screening.frozen > 0) == (
            not trusted, not trusted)


def test_trust_returns_with_the_sensor():
    samples = measured(oracle.BLOCK)
    samples[60:90] += 0.05
    _, found = run(samples)
    assert found.trusted


def test_parameters_stay_where_they_are_if_they_are_not_to_be_learnt():
    block = replace(oracle.BLOCK, shear_modulus=1.02e4)
    _, found = run(measured(block), options=EstimatorOptions(learn=False, gate=100.0))
    assert found.values['shear_modulus'] == pytest.approx(1e4, rel=1e-4)


def test_an_identified_covariance_is_the_prior(tmp_path):
    path = tmp_path / 'block.yaml'
    path.write_text(
        '/**:\n  ros__parameters:\n    actuator.shear_modulus: 12000.0\n'
        '    identification.names: [shear_modulus, damping_coefficient]\n'
        '    identification.covariance: [144.0, 0.0, 0.0, 1.0e-4]\n')
    belief = read_belief(path)
    prior = Prior.nominal(belief.actuator).informed(belief.known)
    _, found = run(np.ones(3), prior=prior, times=SAMPLED[:3])
    assert found.values['shear_modulus'] == pytest.approx(12000.0)
    assert found.deviations['shear_modulus'] == pytest.approx(12.0, rel=1e-3)
    assert found.deviations['damping_coefficient'] == pytest.approx(1e-2, rel=1e-3)


@pytest.mark.parametrize(('value', 'word'), [
    ('[144.0, 0.0, 0.0]', '3 numbers for 2 names'), ('[1.0, 2.0, 2.0, 1.0]', 'not a covariance'),
    ('[1.0, 0.0, 0.0, .nan]', 'expected 4 finite'), ('[1.0, 0.0, 0.0, x]', 'expected numbers')])
def test_a_covariance_that_is_none_is_refused(tmp_path, value, word):
    path = tmp_path / 'block.yaml'
    path.write_text(
        '/**:\n  ros__parameters:\n    actuator.shear_modulus: 12000.0\n'
        '    identification.names: [shear_modulus, damping_coefficient]\n'
        f'    identification.covariance: {value}\n')
    with pytest.raises(BadInputError, match=word):
        read_belief(path)


def test_parameters_that_are_frozen_stay_with_their_deviations_and_are_learnt_again_later():
    block = replace(oracle.BLOCK, shear_modulus=1.1e4)
    samples = measured(block)
    estimator = Estimator(Prior.nominal(oracle.BLOCK), EstimatorOptions(noise=NOISE))
    for time, level in zip(TIMES, LEVELS, strict=True):
        estimator.set_levels([(ns(time), level)])
    found = {}
    for i, (time, value) in enumerate(zip(SAMPLED, samples, strict=True)):
        # Frozen in mid-move, with little learnt.
        estimator.learning = not 35 <= i < 80
        estimator.sample(ns(time), value)
        found[i] = estimator.update(ns(time) + 2_000_000)
    first, last = (found[i].values['shear_modulus'] for i in (36, 79))
    assert last == pytest.approx(first, rel=1e-6)
    assert found[79].deviations['shear_modulus'] == pytest.approx(
        found[36].deviations['shear_modulus'])
    assert found[35].deviations['shear_modulus'] > 10.0 * found[149].deviations['shear_modulus']
    assert found[149].values['shear_modulus'] == pytest.approx(
        1.1e4, abs=4.5 * found[149].deviations['shear_modulus'])


def test_samples_that_nobody_asks_for_do_not_pile_up():
    estimator = Estimator(Prior.nominal(oracle.BLOCK), EstimatorOptions(window=20))
    for i in range(1000):
        assert estimator.sample(i * 1_000_000, 1.0)
    assert estimator.screening.late == 980
    assert estimator.update(1_000_000_000).stretch == pytest.approx(1.0, abs=1e-5)


def test_what_cannot_be_tracked_is_refused():
    with pytest.raises(BadInputError, match='initial_rate cannot be tracked'):
        Prior.nominal(oracle.BLOCK, ('initial_rate',))
    with pytest.raises(BadInputError, match='window is 3'):
        EstimatorOptions(window=3)


def test_a_bias_and_a_constant_force_are_said_to_be_confounded_until_two_targets_were_held():
    nominal = Prior.nominal(oracle.BLOCK, (
        'shear_modulus', 'damping_coefficient', 'stretch_bias', 'constant_force'))
    samples = measured(oracle.BLOCK, oracle.Extras(bias=4e-3, force=0.03), noise=2e-4)
    said = []
    for count in (25, len(samples)):
        _, found = run(samples[:count], prior=nominal, times=SAMPLED[:count])
        words = sentence(found, nominal.values, 0.0, 1.0, 1.0, 0.0, 'plans use it')
        said.append('cannot be distinguished until two targets were held' in words)
        assert said[-1] is confounded(found)
    assert said == [True, False]
    assert found.values['constant_force'] == pytest.approx(
        0.03, abs=4.0 * found.deviations['constant_force'])


@pytest.mark.parametrize(('factor', 'force'), [
    (0.8, 0.03), (1.2, -0.03), *(
        pytest.param(*x, marks=pytest.mark.slow) for x in ((0.8, -0.03), (1.2, 0.03)))])
def test_a_force_is_told_from_a_bias_where_another_modulus_was_given(factor, force):
    # It shifts the rest that the first move begins from by another share than was thought.
    block = replace(
        oracle.BLOCK, shear_modulus=factor * oracle.BLOCK.shear_modulus,
        damping_coefficient=2.0 * oracle.BLOCK.damping_coefficient)
    samples = measured(block, oracle.Extras(bias=1e-3, force=force), noise=1e-4)
    _, found = run(samples, prior=Prior.nominal(oracle.BLOCK, suspects=True))
    assert abs(found.values['stretch_bias'] - 1e-3) < 3.0 * found.deviations['stretch_bias']
    assert found.values['constant_force'] == pytest.approx(force, rel=0.1)


@pytest.mark.parametrize('gain', [0.98, pytest.param(1.02, marks=pytest.mark.slow)])
def test_a_bias_is_known_no_better_than_the_gain_of_the_sensor_lets_tell_it_from_a_force(gain):
    # The gain is about rest: what it shows of a stretch of 1 is right.
    extras = oracle.Extras(bias=1.0 - gain, force=0.03, gain=gain)
    samples = measured(oracle.BLOCK, extras, noise=1e-4)
    _, found = run(samples, prior=Prior.nominal(oracle.BLOCK, suspects=True))
    assert abs(found.values['stretch_bias']) < 3.0 * found.deviations['stretch_bias']


def test_a_bias_at_its_bound_is_correlated_with_nothing():
    prior = Prior.nominal(oracle.BLOCK, ('stretch_bias', 'stretch_gain'))
    _, found = run(measured(oracle.BLOCK, oracle.Extras(bias=0.02)), prior=prior)
    assert sensor_of(found, prior).bias_std == 0.0
    assert sensor_of(found, prior).together == 0.0


def test_another_remanence_leaves_modulus_and_damping_as_given():
    block = replace(oracle.BLOCK, remanence=1.02 * oracle.BLOCK.remanence)
    _, found = run(measured(block), prior=Prior.nominal(oracle.BLOCK, suspects=True))
    assert found.values['shear_modulus'] == pytest.approx(oracle.BLOCK.shear_modulus)
    assert found.values['damping_coefficient'] == pytest.approx(oracle.BLOCK.damping_coefficient)
    assert found.values['remanence'] == pytest.approx(block.remanence, rel=2e-3)


def test_a_gain_of_the_sensor_is_no_chain_limit():
    samples = measured(oracle.BLOCK, oracle.Extras(bias=0.02, gain=0.98), noise=3e-4)
    _, found = run(samples, prior=Prior.nominal(oracle.BLOCK, suspects=True))
    assert found.values['chain_limit'] == pytest.approx(oracle.BLOCK.chain_limit)


def test_a_gain_that_explains_samples_as_well_as_a_force_is_as_likely_but_not_sought():
    # Three tenths of the prior's deviation, known to a tenth, of either.
    look = Evidence(
        Hypotheses(('constant_force', 'stretch_gain'), (0, 1), 0, np.zeros(2), np.ones(2)),
        np.zeros(2), np.array([[101.0, 100.0], [100.0, 101.0]]), np.full(2, 40.0),
        np.full(2, -np.inf), np.full(2, np.inf))
    sought, others = look.choose(())
    assert sought == (0,)
    assert others.sure < 0.5
    assert others.off == pytest.approx([-0.2, 0.2], abs=0.01)


def _unsure(*, expected=True):
    """Return an estimate of a block whose G and creep ratio are correlated."""
    prior = Prior.nominal(oracle.BLOCK, suspects=True)
    estimator = Estimator(prior)
    estimator.set_levels([(0, 0.0)])
    found = estimator.predict(0)
    places = [found.free.index(x) for x in ('shear_modulus', 'viscoelastic_ratio')]
    covariance = np.zeros_like(found.covariance)
    covariance[np.ix_(places, places)] = [[4e-4, -4e-4], [-4e-4, 5e-4]]
    off = np.zeros(len(found.off))
    off[places[0]] = 0.01
    return replace(
        found, covariance=covariance, off=off, instead=expected * off,
        values={**found.values, 'viscoelastic_ratio': 0.02})


@pytest.mark.parametrize(('deviation', 'expected', 'modulus'), [
    # Creep is known: the modulus beside it; what is expected, unless what is sought is likely.
    (0.005, False, 0.0), (0.005, True, 0.01),
    # It is not: the modulus if there is none.
    (0.02, False, 0.8 * 0.02), (0.02, True, 0.01 + 0.8 * 0.02)])
def test_plans_use_what_is_expected_with_or_without_creep(deviation, expected, modulus):
    found = _unsure(expected=expected)
    found.deviations['viscoelastic_ratio'] = deviation
    block = found.model(PlannerOptions()).actuator
    assert bool(block.creep) is (deviation < 0.01)
    assert block.shear_modulus == pytest.approx(np.exp(modulus) * oracle.BLOCK.shear_modulus)


def test_plans_have_no_lag_where_none_was_found():
    found, random = _unsure(), np.random.default_rng(0)
    for _ in range(8):
        root = 1e-3 * random.standard_normal(found.covariance.shape)
        there = replace(found, covariance=root @ root.T, off=root[0], instead=root[0])
        assert there.model(PlannerOptions()).options.coil_time_constant == 0.0


def test_the_systems_of_subsets_are_solved_as_by_numpy():
    random = np.random.default_rng(0)
    root = random.standard_normal((9, 7))
    matrix, varies = root.T @ root, random.random((40, 7)) < 0.5
    given, log_det = random.standard_normal((40, 7)), np.empty(40)
    found = given.copy()
    subsets(matrix, varies, found, log_det)
    for some, right, solved, size in zip(varies, given, found, log_det, strict=True):
        part = matrix[np.ix_(some, some)]
        np.testing.assert_allclose(solved[some], np.linalg.solve(part, right[some]), rtol=1e-9)
        assert np.all(solved[~some] == right[~some])
        assert size == pytest.approx(np.linalg.slogdet(part)[1], rel=1e-12, abs=1e-12)
    weights, total, expected = random.random(40), np.ones((7, 7)), np.ones((7, 7))
    subset_inverses(matrix, varies, weights, total)
    for some, weight in zip(varies, weights.tolist(), strict=True):
        expected[np.ix_(some, some)] += weight * np.linalg.inv(matrix[np.ix_(some, some)])
    np.testing.assert_allclose(total, expected, rtol=1e-9)
    subsets(matrix, varies[:0], found[:0], log_det[:0])
    with pytest.raises(ValueError, match='fit each other'):
        subsets(matrix, varies, found[:39], log_det)
    with pytest.raises(ValueError, match='fit each other'):
        subset_inverses(matrix, varies, weights, total[:6])


@pytest.mark.parametrize('stretch', [1.1, pytest.param(1.4, marks=pytest.mark.slow)])
def test_a_changed_sensor_without_noise_is_known_to_within_a_variance_at_rest(stretch):
    estimator = Estimator(Prior.of_changed_sensor(
        oracle.BLOCK, ('shear_modulus', 'damping_coefficient', 'stretch_bias'), Known(), others={},
        bias=(0.0, 1e-4)))
    estimator.set_levels([(0, oracle.level_of(stretch))])
    for stamp in range(0, 1_200_000_000, 20_000_000):
        for i in range(10):
            estimator.sample(stamp + i * 2_000_000, stretch + 0.02)
        found = estimator.update(stamp + 20_000_000)
        assert found.trusted
        assert np.all(np.diag(found.covariance) >= 0.0)
    assert found.stretch == pytest.approx(stretch, abs=1e-6)


def test_levels_that_never_took_effect_are_forgotten():
    estimator = Estimator(Prior.nominal(oracle.BLOCK))
    estimator.set_levels([(0, 0.0), (ns(0.1), 0.07)])
    # The plan that has the next one begins later.
    estimator.set_levels([(ns(0.3), 0.05)], (0, ns(0.3)))
    assert estimator.predict(ns(0.2)).stretch == pytest.approx(1.0, abs=1e-9)
