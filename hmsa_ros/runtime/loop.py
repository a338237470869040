"""
Run the controller and a device in one loop, in simulated time, as fast as possible.

The controller is `hmsa_ros.runtime.runtime.Runtime`, as in the nodes. The loop passes it
the time, the applied levels, the cut-offs and the samples.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from hmsa.model.sensor import Sample
from hmsa.model.units import NANOSECONDS
from hmsa.planning.group import PlannerGroup
from hmsa_ros.device.watchdog import GuardedJoint
from hmsa_ros.runtime.records import Environment, Output, Send, Settings
from hmsa_ros.runtime.runtime import Runtime

# Time to wait, in ns, while the controller waits for something.
_PATIENCE = NANOSECONDS // 1000


class LoopDevice(Protocol):
    """What the loop needs of a device, as of `hmsa_ros.device.simulated.SimulatedDevice`."""

    @property
    def time(self) -> int:
        """Time in ns that the device has been advanced to."""

    @property
    def next_sample(self) -> int:
        """Time in ns to advance the device to next."""

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """Accept a level in T from a timestamp in ns on."""

    def advance(self, time: int) -> None:
        """Do the work due up to a time in ns."""

    def changes(self) -> Sequence[tuple[int, int, float]]:
        """Return joint, time and level of what took effect since the last call."""

    def samples(self) -> Sequence[Sample]:
        """Return the samples since the last call."""


class Loop:
    """
    Run a controller and a device.

    Parameters
    ----------
    group : PlannerGroup
        The planners, in the order of the device's joints.
    settings : Settings
        Settings of the controller.
    device : LoopDevice
        The device to command; its time is that of the loop.
    guards : sequence of GuardedJoint, optional
        The guards of its joints, if it rejects commands after a cut-off.

    """

    def __init__(
            self, group: PlannerGroup, settings: Settings, device: LoopDevice,
            guards: Sequence[GuardedJoint] = ()) -> None:
        self.now = device.time  #: in ns
        self.device, self._guards = device, guards
        self.runtime = Runtime(
            group, settings, Environment(
                clock=lambda: self.now, steady=lambda: self.now, one_clock=lambda: True))
        self.runtime.active = True
        #: Called with each output of the controller.
        self.deliver: Callable[[Output], None] = lambda output: None
        self._names = list(group.planners)

    def run(self, until: int) -> None:
        """Run until a time in ns."""
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
        """Do the work that is due now."""
        for output in self.runtime.tick(self.now):
            if isinstance(output, Send):
                self.device.receive(
                    self._names.index(output.joint), output.stamp, output.flux_density)
            self.deliver(output)

    def _follow(self) -> None:
        """Advance the device to now, and pass on its changes and samples."""
        self.device.advance(self.now)
        self.now = max(self.now, self.device.time)
        for joint, stamp, level in self.device.changes():
            self.runtime.applied(self._names[joint], stamp, level)
        for guard in self._guards:
            self.runtime.cut_off(
                self._names[guard.number], in_force=guard.is_cut_off, time=guard.cut_off_time)
        self.runtime.sampled(self._names, self.device.samples())
