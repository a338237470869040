"""Identification: derivatives, bounds, accuracy, verdicts, against simulations with SciPy."""

from dataclasses import replace

from identification_oracle import BLOCK, Extras, level_of, relative, simulate, steps
import numpy as np
import pytest

from benchmarks.bench_identification import levels_of
from hmsa.api.actuator import Actuator
from hmsa.errors import BadInputError
from hmsa.identification import modal
from hmsa.identification.fit import fit
from hmsa.identification.identify import identify
from hmsa.identification.intervals import profile
from hmsa.identification.measurement import Measurement
from hmsa.identification.quantities import (
    DEFAULT_FREE,
    from_coordinate,
    to_coordinate,
    values_of,
)
from hmsa.identification.response import respond
from hmsa.planning.two_step import plan_two_step

T = BLOCK.time_unit
SPAN = 10.0 * T
SEQUENCE = (1.1, 1.4, 1.0)
REPEATS = 15
NINE = (*DEFAULT_FREE, 'coil_time_constant', 'constant_force', 'viscoelastic_ratio',
        'viscoelastic_time')
EXTRAS = Extras(coil=5e-4, ratio=0.1, time=2.0 * T, force=0.3, bias=0.01)
#: Ten times off in modulus and damping, and off in all else.
FAR = replace(
    BLOCK, shear_modulus=10.0 * BLOCK.shear_modulus,
    damping_coefficient=0.1 * BLOCK.damping_coefficient, chain_limit=9.0, remanence=0.06)
NEAR_FAR = (FAR, replace(
    BLOCK, shear_modulus=0.1 * BLOCK.shear_modulus,
    damping_coefficient=10.0 * BLOCK.damping_coefficient))
TIMES = np.arange(1200) * 1e-3


def values_with(extras: Extras):
    """Return values of all quantities."""
    return values_of(BLOCK, {
        'coil_time_constant': extras.coil, 'viscoelastic_ratio': extras.ratio,
        'viscoelastic_time': extras.time, 'constant_force': extras.force,
        'stretch_bias': extras.bias, 'stretch_gain': extras.gain})


def recorded(targets=SEQUENCE, *, noise=1e-3, seed=0, times=TIMES, extras=None, repeats=9,
             span=SPAN) -> Measurement:
    """Return a noisy recording of unshaped steps."""
    level_times, levels = steps(targets, span, repeats)
    stretch = simulate(times, level_times, levels, extras=extras)
    noisy = stretch + noise * np.random.default_rng(seed).standard_normal(len(times))
    return Measurement(times, noisy, level_times, levels)


def shaped(repeats: int, noise: float = 1e-3) -> Measurement:
    """Return a recording of two-step moves."""
    now, start, level_times, levels = 0.02, 1.0, [0.0], [0.0]
    for target in SEQUENCE * repeats:
        plan = plan_two_step(start, target, BLOCK.nondimensional)
        level_times += [now, now + plan.tau_p * T]
        levels += [plan.beta_p * BLOCK.flux_density_unit, level_of(target)]
        start, now = target, now + SPAN
    level_times, levels = np.array(level_times), np.array(levels)
    stretch = simulate(TIMES, level_times, levels)
    noisy = stretch + noise * np.random.default_rng(1).standard_normal(len(TIMES))
    return Measurement(TIMES, noisy, level_times, levels)


@pytest.mark.parametrize('slew', [np.inf, 20.0])
def test_derivatives_are_those_of_finite_differences_for_every_parameter(slew):
    free = (*NINE, 'density', 'stretch_gain', 'sensor_latency')
    times = np.sort(np.random.default_rng(0).uniform(0.0, 0.25, 300))
    recording = Measurement(
        times, 1.0 + 0.1 * np.sin(70.0 * times), *steps(SEQUENCE, SPAN), slew_limit=slew)
    values = values_with(EXTRAS) | {'sensor_latency': 3e-4}
    for at_rest in (True, False):
        names = free if at_rest else (*free, 'initial_stretch', 'initial_rate')
        values |= {'initial_stretch': 1.05, 'initial_rate': 3.0}
        recording = replace(recording, at_rest=at_rest)
        exact = respond(recording, values, names, rtol=1e-12).jacobian
        for column, name in enumerate(names):
            x = to_coordinate(name, values[name])
            h = 1e-5 * max(abs(x), 1e-4)
            ends = [respond(
                recording, values | {name: from_coordinate(name, x + y)}, (),
                rtol=1e-12).stretch for y in (h, -h)]
            difference = (ends[0] - ends[1]) / (2.0 * h)
            assert exact[:, column] == pytest.approx(
                difference, abs=2e-5 * np.max(np.abs(difference))), name


def test_derivatives_ring_on_after_a_shaped_move_however_rare_the_samples_are():
    moves = shaped(2)
    recording = replace(moves, time=moves.time[::17], stretch=moves.stretch[::17])
    values = values_of(BLOCK)
    exact = respond(recording, values, ('shear_modulus',)).jacobian[:, 0]
    ends = [respond(
        recording, values | {'shear_modulus': x * BLOCK.shear_modulus}, (), rtol=1e-12).stretch
        for x in (1.0 + 1e-5, 1.0 - 1e-5)]
    assert exact == pytest.approx((ends[0] - ends[1]) / 2e-5, abs=1e-5)


def test_derivative_by_a_lag_of_nothing_is_the_limit_of_lags():
    times = np.arange(300) * 1e-3
    recording = Measurement(times, 1.0 + 0.1 * np.sin(70.0 * times), *steps(SEQUENCE, SPAN))
    values = values_of(BLOCK)
    none = respond(recording, values, ('coil_time_constant',), rtol=1e-12)
    little = respond(recording, values | {'coil_time_constant': 1e-7}, (), rtol=1e-12)
    assert (little.stretch - none.stretch) / 1e-7 == pytest.approx(
        none.jacobian[:, 0], abs=1e-3 * np.max(np.abs(none.jacobian)))


def test_response_is_that_of_an_independent_solver():
    level_times, levels = steps(SEQUENCE, SPAN, 2)
    times = np.sort(np.random.default_rng(0).uniform(0.0, 0.3, 500))
    recording = Measurement(times, 1.0 + 0.1 * np.sin(70.0 * times), level_times, levels)
    found = respond(recording, values_with(EXTRAS), (), rtol=1e-10)
    assert found.stretch == pytest.approx(
        simulate(times, level_times, levels, extras=EXTRAS), abs=5e-7)


@pytest.mark.parametrize(('targets', 'repeats', 'bounds', 'bias'), [
    (SEQUENCE, 1, (.030, .14, .23, .041), 2.3e-5),
    (SEQUENCE, REPEATS, (.008, .038, .060, .013), 3.1e-5),
    ((1.4, 1.8, .8, 1.0), 12, (.004, .017, .015, .006), 2.8e-5)])
def test_bounds_of_plain_steps_are_those_of_the_literature(targets, repeats, bounds, bias):
    times = np.arange(2000) * 1e-3
    recording = Measurement(
        times, 1.0 + 0.1 * np.sin(70.0 * times), *steps(targets, SPAN, repeats, begin=0.0))
    values = values_of(BLOCK)
    jacobian = respond(recording, values, DEFAULT_FREE).jacobian
    std = 1e-3 * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    std[1:3] *= 1.0 / values['damping_coefficient'], values['chain_limit']
    assert 100.0 * std[:4] == pytest.approx(bounds, rel=0.07, abs=6e-4)
    assert std[4] == pytest.approx(bias, rel=0.07)


@pytest.mark.parametrize('start', NEAR_FAR)
@pytest.mark.parametrize('rate', [1000, 200, 60])
def test_estimates_lie_within_their_intervals_from_starts_ten_times_off(start, rate):
    times = np.arange(int(1.2 * rate)) / rate
    found = identify(recorded(times=times), actuator=start)
    assert found.verdict == 'identified', found.reason
    off = relative(found)
    assert len(off) == 4
    assert max(map(abs, off.values())) < 4.0
    assert found.parameters['shear_modulus'].std < 10.0 * 1000.0 / rate
    assert found.noise_std == pytest.approx(1e-3, rel=0.2)


@pytest.mark.slow
def test_errors_of_many_runs_are_as_large_as_the_deviations_say():
    errors = np.array([
        [*relative(identify(recorded(seed=seed, repeats=3, times=TIMES[:500]))).values()]
        for seed in range(24)])
    # The mean square of 96 correlated normal errors.
    assert 0.55 < np.sqrt(np.mean(errors ** 2)) < 1.45
    assert np.mean(np.abs(errors) < 1.96) > 0.85


@pytest.mark.parametrize(('noise', 'rate'), [(0.0, 1000), (0.0, 200), (1e-6, 1000), (1e-4, 60)])
def test_search_ends_where_noise_is_near_the_errors_of_the_simulation(noise, rate):
    times = np.arange(2 * rate) / rate
    for seed in (10, 13):
        start = replace(
            BLOCK, shear_modulus=(1.0 + 0.02 * (seed - 9)) * BLOCK.shear_modulus,
            damping_coefficient=1.1 * BLOCK.damping_coefficient)
        found = identify(
            recorded(noise=noise, seed=seed, times=times, repeats=1), actuator=start)
        assert found.verdict == 'identified', found.reason
        assert max(map(abs, relative(found).values())) < 4.0


def test_nine_parameters_are_found_at_once(monkeypatch):
    with_modes = []
    monkeypatch.setattr(modal, 'fit', lambda *x, **y: with_modes.append(x) or fit(*x, **y))
    found = identify(recorded(extras=EXTRAS), free=NINE)
    assert found.verdict == 'identified', found.reason
    assert len(with_modes) <= 2
    assert max(map(abs, relative(found).values())) < 4.0
    for name, true in (
            ('coil_time_constant', EXTRAS.coil), ('viscoelastic_ratio', EXTRAS.ratio),
            ('viscoelastic_time', EXTRAS.time), ('constant_force', EXTRAS.force)):
        x = found.parameters[name]
        assert abs(x.value - true) < 4.0 * x.std, name


def test_search_among_slow_samples_of_shaped_moves_does_not_end_far_off():
    times = np.arange(400) / 200.0
    recording = Measurement(times, 1.0 + 0.1 * np.sin(70.0 * times), *levels_of(True, 15))
    clean = respond(recording, values_of(BLOCK), (), rtol=1e-10).stretch
    noise = 1e-4 * np.random.default_rng(1002).standard_normal(len(times))
    # Here differences from one sample to the next are as large as what a wrong fit leaves.
    start = replace(
        BLOCK, shear_modulus=2058.774275913783, remanence=0.1015426981741141,
        chain_limit=6.465398485581865, damping_coefficient=4.7000366100194295)
    found = identify(replace(recording, stretch=clean + noise), actuator=start)
    assert found.verdict == 'identified', found.reason
    assert max(map(abs, relative(found).values())) < 4.0


def test_time_unit_serves_where_geometry_is_unknown():
    free = ('time_unit', 'damping_coefficient', 'chain_limit', 'remanence')
    found = identify(recorded(), free=free, actuator=replace(BLOCK, density=400.0))
    assert found.verdict == 'identified', found.reason
    x = found.parameters['time_unit']
    assert abs(x.value - T) < 4.0 * x.std < 1e-3 * T
    assert found.actuator.time_unit == pytest.approx(x.value, rel=1e-12)


def test_begin_in_motion_frees_the_initial_state():
    whole = recorded()
    late = slice(35, None)
    level_times = whole.level_times[1:].copy()
    level_times[0] = whole.time[35]
    found = identify(Measurement(
        whole.time[late], whole.stretch[late], level_times, whole.levels[1:]))
    assert found.verdict == 'identified', found.reason
    assert not found.recording.at_rest
    assert found.names[-2:] == ('initial_stretch', 'initial_rate')
    assert max(map(abs, relative(found).values())) < 4.0


def test_one_in_a_hundred_outliers_moves_nothing_by_a_deviation():
    clean = recorded()
    before = identify(clean)
    random = np.random.default_rng(3)
    stretch = clean.stretch.copy()
    places = random.choice(len(stretch), 12, replace=False)
    stretch[places] = random.choice([0.2, 1.6, 3.0], 12)
    after = identify(replace(clean, stretch=stretch))
    assert after.verdict == 'identified'
    assert after.outliers == 12
    for name in after.names:
        x = after.parameters[name]
        assert abs(x.value - before.parameters[name].value) < x.std, name


@pytest.mark.slow
def test_correlated_noise_widens_the_intervals_and_is_no_misfit():
    from scipy.signal import lfilter
    clean = recorded(noise=0.0)
    errors, plain = [], identify(recorded()).parameters['shear_modulus'].std
    for seed in range(6):
        white = np.random.default_rng(seed).standard_normal(len(TIMES))
        noise = 1e-3 * np.sqrt(1.0 - 0.9 ** 2) * lfilter([1.0], [1.0, -0.9], white)
        found = identify(replace(clean, stretch=clean.stretch + noise))
        assert found.verdict == 'identified', found.reason
        assert found.widened > 1.5
        assert any('not white' in x for x in found.warnings)
        errors += relative(found).values()
    assert plain > 0.0
    assert np.sqrt(np.mean(np.square(errors))) < 1.6


def test_pixels_of_eight_bits_are_said_and_covered():
    recording = recorded(noise=0.0)
    pixel = 0.8 / 255.0
    found = identify(replace(
        recording, stretch=np.round(recording.stretch / pixel) * pixel))
    assert found.verdict == 'identified', found.reason
    assert any('steps of 0.0031' in x for x in found.warnings)
    assert max(map(abs, relative(found).values())) < 5.0


@pytest.mark.parametrize(('extras', 'words'), [
    (Extras(coil=5e-4), 'coil_time_constant'),
    (Extras(force=0.1), 'try --free +constant_force'),
    (Extras(ratio=0.1, time=2.0 * T), 'creep'),
    (Extras(ratio=0.1, time=0.1), 'creep')])
def test_what_the_model_leaves_out_rejects_it_by_name(extras, words):
    found = identify(recorded(extras=extras))
    assert found.verdict == 'model_rejected'
    assert words in found.reason
    assert 'autocorrelation' in found.reason


def _drifting(recording: Measurement) -> Measurement:
    return replace(recording, stretch=recording.stretch + 0.005 * recording.time)


def _ringing_twice(recording: Measurement) -> Measurement:
    return replace(recording, stretch=recording.stretch + 0.003 * np.sin(
        2.0 * np.pi * 311.0 * recording.time))


def _jittering(recording: Measurement) -> Measurement:
    late = 1e-4 * np.random.default_rng(5).standard_normal(len(TIMES))
    true = simulate(np.sort(np.clip(TIMES + late, 0.0, TIMES[-1])), *steps(SEQUENCE, SPAN, 9))
    return replace(recording, stretch=true)


@pytest.mark.parametrize(('change', 'word'), [
    (_drifting, 'drift'), (_ringing_twice, 'second mode at 31')])
def test_what_the_sensor_does_rejects_the_model_by_name(change, word):
    found = identify(change(recorded()))
    assert found.verdict == 'model_rejected'
    assert word in found.reason


@pytest.mark.parametrize(('make', 'warning'), [
    (lambda: shaped(9), 'sixth of the information'),
    (lambda: _jittering(recorded()), 'timestamp errors of')],
    ids=['shaped moves alone', 'stamps that jitter'])
def test_what_determines_the_parameters_poorly_is_identified_with_a_warning(make, warning):
    found = identify(make(), actuator=FAR)
    assert found.verdict == 'identified', found.reason
    assert any(warning in x for x in found.warnings)
    assert max(map(abs, relative(found).values())) < 4.0


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_foreign_motion_is_rejected_without_a_number():
    recording = recorded()
    found = identify(
        replace(recording, stretch=recording.stretch[::-1].copy()), actuator=BLOCK)
    assert found.verdict == 'model_rejected'
    assert all(np.isnan(found.parameters[x].value) for x in found.names)
    assert not found.warnings


def test_ratios_alone_are_not_identifiable_and_said_to_be():
    found = identify(recorded(), free=(*DEFAULT_FREE, 'density'))
    assert found.verdict == 'not_identifiable'
    for name in ('shear_modulus', 'density', 'remanence', 'damping_coefficient'):
        assert np.isnan(found.parameters[name].value)
        assert name in found.reason
    assert 'weigh' in found.reason
    assert np.isfinite(found.parameters['chain_limit'].value)


def test_samples_at_rest_alone_show_no_frequency_but_what_rest_determines():
    random = np.random.default_rng(4)
    targets = random.permutation(np.linspace(0.85, 1.6, 8))
    levels = np.array([level_of(x) for x in targets])
    times = np.sort(np.append(*(np.arange(8) + random.uniform(0.5, 0.95, 8) for _ in range(2))))
    for noise in (1e-4, 1e-3, 5e-3):
        recording = Measurement(
            times, np.repeat(targets, 2) + noise * random.standard_normal(16), np.arange(8.0),
            levels)
        found = identify(recording)
        assert found.verdict == 'not_identifiable', found.reason
        assert np.isnan(found.parameters['shear_modulus'].value)
        found = identify(recording, free=('remanence', 'chain_limit'))
        assert found.verdict == 'identified', found.reason
        assert abs(found.parameters['remanence'].value - BLOCK.remanence) < 4.0 * (
            found.parameters['remanence'].std)


def test_noisy_samples_of_one_step_are_no_higher_frequency_that_fits_them_by_chance():
    # At 4.2 samples a period: 353 Hz fit a recording like this one better than 17.5 Hz.
    unit = 1.0 / 17.5 / 2.56
    block = replace(
        BLOCK, shear_modulus=BLOCK.density * (BLOCK.half_length / unit) ** 2)
    times, level_times = 0.0136 * np.arange(61), np.array([0.0, 0.07])
    levels = np.array([0.0, level_of(1.3, block)])
    noise = 0.03 * np.random.default_rng(3).standard_normal(61)
    found = identify(
        Measurement(
            times, simulate(times, level_times, levels, block) + noise, level_times, levels),
        free=('shear_modulus', 'damping_coefficient', 'remanence', 'stretch_bias'))
    x = found.parameters['shear_modulus']
    assert found.verdict == 'not_identifiable' or x.low < block.shear_modulus < x.high


def test_errors_that_no_residual_shows_widen_the_intervals_and_are_said():
    recording = recorded(extras=Extras(gain=1.02), repeats=1, times=TIMES[:160], noise=3e-3)
    found = identify(recording, uncertain={'density': 0.05 * BLOCK.density})
    assert found.verdict == 'identified', found.reason
    for name in ('shear_modulus', 'remanence', 'chain_limit', 'damping_coefficient'):
        x = found.parameters[name]
        assert x.low < getattr(BLOCK, name) < x.high, name
    x = found.parameters['shear_modulus']
    assert x.high - x.value == pytest.approx(1.97 * 0.05 * x.value, rel=0.1)
    assert x.std < 0.005 * x.value
    for words in ('an error of density', '--known stretch_gain=1+-0.1%'):
        assert any(words in note for note in found.warnings)


def test_latency_that_samples_do_not_show_is_named_with_what_it_moves_until_it_is_given():
    period = 2.56 * T
    times = np.linspace(0.0, 0.1, 60)
    level_times, levels = steps((1.3,), SPAN, 1)
    stretch = simulate(times, level_times, levels) + 2e-3 * np.random.default_rng(
        3).standard_normal(60)
    recording = Measurement(times, stretch, level_times, levels)
    free = tuple(x for x in DEFAULT_FREE if x != 'chain_limit')
    note, = (x for x in identify(recording, free=free).warnings if 'sensor latency below' in x)
    seconds = float(note.split('below ')[1].split(' s ')[0])
    assert 0.003 * period < seconds < 0.3 * period
    assert '--known sensor_latency=VALUE+-STD' in note
    name, _, change = note.split('moves ')[1].split(': ')[0].split(' and ')[0].split(
        ', ')[0].partition(' by ')
    values = [identify(x, free=free).values[name] for x in (
        recording, replace(recording, time=times + seconds))]
    assert abs(values[1] - values[0]) == pytest.approx(float(change.split()[0]), rel=0.3)
    given = identify(recording, free=free, known={'sensor_latency': 0.0})
    assert not any('sensor latency below' in x for x in given.warnings)


@pytest.mark.slow
def test_small_stretches_do_not_hold_the_chain_limit():
    found = identify(recorded((1.02, 1.0)))
    assert found.verdict == 'not_identifiable'
    assert found.reason.startswith('chain_limit cannot be identified')
    assert 'larger stretches' in found.reason


@pytest.mark.slow
def test_gain_of_the_sensor_and_nine_more_are_not_read_out_of_one_shaped_pass():
    found = identify(shaped(1), free=(*NINE, 'stretch_gain'))
    assert found.verdict == 'not_identifiable'
    assert np.isnan(found.parameters['chain_limit'].value)


def test_profile_reaches_the_limit_at_the_ends_of_the_interval():
    found = identify(recorded(repeats=2, times=TIMES[:400]), known={'stretch_gain': 1.0})
    values, deviance = np.array(profile(found, 'chain_limit', 9)).T
    order = np.argsort(values)
    x = found.parameters['chain_limit']
    assert np.interp([x.low, x.high], values[order], deviance[order]) == pytest.approx(
        [3.84, 3.84], rel=0.3)
    with pytest.raises(BadInputError, match='density was not free: expected one of'):
        profile(found, 'density')


def test_what_a_model_lacks_costs_a_share_of_a_usual_step_not_of_the_smallest():
    time, (switches, levels) = np.arange(0.0, 2.4, 1e-3), steps((1.3, 1.31, 1.0, 1.2), 0.1, 6)
    since = time - switches[np.searchsorted(switches, time, 'right') - 1]
    seen = simulate(time, switches, levels) + 4e-3 * np.sin(900.0 * since) * np.exp(-50.0 * since)
    noise = np.random.default_rng(0).normal(0.0, 1e-3, len(time))
    found = identify(Measurement(time, seen + noise, switches, levels))
    assert found.verdict == 'model_rejected'
    assert 0.01 < found.cost < 0.03


def test_block_without_limit_of_its_chains_is_identified():
    block = replace(BLOCK, chain_limit=np.inf)
    level_times, levels = steps(SEQUENCE, SPAN, 3)
    times = TIMES[:500]
    stretch = simulate(times, level_times, levels, replace(block, chain_limit=1e12))
    stretch += 1e-3 * np.random.default_rng(2).standard_normal(len(times))
    free = tuple(x for x in DEFAULT_FREE if x != 'chain_limit')
    found = identify(
        Measurement(times, stretch, level_times, levels), free=free, actuator=replace(
            block, shear_modulus=1.3 * block.shear_modulus, remanence=0.08))
    assert found.verdict == 'identified', found.reason
    assert found.parameters['chain_limit'].value == np.inf
    assert max(map(abs, relative(found).values())) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize(('modulus', 'damping'), [(1.88, 0.11), (7.7, 0.15)])
def test_one_pass_at_sixty_frames_a_second_is_found_from_far_off(modulus, damping):
    # Three samples or so fall on each step, and it rings one and a half times between two.
    found = identify(
        recorded(noise=1e-4, times=np.arange(120) / 60.0, repeats=1), actuator=replace(
            BLOCK, shear_modulus=modulus * BLOCK.shear_modulus,
            damping_coefficient=damping * BLOCK.damping_coefficient))
    assert found.verdict == 'identified', found.reason
    assert max(map(abs, relative(found).values())) < 4.0


def test_sixty_uneven_points_of_a_figure_are_enough():
    random = np.random.default_rng(11)
    times = np.sort(random.uniform(0.0, 0.15, 60))
    found = identify(recorded(noise=5e-3, times=times, repeats=1), actuator=FAR)
    assert found.verdict == 'identified', found.reason
    assert max(map(abs, relative(found).values())) < 4.0


@pytest.mark.parametrize(('jitter', 'offset'), [
    pytest.param(0.01, 0.0, marks=pytest.mark.slow), (0.0, 0.003)])
def test_intervals_of_one_step_of_sixty_points_with_wrong_stamps_cover_the_truth(jitter, offset):
    period, start = 2.56 * T, replace(BLOCK, shear_modulus=1.05 * BLOCK.shear_modulus)
    level_times, levels = steps((1.3,), SPAN, 1)
    random, inside, warned = np.random.default_rng(7), [], 0
    for _ in range(8):
        times = np.sort(random.uniform(0.0, 0.1, 60))
        stretch = simulate(times, level_times, levels) + 2e-3 * random.standard_normal(60)
        stamps = times + period * (jitter * random.standard_normal(60) + offset)
        order = np.argsort(stamps)
        found = identify(
            Measurement(stamps[order], stretch[order], level_times, levels), actuator=start)
        warned += any('timestamp errors of' in x for x in found.warnings)
        if found.verdict == 'identified':
            inside += [x.low <= getattr(BLOCK, name) <= x.high
                       for name, x in found.parameters.items() if x.free and hasattr(BLOCK, name)]
    assert len(inside) >= 16
    assert np.mean(inside) > 0.85
    assert (warned == 8) == bool(jitter)


def test_a_switch_at_the_end_of_its_interval_does_not_keep_a_search_from_converging():
    time, switches, levels = np.arange(1000) / 1e3, np.array([0.0, 0.1, 0.6]), [0.0, 0.05, 0.0]
    seen = simulate(time, switches, levels)
    for seed in range(4):
        noise = np.random.default_rng(seed).normal(0.0, 1e-3, len(time))
        found = identify(Measurement(time, seen + noise, switches, levels, earlier=1e-3))
        assert found.fit.converged


@pytest.mark.parametrize(('rate', 'limit', 'share'), [
    (400.0, 1.07, 0.22), (3600.0, 1.10, 0.025), (20000.0, 1.07, 0.22), (20000.0, 1.10, 0.025)])
@pytest.mark.parametrize('noise', [0.0, 1e-4, 1e-3])
def test_a_sensor_that_cuts_off_is_named_at_any_sampling_rate(rate, limit, share, noise):
    commands = np.array([(0.0, 0.0), (0.05, 0.03), (0.2, -0.02), (0.35, 0.02), (0.5, 0.0)])
    motion = Actuator().simulate(commands, until=0.7, rate=rate, noise=noise)

    def recording(stretch):
        return Measurement(motion.times, stretch, *commands.T)

    seen = np.minimum(motion.stretches, limit)
    assert np.mean(seen == limit) == pytest.approx(share, abs=0.01)
    try:
        said = recording(seen).notes[0]
    except BadInputError as error:
        said = str(error)
        assert share > 0.05 or 'is cut off 2 times' in said
    else:
        assert share < 0.05
    assert f'{limit:g}' in said
    assert 'expected a sensor within its range' in said or 'the sensor seems to cut' in said
    assert recording(motion.stretches).notes == ()
    for digits in (3, 4, 5, 6):
        assert recording(np.round(motion.stretches, digits)).notes == ()


@pytest.mark.parametrize(('change', 'message'), [
    (lambda x: {'stretch': np.ones(1200)}, 'stays within 0.*expected a motion'),
    (lambda x: {'stretch': 1.0 + 1e-3 * np.random.default_rng(0).standard_normal(1200)},
     'expected a motion'),
    (lambda x: {'stretch': np.clip(x.stretch, 0.0, 1.35)}, 'cut off .* times at .*1.35'),
    (lambda x: {'stretch': 10.0 * x.stretch}, 'ten times the stretch'),
    (lambda x: {'stretch': 25.0 * x.stretch}, 'in mm'),
    (lambda x: {'levels': 1000.0 * x.levels}, 'in mT'),
    (lambda x: {'time': TIMES[::-1]}, 'expected increasing times'),
    (lambda x: {'time': TIMES[:5]}, '5 time and 1200 stretch'),
    (lambda x: {'stretch': np.where(TIMES == 0.5, np.nan, 1.1)}, '1 that are not finite')])
def test_arrays_that_hold_no_motion_are_refused_with_a_reason(change, message):
    recording = recorded()
    with pytest.raises(BadInputError, match=message):
        replace(recording, **change(recording))
