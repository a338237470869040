"""The simulated plant as a device: what it does, and when."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from hmsa_ros.device.protocol import Change, Kind, Sample
from hmsa_ros.device.sensor import Sensor, SensorErrors, Transport
from hmsa_ros.device.watchdog import Device, Fallback, GuardedJoint
from hmsa_ros.model.actuators import Actuators, Setup
from hmsa_ros.model.equations import Array
from hmsa_ros.model.simulation import too_large
from hmsa_ros.model.units import NANOSECONDS

# A gap of the clock that is not simulated through but skipped.
_LARGEST_GAP_NS = 5 * NANOSECONDS


@dataclass(frozen=True)
class SimulatedJoint:
    """A simulated actuator, what its watchdog does, and how it is measured."""

    setup: Setup
    fallback: Fallback = field(default_factory=Fallback)
    errors: SensorErrors = field(default_factory=SensorErrors)


class SimulatedDevice(Device):
    """
    Simulated actuators.

    Commands take effect exactly at their stamps, inside the integration.

    Parameters
    ----------
    joints : sequence of SimulatedJoint
        At least one.
    period : int
        Between samples, in ns, at least 1; they lie on a grid from time zero.
    time : int
        Time at the start in ns; its state is the first sample (`next_sample`).
    command_delay, measurement_delay : int
        Transport delays of commands and samples in ns, at least 0.
    seed : int
        Of the sensor's noise.

    """

    def __init__(
            self, joints: Sequence[SimulatedJoint], *, period: int, time: int = 0,
            command_delay: int = 0, measurement_delay: int = 0, seed: int = 0) -> None:
        super().__init__()
        self.guards = [
            GuardedJoint(i, x.fallback, self._notices) for i, x in enumerate(joints)]
        self.period = period
        self.next_sample = time
        self._actuators = Actuators([x.setup for x in joints], time=time)
        self._sensor = Sensor([x.errors for x in joints], measurement_delay, seed)
        self._transit: Transport[tuple[int, int, float]] = Transport(command_delay)
        self._changes += [Change(i, time, self.level(i)) for i in range(len(joints))]

    # -- what there is to see ------------------------------------------------------------------

    @property
    def time(self) -> int:
        """Time in ns that the state belongs to."""
        return self._actuators.time

    @property
    def stretch(self) -> Array:
        """True stretch of each joint."""
        return self._actuators.stretch

    @property
    def coordinates(self) -> list[str]:
        """What the position of each joint is called."""
        return [x.actuator.coordinate.name for x in self._actuators.setups]

    @property
    def rate(self) -> Array:
        """True stretch rate of each joint in 1/s."""
        return self._actuators.rate

    @property
    def setups(self) -> tuple[Setup, ...]:
        """What each joint consists of."""
        return self._actuators.setups

    @property
    def flux_density(self) -> Array:
        """Flux density on each joint in T."""
        return self._actuators.flux_density

    def level(self, joint: int) -> float:
        """Return the last level in T that took effect on a joint."""
        return self._actuators.schedules[joint].current

    def changes(self) -> list[Change]:
        """Return which levels took effect."""
        self._changes += [Change(*x) for x in self._actuators.changes]
        self._actuators.changes.clear()
        return super().changes()

    # -- what drives it ------------------------------------------------------------------------

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """Have a command in T take effect at its stamp in ns (0 for now), or its delay later."""
        self._check_clock(stamp)
        if self._transit.delay:
            self._actuators.setups[joint].check_level(level)
            self._transit.send(self.time, (joint, stamp, level))
        else:
            self._obey(joint, stamp, level)

    def push(self, joint: int, stamp: int, force: float) -> None:
        """Have a force in N act along the field on a joint from a stamp in ns on, 0 for now."""
        self._actuators.force(joint, stamp or self.time, force)

    def _obey(self, joint: int, stamp: int, level: float) -> None:
        self._actuators.setups[joint].check_level(level)
        guard = self.guards[joint]
        if guard.refuses(stamp, level, self.time, self.level(joint)):
            return
        late = self._actuators.command(joint, stamp or self.time, level)
        guard.feed(self.time)
        if late:
            guard.note_late(late)

    # -- time ----------------------------------------------------------------------------------

    def advance(self, time: int) -> None:
        """Simulate up to a time in ns and take the samples on the way."""
        while self.next_sample <= time:
            self._run(self.next_sample)
            self.next_sample += self.period
            actuators = self._actuators
            self._samples += self._sensor.measure(Sample(
                actuators.time, actuators.stretch.copy(), actuators.rate,
                actuators.flux_density))
        if self.time < time:
            self._run(time)

    def _run(self, time: int) -> None:
        """Simulate, with what is known of commands and of silence by then."""
        for known, command in self._transit.arrived(time):
            self._integrate(known)
            self._obey(*command)
        for i, guard in enumerate(self.guards):
            for stamp, level in guard.watch(self.time, time, self.level(i)):
                self._actuators.command(i, stamp, level)
        self._integrate(time)

    def _integrate(self, time: int) -> None:
        """Advance all joints; those whose load is too large start again."""
        for i, reached in self._actuators.advance(time):
            self.guards[i].note(
                Kind.FAILED, f'{too_large(reached, self.level(i))}; the joint starts again from '
                'its initial state')
            self.restart(i)

    def follow(self, now: int, *, standing: bool = False) -> int:
        """Follow a clock (ns), or hold while ``standing``; return by how many ns it jumped."""
        # A device that has not begun, one that is held, and one whose clock jumps goes on from the
        # clock's time; where the clock has jumped back it starts again.
        gap = now - self.time
        if self.time == 0:
            self._go_on_from(now)
            return 0
        if gap < -self.period:
            self._go_on_from(now)
            self._transit.clear()
            for i in range(len(self.guards)):
                self.restart(i)
            return gap
        if standing:
            self._go_on_from(now)
        elif gap > _LARGEST_GAP_NS:
            self._go_on_from(now)
            return gap
        return 0

    def _go_on_from(self, now: int) -> None:
        for guard in self.guards:
            # Time that was not simulated is no silence.
            guard.pass_over(now - self.time)
        self._actuators.time = now
        self.next_sample = -(-now // self.period) * self.period

    # -- beginning anew ------------------------------------------------------------------------

    def restart(self, joint: int, stretch: float | None = None, rate: float = 0.0) -> None:
        """Put a joint back to its initial or another state (rate in 1/s); time goes on."""
        self._actuators.reset(joint, stretch, rate)
        # A first command arms it again.
        self.guards[joint].stand_by()
        self.guards[joint].end_cut_off()
        self._sensor.forget()

    def drop_commands(self) -> None:
        """Lose the commands on their way."""
        self._transit.clear()
