"""
The two-step command of Eqs. 13 and 14, for one move from any state.

A constant load beta_p brings the actuator to its turning point exactly at the target. There, the
load that holds the target, beta_1, replaces it and no vibration remains.
"""

from dataclasses import dataclass
import math
import os
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmsa import motion
from hmsa.errors import BadInputError
from hmsa.model import law
from hmsa.model.laws.record import CONSTANTS, Elastic
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.status import Code

#: Relative tolerance of the integration and of beta_p.
RTOL = 1e-12
#: Deviation from the target below which the actuator counts as already there.
HOLD_TOLERANCE = 1e-9

#: Codes by status of `hmsa.motion.two_step`.
CODES = dict(enumerate((
    Code.TWO_STEP, Code.HOLD, Code.TOO_DAMPED, Code.INDISTINGUISHABLE, Code.NO_TWO_STEP,
    Code.NOT_CONVERGED, Code.OUT_OF_RANGE, Code.BAD_INPUT)))

# Maximum number of values in the packed materials of a batch; a table has about 330 per row.
_MOST_NUMBERS = 1 << 20
# Minimum number of rows per thread.
_PART = 256


class TwoStep(NamedTuple):
    """Result of `plan_two_step`; loads and times are NaN where there are none."""

    #: ``TWO_STEP`` or ``HOLD`` if the plan leaves no vibration, else the reason why there is none.
    code: Code
    beta_p: float  #: intermediate load
    tau_p: float  #: time at which the target is reached at rest
    beta_1: float  #: load that holds the target; NaN outside the limits
    passes: int  #: number of integrations


def plan_two_step(
        start: float, target: float, material: NondimensionalParameters, *,
        rate: float = 0.0, load_limits: tuple[float, float] = (-math.inf, math.inf),
        rtol: float = RTOL) -> TwoStep:
    """
    Find the intermediate load and its duration for one move (Eq. 13).

    Parameters
    ----------
    start : float
        Initial stretch, inside the limiting stretches.
    target : float
        Target stretch, inside the limiting stretches.
    material : NondimensionalParameters
        zeta, J_lim and c1.
    rate : float
        Initial stretch rate, dimensionless.
    load_limits : tuple of float
        Admissible loads. If two plans exist, the fastest one inside the limits is returned. If
        none is inside, the plan with the direct approach is returned, whose ``beta_p`` shows the
        load it needs.
    rtol : float
        Relative tolerance, 1e-14 to 1e-4.

    Returns
    -------
    TwoStep
        With `Code.TOO_DAMPED` if the response to beta_1 does not cross the target, so that no
        two-step command exists, and `Code.INDISTINGUISHABLE` if beta_p equals beta_1 to rounding.

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
    if material.creeps:
        raise BadInputError(
            'the material creeps: expected one without viscoelastic branches, or plan_sequence')
    least, most = load_limits
    status, beta_p, tau_p, beta_1, passes = motion.two_step(
        start, rate, target, material.packed, least, most, rtol, HOLD_TOLERANCE)
    # Skip the constructor, which would take 3 % of the time of a plan.
    return tuple.__new__(TwoStep, (CODES[status], beta_p, tau_p, beta_1, passes))


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(frozen=True)
class TwoStepBatch:
    """Result of `plan_two_step_batch`: arrays of the broadcast shape, as in `TwoStep`."""

    status: NDArray[np.int64]  #: keys of `CODES`
    beta_p: NDArray[np.float64]
    tau_p: NDArray[np.float64]
    beta_1: NDArray[np.float64]


class Groups(NamedTuple):
    """Values of `NondimensionalParameters` as arrays, and their common hyperelastic model."""

    zeta: ArrayLike = 0.2
    j_lim: ArrayLike = 5.0
    c1: ArrayLike = 2.0
    elastic: Elastic | None = None  #: in place of ``j_lim``


#: Those of the paper.
USUAL = Groups()


def plan_two_step_batch(
        start: ArrayLike, target: ArrayLike, groups: Groups = USUAL, *,
        rate: ArrayLike = 0.0, load_limits: tuple[float, float] = (-math.inf, math.inf),
        rtol: float = RTOL, workers: int = 0) -> TwoStepBatch:
    """
    Plan many moves at once on all cores.

    Parameters
    ----------
    start, target, rate : array_like
        As for `plan_two_step`, broadcast with each other and the groups.
    groups : Groups
        Materials.
    load_limits : tuple of float
        Admissible loads.
    rtol : float
        Relative tolerance, 1e-14 to 1e-4.
    workers : int
        Threads; 0 for one per core.

    Returns
    -------
    TwoStepBatch
        A row that cannot be planned contains its status and NaN, and does not affect the others.

    Raises
    ------
    BadInputError
        If the shapes do not broadcast or ``rtol`` is out of range.

    """
    if not 1e-14 <= rtol <= 1e-4:
        raise BadInputError(f'rtol is {rtol!r}: expected 1e-14 to 1e-4')
    try:
        given = [np.asarray(a, dtype=np.float64) for a in (start, rate, target, *groups[:3])]
        shape = np.broadcast_shapes(*(a.shape for a in given))
    except ValueError as error:
        raise BadInputError(f'the arrays do not broadcast against each other: {error}') from error
    # A single material is packed only once.
    alike = all(a.size == 1 for a in given[3:])
    elastic = groups.elastic
    columns = [np.broadcast_to(a, shape).flatten() for a in given[:3 if alike else 6]]
    material = law.pack(
        given[3].item(), given[4].item(), given[5].item(), elastic) if alike else None
    status = np.empty(columns[0].size, dtype=np.int64)
    results = [np.empty(status.size) for _ in range(3)]
    each = _MOST_NUMBERS // (CONSTANTS + (1 if elastic is None else len(elastic.constants)))

    def plan(part: slice) -> None:
        start, rate, target, *groups = (x[part] for x in columns)
        rows = material if material is not None else np.ascontiguousarray(
            law.pack(groups[0], groups[1], groups[2], elastic))
        motion.two_step_batch(
            start, rate, target, rows, 0 if rows.ndim == 1 else rows.shape[1], *load_limits, rtol,
            HOLD_TOLERANCE, True, status[part], *(x[part] for x in results))

    count = max(min(workers or available_cores(), status.size // _PART), 1)
    size = min(-(-status.size // count), each) or 1
    parts = [slice(x, x + size) for x in range(0, status.size, size)]
    if count == 1:
        for part in parts:
            plan(part)
    else:
        from concurrent.futures import ThreadPoolExecutor  # slow to import

        with ThreadPoolExecutor(count) as pool:
            list(pool.map(plan, parts))
    return TwoStepBatch(status.reshape(shape), *(a.reshape(shape) for a in results))
