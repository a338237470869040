"""Blind calibration of delays and statics, on benches integrated with SciPy."""

from dataclasses import replace
from functools import cache
import json
import math

from bench_oracle import Plant, slow
import numpy as np
import pytest

from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.identification.delays import delays, field_delays
from hmsa.identification.measurement import Measurement
from hmsa.model.parameters import paper_actuator
from hmsa.runs.parameters import entries_of
from hmsa_lab.bench.assembly import SensorScale
from hmsa_lab.bench.calibration import scale_at_rest, scale_by_gauge, statics

NOISE = 1e-3


@cache
def recorded(seed):
    """Return truth, samples, probe readings and levels of a random bench."""
    random = np.random.default_rng((42, seed))
    truth = {
        'transport': random.uniform(0.0, 3e-3), 'lag': math.exp(random.uniform(
            math.log(2e-4), math.log(2e-3))), 'latency': random.uniform(5e-4, 5e-3)}
    nominal = slow(paper_actuator())
    plant = Plant(
        replace(nominal, shear_modulus=random.uniform(0.8, 1.2) * nominal.shear_modulus),
        lag=truth['lag'], ratio=random.uniform(0.0, 0.06) * (seed % 2), tau=0.3)
    begins = 1.0 + np.cumsum(random.uniform(0.2, 0.35, 10))
    levels = random.choice([0.0, 0.02, 0.04, -0.02, 0.03], 10) + random.uniform(-3e-3, 3e-3, 10)
    for begin, level in zip(begins, levels, strict=True):
        plant.levels.append((round((begin + truth['transport']) * 1e9), level))
    time = np.arange(1.0, begins[-1] + 0.3, 1e-3)
    seen = []
    for x in time:
        stretch, _ = plant.advance(round(x * 1e9) + 1)
        seen.append((stretch, plant.state[3]))
    stretch, field = np.array(seen).T
    # A coil with a gain of its own, and a probe with an offset.
    field = 1.04 * field + 1e-3 + NOISE * np.ptp(field) * random.standard_normal(len(time))
    stretch = stretch + NOISE * random.standard_normal(len(time))
    return truth, nominal, (time + truth['latency'], stretch), (time, field), (begins, levels)


@pytest.mark.parametrize('lag', [1e-9, 2e-5, 1e-4])
def test_a_field_that_rises_between_two_readings_has_honest_intervals(lag):
    right = 0
    for seed in range(20):
        random = np.random.default_rng(seed)
        transport = random.uniform(-5e-4, 3e-3)  # a field may lead the reported times
        begins = 1.0 + np.cumsum(random.uniform(0.12, 0.2, 24))
        levels = np.resize([0.02, -0.01, 0.03, 0.005], 24)
        time = np.arange(1.0, begins[-1] + 0.2, 1e-3)
        place = np.searchsorted(begins + transport, time, 'right')
        target = np.append(0.0, levels)
        since = time - np.append(0.0, begins + transport)[place]
        left = np.where(place > 0, target[place - 1] - target[place], 0.0) * np.exp(-since / lag)
        field = target[place] + left + 2e-5 * random.standard_normal(len(time))
        found = field_delays(time, field, begins, levels)
        right += (found.transport.low <= transport <= found.transport.high
                  and found.lag.low <= lag <= found.lag.high)
        assert transport < 0.0 or found.transport.value == pytest.approx(transport, abs=2e-4)
    assert right >= 17


@pytest.mark.parametrize('seed', [
    pytest.param(x, marks=pytest.mark.slow if x else ()) for x in range(8)])
def test_transport_lag_and_latency_are_told_apart_on_random_benches(seed):
    truth, nominal, samples, readings, (begins, levels) = recorded(seed)
    found = delays(
        Measurement(*samples, np.append(0.5, begins), np.append(0.0, levels)),
        np.append(math.nan, begins), field_delays(*readings, begins, levels), nominal)
    assert found.motion.verdict == 'identified'
    assert found.transport.value == pytest.approx(truth['transport'], abs=5e-5)
    assert found.lag.value == pytest.approx(truth['lag'], rel=0.05)
    assert found.latency.value == pytest.approx(truth['latency'], abs=5e-5)
    assert found.setting.value == pytest.approx(
        truth['latency'] + truth['transport'], abs=5e-5)
    # Some of 95 % intervals miss, by little.
    for name in truth:
        interval = getattr(found, name)
        half = interval.high - interval.value
        assert abs(interval.value - truth[name]) < 2.0 * half + 1e-9


def test_without_a_probe_what_cannot_be_told_apart_is_said():
    truth, nominal, samples, _, (begins, levels) = recorded(0)
    recording = Measurement(*samples, np.append(0.5, begins), np.append(0.0, levels))
    found = delays(recording, np.append(math.nan, begins), None, nominal, lag=truth['lag'])
    assert found.setting.value == pytest.approx(truth['latency'] + truth['transport'], abs=5e-5)
    assert 'includes transport that the device does not report' in found.notes[0]
    found = delays(recording, np.append(math.nan, begins), None, nominal)
    assert math.isnan(found.lag.value)
    assert found.latency.value == pytest.approx(sum(truth.values()), abs=1e-4)
    assert 'includes the lag' in found.notes[0]


@pytest.mark.parametrize(('break_it', 'what'), [
    (lambda t, b, s, x: (t[:10], b[:10], s, x), '10 readings of the probe'),
    (lambda t, b, s, x: (t, b * math.nan, s, x), 'not all finite'),
    (lambda t, b, s, x: (t, b, s[:2], x[:2]), '2 levels'),
    (lambda t, b, s, x: (t, np.random.default_rng(1).normal(size=len(t)), s, x), 'follows the'),
    (lambda t, b, s, x: (t + 1e3, b, s, x), 'close enough after a level'),
    (lambda t, b, s, x: (t, 0.0 * b, s, x), 'close enough')])
def test_a_probe_that_shows_no_steps_is_refused(break_it, what):
    *_, readings, steps = recorded(0)
    with pytest.raises(BadInputError, match=what):
        field_delays(*break_it(*readings, *steps))


# -- statics ------------------------------------------------------------------------------------

LEVELS = np.array([0.0, 0.02, 0.04, 0.02, 0.0, -0.02, -0.04, -0.02, 0.0, 0.01, -0.01])


def test_a_staircase_gives_a_law_and_the_scale_of_the_sensor():
    truth = 1.0 + 3.0 * LEVELS + 20.0 * LEVELS**2
    found = statics(LEVELS, 0.98 * truth)
    assert found.rest == pytest.approx(0.98)
    assert found.stretch == pytest.approx(1.0 + 3.0 * found.level + 20.0 * found.level**2)
    scale = scale_at_rest(SensorScale(-2.0, 60.0, 20.0), 0.98)
    assert (scale.gain, scale.offset, scale.rest_length) == (-2.0, 60.0, pytest.approx(19.6))
    # A sensor whose data sheet is wrong in everything, against a gauge.
    wrong, right = SensorScale(-2.0, 60.0, 20.0, 1e-3), SensorScale(-2.1, 63.0, 20.5)
    reading = (truth * right.rest_length - right.offset) / right.gain
    scale, misses = scale_by_gauge(
        wrong, LEVELS, np.array([wrong.stretch(x) for x in reading]), 20.5 * truth)
    assert (scale.gain, scale.offset, scale.rest_length) == pytest.approx((-2.1, 63.0, 20.5))
    assert (scale.latency, misses) == (1e-3, pytest.approx(0.0, abs=1e-9))


@pytest.mark.parametrize(('level', 'stretch', 'what'), [
    (LEVELS, 1.0 - 3.0 * LEVELS, 'swap the leads'), (LEVELS, math.nan * LEVELS, 'not all finite'),
    (np.abs(LEVELS), 1.0 + LEVELS, 'of both signs'),
    (LEVELS, -1.0 + 3.0 * LEVELS, 'without a field'),
    (LEVELS[:3], 1.0 + LEVELS[:3], 'at least 6')])
def test_a_staircase_that_is_no_law_is_refused(level, stretch, what):
    with pytest.raises(BadInputError, match=what):
        statics(level, stretch)


@pytest.mark.parametrize('length', [np.full(11, 20.0), np.full(11, math.nan), LEVELS**2])
def test_a_gauge_that_does_not_follow_is_refused(length):
    with pytest.raises(BadInputError, match='the gauge (shows|reads)'):
        scale_by_gauge(SensorScale(), LEVELS, 1.0 + LEVELS, length)


# -- the guided runs ----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_guided_run_tells_the_delays_of_a_simulated_bench(tmp_path, capsys):
    out, picture = tmp_path / 'delays.yaml', tmp_path / 'delays.png'
    assert main([
        'calibrate', 'latency', '--simulate', '--limit', '0.03', '--set', 'latency=0.003',
        '--set', 'transport=0.001', '--out', str(out), '--picture', str(picture), '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    for name, truth in (('transport', 1e-3), ('lag', 5e-4), ('latency', 3e-3)):
        assert found[name]['value'] == pytest.approx(truth, abs=5e-5)
    assert found['setting'] == pytest.approx(4e-3, abs=5e-5)
    settings = {x: y for _, x, y in entries_of(out)}
    assert settings == {'coil_time_constant': pytest.approx(5e-4, rel=0.05)}
    assert picture.stat().st_size > 5000


@pytest.mark.slow
def test_a_guided_staircase_writes_a_law_that_the_planner_takes(tmp_path, capsys):
    out, picture = tmp_path / 'static.yaml', tmp_path / 'static.png'
    assert main([
        'calibrate', 'static', 'serial_board', '--set', 'port=sim', '--set',
        'coil.tesla_per_ampere=0.05', '--set', 'sensor.rest_length=21', '--limit', '0.03',
        '--settle', '0.3', '--steps', '4', '--out', str(out), '--picture', str(picture)]) == 0
    assert 'sensor.rest_length  ' in capsys.readouterr().out
    found = {x: y for _, x, y in entries_of(out)}
    assert found['hardware.sensor.rest_length'] == pytest.approx(20.0, rel=1e-3)
    assert main(['plan', '1.05:0.2', '--params-file', str(out), '--json']) == 0
    level = json.loads(capsys.readouterr().out)['segments'][0]['flux_density_1']
    # What holds it on the block that is simulated.
    block = paper_actuator()
    x, limit = 1.05, block.chain_limit
    force = (x - x**-2) / (1.0 - (2.0 / x + x**2 - 3.0) / limit)
    mu_0 = 4e-7 * math.pi
    assert level == pytest.approx(block.shear_modulus * force * mu_0 / block.remanence, rel=0.02)


@pytest.mark.parametrize(('words', 'what'), [
    (('latency',), 'either MODULE:NAME'), (('static', 'x:y', '--simulate'), 'either MODULE:NAME'),
    (('latency', 'nothing:here'), 'cannot be loaded'),
    (('latency', '--simulate', '--limit', 'nan'), '--limit'),
    (('latency', '--simulate', '--steps', '1'), '--steps'),
    (('latency', 'x:y', '--lag', '-1'), '--lag'),
    (('latency', '--simulate', '--lag', '0'), 'expected one of both'),
    (('static', '--simulate', '--settle', '0'), '--settle'),
    (('static', '--simulate', '--steps', '2'), '--steps is 2'),
    (('static', '--simulate', '--gauge', 'nothing:here'), '--gauge')])
def test_what_cannot_be_measured_is_refused(words, what, refusal):
    assert what in refusal('calibrate', *words)
