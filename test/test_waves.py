"""Waves of the stretch, their spectra judged by SciPy's integration of the equation of motion."""

import json
import math
import re

from creep_oracle import C1
import numpy as np
import pytest
from test_path import moved, TIME

from hmsa import Actuator, UnusualWarning
from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.model.status import RefusedError

AMPLITUDE = 0.1
# Of small motion about 1, where psi'' is 3.
NATURAL = math.sqrt(3.0 / ((1.0 + C1) / 6.0)) / (2.0 * math.pi * TIME)
#: Share of the amplitude that a harmonic may have.
PURE = 5e-3
_OF_EACH, _CYCLES = 64, 6


def spectrum(plan, frequency, fade, mean=1.0, **coil):
    """Return the amplitudes at multiples of a frequency and between, and the error after it."""
    times = fade / frequency + np.arange(_CYCLES * _OF_EACH) / (_OF_EACH * frequency)
    end = plan.move_times[-1]
    stretch = moved(plan.levels.tolist(), np.append(
        times, end + np.linspace(1e-6, 3.0 / NATURAL, 300)), **coil)
    found = 2.0 * np.abs(np.fft.rfft(stretch[:len(times)] - mean)) / len(times)
    return found[::_CYCLES], np.delete(found, np.arange(0, len(found), _CYCLES)), (
        np.abs(stretch[len(times):] - 1.0).max())


@pytest.mark.parametrize(('share', 'options', 'coil'), [
    (1.0, {}, {}), (1.7, {}, {}), *(pytest.param(1.0 / 3.0, *x, marks=pytest.mark.slow) for x in (
        ({}, {}),
        ({'slew_limit': 60.0, 'coil_time_constant': 5e-4}, {'slew': 60.0, 'lag': 5e-4})))],
    ids=['resonance', 'above', 'a third', 'ramps and lag'])
def test_a_sine_of_the_field_is_not_what_a_sine_of_the_stretch_needs(share, options, coil):
    frequency = share * NATURAL
    plan = Actuator(**options).wave('sine', frequency, AMPLITUDE)
    assert plan.segments[0].notes() == []
    harmonics, between, after = spectrum(plan, frequency, math.ceil(max(1.0, 2.0 * share)), **coil)
    assert harmonics[1] == pytest.approx(AMPLITUDE, rel=1e-4)
    assert harmonics[0] < 2.0 * PURE * AMPLITUDE
    assert harmonics[2:].max() < 0.01 * PURE * AMPLITUDE
    assert between.max() < 0.01 * PURE * AMPLITUDE
    assert after < 1e-9
    if share < 1.0 and not coil:
        # The same sine of the field would not do.
        levels = plan.levels.copy()
        field = np.array([0.0, *plan.levels[:-1, 1]])
        steady = (plan.times > 1.0 / frequency) & (plan.times < 10.0 / frequency)
        size = np.ptp(field[steady]) / 2.0
        levels[:, 1] = size * np.sin(2.0 * np.pi * frequency * plan.times)
        plain = 2.0 * np.abs(np.fft.rfft(moved(
            levels.tolist(), 4.0 / frequency + np.arange(384) / (64.0 * frequency)) - 1.0)) / 384
        assert plain[12::6].max() > PURE * AMPLITUDE


@pytest.mark.parametrize(('share', 'path', 'end'), [
    (0.2, 3e-4, 1e-4), (0.5, 4e-3, 1e-3), (0.7, 0.03, 0.02)])
def test_a_wave_of_a_continuum_is_that_of_all_its_modes(share, path, end):
    block = Actuator(damping_ratio=0.03, mount='free', half_thickness=4e-3)
    frequency = share * block.scales.frequency
    plan = block.wave('sine', frequency, AMPLITUDE, cycles=16.0)
    motion = plan.simulate(rate=40.0 * frequency)
    steady = np.abs(motion.times * frequency - 10.0) < 2.0
    angle = 2.0 * np.pi * frequency * motion.times[steady]
    terms = np.column_stack([np.ones(len(angle)), np.sin(angle), np.cos(angle)])
    found, *_ = np.linalg.lstsq(terms, motion.stretches[steady], rcond=None)
    # It is 0.99, 0.93 and 0.86 if the path of the first mode is that of the stretch.
    assert np.hypot(*found[1:]) == pytest.approx(AMPLITUDE, rel=3e-3)
    after = motion.stretches[motion.times > plan.move_times[-1]]
    assert np.ptp(after) < end * AMPLITUDE
    assert any('secondary modes' in x for x in plan.segments[0].notes()) is (share > 0.2)
    wanted = 1.0 + AMPLITUDE * np.sin(angle)
    assert np.abs(motion.stretches[steady] - wanted).max() < path * AMPLITUDE


def test_what_the_modes_of_a_continuum_leave_of_a_wave_is_told():
    block = Actuator(damping_ratio=0.03, mount='free', half_thickness=4e-3)
    told, = block.wave('sine', 1.5 * block.scales.frequency, 0.02).segments[0].notes()
    assert float(re.search(r'\((\d+) % of its range\)', told)[1]) > 30.0
    assert 'the limit is its secondary modes' in told


def test_a_triangle_and_a_period_of_ones_own_are_followed_about_a_mean():
    block, frequency = Actuator(), 0.1 * NATURAL
    plan = block.wave('triangle', frequency, AMPLITUDE, offset=1.2)
    harmonics, between, after = spectrum(plan, frequency, 1, mean=1.2)
    # The even ones are missing, the odd ones fall at least as those of a true triangle.
    assert harmonics[2::2].max() < 0.01 * PURE * AMPLITUDE
    assert np.all(harmonics[3:10:2] < harmonics[1] / np.arange(3, 10, 2) ** 2)
    assert (between.max(), after) < (0.01 * PURE * AMPLITUDE, 1e-9)
    s = np.linspace(0.0, 1.0, 33)
    own = np.sin(2.0 * np.pi * s) + 0.3 * np.sin(4.0 * np.pi * s)
    plan = block.wave(np.column_stack([7.0 * s, 3.0 + own]), frequency, AMPLITUDE)
    harmonics, *_ = spectrum(plan, frequency, 1)
    assert harmonics[2] / harmonics[1] == pytest.approx(0.3, rel=1e-3)


def test_a_sweep_goes_through_the_resonance_at_one_amplitude():
    plan = Actuator().wave('sine', 20.0, 0.05, last=200.0, cycles=25)
    times = np.linspace(0.0, plan.move_times[-1] + 0.05, 3000)
    stretch = moved(plan.levels.tolist(), times)
    inside = (times > 0.06) & (times < plan.move_times[-1] - 0.03)
    peaks = np.abs(stretch[1:-1] - 1.0)[
        inside[1:-1] & ((np.diff(stretch)[1:] * np.diff(stretch)[:-1]) < 0.0)]
    assert len(peaks) > 30
    assert peaks == pytest.approx(np.full(len(peaks), 0.05), rel=0.02)
    assert np.abs(stretch[times > plan.move_times[-1] + 1e-6] - 1.0).max() < 1e-9


def test_what_the_limits_allow_is_told_and_holds():
    block = Actuator(slew_limit=100.0)
    (_, highest), = block.wave_bands('sine', AMPLITUDE)
    assert block.wave('sine', 0.999 * highest, AMPLITUDE).segments[0].notes() == []
    with pytest.raises(RefusedError, match=f'expected a frequency below {highest:.4g} Hz'):
        block.wave('sine', 1.001 * highest, AMPLITUDE)
    (_, highest), = Actuator().wave_bands('square', AMPLITUDE)
    assert {str(x.move.code) for x in Actuator().wave(
        'square', 0.99 * highest, AMPLITUDE, cycles=2).segments} == {'two_step'}
    with pytest.raises(RefusedError, match='at least as long as the move'):
        Actuator().wave('square', 1.01 * highest, AMPLITUDE, cycles=2)
    s = np.linspace(0.0, 1.0, 33)
    assert Actuator().wave_bands(np.column_stack([s, np.sin(2.0 * np.pi * s)]), 0.05) == (
        pytest.approx(Actuator().wave_bands('sine', 0.05), rel=0.02))
    with pytest.warns(UnusualWarning):
        weak = Actuator(flux_density_limits=1e-4)
    assert len(weak.wave_bands('sine', AMPLITUDE)) == 0


def test_the_bands_end_where_the_limits_do_and_not_where_the_search_does():
    # A strong coil moves a soft block far above 30 natural frequencies.
    strong = Actuator(flux_density_limits=2.0, remanence=0.4, shear_modulus=2e3)
    (lowest, highest), = strong.wave_bands('sine', 0.01)
    assert lowest == 0.0
    assert highest > 40.0 * NATURAL
    strong.wave('sine', 0.999 * highest, 0.01, cycles=1)
    with pytest.raises(RefusedError, match=f'expected a frequency below {highest:.4g} Hz'):
        strong.wave('sine', 1.001 * highest, 0.01, cycles=1)


def test_a_wave_that_is_only_possible_about_the_resonance_has_both_limits():
    # About the resonance, inertia carries what the coil cannot hold.
    with pytest.warns(UnusualWarning, match='the coil only reaches'):
        block = Actuator(flux_density_limits=2e-3, zeta=0.01)
    (lowest, highest), = block.wave_bands('sine', 0.02)
    assert 0.5 * NATURAL < lowest < NATURAL < highest < 1.5 * NATURAL
    with pytest.raises(RefusedError, match=f'frequency at {lowest:.4g} to {highest:.4g} Hz'):
        block.wave('sine', 0.99 * lowest, 0.02)


@pytest.mark.parametrize(('shape', 'values', 'words'), [
    ('saw', {}, "shape is 'saw': expected one of square, sine"),
    ('sine', {'frequency': 0.0}, 'frequency is 0 Hz'),
    ('sine', {'frequency': math.nan}, 'frequency is nan'),
    ('sine', {'frequency': 1e-6}, 'expected at most 200000'),
    ('sine', {'amplitude': 0.0}, 'amplitude is 0'),
    ('square', {'amplitude': 2.0}, 'an extreme of the wave is -1'),
    ('sine', {'offset': math.inf}, 'an extreme of the wave is inf'),
    ('sine', {'cycles': 0.5}, 'cycles is 0.5'), ('sine', {'last': -3.0}, 'frequency is -3 Hz'),
    ([(0.0, 1.0), (1.0, 1.1)], {}, 'at least 4 samples'),
    ([(x, 1.0) for x in range(5)], {}, 'stretches that vary'),
    ([(x, 1.0 + x) for x in range(5)], {}, 'a last sample equal to the first')])
def test_what_is_no_wave_is_refused(shape, values, words):
    with pytest.raises(BadInputError, match=words):
        Actuator().wave(shape, **{'frequency': 20.0, 'amplitude': 0.05, **values})


def test_the_command_tells_the_reach_first_and_writes_levels(tmp_path, capsys):
    out = tmp_path / 'wave.csv'
    wave = ['wave', 'sine', '--frequency', '30', '--amplitude', '0.05']
    assert main([*wave, '--mean', '1.1', '--out', str(out)]) == 0
    first, second, _ = capsys.readouterr().out.splitlines()
    assert first.startswith('an amplitude of 0.05 is possible below ')
    assert second.endswith('T, at rest after 0.4 s')
    written = np.loadtxt(out, delimiter=',', skiprows=1)
    assert main([*wave, '--offset', '1.1', '--json']) == 0
    assert np.allclose(json.loads(capsys.readouterr().out)['levels'], written, atol=1e-12)
    assert main(['wave', 'sweep', *wave[2:], '--to', '40', '--path', str(out)]) == 0
    times, stretch = np.loadtxt(out, delimiter=',', skiprows=1).T
    assert (stretch[0], stretch[-1]) == (1.0, 1.0)
    assert np.ptp(stretch) == pytest.approx(0.1, rel=1e-3)
    assert np.all(np.diff(times) > 0.0)
    assert main(['wave', 'square', *wave[2:], '--path', str(out)]) == 2
    assert 'a square wave is not a path, because it jumps: expected' in capsys.readouterr().err
    assert main(['wave', str(tmp_path), *wave[2:]]) == 2
    assert 'cannot be read (Is a directory): expected a CSV' in capsys.readouterr().err
    for extra, words in ((['--to', '40'], 'expected --to HZ with sweep'),
                         (['--amplitude', '3'], 'an extreme of the wave is -2'),
                         (['--frequency', '900'], 'Hz: expected a frequency below ')):
        assert main([*wave, *extra]) == 2
        assert words in capsys.readouterr().err
