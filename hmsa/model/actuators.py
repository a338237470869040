"""
Several actuators over time in SI units, advanced together by one compiled call.

Time is integer nanoseconds, so that it does not drift. Each actuator is integrated separately,
from one change of its drive to the next: events of one actuator do not affect the numbers of
another, and an actuator alone moves bit for bit as it does among others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import NDArray

from hmsa import motion
from hmsa.errors import BadInputError, check_number
from hmsa.model import law
from hmsa.model.delivery import CommandSchedule
from hmsa.model.equations import Array, stretch_limits
from hmsa.model.parameters import ActuatorParameters, NondimensionalParameters
from hmsa.model.units import NANOSECONDS

#: Relative tolerance of the integration.
RTOL = 1e-13
_NEVER = np.iinfo(np.int64).max
# Larger loads are indistinguishable from the limit.
_LARGEST_LOAD = 1e9


def unheld(material: NondimensionalParameters) -> str:
    """Return a sentence on stretches that cannot be held, as the force falls; empty if none."""
    if material.law is None:
        return ''
    sides = [
        f'{words} {limit:.4f}' for words, limit, end in zip(
            ('below', 'above'), stretch_limits(material), material.law.limits, strict=True)
        if limit != end]
    return sides and (
        f'no field holds {material.coordinate.plural} {" and ".join(sides)}, where law '
        f'{material.law.law} has a falling force') or ''


@dataclass(frozen=True)
class Setup:
    """
    One actuator with its amplifier and coil; it starts at rest, with relaxed branches.

    An amplifier with a slew limit ramps to a commanded level; a coil with a time constant
    follows the amplifier as a first-order lag. Both together give a lagged ramp.
    """

    actuator: ActuatorParameters
    stretch: float = 1.0  #: initial stretch, held by its flux density
    slew_limit: float = math.inf  #: of the amplifier in T/s, above 0; infinite for steps
    coil_time_constant: float = 0.0  #: in s; 0 for no lag

    def __post_init__(self) -> None:
        """Check the values."""
        self.actuator.nondimensional.check(self.stretch, 'initial stretch')
        check_number('slew limit', self.slew_limit, 'T/s', above=0.0, endless=True)
        check_number('time constant of the coil', self.coil_time_constant, 's', least=0.0)

    def at_temperature(self, temperature: float) -> 'Setup':
        """Return it at a temperature in degrees Celsius, unchanged without coefficients."""
        actuator = self.actuator.at_temperature(temperature)
        if actuator is self.actuator:
            return self
        return replace(
            self, actuator=actuator,
            coil_time_constant=self.actuator.thermal.coil_time_constant(
                self.coil_time_constant, temperature))

    def holding(self, stretch: float) -> float:
        """Return the flux density in T that holds a stretch."""
        return float(
            self.actuator.units.level(
                law.elastic_force(stretch, self.actuator.nondimensional.packed)))

    def check_level(self, flux_density: float) -> None:
        """Raise `BadInputError` for a level in T that is too large to simulate."""
        units = self.actuator.units
        _check_load('flux density', flux_density, units.load_name.strip(), units.load)

    def check_force(self, force: float) -> None:
        """Raise `BadInputError` for a disturbing force in N that is too large to simulate."""
        _check_load('disturbing force', force, 'N', 1.0 / self.actuator.load_per_newton)


def _check_load(name: str, value: float, unit_name: str, unit: float) -> None:
    """Raise `BadInputError` for a value with too large a load; ``unit`` is the value of load 1."""
    if not abs(value / unit) < _LARGEST_LOAD:
        raise BadInputError(
            f'{name} is {value:g} {unit_name}: expected a finite value below '
            f'{_LARGEST_LOAD * unit:g} {unit_name}')


class Actuators:
    """
    Actuators that accept timestamped commands and forces, and advance together to a time in ns.

    For each actuator, ``schedules`` and ``forces`` contain the present and future levels in T and
    disturbing forces in N. ``changes`` lists actuator, time in ns and level in T of each change
    that has taken effect; the reader of the list clears it.
    """

    def __init__(self, setups: Sequence[Setup], *, time: int = 0) -> None:
        """Start at rest."""
        self.setups = tuple(setups)
        self.time = time
        blocks = [x.actuator for x in self.setups]
        count = len(blocks)
        self._time_units, self._units, self._lags = np.ones((3, count))
        self._scales = [x.units for x in blocks]
        self._per_newton = [0.0] * count
        self._slews = [0.0] * count
        self._material = law.stack([x.nondimensional.packed for x in blocks])
        self._state = np.zeros((count, 3))
        self._drive = np.zeros((count, 4))
        self._levels = np.zeros(count)  # of the amplifiers, in T
        self._events = np.full(count, _NEVER)
        self._durations = np.zeros(count)
        self._status = np.zeros(count, np.int64)
        self._all = np.ones(count, bool)
        self._branches = np.zeros((
            count if any(len(x.nondimensional.rows) for x in blocks) else 0, motion.ROWS,
            motion.BRANCH))
        # Actuators with secondary modes, and the place of the first row of these.
        self._modes: dict[int, tuple[NondimensionalParameters, int]] = {}
        for i, setup in enumerate(self.setups):
            self._describe(i, setup)
            self.limit_slew(i, math.inf)
        self.schedules = [CommandSchedule(0.0) for _ in blocks]
        self.forces = [CommandSchedule(0.0) for _ in blocks]
        self.changes: list[tuple[int, int, float]] = []
        for i in range(count):
            self.reset(i)
        self.changes.clear()

    def _describe(self, i: int, setup: Setup) -> None:
        """Take the scales and the material of one."""
        block, group = setup.actuator, setup.actuator.nondimensional
        self._time_units[i], self._units[i] = block.time_unit, block.flux_density_unit
        self._scales[i], self._per_newton[i] = block.units, block.load_per_newton
        self._lags[i] = setup.coil_time_constant / block.time_unit
        self._material[i, :len(group.packed)] = group.packed
        if len(self._branches):
            self._branches[i, :len(group.rows)] = group.rows
        if group.modes.ratios:
            self._modes[i] = group, len(group.branches)

    def set_temperature(self, i: int, setup: Setup, temperature: float) -> None:
        """
        Continue the motion of one with the parameters of a setup at a temperature.

        ``setup`` has the values at its reference, the temperature is in degrees Celsius.
        """
        before, flux = self.setups[i].actuator, float(self.flux_density[i])
        now = setup.at_temperature(temperature)
        if now.actuator == before:
            return
        followed = self._branches[i, :, motion.FOLLOWER].copy() if len(self._branches) else None
        self.setups = (*self.setups[:i], now, *self.setups[i + 1:])
        self._describe(i, now)
        # Rates are in units of time.
        slower = now.actuator.time_unit / before.time_unit
        self._state[i, 1] *= slower
        self._slews[i] *= slower * before.flux_density_unit / now.actuator.flux_density_unit
        if followed is not None:
            self._branches[i, :, motion.FOLLOWER] = followed
            if i in self._modes:
                group, place = self._modes[i]
                self._branches[
                    i, place + 1:place + 2 * len(group.modes.ratios):2, motion.FOLLOWER] *= slower
        # The field does not jump; a ramp goes on at the next step.
        self._drive[i] = 0.0
        if self._lags[i] > 0.0:
            self._drive[i, 2] = (flux - self._levels[i]) / self._units[i]
        self._begin_piece(i)

    def __len__(self) -> int:
        """Return the number of actuators."""
        return len(self.setups)

    # -- state ---------------------------------------------------------------------------------

    @property
    def stretch(self) -> Array:
        """Stretch of each; a view unless there are secondary modes."""
        return self._observed(motion.STRETCH)

    @property
    def rate(self) -> Array:
        """Stretch rate of each in 1/s."""
        rates: Array = self._observed(motion.RATE) / self._time_units
        return rates

    def _observed(self, place: int) -> Array:
        """Return stretches or dimensionless rates of all modes together."""
        seen: Array = self._state[:, place]
        if self._modes:
            seen = seen.copy()
            for i, (material, count) in self._modes.items():
                seen[i] = material.observed(
                    self._state[i, 0], self._state[i, 1], self._branches[
                        i, count:count + 2 * len(material.modes.shares), motion.FOLLOWER])[place]
        return seen

    @property
    def flux_density(self) -> Array:
        """Flux density at each in T."""
        drive = self._drive
        field: Array = self._levels + (drive[:, 2] - drive[:, 1] * self._lags) * self._units
        return field

    def reset(self, i: int, stretch: float | None = None, rate: float = 0.0) -> None:
        """Reset one to its initial or another stretch, held by its flux density."""
        setup = self.setups[i]
        stretch = setup.stretch if stretch is None else stretch
        self.set_state(i, stretch, rate, setup.holding(stretch))

    def set_state(
            self, i: int, stretch: float, rate: float, flux_density: float,
            level: float | None = None) -> None:
        """
        Set another state of one, with relaxed branches, no commands ahead and no force.

        The rate is in 1/s; ``level`` (T) is the level to which the amplifier still ramps, by
        default the present flux density. Raise `BadInputError` if the state is out of range.
        """
        self.setups[i].actuator.nondimensional.check(stretch)
        check_number('stretch rate', rate, '1/s')
        level = flux_density if level is None else level
        self._state[i] = stretch, rate * self._time_units[i], 0.0
        if len(self._branches):
            self._branches[i, :, motion.FOLLOWER] = law.elastic_force(
                stretch, self._material[i])
            if i in self._modes:
                material, count = self._modes[i]
                number = len(material.modes.ratios)
                self._branches[i, count:count + 2 * number, motion.FOLLOWER] = (
                    (stretch, rate * self._time_units[i]) * number)
        # The amplifier of a lagging coil may have arrived before the field; that of another not.
        behind = self._lags[i] > 0.0
        self._levels[i] = level if behind and math.isinf(self._slews[i]) else flux_density
        self._drive[i] = 0.0
        if behind:
            self._drive[i, 2] = (flux_density - self._levels[i]) / self._units[i]
        self.schedules[i] = CommandSchedule(level)
        self.forces[i] = CommandSchedule(0.0)
        self._set_drive(i, 0.0)
        self._plan(i)
        self.changes.append((i, self.time, level))

    def equilibrium(self, i: int) -> float:
        """Return the equilibrium stretch of one under the present flux density."""
        return float(law.equilibrium_stretch(
            self._scales[i].of_level(self.flux_density[i]), self._material[i]))

    # -- drive ---------------------------------------------------------------------------------

    def command(self, i: int, stamp: int, flux_density: float) -> int:
        """
        Take a command in T from its timestamp in ns on; it replaces all at or after this time.

        Return the lateness of the change in ns: a late command applies at once. A command for the
        level that applies anyway changes nothing, and is not late.
        """
        self.setups[i].check_level(flux_density)
        changed = self.schedules[i].insert(max(stamp, self.time), flux_density)
        self._plan(i)
        return max(self.time - stamp, 0) if changed else 0

    def force(self, i: int, stamp: int, force: float) -> None:
        """Take a force in N along the field from a timestamp in ns on; it replaces later ones."""
        self.setups[i].check_force(force)
        self.forces[i].insert(max(stamp, self.time), force)
        self._plan(i)

    def clock_set(self, by: int) -> None:
        """Shift the time, and those of all commands and forces, by some ns; nothing moves."""
        self.time += by
        for i, inputs in enumerate(zip(self.schedules, self.forces, strict=True)):
            for schedule in inputs:
                schedule.shift(by)
            self._plan(i)

    def limit_slew(self, i: int, slew: float) -> None:
        """Limit the ramps of one amplifier to a rate in T/s, in addition to its own limit."""
        setup = self.setups[i]
        self._slews[i] = min(slew, setup.slew_limit) \
            / setup.actuator.flux_density_unit * setup.actuator.time_unit

    def _plan(self, i: int) -> None:
        """Set the time of the next event of one; at once while its amplifier ramps."""
        ramping = self._levels[i] != self.schedules[i].current
        self._events[i] = -1 if ramping else self._next(i)

    def _next(self, i: int) -> int:
        """Return the time in ns of the next command or force of one."""
        return min((
            x for x in (self.schedules[i].next_stamp, self.forces[i].next_stamp)
            if x is not None), default=_NEVER)

    def _set_drive(self, i: int, slope: float, level: float | None = None) -> None:
        """Update the load for amplifier, coil and force; the field does not jump."""
        lag = self._lags[i]
        flux = self.flux_density[i] / self._units[i]
        if level is not None:
            self._levels[i] = level
        load = self._scales[i].of_level(self._levels[i])
        force = self.forces[i].current * self._per_newton[i]
        if lag > 0.0:
            # u0 + s t, followed with a lag: u0 + s (t - T) + (flux - u0 + s T) exp(-t/T).
            follower = load - slope * lag
            self._drive[i] = follower + force, slope, flux - follower, 1.0 / lag
        else:
            self._drive[i] = load + force, slope, 0.0, 0.0

    # -- time ----------------------------------------------------------------------------------

    def advance(self, time: int) -> list[tuple[int, int]]:
        """
        Integrate to a time in ns, with each change applied exactly at its timestamp.

        Return the actuators whose load is too large to simulate, and the times in ns at which they
        stop. A time that is not ahead only applies changes that are due.
        """
        due = self._events <= time
        failed = []
        if due.any():
            for i in np.flatnonzero(due):
                reached = self._advance_one(int(i), time)
                if reached < time:
                    failed.append((int(i), reached))
        if time > self.time:
            np.divide((time - self.time) / NANOSECONDS, self._time_units, self._durations)
            if self._integrated(0, len(self.setups), ~due):
                failed += [(int(i), self.time) for i in np.flatnonzero(
                    ~due & (self._status != motion.DONE))]
            self.time = time
        return failed

    def _advance_one(self, i: int, end: int) -> int:
        """Advance one from change to change; return the time reached in ns."""
        now = self.time
        end = max(end, now)
        schedule, forces = self.schedules[i], self.forces[i]
        while True:
            until = min(self._next(i), end)
            if until > now:
                if not self._integrate(i, until - now):
                    self._plan(i)
                    return now
                now = until
            stamp = schedule.next_stamp
            if stamp is not None and stamp <= now:
                before = schedule.current
                schedule.apply_next()
                if schedule.current != before:
                    self.changes.append((i, now, schedule.current))
                # An amplifier that ramps arrives later.
                self._begin_piece(
                    i, schedule.current if math.isinf(self._slews[i]) else None)
            elif forces.next_stamp is not None and forces.next_stamp <= now:
                forces.apply_next()
                self._begin_piece(i)
            else:
                self._plan(i)
                return now

    def _begin_piece(self, i: int, level: float | None = None) -> None:
        """Start a new piece at a corner of the load, with the amplifier at a level if given."""
        self._set_drive(i, 0.0, level)
        self._state[i, 2] = 0.0

    def _integrate(self, i: int, duration: int) -> bool:
        """Integrate one up to its next event; its amplifier may arrive during this time."""
        left = duration / NANOSECONDS / float(self._time_units[i])
        target = self.schedules[i].current
        change = (target - self._levels[i]) / self._units[i]
        if change != 0.0:
            ramp = abs(change) / self._slews[i]
            span = min(left, ramp)
            slope = math.copysign(self._slews[i], change)
            if self._drive[i, 1] != slope:
                self._set_drive(i, slope)
            if not self._follow(i, span):
                return False
            if span < ramp:
                self._levels[i] += slope * span * self._units[i]
                return True
            left -= span
            self._levels[i] = target
            self._begin_piece(i)
        return left <= 0.0 or self._follow(i, left)

    def _follow(self, i: int, duration: float) -> bool:
        self._durations[i] = duration
        return not self._integrated(i, i + 1, self._all)

    def _integrated(self, first: int, last: int, wanted: NDArray[np.bool_]) -> int:
        """Integrate actuators over their durations; return the number of failures."""
        return motion.follow(
            first, last, wanted, self._state, self._drive, self._material, self._branches,
            self._durations, RTOL, self._status)
