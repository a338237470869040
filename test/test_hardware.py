"""Drivers of hardware without ROS: times of writes, failures, and messages."""

import math
from threading import Event
from time import monotonic_ns

from conftest import wait_until
from devices import advance, command, MS, START
import numpy as np
import pytest

from hmsa.errors import BadInputError, HmsaError
from hmsa_ros.device import StateLostError
from hmsa_ros.device.hardware import Calls, ClockMap, load
from hmsa_ros.device.watchdog import Fallback, judge_hardware, Kind
from hmsa_ros.device.worker import HardwareDevice, HardwareJoint, HardwareWorker

TODAY = 1_800_000_000_000 * MS


class Bench:
    """An amplifier that takes 2 us, and a sensor; records its calls."""

    def __init__(self):
        self.writes = []

    @property
    def levels(self):
        return [level for _, level in self.writes]

    def write(self, level, now):
        self.writes.append((now, level))
        return now + 2000

    def read(self, now):
        return 1.25, float(len(self.writes))


def driver(period=0, bench=None, **settings):
    bench = bench or Bench()
    device = HardwareDevice([HardwareJoint(bench, 0.5, **settings)], time=START, period=period)
    assert device.switch_off(START) == ''
    assert bench.writes == [(START, 0.0)]
    assert [(x.stamp, x.level) for x in device.changes()] == [(START + 2000, 0.0)]
    return bench, device


def serve(*benches, period=0, reconnect=False, **calls):
    """Return a started worker."""
    worker = HardwareWorker(lambda: HardwareDevice(
        [HardwareJoint(x, 0.5, name=f'joint_{i}') for i, x in enumerate(benches)],
        time=monotonic_ns(), period=period, calls=Calls(**{'limit': 60.0, **calls})),
        monotonic_ns, reconnect=reconnect)
    assert worker.started(60.0)
    return worker


def put(worker, joint, bench, level):
    """Command a level, and wait until it is written."""
    worker.receive(joint, 0, level)
    wait_until(lambda: level in bench.levels, 'the level')


def ended(worker):
    """Wait until a worker has ended as it is looked after; return why."""
    return wait_until(lambda: worker.look_after() or worker.failure, 'the end')


def test_a_driver_writes_each_level_when_it_is_due():
    bench, device = driver()
    assert device.due is None
    for stamp, level in ((10, 0.1), (20, 0.2), (30, 0.3), (20, 0.25)):
        device.receive(0, START + stamp * MS, level)
    assert device.due == START + 10 * MS
    advance(device, 9, 10, 21, 50)
    assert bench.writes[1:] == [(START + 10 * MS, 0.1), (START + 21 * MS, 0.25)]
    # What is reported is when the amplifier had done it.
    assert [(x.stamp, x.level) for x in device.changes()] == [
        (START + 10 * MS + 2000, 0.1), (START + 21 * MS + 2000, 0.25)]
    device.receive(0, 0, 0.4)
    device.advance(START + 51 * MS)
    assert bench.writes[-1] == (START + 51 * MS, 0.4)


def test_a_driver_that_comes_too_late_for_several_levels_writes_the_last():
    bench, device = driver()
    for k in (1, 2, 3):
        device.receive(0, START + k * MS, 0.1 * k)
    device.advance(START + 10 * MS)
    assert bench.writes[1:] == [(START + 10 * MS, pytest.approx(0.3))]


@pytest.mark.parametrize('level', [0.6, -0.6, math.nan, math.inf])
def test_a_driver_refuses_what_is_beyond_its_limit(level):
    bench, device = driver()
    with pytest.raises(BadInputError, match='expected at most 0.5 T'):
        device.receive(0, START, level)
    device.advance(START + MS)
    assert len(bench.writes) == 1


def test_a_driver_switches_the_coil_off_after_a_silence():
    bench, device = driver()
    command(device, (1, 0.1), (3000, 0.3), until=1)
    assert device.due == START + 1001 * MS + 1
    device.advance(device.due)
    assert bench.writes[1:] == [(START + MS, 0.1), (START + 1001 * MS + 1, 0.0)]
    assert [x.kind for x in device.notices()] == [Kind.SILENT]
    # Nothing is left to be done until somebody speaks again.
    assert device.due is None
    device.receive(0, 0, 0.0)
    device.receive(0, 0, 0.2)
    device.advance(START + 5000 * MS)
    assert bench.writes[-1] == (START + 5000 * MS, 0.2)
    assert [x.kind for x in device.notices()] == [Kind.HEARD]
    device.switch_off(START + 5001 * MS)
    assert bench.writes[-1] == (START + 5001 * MS, 0.0)


@pytest.mark.parametrize('late', [0, 300_000])
def test_a_driver_ramps_down_where_that_is_wanted(late):
    bench, device = driver(fallback=Fallback(0.01, 'ramp', 10.0))
    device.receive(0, 0, 0.05)
    now = START
    device.advance(now)
    while device.due is not None:
        # Its thread wakes up late.
        now = device.due + late
        device.advance(now)
    assert [x for _, x in bench.writes[1:]] == pytest.approx(
        [0.05, 0.04, 0.03, 0.02, 0.01, 0.0], abs=1e-12)


def test_a_driver_reads_its_sensor_on_a_grid():
    bench, device = driver(period=2 * MS)
    for time in (START, START + MS, START + 2 * MS, START + 7 * MS, START + 8 * MS):
        device.advance(time)
    samples = device.samples()
    assert [x.time - START for x in samples] == [0, 2 * MS, 7 * MS, 8 * MS]
    assert (samples[0].stretch[0], samples[0].rate[0]) == (1.25, 1.0)
    # Also when the clock is set back.
    device.advance(START - 1000 * MS)
    assert device.samples()[0].time == device.time
    assert device.due == device.time + 2 * MS


def test_a_level_that_a_driver_gets_after_its_stamp_is_told():
    bench, device = driver()
    device.advance(START + 5 * MS)
    device.receive(0, START + 2 * MS, 0.1)
    assert [(x.kind, x.late) for x in device.notices()] == [(Kind.LATE, 3 * MS)]


def test_a_sign_of_life_is_passed_on_unless_the_next_level_is_near():
    bench, device = driver()
    device.receive(0, 0, 0.1)
    device.advance(START + MS)
    device.receive(0, START + 60 * MS, 0.1)
    assert device.due == START + 1001 * MS + 1
    device.advance(START + 2 * MS)
    assert bench.writes[1:] == [(START + MS, 0.1), (START + 2 * MS, 0.1)]
    # What repeats is no change.
    assert [x.level for x in device.changes()] == [0.1]
    device.calls.longest['slow'] = 0.02
    command(device, (30, 0.2), (60, 0.2), until=3)
    assert bench.levels == [0.0, 0.1, 0.1]
    device.advance(START + 30 * MS)
    assert bench.levels == [0.0, 0.1, 0.1, 0.2]


# -- what hardware says -------------------------------------------------------------------------


class Amplifier(Bench):
    """Outputs at most 0.2 T, in steps, with configurable answers."""

    resolution = 1e-3
    limit = 0.4

    def __init__(self):
        super().__init__()
        self.answer = self.readings = None

    def write(self, level, now):
        super().write(level, now)
        if callable(self.answer):
            return self.answer()
        return now + 2000, min(round(level, 3), 0.2)

    def read(self, now):
        return self.readings


def test_what_is_reported_is_what_was_really_set_and_saturation_is_named_once():
    amplifier, device = driver(bench=Amplifier())
    for k, level in enumerate((0.1004, 0.3, 0.35, 0.15)):
        device.receive(0, 0, level)
        device.advance(START + k * MS)
    assert [x.level for x in device.changes()] == [0.1, 0.2, 0.2, 0.15]
    (notice,) = device.notices()
    assert notice.kind == Kind.SATURATED
    assert 'Amplifier was asked for 0.3 T and set 0.2 T' in notice.text
    assert device.counts == {'saturated': 2, 'state_lost': 0}
    with pytest.raises(BadInputError, match='expected at most 0.4 T'):
        device.receive(0, 0, 0.45)


@pytest.mark.parametrize(('answer', 'stamp'), [
    (None, 0), (START + 5, 5), ((None, 0.1), 0), ((float(START), 0.1), 0)])
def test_write_may_say_when_or_nothing(answer, stamp):
    amplifier, device = driver(bench=Amplifier())
    amplifier.answer = lambda: answer
    device.receive(0, 0, 0.1)
    device.advance(START)
    assert [(x.stamp, x.level) for x in device.changes()] == [(START + stamp, 0.1)]


@pytest.mark.parametrize('answer', [
    'done', math.nan, (START, math.nan), (START, 0.1, 3), [], 1e9 + 5.0, True, object(), 10**400])
def test_what_write_must_not_return_is_said_and_the_level_is_not_known(answer):
    amplifier, device = driver(bench=Amplifier())
    amplifier.answer = lambda: answer
    device.receive(0, 0, 0.1)
    with pytest.raises(HmsaError, match='Amplifier.write of joint actuator returned .*: expected'):
        device.advance(START + 5 * 1000 * MS * 3)
    assert [str(x.level) for x in device.changes()] == ['nan']


NAN = math.nan


@pytest.mark.parametrize(('readings', 'expected'), [
    (1.1, [(9, 1.1, NAN)]), ((1.1,), [(9, 1.1, NAN)]), ((1.1, 2), [(9, 1.1, 2.0)]),
    ([1.1, None], [(9, 1.1, NAN)]), ((NAN, 2.0), [(9, NAN, 2.0)]),
    ((1.1, 2.0, START + 7 * MS), [(7, 1.1, 2.0)]), ([], []),
    ([(1.2, NAN, START + 8 * MS), (1.1, 2.0, START + 6 * MS)], [(6, 1.1, 2.0), (8, 1.2, NAN)])])
def test_read_returns_what_is_new(readings, expected):
    amplifier, device = driver(period=MS, bench=Amplifier())
    amplifier.readings = readings
    command(device, (7, 0.1), until=9)
    samples = device.samples()
    assert [((x.time - START) / MS, x.stretch[0], x.rate[0]) for x in samples] == [
        tuple(pytest.approx(x, nan_ok=True) for x in each) for each in expected]
    # The level that was in force when it was taken: it was written at 9 ms.
    assert all(x.flux_density[0] == 0.0 for x in samples)


@pytest.mark.parametrize('readings', [
    None, 'ok', b'ok', (1.0, 'x'), (1.0, 0.0, NAN), (1.0, 0.0, 3, 4), [(1.0, 'x', 5)],
    (None, 1.0), object(), 10**400,
    # Times of another clock than `now`: in s, in microseconds, since a start, and of none.
    *((1.0, 0.0, x) for x in (TODAY / 1e9, TODAY // 1000, START, 0, -1, 10**30, 10**400)),
    # Endless.
    iter(lambda: (1.0, 0.0), None)])
def test_what_read_must_not_return_is_said(readings):
    amplifier, device = driver(period=MS, bench=Amplifier())
    amplifier.readings = readings
    with pytest.raises(
            HmsaError, match='Amplifier.read of joint actuator returned .*: expected stretch.* '
            r'and \[\] if there is none'):
        device.advance(TODAY)


def yielding(blocked, go, error=None):
    yield 1.0, 0.0
    if error is not None:
        raise error
    blocked.set()
    go.wait()


def test_what_read_yields_is_part_of_the_call():
    bench = Bench()
    worker = serve(bench, period=MS)
    bench.read = lambda now: yielding(None, None, OSError('no answer'))
    wait_until(lambda: worker.failure is not None, 'the failure')
    assert 'Bench.read of joint joint_0 raised OSError' in str(worker.failure)
    blocked, go = Event(), Event()
    bench = Bench()
    worker = serve(bench, period=MS, limit=0.01)
    bench.read = lambda now: yielding(blocked, go)
    assert blocked.wait(60.0)
    worker.receive(0, 0, 0.1)
    assert 'Bench.read of joint joint_0 has not returned for 0.01 s' in str(ended(worker))
    assert bench.levels[-1] == 0.0
    go.set()
    worker.close()


def test_hardware_that_has_lost_its_state_begins_without_a_field():
    bench, device = driver()
    device.receive(0, 0, 0.1)
    command(device, (5, 0.2), until=1)
    taken = bench.write

    def write(level, now):
        bench.write = taken
        raise StateLostError('brown-out')

    bench.write = write
    device.advance(START + 5 * MS)
    assert bench.levels == [0.0, 0.1, 0.0]
    assert [x.level for x in device.changes()] == [0.1, 0.0]
    (notice,) = device.notices()
    assert 'Bench has lost its state (brown-out) and its coil is off' in notice.text
    # What was ahead is forgotten, and what was in force is not put on again.
    named = device.guards[0].cut_off_time
    for stamp, level, expected in (
            (START + 9 * MS, 0.1, 0.0), (0, 0.3, 0.0), (named, 0.0, 0.0), (0, 0.15, 0.15)):
        device.receive(0, stamp, level)
        device.advance(START + 9 * MS)
        assert bench.levels[-1] == expected
    assert device.counts['state_lost'] == 1


class Board:
    """A board that stores levels, with its own clock, which started later and runs fast."""

    capacity = None
    rate = 1.0 + 80e-6
    # What it keeps is applied so much after its time, in ns of its clock.
    late = 3000

    def __init__(self):
        self.host = START
        self.begun = START - 5000 * MS
        self.kept, self.told, self.calls, self.exposed = [], [], [], []
        self.level, self.asked = 0.0, 0

    def time_ns(self):
        """Return the host time, which advances by 20 us with each call."""
        self.host += 20_000
        return self.host

    def clock(self):
        self.asked += 1
        return round((self.host + 10_000 - self.begun) * self.rate)

    def host_time(self, own):
        return self.begun + own / self.rate

    def run_until(self, host):
        self.host = max(self.host, host)
        while self.kept and self.host_time(self.kept[0][0]) <= self.host:
            stamp, self.level = self.kept.pop(0)
            self.told.append((stamp + self.late, self.level))

    def write(self, level, now):
        self.calls.append(('write', level))
        self.kept, self.level = [], level
        return now, level

    def schedule(self, levels):
        self.calls.append(('schedule', [x for _, x in levels]))
        if levels:
            self.kept = [x for x in self.kept if x[0] < levels[0][0]] + list(levels)

    def applied(self):
        told, self.told = self.told, []
        return told

    def read(self, now):
        self.exposed.append(self.host - 2 * MS)
        return [(1.1, 0.0, round((self.exposed[-1] - self.begun) * self.rate))]


def board_driver(period=0, **changes):
    board = type('Board', (Board,), changes)()
    device = HardwareDevice(
        [HardwareJoint(board, 0.5, Fallback(0.0))], time=START, period=period,
        clock=board.time_ns)
    assert device.switch_off(START + MS) == ''
    device.changes()
    return board, device


def step(board, device, time):
    board.run_until(time)
    device.advance(time)


def steps(board, device, begin, end, by=1):
    """Step each so many ms from a time in ms to another."""
    for k in range(begin, end, by):
        step(board, device, START + k * MS)


def test_a_device_that_keeps_time_gets_levels_ahead_and_says_when_they_took_effect():
    board, device = board_driver()
    for stamp, level in ((50, 0.1), (60, 0.2), (70, 0.3), (60, 0.25)):
        device.receive(0, START + stamp * MS, level)
        step(board, device, START + 2 * MS)
    # The last one replaced what was kept from its stamp on.
    assert board.calls[1:] == [('schedule', [x]) for x in (0.1, 0.2, 0.3, 0.25)]
    # Nothing is watched for, since the board keeps the time.
    assert device.next_level is None
    steps(board, device, 3, 100)
    changes = device.changes()
    assert [x.level for x in changes] == [0.1, 0.25]
    for x, due in zip(changes, (50, 60), strict=True):
        # As the board says it, in the time of the host.
        assert abs(x.stamp - (START + due * MS + board.late)) < 15_000
    # Signs of life are passed on without disturbing what is kept.
    device.receive(0, START + 300 * MS, 0.1)
    step(board, device, START + 101 * MS)
    assert board.calls[-1] == ('schedule', [0.1])
    device.receive(0, START + 300 * MS, 0.1)
    step(board, device, START + 102 * MS)
    assert board.calls[-1] == ('schedule', [])
    # A command for now goes past what is kept.
    device.receive(0, 0, -0.1)
    step(board, device, START + 103 * MS)
    assert (board.calls[-1], board.kept) == (('write', -0.1), [])


@pytest.mark.parametrize('late', [0, 7])
def test_the_level_in_force_takes_back_what_a_device_keeps_also_if_it_comes_late(late):
    board, device = board_driver()
    for stamp, level in ((10, 0.1), (500, 0.2), (510, 0.3)):
        device.receive(0, START + stamp * MS, level)
        step(board, device, START + 2 * MS)
    step(board, device, START + 20 * MS)
    device.receive(0, START + (20 - late) * MS, 0.1)
    steps(board, device, 20, 600)
    assert board.kept == []
    assert [x.level for x in device.changes()] == pytest.approx([0.1])


def test_a_device_that_is_slow_to_answer_is_not_given_levels_again_that_are_past():
    def applied(self):
        self.run_until(self.host + 45 * MS)
        return Board.applied(self)

    board, device = board_driver(applied=applied)
    for k in range(1, 20):
        device.receive(0, START + 20 * k * MS, 0.01 * k)
    # Two levels take effect while the first is asked for, and one before it can be said.
    for k in (2, 21, 22, 83, 84, 100, 180, 300, 500):
        step(board, device, max(START + k * MS, board.host))
    assert [x for x, _ in board.calls].count('write') == 1  # the first 0 T
    assert [x.level for x in device.changes()] == pytest.approx([0.01 * k for k in range(1, 20)])


def test_a_level_is_replaced_at_its_own_time_though_the_clock_is_known_better_by_then():
    board, device = board_driver()
    device.receive(0, START + 3000 * MS, 0.1)
    steps(board, device, 2, 2000, 5)
    (first,) = board.kept
    device.receive(0, START + 3000 * MS, 0.2)
    step(board, device, START + 2001 * MS)
    assert board.kept == [(first[0], 0.2)]


def test_a_device_with_little_room_gets_levels_as_it_has_room():
    board, device = board_driver(capacity=2)
    for k in range(1, 7):
        device.receive(0, START + (10 + 10 * k) * MS, 0.05 * k)
    for k in range(2, 100):
        step(board, device, START + k * MS)
        assert len(board.kept) <= 2
    assert [x.level for x in device.changes()] == pytest.approx([
        0.05 * k for k in range(1, 7)])
    # What it keeps is taken back, also where nothing comes in its place.
    device.receive(0, START + 150 * MS, 0.0)
    step(board, device, START + 110 * MS)
    device.receive(0, START + 120 * MS, 0.3)
    step(board, device, START + 111 * MS)
    assert [x for _, x in board.kept] == pytest.approx([0.3])


def test_samples_of_a_device_with_a_clock_are_stamped_in_the_time_of_the_host():
    board, device = board_driver(period=10 * MS)
    steps(board, device, 2, 2000, 5)
    samples = device.samples()
    assert len(samples) > 190
    errors = np.array([x.time for x in samples]) - np.array(board.exposed)
    assert np.abs(errors).max() < 30_000
    assert np.abs(errors[100:]).max() < 10_000
    assert device.coils[0].instrument.clock_map.drift == pytest.approx(80e-6, abs=15e-6)
    assert device.coils[0].instrument.clock_map.error < 50e-6


def test_a_clock_that_answers_at_once_is_known_by_later_answers_that_take_longer():
    known, dice, now = ClockMap(), np.random.default_rng(1), TODAY

    def clock(host):
        return round((host - START) * (1.0 + 50e-6))
    # First several within microseconds, then each for itself.
    for duration in [200] * 8 + [20_000] * 50:
        now += 250 * MS if duration > 200 else 500
        assert known.add(now, clock(now + int(dice.integers(duration))), now + duration)
        off = abs(known.to_device(now) - clock(now)) * 1e-9
        assert off < min(2e-5, known.error)
    assert known.drift == pytest.approx(50e-6, abs=2e-6)


def test_a_board_whose_clock_begins_anew_has_lost_its_state():
    board, device = board_driver()
    device.receive(0, START + 50 * MS, 0.2)
    steps(board, device, 2, 100)
    board.begun, board.kept, board.level = START + 99 * MS, [], 0.0
    steps(board, device, 100, 1200)
    (notice,) = device.notices()
    assert (notice.kind, device.coils[0].level) == (Kind.LOST, 0.0)
    assert 'its clock is another one' in notice.text
    # It goes on by the new clock.
    device.receive(0, device.guards[0].cut_off_time, 0.0)
    device.receive(0, START + 1300 * MS, 0.1)
    steps(board, device, 1201, 1400)
    stamp = device.changes()[-1].stamp
    assert abs(stamp - START - 1300 * MS) < 50_000


@pytest.mark.parametrize(('changes', 'expected'), [
    ({'applied': lambda self: []}, 'does not report that 0.2 T took effect'),
    ({'applied': lambda self: [1]}, 'expected a list of'),
    ({'applied': lambda self: [(10**30, 0.2)]}, 'expected a list of'),
    ({'schedule': lambda self, levels: 1 / 0}, 'schedule of joint actuator raised ZeroDivision')])
def test_a_device_that_does_not_keep_levels_as_it_should_is_said_to(changes, expected):
    board, device = board_driver(**changes)
    device.receive(0, START + 10 * MS, 0.2)
    with pytest.raises(HmsaError, match=expected):
        steps(board, device, 2, 3000, 5)
    assert device.switch_off(START + 3000 * MS) == ''


def test_a_clock_is_asked_on_when_that_of_the_host_has_been_set_back():
    board, device = board_driver()
    steps(board, device, 2, 500)
    asked = board.asked
    board.host -= 400 * MS
    steps(board, device, 100, 400)
    assert board.asked > asked


@pytest.mark.parametrize('by', [240_000 * MS, -5_000 * MS])
def test_when_the_clock_is_set_levels_ahead_and_the_watchdog_go_on(by):
    bench, device = driver(fallback=Fallback(0.1, 'zero'))
    command(device, (0, 0.1), until=0)
    command(device, (50, 0.2), until=10)
    device.clock_set(by)
    words = f'set {"ahead" if by > 0 else "back"} by {abs(by) / 1e9:.3f} s'
    assert [words in x.text for x in device.notices()] == [True]
    start = START + by
    device.advance(start + 49 * MS)
    device.advance(start + 51 * MS)
    assert bench.writes[1:] == [(START, 0.1), (start + 51 * MS, 0.2)]
    device.advance(start + 109 * MS)
    assert device.silent == []
    device.advance(start + 111 * MS)
    assert (device.silent, bench.levels[-1]) == ([0], 0.0)
    device.receive(0, start + 100 * MS, 0.3)
    device.receive(0, device.guards[0].cut_off_time, 0.0)
    device.receive(0, start + 120 * MS, 0.4)
    device.advance(start + 120 * MS)
    assert bench.levels[-1] == 0.4


@pytest.mark.parametrize('by', [240_000 * MS, -5_000 * MS])
def test_a_device_that_keeps_time_is_the_same_when_the_clock_of_the_host_is_set(by):
    board, device = board_driver()
    steps(board, device, 2, 290)
    device.receive(0, START + 310 * MS, 0.1)
    step(board, device, START + 290 * MS)
    board.host += by
    board.begun += by
    device.clock_set(by)
    for k in range(291, 1000):
        step(board, device, START + by + k * MS)
    change, = device.changes()
    assert abs(change.stamp - (START + by + 310 * MS + board.late)) < 15_000
    assert device.counts['state_lost'] == 0


def test_a_worker_sees_that_the_clock_is_set():
    bench, by = Bench(), [0]
    worker = HardwareWorker(lambda: HardwareDevice(
        [HardwareJoint(bench, 0.5, Fallback(3600.0, 'zero'))], time=monotonic_ns(),
        calls=Calls(60.0)), lambda: monotonic_ns() + by[0])
    assert worker.started(60.0)
    worker.receive(0, monotonic_ns(), 0.1)
    wait_until(lambda: bench.levels[-1] == 0.1, 'the level')
    by[0] = 7200 * 1000 * MS
    worker.receive(0, monotonic_ns() + by[0], 0.2)
    wait_until(lambda: bench.levels[-1] == 0.2, 'the level by the other clock')
    assert (worker.device.trips, bench.levels) == (0, [0.0, 0.1, 0.2])
    worker.close()


@pytest.mark.parametrize('seconds', [0.4, 2.0])
def test_a_worker_on_a_computer_that_was_suspended_cuts_its_coil_off(seconds):
    bench, slept = Bench(), [0]

    def clock() -> int:
        return monotonic_ns() + slept[0]

    # CLOCK_BOOTTIME counts the suspension, as the wall clock does; waits do not.
    worker = HardwareWorker(lambda: HardwareDevice(
        [HardwareJoint(bench, 0.5, Fallback(1.0, 'zero'))], time=clock(), calls=Calls(60.0)),
        clock, clock)
    assert worker.started(60.0)
    put(worker, 0, bench, 0.1)
    slept[0] = round(seconds * 1000) * MS
    if seconds > 1.0:
        # As the node does on its next tick.
        worker.stood_still(slept[0])
    wait_until(lambda: bench.levels[-1] == 0.0, 'the end of the level')
    notices = worker.device.notices()
    assert [x.kind for x in notices] == [Kind.SILENT]
    assert ('stood still for' in notices[0].text) == (seconds > 1.0)
    worker.receive(0, clock(), 0.2)
    wait_until(worker.device.notices, 'the refusal')
    assert bench.levels == [0.0, 0.1, 0.0]
    worker.close()


@pytest.mark.parametrize('clock', [
    lambda self: 'now', lambda self: None, lambda self: 10**400])
def test_a_clock_that_says_no_time_refuses_the_start(clock):
    with pytest.raises(HmsaError, match='expected its time in ns'):
        board_driver(clock=clock)


@pytest.mark.parametrize(('change', 'expected'), [
    ({'write': lambda level: None}, r'Coil.write does not take .*: expected write\(level, now\)'),
    ({'read': lambda: (1.0, 0.0)}, r'Coil.read does not take .*: expected read\(now\)'),
    ({'close': lambda x: None}, r'Coil.close does not take'),
    ({'limit': 'much'}, "Coil.limit is 'much': expected a number above 0"),
    ({'limit': 10**400}, 'Coil.limit is 1000.*: expected a number above 0'),
    ({'slew': 0.0}, 'Coil.slew is 0.0: expected a number above 0'),
    ({'out': True}, "Coil.resolution raised OSError: 'no device'")])
def test_a_class_that_cannot_be_called_is_refused(change, expected):
    class Coil(Bench):
        out = False

        @property
        def resolution(self):
            if self.out:
                raise OSError('no device')

    coil = Coil()
    for name, value in change.items():
        setattr(coil, name, value)
    with pytest.raises(BadInputError, match=expected):
        HardwareDevice([HardwareJoint(coil, 0.5)], time=START)


# -- the thread ---------------------------------------------------------------------------------


def test_a_worker_writes_each_level_at_its_stamp_and_switches_off_in_the_end():
    bench = Bench()
    bench.closed = []
    bench.close = lambda: bench.closed.append(bench.levels[-1])
    worker = serve(bench, period=MS)
    stamps = []
    # One after the other: of two that are late, only the second would be written.
    for level in (0.1, 0.2):
        stamps.append(monotonic_ns() + 20 * MS)
        worker.receive(0, stamps[-1], level)
        with pytest.raises(BadInputError, match='expected at most 0.5 T'):
            worker.receive(0, stamps[-1] + 20 * MS, 0.6)
        wait_until(lambda: bench.levels[-1] == level, 'the level')  # noqa: B023 called here
    worker.close()
    worker.close()
    assert bench.levels == [0.0, 0.1, 0.2, 0.0]
    assert bench.closed == [0.0]
    assert all(now >= stamp for (now, _), stamp in zip(bench.writes[1:], stamps, strict=False))
    assert [x.level for x in worker.device.changes()] == [0.0, 0.1, 0.2, 0.0]
    times = [x.time for x in worker.device.samples()]
    assert len(times) > 2
    assert times == sorted(times)
    assert worker.failure is None


class WordlessError(Exception):
    """An exception without a printable text."""

    def __str__(self):
        raise SystemExit


class Odd(BaseException):
    """An unexpected exception."""


@pytest.mark.parametrize('error', [
    OSError('no answer'), SystemExit(3), KeyboardInterrupt(), MemoryError(), Odd('who?'),
    GeneratorExit(), RecursionError('deep'), WordlessError()], ids=lambda x: type(x).__name__)
@pytest.mark.parametrize('method', ['write', 'read'])
def test_whatever_hardware_raises_ends_the_worker_with_all_coils_switched_off(method, error):
    benches = [Bench(), Bench()]
    worker = serve(*benches, period=MS)
    worker.receive(1, 0, 0.3)
    wait_until(lambda: 0.3 in benches[1].levels, 'the level')
    taken = getattr(benches[0], method)

    def fail(*_):
        setattr(benches[0], method, taken)
        raise error

    setattr(benches[0], method, fail)
    worker.receive(0, 0, 0.2)
    wait_until(lambda: worker.failure is not None, 'the failure')
    assert str(worker.failure).startswith(
        f'Bench.{method} of joint joint_0 raised {type(error).__name__}')
    assert 'the coil is switched off; correct it' in str(worker.failure)
    assert [x.levels[-1] for x in benches] == [0.0, 0.0]
    worker.close()


class Warm(Bench):
    degrees = 20.0

    def temperature(self):
        return self.degrees


def test_a_coil_that_is_too_warm_goes_off_and_is_obeyed_again_once_it_has_cooled():
    bench, device = driver(bench=Warm(), temperature_limit=80.0)
    second = 1000 * MS

    def go_on(until):
        for time in range(device.time, until, 10 * MS):
            device.advance(time)
    device.receive(0, START + MS, 0.1)
    device.receive(0, START + 3 * second, 0.2)
    go_on(START + second // 2)
    assert bench.levels[-1] == 0.1
    assert (device.coils[0].temperature, device.too_warm) == (20.0, '')
    for degrees, said in ((80.1, 'is at 80.1 degrees Celsius: expected at most 75'),
                          # The limit of before does not do.
                          (79.0, 'expected at most 75 .temperature_limit 80'),
                          (math.nan, 'is at nan degrees')):
        bench.degrees = degrees
        go_on(device.time + second // 2)
        assert bench.levels[-1] == 0.0
        assert device.coils[0].level == 0.0
        with pytest.raises(BadInputError, match=said):
            device.receive(0, 0, 0.1)
        device.receive(0, 0, 0.0)
    assert [x.kind for x in device.notices()].count(Kind.LOST) == 1
    bench.degrees = 75.0
    go_on(START + 4 * second)
    # What was ahead is forgotten.
    assert (bench.levels[-1], device.too_warm) == (0.0, '')
    device.receive(0, 0, 0.0)
    device.receive(0, 0, 0.15)
    go_on(device.time + second)
    assert bench.levels[-1] == 0.15


@pytest.mark.parametrize('end', ['switched off', 'rebooted', 'too warm'])
def test_a_ramp_down_does_not_go_on_once_the_coil_is_off(end):
    bench, device = driver(
        bench=Warm(), temperature_limit=80.0, fallback=Fallback(0.01, 'ramp', 0.1))
    device.receive(0, 0, 0.05)
    advance(device, 0, 11, 100)
    assert 0.0 < bench.levels[-1] < 0.05
    if end == 'switched off':
        device.switch_off(START + 101 * MS)
    elif end == 'rebooted':
        device.coils[0].lose(StateLostError('brown-out'), START + 101 * MS)
    else:
        bench.degrees = 81.0
    # The temperature is asked for four times a second.
    advance(device, *range(260, 600))
    # At the start, and once more.
    assert (bench.levels.count(0.0), bench.levels[-1]) == (2, 0.0)
    # Nor does what was commanded before, though it is repeated.
    bench.degrees = 20.0
    device.advance(START + 900 * MS)
    device.receive(0, 0, 0.05)
    assert '0.05 T, and the coil was cut off' in device.notices()[-1].text


def test_a_temperature_that_is_none_and_a_limit_without_one_are_refused():
    with pytest.raises(BadInputError, match='Bench reports no temperature: expected 0 for no'):
        driver(temperature_limit=80.0)
    with pytest.raises(BadInputError, match='temperature_limit is nan'):
        driver(temperature_limit=math.nan)
    bench = Warm()
    bench.degrees = 'hot'
    with pytest.raises(HmsaError, match="Warm.temperature of joint actuator returned 'hot'"):
        driver(bench=bench)


class Cable(Bench):
    """A line that can be disconnected; a new connection works once it is connected again."""

    def __init__(self):
        super().__init__()
        self.out = self.cut = False
        self.tries = 0

    def write(self, level, now):
        self.tries += 1
        if self.out or self.cut:
            raise OSError('no device')
        return super().write(level, now)

    def read(self, now):
        return self.write(0.1, now), 0.0

    def open(self):
        self.cut = self.out


def test_a_coil_that_could_not_be_switched_off_is_said_to_be_and_tried_until_it_is():
    cable = Cable()
    worker = serve(cable)
    put(worker, 0, cable, 0.1)
    cable.out = cable.cut = True
    worker.receive(0, 0, 0.2)
    wait_until(lambda: worker.trouble, 'the trouble')
    assert worker.trouble.startswith(
        "Cable.write of joint joint_0 raised OSError: 'no device': the coil could NOT be switched "
        'off and may be on')
    assert worker.failure is None
    with pytest.raises(BadInputError, match='could NOT be switched off'):
        worker.receive(0, 0, 0.1)
    tries = cable.tries
    wait_until(lambda: cable.tries > tries + 2, 'more attempts')
    # What flows is not known.
    assert [str(x.level) for x in worker.device.changes()] == ['0.0', '0.1', 'nan']
    cable.out = False
    wait_until(lambda: worker.failure is not None, 'the end')
    assert 'the coil is switched off at last, after' in str(worker.failure)
    assert [x.level for x in worker.device.changes()] == [0.0]
    assert cable.levels == [0.0, 0.1, 0.0]


def test_a_worker_that_is_to_reconnect_goes_on_from_zero_once_the_cable_is_in_again():
    cable, other = Cable(), Bench()
    worker = serve(cable, other, reconnect=True)
    worker.receive(0, 0, 0.1)
    worker.receive(1, 0, 0.2)
    worker.receive(1, monotonic_ns() + 3600 * 1000 * MS, 0.3)
    wait_until(lambda: cable.levels[-1] == 0.1 and other.levels[-1] == 0.2, 'the levels')
    for _ in range(2):
        cable.out = cable.cut = True
        worker.receive(0, 0, 0.15)
        wait_until(lambda: 'could NOT be switched off' in worker.trouble, 'the trouble')
        assert other.levels[-1] == 0.0
        with pytest.raises(BadInputError, match='no device'):
            worker.receive(1, 0, 0.2)
        cable.out = False
        wait_until(lambda: 'the coil is switched off, and all' in worker.trouble, 'the off')
        # Time enough for a planner to hear of it; then 0 T comes first.
        wait_until(lambda: worker.look_after() or not worker.trouble, 'the end of it')
        assert [x.is_cut_off for x in worker.device.guards] == [True, True]
        for level in (0.15, 0.0, 0.12):
            worker.receive(0, 0, level)
        wait_until(lambda: cable.levels[-1] == 0.12, 'a new level')
        assert '0.15 T, and the coil was cut off' in ''.join(
            x.text for x in worker.device.notices() if x.kind is Kind.REFUSED)
        assert 0.15 not in cable.levels
    assert other.levels[-1] == 0.0
    worker.close()
    assert worker.failure is None
    assert (cable.levels[-1], other.levels[-1]) == (0.0, 0.0)


def test_a_worker_that_is_to_reconnect_ends_by_itself_only_for_errors_of_its_own(monkeypatch):
    bench = Bench()
    worker = serve(bench, period=5 * MS, reconnect=True)

    def fail(now):
        raise OSError('broken')
    monkeypatch.setattr(bench, 'read', fail)
    wait_until(lambda: 'broken' in worker.trouble, 'the trouble')
    count = len(bench.levels)
    wait_until(lambda: len(bench.levels) > count + 4, 'more attempts')
    assert not any(bench.levels)
    # An end is heard meanwhile.
    worker.close()
    assert worker.failure is None
    worker = serve(Bench(), reconnect=True)
    monkeypatch.setattr(worker.device, 'advance', lambda now: 1 / 0)
    worker.receive(0, 0, 0.1)
    wait_until(lambda: worker.failure is not None, 'the end')
    worker.close()


def test_a_worker_that_is_ended_meanwhile_says_that_the_coil_was_not_switched_off():
    cable = Cable()
    worker = serve(cable)
    put(worker, 0, cable, 0.1)
    cable.out = True
    worker.close()
    assert 'the coil was NOT switched off and may be on' in str(worker.failure)


class Gate(Bench):
    """Blocks on request, until it is released or a call comes from another thread."""

    def __init__(self):
        super().__init__()
        self.blocks, self.blocked, self.go = '', Event(), Event()

    def write(self, level, now):
        self.pass_through('write')
        return super().write(level, now)

    def read(self, now):
        self.pass_through('read')
        return super().read(now)

    def pass_through(self, method):
        if self.blocks == method:
            self.blocks = ''
            self.blocked.set()
            assert self.go.wait(60.0)


def test_nobody_waits_for_a_call_that_blocks_and_then_only_the_newest_level_is_written():
    gate = Gate()
    worker = serve(gate)
    gate.blocks = 'write'
    worker.receive(0, 0, 0.1)
    assert gate.blocked.wait(60.0)
    # With a lock around the call, none of these would return.
    for k in range(2, 5):
        worker.receive(0, 0, k / 10)
    assert (worker.device.samples(), worker.device.notices(), worker.device.silent) == ([], [], [])
    assert [x.level for x in worker.device.changes()] == [0.0]
    gate.go.set()
    wait_until(lambda: 0.4 in gate.levels, 'the newest level')
    assert gate.levels == [0.0, 0.1, 0.4]
    worker.close()


@pytest.mark.parametrize('method', ['write', 'read'])
def test_a_call_that_does_not_return_in_time_ends_the_worker_from_another_thread(method):
    gate, other = Gate(), Bench()
    worker = serve(gate, other, period=MS, limit=0.01)
    put(worker, 1, other, 0.3)
    gate.blocks = method
    worker.receive(0, 0, 0.1)
    assert gate.blocked.wait(60.0)
    said = str(ended(worker))
    assert f'Gate.{method} of joint joint_0 has not returned for 0.01 s' in said
    assert 'the coil is switched off from another thread' in said
    assert [x.levels[-1] for x in (gate, other)] == [0.0, 0.0]
    gate.go.set()
    worker.close()
    # What blocked may have been a level; nothing but off has followed it.
    assert gate.levels[-1] == 0.0


def test_a_level_of_before_a_cut_off_is_not_written_when_a_call_returns_late():
    gate = Gate()
    now = [START]
    worker = HardwareWorker(lambda: HardwareDevice(
        [HardwareJoint(gate, 0.5)], time=START, calls=Calls(60.0)), *[lambda: now[0]] * 2)
    assert worker.started(60.0)
    gate.blocks = 'write'
    worker.receive(0, START, 0.1)
    assert gate.blocked.wait(60.0)
    # It came in time, and then nothing did for longer than the watchdog waits.
    now[0] = START + 500 * MS
    worker.receive(0, START + 600 * MS, 0.2)
    now[0] = START + 2000 * MS
    worker.receive(0, START + 1900 * MS, 0.1)
    gate.go.set()
    wait_until(lambda: gate.levels == [0.0, 0.1, 0.0], 'the coil to be off')
    worker.close()
    assert [x.kind for x in worker.device.notices()] == [Kind.SILENT, Kind.REFUSED]
    assert [x.level for x in worker.device.changes()] == [0.0, 0.1, 0.0]


def test_hardware_that_does_not_start_says_why():
    class Silent(Bench):
        def write(self, level, now):
            raise OSError('no device')

    class Stuck(Bench):
        def write(self, level, now):
            return now, 0.1

    for bench, text in ((Silent(), "raised OSError: 'no device'"), (Stuck(), '0.1 T are left')):
        with pytest.raises(HmsaError, match=f'{text}: the coil could NOT be switched off'):
            serve(bench)


def test_whatever_a_module_or_a_class_raises_refuses_the_start(tmp_path, monkeypatch):
    (tmp_path / 'ends_here.py').write_text('import sys\nsys.exit("no licence")\n')
    (tmp_path / 'a_lab.py').write_text("""\
class Coil:
    def __init__(self, joint, port=''):
        if not port:
            raise SystemExit('no port')
        self.port = port

    write = read = lambda self, *_: None
""")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadInputError, match="'ends_here:Coil' cannot be loaded .SystemExit: 'no "):
        load('ends_here:Coil', 'left', {})
    assert load('a_lab:Coil', 'left', {'port': 'x'}).port == 'x'
    with pytest.raises(BadInputError, match=r"joint left does not start \(SystemExit: 'no port'"):
        load('a_lab:Coil', 'left', {})


def test_the_verdict_on_hardware_names_what_is_wrong():
    assert judge_hardware('', saturated=0, state_lost=0) == (0, 'hardware obeys')
    assert judge_hardware('', saturated=3, state_lost=1) == (
        1, '3 levels not reached: the amplifier is saturated; its state was lost, times: 1')
    assert judge_hardware('the cable', saturated=3, state_lost=1) == (2, 'the cable')


def test_time_in_which_the_process_is_stopped_does_not_count_for_a_call(monkeypatch):
    clock = iter([0.0, 0.0, 0.05, 60.0, *(60.0 + 0.1 * x for x in range(1, 20))])
    now = [0.0]

    def monotonic():
        now[0] = next(clock, now[0])
        return now[0]

    monkeypatch.setattr('hmsa_ros.device.hardware.monotonic', monotonic)
    calls = Calls(1.0)

    def hang():
        assert [calls.overdue() for _ in range(10)] == [''] * 10
        return [calls.overdue() for _ in range(5)]

    assert calls('Coil.write', hang)[-1] == 'Coil.write'
