"""Commands that devices refuse: after a cut-off of the coil, too late, of another clock."""

from devices import advance, command, MS, START
import pytest

from hmsa.errors import BadInputError
from hmsa.model.actuators import Setup
from hmsa.model.parameters import paper_actuator
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.device.watchdog import Fallback, Kind
from hmsa_ros.device.worker import HardwareDevice, HardwareJoint

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


def cut_offs(device):
    """Return the joints that refuse levels until a cut-off is acknowledged."""
    return [x.number for x in device.guards if x.is_cut_off]


def cut_off(make, fallback=ZERO):
    """Return a device whose coil was cut off after a silence."""
    device = make(fallback)
    device.receive(0, START + MS, 0.05)
    for step in range(1, 200):
        device.advance(START + step * 2 * MS)
    assert [x.kind for x in device.notices()] == [Kind.SILENT]
    assert device.changes()[-1].level == 0.0
    assert cut_offs(device) == [0]
    return device


def refused(device, stamp, level):
    """Return why a command is refused; empty if it is obeyed."""
    device.receive(0, stamp, level)
    for _ in range(30):
        device.advance(device.time + MS)
    why = ''.join(x.text for x in device.notices() if x.kind is Kind.REFUSED)
    changed = [x.level for x in device.changes()]
    assert changed == ([level] if level and not why else [])
    return why


@BOTH
@pytest.mark.parametrize('fallback', [ZERO, Fallback(0.1, 'ramp', 10.0)])
def test_after_a_cut_off_no_level_is_obeyed_until_that_is_acknowledged(make, fallback):
    device = cut_off(make, fallback)
    named = device.guards[0].cut_off_time
    assert START + 100 * MS < named <= START + 105 * MS
    # Sent again by the middleware, the rest of a sequence, and levels of a planner that woke up.
    for stamp in (START + 50 * MS, device.time - MS, 0, device.time + 20 * MS):
        for level in (0.05, 0.02, -0.03):
            assert 'expected 0 T first' in refused(device, stamp, level)
    # Nor does 0 T that was planned before; a sign of life of a planner at rest, for one.
    for stamp in (device.time + 20 * MS, START + 50 * MS, named - 1, named + 1):
        assert f'time_ref of receipts, {named / 1e9:.9f} s' in refused(device, stamp, 0.0)
    assert (cut_offs(device), device.silent) == ([0], [0])


@BOTH
@pytest.mark.parametrize('by_hand', [True, False])
def test_a_cut_off_that_is_acknowledged_is_over(make, by_hand):
    device = cut_off(make)
    named = device.guards[0].cut_off_time
    device.receive(0, 0 if by_hand else named, 0.0)
    device.advance(device.time + MS)
    assert (cut_offs(device), device.silent, device.guards[0].cut_off_time) == ([], [], 0)
    # It may be acknowledged once more before the receipt has come.
    device.receive(0, named, 0.0)
    assert not refused(device, device.time + 20 * MS, 0.05)
    assert [x.kind for x in device.notices()] == []


@BOTH
def test_a_coil_that_still_ramps_down_is_not_acknowledged(make):
    device = make(Fallback(0.1, 'ramp', 0.1))
    device.receive(0, START + MS, 0.05)
    advance(device, *range(1, 200))
    named = device.guards[0].cut_off_time
    for stamp in (0, named):
        device.receive(0, stamp, 0.0)
        device.advance(device.time + MS)
    assert cut_offs(device) == [0]
    for _ in range(1000):
        device.advance(device.time + MS)
    levels = [x.level for x in device.changes()]
    # It has stayed the slow ramp that it was.
    assert max(abs(x - y) for x, y in zip(levels[2:], levels[1:], strict=False)) < 2e-4
    device.receive(0, named, 0.0)
    assert cut_offs(device) == []


@BOTH
def test_each_cut_off_is_acknowledged_by_its_own_time(make):
    device = cut_off(make)
    first = device.guards[0].cut_off_time
    device.receive(0, first, 0.0)
    for _ in range(200):
        device.advance(device.time + MS)
    second = device.guards[0].cut_off_time
    assert second > first
    device.notices()
    assert 'cut off' in refused(device, first, 0.0)
    device.receive(0, second, 0.0)
    assert cut_offs(device) == []


@BOTH
def test_a_clock_that_is_set_does_not_rename_a_cut_off(make):
    device = cut_off(make)
    named = device.guards[0].cut_off_time
    device.clock_set(-5000 * MS)
    device.notices()
    assert 'was cut off 0.2' in refused(device, 0, 0.05)
    device.receive(0, named, 0.0)
    assert cut_offs(device) == []


# -- what feeds the watchdog, and what comes too late ---------------------------------------------


@BOTH
def test_commands_far_ahead_do_not_keep_a_coil_on(make):
    device = make()
    device.receive(0, START + MS, 0.05)
    # By the clock of a planner that is an hour ahead: levels, and heartbeats.
    for step in range(1, 100):
        device.advance(START + step * 2 * MS)
        device.receive(0, device.time + 3_600_000 * MS, 0.05 if step % 2 else 0.04)
    stamp, level = device.changes()[-1][1:]
    assert (level, START + 100 * MS < stamp <= START + 105 * MS) == (0.0, True)
    found = next(x.text for x in device.notices() if x.kind is Kind.SILENT)
    assert 'that applies (the newest one applies in ' in found
    assert 'compare the clocks' in found
    # Its clock is right again: what was commanded for then is gone.
    device.clock_set(3_600_000 * MS)
    device.advance(device.time + 100 * MS)
    assert device.changes() == []


@BOTH
def test_levels_that_are_sent_far_ahead_feed_the_watchdog_when_they_apply(make):
    device = make(Fallback(0.2, 'zero'))
    for k in range(10):
        device.receive(0, START + (1000 + 150 * k) * MS, 0.01 * (k + 1))
    for step in range(1, 1300):
        device.advance(START + step * 2 * MS)
    levels = [(x.stamp - START, x.level) for x in device.changes() if x.stamp > START]
    assert [y for _, y in levels] == [*(pytest.approx(0.01 * (k + 1)) for k in range(10)), 0.0]
    # The last one feeds it when it is the timeout ahead.
    assert 2350 * MS <= levels[-1][0] <= 2354 * MS
    assert device.trips == 1


@BOTH
def test_a_level_that_comes_too_late_is_refused_and_does_not_feed_the_watchdog(make):
    device = make(Fallback(0.1, 'zero', lateness_limit=0.02))
    command(device, (1, 0.05), until=2)
    device.changes()
    device.receive(0, START + 2 * MS - 20 * MS, 0.04)
    device.advance(START + 3 * MS)
    assert [x.level for x in device.changes()] == [0.04]
    assert device.guards[0].too_late is None
    device.notices()
    for step in range(100):
        device.receive(0, device.time - 21 * MS, 0.03)
        assert cut_offs(device) or device.guards[0].too_late == device.time - 21 * MS
        device.advance(START + (5 + 2 * step) * MS)
    assert [x.level for x in device.changes()] == [0.0]
    notices = device.notices()
    assert [x.kind for x in notices].count(Kind.REFUSED) == 100
    found, = (x.text for x in notices if x.kind is Kind.SILENT)
    assert 'that applies (the newest one came 0.021 s late)' in found


@BOTH
def test_a_level_that_is_held_through_a_silence_is_no_cut_off(make):
    device = make(Fallback(0.1, 'hold'))
    device.receive(0, START + MS, 0.05)
    advance(device, 1, 300)
    assert (device.silent, cut_offs(device)) == ([0], [])
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


# -- a device that stands still -------------------------------------------------------------------


def test_a_driver_that_stood_still_for_longer_than_its_watchdog_is_cut_off():
    device = driver(Fallback(0.1, 'zero'))
    command(device, (1, 0.05), until=2)
    device.advance_to(START + 92 * MS)
    device.stood_still(90 * MS)
    command(device, (95, 0.05), until=100)
    assert cut_offs(device) == []
    device.advance_to(START + 250 * MS)
    device.stood_still(150 * MS)
    # This has waited to be read.
    command(device, (240, 0.04), (290, 0.03), until=300)
    assert [x.level for x in device.changes()][-2:] == [0.05, 0.0]
    assert cut_offs(device) == [0]
    found = [x.text for x in device.notices() if x.kind is Kind.SILENT]
    assert len(found) == 1
    assert 'stood still for 0.150 s, more than 0.1 s: the field goes to zero' in found[0]


@pytest.mark.parametrize('safe', ['zero', 'ramp'])
def test_levels_that_a_stall_has_made_late_do_not_keep_a_coil_on(safe):
    device = driver(Fallback(0.1, safe, lateness_limit=0.02))
    command(device, (1, 0.05), (50, 0.03), (80, 0.04), until=2)
    device.advance_to(START + 500 * MS)
    device.stood_still(498 * MS)
    advance(device, *range(501, 700))
    assert (device.changes()[-1].level, cut_offs(device)) == (0.0, [0])


def test_a_driver_drops_levels_that_it_could_not_write_in_time():
    device = driver(Fallback(10.0, 'zero', lateness_limit=0.02))
    command(device, (10, 0.05), (50, 0.03), (400, 0.02))
    advance(device, 30, 300, 500)
    assert [x.level for x in device.changes()][-1] == 0.05
    assert '2 levels are dropped, the first of which is 0.250 s late' in device.notices()[-1].text
    # It was accepted, and would be acknowledged.
    assert device.guards[0].too_late == START + 400 * MS
    device.receive(0, 0, 0.01)
    device.advance(START + 900 * MS)
    assert [x.level for x in device.changes()] == [0.01]


def test_a_simulation_that_stood_still_catches_up_with_what_has_waited():
    device = plant(Fallback(0.1, 'zero'), command_delay=0)
    device.receive(0, START + MS, 0.05)
    device.follow(START + 2 * MS)
    device.advance(START + 2 * MS)
    # Half a second later there are levels and heartbeats of the first 200 ms.
    device.stood_still(498 * MS)
    for time in range(10, 200, 10):
        device.receive(0, START + time * MS, 0.05 if time < 150 else 0.04)
    device.follow(START + 500 * MS)
    device.advance(START + 500 * MS)
    assert [((x.stamp - START) / MS, x.level) for x in device.changes()][1:] == [
        (1.0, 0.05), (150.0, 0.04), (291.0, 0.0)]
    assert [x.kind for x in device.notices()] == [Kind.SILENT]


@BOTH
def test_a_clock_that_is_set_stops_nothing(make):
    for by in (-3_600_000, -5000, -500, 1000, 3_600_000):
        device = make(Fallback(0.1, 'zero'))
        command(device, (1, 0.05), (60, 0.03), until=50)
        device.samples()
        device.clock_set(by * MS)
        if make is plant:
            assert device.follow(START + (50 + by) * MS) == 0
        start = START + by * MS
        for time in range(51, 160):
            device.advance(start + time * MS)
        changes = device.changes()[-2:]
        assert [x.level for x in changes] == [0.03, 0.0]
        # A driver feeds its watchdog when it advances.
        assert [(x.stamp - start) // MS for x in changes] == [60, 101 if make is plant else 151]
        assert [x.kind for x in device.notices()] == [Kind.CLOCK, Kind.SILENT]
        if make is plant:
            samples = device.samples()
            assert [(x.time - start) / MS for x in samples] == [*range(51, 160)]
            assert max(abs(x.stretch[0] - y.stretch[0]) for x, y in zip(
                samples[1:], samples, strict=False)) < 0.05
