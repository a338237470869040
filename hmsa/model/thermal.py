"""How parameters of block and coil change with the temperature, and how the coil warms a block."""

from dataclasses import dataclass, fields, replace
import math

from hmsa.errors import BadInputError, check_number

#: Temperatures in degrees Celsius that a silicone bears; others are mistakes.
COLDEST, HOTTEST = -60.0, 200.0
#: Coefficients, each that of the parameter of its name, except for that of the coil.
BLOCK_COEFFICIENTS = ('shear_modulus', 'remanence', 'damping_coefficient')
_COEFFICIENTS = (*BLOCK_COEFFICIENTS, 'coil_resistance')
_KELVIN = 273.15
# Largest coefficient in 1/K, far above that of any elastomer, magnet or metal.
_STEEPEST = 0.1
# Fraction of a parameter that must be left: farther from the reference, lines mean nothing.
_LEAST = 0.1


def checked_temperature(value: float, name: str = 'temperature') -> float:
    """Return a temperature in degrees Celsius; raise `BadInputError` for an impossible one."""
    if COLDEST <= value <= HOTTEST:
        return float(value)
    celsius = value - _KELVIN
    raise BadInputError(
        f'{name} is {value:g}: expected degrees Celsius, not kelvin, from {COLDEST:g} to '
        f'{HOTTEST:g}' + (
            f'; {value:g} K are {celsius:g} degrees Celsius' if COLDEST <= celsius <= HOTTEST
            else ''))


@dataclass(frozen=True)
class Thermal:
    """
    Temperature coefficients of block and coil, and the warming by the coil.

    A parameter x at the temperature T is x_0 (1 + a (T - T_0)), with its coefficient a and the
    reference T_0 at which x_0 holds. Temperatures are in degrees Celsius.
    """

    reference: float = 25.0
    shear_modulus: float = 0.0  #: coefficient in 1/K, -0.1 to 0.1, as the next three
    remanence: float = 0.0  #: of the reversible change
    damping_coefficient: float = 0.0
    coil_resistance: float = 0.0  #: the time constant of the coil is L/R
    limit: float = 80.0  #: above which the magnets lose remanence for good
    #: Warming of the block at a level held for long, in K/T^2, at least 0.
    rise: float = 0.0
    time_constant: float = 100.0  #: of this warming in s, above 0
    ambient: float = 25.0  #: temperature without a field

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ('reference', 'limit', 'ambient'):
            checked_temperature(getattr(self, name), f'thermal.{name}')
        for name in _COEFFICIENTS:
            value = getattr(self, name)
            if not abs(value) <= _STEEPEST:
                raise BadInputError(
                    f'thermal.{name} is {value:g} 1/K: expected a coefficient of {-_STEEPEST:g} '
                    f'to {_STEEPEST:g} 1/K, such as 0.003 for 0.3 %/K')
        check_number('thermal.rise', self.rise, 'K/T^2', least=0.0)
        check_number('thermal.time_constant', self.time_constant, 's', above=0.0)

    def __bool__(self) -> bool:
        """Return whether the temperature changes anything."""
        return any(getattr(self, x) for x in _COEFFICIENTS)

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters that describe it; none if the temperature changes nothing."""
        return {f'thermal.{x.name}': getattr(self, x.name) for x in fields(self)} if self else {}

    def factor(self, name: str, temperature: float) -> float:
        """
        Return the factor on a parameter, by the name of its coefficient, at a temperature.

        Raise `BadInputError` if hardly anything is left of the parameter.
        """
        coefficient: float = getattr(self, name)
        found = 1.0 + coefficient * (temperature - self.reference)
        if not found >= _LEAST:
            raise BadInputError(
                f'temperature is {temperature:g} degrees Celsius: with thermal.{name} '
                f'{coefficient:g} 1/K from {self.reference:g} degrees, {100.0 * found:.3g} % of '
                f'the parameter is left: expected {100.0 * _LEAST:g} % or more')
        return found

    def coil_time_constant(self, value: float, temperature: float) -> float:
        """Return the time constant L/R in s at a temperature, of a ``value`` at the reference."""
        return value / self.factor('coil_resistance', temperature)

    @property
    def stiffening(self) -> float:
        """Relative change, per K, of the flux density that holds a stretch."""
        return self.shear_modulus - self.remanence

    def at(self, temperature: float) -> 'Thermal':
        """Return the same coefficients with another reference."""
        return replace(self, reference=temperature, **{
            x: getattr(self, x) / self.factor(x, temperature) for x in _COEFFICIENTS})

    def warmed(
            self, temperature: float, flux_density: float, duration: float,
            ambient: float | None = None) -> float:
        """
        Return the temperature of the block after a level in T has been held for some seconds.

        The heat of the coil goes with the square of its current, and reaches the block as a
        first-order lag. ``ambient`` is the temperature without a field, by default the given one.
        With no warming, the temperature stays.
        """
        if not self.rise:
            return temperature
        end = self.settled(flux_density, ambient)
        return end + (temperature - end) * math.exp(-duration / self.time_constant)

    def settled(self, flux_density: float, ambient: float | None = None) -> float:
        """Return the temperature of the block long after a level in T was set."""
        return (self.ambient if ambient is None else ambient) + self.rise * flux_density ** 2

    def warning(self, temperature: float) -> str:
        """Return a sentence on magnets that are too hot; empty below the limit."""
        return '' if temperature <= self.limit else (
            f'the block is at {temperature:.4g} degrees Celsius, above thermal.limit '
            f'{self.limit:g}: its magnets may lose remanence for good; let it cool, and identify '
            'the remanence again')
