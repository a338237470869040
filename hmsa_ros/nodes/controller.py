"""
Planner and plant, or driver, in one process, with one loop and no middleware between them.

Both nodes exist with their names, topics, services and parameters. Commands reach the device and
samples reach the planner in the cycle in which they are created. Publishing, judging and planning
follow while nothing else is due.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
import gc
from time import monotonic_ns, thread_time_ns

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from hmsa.interfaces import topics
from hmsa.model.sensor import Sample
from hmsa.model.units import NANOSECONDS
from hmsa_ros.device.watchdog import Change
from hmsa_ros.nodes import conversions, ros_entities
from hmsa_ros.nodes.device_node import DeviceNode, TICK_SECONDS
from hmsa_ros.nodes.driver import DriverNode, HARDWARE, SHORT
from hmsa_ros.nodes.managed import run
from hmsa_ros.nodes.planner import PlannerNode
from hmsa_ros.nodes.plant import PlantNode
from hmsa_ros.runtime.records import Clock, ObservedSample, Output, Send, Severity
from hmsa_ros.timekeeping import steady_ns

# Time in ns that must remain of a period to publish one more message; limit on waiting messages.
_ENOUGH, _CROWDED = 400_000, 50
# Number of cycles whose processor times are stored.
_REMEMBERED = 4096


class LinkedPlanner(PlannerNode):
    """A planner linked to a device in the same process."""

    linked = True

    def __init__(self) -> None:
        self.plant: Linked | None = None
        self._last = 0
        self._seen: tuple[Sequence[str], Sample] | None = None
        self._waiting: deque[Output] = deque()
        super().__init__()

    @property
    def drives_hardware(self) -> bool:
        """Whether the parameters for all nodes of the process name hardware."""
        given = self._parameter_overrides
        return any(x in given and given[x].value for x in (HARDWARE.name, SHORT))

    def pass_on(self) -> None:
        """Pass the commands that are due to the device."""
        if self._channels:
            self._take(self._runtime.send(self.now()))

    def serve(self, left: Callable[[], bool]) -> None:
        """Do the work that is due; publish at least one message, and more while there is time."""
        self._serve()
        if self._channels:
            self._runtime.serve_by(steady_ns() + round(TICK_SECONDS * NANOSECONDS))
        while self._waiting:
            self._publish(self._waiting.popleft())
            if not left() and len(self._waiting) < _CROWDED:
                return

    def serve_if_due(self) -> None:
        """Do the work that is due, if any."""
        wake = self._runtime.wake
        if wake is not None and wake <= self.now():
            self._serve()

    def take_change(self, joint: str, change: Change) -> None:
        """Record that a level has taken effect."""
        self._runtime.applied(joint, change.stamp, change.level)

    def take_sample(self, joints: Sequence[str], sample: Sample) -> None:
        """Process a sample of all joints."""
        self._seen = joints, sample
        self._runtime.sampled(joints, [sample])

    def take_refusal(self, joint: str, refuses: str, cut_off_time: int) -> None:
        """Record why commands of a joint are rejected, as in a receipt."""
        self._runtime.cut_off(
            joint, in_force=bool(refuses), locked=refuses == conversions.INTERLOCK,
            time=cut_off_time)

    def _glance(self) -> Iterator[tuple[str, ObservedSample]]:
        if self._seen is not None:
            joints, sample = self._seen
            self._seen = None
            for name, *measured in zip(
                    joints, *(x.tolist() for x in sample[1:]), strict=True):
                yield name, ObservedSample(sample.time, *measured)

    def now(self) -> int:
        """Return the time in ns, from the plant if that publishes the clock."""
        time = None if self.plant is None or not self.simulated else self.plant.leading_time
        if time is None:
            return super().now()
        last, self._last = self._last, time
        if time < last:
            self._runtime.clock_set_back(last - time)
        return time

    def _one_clock(self) -> bool:
        return True

    def _observable(self) -> bool:
        return self.plant is not None and self.plant.active

    def _unheard(self) -> str:
        if self.plant is not None and self.plant.active:
            return self.plant.trouble
        return 'the plant or driver of this process is not active: activate it'

    def cleanup(self) -> None:
        """Publish the waiting messages, and drop the plans."""
        self.serve(lambda: True)
        super().cleanup()

    def close(self) -> None:
        """Publish the waiting messages too."""
        super().close()
        while self._waiting and self.context.ok():
            self._publish(self._waiting.popleft())

    def _take(self, outputs: Iterable[Output]) -> None:
        for output in outputs:
            if isinstance(output, Send) and self.plant is not None:
                self.plant.command(output)
            self._waiting.append(output)
        if self.plant is not None and self.plant.leading_time is not None:
            # Simulated time may advance far until the cycle ends.
            super()._take(self._waiting)
            self._waiting.clear()


class Cycles:
    """
    Measure the cycles of a loop, each run in this context manager; all times are in ns.

    ``late`` counts the cycles that began more than a period after they were due.
    """

    def __init__(
            self, period: int, *, steady: Clock = monotonic_ns,
            cpu: Clock = thread_time_ns) -> None:
        self.count = self.late = self.largest = 0
        self._period, self._steady, self._cpu = period, steady, cpu
        self._work = np.zeros(_REMEMBERED, dtype=np.int64)
        self._rest = np.zeros(_REMEMBERED, dtype=np.int64)
        self._due = self._begun = self._ended = 0
        self._reported = 0, 0

    def __enter__(self) -> None:
        now = self._steady()
        lateness = now - self._due if self.count else 0
        if lateness > self._period:
            self.late += 1
            self.largest = max(self.largest, lateness)
        # The grid is that of the first cycles; missed cycles are skipped.
        self._due = now + self._period - (
            lateness if 0 < lateness <= self._period else 0)
        self._begun = self._cpu()

    def __exit__(self, *_: object) -> None:
        self._ended = self._cpu()
        self._work[self.count % _REMEMBERED] = self._ended - self._begun
        self.count += 1

    @property
    def left(self) -> int:
        """Time until the next cycle is due; negative if it is late."""
        return self._due - self._steady()

    def note_rest(self) -> None:
        """Record the processor time spent since the last cycle ended."""
        self._rest[(self.count - 1) % _REMEMBERED] = self._cpu() - self._ended

    def _figures(self, name: str, spent: NDArray[np.int64]) -> dict[str, object]:
        """Return median, 99 % quantile and maximum of recent processor times in us."""
        # Not by np.quantile, whose first call imports numpy.ma: 20 ms without a command.
        seen = np.sort(spent[:max(self.count, 1)])
        return {f'{name}_{key}_us': f'{float(seen[round(x * (len(seen) - 1))]) / 1e3:.1f}'
                for key, x in (('p50', 0.5), ('p99', 0.99), ('largest', 1.0))}

    def report(self) -> tuple[Severity, str, dict[str, object]]:
        """Return severity and message for the cycles since the last call, and counters."""
        count, late = self.count - self._reported[0], self.late - self._reported[1]
        self._reported = self.count, self.late
        message = f'{late} of {count} cycles late' if late else 'cycles in time'
        return Severity.WARN if late else Severity.OK, message, {
            'cycles': self.count, 'late': self.late,
            'largest_lateness_ms': f'{self.largest / 1e6:.3f}',
            **self._figures('work', self._work), **self._figures('rest', self._rest)}


class Linked(DeviceNode):
    """A device commanded by a planner in the same process; first base class of such nodes."""

    def __init__(self, planner: LinkedPlanner) -> None:
        self._planner = planner
        self.companion = planner.get_fully_qualified_name()
        self.cycles = Cycles(round(TICK_SECONDS * 1e9))
        super().__init__()  # type: ignore[call-arg]  # the constructor of the device node
        planner.plant = self
        self._of_loop = ros_entities.publisher(self, topics.DIAGNOSTICS)
        self.keep(
            self.every(TICK_SECONDS, self._cycle), self.every(1.0, self._report_loop),
            self._of_loop)

    def command(self, command: Send) -> None:
        """Apply a command of the planner."""
        for joint in self._joints:
            if joint.name == command.joint:
                joint.command(command.stamp, command.flux_density)

    def _cycle(self) -> None:
        """Advance the device and send commands; then publish, poll and serve the planner."""
        if self._joints and self.reads_first():
            self._poll_commands()
            return
        with self.cycles:
            if self._joints:
                self._go_on()
                for joint in self._joints:
                    self._planner.take_refusal(joint.name, joint.refuses, joint.cut_off_time)
            self._planner.pass_on()
        if self._joints:
            self._poll_commands()
            self._publish_news()
        self._planner.serve(lambda: self.cycles.left > _ENOUGH)
        self.cycles.note_rest()

    def _publish_change(self, change: Change) -> None:
        self._planner.take_change(self._joints[change.joint].name, change)
        super()._publish_change(change)

    def _publish_sample(self, sample: Sample) -> None:
        self._planner.take_sample(self.values.names, sample)
        super()._publish_sample(sample)

    def _report_loop(self) -> None:
        """Publish the timing of the loop; garbage is collected now, between two cycles."""
        gc.collect()
        severity, message, values = self.cycles.report()
        self._of_loop.publish(conversions.to_diagnostics(
            self.now(), conversions.to_status('controller: loop', '', severity, message, values)))


class LinkedPlant(Linked, PlantNode):
    """A plant commanded by a planner in the same process."""

    def _sample(self) -> None:
        self._advance()
        if self.leading_time is not None:
            # Simulated time may advance far in one cycle, and the planner needs each sample.
            self._publish_news()
            self._planner.serve_if_due()


class LinkedDriver(Linked, DriverNode):
    """A driver of hardware commanded by a planner in the same process."""


def make() -> Sequence[Node]:
    """Create planner and plant, or driver; from now on only the loop collects garbage."""
    planner = LinkedPlanner()
    device = LinkedDriver(planner) if planner.drives_hardware else LinkedPlant(planner)
    gc.disable()
    return device, planner


#: Run by ``hmsa controller`` with the command line's arguments; returns the exit status.
main = partial(run, make)
