"""Real hardware as a device: levels written at their stamps, a watchdog, and samples."""

from collections.abc import Callable, Sequence
import math
from time import time_ns

import numpy as np

from hmsa_ros.device.coil import Coil, HardwareJoint
from hmsa_ros.device.hardware import Calls, HardwareError
from hmsa_ros.device.protocol import Kind, Sample
from hmsa_ros.device.watchdog import Device
from hmsa_ros.errors import BadInputError
from hmsa_ros.model.equations import Array
from hmsa_ros.timekeeping import clock_set_words


class HardwareDevice(Device):
    """
    Real actuators; their coils are not known to be off before `switch_off`.

    Parameters
    ----------
    joints : sequence of HardwareJoint
        At least one.
    time : int
        Time at the start in ns.
    period : int
        Between samples, in ns; 0 for none.
    calls : Calls
        Limits and times the calls of hardware.
    clock : callable
        Returns the time in ns, as ``time`` is; for hardware with a clock of its own.

    Raises
    ------
    BadInputError
        If hardware is not as `Hardware` says.
    HardwareError
        If it does not answer what time it has.

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
        """Time in ns that it has been advanced to."""
        return self._time

    @property
    def next_level(self) -> int | None:
        """Stamp of the next level, in ns; None if there is none ahead."""
        return min((x.next_level for x in self.coils if x.next_level is not None), default=None)

    @property
    def due(self) -> int | None:
        """When to advance it next, in ns; None for not before a command comes."""
        times = [x.due(self._time) for x in self.coils]
        if self._period:
            times.append(self._next_sample)
        return min((x for x in times if x is not None), default=None)

    @property
    def counts(self) -> dict[str, int]:
        """How often a level was not reached, and hardware lost its state."""
        return {'saturated': sum(x.saturated for x in self.coils),
                'state_lost': sum(x.lost for x in self.coils)}

    @property
    def facts(self) -> dict[str, str]:
        """What is known of clocks, temperatures and calls, in words by name."""
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
        """Which coils are too warm, in words; empty if none is."""
        return '; '.join(f'joint {x.name}: {x.too_warm}' for x in self.coils if x.too_warm)

    # -- commands ------------------------------------------------------------------------------

    def check(self, joint: int, stamp: int, level: float) -> None:
        """
        Refuse a level in T beyond the limit, a stamp in ns of another clock, and any while locked.

        A coil that is too warm takes 0 T only.

        Raises
        ------
        BadInputError
            If it is.

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
        Take a level in T that applies from a stamp in ns on; a past one, or 0, at once.

        Raises
        ------
        BadInputError
            If the level is beyond the limit, the stamp of another clock, or the interlock open.

        """
        self.check(joint, stamp, level)
        self.coils[joint].receive(stamp, level, self._time)

    def hear(self, joint: int, stamp: int, level: float, now: int) -> None:
        """Take a level that came at a time in ns (see `receive`), after any silence before it."""
        self._pass_to(now)
        self.coils[joint].look(now)
        self.receive(joint, stamp, level)
        self.coils[joint].look(now)

    def lock(self, why: str, time: int) -> None:
        """
        Switch all coils off at a time in ns, or ramp them down, and refuse commands from then on.

        Afterwards a joint obeys 0 T first: what was under way does not go on. An empty reason
        ends it.

        Raises
        ------
        HardwareError
            If a call fails.

        """
        begins = bool(why) and not self.locked
        self.locked = why
        if begins:
            self._pass_to(time)
            for coil in self.coils:
                coil.lock(time)

    # -- time ----------------------------------------------------------------------------------

    def _pass_to(self, time: int) -> None:
        if time < self._time:
            # The clock was set back.
            self._next_sample = min(self._next_sample, time)
        self._time = time

    def clock_set(self, by: int) -> None:
        """Take in that the clock was set ahead by some ns: all that is ahead stays as far away."""
        self._time += by
        self._next_sample += by
        for coil in self.coils:
            coil.clock_set(by)
        self.coils[0].note(Kind.CLOCK, clock_set_words(by, 'levels ahead apply'))

    def advance(self, time: int) -> None:
        """
        Write what is due at a time in ns, which is now, and read if that is due.

        Raises
        ------
        HardwareError
            If a call fails.

        """
        self._pass_to(time)
        for coil in self.coils:
            coil.advance(time)
            if self.locked and coil.asked == 0.0:
                coil.disarm()
        if self._period and time >= self._next_sample:
            self._next_sample = (time // self._period + 1) * self._period
            self._read()

    def _read(self) -> None:
        """Take what is new; readings of several joints with one stamp are one sample."""
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
        """Switch all coils off at a time in ns; return what could not be, in words."""
        self._pass_to(time)
        return '; '.join(filter(None, [x.switch_off(time) for x in self.coils]))

    def open(self) -> None:
        """Have the hardware connect again, where it can."""
        for x in self.coils:
            x.instrument.open()

    def close(self) -> str:
        """Have the hardware end; return what has gone wrong, in words."""
        wrong = []
        for x in self.coils:
            try:
                x.instrument.close()
            except HardwareError as error:
                wrong.append(str(error))
        return '; '.join(wrong)
