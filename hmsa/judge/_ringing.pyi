# Compiled module: fits of samples, and their largest motion; times in s, stamps in ns.

from numpy import int64
from numpy.typing import NDArray

from hmsa.model.equations import Array

Bounded = tuple[float, float, float, float]

# Offset, vibration, frequency and peak to peak of each mode, noise, robust noise, fraction of
# independent samples, and the highest frequency that was searched, in rad/s.
def fit(
    time: Array, rest: Array, frequency: float, decay: float, beyond: float, z: float,
    nothing: float, creep: bool, /,
) -> tuple[
    Bounded, Bounded, tuple[tuple[float, float], ...], float, float, float, float] | None: ...
def largest(stamps: NDArray[int64], values: Array, begin: int, period: int, /) -> float: ...
def quantile(freedom: float, probability: float, z: float, /) -> float: ...
