"""Which shaper suits an actuator that is known so well."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from hmsa_ros.api.actuator import Actuator
from hmsa_ros.api.plan import Plan
from hmsa_ros.errors import BadInputError
from hmsa_ros.identification.known import Known
from hmsa_ros.interfaces.parameters import ACTUATOR_FIELDS

#: Shapers that are compared, the quickest first.
CANDIDATES = ('two_step', 'zvd', 'robust', 'minimax', 'smooth')
_DRAWS = 24
# Share of the draws that leave at most the vibration given.
_MOST = 0.95
# Smaller steps, in stretch, have no share worth comparing.
_STEP = 1e-9


@dataclass(frozen=True)
class Expected:
    """What a shaper is expected to do with an actuator that is known so well."""

    shaper: str
    #: residual vibration, peak to peak, as a share of the step, that 95 % of the actuators that
    #: the actuator may be leave at most; of the worst move; NaN where it does not plan them
    vibration: float
    #: of the longest move, in s
    move_time: float
    #: why it does not plan the moves; empty if it does
    reason: str = ''


def compare_shapers(
        actuator: Actuator, setpoints: Sequence[tuple[float, float]], known: Known, *,
        seed: int = 0) -> list[Expected]:
    """
    Return what each of `CANDIDATES` is expected to leave.

    Parameters
    ----------
    actuator : Actuator
        As identified.
    setpoints : pairs
        Stretch and duration in s.
    known : Known
        Values and covariance; what is not in it counts as exact.
    seed : int
        Of the actuators that are drawn.

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
    Return the quickest shaper that leaves at most a share of the step; else the best one.

    Raises
    ------
    BadInputError
        If none of them plans the moves.

    """
    able = [x for x in expected if not x.reason]
    if not able:
        raise BadInputError(f'no shaper plans the setpoints: {expected[0].reason}')
    good = [x for x in able if x.vibration <= tolerance]
    return min(good, key=lambda x: x.move_time) if good else min(able, key=lambda x: x.vibration)


def _vibration(plan: Plan, truth: Actuator) -> float:
    """Return what a plan leaves on an actuator, after the worst of its moves."""
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
