"""
Records of a plan over time, and predictions along them.

Times are integer nanoseconds and levels are flux densities in tesla, as in messages. Each level
contains the model with which it was planned, so that predictions of a running plan do not change
with the parameters.
"""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
import math
from operator import attrgetter
from typing import Any, TYPE_CHECKING

import numpy as np

from hmsa.errors import check_choice, check_number
from hmsa.model import law
from hmsa.model.delivery import Delivery, IDEAL
from hmsa.model.equations import acceleration
from hmsa.model.moves import Level, Limits, State
from hmsa.model.parameters import ActuatorParameters, NondimensionalParameters, Uncertainty
from hmsa.model.simulation import follow, longest_motion, observed, sampled
from hmsa.model.status import Code
from hmsa.model.units import NANOSECONDS, Units
from hmsa.planning.sequence import Remaining, SHORT_SPELL
from hmsa.planning.shapers import creeping, get_shaper
from hmsa.planning.shapers.request import as_errors, ERRORS, PACE, SmoothLimits

if TYPE_CHECKING:
    from hmsa.planning.path import Path  # slow to import

#: Options that describe coil and block, and can be estimated.
ESTIMATED = ('coil_time_constant', 'constant_force')
# Codes of plans that deviate from the request.
_WARNINGS = (Code.TOO_DAMPED, Code.INDISTINGUISHABLE, Code.SPELL_TOO_SHORT)
#: Timestamp of a level that has always been in effect, at rest.
ALWAYS = -2**62
#: Order of levels by start, and of setpoints by start.
STAMP, SINCE = attrgetter('stamp'), attrgetter('since')


@dataclass(frozen=True)
class Options:
    """How requests are planned."""

    shaper: str = 'two_step'  #: a name in `hmsa.planning.shapers.SHAPERS`
    short_spell: str = 'refuse'  #: for a duration that ends before the move: refuse or continue
    flux_density_min: float = -math.inf  #: in T
    flux_density_max: float = math.inf  #: in T
    lead_time: int = 50_000_000  #: in ns, time from sending a command to its timestamp
    period: int = 0  #: of the command grid, in ns; 0 for any time
    slew_limit: float = math.inf  #: in T/s; infinite for steps
    order: int = 2  #: of the shapers robust and minimax
    coil_time_constant: float = 0.0  #: of a first-order lag, in s; 0 for none
    constant_force: float = 0.0  #: in N, in addition to that of the field
    #: Vibration that levels of the creep tail may leave, as a fraction of the move.
    creep_tolerance: float = IDEAL.ripple
    #: Deviation from a path that levels may leave, as a fraction of its range.
    path_tolerance: float = 1e-6
    #: Relative errors of G, damping coefficient and J_lim that minimax must tolerate.
    errors: Uncertainty = ERRORS
    pace: SmoothLimits = PACE  #: of the shaper smooth; the rate in 1/s


@dataclass(frozen=True)
class JointModel:
    """All data of a prediction: the block and how commands reach it."""

    actuator: ActuatorParameters
    options: Options
    material: NondimensionalParameters = field(init=False)
    units: Units = field(init=False)  #: scales of the dimensionless time and load
    limits: Limits = field(init=False)
    delivery: Delivery = field(init=False)  #: dimensionless, like limits and pace
    pace: SmoothLimits = field(init=False)
    pull: float = field(init=False)  #: load of the constant force
    rest: float = field(init=False)  #: position at rest without a field

    def __post_init__(self) -> None:
        """Compute the dimensionless data."""
        actuator, options = self.actuator, self.options
        get_shaper(options.shaper)
        as_errors(options.errors)
        check_choice('short_spell', options.short_spell, SHORT_SPELL)
        check_number('lead_time', options.lead_time / NANOSECONDS, 's', least=0.0)
        units, pull = actuator.units, options.constant_force * actuator.load_per_newton
        time, load = units.time, units.load
        least, largest = map(units.of_level, (options.flux_density_min, options.flux_density_max))
        worked_out = {
            'material': actuator.nondimensional,
            'units': units,
            'limits': Limits(least + pull, largest + pull),
            'delivery': Delivery(
                options.period / NANOSECONDS / time, options.slew_limit / load * time,
                1.0 / NANOSECONDS / time, options.coil_time_constant / time,
                options.creep_tolerance),
            'pace': replace(options.pace, rate=options.pace.rate * time),
            'pull': pull,
            'rest': actuator.rest,
        }
        for name, value in worked_out.items():
            object.__setattr__(self, name, value)

    @property
    def others(self) -> dict[str, Any]:
        """Parameters that can be estimated besides those of the block, by name."""
        return {x: getattr(self.options, x) for x in ESTIMATED}

    def at_temperature(self, temperature: float) -> 'JointModel':
        """Return the model at a temperature in degrees Celsius, this one without coefficients."""
        actuator = self.actuator.at_temperature(temperature)
        if actuator is self.actuator:
            return self
        return JointModel(actuator, replace(
            self.options, coil_time_constant=self.actuator.thermal.coil_time_constant(
                self.options.coil_time_constant, temperature)))

    @property
    def temperature(self) -> float:
        """Temperature in degrees Celsius that the model holds at, if that matters."""
        return self.actuator.thermal.reference

    def ns(self, time: float) -> int:
        """Return a nondimensional time in ns."""
        return round(time * self.units.time * NANOSECONDS)

    def time(self, ns: int) -> float:
        """Return the dimensionless time of a time in ns."""
        return ns / NANOSECONDS / self.units.time

    def load(self, flux_density: float) -> float:
        """Return the load of a flux density in T plus the constant force."""
        return float(flux_density / self.units.load) + self.pull

    def flux_density(self, load: float) -> float:
        """Return the flux density in T of a load."""
        return float((load - self.pull) * self.units.load)

    def holding(self, stretch: float) -> float:
        """Return the load that holds a stretch."""
        return float(law.elastic_force(stretch, self.material.packed))

    def frequency(self, stretch: float) -> float:
        """Return the nondimensional natural frequency about a stretch."""
        return float(law.natural_frequency(stretch, self.material.packed))

    def acceleration(self, state: State) -> float:
        """Return the nondimensional acceleration in a state whose branches have relaxed."""
        return float(acceleration(state.stretch, state.rate, state.load, self.material))

    def observed(self, state: State) -> tuple[float, float]:
        """Return stretch and dimensionless rate of all modes together."""
        if not self.material.modes.ratios or len(state.followed) != len(self.material.rows):
            return state.stretch, state.rate
        seen, speed = self.material.observed(
            state.stretch, state.rate, state.followed[len(self.material.branches):])
        return float(seen), float(speed)

    def on_grid(self, time: int) -> int:
        """Return the earliest time in ns, not before the given one, that a command may have."""
        period = self.options.period
        return time if period == 0 else -(-time // period) * period

    def follow(self, state: State, load: float, duration: float) -> State:
        """Predict the state after a load has been commanded for a dimensionless time."""
        return follow((Level(0.0, load),), state, duration, self.material, self.delivery)

    def taken_from(self, state: State, other: 'JointModel') -> State:
        """Return a state of another model in the units of this one."""
        if other is self:
            return state
        loads = float(self.units.of_level(other.units.load))

        def taken(load: float) -> float:
            return (load - other.pull) * loads + self.pull

        return State(
            state.stretch, state.rate / other.units.time * self.units.time, taken(state.load),
            None if state.amplifier is None else taken(state.amplifier),
            creeping.carried(
                state, other.material, self.material, self.units.time / other.units.time))

    def held(self, taken: State, other: 'JointModel', flux_density: float) -> State:
        """
        Return a state taken from another model in the stretches of this one, under a level in T.

        With the parameters of this model, the level holds another stretch. A state beyond the
        limits of this model does not change.
        """
        more = float(law.equilibrium_stretch(self.load(flux_density), self.material.packed)
                     - law.equilibrium_stretch(other.load(flux_density), other.material.packed))
        stretch, count = taken.stretch + more, len(self.material.branches)
        if self.material.beyond(stretch):
            return taken
        force = self.holding(stretch) - self.holding(taken.stretch)
        return replace(taken, stretch=stretch, followed=(
            *(x + force for x in taken.followed[:count]),
            *(x if i % 2 else x + more for i, x in enumerate(taken.followed[count:]))))


@dataclass(frozen=True, slots=True)
class PlannedLevel:
    """A change of level, and the prediction at its timestamp."""

    stamp: int  #: start time in ns
    flux_density: float  #: in T
    state: State  #: in the units of the model
    model: JointModel = field(repr=False)  #: of the motion from the timestamp on
    #: Timestamp in ns with which it was sent, if it was delayed by an earlier, late level.
    sent_for: int | None = None

    @property
    def stretch(self) -> float:
        """Stretch at the timestamp."""
        return self.model.observed(self.state)[0]

    @property
    def rate(self) -> float:
        """Stretch rate at the timestamp in 1/s."""
        return self.model.observed(self.state)[1] / self.model.units.time

    @property
    def in_force(self) -> float:
        """Flux density in T at the timestamp, from which a slew limit ramps to the level."""
        return self.model.flux_density(self.state.load)

    @property
    def load(self) -> float:
        """The level as a dimensionless load."""
        return self.model.load(self.flux_density)

    @property
    def due(self) -> int:
        """Timestamp in ns with which it is sent."""
        return self.stamp if self.sent_for is None else self.sent_for

    def shifted(self, span: int) -> 'PlannedLevel':
        """Return the level with its times shifted by some ns."""
        return replace(
            self, stamp=self.stamp if self.stamp == ALWAYS else self.stamp + span,
            sent_for=None if self.sent_for is None else self.sent_for + span)

    def at(self, time: int) -> State:
        """Predict the dimensionless state at a time in ns, or at the timestamp if it is later."""
        if self.stamp == ALWAYS:
            return self.state
        return self.model.follow(
            self.state, self.load,
            min(max(self.model.time(time - self.stamp), 0.0),
                math.inf if self.model.material.creeps else self._settled()))

    @property
    def ramped(self) -> float:
        """Dimensionless time in which the field reaches the level."""
        return self.model.delivery.settling(self.load - self.state.ramps_from)

    def _settled(self) -> float:
        """Return the time after which the motion has ended, except for creep."""
        return self.ramped + longest_motion(self.load, self.model.material)

    def sample(self, times: Sequence[int]) -> list[tuple[float, float]]:
        """Predict stretch and rate (1/s) at times in ns, not decreasing, from the timestamp on."""
        if self.stamp == ALWAYS or all(x == self.stamp for x in times):
            return [(self.stretch, self.rate)] * len(times)
        model, settled = self.model, self._settled()
        after = np.array([model.time(x - self.stamp) for x in times])
        # After settling, creep may continue.
        count = int(np.searchsorted(after, settled)) if model.material.creeps else len(after)
        stretch, rate = observed(sampled(
            (Level(0.0, self.load),), self.state, np.minimum(after[:count], settled),
            model.material, model.delivery), model.material) if count else np.empty((2, 0))
        found = [*zip(stretch.tolist(), rate.tolist(), strict=True),
                 *((x.stretch, x.rate) for x in map(self.at, times[count:]))]
        return [(x, y / model.units.time) for x, y in found]

    def after(self, level: 'PlannedLevel') -> 'PlannedLevel':
        """Return this level with the prediction at its timestamp after another level."""
        return replace(self, state=self.model.taken_from(level.at(self.stamp), level.model))


@dataclass(frozen=True, slots=True)
class PlannedSegment:
    """One setpoint on the timeline, times in ns."""

    stretch: float  #: target
    begin: int  #: start of the move
    arrival: int | None  #: time of rest at the target; None if only approached
    code: Code
    reason: str  #: why the command is not the requested one; empty if it is
    since: int  #: start of the setpoint; the move may start later
    #: Upper bound of the vibration that levels of the creep tail leave in stretch, peak to peak.
    vibration: float = 0.0
    until: int | None = None  #: end as requested; None if it is held on
    carried_out: bool = True  #: whether its commands were sent and took effect, as far as known
    #: Path to follow, in s from ``since`` on; None for a move.
    path: 'Path | None' = field(default=None, compare=False, repr=False)
    #: Vibration of an actuator with secondary modes after the move; None for none.
    left: Remaining | None = None

    @property
    def rests(self) -> int:
        """Planned time of rest; the start of a move whose target is only approached."""
        return self.begin if self.arrival is None else self.arrival

    @property
    def told(self) -> str:
        """How the move differs from the request, and the vibration it leaves; empty if none."""
        left = '' if self.left is None else self.left.of(self.stretch, self.code)
        return '; '.join(filter(None, (self.reason, left)))

    @property
    def warns(self) -> bool:
        """Whether it is reached only roughly: by another command, or worse than by a step."""
        return (self.code in _WARNINGS or self.code is Code.PATH and bool(self.reason)
                or self.left is not None and self.left.worse)

    def shifted(self, span: int) -> 'PlannedSegment':
        """Return the segment with its times shifted by some ns."""
        return replace(
            self, begin=self.begin + span, since=self.since + span,
            arrival=None if self.arrival is None else self.arrival + span,
            until=None if self.until is None else self.until + span)


@dataclass(frozen=True)
class Timeline:
    """The plan from the present level on."""

    number: int  #: counts accepted requests from 1; 0 before the first
    levels: Sequence[PlannedLevel]  #: by stamp; the first ones may lie in the past
    segments: tuple[PlannedSegment, ...]  #: by time
    kept: int = 0  #: number of segments, from the first on, that belong to earlier requests

    def shifted(self, span: int) -> 'Timeline':
        """Return the plan with all times shifted by some ns."""
        return replace(
            self, levels=tuple(x.shifted(span) for x in self.levels),
            segments=tuple(x.shifted(span) for x in self.segments))

    def ahead(self, now: int, limit: int | None = None) -> Sequence[PlannedLevel]:
        """Return the levels from the present one on, without the one that always applied."""
        first = self.place(now)
        first += self.levels[first].stamp < 0
        return self.levels[first:None if limit is None else first + limit]

    def level(self, time: int) -> PlannedLevel:
        """Return the level at a time; before all levels, the first one."""
        return self.levels[self.place(time)]

    def place(self, time: int) -> int:
        """Return the index of the level at a time; before all levels, that of the first one."""
        return max(bisect_right(self.levels, time, key=STAMP) - 1, 0)

    def under_way(self, time: int) -> int:
        """Return the index of the setpoint at a time, -1 before the first."""
        return bisect_right(self.segments, time, key=SINCE) - 1

    def ends_at(self, stretch: float, time: int) -> bool:
        """Return whether the last setpoint has a stretch and has begun by a time in ns."""
        last = self.segments[-1] if self.segments else None
        return last is not None and last.stretch == stretch and last.since <= time

    def step(self, place: int) -> float:
        """Return the distance in stretch of a setpoint from the previous one, by index."""
        before = self.segments[place - 1] if place else self.levels[0]
        return abs(self.segments[place].stretch - before.stretch)


@dataclass(frozen=True)
class Draft:
    """A plan that has not been taken yet."""

    begin: int  #: in ns, the start of the part of the plan that it replaces
    levels: tuple[PlannedLevel, ...]
    segments: tuple[PlannedSegment, ...]
    #: Index of the first setpoint of the running plan that is planned again; None for a request.
    resumed: int | None = None
    missed: int = 0  #: number of setpoints skipped because their time is over

    def delayed(self, delays: Sequence[int]) -> 'Draft':
        """Return the draft with the move of each segment delayed by its delay in ns."""
        begins = [x.begin for x in self.segments]
        levels = tuple(
            replace(x, stamp=x.stamp + delays[bisect_right(begins, x.stamp) - 1])
            for x in self.levels)
        segments = tuple(
            x if not delay else replace(
                x, begin=x.begin + delay,
                arrival=None if x.arrival is None else x.arrival + delay)
            for x, delay in zip(self.segments, delays, strict=True))
        return replace(self, levels=levels, segments=segments)


# Change of the level that holds a stretch at which a plan sets a new one, as a fraction: it moves
# the block by less than 1e-3 of a step if this is a fifth of its distance from rest or more.
_WARMED = 2e-4
# Difference of temperature in K that changes no level to 1e-5, with coefficients up to 1 %/K.
_SAME = 1e-3


@dataclass(frozen=True)
class Warmth:
    """Temperature of the block of a joint at a time, in degrees Celsius."""

    base: JointModel  #: the model at its reference temperature
    temperature: float
    time: int | None  #: in ns; None before the first one
    ambient: float  #: temperature without a field
    #: The newest measurement: time in ns and temperature; None if there is none.
    measured: tuple[int, float] | None = None
    estimated: bool = False  #: whether it was estimated from the motion since
    #: Estimated minus measured temperature: coefficients are inexact.
    offset: float = 0.0

    @classmethod
    def of(cls, base: JointModel) -> 'Warmth':
        """Return the temperature without a field, before any measurement."""
        ambient = base.actuator.thermal.ambient
        return cls(base, ambient, None, ambient)

    def model(self, known: JointModel | None = None) -> JointModel:
        """Return the model at the temperature; ``known``, made before, if it holds there."""
        if known is not None and abs(known.temperature - self.temperature) < _SAME:
            return known
        return self.base.at_temperature(self.temperature)

    def after(self, flux_density: float, time: int) -> 'Warmth':
        """Return the temperature at a time in ns until which a level in T is held."""
        if self.time is None:
            return replace(self, time=time)
        if time <= self.time:
            return self
        return replace(self, time=time, temperature=self.base.actuator.thermal.warmed(
            self.temperature, flux_density, (time - self.time) / NANOSECONDS, self.ambient))

    def along(self, levels: Sequence[PlannedLevel], time: int) -> 'Warmth':
        """Return the temperature at a time in ns under levels, of which the first applies now."""
        found = self
        for level, following in zip(levels, levels[1:], strict=False):
            if following.stamp >= time:
                return found.after(level.flux_density, time)
            found = found.after(level.flux_density, following.stamp)
        return found.after(levels[-1].flux_density, time)

    def shown(
            self, temperature: float, levels: Sequence[PlannedLevel], time: int, *,
            estimated: bool = False) -> 'Warmth':
        """Return it with a temperature that a time in ns has shown, under some levels."""
        foreseen = self.along(levels, time)
        measured, offset = self.measured if estimated else (time, temperature), self.offset
        if estimated and measured is not None:
            offset = temperature - measured[1]
        elif not estimated:
            temperature += offset
        # What the warming by the coil does not explain is the temperature without it.
        return replace(
            foreseen, temperature=temperature, estimated=estimated, measured=measured,
            offset=offset, ambient=foreseen.ambient + temperature - foreseen.temperature)

    def shifted(self, by: int) -> 'Warmth':
        """Return it with its times shifted by some ns."""
        return replace(
            self, time=None if self.time is None else self.time + by,
            measured=None if self.measured is None else (
                self.measured[0] + by, self.measured[1]))

    def drift(self, model: JointModel) -> float:
        """Return by how much the level that holds a stretch differs from that of a model."""
        thermal = self.base.actuator.thermal
        ratio = [thermal.factor('shear_modulus', x) / thermal.factor('remanence', x)
                 for x in (self.temperature, model.temperature)]
        return ratio[0] / ratio[1] - 1.0

    def changes(self, flux_density: float, end: float) -> Iterator['Warmth']:
        """Yield the temperature, until a time in ns, whenever the holding level has changed."""
        found, thermal = self, self.base.actuator.thermal
        while True:
            rate = thermal.at(found.temperature).stiffening
            left = thermal.settled(flux_density, self.ambient) - found.temperature
            if not thermal.rise or abs(rate * left) <= _WARMED:
                return
            duration = -thermal.time_constant * math.log1p(-_WARMED / abs(rate * left))
            time = (found.time or 0) + round(duration * NANOSECONDS)
            if time >= end:
                return
            found = found.after(flux_density, time)
            flux_density *= 1.0 + math.copysign(_WARMED, rate * left)
            yield found
