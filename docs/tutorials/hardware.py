"""What a driver has to do with hardware; here a simulated block on the bench takes its place."""

from hmsa_ros.core.parameters import paper_actuator
from hmsa_ros.core.simulation import ActuatorSimulation


class Bench:
    """The coil's amplifier and the sensor of the stretch."""

    def __init__(self, now: int) -> None:
        self.block = ActuatorSimulation(paper_actuator(), time=now)

    def write(self, level: float, now: int) -> int:
        """Set the coil to a flux density in T; return when it took effect, in ns."""
        self.block.command(now, level)
        return now

    def read(self, now: int) -> tuple[float, float]:
        """Return stretch and stretch rate in 1/s."""
        self.block.advance(max(now, self.block.time))
        return self.block.stretch, self.block.rate
