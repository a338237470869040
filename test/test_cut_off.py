"""Commands that devices obey after a cut-off of the coil, and commands of another clock."""

import pytest

from hmsa_ros.device.driven import HardwareDevice, HardwareJoint
from hmsa_ros.device.protocol import Kind
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.device.watchdog import Fallback
from hmsa_ros.errors import BadInputError
from hmsa_ros.model.actuators import Setup
from hmsa_ros.model.parameters import paper_actuator

MS = 1_000_000
START = 1000 * MS
ZERO = Fallback(0.1, 'zero')


class Coil:
    """An amplifier that applies commands immediately."""

    def write(self, level, now):
        return now

    def read(self, now):
        return 1.0, 0.0


def plant(fallback=ZERO, **settings):
    joint = SimulatedJoint(Setup(paper_actuator()), fallback)
    return SimulatedDevice([joint], period=MS, time=START, **settings)


def driver(fallback=ZERO):
    device = HardwareDevice([HardwareJoint(Coil(), 0.5, fallback)], time=START)
    assert device.switch_off(START) == ''
    return device


BOTH = pytest.mark.parametrize('make', [plant, driver])


def cut_off(make, fallback=ZERO):
    """Return a device whose coil was cut off after a silence."""
    device = make(fallback)
    device.receive(0, START + MS, 0.05)
    for step in range(1, 200):
        device.advance(START + step * 2 * MS)
    assert [x.kind for x in device.notices()] == [Kind.SILENT]
    assert device.changes()[-1].level == 0.0
    assert device.cut_offs == [0]
    return device


def refused(device, stamp, level):
    """Return why a command is refused; empty if it is obeyed."""
    device.receive(0, stamp, level)
    for _ in range(30):
        device.advance(device.time + MS)
    why = ''.join(x.text for x in device.notices() if x.kind is Kind.REFUSED)
    assert [x.level for x in device.changes()] == ([] if why else [level])
    return why


@BOTH
@pytest.mark.parametrize('fallback', [ZERO, Fallback(0.1, 'ramp', 10.0)])
def test_after_a_cut_off_no_level_of_before_comes_back(make, fallback):
    device = cut_off(make, fallback)
    # Sent again by the middleware, then repeated by a planner that has heard nothing.
    assert 'expected a command for a time that has not passed' in refused(
        device, START + 50 * MS, 0.05)
    assert '0.05 T was commanded before' in refused(device, device.time + 20 * MS, 0.05)
    assert '0.05 T was commanded before' in refused(device, 0, 0.05)
    # The rest of a sequence, all of it late, and its last level as a sign of life.
    assert 'expected a command for a time' in refused(device, device.time - 20 * MS, 0.02)
    assert '0.02 T was commanded before' in refused(device, device.time + 20 * MS, 0.02)
    assert (device.cut_offs, device.silent) == ([0], [0])


@BOTH
@pytest.mark.parametrize('ahead', [0, 20 * MS])
def test_another_level_ends_a_cut_off(make, ahead):
    device = cut_off(make)
    assert not refused(device, ahead and device.time + ahead, 0.03)
    assert (device.cut_offs, device.silent) == ([], [])
    assert not refused(device, 0, 0.05)


@BOTH
def test_a_cut_off_that_is_acknowledged_is_over(make):
    device = cut_off(make)
    device.receive(0, device.time + 20 * MS, 0.0)
    assert device.cut_offs == []
    assert not refused(device, device.time + 20 * MS, 0.05)


@BOTH
def test_a_level_that_is_held_through_a_silence_is_no_cut_off(make):
    device = make(Fallback(0.1, 'hold'))
    device.receive(0, START + MS, 0.05)
    for time in (1, 300):
        device.advance(START + time * MS)
    assert (device.silent, device.cut_offs) == ([0], [])
    device.changes()
    assert not refused(device, START + 250 * MS, 0.02)


@BOTH
def test_before_the_first_command_nothing_is_refused(make):
    device = make()
    device.guards[0].cut_off(device.time)
    device.changes()
    assert not refused(device, START - MS, 0.05)


def test_a_command_that_was_long_on_its_way_is_refused_when_it_arrives():
    device = plant(command_delay=200 * MS)
    for time in (0, 150):
        device.advance(START + time * MS)
        device.receive(0, START + time * MS + MS, 0.05)
    device.advance(START + 500 * MS)
    assert [x.level for x in device.changes()] == [0.0, 0.05, 0.0]
    assert [x.kind for x in device.notices()] == [Kind.LATE, Kind.SILENT, Kind.REFUSED]


@BOTH
def test_a_command_of_another_clock_is_refused_by_its_name(make):
    device = make()
    device.changes()
    with pytest.raises(BadInputError, match='expected one clock for both'):
        device.receive(0, 1_700_000_000_000 * MS, 0.05)
    device.advance(START + 5 * MS)
    assert device.changes() == []
