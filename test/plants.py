"""An actuator that reports the levels that take effect."""

import math

from hmsa.model.equations import natural_frequency
from hmsa.model.simulation import ActuatorSimulation


class Plant(ActuatorSimulation):
    """An actuator that obeys a planner."""

    def go_on(self, time):
        """Advance to a time, and yield each change of level: its time and the level."""
        while (stamp := self.schedule.next_stamp) is not None and stamp <= time:
            before = self.schedule.current
            self.advance(stamp)
            if self.schedule.current != before:
                yield self.time, self.schedule.current
        self.advance(time)

    def residual(self, stretch):
        """Return the deviation from rest at a stretch."""
        frequency = float(natural_frequency(stretch, self.actuator.nondimensional))
        return math.hypot(
            self.stretch - stretch, self.rate * self.actuator.time_unit / frequency)
