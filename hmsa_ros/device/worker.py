"""
Real hardware as a device, and a thread that serves it, so that no other thread waits for it.

Commands and results pass through queues; no lock is held during a call of hardware. The thread
publishes nothing, since blocked publishing would delay the coil.
"""

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
import math
import sys
from threading import Condition, Event, Thread
from time import monotonic, time_ns

import numpy as np

from hmsa.errors import BadInputError, HmsaError
from hmsa.model.equations import Array
from hmsa.model.sensor import Sample
from hmsa.model.units import NANOSECONDS
from hmsa_ros.device.coil import Coil, HardwareJoint
from hmsa_ros.device.hardware import Calls, described, HardwareError
from hmsa_ros.device.watchdog import Device, Kind
from hmsa_ros.timekeeping import clock_set_words, steady_ns, StepWatch

# In ns: a sleeping thread wakes up about 50 us late, and then waits for Python's global lock, at
# most for the switch interval. Both are this time before a level.
_WATCHED = 250_000
# In s: interval of attempts to switch off, its maximum, and their duration after a request to end.
_PAUSE, _LONGEST_PAUSE, _LAST_ATTEMPTS = 0.05, 1.0, 0.7
# In s, for ending while a call blocks: wait for the call, wait for each call that bypasses it, and
# limit for the rest.
_PATIENCE, _PAST, _HANGING = 0.8, 0.4, 2.5
# In s, after failed hardware obeys again: a pause, and the time during which commands are refused,
# so that planners receive that state.
_BREATH, _AWAY = 0.2, 1.0
# Longer than any pause between two levels, in ns.
_LONG = 1_000_000 * NANOSECONDS
#: A longer pause of a loop, in ns, may be a stall of the whole process.
STALL = 100_000_000
# Longest wait in s for the main thread after a stall, and interval of looks at it.
_READING, _LOOK = 0.2, 0.002
_MEND = 'correct it, then start the driver again'


class HardwareDevice(Device):
    """
    Real actuators; their coils may be on until `switch_off`.

    Parameters
    ----------
    joints : sequence of HardwareJoint
        At least one.
    time : int
        Initial time in ns.
    period : int
        Sampling period in ns; 0 for no samples.
    calls : Calls
        Limits and times the calls of hardware.
    clock : callable
        Returns the time in ns, on the clock of ``time``; for hardware with its own clock.

    Raises
    ------
    BadInputError
        If the hardware does not conform to `Hardware`.
    HardwareError
        If its clock cannot be read.

    """

    def __init__(
            self, joints: Sequence[HardwareJoint], *, time: int, period: int = 0,
            calls: Calls | None = None, clock: Callable[[], int] = time_ns) -> None:
        super().__init__()
        self.calls = Calls(1.0) if calls is None else calls
        self._time = self._next_sample = time
        self._period = period
        self.guards = self.coils = [
            Coil(i, x, self.calls, clock, self._notices, self._changes)
            for i, x in enumerate(joints)]

    @property
    def time(self) -> int:
        """Time in ns that the device has been advanced to."""
        return self._time

    @property
    def next_level(self) -> int | None:
        """Timestamp of the next level in ns; None if there is none."""
        return min((x.next_level for x in self.coils if x.next_level is not None), default=None)

    @property
    def due(self) -> int | None:
        """Time in ns of the next work; None if there is none until a command arrives."""
        times = [x.due(self._time) for x in self.coils]
        if self._period:
            times.append(self._next_sample)
        return min((x for x in times if x is not None), default=None)

    @property
    def counts(self) -> dict[str, int]:
        """Number of levels that were not reached, and of state losses of the hardware."""
        return {'saturated': sum(x.saturated for x in self.coils),
                'state_lost': sum(x.lost for x in self.coils)}

    @property
    def facts(self) -> dict[str, str]:
        """State of clocks, temperatures and calls, as texts by name."""
        found: dict[str, str] = {}
        for x in self.coils:
            if (known := x.instrument.clock_map) is not None:
                found |= {f'clock of {x.name}: error in us': f'{known.error * 1e6:.1f}',
                          f'clock of {x.name}: drift in ppm': f'{known.drift * 1e6:.2f}'}
            if not math.isnan(x.temperature):
                found[f'temperature of {x.name} in deg C'] = f'{x.temperature:.1f}'
        return found | {f'longest {name} in ms': f'{seconds * 1e3:.3f}'
                        for name, seconds in [*self.calls.longest.items()]}

    @property
    def too_warm(self) -> str:
        """The coils that are too warm, in words; empty if there is none."""
        return '; '.join(f'joint {x.name}: {x.too_warm}' for x in self.coils if x.too_warm)

    # -- commands ------------------------------------------------------------------------------

    def check(self, joint: int, stamp: int, level: float) -> None:
        """
        Refuse levels in T beyond the limit, timestamps in ns of another clock, and locked joints.

        A coil that is too warm accepts only 0 T.

        Raises
        ------
        BadInputError
            If the level is refused.

        """
        limit = self.coils[joint].limit
        if not abs(level) <= limit:  # not a number is refused, too
            raise BadInputError(f'flux density is {level:g} T: expected at most {limit:g} T')
        if self.locked:
            raise BadInputError(
                f'the interlock is open ({self.locked}): close it, then send a new request')
        if level and (why := self.coils[joint].too_warm):
            raise BadInputError(f'flux density is {level:g} T, and {why}')
        self._check_clock(stamp)

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """
        Accept a level in T that applies from a timestamp in ns on; immediately if past or 0.

        Raises
        ------
        BadInputError
            If the level is beyond the limit, its timestamp of another clock, or the interlock
            open.

        """
        self.check(joint, stamp, level)
        self.coils[joint].receive(stamp, level, self._time)

    def receive_at(self, joint: int, stamp: int, level: float, now: int) -> None:
        """Accept a level that arrived at a time in ns (see `receive`); run the watchdog first."""
        self.advance_to(now)
        self.coils[joint].look(now)
        self.receive(joint, stamp, level)
        self.coils[joint].look(now)

    def lock(self, why: str, time: int) -> None:
        """
        Switch off all coils at a time in ns, or ramp them down, and refuse commands from then on.

        Afterwards, a joint must first receive 0 T, so that earlier motion does not continue. An
        empty reason ends the lock.

        Raises
        ------
        HardwareError
            If a call fails.

        """
        begins = bool(why) and not self.locked
        self.locked = why
        if begins:
            self.advance_to(time)
            for coil in self.coils:
                coil.lock(time)

    # -- time ----------------------------------------------------------------------------------

    def advance_to(self, time: int) -> None:
        """Adopt a time in ns as the present one."""
        if time < self._time:
            # The clock was set back.
            self._next_sample = min(self._next_sample, time)
            for coil in self.coils:
                coil.set_back(time)
        self._time = time

    def stood_still(self, span: int) -> None:
        """
        Record that this process stood still for some ns until now.

        A coil that was left alone for longer than a planner may be silent is cut off.
        """
        for coil in self.coils:
            coil.stood_still(self._time, span)
            coil.look(self._time)

    def clock_set(self, by: int) -> None:
        """Shift all future times by the ns that the clock was set ahead."""
        self._time += by
        self._next_sample += by
        for coil in self.coils:
            coil.clock_set(by)
        self.coils[0].note(Kind.CLOCK, clock_set_words(by, 'levels ahead apply'))

    def advance(self, time: int) -> None:
        """
        Write levels due at a time in ns, which is now, and read if due.

        Raises
        ------
        HardwareError
            If a call fails.

        """
        self.advance_to(time)
        for coil in self.coils:
            coil.advance(time)
            if self.locked and coil.asked == 0.0:
                coil.disarm()
        if self._period and time >= self._next_sample:
            self._next_sample = (time // self._period + 1) * self._period
            self._read()

    def _read(self) -> None:
        """Add new samples; readings of several joints with the same timestamp form one sample."""
        found: dict[int, Array] = {}
        for coil in self.coils:
            for stamp, *values in coil.read(self._time):
                found.setdefault(stamp, np.full((2, len(self.coils)), math.nan))[
                    :, coil.number] = values
        for stamp, (stretch, rate) in sorted(found.items()):
            self._samples.append(Sample(
                stamp, stretch, rate, np.array([x.at(stamp) for x in self.coils])))

    # -- the end -------------------------------------------------------------------------------

    def switch_off(self, time: int) -> str:
        """Switch off all coils at a time in ns; return the failures in words."""
        self.advance_to(time)
        return '; '.join(filter(None, [x.switch_off(time) for x in self.coils]))

    def open(self) -> None:
        """Reconnect the hardware, if it supports that."""
        for x in self.coils:
            x.instrument.open()

    def close(self) -> str:
        """Close the hardware; return the failures in words."""
        wrong = []
        for x in self.coils:
            try:
                x.instrument.close()
            except HardwareError as error:
                wrong.append(str(error))
        return '; '.join(wrong)


class HardwareWorker:
    """
    A device of hardware that follows a clock in ns in its own thread.

    ``make`` is called in this thread, as all hardware is. ``failure`` contains the reason for an
    end without request. ``trouble`` contains an error that keeps the hardware from obeying, while
    the worker continues its attempts to switch off. The main thread calls `look_after` regularly,
    and reads the results from the ``device``.

    With ``reconnect``, an error of hardware does not end the worker: once the coils are off, it
    continues as after an interlock.
    """

    device: HardwareDevice  # available after `started`

    def __init__(
            self, make: Callable[[], HardwareDevice], clock: Callable[[], int],
            steady: Callable[[], int] = steady_ns, *, reconnect: bool = False) -> None:
        self._make, self._clock, self._steady = make, clock, steady
        self._reconnect = reconnect
        self._away = ''  # reason of a failure, until it continues
        self._resumes = 0.0  # end of the refusal after a failure, by the monotonic clock
        self._steps = StepWatch(clock, steady)
        # Steady times in ns by which this thread is to wake up, and of the last `look_after`.
        self._wakes = steady()
        self._looked: int | None = None
        self._turn = Condition()
        self._ready = Event()
        self._ended = False
        self._saver: Thread | None = None
        # Requests to the thread.
        self._commands: deque[Callable[[], None]] = deque()
        self.failure: HmsaError | None = None
        self.trouble = ''
        self.locked = ''  # why commands are refused
        sys.setswitchinterval(_WATCHED / NANOSECONDS)
        self._thread = Thread(target=self._work, name='hardware', daemon=True)
        self._thread.start()

    # -- for the main thread -------------------------------------------------------------------

    def started(self, seconds: float) -> bool:
        """
        Wait for at most some seconds until the coils are off initially; return whether they are.

        Raises
        ------
        HmsaError
            If the hardware does not start.

        """
        if not self._ready.wait(seconds):
            return False
        if self.failure is not None:
            raise self.failure
        return True

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """
        Pass a level in T that applies from a timestamp in ns on to the device.

        Raises
        ------
        BadInputError
            If the level is beyond the limit, or the hardware has failed.

        """
        if self.trouble:
            raise BadInputError(self.trouble)
        self.device.check(joint, stamp, level)
        self._put(partial(self._obey, joint, stamp, level, self._steady()))

    @property
    def busy(self) -> bool:
        """Whether a command that was received is still to be processed."""
        return bool(self._commands)

    def switch_off(self) -> None:
        """Switch off all coils, and drop pending levels."""
        self._put(self._switch_off)

    def lock(self, why: str) -> None:
        """Keep coils off and refuse commands while there is a reason; an empty one ends that."""
        if why != self.locked:
            self.locked = why
            self._put(lambda: self.device.lock(why, self._now()))

    def _put(self, command: Callable[[], None]) -> None:
        self._commands.append(command)
        with self._turn:
            self._turn.notify()

    def stood_still(self, span: int) -> None:
        """Record that this process stood still for some ns."""
        def stand_still() -> None:
            self.device.advance_to(self._now())
            self.device.stood_still(span)

        self._put(stand_still)

    def look_after(self) -> None:
        """Check that the thread is alive and its calls return; otherwise switch off without it."""
        self._looked = self._steady()
        if self.failure is not None or self._saver is not None:
            return
        if not self._thread.is_alive():
            self._save('the thread that serves the hardware has ended')
        elif overdue := self.device.calls.overdue():
            self._save(f'{overdue} has not returned for {self.device.calls.limit:g} s '
                       '(hardware.timeout)')

    def close(self) -> None:
        """Switch off all coils and end; may be called repeatedly."""
        with self._turn:
            self._ended = True
            self._turn.notify()
        if self._saver is None:
            self._thread.join(_PATIENCE)
            if self._thread.is_alive():
                self._save(f'{self.device.calls.current or "the hardware"} does not return')
        if self._saver is not None:
            self._saver.join(3.0 * _PAST)
            # A blocked call that returns after all may have written a level: off follows it.
            self._thread.join(_PATIENCE)

    # -- in the thread of the hardware ---------------------------------------------------------

    def _work(self) -> None:
        """Serve the hardware whenever work is due, and sleep until then."""
        try:
            self.device = self._make()
            if left := self.device.switch_off(self._now()):
                raise HmsaError(
                    f'{left}: the coil could NOT be switched off at the start; {_MEND}')
        except BaseException as error:  # any error, which would be lost otherwise
            self.failure = error if isinstance(error, HmsaError) else HmsaError(
                f'the driver does not start ({described(error)})')
            return
        finally:
            self._ready.set()
        while self._serve():
            pass

    def _serve(self) -> bool:
        """Serve the hardware; return whether to continue after an error."""
        try:
            if self._away:
                self._come_back()
            while not self._ended:
                if self._resumes and monotonic() >= self._resumes:
                    self._resumes = 0.0
                    self.device.lock(self.locked, self._now())
                    self.trouble = ''
                self._let_main_thread_read()
                while self._commands:
                    try:
                        self._commands[0]()
                    finally:
                        self._commands.popleft()
                self.device.advance(self._now())
                self._wait()
        except BaseException as error:
            return self._end(
                str(error) if isinstance(error, HmsaError) else
                f'the driver failed ({described(error)})',
                again=self._reconnect and isinstance(error, HardwareError))
        return self._end('', again=False)

    def _come_back(self) -> None:
        """Prepare to continue: all coils are off and locked for a while."""
        self.trouble, self._away = (
            f'{self._away}: the coil is switched off, and all commands are discarded', '')
        self.device.lock(self.trouble, self._now())
        self._resumes = monotonic() + _AWAY

    def _now(self) -> int:
        """Return the time in ns; a clock that was set must not count as silence."""
        now, by = self._steps.read()
        if by:
            self.device.clock_set(by)
        return now

    def _let_main_thread_read(self) -> None:
        """After a stall, wait for the commands that arrived meanwhile, for a short time."""
        woke = self._steady()
        if woke - self._wakes < STALL or self._looked is None:
            return
        until = monotonic() + _READING
        with self._turn:
            while self._looked < woke and not self._ended and monotonic() < until:
                self._turn.wait(_LOOK)

    def _obey(self, joint: int, stamp: int, level: float, came: int) -> None:
        """Accept a level that arrived at a steady time in ns, perhaps during a blocked call."""
        try:
            self.device.receive_at(joint, stamp, level, self._now() - self._steady() + came)
        except BadInputError as error:
            self.device.coils[joint].note(Kind.REFUSED, str(error))

    def _switch_off(self) -> None:
        if left := self.device.switch_off(self._now()):
            raise HardwareError(left)

    def _wait(self) -> None:
        """Sleep until work is due, but busy-wait shortly before a level."""
        device, now = self.device, self._now()
        due, level = device.due, device.next_level
        left = math.inf if due is None else due - now
        self._wakes = self._steady() + round(min(max(left, 0), _LONG))
        if due == level and left <= _WATCHED:
            device.calls.make_ready()
            # By the steady clock, since the other may be set meanwhile.
            end = self._steady() + left
            while self._steady() < end and not self._commands:
                pass
            return
        device.calls.relax()
        with self._turn:
            if self._ended or self._commands:
                return
            if due == level:
                left -= _WATCHED
            if self._resumes:
                left = min(left, (self._resumes - monotonic()) * NANOSECONDS)
            self._turn.wait(None if left == math.inf else max(left, 0.0) / NANOSECONDS)

    def _end(self, why: str, *, again: bool) -> bool:
        """
        Switch off and close; repeat failed attempts until the end is requested.

        With ``again``, return True without closing once the coils are off.
        """
        begun, pause = monotonic(), _PAUSE
        last, reported = None, False
        self._resumes = 0.0
        while left := self.device.switch_off(self._now()):
            if not reported:
                reported = True
                self.trouble = (
                    f'{why or left}: the coil could NOT be switched off and may be on'
                    f'{f" ({left})" if why and left != why else ""}; cut the power of the '
                    'amplifier; the driver keeps trying')
            if self._ended:
                last = last or monotonic() + _LAST_ATTEMPTS
                if monotonic() > last:
                    break
            with self._turn:
                self._turn.wait(_PAUSE if self._ended else pause)
            pause = min(2.0 * pause, _LONGEST_PAUSE)
            self.device.open()
        if again and not self._ended:
            with self._turn:
                # Limits the CPU load if the failure recurs immediately.
                self._turn.wait_for(lambda: self._ended, _BREATH)
            if not reported:
                self.device.open()
            self._away = why
            return True
        closed = '' if left else self.device.close()
        # An error that the worker would have survived does not spoil an end that was asked for.
        survived = again and not (left or closed or reported)
        if self._saver is not None or survived or not (why or left or closed or reported):
            return False
        after = f' at last, after {monotonic() - begun:.1f} s' if reported else ''
        self.failure = HmsaError(
            f'{why or left}: the coil was NOT switched off and may be on; cut the power of the '
            'amplifier' if left else
            f'{why or closed or "the hardware failed"}: the coil is switched off{after}; {_MEND}')
        return False

    # -- without the thread of the hardware ----------------------------------------------------

    def _save(self, why: str) -> None:
        """Start to end without the thread, which is blocked in a call."""
        self.trouble = f'{why}: trying to switch the coil off from another thread'
        self._ended = True
        self.device.calls.give_up(_HANGING)
        self._saver = Thread(target=self._switch_off_past, args=(why,), daemon=True)
        self._saver.start()

    def _switch_off_past(self, why: str) -> None:
        """Write 0 and close, bypassing the blocked call, with a time limit for each."""
        device, now = self.device, self._clock()
        done: dict[int, bool] = {}
        for act in (
                lambda x: done.update({x.number: x.instrument.cut(now)}),
                lambda x: x.instrument.drop()):
            threads = [Thread(target=act, args=(x,), daemon=True) for x in device.coils]
            for x in threads:
                x.start()
            until = monotonic() + _PAST
            for x in threads:
                x.join(max(until - monotonic(), 0.0))
        for coil in device.coils:
            level = 0.0 if done.get(coil.number) else math.nan
            coil.set(device.time, level, level)
        self.failure = HmsaError(
            f'{why}: ' + (
                f'the coil is switched off from another thread; {_MEND}'
                if all(done.get(x.number) for x in device.coils) else
                'the coil could NOT be switched off and may be on; cut the power of the '
                'amplifier'))
