"""Choice of a shaper for an actuator whose parameters have a known uncertainty."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from hmsa.api.actuator import Actuator
from hmsa.api.plan import Plan
from hmsa.errors import BadInputError
from hmsa.identification.known import Known
from hmsa.interfaces.parameters import ACTUATOR_FIELDS

#: Compared shapers, the fastest first.
CANDIDATES = ('two_step', 'zvd', 'robust', 'minimax', 'smooth')
_DRAWS = 24
# Fraction of the draws with at most the reported residual vibration.
_MOST = 0.95
# Smaller steps, in stretch, are not evaluated.
_STEP = 1e-9


@dataclass(frozen=True)
class Expected:
    """Expected performance of a shaper with uncertain parameters."""

    shaper: str
    #: 95th percentile, over the possible parameters, of the residual vibration after the worst
    #: move, peak to peak, as a fraction of the step; NaN if the shaper rejects the moves
    vibration: float
    #: move time of the longest move in s
    move_time: float
    #: reason if the shaper rejects the moves; else empty
    reason: str = ''


def compare_shapers(
        actuator: Actuator, setpoints: Sequence[tuple[float, float]], known: Known, *,
        seed: int = 0) -> list[Expected]:
    """
    Return the expected residual vibration and move time of each of `CANDIDATES`.

    Parameters
    ----------
    actuator : Actuator
        The identified actuator.
    setpoints : pairs
        Stretches and durations in s.
    known : Known
        Values and covariance; other parameters count as exact.
    seed : int
        Seed of the drawn parameters.

    Returns
    -------
    list of Expected
        In the order of `CANDIDATES`.

    """
    places = [i for i, x in enumerate(known.names) if x in ACTUATOR_FIELDS and known.values]
    drawn = np.random.default_rng(seed).multivariate_normal(
        np.zeros(len(places)), known.covariance[np.ix_(places, places)], _DRAWS)
    truths = [
        actuator.scaled(**{
            known.names[i]: 1.0 + max(by / known.values[i], -0.9)
            for i, by in zip(places, row, strict=True)}) for row in drawn.tolist()]
    found = []
    for shaper in CANDIDATES:
        try:
            plan = actuator.plan(setpoints, shaper)
        except BadInputError as error:
            found.append(Expected(shaper, math.nan, math.nan, str(error)))
            continue
        left = [_vibration(plan, x) for x in truths]
        found.append(Expected(
            shaper, float(np.quantile(left, _MOST)), float(np.max(plan.move_times))))
    return found


def choose(expected: Sequence[Expected], tolerance: float) -> Expected:
    """
    Return the fastest shaper whose residual vibration is within tolerance, else the best one.

    The tolerance is a fraction of the step.

    Raises
    ------
    BadInputError
        If every shaper rejects the moves.

    """
    able = [x for x in expected if not x.reason]
    if not able:
        raise BadInputError(f'no shaper plans the setpoints: {expected[0].reason}')
    good = [x for x in able if x.vibration <= tolerance]
    return min(good, key=lambda x: x.move_time) if good else min(able, key=lambda x: x.vibration)


def _vibration(plan: Plan, truth: Actuator) -> float:
    """Return the residual vibration of a plan, as a fraction of the step, after the worst move."""
    motion = plan.simulate(truth=truth)
    ends = np.cumsum(plan.setpoints[:, 1])
    arrivals = ends - plan.setpoints[:, 1] + plan.move_times
    before, worst = plan.segments[0].start.stretch, 0.0
    for target, arrival, end in zip(plan.setpoints[:, 0], arrivals, ends, strict=True):
        after = motion.stretches[(motion.times >= arrival) & (motion.times <= end)]
        if len(after) and abs(target - before) > _STEP:
            worst = max(worst, float(np.ptp(after)) / abs(target - before))
        before = target
    return worst
