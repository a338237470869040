"""A thread that tells a driver of hardware the time, whenever something is due."""

from collections.abc import Callable
import sys
from threading import Condition, Thread

from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.device.hardware import HardwareDevice
from hmsa_ros.device.protocol import Change, Notice, Sample
from hmsa_ros.errors import excerpt, HmsaError

# In ns: a thread that sleeps wakes up late, by some 50 us, and then waits for Python's lock. It
# gets that within the switch interval, and keeps it as long: both are this time before a level.
_WATCHED = 250_000


class HardwareWorker:
    """
    A device of hardware that lets time run by itself, by a clock in ns, for one other thread.

    ``failure`` says why it has ended by itself: an error of the hardware. The coils are switched
    off then, as far as the hardware still obeys.
    """

    def __init__(self, device: HardwareDevice, clock: Callable[[], int]) -> None:
        self._device, self._clock = device, clock
        self._turn = Condition()
        self._ended = False
        self.failure: HmsaError | None = None
        sys.setswitchinterval(_WATCHED / NANOSECONDS)
        self._thread = Thread(target=self._work, name='hardware', daemon=True)
        self._thread.start()

    @property
    def time(self) -> int:
        """Time in ns at which it last looked after the hardware."""
        return self._device.time

    @property
    def silent(self) -> list[int]:
        """Joints that nobody commands any more."""
        return self._device.silent

    @property
    def cut_offs(self) -> list[int]:
        """Joints whose levels of before a cut-off are refused."""
        return self._device.cut_offs

    @property
    def trips(self) -> int:
        """How often a joint fell silent."""
        return self._device.trips

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """Have the device take a level in T that applies from a stamp in ns on."""
        with self._turn:
            self._advance()
            self._device.receive(joint, stamp, level)
            self._turn.notify()

    def changes(self) -> list[Change]:
        """Return which levels took effect."""
        with self._turn:
            return self._device.changes()

    def samples(self) -> list[Sample]:
        """Return what was measured."""
        with self._turn:
            return self._device.samples()

    def notices(self) -> list[Notice]:
        """Return what there is to log."""
        with self._turn:
            return self._device.notices()

    def switch_off(self) -> None:
        """Switch all coils off; nothing is ahead."""
        with self._turn:
            self._guarded(lambda: self._device.switch_off(self._clock()))

    def close(self) -> None:
        """Switch all coils off and end; may be called again."""
        with self._turn:
            self._ended = True
            self._turn.notify()
        self._thread.join()
        self.switch_off()

    def _work(self) -> None:
        """Look after the hardware whenever something is due, and sleep until then."""
        with self._turn:
            while not self._ended:
                self._advance()
                self._wait()

    def _wait(self) -> None:
        """Sleep until something is due; the last of the time to a level is watched instead."""
        due, level = self._device.due, self._device.next_level
        if due is None:
            self._turn.wait()
            return
        left = due - self._clock()
        if due != level:
            self._turn.wait(max(left, 0) / NANOSECONDS)
        elif left > _WATCHED:
            self._turn.wait((left - _WATCHED) / NANOSECONDS)
        else:
            while self._clock() < due:
                pass

    def _advance(self) -> None:
        if not self._ended:
            self._guarded(lambda: self._device.advance(self._clock()))

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do something with the hardware; at its first error end, with the coils switched off."""
        try:
            work()
        except Exception as error:  # whatever a laboratory's code raises
            self._ended = True
            if self.failure is None:
                self.failure = HmsaError(
                    f'the hardware failed ({type(error).__name__}: {excerpt(str(error))}) and is '
                    'switched off: mend it, then start the driver again')
                self.switch_off()
