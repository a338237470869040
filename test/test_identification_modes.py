"""Identification of secondary modes: the motion with them, their search, advice and files."""

from dataclasses import replace
from datetime import datetime
import json
import math
import sys

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.block_elements import Block
from hmsa import Actuator
from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.identification import modal
from hmsa.identification.diagnosis import cost, frequency_of, misfit, unexplained
from hmsa.identification.excitation import Bounds, excite
from hmsa.identification.files import file_text, read_belief
from hmsa.identification.fit import fit, whiteness
from hmsa.identification.identify import identify
from hmsa.identification.measurement import Measurement
from hmsa.identification.quantities import (
    DEFAULT_FREE,
    from_coordinate,
    Known,
    MODES,
    SECONDARY,
    to_coordinate,
    values_of,
)
from hmsa.identification.response import respond
from hmsa.model import law
from hmsa.model.equations import elastic_force
from hmsa.model.modes import Modes
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation
from hmsa.planning.two_step import plan_two_step

pytestmark = pytest.mark.thorough

BLOCK = replace(paper_actuator(), damping_coefficient=0.5)
TRUE = replace(
    BLOCK, mass_factor=1.2, remanence=0.11, modes=Modes((1.4, 2.6), (0.2, 0.06), (0.1, 0.15)))
TARGETS = (1.1, 1.0, 1.2, 1.1, 0.9, 1.0, 1.15, 1.0)
DWELL = 8.0 * BLOCK.period
WITH_MODES = (*DEFAULT_FREE, MODES)


def levels_of(count=6, targets=TARGETS):
    """Return times in s and levels in T of unshaped steps."""
    times = np.append(0.0, 0.02 + DWELL * np.arange(count))
    levels = BLOCK.flux_density_unit * np.append(0.0, elastic_force(
        np.resize(targets, count), BLOCK.nondimensional))
    return times, levels


def recorded(actuator=TRUE, *, noise=1e-3, extras=None, seed=0, count=6) -> Measurement:
    """Return a recording of unshaped steps."""
    level_times, levels = levels_of(count)
    times = np.arange(0.0, level_times[-1] + DWELL, 1e-3)
    blank = Measurement(times, 1.0 + 0.1 * np.sin(70.0 * times), level_times, levels)
    stretch = respond(blank, values_of(actuator, extras), (), rtol=1e-10).stretch
    return replace(blank, stretch=stretch + noise * np.random.default_rng(
        seed).standard_normal(len(times)))


@pytest.mark.parametrize(('slew', 'extras'), [
    (np.inf, {}), (20.0, {'coil_time_constant': 5e-4, 'viscoelastic_ratio': 0.1}),
    (np.inf, {'damping_exponent': -1.5})])
def test_derivatives_with_modes_are_those_of_finite_differences(slew, extras):
    times = np.sort(np.random.default_rng(0).uniform(0.0, 0.25, 200))
    recording = Measurement(
        times, 1.0 + 0.1 * np.sin(70.0 * times), *levels_of(3), slew_limit=slew)
    actuator = replace(
        TRUE, transverse_mass_factor=1.3, modes=replace(
            TRUE.modes, exponents=(0.3, -0.2), share_exponents=(-2.0, 0.7)))
    values = values_of(actuator, extras)
    free = (*DEFAULT_FREE, 'mass_factor', 'transverse_mass_factor', *SECONDARY[0], *SECONDARY[1],
            *extras)
    exact = respond(recording, values, free, rtol=1e-12).jacobian
    for column, name in enumerate(free):
        x = to_coordinate(name, values[name])
        h = 1e-5 * max(abs(x), 1e-2)
        ends = [respond(
            recording, values | {name: from_coordinate(name, x + y)}, (), rtol=1e-12).stretch
            for y in (h, -h)]
        difference = (ends[0] - ends[1]) / (2.0 * h)
        assert exact[:, column] == pytest.approx(
            difference, abs=2e-5 * np.max(np.abs(difference))), name


@pytest.mark.parametrize('exponents', [(), (-2.0, 0.7)])
def test_response_with_modes_is_the_motion_of_the_simulation(exponents):
    true = replace(TRUE, modes=replace(TRUE.modes, share_exponents=exponents))
    recording = recorded(true, noise=0.0, count=3)
    simulation = ActuatorSimulation(true)
    for time, level in zip(recording.level_times, recording.levels, strict=True):
        simulation.command(round(1e9 * time), float(level))
    stretch = []
    for time in recording.time:
        simulation.advance(round(1e9 * time))
        stretch.append(simulation.stretch)
    assert recording.stretch == pytest.approx(stretch, abs=1e-6)


def test_damping_changes_with_a_power_of_the_stretch():
    recording, exponent = recorded(BLOCK, noise=0.0, count=1), -2.0
    group, unit = BLOCK.nondimensional, BLOCK.time_unit
    load = recording.levels[1] / BLOCK.flux_density_unit

    def change(_, state):
        stretch, rate = state
        damping = law.damping(stretch, group.packed) * stretch ** exponent
        inertia = -0.25 * rate ** 2 / stretch ** 4
        net = load - elastic_force(stretch, group) - damping * rate - inertia
        return rate, net / law.mass(stretch, group.packed)

    times = (recording.time - recording.level_times[1]) / unit
    after = times > 0.0
    expected = solve_ivp(
        change, (0.0, times[-1]), (1.0, 0.0), t_eval=times[after], rtol=1e-9, atol=1e-11).y[0]
    found = respond(recording, values_of(BLOCK, {'damping_exponent': exponent}), ())
    assert found.stretch[after] == pytest.approx(expected, abs=1e-6)


@pytest.fixture(scope='module')
def found():
    return identify(recorded(), WITH_MODES, actuator=BLOCK, known={'stretch_gain': 1.0})


def test_modes_are_found_in_one_recording_within_their_intervals(found):
    assert found.verdict == 'identified', found.reason
    assert len(found.modes) == 2
    values = values_of(TRUE)
    for name in found.names:
        x = found.parameters[name]
        assert abs(x.value - values[name]) < 4.0 * x.std, name
    assert 'shear_modulus' not in found.names
    assert found.parameters['shear_modulus'].value == BLOCK.shear_modulus
    for mode, ratio, share in zip(found.modes, TRUE.modes.ratios, TRUE.modes.shares, strict=True):
        assert mode.ratio[0] == pytest.approx(ratio, rel=0.02)
        assert mode.share[0] == pytest.approx(share, rel=0.1)


def test_file_of_modes_is_read_by_plans_and_as_prior(found, tmp_path):
    path = tmp_path / 'actuator.yaml'
    path.write_text(file_text(
        found, read_belief(None), 'recording', datetime(2000, 1, 1)), encoding='utf-8')
    belief = read_belief(path)
    assert belief.actuator.modes == found.actuator.modes
    assert belief.actuator.mass_factor == found.values['mass_factor'] != 1.0
    assert 'standard deviation' in next(
        x for x in path.read_text().splitlines() if 'modes.share:' in x)
    # Feedback does not estimate secondary modes.
    assert set(belief.known.names) == {
        'damping_coefficient', 'chain_limit', 'remanence', 'stretch_bias'}


def test_modes_of_the_parameter_file_are_part_of_the_fit():
    known = replace(TRUE, remanence=BLOCK.remanence)
    found = identify(recorded(), actuator=known)
    assert found.verdict == 'identified', found.reason
    x = found.parameters['shear_modulus']
    assert abs(x.value - TRUE.shear_modulus) < 4.0 * x.std


@pytest.mark.parametrize('modes', [
    Modes((1.4,), (0.2,), (0.1,)), *(pytest.param(x, marks=pytest.mark.slow) for x in (
        Modes((1.7, 2.6), (0.2, 0.06), (0.1, 0.15)), Modes((1.4, 2.6), (0.05, 0.06), (0.1, 0.15)),
        Modes((3.0,), (0.1,), (0.1,))))])
def test_modes_of_the_parameter_file_that_are_wrong_or_too_few_are_named(modes):
    found = identify(recorded(), actuator=replace(TRUE, modes=modes))
    assert found.verdict == 'model_rejected'
    assert found.signatures[0].remedy == MODES
    assert found.modes[0].ratio[0] == pytest.approx(1.4, rel=0.05)
    assert found.modes[0].share[0] == pytest.approx(0.2, rel=0.1)
    again = identify(recorded(), WITH_MODES, actuator=replace(TRUE, modes=modes))
    assert again.verdict == 'identified', again.reason


def test_a_defect_beside_right_modes_of_the_parameter_file_is_not_taken_for_modes():
    found = identify(recorded(extras={'coil_time_constant': 1e-3}), actuator=TRUE)
    assert found.verdict == 'model_rejected'
    assert found.signatures[0].remedy == 'coil_time_constant'


def test_a_mode_is_named_before_all_else_and_the_first_mode_is_shown():
    found = identify(recorded(), actuator=BLOCK)
    assert found.verdict == 'model_rejected'
    assert found.reason.index('a second mode at') < found.reason.index('try --free +modes')
    assert found.signatures[0].remedy == MODES
    mode = found.modes[0]
    assert mode.ratio[0] == pytest.approx(1.4, rel=0.1)
    assert mode.share[1] > 0.0
    assert all(np.isfinite(found.parameters[x].value) for x in found.names)
    # Of one mode, the modulus has to explain the mass factor.
    assert found.parameters['shear_modulus'].value == pytest.approx(
        BLOCK.shear_modulus / 1.2, rel=0.05)
    assert found.record()['modes'][0]['ratio'] == mode.ratio


def test_a_large_mode_that_changes_with_the_stretch_is_named_and_asks_for_smaller_steps():
    known = replace(BLOCK, damping_coefficient=0.24)
    recording = recorded(replace(
        known, mass_factor=1.24, transverse_mass_factor=2.5, modes=Modes(
            (1.36,), (0.4,), (0.05,), exponents=(0.7,), share_exponents=(-10.0,))), count=5)
    plain = identify(recording, actuator=known)
    assert plain.signatures[0].remedy == MODES
    assert plain.reason.endswith('try --free +modes')
    found = identify(recording, WITH_MODES, actuator=known)
    assert found.verdict == 'model_rejected'
    assert 'record steps half as large' in found.reason
    # So do the same modes in a parameter file.
    told = fit(recording, found.values, ('remanence',), most=2)
    assert 'record steps half as large' in misfit(
        told, whiteness(told.root * told.residual), (), None)


def test_modes_that_explain_nearly_all_residuals_are_named_whatever_their_intervals(monkeypatch):
    # As on finite elements of a tall block, of which no step was recorded twice.
    monkeypatch.setattr(sys.modules['hmsa.identification.identify'], '_CLEAR', 1e9)
    tall = replace(BLOCK, half_thickness=3.0 * BLOCK.half_length, damping_coefficient=0.15)
    found = identify(
        recorded(replace(tall, mass_factor=1.2, modes=Modes(
            (2.4, 2.7, 3.0), (0.05, 0.08, 0.02), (0.2, 0.22, 0.24), (), (-2.0, 1.0, 2.0))),
            count=3), actuator=tall)
    assert found.verdict == 'model_rejected'
    assert found.signatures[0].remedy == MODES


def test_close_modes_that_change_with_the_stretch_are_no_single_one_of_more_damping(monkeypatch):
    # With computed modes, a third one would be added, so broad that it stands for others.
    monkeypatch.setattr(
        sys.modules['hmsa.identification.identify'], 'as_computed', lambda *_: None)
    known = replace(BLOCK, damping_coefficient=0.25)
    found = identify(recorded(replace(known, mass_factor=1.2, modes=Modes(
        (1.7, 2.1), (0.12, 0.12), (0.05, 0.06), (0.4, 0.4), (-2.0, 1.5))), count=5),
        WITH_MODES, actuator=known)
    assert found.verdict == 'identified', found.reason
    assert [x.ratio[0] for x in found.modes] == pytest.approx([1.7, 2.1], rel=0.05)
    assert [x.share[0] for x in found.modes] == pytest.approx([0.12, 0.12], rel=0.15)


def test_a_mode_too_fast_for_a_strong_one_has_the_damping_of_all_weak_ones():
    true = replace(BLOCK, modes=Modes((1.4, 8.0), (0.2, 0.1), (0.1, 0.6)))
    begin = fit(
        recorded(true, count=2), {**values_of(true), 'modes.damping_ratio.2': 0.3},
        ('mass_factor', 'modes.share.2'))
    values = modal._viscous(begin).values
    assert values['modes.damping_ratio.2'] == 0.6
    assert values['modes.damping_ratio'] == pytest.approx(1.4 * modal._damping_ratio(values))


@pytest.mark.parametrize('shares', [0.0, 0.95])
def test_what_was_not_asked_for_is_not_free_where_the_modes_hide_it(monkeypatch, shares):
    # As on finite elements of a flat block, where each coordinate improves the fit.
    monkeypatch.setattr(modal, '_completed', lambda best, _: best)

    def again(recording, values, free, **given):
        # Without it, a cube's modes may only fit with impossible shares.
        own = {SECONDARY[0][1]: shares} if shares and 'transverse_mass_factor' not in free else {}
        return fit(recording, {**values, **own}, [x for x in free if x not in own], **given)

    monkeypatch.setattr(sys.modules['hmsa.identification.identify'], 'fit', again)
    flat = replace(BLOCK, half_thickness=0.02 * BLOCK.half_length, damping_coefficient=5.0)
    found = identify(recorded(replace(flat, mass_factor=1.4, modes=Modes(
        (1.3,), (0.2,), (0.05,))), count=2), WITH_MODES, actuator=flat)
    assert 0.0 < found.actuator.modes.shares[0] < 0.9
    if shares:
        assert found.verdict == 'not_identifiable'
        return
    assert found.verdict == 'identified', found.reason
    assert 'transverse_mass_factor' not in found.names
    assert found.values['transverse_mass_factor'] == 1.0
    assert found.parameters['mass_factor'].value == pytest.approx(1.4, rel=0.01)


def test_a_mode_close_to_the_first_is_named_and_identified():
    known = replace(BLOCK, damping_coefficient=0.12)
    recording = recorded(replace(
        known, mass_factor=1.2, modes=Modes((1.09, 1.45), (0.25, 0.1), (0.026, 0.04))))
    assert identify(recording, actuator=known).reason.endswith('try --free +modes')
    found = identify(recording, WITH_MODES, actuator=known)
    assert found.verdict == 'identified', found.reason
    assert found.modes[0].ratio[0] == pytest.approx(1.09, rel=0.01)
    assert found.modes[0].share[0] == pytest.approx(0.25, rel=0.1)


def test_gain_beside_modes_that_leave_more_than_noise_may_be_an_error_of_the_statics():
    known = replace(BLOCK, damping_coefficient=0.25)
    found = identify(recorded(replace(known, mass_factor=1.2, modes=Modes(
        (1.7,), (0.2,), (0.05,), (0.4,), (-2.0,))), extras={'stretch_gain': 0.8}, count=5),
        (*WITH_MODES, 'stretch_gain'), actuator=known)
    assert found.verdict == 'not_identifiable'
    assert 'an error of the statics of the actuator would look the same' in found.reason


def test_residuals_of_shaped_moves_stand_for_twice_as_much_vibration():
    factors, steps = [], recorded()
    for shaped in (False, True):
        recording = steps
        if shaped:
            plan = plan_two_step(1.0, 1.1, BLOCK.nondimensional)
            recording = replace(
                steps, level_times=np.array([0.0, 0.02, 0.02 + plan.tau_p * BLOCK.time_unit]),
                levels=BLOCK.flux_density_unit * np.array([0.0, plan.beta_p, float(
                    elastic_force(1.1, BLOCK.nondimensional))]))
            recording = replace(recording, stretch=respond(
                recording, values_of(BLOCK), ()).stretch)
        found = fit(recording, values_of(BLOCK), ('remanence', *SECONDARY[0]), most=3)
        factors.append(cost(found, (), None) / unexplained(found))
    assert factors[1] == pytest.approx(2.0 * factors[0])


def test_modes_of_a_block_that_change_with_the_stretch_are_the_computed_ones():
    flat = Actuator(half_thickness=3e-3, damping_ratio=0.04)
    block = flat.replace(mount='free').block
    true = replace(block, remanence=0.11)
    found = identify(recorded(true, count=5), WITH_MODES, actuator=flat.block)
    assert found.verdict == 'identified', found.reason
    # Fitted modes that do not change would leave more than noise.
    assert found.whiteness.white
    assert found.actuator.modes.share_exponents == block.modes.share_exponents
    assert found.actuator.modes.ratios[2] == block.modes.ratios[2]
    values = values_of(true)
    for name in found.names:
        x = found.parameters[name]
        assert abs(x.value - values[name]) < 4.0 * x.std, name
    assert any('computed for a block' in x for x in found.warnings)
    assert 'times the first) with' in found.modes[0].words


def test_computed_modes_may_be_close_to_each_other():
    tall = Actuator(half_thickness=26e-3, damping_ratio=0.04)
    modes = tall.replace(mount='free').block.modes
    true = replace(
        tall.replace(mount='free').block, modes=replace(
            modes, shares=(modes.shares[0], 0.06, modes.shares[2])))
    assert modes.ratios[1] < 1.12 * modes.ratios[0]
    found = identify(recorded(true, count=5), WITH_MODES, actuator=tall.block)
    assert found.verdict == 'identified', found.reason
    assert found.actuator.modes.ratios == pytest.approx(modes.ratios, rel=5e-3)
    assert found.actuator.modes.shares == pytest.approx(true.modes.shares, rel=0.06)


def test_a_latency_that_hardly_shows_beside_modes_is_part_of_the_intervals():
    found = identify(
        recorded(extras={'sensor_latency': 1e-4}, count=4), WITH_MODES, actuator=BLOCK)
    assert found.verdict == 'identified', found.reason
    assert any(x.found and x.remedy == 'sensor_latency' for x in found.signatures)
    for name, true in (('mass_factor', TRUE.mass_factor), ('remanence', TRUE.remanence),
                       ('damping_coefficient', TRUE.damping_coefficient)):
        value = found.parameters[name]
        assert value.low < true < value.high


def test_without_modes_none_is_found():
    found = identify(recorded(replace(BLOCK, mass_factor=1.3)), WITH_MODES, actuator=BLOCK)
    assert found.verdict == 'identified', found.reason
    assert not found.modes
    assert found.parameters['mass_factor'].value == pytest.approx(1.3, rel=1e-3)


def test_values_of_no_actuator_beside_residuals_are_rejected(monkeypatch):
    usual = sys.modules['hmsa.identification.diagnosis']._USUAL
    monkeypatch.setitem(usual, 'remanence', (0.2, 0.3, -2))
    with pytest.raises(BadInputError, match='corresponds to a remanence'):
        identify(recorded(BLOCK), actuator=BLOCK)
    # Fits to glued blocks, which do not deform uniformly, have led to such values.
    found = identify(
        recorded(TRUE), (*(x for x in DEFAULT_FREE if x != 'chain_limit'), 'stretch_gain'),
        actuator=BLOCK)
    assert found.verdict == 'model_rejected'


@pytest.mark.parametrize(('extras', 'words'), [
    ({'viscoelastic_ratio': 0.1}, 'creep'), ({'stretch_gain': 0.97}, 'stretch_gain'),
    ({'coil_time_constant': 3e-3}, 'sensor_latency')])
def test_defects_are_not_taken_for_modes(extras, words):
    found = identify(recorded(BLOCK, extras=extras), actuator=BLOCK)
    assert found.verdict == 'model_rejected'
    assert not found.modes
    assert words in found.reason


def test_what_is_freed_on_advice_is_said():
    found = identify(
        recorded(BLOCK, extras={'stretch_gain': 0.97}), (*DEFAULT_FREE, 'stretch_gain'),
        actuator=BLOCK)
    assert found.verdict == 'identified', found.reason
    assert any(x.startswith('stretch_gain 0.97') and 'no other measurement' in x
               for x in found.warnings)


def test_what_a_mode_explains_as_well_as_freed_parameters_is_not_identifiable():
    free = (*(x for x in DEFAULT_FREE if x != 'chain_limit'), 'stretch_gain', 'sensor_latency',
            'viscoelastic_ratio', 'viscoelastic_time')
    found = identify(recorded(
        replace(BLOCK, modes=Modes((1.5,), (0.1,), (0.55,))), count=3, noise=2e-3), free,
        actuator=BLOCK)
    assert found.verdict == 'not_identifiable'
    assert 'a second mode' in found.reason
    assert '--free +modes' in found.reason


def _block(known, cells) -> Block:
    material = known.nondimensional
    return Block(
        known.half_thickness / known.half_length, material.j_lim,
        material.zeta * material.c1 / 6.0, cells)


def _elements(known, cells) -> Measurement:
    """Return a recording of coarse finite elements."""
    material, unit, dwell = known.nondimensional, known.time_unit, 8.0 * known.period
    times = np.append(0.0, 0.02 + dwell * np.arange(6))
    levels = known.flux_density_unit * np.append(0.0, elastic_force(
        np.resize(TARGETS, 6), material))
    block = _block(known, cells)
    end = float(times[-1] + dwell)
    moved, stretch = block.follow([*zip(
        np.diff(np.append(times, end)) / unit, (levels / known.flux_density_unit).tolist(),
        strict=True)])
    samples = np.arange(0.0, end, 1e-3)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(len(samples))
    return Measurement(samples, noise + np.interp(
        samples, np.append(0.0, moved) * unit, np.append(1.0, stretch)), times, levels)


def test_finite_elements_are_rejected_for_a_second_mode_and_identified_with_it():
    known = replace(BLOCK, half_thickness=0.5 * BLOCK.half_length)
    recording = _elements(known, (3, 3, 2))
    plain = identify(recording, actuator=known)
    assert plain.verdict == 'model_rejected'
    assert 'a second mode' in plain.reason
    assert '--free +modes' in plain.reason
    found = identify(recording, WITH_MODES, actuator=known)
    assert found.verdict == 'identified', found.reason
    assert found.residual_rms < 0.8 * plain.residual_rms
    # The viscous stress of an elongated block acts on a smaller area, and its rate is smaller.
    assert -3.5 < found.parameters['damping_exponent'].value < -1.0
    assert found.parameters['damping_coefficient'].value == pytest.approx(
        BLOCK.damping_coefficient, rel=0.1)
    assert found.parameters['remanence'].value == pytest.approx(BLOCK.remanence, rel=0.03)
    assert abs(found.parameters['stretch_bias'].value) < 3.0 * found.parameters['stretch_bias'].std
    assert any('modes leave' in x for x in found.warnings)
    frequencies, shares = _block(known, (3, 3, 2)).modes()
    true = frequencies[np.argmax(shares)] / (2.0 * math.pi * known.time_unit)
    factor = found.parameters['mass_factor']
    assert factor.low < factor.value * (frequency_of(found.fit) / true) ** 2 < factor.high
    assert 0.02 < (factor.high - factor.low) / factor.value < 0.028


@pytest.mark.slow
def test_excitation_for_modes_is_small_and_resolves_them():
    actuator = replace(BLOCK, modes=Modes((1.4,), (0.2,), (0.1,)))
    found = excite(actuator, Bounds(), duration=0.4, free=WITH_MODES)
    low, high = found.best.reach
    assert 0.85 < low < 0.95
    assert 1.05 < high <= 1.15
    assert found.best.std['modes.frequency_ratio'] < 0.01
    assert found.best.std['modes.share'] < 0.1
    assert 'mass_factor' in found.best.std
    assert 'chain_limit' not in found.best.std


def test_command_frees_modes_and_writes_them(tmp_path, capsys):
    recording = recorded()
    np.savetxt(
        tmp_path / 'camera.csv', np.column_stack([recording.time, recording.stretch]),
        delimiter=',', header='time,stretch', comments='')
    np.savetxt(
        tmp_path / 'levels.csv', np.column_stack([recording.level_times, recording.levels]),
        delimiter=',', header='time,flux_density', comments='')
    out = tmp_path / 'actuator.yaml'
    assert main([
        'identify', str(tmp_path / 'camera.csv'), '--commands', str(tmp_path / 'levels.csv'),
        '--known', f'damping_coefficient={BLOCK.damping_coefficient}', '--free', '+modes',
        '--out', str(out), '--json']) == 0
    record = json.loads(capsys.readouterr().out)
    assert record['verdict'] == 'identified'
    assert len(record['modes']) == len(read_belief(out).actuator.modes.ratios) == 2


def test_known_values_leave_out_modes():
    assert Known.read({
        'identification.names': ['remanence', 'modes.share', 'mass_factor'],
        'identification.values': [0.1, 0.2, 1.2],
        'identification.covariance': np.diag([1e-6, 1e-4, 1e-4]).ravel().tolist(),
    }).names == ('remanence',)
