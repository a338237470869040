"""Hardware assembled from a source, a coil and a sensor: values and units of all calls."""

import math

import numpy as np
import pytest

from hmsa.errors import BadInputError
from hmsa_lab.bench import Assembly, CoilModel, parts, SensorScale
from hmsa_lab.bench import assembly as assembly_module
from hmsa_ros.device.watchdog import Fallback, Kind
from hmsa_ros.device.worker import HardwareDevice, HardwareJoint

MS = 1_000_000
START = 1000 * MS


class Supply:
    """A supply of at most 8 A, in steps of 1 mA."""

    limit, resolution, slew = 8.0, 1e-3, 1000.0

    def __init__(self):
        self.currents = []

    def write(self, current, now):
        self.currents.append(current)
        return now, round(current, 3)


class Laser:
    """A sensor of the free end of a block of 20 mm, which approaches it, 2 ms late."""

    length = 20.0

    def read(self, now):
        return [(60.0 - self.length, -1.0)]


def driven(coil, period=0):
    supply, laser = Supply(), Laser()
    device = HardwareDevice(
        [HardwareJoint(Assembly(supply, coil, SensorScale(-1.0, 60.0, 20.0, 2e-3), laser), 0.5,
                       Fallback(0.0))], time=START, period=period)
    assert device.switch_off(START) == ''
    device.changes()
    return supply, laser, device


def test_levels_go_out_as_currents_and_come_back_as_levels_and_readings_as_stretch():
    supply, laser, device = driven(CoilModel(0.05), period=MS)
    assert device.coils[0].limit == pytest.approx(0.4)
    instrument = device.coils[0].instrument
    assert (instrument.resolution, instrument.slew) == pytest.approx((5e-5, 50.0))
    device.receive(0, 0, 0.2)
    laser.length = 22.0
    device.advance(START + MS)
    assert supply.currents == pytest.approx([0.0, 4.0])
    assert device.coils[0].level == pytest.approx(0.2)
    sample = device.samples()[-1]
    assert sample.stretch[0] == pytest.approx(1.1)
    assert sample.rate[0] == pytest.approx(0.05)
    assert sample.time == START - MS
    with pytest.raises(BadInputError, match=r'expected at most 0\.4 T'):
        device.receive(0, 0, 0.41)


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_a_coil_is_a_number_a_saturating_curve_or_a_table_and_each_has_an_inverse(tmp_path, sign):
    saturating = CoilModel(sign * 0.05, saturation=0.3)
    currents = np.linspace(-8.0, 8.0, 65)
    path = tmp_path / 'coil.csv'
    path.write_text('current,flux_density\n' + ''.join(
        f'{x!r},{saturating.flux_density(x)!r}\n' for x in currents.tolist()))
    table = CoilModel(file=str(path))
    for coil in (saturating, table):
        for level in (-0.25, -1e-3, 0.0, 0.1, 0.25):
            assert coil.flux_density(coil.current(level)) == pytest.approx(level, abs=1e-12)
        most, least, largest = coil.within(100.0 if coil is table else 8.0)
        assert most == pytest.approx(0.3 * math.tanh(0.4 / 0.3))
        assert least < 0.02 < largest == pytest.approx(0.05, rel=2e-3)
        assert abs(coil.current(0.2) - saturating.current(0.2)) < 0.01
    # No current is endless, whatever is asked for.
    assert abs(saturating.current(9.0)) < 20.0


def test_a_coil_that_is_too_warm_is_switched_off_and_refused_until_it_has_cooled(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(assembly_module, 'monotonic', lambda: clock[0])
    supply, _, device = driven(CoilModel(0.05, rms=2.0, rms_time=10.0), period=MS)

    def at(seconds, level=None):
        clock[0] = seconds
        now = START + round(seconds * 1e9)
        if any(x.is_cut_off for x in device.guards):
            device.receive(0, device.guards[0].cut_off_time, 0.0)
        if level is not None:
            device.receive(0, now, level)
        device.advance(now)
        return [x.text for x in device.notices() if x.kind == Kind.LOST]

    # 4 A reach 2 A effective after 10 s ln(4/3), 2.88 s.
    assert not at(0.1, 0.2)
    assert not at(2.9)
    (text,) = at(3.1)
    assert 'the coil is too warm: 2.04 A effective over 10 s' in text
    assert (supply.currents[-1], device.coils[0].level) == (0.0, 0.0)
    (text,) = at(4.0, 0.1)
    assert 'wait 1.6 s' in text
    assert not at(6.0, 0.15)
    assert supply.currents[-1] == pytest.approx(3.0)


@pytest.mark.parametrize(('settings', 'expected'), [
    ({}, 'coil.tesla_per_ampere is nan: expected the flux density in T at 1 A'),
    ({'coil.tesla_per_ampere': 0}, 'coil.tesla_per_ampere is 0'),
    ({'coil.tesla_per_ampere': 'much'}, "coil.tesla_per_ampere is 'much'"),
    ({'coil.tesla_per_ampere': 1.0, 'coil.rms': -1}, 'coil.rms is -1: expected a number above 0'),
    ({'coil.tesla_per_ampere': 1.0, 'sensor.latency': math.nan}, 'sensor.latency is nan'),
    ({'coil.tesla_per_ampere': 1.0, 'sensor.gain': 0.0}, 'sensor.gain is 0'),
    ({'coil.tesla': 1.0}, 'coil.tesla is no setting: expected coil.file, coil.limit'),
    ({'port': 1}, 'port is no setting'), ({'coil.file': '/none.csv'}, '/none.csv cannot be read'),
    ({'coil.file': 'current,flux_density\n-1,-1\n0,0\n1,1\n2,1'}, 'rise from row to row'),
    ({'coil.file': 'current,flux_density\n-1,-1\n0,0.1\n1,1'}, 'with 0 T at 0 A')])
def test_what_is_no_coil_and_no_sensor_is_refused(tmp_path, settings, expected):
    if '\n' in settings.get('coil.file', ''):
        (tmp_path / 'coil.csv').write_text(settings['coil.file'])
        settings = {'coil.file': str(tmp_path / 'coil.csv')}
    with pytest.raises(BadInputError, match=expected.replace('(', r'\(')):
        parts(settings)
