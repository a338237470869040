"""Real hardware as a device: levels written at their timestamps, a watchdog, and samples."""

from collections.abc import Callable, Sequence
import math
from time import time_ns

import numpy as np

from hmsa.errors import BadInputError
from hmsa.model.equations import Array
from hmsa.model.sensor import Sample
from hmsa_ros.device.coil import Coil, HardwareJoint
from hmsa_ros.device.hardware import Calls, HardwareError
from hmsa_ros.device.watchdog import Device, Kind
from hmsa_ros.timekeeping import clock_set_words


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
