"""Real hardware as a device: levels written at their stamps, a watchdog, and samples."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
import math
import os
import sys
from typing import cast, Protocol

import numpy as np

from hmsa_ros.core.schedule import CommandSchedule
from hmsa_ros.device.protocol import Change, Sample
from hmsa_ros.device.watchdog import Device, Fallback
from hmsa_ros.errors import BadInputError


class Hardware(Protocol):
    """A coil's amplifier, and the sensor of its actuator; both calls must be quick."""

    def write(self, level: float, now: int) -> int:
        """Set the coil to a level in T at a time in ns; return when that took effect."""

    def read(self, now: int) -> tuple[float, float]:
        """Return stretch and stretch rate in 1/s; NaN for what is not measured."""


def load(text: str) -> Callable[[str], Hardware]:
    """
    Return what makes the hardware of a joint by its name, found by ``'MODULE:NAME'``.

    Raises
    ------
    BadInputError
        If there is no such thing; what is returned raises it, too, where it fails.

    """
    module, _, name = text.partition(':')
    if not module or not name:
        raise BadInputError(
            f'hardware is {text!r}: expected MODULE:NAME of what makes the hardware of a joint, '
            'as in hardware:=my_lab:Coil')
    if os.getcwd() not in sys.path:
        # The script of a command has its own folder there instead.
        sys.path.append(os.getcwd())
    try:
        make = getattr(import_module(module), name)
    except Exception as error:  # whatever a laboratory's module raises
        raise BadInputError(
            f'hardware {text!r} cannot be loaded ({type(error).__name__}: {error}): expected a '
            'module that Python finds, or in the working directory, with that name in it'
        ) from error

    def made(joint: str) -> Hardware:
        try:
            found = make(joint)
        except Exception as error:
            raise BadInputError(
                f'hardware {text!r} of joint {joint} does not start ({type(error).__name__}: '
                f'{error}): expected it to take the name of a joint') from error
        if not all(callable(getattr(found, x, None)) for x in ('write', 'read')):
            raise BadInputError(
                f'hardware {text!r} made a {type(found).__name__}: expected something with the '
                'methods write and read')
        return cast(Hardware, found)
    return made


@dataclass(frozen=True)
class HardwareJoint:
    """
    A real actuator.

    Raises
    ------
    BadInputError
        If the limit is out of range.

    """

    hardware: Hardware  #: what writes and reads
    limit: float  #: largest level in T, above 0; what exceeds it is refused
    #: what to do after a silence
    fallback: Fallback = field(default_factory=lambda: Fallback(safe_flux='zero'))

    def __post_init__(self) -> None:
        if not 0.0 < self.limit < math.inf:
            raise BadInputError(f'limit is {self.limit:g} T: expected a number above 0')


class HardwareDevice(Device):
    """
    Real actuators.

    Parameters
    ----------
    joints : sequence of HardwareJoint
        At least one; their coils are switched off at the start.
    time : int
        Time at the start in ns.
    period : int
        Between samples, in ns; 0 for none.

    """

    def __init__(
            self, joints: Sequence[HardwareJoint], *, time: int, period: int = 0) -> None:
        super().__init__(x.fallback for x in joints)
        self._joints = tuple(joints)
        self._time = time
        self._period = period
        self._next_sample = time
        self._schedules = [CommandSchedule(0.0) for _ in joints]
        self._heard = [False for _ in joints]
        self._levels = [math.nan for _ in joints]
        self.switch_off(time)

    @property
    def time(self) -> int:
        """Time in ns that it has been advanced to."""
        return self._time

    @property
    def next_level(self) -> int | None:
        """Stamp of the next level, in ns; None if there is none ahead."""
        return min((x.next_stamp for x in self._schedules if x.next_stamp is not None),
                   default=None)

    @property
    def due(self) -> int | None:
        """When to advance it next, in ns; None for not before a command comes."""
        times = [self.next_level, *(x.due(self._time) for x in self._watchdogs)]
        if self._period:
            times.append(self._next_sample)
        return min((x for x in times if x is not None), default=None)

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """
        Take a level in T that applies from a stamp in ns on; a past one, or 0, at once.

        Raises
        ------
        BadInputError
            If the level is beyond the limit.

        """
        limit = self._joints[joint].limit
        if not abs(level) <= limit:  # not a number is refused, too
            raise BadInputError(f'flux density is {level:g} T: expected at most {limit:g} T')
        self._check_clock(stamp)
        if self._refuses(joint, stamp, level, self._schedules[joint].current):
            return
        changed = self._schedules[joint].insert(stamp, level)
        self._heard[joint] = True
        late = self._time - stamp
        if changed and stamp and late > 0:
            self._note_late(joint, late)

    def advance(self, time: int) -> None:
        """Write what is due at a time in ns, which is now, and read if that is due."""
        if time < self._time:
            # The clock was set back.
            self._next_sample = min(self._next_sample, time)
        self._time = time
        for i, schedule in enumerate(self._schedules):
            self._watch(i)
            self._write(i, schedule.apply_until(self._time))
        if self._period and self._time >= self._next_sample:
            self._next_sample = (self._time // self._period + 1) * self._period
            read = np.array([x.hardware.read(self._time) for x in self._joints])
            self._samples.append(
                Sample(self._time, read[:, 0], read[:, 1], np.array(self._levels)))

    def _watch(self, i: int) -> None:
        schedule = self._schedules[i]
        if self._heard[i]:
            self._heard[i] = False
            self._feed(i, self._time)
        for stamp, level in self._safe_levels(i, self._time, self._time, schedule.current):
            schedule.insert(stamp, level)

    def _write(self, i: int, level: float) -> None:
        if level != self._levels[i]:
            # Not known while an error may leave it anywhere.
            self._levels[i] = math.nan
            stamp = self._joints[i].hardware.write(level, self._time)
            self._levels[i] = level
            self._changes.append(Change(i, stamp, level))

    def switch_off(self, time: int) -> None:
        """
        Switch all coils off at a time in ns, which is now; nothing is ahead.

        Raises
        ------
        Exception
            What the hardware of one has raised, when the others are off.

        """
        self._time = time
        self._schedules = [CommandSchedule(0.0) for _ in self._joints]
        errors = []
        for i in range(len(self._joints)):
            try:
                self._write(i, 0.0)
            except Exception as error:
                errors.append(error)
        if errors:
            raise errors[0]
