"""
The controller beside a device in one loop, in simulated time and as fast as that goes.

What runs is `hmsa_ros.control.planner.PlannerRuntime`, which nodes drive too; the loop hands it
the time, what took effect and what was measured.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from hmsa_ros.control.planner import PlannerRuntime
from hmsa_ros.control.records import Output, Send, Settings
from hmsa_ros.control.surroundings import Surroundings
from hmsa_ros.model.equations import Array
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.group import PlannerGroup

# How long to wait, in ns, where there is something to do that has to wait.
_PATIENCE = NANOSECONDS // 1000


class SimulatedDevice(Protocol):
    """What carries out commands; times in ns, fields in T, joints by number."""

    @property
    def time(self) -> int:
        """Time that it has been advanced to."""

    @property
    def next_sample(self) -> int:
        """When it measures next."""

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """Take a level from a stamp on."""

    def advance(self, time: int) -> None:
        """Do what is due up to a time."""

    def changes(self) -> Sequence[tuple[int, int, float]]:
        """Return which levels took effect: joint, stamp and level."""

    def samples(self) -> Sequence[tuple[int, Array, Array, Array]]:
        """Return what was measured: stamp, and stretch, rate (1/s) and field of each joint."""


class Loop:
    """
    Runs a controller and a device.

    Parameters
    ----------
    group : PlannerGroup
        The planners, in the order of the device's joints.
    settings : Settings
        Of the controller.
    device : SimulatedDevice
        What it commands; its time is that of the loop.

    """

    def __init__(
            self, group: PlannerGroup, settings: Settings, device: SimulatedDevice) -> None:
        self.now = device.time  #: in ns
        self.device = device
        self.runtime = PlannerRuntime(
            group, settings, Surroundings(
                clock=lambda: self.now, steady=lambda: self.now, one_clock=lambda: True))
        self.runtime.active = True
        #: Called with all that the controller says.
        self.tell: Callable[[Output], None] = lambda output: None
        self._names = list(group.planners)

    def run(self, until: int) -> None:
        """Go on until a time in ns."""
        while self.now < until:
            self.serve()
            wakes = [self.runtime.wake, self.runtime.group.next_command()]
            if wakes[0] is not None and wakes[0] <= self.now:
                # There is more to do, which may have to wait.
                self.serve()
                wakes = [self.now + _PATIENCE, self.runtime.group.next_command()]
            self.now = min(
                until, max(self.device.next_sample, self.now + 1),
                *(x for x in wakes if x is not None and x > self.now))
            self._follow()

    def serve(self) -> None:
        """Do what is due now."""
        for output in self.runtime.tick(self.now):
            if isinstance(output, Send):
                self.device.receive(
                    self._names.index(output.joint), output.stamp, output.flux_density)
            self.tell(output)

    def _follow(self) -> None:
        """Let the device act up to now, and take in what came of it."""
        self.device.advance(self.now)
        self.now = max(self.now, self.device.time)
        for joint, stamp, level in self.device.changes():
            self.runtime.applied(self._names[joint], stamp, level)
        for stamp, *measured in self.device.samples():
            if self.runtime.looks_at(stamp):
                for name, *values in zip(
                        self._names, *(x.tolist() for x in measured), strict=True):
                    self.runtime.observed(name, stamp, *values)
