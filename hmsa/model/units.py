"""Scales of dimensionless quantities, and units in messages."""

from dataclasses import dataclass
from typing import Any

#: Nanoseconds in a second; times that must not drift are integer nanoseconds.
NANOSECONDS = 1_000_000_000
#: Vacuum permeability in H/m (CODATA 2022); SciPy's table of constants takes 0.2 s to load.
MU_0 = 1.25663706127e-6


def flux_text(flux_density: float, form: str = '.3g') -> str:
    """Format a flux density in T, as in ``'20 mT'``."""
    return f'{1e3 * flux_density:{form}} mT'


@dataclass(frozen=True)
class Units:
    """Units for times and loads in messages."""

    time: float = 1.0  #: time scale, in the named unit
    load: float = 1.0  #: flux density of the load 1
    time_name: str = ''  #: with a leading space; empty for dimensionless values, as load_name
    load_name: str = ''
    coordinate: str = 'stretch'  #: name of a position

    def duration(self, value: float) -> float:
        """Return a dimensionless time in the unit of time, to 15 digits: 0.5 if 0.5 was given."""
        return float(f'{value * self.time:.15g}')

    def level(self, load: Any) -> Any:
        """Return the flux density of a load or array."""
        return load * self.load

    def of_level(self, level: Any) -> Any:
        """Return the load of a flux density or array."""
        return level / self.load

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
