"""
The two-step command of Eqs. 13 and 14, for one move from any state.

A constant load beta_p brings the actuator to its turning point exactly at the target; there
the load that holds the target, beta_1, takes over and nothing is left to oscillate.
"""

from dataclasses import dataclass
import math

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmsa_ros.core import kernels, law
from hmsa_ros.core import two_step_kernel as kernel
from hmsa_ros.core.laws.record import CONSTANTS, Elastic
from hmsa_ros.core.parameters import NondimensionalParameters
from hmsa_ros.core.status import Code
from hmsa_ros.errors import BadInputError

#: Relative tolerance of the integration and of beta_p.
RTOL = 1e-12
#: Deviation from the target below which the actuator counts as being there already.
HOLD_TOLERANCE = 1e-9

CODES = {
    kernel.TWO_STEP: Code.TWO_STEP,
    kernel.HOLD: Code.HOLD,
    kernel.TOO_DAMPED: Code.TOO_DAMPED,
    kernel.INDISTINGUISHABLE: Code.INDISTINGUISHABLE,
    kernel.NO_TWO_STEP: Code.NO_TWO_STEP,
    kernel.NOT_CONVERGED: Code.NOT_CONVERGED,
    kernel.OUT_OF_RANGE: Code.OUT_OF_RANGE,
    kernel.BAD_INPUT: Code.BAD_INPUT,
}

# Numbers of packed materials that a batch keeps at a time; a table has some 330 a row.
_MOST_NUMBERS = 1 << 20

_WORK = kernels.work_space()


@dataclass(frozen=True)
class TwoStep:
    """Result of `plan_two_step`; loads and times are NaN where there are none."""

    #: ``TWO_STEP`` or ``HOLD`` where the plan leaves no vibration, else why there is none.
    code: Code
    beta_p: float  #: intermediate load
    tau_p: float  #: time at which the target is reached at rest
    beta_1: float  #: load that holds the target; NaN outside the limits
    passes: int  #: integrations that the solution took


def plan_two_step(
        start: float, target: float, material: NondimensionalParameters, *,
        rate: float = 0.0, load_limits: tuple[float, float] = (-math.inf, math.inf),
        rtol: float = RTOL) -> TwoStep:
    """
    Find the intermediate load and its duration for one move (Eq. 13).

    Parameters
    ----------
    start : float
        Stretch at the start, inside the limiting stretches.
    target : float
        Stretch to come to rest at, inside the limiting stretches.
    material : NondimensionalParameters
        zeta, J_lim and c1.
    rate : float
        Stretch rate at the start, per unit of nondimensional time.
    load_limits : tuple of float
        Admissible loads. Where two plans exist, the fastest inside them is taken; where none
        lies inside, the plan with the direct approach is returned and the caller sees from
        ``beta_p`` what it would need.
    rtol : float
        Relative tolerance, 1e-14 to 1e-4.

    Returns
    -------
    TwoStep
        With `Code.TOO_DAMPED` where the response to beta_1 does not cross the target, so that
        no two-step command exists, and `Code.INDISTINGUISHABLE` where beta_p equals beta_1 to
        rounding.

    Raises
    ------
    BadInputError
        If an argument is not a finite number or ``rtol`` is out of range.

    """
    if not math.isfinite(start + target + rate):
        raise BadInputError(
            f'start {start!r}, target {target!r}, rate {rate!r}: expected finite numbers')
    if not 1e-14 <= rtol <= 1e-4:
        raise BadInputError(f'rtol is {rtol!r}: expected 1e-14 to 1e-4')
    if material.creep:
        raise BadInputError(
            'the group has Maxwell branches: expected one without, or plan_sequence for one that '
            'creeps')
    status, beta_p, tau_p, beta_1, passes = kernel.two_step(
        _WORK, float(start), float(rate), float(target), material.packed,
        float(load_limits[0]), float(load_limits[1]), float(rtol), HOLD_TOLERANCE)
    return TwoStep(CODES[status], beta_p, tau_p, beta_1, passes)


@dataclass(frozen=True)
class TwoStepBatch:
    """Result of `plan_two_step_batch`: arrays of the broadcast shape, as in `TwoStep`."""

    status: NDArray[np.int64]  #: keys of `CODES`
    beta_p: NDArray[np.float64]
    tau_p: NDArray[np.float64]
    beta_1: NDArray[np.float64]


def plan_two_step_batch(
        start: ArrayLike, target: ArrayLike, *, zeta: ArrayLike = 0.2,
        j_lim: ArrayLike = 5.0, c1: ArrayLike = 2.0, rate: ArrayLike = 0.0,
        load_limits: tuple[float, float] = (-math.inf, math.inf),
        rtol: float = RTOL, elastic: Elastic | None = None) -> TwoStepBatch:
    """
    Plan many moves at once, over all cores.

    Parameters
    ----------
    start, target, zeta, j_lim, c1, rate : array_like
        As for `plan_two_step`, broadcast against each other.
    load_limits : tuple of float
        Admissible loads.
    rtol : float
        Relative tolerance, 1e-14 to 1e-4.
    elastic : Elastic, optional
        The law of all rows, in place of ``j_lim``.

    Returns
    -------
    TwoStepBatch
        A row that cannot be planned carries its status and NaN; it never spoils the others.

    Raises
    ------
    BadInputError
        If the shapes do not broadcast or ``rtol`` is out of range.

    """
    if not 1e-14 <= rtol <= 1e-4:
        raise BadInputError(f'rtol is {rtol!r}: expected 1e-14 to 1e-4')
    try:
        arrays = np.broadcast_arrays(*(
            np.asarray(a, dtype=np.float64) for a in (start, rate, target, zeta, j_lim, c1)))
    except ValueError as error:
        raise BadInputError(f'the arrays do not broadcast against each other: {error}') from error
    shape = arrays[0].shape
    # Copies: NumPy warns of a broadcast array that Numba asks whether it may write to.
    columns = [np.array(a).ravel() for a in arrays]
    status = np.empty(columns[0].size, dtype=np.int64)
    results = [np.empty(status.size) for _ in range(3)]
    # No single plan needs it, and it takes a moment to load.
    from hmsa_ros.core.lockstep_kernel import two_step_batch

    each = _MOST_NUMBERS // (CONSTANTS + (1 if elastic is None else len(elastic.constants)))
    for begin in range(0, status.size, each):
        part = slice(begin, begin + each)
        start, rate, target, zeta, j_lim, c1 = (x[part] for x in columns)
        # Enough parts for all cores, each long enough that its last moves do not matter.
        size = min(max(target.size // (4 * numba.get_num_threads()), 64), 1024)
        two_step_batch(
            start, rate, target, law.pack(zeta, j_lim, c1, elastic), float(load_limits[0]),
            float(load_limits[1]), float(rtol), HOLD_TOLERANCE, size, True,
            status[part], *(x[part] for x in results))
    return TwoStepBatch(status.reshape(shape), *(a.reshape(shape) for a in results))
