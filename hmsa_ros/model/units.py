"""Scales of dimensionless quantities, and units in messages."""

from dataclasses import dataclass
from typing import Any

#: Nanoseconds in a second; times that must not drift are integer nanoseconds.
NANOSECONDS = 1_000_000_000
#: Vacuum permeability in H/m (CODATA 2022); SciPy's table of constants takes 0.2 s to load.
MU_0 = 1.25663706127e-6
#: Vacuum permittivity in F/m, of the same table.
EPSILON_0 = 8.8541878188e-12


@dataclass(frozen=True)
class Drive:
    """Drive of an actuator, a field or a voltage, and its relation to the load."""

    name: str
    plural: str
    symbol: str
    unit: str
    shown: str  #: unit in tables and figures
    per: float  #: number of shown units in one unit
    squared: bool = False  #: whether the load increases as the square of the level

    def text(self, level: float, form: str = '.3g') -> str:
        """Format a level in the shown unit."""
        return f'{self.per * level:{form}} {self.shown}'


FLUX = Drive('flux density', 'flux densities', 'B', 'T', 'mT', 1e3)
VOLTAGE = Drive('voltage', 'voltages', 'U', 'V', 'V', 1.0, squared=True)


@dataclass(frozen=True)
class Units:
    """Units for times and loads in messages."""

    time: float = 1.0  #: time scale, in the named unit
    load: float = 1.0  #: level of the load 1
    time_name: str = ''  #: with a leading space; empty for dimensionless values, as load_name
    load_name: str = ''
    coordinate: str = 'stretch'  #: name of a position
    drive: Drive = FLUX

    def level(self, load: Any) -> Any:
        """Return the level of a load or array; negative for a load that no voltage has."""
        if self.drive.squared:
            return abs(load) ** 0.5 * ((load >= 0.0) * 2.0 - 1.0) * self.load
        return load * self.load

    def of_level(self, level: Any) -> Any:
        """Return the load of a level or array; voltages of either sign attract."""
        load = level / self.load
        return load * load if self.drive.squared else load

    def change(self, level: float, by: float) -> float:
        """Return the maximum change of the load when a level changes by an amount."""
        more = (2.0 * abs(level) + abs(by)) / self.load if self.drive.squared else 1.0
        return by / self.load * more

    def range(self, least: float, largest: float) -> tuple[float, float]:
        """Return the minimum and maximum load in a range of levels."""
        least = max(least, 0.0) if self.drive.squared else least
        return self.of_level(least), self.of_level(largest)

    def time_text(self, value: float) -> str:
        """Format a dimensionless time with four significant digits."""
        return f'{value * self.time:.4g}{self.time_name}'

    def slew_text(self, value: float) -> str:
        """Format a slew rate (dimensionless) with four digits, as in ``'20 T/s'``."""
        unit = f'{self.load_name}/{self.time_name.strip()}' if self.time_name else ''
        return f'{value * self.load / self.time:.4g}{unit}'

    def load_text(self, value: float) -> str:
        """Format a dimensionless load beta with four significant digits."""
        return f'{self.level(value):.4g}{self.load_name}'
