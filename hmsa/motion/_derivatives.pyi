# Stubs of the compiled module; arrays are contiguous, of float64 unless stated otherwise.
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Whether the motion was followed to its end.
def respond(
    theta: Array, material: Array, branches: int, wanted: NDArray[np.int64], start: Array,
    begins: Array, levels: Array, ramps: Array, field: float, field_lag: float, times: Array,
    rtol: float, stretch: Array, rate: Array, jacobian: Array, by_rate: Array, behind: Array,
    behind_last: Array, /
) -> bool: ...
# Return the equilibrium stretch under a level; NaN if there is none.
def rest(
    theta: Array, material: Array, level: float, wanted: NDArray[np.int64], slopes: Array, /
) -> float: ...
