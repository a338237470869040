"""What a driver has to do with hardware; here a simulated block on the bench takes its place."""

from time import time_ns

from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation


class Bench:
    """The coil's amplifier and the sensor of the stretch of one joint."""

    def __init__(self, joint: str) -> None:
        self.block = ActuatorSimulation(paper_actuator(), time=time_ns())

    def write(self, level: float, now: int) -> int:
        """Set the coil to a flux density in T; return when it took effect, in ns."""
        now = max(now, self.block.time)
        self.block.command(now, level)
        return now

    def read(self, now: int) -> tuple[float, float]:
        """Return stretch and stretch rate in 1/s."""
        self.block.advance(max(now, self.block.time))
        return self.block.stretch, self.block.rate
