"""The interlock: opening, effect on coil and planner, and recovery."""

from dataclasses import replace
from functools import partial
import math

import pytest
from std_msgs.msg import Bool
from test_runtime_hosts import BEATING, Bench, MS, START
from test_runtime_planner import Rig, trajectory

from hmsa.errors import BadInputError
from hmsa.interfaces import topics
from hmsa_ros.device import StateLostError
from hmsa_ros.device.watchdog import Fallback, Interlock, Kind
from hmsa_ros.device.worker import HardwareDevice, HardwareJoint
from hmsa_ros.runtime.records import Stop, StretchRequest

SECOND = 1000 * MS
A, B, C = b'a', b'b', b'c'


def opened(lock, now, *said, here=(A, B, C)):
    """Return whether an interlock is open after messages of publishers at a time in ms."""
    for publisher, closed in said:
        lock.receive(publisher, now * MS, closed=closed, present=lambda: here)
    return bool(lock.look(now * MS))


def test_an_interlock_that_is_not_required_is_open_while_a_publisher_says_so():
    lock = Interlock(required=False, timeout=500 * MS)
    assert not opened(lock, 0)
    assert not opened(lock, 1, (A, True))
    assert opened(lock, 10_000, (B, False), (A, True))
    assert not opened(lock, 12_000, (B, True))
    # At least a second, though it is taken back at once.
    assert opened(lock, 13_000, (B, False), (B, True))
    assert opened(lock, 13_999)
    assert not opened(lock, 14_000)
    assert lock.openings == 2


def test_who_has_left_keeps_an_interlock_open_until_another_closes_it_anew():
    lock = Interlock(required=False, timeout=500 * MS)
    assert not opened(lock, 0, (A, True))
    assert opened(lock, 1, (B, False))
    # One who never opened it does not close it by going on.
    assert opened(lock, 5000, (A, True), here=(A,))
    assert opened(lock, 5001, (C, True), here=(A, B, C))
    lock = Interlock(required=False, timeout=500 * MS)
    assert opened(lock, 1, (B, False))
    assert not opened(lock, 5000, (C, True), here=(C,))


def test_a_required_interlock_is_open_without_anybody_and_after_a_silence():
    lock = Interlock(required=True, timeout=500 * MS)
    assert opened(lock, 0)
    assert 'no publisher has closed it' in lock.why
    assert opened(lock, 999, (A, True))
    assert not opened(lock, 1400, (A, True))
    assert not opened(lock, 1900)
    assert opened(lock, 1901)
    assert 'silent for more than 0.5 s' in lock.why
    # Another goes on, and the silent one has left: it is to be closed anew.
    assert opened(lock, 3000, (A, True), (B, True)) is False
    assert opened(lock, 3501, (B, True), here=(B,))
    assert opened(lock, 6000, (B, True), here=(B,))
    assert not opened(lock, 6001, (C, True), (B, True), here=(B, C))


# -- the coil -----------------------------------------------------------------------------------


class Coil:
    """An amplifier that can be armed, with or without stored levels; records its calls."""

    def __init__(self, lose=''):
        self.told, self.lose = [], lose

    def arm(self):
        self.told.append('arm')

    def disarm(self):
        self.told.append('disarm')

    def write(self, level, now):
        if self.lose:
            error, self.lose = self.lose, ''
            raise error
        self.told.append(level)

    def read(self, now):
        return []


class Keeping(Coil):
    """An amplifier that stores levels."""

    def schedule(self, levels):
        self.told += [x for _, x in levels]


def device(coil, safe='zero'):
    found = HardwareDevice(
        [HardwareJoint(coil, 0.5, Fallback(1.0, safe, 10.0))], time=START)
    assert found.switch_off(START) == ''
    return found


@pytest.mark.parametrize('make', [Coil, Keeping])
def test_an_open_interlock_switches_off_and_nothing_goes_on_by_itself(make):
    coil = make()
    driver = device(coil)
    driver.receive(0, 0, 0.1)
    driver.receive(0, START + 50 * MS, 0.2)
    driver.advance(START + MS)
    before = len(coil.told)
    driver.lock('the door', START + 2 * MS)
    for time in range(3, 200):
        driver.advance(START + time * MS)
    assert coil.told[:3] == [0.0, 'arm', 0.1]
    assert coil.told[before:] == [0.0, 'disarm']
    for level in (0.1, 0.0):
        with pytest.raises(BadInputError, match=r'interlock is open \(the door\): close it'):
            driver.receive(0, 0, level)
    driver.lock('', driver.time)
    told = [*coil.told]
    # Neither what was commanded before, nor anything new, nor a level for later.
    for stamp, level in ((0, 0.1), (0, 0.3), (driver.time + 20 * MS, -0.05), (START, 0.0)):
        driver.receive(0, stamp, level)
        driver.advance(driver.time + 50 * MS)
    assert coil.told == told
    refused = [x.text for x in driver.notices() if x.kind is Kind.REFUSED]
    assert ['expected 0 T first' in x for x in refused] == [True] * 4
    driver.receive(0, 0, 0.0)
    driver.receive(0, 0, 0.3)
    driver.advance(driver.time + MS)
    assert [x for x in coil.told[len(told):] if x != 0.0] == ['arm', 0.3]
    assert driver.switch_off(driver.time) == ''
    assert coil.told[-2:] == [0.0, 'disarm']


def test_an_open_interlock_ramps_a_coil_that_must_not_be_released():
    coil = Coil()
    driver = device(coil, 'ramp')
    driver.receive(0, 0, 0.05)
    driver.advance(START + MS)
    driver.lock('the door', START + 2 * MS)
    while driver.due is not None:
        driver.advance(driver.due + 100_000)
    assert [x for x in coil.told[2:] if x != 'disarm'] == pytest.approx(
        [0.05, 0.05, 0.04, 0.03, 0.02, 0.01, 0.0], abs=1e-12)
    assert coil.told[-1] == 'disarm'


def test_an_open_interlock_finds_a_board_that_has_rebooted():
    coil = Coil()
    driver = device(coil)
    driver.receive(0, 0, 0.1)
    driver.advance(START + MS)
    coil.lose = StateLostError('boot 2')
    driver.lock('the door', START + 2 * MS)
    driver.advance(START + 3 * MS)
    assert coil.told[-1] == 0.0
    assert math.isclose(driver.coils[0].level, 0.0)
    driver.lock('', START + 5 * MS)
    driver.receive(0, 0, 0.2)
    assert 'expected 0 T first' in driver.notices()[-1].text


# -- the planner --------------------------------------------------------------------------------


class LockedBench(Bench):
    """A rig whose driver has an interlock."""

    door = False

    def deliver(self):
        self.cut = self.cut or self.door
        if self.door:
            self.wire = []
        Bench.deliver(self)

    def open_door(self):
        self.door = True
        self.plant.command(self.now, 0.0)
        self.plant.advance(self.now)
        self.runtime.applied('a', self.now, 0.0)


@pytest.mark.parametrize('reaction', ['wait', 'resume'])
def test_a_planner_drops_its_plan_refuses_and_waits_to_be_asked(reaction, monkeypatch):
    rig = LockedBench(settings=replace(BEATING, after_cut_off=reaction))
    received = rig.runtime.received
    monkeypatch.setattr(rig.runtime, 'received', lambda *x, **others: received(
        *x, **others, locked=rig.door))
    rig.go(trajectory((1.2, 400 * MS), (1.4, 60_000 * MS)), START + 800 * MS)
    rig.open_door()
    rig.run(rig.now + 1500 * MS)
    assert rig.status.verdict.code == 'interlock'
    assert rig.status.progress.state == 'idle'
    sent = len(rig.sent)
    verdict = rig.runtime.request(StretchRequest('a', 1.3))
    assert verdict.code == 'interlock'
    assert verdict.message.endswith(
        'close the interlock (hmsa interlock close), then send a new request')
    assert rig.runtime.request(Stop()).code != 'interlock'
    rig.run(rig.now + 1000 * MS)
    assert rig.status.verdict.message == (
        'stopped: the coil of a is off; no samples show whether it rests')
    rig.door = False
    rig.run(rig.now + 3000 * MS)
    assert not rig.cut
    assert max(abs(x.flux_density) for _, x in rig.sent[sent:]) < 1e-9
    assert rig.runtime.request(StretchRequest('a', 1.3)).code == 'accepted'
    rig.run(rig.now + 500 * MS)
    assert rig.residual(1.3) < 1e-6


def test_a_request_that_waits_is_refused_when_the_interlock_opens():
    rig = Rig(settings=replace(BEATING, takeover_timeout=5000 * MS))
    assert rig.runtime.request(StretchRequest('a', 1.3)).code == 'waiting'
    rig.runtime.received('a', rig.now, 0, cut_off=False, locked=True)
    rig.run(rig.now + 6000 * MS)
    assert rig.status.verdict.code == 'interlock'
    assert not rig.sent


# -- the nodes ----------------------------------------------------------------------------------

BENCH = """\
class Coil:
    def __init__(self, joint):
        self.log = open(__file__ + '.log', 'a', buffering=1)

    def arm(self):
        self.log.write('arm\\n')

    def disarm(self):
        self.log.write('disarm\\n')

    def write(self, level, now):
        self.log.write(f'{level:.3f}\\n')

    def read(self, now):
        return []
"""


@pytest.mark.ros
@pytest.mark.parametrize('command', [
    'driver', pytest.param('controller', marks=pytest.mark.slow)])
def test_a_required_interlock_wins_over_everything(command, start, ros, tmp_path):
    (tmp_path / 'lab.py').write_text(BENCH)
    health = ros.collect(topics.DIAGNOSTICS.type, topics.DIAGNOSTICS.name)
    status = ros.collect(topics.STATUS, 'planner/status')
    applied = ros.collect(topics.FLUX_DENSITY_APPLIED)
    node = start.hmsa(
        command, '--ros-args', '-p', 'hardware:=lab:Coil', '-p', 'interlock_required:=true',
        '-p', 'interlock_timeout:=2.0', '-p', 'publish_rate:=0.0', PYTHONPATH=str(tmp_path))
    if command == 'driver':
        start.hmsa('planner')
    door = ros.publisher(topics.INTERLOCK, 'driver/interlock')
    setpoint = ros.publisher(topics.SETPOINT, 'planner/setpoint')

    def says(text):
        return any(x.message.startswith(text) for y in health[-20:] for x in y.status
                   if x.name == 'driver: interlock')

    ask = partial(ros.ask, setpoint, status)
    ros.spin_until(lambda: says('open: no publisher has closed it'), 'an open interlock')
    ask(1.1, 'interlock')
    beat = ros.node.create_timer(0.1, lambda: door.publish(Bool(data=True)))
    ros.spin_until(lambda: says('closed'), 'a closed interlock')
    ask(1.1, 'accepted', 'unchanged')
    ros.spin_until(lambda: applied[-1].magnetic_field.z > 0.01, 'the coil on')
    beat.cancel()
    ros.spin_until(lambda: says('open: a publisher that closed it has been silent'), 'silence')
    ros.spin_until(lambda: applied[-1].magnetic_field.z == 0.0, 'the coil off')
    ask(1.2, 'interlock')
    count = len(applied)
    beat.reset()
    health.clear()
    ros.spin_until(lambda: says('closed'), 'a closed interlock again')
    ask(1.2, 'accepted', 'unchanged')
    ros.spin_until(lambda: applied[-1].magnetic_field.z > 0.01, 'the coil on again')
    assert all(x.magnetic_field.z >= 0.0 for x in applied[count:])
    door.publish(Bool(data=False))
    ros.spin_until(lambda: applied[-1].magnetic_field.z == 0.0, 'the coil off again')
    beat.cancel()
    assert node.stop() == 0
    log = (tmp_path / 'lab.py.log').read_text().split()
    assert (log[0], log[-2:]) == ('0.000', ['disarm', '0.000'])
    assert log.count('arm') == log.count('disarm') == 2


@pytest.mark.ros
def test_an_interlock_stays_open_while_a_driver_is_configured_anew(start, ros, tmp_path):
    (tmp_path / 'lab.py').write_text(BENCH)
    health = ros.collect(topics.DIAGNOSTICS.type, topics.DIAGNOSTICS.name)
    start.hmsa(
        'driver', '--ros-args', '-p', 'hardware:=lab:Coil', '-p', 'publish_rate:=0.0',
        PYTHONPATH=str(tmp_path))
    door = ros.publisher(topics.INTERLOCK, 'driver/interlock')

    def shown():
        return [x.message for y in health[-1:] for x in y.status if x.name == 'driver: interlock']

    ros.spin_until(lambda: door.get_subscription_count() and shown() == ['closed'], 'a driver')
    door.publish(Bool(data=False))
    ros.spin_until(lambda: shown() == ['open: a publisher has opened it'], 'an open interlock')
    assert ros.change('driver', 'deactivate', 'cleanup', 'configure', 'activate')
    health.clear()
    ros.spin_until(shown, 'a driver that is there again')
    assert shown() == ['open: a publisher has opened it']


@pytest.mark.ros
def test_a_command_opens_and_closes_the_interlock_of_a_driver(start, ros, tmp_path):
    (tmp_path / 'lab.py').write_text(BENCH)
    health = ros.collect(topics.DIAGNOSTICS.type, topics.DIAGNOSTICS.name)
    for namespace, required in (('left', 'false'), ('right', 'true')):
        start.hmsa(
            'driver', '--ros-args', '-r', f'__ns:=/{namespace}', '-p', 'hardware:=lab:Coil',
            '-p', 'publish_rate:=0.0', '-p', f'interlock_required:={required}',
            PYTHONPATH=str(tmp_path))

    def turn(state, namespace, status, said, timeout=60):
        command = start.hmsa(
            'interlock', state, '--namespace', namespace, '--timeout', str(timeout))
        assert command.wait() == status
        assert said in (command.stderr if status else command.stdout)

    turn('close', 'left', 0, 'interlock closed: the next request moves the actuator again')
    turn('open', 'left', 0, 'interlock open: the driver switches the coil off')
    health.clear()
    ros.spin_until(lambda: health and any(
        x.message == 'open: a publisher has opened it' for y in health for x in y.status),
        'an interlock that stays open without its publisher')
    turn('close', 'left', 0, 'interlock closed')
    turn('close', 'right', 1, '/right/driver has interlock_required: it opens again')
    turn('open', 'middle', 1, 'no driver /middle/driver', timeout=1)
