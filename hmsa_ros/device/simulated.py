"""The simulated plant as a device."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from hmsa.model.actuators import Actuators, Setup
from hmsa.model.equations import Array
from hmsa.model.sensor import Delay, Sample, Sensor, SensorErrors
from hmsa.model.simulation import too_large
from hmsa.model.thermal import checked_temperature, HOTTEST
from hmsa.model.units import NANOSECONDS
from hmsa_ros.device.watchdog import Change, Device, Fallback, GuardedJoint, Kind
from hmsa_ros.timekeeping import clock_set_words

# Change of temperature in K from which the simulated parameters follow: 1e-4 of any of them.
_WARMER = 0.01
# Gap of the clock above which time is skipped instead of simulated.
_LARGEST_GAP_NS = 5 * NANOSECONDS


@dataclass(frozen=True)
class SimulatedJoint:
    """A simulated actuator with its watchdog and sensor."""

    setup: Setup
    fallback: Fallback = field(default_factory=Fallback)
    errors: SensorErrors = field(default_factory=SensorErrors)


class SimulatedDevice(Device):
    """
    Simulated actuators.

    Commands take effect exactly at their timestamps, within the integration.

    Parameters
    ----------
    joints : sequence of SimulatedJoint
        At least one.
    period : int
        Sampling period in ns, at least 1; samples lie on a grid from time zero.
    time : int
        Initial time in ns; the initial state is the first sample (`next_sample`).
    command_delay, measurement_delay : int
        Transport delays of commands and samples in ns, at least 0.
    seed : int
        Seed of the sensor noise.

    """

    def __init__(
            self, joints: Sequence[SimulatedJoint], *, period: int, time: int = 0,
            command_delay: int = 0, measurement_delay: int = 0, seed: int = 0) -> None:
        super().__init__()
        self.guards = [
            GuardedJoint(i, x.fallback, self._notices) for i, x in enumerate(joints)]
        self.period = period
        self.next_sample = time
        given = [x.setup for x in joints]
        # Setups at their reference, and temperatures in degrees Celsius, of joints that have both.
        self._cold = {i: x for i, x in enumerate(given) if x.actuator.thermal}
        self.temperatures = {i: x.actuator.thermal.ambient for i, x in self._cold.items()}
        self._warmed = time  # time in ns of these temperatures
        #: Simulated actuators, with their setups and states.
        self.actuators = Actuators([
            x.at_temperature(self.temperatures[i]) if i in self._cold else x
            for i, x in enumerate(given)], time=time)
        self._present = time  # newest time of the clock, which the simulation may lag behind
        self._sensor = Sensor([x.errors for x in joints], measurement_delay, seed)
        self._transit: Delay[tuple[int, int, float]] = Delay(command_delay)
        self._changes += [Change(i, time, self.level(i)) for i in range(len(joints))]

    # -- state ---------------------------------------------------------------------------------

    @property
    def time(self) -> int:
        """Time of the state in ns."""
        return self.actuators.time

    @property
    def stretch(self) -> Array:
        """True stretch of each joint."""
        return self.actuators.stretch

    @property
    def coordinates(self) -> list[str]:
        """Name of the position coordinate of each joint."""
        return [x.actuator.coordinate.name for x in self.actuators.setups]

    def warms(self, joint: int) -> bool:
        """Return whether the coil of a joint warms it."""
        return joint in self._cold and self._cold[joint].actuator.thermal.rise > 0.0

    @property
    def flux_density(self) -> Array:
        """Flux density on each joint in T."""
        return self.actuators.flux_density

    def level(self, joint: int) -> float:
        """Return the last level in T that took effect on a joint."""
        return self.actuators.schedules[joint].current

    def changes(self) -> list[Change]:
        """Return the levels that took effect since the last call."""
        self._changes += [Change(*x) for x in self.actuators.changes]
        self.actuators.changes.clear()
        return super().changes()

    # -- inputs --------------------------------------------------------------------------------

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """Apply a command in T at its timestamp in ns (0 for now), or after its delay."""
        self._check_clock(stamp)
        if self._transit.delay:
            self.actuators.setups[joint].check_level(level)
            self._transit.put(self.time, (joint, stamp, level))
        else:
            self._obey(joint, stamp, level)

    def push(self, joint: int, stamp: int, force: float) -> None:
        """Apply a force in N along the field to a joint from a timestamp in ns on, 0 for now."""
        self.actuators.force(joint, stamp or self.time, force)

    def set_temperature(self, joint: int, temperature: float) -> None:
        """
        Continue with the parameters of a joint at a temperature in degrees Celsius.

        Raise `BadInputError` for an impossible temperature.
        """
        if joint in self._cold:
            self.actuators.set_temperature(
                joint, self._cold[joint], checked_temperature(temperature))
            self.temperatures[joint] = temperature

    def _warm(self, time: int) -> None:
        """Have the coils warm the joints up to a time in ns."""
        seconds, self._warmed = (time - self._warmed) / NANOSECONDS, max(time, self._warmed)
        for i, cold in self._cold.items():
            if not self.warms(i) or seconds <= 0.0:
                continue
            warm = cold.actuator.thermal.warmed(
                self.temperatures[i], float(self.flux_density[i]), seconds)
            self.temperatures[i] = min(warm, HOTTEST)
            if abs(self.temperatures[i] - (
                    self.actuators.setups[i].actuator.thermal.reference)) > _WARMER:
                self.actuators.set_temperature(i, cold, self.temperatures[i])

    def _obey(self, joint: int, stamp: int, level: float) -> None:
        self.actuators.setups[joint].check_level(level)
        guard = self.guards[joint]
        if guard.refuses(stamp, level, self.time, self.level(joint)):
            return
        late = self.actuators.command(joint, stamp or self.time, level)
        came = min(stamp, self._present) if stamp else self._present
        guard.feed(max(self.time, came), stamp)
        if late:
            guard.note_late(late)

    # -- time ----------------------------------------------------------------------------------

    def advance(self, time: int) -> None:
        """Simulate up to a time in ns, and take the samples that are due."""
        while self.next_sample <= time:
            self._run(self.next_sample)
            self.next_sample += self.period
            actuators = self.actuators
            self._samples += self._sensor.measure(Sample(
                actuators.time, actuators.stretch.copy(), actuators.rate,
                actuators.flux_density))
        if self.time < time:
            self._run(time)

    def _run(self, time: int) -> None:
        """Simulate to a time, with the commands and watchdogs that act before it."""
        for known, command in self._transit.arrived(time):
            self._integrate(known)
            self._obey(*command)
        # The safe flux, where a watchdog demands it.
        for i, guard in enumerate(self.guards):
            for stamp, level in guard.watch(self.time, time, self.level(i)):
                self.actuators.command(i, stamp, level)
        self._integrate(time)

    def _integrate(self, time: int) -> None:
        """Advance all joints; those with an excessive load restart."""
        if self._cold:
            self._warm(time)
        for i, reached in self.actuators.advance(time):
            self.guards[i].note(
                Kind.FAILED, f'{too_large(reached, self.level(i))}; the joint starts again from '
                'its initial state')
            self.restart(i)

    def follow(self, now: int, *, standing: bool = False) -> int:
        """Follow a clock (ns), or wait while ``standing``; return any clock jump in ns."""
        # Before the first time, while standing and after a jump ahead, the device continues from
        # the clock's time; after a jump back, it restarts.
        gap = now - self.time
        self._present = now
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

    def stood_still(self, span: int) -> None:
        """
        Record that this process stood still for some ns until now.

        The simulation then catches up: commands that have waited apply at their timestamps, and
        feed the watchdog at them.
        """
        self._present = max(self._present, self.time + span)

    def clock_set(self, by: int) -> None:
        """Shift all times by the ns that the clock was set ahead; the motion continues."""
        self.actuators.clock_set(by)
        self._present += by
        self._warmed += by
        # Samples lie on a grid of the new time.
        self.next_sample = -(-(self.next_sample + by) // self.period) * self.period
        self._transit.shift(by)
        self._sensor.shift(by)
        for guard in self.guards:
            guard.clock_set(by)
        self.guards[0].note(
            Kind.CLOCK, clock_set_words(by, 'the simulation and levels ahead continue'))

    def _go_on_from(self, now: int) -> None:
        for guard in self.guards:
            # Time that was not simulated does not count as silence.
            guard.pass_over(now - self.time)
        self.actuators.time = self._warmed = now
        self.next_sample = -(-now // self.period) * self.period

    # -- restart -------------------------------------------------------------------------------

    def restart(self, joint: int, stretch: float | None = None, rate: float = 0.0) -> None:
        """Reset a joint to its initial or another state (rate in 1/s); time continues."""
        self.actuators.reset(joint, stretch, rate)
        # The next command arms it again.
        self.guards[joint].stand_by()
        self.guards[joint].end_cut_off()
        self._sensor.forget()

    def drop_commands(self) -> None:
        """Discard the commands in transit."""
        self._transit.clear()
