"""Units: of time, and of what messages to a person give."""

from dataclasses import dataclass

#: Nanoseconds in a second; times that must not drift are integer nanoseconds.
NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Units:
    """
    Units in which messages give times and loads.

    Attributes
    ----------
    time, load : float
        Size of the nondimensional unit in the named unit.
    time_name, load_name : str
        With a leading space; empty for nondimensional values.

    """

    time: float = 1.0
    load: float = 1.0
    time_name: str = ''
    load_name: str = ''

    def time_text(self, value: float) -> str:
        """
        Word a time.

        Parameters
        ----------
        value : float
            Nondimensional time.

        Returns
        -------
        str
            With four significant digits.

        """
        return f'{value * self.time:.4g}{self.time_name}'

    def load_text(self, value: float) -> str:
        """
        Word a load.

        Parameters
        ----------
        value : float
            Nondimensional load beta.

        Returns
        -------
        str
            With four significant digits.

        """
        return f'{value * self.load:.4g}{self.load_name}'
