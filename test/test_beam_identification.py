"""Identification of a beam, against its equations integrated by SciPy."""

from dataclasses import replace
from functools import cache
import json

from beam_oracle import (
    DAMPING,
    DENSITY,
    LENGTH,
    REMANENCE,
    sampled,
    silicone,
    THICKNESS,
    WIDTH,
    YOUNGS,
)
import numpy as np
import pytest

from benchmarks.beam_segments import Chain
from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.identification.excitation import Bounds, Designer, excite
from hmsa.identification.files import read_belief
from hmsa.identification.identify import identify
from hmsa.identification.measurement import Measurement, UncheckedMeasurement
from hmsa.identification.quantities import check_free, DEFAULT_FREE, derivative, values_of
from hmsa.identification.response import respond
from hmsa.interfaces.actuator import along_elastica
from hmsa.model import equations
from hmsa.model.continuum import clamped
from hmsa.model.laws.record import DEFLECTION
from hmsa.model.modes import Modes
from hmsa.model.simulation import ActuatorSimulation

pytestmark = pytest.mark.thorough

BEAM = silicone()
PERIOD = 2.0 * np.pi * BEAM.time_unit / float(
    equations.natural_frequency(0.0, BEAM.nondimensional))
TRUE = {'shear_modulus': BEAM.shear_modulus, 'damping_coefficient': DAMPING,
        'remanence': REMANENCE, 'stretch_bias': 0.0}
#: As one would guess it.
START = replace(
    BEAM, shear_modulus=2.5 * BEAM.shear_modulus, damping_coefficient=0.4 * DAMPING,
    remanence=0.07)
LEVELS = np.array([0.0, *(BEAM.flux_density_unit * float(
    equations.elastic_force(x, BEAM.nondimensional)) for x in (0.2, -0.3, 0.4, 0.0))])
LEVEL_TIMES = np.append(0.0, 0.1 + 4.0 * PERIOD * np.arange(4))
TIMES = np.arange(0.0, LEVEL_TIMES[-1] + 4.0 * PERIOD, 0.01)


@cache
def motion():
    """Return the noise-free output of a sensor."""
    return sampled(TIMES, LEVEL_TIMES, LEVELS)


def seen(noise=1e-3, seed=0):
    """Return the output of a camera."""
    return motion() + noise * np.random.default_rng(seed).standard_normal(len(TIMES))


@pytest.mark.parametrize(('name', 'change'), [
    ('shear_modulus', 'modulus'), ('damping_coefficient', 'damping'),
    ('remanence', 'remanence'), ('constant_force', 'force')])
def test_derivatives_are_those_of_the_equation_of_the_angle(name, change):
    short = slice(0, 90)
    size, middle = (1e-6, 0.0) if change == 'force' else (1e-3, 1.0)
    ends = [sampled(TIMES[short], LEVEL_TIMES[:2], LEVELS[:2], **{change: middle + x})
            for x in (-size, size)]
    values = values_of(BEAM)
    found = respond(
        UncheckedMeasurement(TIMES[short], LEVEL_TIMES[:2], LEVELS[:2]), values, [name])
    scale = 1.0 if change == 'force' else TRUE[name]
    wanted = (ends[1] - ends[0]) / (2.0 * size) / scale * derivative(name, values[name])
    assert found.jacobian[:, 0] == pytest.approx(
        wanted, abs=3e-4 * np.max(np.abs(wanted)))


def of_beam(times, deflection, level_times=LEVEL_TIMES, levels=LEVELS):
    return Measurement(times, deflection, level_times, levels, coordinate=DEFLECTION)


def test_modulus_damping_remanence_and_bias_are_found_within_their_deviations():
    found = identify(of_beam(TIMES, seen() + 0.01), actuator=START)
    assert found.verdict == 'identified'
    for name, value in (TRUE | {'stretch_bias': 0.01}).items():
        estimate = found.parameters[name]
        assert abs(estimate.value - value) < 4.0 * estimate.std
        assert estimate.std < 1e-3 * max(value, 0.1)
    assert found.shown('shear_modulus')[0] == 'youngs_modulus'
    assert found.noise_std == pytest.approx(1e-3, rel=0.15)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(('every', 'noise', 'count'), [(1, 1e-3, 60), (3, 5e-3, 30)])
def test_errors_of_many_runs_are_as_large_as_the_deviations_say(every, noise, count):
    runs = [identify(of_beam(TIMES[::every], seen(noise, seed)[::every]), actuator=START)
            for seed in range(count)]
    off = np.array([[(x.parameters[name].value - value) / x.parameters[name].std
                     for name, value in TRUE.items()] for x in runs])
    assert all(x.verdict == 'identified' for x in runs)
    assert np.all(np.sqrt(np.mean(off ** 2, axis=0)) < 1.3)
    assert 0.91 < np.mean(np.abs(off) < 1.96) < 0.985


def test_begin_in_motion_frees_the_initial_deflection():
    late = slice(20, None)
    found = identify(
        of_beam(TIMES[late], seen()[late], LEVEL_TIMES[1:], LEVELS[1:]), actuator=START)
    assert found.verdict == 'identified'
    assert 'initial_stretch' in found.names
    estimate = found.parameters['shear_modulus']
    assert abs(estimate.value - BEAM.shear_modulus) < 4.0 * estimate.std


def test_command_shows_the_modulus_of_young_and_writes_what_the_nodes_take(
        tmp_path, capsys, refusal):
    known, data, levels, out, page = (
        tmp_path / x for x in ('beam.yaml', 'camera.csv', 'levels.csv', 'found.yaml', 'page.html'))
    assert main([
        'init', '--beam', '--length', '25mm', '--thickness', '1mm', '--width', '5mm',
        '--youngs-modulus', '2MPa', '--density', '2g/cm3', '--remanence', '0.08',
        '--damping', '1e-4', '--flux-max', '10mT', '--out', str(known)]) == 0
    for file, name, rows in ((data, 'stretch', (TIMES, seen())),
                             (levels, 'flux_density', (LEVEL_TIMES, LEVELS))):
        np.savetxt(file, np.transpose(rows), delimiter=',', header=f'time,{name}', comments='')
    capsys.readouterr()
    words = ['identify', str(data), '--commands', str(levels), '--params-file', str(known)]
    assert main([*words, '--out', str(out), '--report', str(page)]) == 0
    shown = capsys.readouterr().out
    row = next(x for x in shown.splitlines() if x.startswith('youngs_modulus')).split()
    assert float(row[1]) == pytest.approx(YOUNGS, abs=4.0 * float(row[2]))
    assert 'shear_modulus' not in shown
    assert 'measured and fitted deflection' in page.read_text()
    belief = read_belief(out)
    assert belief.actuator.shear_modulus == pytest.approx(BEAM.shear_modulus, rel=1e-3)
    assert belief.known.names == tuple(TRUE)
    free = 'youngs_modulus,damping_coefficient,remanence'
    assert main([*words, '--free', free, '--json']) == 0
    estimate = json.loads(capsys.readouterr().out)['parameters']['youngs_modulus']
    assert estimate['low'] < estimate['value'] < estimate['high']
    # Millimetres.
    rows = np.transpose((TIMES, 25.0 * seen()))
    np.savetxt(data, rows, delimiter=',', header='time,stretch', comments='')
    assert 'expected the deflection of the tip over the length' in refusal('', *words)


def test_a_recording_of_a_stretch_is_none_of_a_beam():
    recording = Measurement(TIMES, 1.0 + seen(), LEVEL_TIMES, LEVELS)
    with pytest.raises(BadInputError, match='has stretches: expected deflections'):
        identify(recording, actuator=BEAM)


@pytest.mark.slow
@pytest.mark.parametrize(('noise', 'verdict'), [(1e-3, 'model_rejected'), (2e-2, 'identified')])
def test_a_chain_of_links_is_found_within_percents_and_rejected_where_its_modes_show(
        noise, verdict):
    chain = Chain(16, LENGTH, WIDTH, THICKNESS, DENSITY, YOUNGS, REMANENCE, DAMPING)
    times, deflection = chain.follow([(4.0 * PERIOD, x) for x in LEVELS[1:]], 120)
    once = np.append(True, np.diff(times) > 1e-9)
    noisy = deflection + noise * np.random.default_rng(0).standard_normal(len(times))
    found = identify(of_beam(0.1 + times[once], noisy[once]), actuator=START)
    assert found.verdict == verdict
    for name, within in (
            ('shear_modulus', 0.01), ('damping_coefficient', 0.05), ('remanence', 0.015)):
        assert found.parameters[name].value == pytest.approx(TRUE[name], rel=within)


def test_plain_steps_that_are_proposed_stay_within_the_limits_of_the_deflection():
    designer = Designer(
        BEAM, Bounds(-0.01, 0.01, stretch_max=0.5), 9.0 * PERIOD, rate=200.0)
    plain, paper = designer.plain(), designer.paper()
    assert plain.reach[0] < -0.02
    assert 0.3 < plain.reach[1] <= 0.5
    assert paper.reach == pytest.approx((0.0, 0.4), abs=1e-3)
    times = np.linspace(0.0, 9.0 * PERIOD, 300)
    deflection = sampled(times, plain.level_times, plain.levels)
    assert np.max(deflection) == pytest.approx(plain.reach[1], abs=2e-3)


@pytest.mark.slow
def test_a_sequence_to_record_bends_to_both_sides_within_the_limits_and_ends_at_rest():
    found = excite(BEAM, Bounds(-0.01, 0.01, stretch_max=0.5), duration=2.5, rate=100.0)
    times = np.linspace(0.0, 2.5, 2000)
    deflection = sampled(times, found.best.level_times, found.best.levels)
    assert -0.601 < np.min(deflection) < -0.1
    assert 0.1 < np.max(deflection) < 0.501
    assert deflection[times > 2.5 - 0.5 * PERIOD] == pytest.approx(0.0, abs=2e-3)
    assert found.improvement > 1.2


@pytest.mark.parametrize(('secondary', 'free', 'size', 'noise'), [
    (Modes(), DEFAULT_FREE, 1.0, 1e-4),
    (clamped(0.05), (*check_free(DEFAULT_FREE, BEAM.law), 'modes'), 0.4, 1e-3)],
    ids=['first mode', 'modes'])
def test_recording_of_a_beam_that_bends_along_its_elastica_does_not_bias_the_remanence(
        secondary, free, size, noise):
    beam, levels = replace(along_elastica(BEAM), modes=secondary), size * LEVELS
    simulation, times = ActuatorSimulation(beam), np.arange(0.0, TIMES[-1], 0.005)
    for time, level in zip(LEVEL_TIMES.tolist(), levels.tolist(), strict=True):
        simulation.command(round(1e9 * time), level)
    shown = np.empty(len(times))
    for i, time in enumerate(times.tolist()):
        simulation.advance(round(1e9 * time))
        shown[i] = simulation.stretch
    recording = Measurement(
        times, shown + noise * np.random.default_rng(0).standard_normal(len(times)), LEVEL_TIMES,
        levels, coordinate=DEFLECTION)
    # Of modulus and remanence, motion with modes shows the ratio.
    found = identify(
        recording, free, actuator=replace(START, shear_modulus=BEAM.shear_modulus))
    assert found.verdict == 'identified', found.reason
    remanence = found.parameters['remanence']
    # With the shape of the first mode, it would be 1 to 3 % off.
    assert remanence.value == pytest.approx(REMANENCE, rel=2e-3)
    assert found.actuator.law == beam.law
    assert any('along its elastica' in x for x in found.warnings)


def test_a_beam_that_swings_beyond_its_elastica_asks_for_smaller_steps():
    far = of_beam(TIMES, seen(), levels=1.4 * LEVELS)
    shown = respond(far, values_of(along_elastica(BEAM), {'coil_time_constant': 0.02}), ())
    assert np.max(np.abs(shown.stretch)) > 0.8
    noise = 1e-3 * np.random.default_rng(0).standard_normal(len(TIMES))
    found = identify(replace(far, stretch=shown.stretch + noise), actuator=BEAM)
    assert found.verdict == 'model_rejected'
    assert 'record steps half as large' in found.reason
    assert '--free' not in found.reason
