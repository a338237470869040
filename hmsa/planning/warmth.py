"""Temperature of a block while its coil warms it: measured now, and foreseen along a plan."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import math

from hmsa.model.units import NANOSECONDS
from hmsa.planning.timeline import JointModel, PlannedLevel

#: Change of the level that holds a stretch at which a plan sets a new one, as a fraction: it moves
#: the block by less than 1e-3 of a step if this is a fifth of its distance from rest or more.
SHARE = 2e-4
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
            if not thermal.rise or abs(rate * left) <= SHARE:
                return
            duration = -thermal.time_constant * math.log1p(-SHARE / abs(rate * left))
            time = (found.time or 0) + round(duration * NANOSECONDS)
            if time >= end:
                return
            found = found.after(flux_density, time)
            flux_density *= 1.0 + math.copysign(SHARE, rate * left)
            yield found
