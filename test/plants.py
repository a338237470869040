"""An actuator that reports the levels that take effect, in SI units, and changes of planners."""

import math

from hmsa.model.equations import acceleration, natural_frequency
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


def acceleration_si(stretch, rate, flux_density, actuator):
    """Return the second derivative of the stretch in 1/s^2, Eq. 10; rate in 1/s, field in T."""
    unit = actuator.time_unit
    return acceleration(
        stretch, rate * unit, flux_density / actuator.flux_density_unit,
        actuator.nondimensional) / unit ** 2


def set_options(planner, options, actuator=None):
    """Have the next requests planned with other options or for another block, after checks."""
    planner.take_model(planner.checked_model(options, actuator or planner.model.actuator))
