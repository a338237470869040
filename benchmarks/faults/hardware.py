"""Faults of drivers, judged by the board's own record of its level."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import math
import re
import signal
from threading import Event
from time import monotonic
from typing import Any

from sensor_msgs.msg import TimeReference

from benchmarks.faults.board import Board
from benchmarks.faults.common import PATIENT_LEAD, Register
from benchmarks.faults.rig import Child, Rig
from benchmarks.faults.table import Seen
from hmsa.interfaces import topics
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.conversions import CUT_OFF, from_time, to_command

FAULTS = Register()
_LEVEL = 0.02
_BEAT = 0.05
# As a planner's, in ns: commands with timestamps before a cut-off are refused.
_LEAD = 200_000_000
# Timeouts in s: the driver's watchdog, a call that hangs, and the firmware's watchdog.
_TIMEOUT, _CALL, _FIRMWARE = 0.5, 0.5, 0.4
# Timeout in s of a call where the fault is not a call that hangs: nor is a host that halts the
# board, by up to 5 s.
_PATIENT_CALL = 15.0
_STALL = 1.2  # time in s for which a process is stopped
# Allowed time in s for a driver to end on request, and for one whose call hangs.
_PROMPT, _SOON = 3.0, 5.0
# Text around a driver's message, in its log and in its last line.
_AROUND = re.compile(
    r'^(hmsa: error: |\[\w+\] \[[\d.]+\] \[\w+\]: )|; correct it, then start the driver again$')


class _Bench:
    """A board, its driver, and commands that are repeated during waits."""

    def __init__(self, rig: Rig, board: Board, **parameters: object) -> None:
        self.rig, self.board = rig, board
        self._parameters = {
            'hardware': 'benchmarks.faults.serial_coil:SerialCoil',
            'hardware.port': rig.folder / 'port', 'hardware.timeout': _PATIENT_CALL,
            'command_timeout': _TIMEOUT, 'publish_rate': 50.0, **parameters}
        self._start()
        self._command = rig.publisher(topics.FLUX_DENSITY_COMMAND)
        self._cut_off = 0  # time in ns that names a cut-off; 0 for none
        ros_entities.subscribe(rig.node, topics.FLUX_DENSITY_RECEIVED, self._on_receipt)

    def _start(self) -> None:
        self.driver: Child = self.rig.start('driver', self._parameters)

    def _on_receipt(self, message: TimeReference) -> None:
        cut_off = message.header.frame_id == CUT_OFF
        self._cut_off = from_time(message.time_ref) if cut_off else 0

    def ready(self) -> None:
        """Wait until the driver accepts commands."""
        self._until(self.rig.spin_until, lambda: (
            self.rig.applied and self._command.get_subscription_count()), 'the driver')

    def switch_on(self) -> None:
        """Set a level in the coil."""
        self.ready()
        self._until(self.beat_until, lambda: self.board.level == _LEVEL, 'the level')

    def _until(
            self, wait: Callable[..., None], condition: Callable[[], Any], what: str) -> None:
        """Wait; start the driver again if the host halted the board for longer than a call."""
        wait(lambda: condition() or not self.driver.alive, what)
        while not condition():
            # The board may still answer the driver that has ended: not on a new line.
            self.board.plug()
            self.rig.applied.clear()
            self._start()
            wait(lambda: condition() or not self.driver.alive, what)

    def beat_until(
            self, condition: Callable[[], Any], what: str, level: float = _LEVEL, *,
            yields: bool = True) -> None:
        """Repeat a level until a condition holds; if ``yields``, acknowledge cut-offs."""
        due = 0.0

        def look() -> Any:
            nonlocal due
            if monotonic() >= due:
                due = monotonic() + _BEAT
                now = self.rig.node.get_clock().now().nanoseconds
                acknowledges = yields and self._cut_off
                self._command.publish(
                    to_command(self._cut_off, 0.0, '') if acknowledges else
                    to_command(now + _LEAD, level, ''))
            return condition()

        self.rig.spin_until(look, what)

    def ends(self) -> int:
        """Wait for the driver to end; return its status."""
        self.beat_until(lambda: not self.driver.alive, 'the end of the driver')
        status = self.driver.popen.poll()
        return -1 if status is None else status

    def spent_since(self, time: float) -> float:
        """Return the time in s since a time, without that for which the host halted the board."""
        return monotonic() - time - self.board.halted_since(time)

    @property
    def last(self) -> str:
        """The last message of the driver."""
        last = self.driver.said.strip().rpartition('\n')[2]
        return _AROUND.sub('', last)


@contextmanager
def _bench(rig: Rig, watchdog: float = 0.0, **parameters: object) -> Iterator[_Bench]:
    board = Board(rig.folder / 'port', watchdog)
    try:
        yield _Bench(rig, board, **parameters)
    finally:
        board.end()


def _failed(rig: Rig, words: str, reply: str, *texts: str) -> Seen:
    """Inject a wrong answer to the next call of a kind."""
    with _bench(rig) as bench:
        bench.switch_on()
        board = bench.board

        def answer(right: str) -> str:
            if right[0] not in words:
                return right
            board.answer = str
            return reply

        begin = monotonic()
        board.answer = answer
        status = bench.ends()
        off = board.off_since(begin)
        return Seen(f'exit {status}, "{bench.last}"', f'off after {off:.2f} s',
                    status == 1 and all(x in bench.last for x in texts)
                    and board.off_within(begin, _TIMEOUT))


for _name, _word, _call in (
        ('OSError', 'K', 'write'), ('SystemExit', 'K', 'write'),
        ('KeyboardInterrupt', 'S', 'read'), ('MemoryError', 'S', 'read')):
    FAULTS.add(
        f'driver_{_name.lower()}', f'{_call} raises {_name}', 'a board on a serial line, 20 mT',
        'off within command_timeout, method and error named, exit 1', _failed, _word,
        f'RAISE {_name}', f'SerialCoil.{_call} of joint actuator raised {_name}',
        'the coil is switched off')


FAULTS.add(
    'driver_garbage', 'board answers garbage', 'half a line, then right answers',
    'off within command_timeout, exit 1', _failed, 'KS', '#*;S 1.', 'SerialCoil')


@FAULTS.fault(
    'driver_cable', 'cable out, later in again', 'at 20 mT; a board without watchdog',
    'failure to switch off reported, ERROR, level NaN; off once the cable is back, exit 1')
def _cable(rig: Rig) -> Seen:
    with _bench(rig) as bench:
        bench.switch_on()
        bench.board.unplug()
        bench.beat_until(lambda: 'could NOT be switched off' in bench.driver.said, 'the alarm')
        bench.beat_until(lambda: rig.level('driver') == 2, 'ERROR in diagnostics')
        bench.beat_until(lambda: math.isnan(rig.applied[-1][1]), 'the report')
        level, applied = bench.board.level, rig.applied[-1][1]
        begin = monotonic()
        bench.board.plug()
        status = bench.ends()
        off = bench.board.off_since(begin)
        return Seen(
            f'{level:g} T, {applied:g} T reported; exit {status}, "{bench.last}"',
            f'off after {off:.2f} s of cable',
            level == _LEVEL and math.isnan(applied) and status == 1 and math.isfinite(off)
            and 'switched off at last' in bench.last)


@FAULTS.fault(
    'driver_cable_ended', 'cable out, then SIGTERM', 'after the report',
    'ends within 3 s, reports that the coil is not off')
def _cable_ended(rig: Rig) -> Seen:
    with _bench(rig) as bench:
        bench.switch_on()
        bench.board.unplug()
        bench.beat_until(lambda: 'could NOT be switched off' in bench.driver.said, 'the alarm')
        return _terminated(bench, 'was NOT switched off')


def _terminated(bench: _Bench, text: str) -> Seen:
    """End the driver by SIGTERM and judge how it ends."""
    begin = monotonic()
    bench.driver.send(signal.SIGTERM)
    status = bench.ends()
    spent = bench.spent_since(begin)
    return Seen(f'exit {status}, "{bench.last}"', f'ended after {spent:.1f} s',
                spent < _PROMPT and text in bench.last and status != 0)


@FAULTS.fault(
    'driver_reboot', 'board reboots', 'its level is lost; the old level is repeated',
    'reported, 0 T, old level rejected, another obeyed; driver continues')
def _reboot(rig: Rig) -> Seen:
    with _bench(rig) as bench:
        bench.switch_on()
        begin = monotonic()
        bench.board.reboot()
        for condition, what in (
                (lambda: 'has lost its state' in bench.driver.said, 'the alarm'),
                (lambda: rig.applied[-1][1] == 0.0, 'the report'),
                (lambda: monotonic() > begin + 2.0 * _TIMEOUT, 'time to pass')):
            bench.beat_until(condition, what, yields=False)
        again = bench.board.largest_since(begin)
        bench.beat_until(lambda: bench.board.level == 0.01, 'another level', 0.01)
        return Seen(f'reported; another level obeyed, {again:g} T before', '-',
                    again == 0.0 and bench.driver.alive)


@FAULTS.fault(
    'driver_saturated', 'amplifier saturated', '20 mT requested, 12 mT possible',
    'actual level reported, WARN names saturation')
def _saturated(rig: Rig) -> Seen:
    with _bench(rig) as bench:
        bench.board.largest = 0.012
        bench.ready()
        bench.beat_until(
            lambda: any('saturated' in x['message'] for x in rig.diagnostics.values()), 'WARN')
        _, values = rig.samples()
        return Seen(
            f'{rig.applied[-1][1]:g} T reported, {values[-1, 2]:g} T in samples', '-',
            rig.applied[-1][1] == values[-1, 2] == bench.board.level == 0.012
            and 'was asked for 0.02 T and set 0.012 T' in bench.driver.said)


def _blocked(bench: _Bench, word: str) -> float:
    """Stop answers to a kind of call; wait for an unanswered call; return the start time."""
    bench.switch_on()
    unanswered = Event()

    def answer(right: str) -> str:
        if right[0] != word:
            return right
        unanswered.set()
        return ''

    begin = monotonic()
    bench.board.answer = answer
    bench.beat_until(unanswered.is_set, 'a call that does not return')
    return begin


def _hung(rig: Rig, word: str, method: str) -> Seen:
    with _bench(rig, **{'hardware.timeout': _CALL}) as bench:
        begin = _blocked(bench, word)
        status = bench.ends()
        spent, off = bench.spent_since(begin), bench.board.off_since(begin)
        return Seen(
            f'exit {status} after {spent:.1f} s, "{bench.last}"', f'off after {off:.2f} s',
            status == 1 and spent < _SOON + _CALL and bench.board.off_within(begin, _SOON)
            and f'SerialCoil.{method} of joint actuator has not returned for' in bench.last)


for _word, _call in (('K', 'write'), ('S', 'read')):
    FAULTS.add(
        f'driver_{_call}_blocks', f'{_call} does not return',
        'the board obeys, but does not answer',
        'off from another thread after hardware.timeout, exit 1 within 5 s', _hung, _word, _call)


@FAULTS.fault(
    'driver_blocked_ended', 'SIGTERM while a call does not return', 'hardware.timeout 60 s',
    'ends within 3 s, coil off')
def _blocked_ended(rig: Rig) -> Seen:
    with _bench(rig, **{'hardware.timeout': 60.0}) as bench:
        begin = _blocked(bench, 'S')
        seen = _terminated(bench, 'SerialCoil.read of joint actuator does not return')
        off = bench.board.off_since(begin)
        return Seen(seen.text, f'{seen.figure}, off after {off:.2f} s',
                    seen.met and math.isfinite(off))


@FAULTS.fault(
    'driver_gil', 'a call keeps the GIL', 'a C function; firmware with a watchdog',
    'ends within 5 s, names the method; the firmware switches off')
def _held(rig: Rig) -> Seen:
    with _bench(rig, _FIRMWARE, **{'hardware.timeout': _CALL}) as bench:
        bench.switch_on()
        begin = monotonic()
        bench.board.answer = lambda _: 'HANG 0 0'
        status = bench.ends()
        spent = bench.spent_since(begin)
        rig.spin_until(lambda: not bench.board.level, 'the firmware')
        return Seen(
            f'exit {status} after {spent:.1f} s, "{bench.last}"',
            f'off after {bench.board.off_since(begin):.2f} s',
            status == 1 and spent < _SOON and 'lets nothing else run' in bench.last)


@FAULTS.fault(
    'driver_constructor', 'SIGTERM while the class starts', 'a constructor that sleeps for 60 s',
    'ends within 3 s')
def _constructor(rig: Rig) -> Seen:
    with _bench(rig, **{'hardware.sleep': 60.0}) as bench:
        rig.spin_until(lambda: 'it has not started yet' in bench.driver.said, 'that it is said')
        return _terminated(bench, 'it has not started yet')


@FAULTS.fault(
    'driver_planner_killed', 'planner killed', 'while 1.1 is held',
    'off within command_timeout of the last heartbeat, reported')
def _planner_killed(rig: Rig) -> Seen:
    with _bench(rig) as bench:
        planner = rig.start('planner')
        bench.ready()
        rig.ready('planner')
        rig.setpoint(1.1)
        rig.spin_until(lambda: bench.board.level, 'a level')
        planner.end(signal.SIGKILL)
        begin = monotonic()
        rig.spin_until(lambda: not bench.board.level, 'the watchdog')
        off = bench.board.off_since(begin)
        rig.spin_until(lambda: 'no heartbeat' in bench.driver.said, 'that it is said')
        return Seen('reported', f'off after {off:.2f} s',
                    bench.board.off_within(begin, _TIMEOUT + 0.1))


def _stalled(rig: Rig, who: str, latest: float) -> Seen:
    """Stop a process for longer than the watchdog waits; ``latest`` is when the coil is off."""
    with _bench(rig) as bench:
        processes = {'driver': bench.driver, 'planner': rig.start('planner', {
            'lead_time': PATIENT_LEAD})}
        bench.ready()
        rig.ready('planner')
        _move_until_on(bench, lambda: rig.sequence([(x, 0.3) for x in (1.1, 1.2, 1.3) * 4]))
        rig.spin(0.5)
        begin = monotonic()
        processes[who].send(signal.SIGSTOP)
        rig.spin(_STALL)
        processes[who].send(signal.SIGCONT)
        rig.spin_until(lambda: any(x['code'] == CUT_OFF for x in rig.verdicts), 'the status')
        # The board reads the level after the driver has written it.
        rig.spin_until(lambda: bench.board.off_since(begin) < math.inf, 'the coil to be off')
        off, in_time = bench.board.off_since(begin), bench.board.off_within(begin, latest)
        rig.spin(1.0)
        again = bench.board.largest_since(begin + off)
        _move_until_on(bench, lambda: rig.setpoint(1.1))
        return Seen(
            f'{again:g} T before the next request', f'off after {off:.2f} s',
            not again and in_time)


def _move_until_on(bench: _Bench, request: Callable[[], object]) -> None:
    """Request motion until the coil is on: a busy host may stop a process for as long."""
    request()

    def on() -> bool:
        if bench.rig.verdicts[-1]['code'] == CUT_OFF:
            request()
        return bool(bench.board.level)

    bench.rig.spin_until(on, 'a level')


for _key, _who, _off, _latest in (
        ('driver_planner_stalled', 'planner', 'within command_timeout of the last heartbeat',
         _TIMEOUT + 0.4),
        ('driver_stalled', 'driver', 'as soon as it continues', _STALL + 0.3)):
    FAULTS.add(
        _key, f'{_who} stopped for longer than command_timeout',
        f'SIGSTOP for {_STALL:g} s in mid-sequence, SIGCONT; a board on a serial line',
        f'off {_off}, and until a request; status `cut_off`', _stalled, _who, _latest)


@FAULTS.fault(
    'driver_killed', 'driver killed', 'firmware with a watchdog, publish_rate 0',
    'heartbeats feed this watchdog; it switches off')
def _killed(rig: Rig) -> Seen:
    with _bench(rig, _FIRMWARE, publish_rate=0.0) as bench:
        bench.switch_on()
        begin = monotonic()
        bench.beat_until(lambda: monotonic() > begin + 3.0 * _FIRMWARE, 'time to pass')
        fed = bench.board.off_since(begin) == math.inf and bench.board.record[-1][0] < begin
        bench.driver.end(signal.SIGKILL)
        begin = monotonic()
        rig.spin_until(lambda: not bench.board.level, 'the firmware')
        off = bench.board.off_since(begin)
        return Seen(f'fed: {fed}', f'off after {off:.2f} s',
                    fed and bench.board.off_within(begin, _FIRMWARE + 0.1))
