"""Units: of time, and of what messages to a person give."""

from dataclasses import dataclass

#: Nanoseconds in a second; times that must not drift are integer nanoseconds.
NANOSECONDS = 1_000_000_000
#: Vacuum permeability in H/m (CODATA 2022); SciPy's table of constants takes 0.2 s to load.
MU_0 = 1.25663706127e-6


@dataclass(frozen=True)
class Units:
    """Units in which messages give times and loads."""

    time: float = 1.0  #: size of the nondimensional unit in the named one, as load
    load: float = 1.0
    time_name: str = ''  #: with a leading space; empty for nondimensional values, as load_name
    load_name: str = ''
    coordinate: str = 'stretch'  #: what a position is called

    def time_text(self, value: float) -> str:
        """Word a nondimensional time with four significant digits."""
        return f'{value * self.time:.4g}{self.time_name}'

    def slew_text(self, value: float) -> str:
        """Word a slew rate (load per nondimensional time) with four digits, as in ``'20 T/s'``."""
        unit = f'{self.load_name}/{self.time_name.strip()}' if self.time_name else ''
        return f'{value * self.load / self.time:.4g}{unit}'

    def load_text(self, value: float) -> str:
        """Word a nondimensional load beta with four significant digits."""
        return f'{value * self.load:.4g}{self.load_name}'
