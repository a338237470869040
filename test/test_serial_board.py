"""The serial board: firmware, line and driver, with faults of boards and cables."""

import errno
from functools import partial
import math
import os
from pathlib import Path
from random import Random
import select
import subprocess
from threading import Event, Thread
from time import monotonic, time_ns
import tty

from conftest import wait_until
from extras import needs
import numpy as np
import pytest

from hmsa.cli import main
from hmsa.errors import HmsaError
from hmsa.interfaces import topics
from hmsa_lab.bench import _board, serial_board
from hmsa_lab.bench.serial_board import (
    Board,
    BoardError,
    framed,
    REST_LENGTH,
    SerialBoard,
    SimulatedBoard,
    TESLA_PER_AMPERE,
)
from hmsa_ros.device.watchdog import Fallback, Kind
from hmsa_ros.device.worker import HardwareDevice, HardwareJoint

FIRMWARE = Path(_board.__file__).with_name('hmsa_board')
SETTINGS = {'coil.tesla_per_ampere': TESLA_PER_AMPERE, 'sensor.rest_length': REST_LENGTH}
MS = 1_000_000


def ask(board, text, now=0):
    return _board.receive(board, framed(text), now).decode().strip().partition('*')[0]


def test_a_board_applies_levels_at_their_times_and_answers_the_same_when_asked_again():
    board = _board.make(10_000_000, 1000)
    assert ask(board, '1 0 S 100 500000') == '1 0 L'
    assert ask(board, '2 7 H 7 1000000') == '2 7 H 1 32 10000000 1000 0 0 0'
    for _ in range(2):
        assert ask(board, '3 7 S 100 500400') == '3 7 S'
        assert ask(board, '4 7 S 200 -99000000') == '4 7 S'
    assert _board.due(board) == 100
    assert (_board.advance(board, 99), _board.advance(board, 100)) == (0, 500_000)
    # A level that is due earlier takes back what is later.
    assert ask(board, '5 7 S 150 1000', 110) == '5 7 S'
    assert _board.advance(board, 300) == 1000
    assert ask(board, '6 7 S 400 -99000000', 300) == '6 7 S'
    assert _board.advance(board, 401) == -10_000_000
    for _ in range(2):
        assert ask(board, '7 7 A 2', 402) == '7 7 A 2 300 1000 101 -10000000'
    assert ask(board, '8 7 S 500 1', 403) == '8 7 S'
    assert ask(board, '9 7 W 2600', 404) == '9 7 W 404 3000 3'
    assert _board.advance(board, 600) == 3000
    # Silence switches off, and the session is over.
    assert _board.advance(board, 404 + 999_999) == 3000
    assert _board.advance(board, 404 + 1_000_000) == 0
    assert ask(board, '10 7 W 2600', 2_000_000) == '10 0 L'


def test_a_board_keeps_no_more_than_it_has_room_for_and_tells_what_it_still_has():
    board = _board.make(1000, 1)
    ask(board, '1 0 H 7 1000000')
    for i in range(160):
        if i < 40:
            assert ask(board, f'1 7 S {100 + i} {i}') == ('1 7 S' if i < 32 else '1 7 F')
        _board.sample(board, 10 * i, i)
    # The newest 128 of 160, a few at a time.
    assert ask(board, '2 7 M 1').startswith('2 7 M 33 320 32 10 33 10 34')
    assert ask(board, '2 7 M 160') == '2 7 M 160 1590 159'
    assert ask(board, '2 7 M 161') == '2 7 M 161'


def test_a_board_tells_the_temperature_of_its_coil_if_it_measures_one(line):
    needs('serial')
    board = _board.make(1000, 1)
    ask(board, '1 0 H 7 1000000')
    # As firmware from before answers what it does not know.
    assert ask(board, '2 7 C') == '2 7 C'
    _board.warm(board, -1_500_000)
    assert ask(board, '2 7 C') == '2 7 C -1500000'
    without = Board(str(line.path))
    assert not hasattr(without, 'temperature')
    without.close()
    line.board.temperature = 41.25
    device = driver(line)
    assert device.coils[0].temperature == 41.25
    assert device.close() == ''


def test_what_is_no_request_puts_no_level_out():
    board, random = _board.make(1000, 1), Random(3)
    ask(board, '1 0 H 7 1000000')
    for text in (b'1 7 W 9\n', b'1 7 W 9*0000\n', b'\n', b'*\n', b'x' * 5000 + b'\n',
                 framed('1 7 W'), framed('1 7 W 1 2'), framed('1 7 W 1234567890123456789'),
                 framed('1 7 W 9')[1:], framed('1 8 W 9'), framed('1 7 W 9x'), framed('W')):
        _board.receive(board, text, 0)
    line = framed('1 7 W 900')
    for _ in range(20_000):
        broken = bytearray(line)
        broken[random.randrange(len(line) - 1)] ^= 1 << random.randrange(8)
        _board.receive(board, bytes(broken), 0)
        _board.receive(board, random.randbytes(20), 0)
        assert _board.advance(board, 0) == 0
    _board.receive(board, b'\n' + line, 0)
    assert _board.advance(board, 0) == 900


def test_firmware_is_portable_and_the_sketch_has_all_that_it_needs(tmp_path):
    (tmp_path / 'arduino.h').write_text("""
        #include <stdint.h>
        enum { A0, A1 };
        struct {
            void begin(long); int available(), read(), availableForWrite(); void write(char);
        } Serial;
        uint32_t micros();
        int analogRead(int);
        void analogWrite(int, int), analogWriteResolution(int), analogReadResolution(int);
    """)
    subprocess.run(
        ['c++', '-std=c++11', '-Wall', '-Wextra', '-Wpedantic', '-Werror', '-fsyntax-only',
         '-fno-exceptions', '-fno-rtti', '-x', 'c++', '-include', tmp_path / 'arduino.h',
         FIRMWARE / 'hmsa_board.ino'], check=True)


class Line:
    """A simulated board behind a pseudo-terminal, whose bytes may be lost or changed."""

    def __init__(self, path):
        self.path, self.board = path, SimulatedBoard()
        self.random, self.loss, self.garbage = Random(5), 0.0, 0.0
        self._end = Event()
        self._main = -1
        self.plug()
        self._thread = Thread(target=self._serve)
        self._thread.start()

    def plug(self):
        main, self._end_of_line = os.openpty()
        tty.setraw(self._end_of_line)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self._end_of_line))
        self._main = main

    def unplug(self):
        if self._main < 0:
            return
        main, self._main = self._main, -1
        os.close(self._end_of_line)
        os.close(main)
        self.path.unlink()

    def _worn(self, text):
        kept = bytes(x for x in text if self.random.random() >= self.loss)
        noise = self.random.randbytes(5) if self.random.random() < self.garbage else b''
        return noise + kept

    def _serve(self):
        while not self._end.is_set():
            try:
                if select.select([self._main], [], [], 0.005)[0]:
                    self.board.write(self._worn(os.read(self._main, 1000)))
                    os.write(self._main, self._worn(self.board.read(10_000)))
                else:
                    self.board.advance()
            except (OSError, ValueError):  # unplugged
                self._end.wait(0.005)
                self.board.advance()

    def close(self):
        self._end.set()
        self._thread.join()
        self.unplug()


@pytest.fixture
def line(tmp_path, monkeypatch):
    # A busy machine is slow to serve the line.
    monkeypatch.setattr(Board, 'times', (0.2, 0.4))
    monkeypatch.setattr(serial_board, '_PATIENCE', 20.0)
    made = Line(tmp_path / 'ttyBoard')
    yield made
    made.close()


def test_lost_bytes_and_garbage_cost_attempts_and_nothing_else(line):
    needs('serial')
    board = Board(str(line.path), watchdog=60.0)
    line.loss, line.garbage = 0.001, 0.1
    begin = board.clock() + 1500 * MS
    asked = [(begin + 20 * MS * i, 0.001 * i) for i in range(1, 25)]
    board.schedule(asked)
    applied, samples = [], []
    until = monotonic() + 60.0
    while len(applied) < len(asked):
        assert monotonic() < until
        applied += board.applied()
        samples += board.read(0)
    assert [x for _, x in applied] == pytest.approx([x for _, x in asked], abs=1e-4)
    # The thread that lets the time of the board pass may be late; its clock counts.
    assert [x for x, _ in applied] == pytest.approx([x for x, _ in asked], abs=1000)
    stamps = np.array([x for *_, x in samples])
    assert len(stamps) > 100
    assert np.all(np.diff(stamps) >= MS)
    board.close()


def driver(line, **settings):
    device = HardwareDevice(
        [HardwareJoint(SerialBoard('a', str(line.path), **settings, **SETTINGS), 0.5,
                       Fallback(0.0))], time=time_ns(), period=5 * MS)
    assert device.switch_off(time_ns()) == ''
    return device


def go_on(device, done, what):
    """Advance a device until a condition is true."""
    wait_until(lambda: device.advance(time_ns()) or done(), what)


def reached(device, level):
    return lambda: device.coils[0].level == pytest.approx(level)


def test_a_board_that_restarts_is_noticed_and_obeys_by_its_new_clock(line):
    needs('serial')
    device = driver(line, watchdog=5.0)
    device.receive(0, time_ns() + 50 * MS, 0.1)
    go_on(device, reached(device, 0.1), 'the level')
    line.board.restart()
    go_on(device, lambda: device.counts['state_lost'], 'the loss')
    (notice,) = [x for x in device.notices() if x.kind == Kind.LOST]
    assert f'the board on {line.path} has restarted' in notice.text
    assert device.coils[0].level == 0.0
    device.changes()
    device.receive(0, device.guards[0].cut_off_time, 0.0)
    device.receive(0, time_ns() + 100 * MS, 0.15)
    go_on(device, reached(device, 0.15), 'the next level')
    assert [x.level for x in device.changes()] == pytest.approx([0.15])
    assert device.close() == ''


def test_a_board_whose_cable_is_pulled_switches_off_and_is_found_again(line):
    needs('serial')
    device = driver(line, watchdog=1.0)
    device.receive(0, 0, 0.1)
    go_on(device, reached(device, 0.1), 'the level')
    line.unplug()
    with pytest.raises(HmsaError, match='raised BoardError') as caught:
        go_on(device, lambda: False, 'an error')
    assert 'check hardware.port, its cable' in str(caught.value.__cause__)
    left = device.switch_off(time_ns())
    assert 'SerialBoard.write of joint actuator raised BoardError: the line' in left
    wait_until(lambda: line.board._level == 0, 'the watchdog of the board')
    line.plug()
    device.open()
    assert device.switch_off(time_ns()) == ''
    assert device.counts['state_lost'] == 1
    assert device.close() == ''


@pytest.mark.slow
@pytest.mark.ros
def test_a_driver_goes_on_after_a_pulled_cable_when_it_is_asked_to(start, ros, line):
    applied = ros.collect(topics.FLUX_DENSITY_APPLIED)
    status = ros.collect(topics.STATUS, 'planner/status')
    health = ros.collect(topics.DIAGNOSTICS.type, topics.DIAGNOSTICS.name)
    driver = start.hmsa('driver', '--ros-args', *(word for x in (
        'hardware:=serial_board', f'hardware.port:={line.path}', 'hardware.reconnect:=true',
        'publish_rate:=50.0', *(f'hardware.{key}:={x}' for key, x in SETTINGS.items()))
        for word in ('-p', x)))
    start.hmsa('planner')
    setpoint = ros.publisher(topics.SETPOINT, 'planner/setpoint')

    ask = partial(ros.ask, setpoint, status)

    def level():
        return applied[-1].magnetic_field.z if applied else math.nan

    def says(severity):
        return any(x.level == severity for y in health[-3:] for x in y.status
                   if x.name == 'driver: hardware')
    ros.spin_until(lambda: level() == 0.0, 'the level at the start')
    ask(1.1, 'accepted', 'unchanged')
    ros.spin_until(lambda: level() > 0.01, 'the coil on')
    line.unplug()
    ros.spin_until(lambda: line.board._level == 0, 'the watchdog of the board')
    ros.spin_until(lambda: says(b'\2'), 'the error')
    ask(1.2, 'interlock')
    assert math.isnan(level())
    line.plug()
    driver.wait_for_output('the hardware responds again: the next request moves the actuator')
    ros.spin_until(lambda: level() == 0.0, 'the coil off')
    count = len(applied)
    ask(1.2, 'accepted', 'unchanged')
    ros.spin_until(lambda: level() > 0.01, 'the coil on again')
    assert applied[count - 1].magnetic_field.z == 0.0
    assert driver.stop() == 0, driver.output
    assert line.board._level == 0


def test_a_board_without_room_and_one_that_is_none_are_said(line, monkeypatch):
    needs('serial')
    board = Board(str(line.path))
    monkeypatch.setattr(serial_board, '_PATIENCE', 0.4)
    with pytest.raises(BoardError, match='is full, 0.4 s after it was asked S'):
        board.schedule([(10**15 + i * MS, 0.1) for i in range(40)])
    board.close()
    line.loss = 1.0
    monkeypatch.setattr(serial_board, '_BOOT', 0.1)
    with pytest.raises(BoardError, match='does not answer, 0.1 s after it was asked H'):
        Board(str(line.path))
    line.loss, sent = 0.0, []
    monkeypatch.setattr(line.board, 'write', sent.append)
    monkeypatch.setattr(line.board, 'read', lambda _: sent.pop())
    with pytest.raises(BoardError, match=r'answers H \[\d+, 500000\], 0.1 s .* without echo'):
        Board(str(line.path))


@pytest.mark.parametrize(('settings', 'expected'), [
    (['port=sim'], 'coil.tesla_per_ampere is nan'),
    (['coil.tesla_per_ampere=1'], "port is '': expected a serial port"),
    (['coil.tesla_per_ampere=1', 'port=/no/tty'], 'the line /no/tty failed'),
    (['coil.tesla_per_ampere=1', 'port=sim:/no/x.csv'], 'expected a file in a folder that exists'),
    (['coil.tesla_per_ampere=1', 'port=sim', 'watchdog=-1'], 'watchdog is -1')])
def test_a_board_that_cannot_be_had_is_refused_in_a_sentence(refusal, settings, expected):
    needs('serial')
    given = [x for setting in settings for x in ('--set', setting)]
    assert expected in refusal('check-driver serial_board', *given)


def test_without_pyserial_it_says_how_to_install_it(monkeypatch):
    def missing(name):
        raise ImportError(errno.ENOENT, name)

    monkeypatch.setattr('hmsa_lab.bench.line.import_module', missing)
    with pytest.raises(HmsaError, match='pip install pyserial'):
        Board('/dev/ttyACM0')


@pytest.mark.slow
def test_the_board_on_a_line_passes_the_conformance_test(line, capsys):
    given = [x for key, value in {**SETTINGS, 'port': line.path}.items()
             for x in ('--set', f'{key}={value}')]
    assert main(['check-driver', 'serial_board', *given, '--limit', '0.02']) == 0, (
        capsys.readouterr())


@pytest.mark.ros
@pytest.mark.slow
def test_a_move_behind_the_firmware_ends_without_vibration(start, ros, tmp_path):
    truth = tmp_path / 'truth.csv'
    driver = start.hmsa(
        'driver', '--ros-args', '-p', 'hardware:=serial_board',
        '-p', f'hardware.port:=sim:{truth}', *[
            x for key, value in SETTINGS.items() for x in ('-p', f'hardware.{key}:={value}')],
        '-p', 'publish_rate:=200.0')
    driver.wait_for_output('SerialBoard for joint actuator (version 1 on sim:')
    planner = start.hmsa('planner', '--ros-args', '-p', 'lead_time:=1.0')
    states = ros.collect(topics.JOINT_STATES.type, topics.JOINT_STATES.name)
    ros.spin_until(lambda: states, 'a sample')
    send = start.hmsa('send', '1.10:0.5', '1.30:0.5', '--wait', '--timeout', '90')
    assert send.wait() == 0, send.output
    assert planner.stop() == 0
    assert driver.stop() == 0
    time, stretch, _, flux = np.genfromtxt(truth, delimiter=',', skip_header=1).T
    ends = [np.flatnonzero(np.diff(flux))[[1, 3]] + 10]
    for end, target, step in zip(ends[0], (1.1, 1.3), (0.1, 0.2), strict=True):
        rest = stretch[end:end + 400]
        assert abs(float(np.mean(rest)) - target) < 0.003 * step
        assert float(np.ptp(rest)) < 0.005 * step
    assert math.isclose(float(np.median(np.diff(time))), 1e-3, rel_tol=0.01)
