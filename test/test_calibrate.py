"""Blind calibration of all kinds of coils, which are off at the end."""

import json
import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.laboratory import Iron
from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.runs.parameters import entries_of
from hmsa_lab.bench.assembly import Assembly, CoilModel
from hmsa_lab.bench.calibration import calibrate_coil, loop

# Amperes of a loop, in its order.
LOOP = np.array(loop(8.0, 8))


def readings(slope, saturation=math.inf, hysteresis=0.0, noise=2e-4, seed=0):
    """Return probe readings with offset of a coil whose hysteresis loop is an ellipse."""
    flux = slope * LOOP if saturation == math.inf else saturation * np.tanh(
        slope * LOOP / saturation)
    rising = np.sign(np.diff(LOOP, prepend=-1.0))
    flux = flux - rising * 0.5 * hysteresis * np.ptp(flux) * (1.0 - (LOOP / 8.0) ** 2)
    return flux + 1e-3 + np.random.default_rng(seed).normal(0.0, noise, len(LOOP))


@pytest.mark.parametrize('saturation', [math.inf, 0.5])
@pytest.mark.parametrize('hysteresis', [0.0, 0.02])
def test_the_constant_is_right_to_a_fifth_of_a_percent_in_nearly_all_runs(saturation, hysteresis):
    drawn = np.random.default_rng(4).uniform(0.0475, 0.0525, 40)
    found = [calibrate_coil(LOOP, readings(x, saturation, hysteresis, seed=i))
             for i, x in enumerate(drawn)]
    off = np.abs([x.tesla_per_ampere for x in found] / drawn - 1.0)
    assert np.sum(off < 2e-3) >= 39
    inside = [x.interval[0] < y < x.interval[1] for x, y in zip(found, drawn, strict=True)]
    assert sum(inside) >= 34
    for x in found:
        assert x.model == ('number' if saturation == math.inf else 'saturation')
        assert x.hysteresis == pytest.approx(hysteresis, abs=2e-3)
        assert x.offset == pytest.approx(1e-3, abs=5e-4)
        if saturation < math.inf:
            assert x.saturation == pytest.approx(saturation, rel=0.02)


def test_readings_in_mt_without_a_unit_are_refused(tmp_path, refusal):
    source = tmp_path / 'readings.csv'
    source.write_text('current,flux_density\n0,0\n1,50\n2,99\n3,148\n')
    assert 'readings.csv has flux densities up to 148 T: expected' in refusal(
        'calibrate coil', source)
    with pytest.raises(BadInputError, match='write "flux_density'):
        CoilModel(file=str(source))


def test_currents_in_ma_without_a_unit_are_refused_as_readings_and_by_the_driver(
        tmp_path, refusal):
    source = tmp_path / 'readings.csv'

    def write(unit, factor):
        source.write_text(f'current{unit},flux_density\n' + ''.join(
            f'{factor * x:g},{0.05 * x:g}\n' for x in (-2.0, -1.0, 0.0, 1.0, 2.0)))

    write('', 1e3)
    assert 'has currents up to 2000 without a unit: expected' in refusal('calibrate coil', source)
    with pytest.raises(BadInputError, match=r'write "current \[mA\]" in its header, or "curr'):
        CoilModel(file=str(source))
    for unit, factor, current in ((' [mA]', 1e3, 1.0), ('', 1.0, 1.0), (' [A]', 1e3, 1000.0)):
        write(unit, factor)
        assert main(['calibrate', 'coil', str(source)]) == 0
        assert CoilModel(file=str(source)).current(0.05) == pytest.approx(current)


def test_a_missing_reading_is_refused_with_its_line(tmp_path, refusal):
    source = tmp_path / 'readings.csv'
    source.write_text('current,flux_density\n0,0\n1,\n2,0.1\n3,0.15\n')
    assert 'readings.csv line 3 has no number for current or flux_density' in refusal(
        'calibrate coil', source)


def test_a_coil_like_no_model_gets_a_table_that_the_driver_takes(tmp_path, capsys, refusal):
    source, out = tmp_path / 'readings.csv', tmp_path / 'coil.yaml'
    flux = 0.05 * LOOP + 0.02 * np.maximum(LOOP, 0.0)

    def write(values):
        source.write_text('current [A],flux_density [mT]\n' + ''.join(
            f'{x},{1e3 * y}\n' for x, y in zip(LOOP, values, strict=True)))

    # The table would replace the readings, which a number does not.
    beside = ['calibrate', 'coil', str(source), '--out', str(source.with_suffix('.yaml'))]
    write(0.05 * LOOP)
    assert main(beside) == 0
    write(flux)
    assert f'cannot write {source}: the command reads it' in refusal('', *beside)
    assert main(['calibrate', 'coil', str(source), '--out', str(out)]) == 0
    assert 'table' in capsys.readouterr().out
    settings = {x.removeprefix('hardware.coil.'): y for _, x, y in entries_of(out)}
    coil = CoilModel(**settings)
    for current in (-8.0, 2.0, 8.0):
        expected = 0.05 * current + 0.02 * max(current, 0.0)
        assert coil.flux_density(current) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(('current', 'flux', 'what'), [
    ([0.0, 1.0, 2.0], [0.0, 1.0, 2.0], 'at least 4 currents'),
    ([1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0], 'with 0 A'),
    ([-1.0, 0.0, 1.0, 2.0], [0.0, math.nan, 0.0, 0.0], 'not all finite'),
    ([-2.0, -1.0, 0.0, 1.0, 2.0], [0.3, -0.2, 0.1, 0.2, -0.3], 'do not follow'),
    ([-2.0, -1.0, 0.0, 1.0, 2.0], [0.1] * 5, 'do not follow')])
def test_readings_that_tell_nothing_are_refused(current, flux, what):
    with pytest.raises(BadInputError, match=what):
        calibrate_coil(np.array(current), np.array(flux))


class Supply:
    """A source of current, and the field of its coil for a probe, 4 % stronger than assumed."""

    amperes = 0.0
    written: list[float] = []

    def __init__(self, joint='', **settings):
        pass

    def write(self, level, now):
        Supply.amperes = level
        Supply.written.append(level)

    def read(self, now=0):
        return 0.052 * Supply.amperes if now == 0 else []


def coil(joint):
    """Return the supply with its coil."""
    return Assembly(Supply(), CoilModel(0.05))


@pytest.mark.parametrize('typed', [False, True])
def test_a_guided_run_measures_the_coil_and_leaves_it_off(typed, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, 'bench_under_test', sys.modules[__name__])
    monkeypatch.setattr('sys.stdin', SimpleNamespace(
        readline=lambda: f'{1e3 * 0.052 * Supply.amperes} mT\n'))
    Supply.written.clear()
    probe = [] if typed else ['--probe', 'bench_under_test:Supply']
    assert main([
        'calibrate', 'coil', 'bench_under_test:coil', *probe, '--limit', '0.1', '--steps', '3',
        '--settle', '0.01', '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['tesla_per_ampere'] == pytest.approx(0.052, rel=1e-6)
    assert found['model'] == 'number'
    assert max(map(abs, Supply.written)) == pytest.approx(2.0)
    assert Supply.amperes == 0.0


def test_a_core_whose_hysteresis_is_written_is_demagnetised_at_the_end(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'bench_under_test', sys.modules[__name__])
    Supply.written.clear()
    assert main([
        'calibrate', 'coil', 'bench_under_test:coil', '--probe', 'bench_under_test:Supply',
        '--limit', '0.1', '--steps', '2', '--settle', '0.01', '--hysteresis']) == 0
    core, left = Iron(0.04, 0.6), []
    for current in Supply.written:
        core.turn(current)
        left.append(core.field(0.0) if current == 0.0 else 0.0)
    assert max(map(abs, left)) > 0.02
    assert abs(left[-1]) < 1e-4


def test_an_interrupt_leaves_the_coil_off(monkeypatch):
    monkeypatch.setitem(sys.modules, 'bench_under_test', sys.modules[__name__])
    asked = []

    def interrupted(text):
        asked.append(text)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return '0'

    monkeypatch.setattr('builtins.input', interrupted)
    main(['calibrate', 'coil', 'bench_under_test:coil', '--limit', '0.1', '--settle', '0.01'])
    assert len(asked) == 3
    assert Supply.amperes == 0.0


@pytest.mark.parametrize(('words', 'what'), [
    (('bench_under_test:Supply',), 'no coil of currents'),
    (('bench_under_test:nothing',), 'cannot be loaded'),
    (('bench_under_test:coil', '--probe', 'bench_under_test:nothing'), '--probe'),
    (('bench_under_test:coil', '--limit', '0'), '--limit'), (('missing.csv',), 'missing.csv'),
    (('.',), 'cannot be read (Is a directory)')])
def test_what_cannot_be_calibrated_is_refused(words, what, monkeypatch, refusal):
    monkeypatch.setitem(sys.modules, 'bench_under_test', sys.modules[__name__])
    assert what in refusal('calibrate coil', *words)
    assert Supply.amperes == 0.0
