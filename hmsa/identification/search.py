"""Search for the best fit from several starts, and for others that are as good."""

from collections.abc import Mapping, Sequence
import math
from typing import Any

import numpy as np

from hmsa.errors import BadInputError
from hmsa.identification import diagnosis, quantities
from hmsa.identification.fit import Fit, fit, loss, robust_scale
from hmsa.identification.initial_guess import at_units, scan, seeks_time, segments, starts, static
from hmsa.identification.measurement import Measurement
from hmsa.identification.quantities import STATIC
from hmsa.identification.response import (
    difference,
    differenced,
    respond,
    ResponseArguments,
    sensed,
)
from hmsa.model.equations import Array
from hmsa.motion import derivatives

# Ratio of residuals to their increments up to which they are white enough for a first check.
_NEAR_WHITE = 1.5
# Fraction of samples that are outliers next to outliers, above which they may be motion.
_ADJACENT = 0.002
# Simulations for each start; the best fit continues. Once there is a fit, further starts get fewer
# simulations, and more only if their loss is within this factor of the best.
_FIRST_PASSES, _FEW_PASSES, _PROMISING = 25, 8, 4.0
# A time unit found in the data is tried first if it is within this factor of the given one.
_FAR = 4.0
# Probability that outliers lie in motion by chance, below which a fit is not used.
_DOUBT = 0.05
# Number of fits at one optimum that ends the search.
_ENOUGH = 2
# Relative tolerance within which fits are one optimum.
_SAME = 0.02
# With fewer samples, or fewer per period, several frequencies may fit.
_FEW_SAMPLES, _FEW_A_PERIOD = 200, 2.0
# Number of start frequencies, the highest in sampling rates, and the damping ratio.
_FREQUENCIES, _HIGHEST, _DECAY = 33, 5.0, 0.1
# Maximum excess of chi-squared of a rival fit, and minimum ratio of its frequency.
_RIVAL, _ANOTHER = 10.0, 1.05
# Probability of such motion in samples of an actuator at rest, below which they show motion.
_MOVES = 1e-3


def _near(found: Fit) -> bool:
    """Return whether a fit converged near the motion, whatever the outliers are."""
    return found.converged and found.scale < diagnosis.DISTANT * float(
        np.std(found.recording.stretch)) and not diagnosis.mistaken(found, _DOUBT)


def _good(found: Fit) -> bool:
    """Return whether a fit leaves only white noise and isolated outliers."""
    out = found.weights < 0.5
    # With few samples per level even large residuals differ from one to the next.
    return _near(found) and bool(
        found.scale < _NEAR_WHITE * robust_scale(np.diff(found.residual)) / math.sqrt(2.0)
        and np.count_nonzero(out[1:] & out[:-1]) <= _ADJACENT * len(out))


def search(
        recording: Measurement, values: Mapping[str, float], free: Sequence[str]
) -> tuple[Fit, int, int]:
    """
    Return the best fit, the number of fits, and how many of them agree with it.

    Raise `BadInputError` if no start leads to a motion.
    """
    found: list[Fit] = []

    def tried(candidates: Sequence[Mapping[str, float]]) -> bool:
        return any(
            _descended(found, recording, x, free) and (_good(found[-1]) or _settled(found))
            for x in candidates)

    given = starts(recording, values, free)
    nearest = min((given[0], given[-1]), key=lambda x: _miss(recording, x))
    # A frequency far from that of the given values may be due to noise.
    near = abs(math.log(nearest['time_unit'] / values['time_unit'])) < math.log(_FAR)
    if not near or not tried([nearest]):
        # Try all time units and other values found in the data, the most likely first.
        others = [*scan(recording, values, free),
                  *(x for x in given if not near or x is not nearest)]
        tried(sorted(others, key=lambda x: _miss(recording, x)))
    if not found:
        raise BadInputError(
            f'no start value leads to a motion that is comparable with {recording.label}: '
            'expected levels in T that the actuator of --params-file can hold, as those of hmsa '
            'excite --params-file actuator.yaml --out levels.csv')
    best, agreed = _best(found)
    if not best.converged:
        best = fit(recording, best.values, free) or best
    return best, len(found), agreed


def _best(found: Sequence[Fit]) -> tuple[Fit, int]:
    """Return the most likely fit, and the number of fits that agree with it."""
    scale = min(x.scale for x in found)
    losses = [loss(x.residual, scale) for x in found]
    agreed = sum(x < (1.0 + _SAME) * min(losses) for x in losses)
    return found[int(np.argmin(losses))], agreed


def _promising(found: Sequence[Fit], one: Fit) -> bool:
    """Return whether a fit that has not converged may still become the best."""
    best, _ = _best([x for x in found if x.converged] or found)
    return loss(one.residual, best.scale, convex=True) < _PROMISING * loss(
        best.residual, best.scale, convex=True)


def _settled(found: Sequence[Fit]) -> bool:
    """Return whether several starts agree on the best fit, even if it leaves more than noise."""
    best, agreed = _best(found)
    return agreed >= _ENOUGH and _near(best)


def _miss(recording: Measurement, candidate: Mapping[str, float]) -> float:
    """Return the mean absolute deviation of the simulated from the recorded motion."""
    response = respond(recording, candidate, (), rtol=1e-4)
    return math.inf if response is None else float(
        np.mean(np.abs(recording.stretch - response.stretch)))


def _descended(
        found: list[Fit], recording: Measurement, start: Mapping[str, float], free: Sequence[str]
) -> bool:
    """Add the fit from a start, in full if it may become the best; return whether there is one."""
    few = any(x.converged for x in found)
    one = fit(recording, start, free, most=_FEW_PASSES if few else _FIRST_PASSES)
    if few and one is not None and not one.converged and _promising(found, one):
        one = fit(recording, one.values, free, most=_FIRST_PASSES)
    if one is not None:
        found.append(one)
    return one is not None


def rivals(best: Fit) -> tuple[Fit, list[Fit]]:
    """
    Return the best fit, and those of other frequencies that are nearly as good.

    The search covers the whole possible range of frequencies. It is only made if there are few
    samples, or fewer than two per period.
    """
    recording = best.recording
    gap = recording.gap
    many = diagnosis.frequency_of(best) * gap * _FEW_A_PERIOD < 1.0
    longest = max((float(recording.time[end - 1] - recording.time[begin])
                   for begin, end, _, _ in segments(recording)), default=0.0)
    if many and len(recording.time) >= _FEW_SAMPLES or longest <= gap or not seeks_time(
            best.values, best.free):
        return best, []
    found = [best]
    natural = diagnosis.frequency_of(best) * best.values['time_unit']
    units = np.asarray(natural / np.geomspace(
        1.0 / longest, _HIGHEST / gap, _FREQUENCIES), dtype=np.float64)
    for start in at_units(
            best.values, best.free, units, _DECAY, static(recording, best.values, best.free)):
        _descended(found, recording, start, best.free)
    scale = min(x.scale for x in found)
    deviances = [2.0 * loss(x.residual, scale) for x in found]
    best, *rest = (found[i] for i in np.argsort(deviances, kind='stable'))
    least, others = min(deviances), list[Fit]()
    for one in rest:
        if 2.0 * loss(one.residual, scale) < least + _RIVAL and all(abs(math.log(
                diagnosis.frequency_of(one) / diagnosis.frequency_of(x))) > math.log(_ANOTHER)
                for x in (best, *others)):
            others.append(one)
    return best, others


def unmoved(best: Fit) -> set[str]:
    """
    Return undetermined parameters, if rest at each level explains the samples as well as motion.

    The test is Fisher's F-test, corrected for the number of frequencies tried.
    """
    # Slow to import, and not needed by a planner that estimates.
    from scipy.special import fdtrc

    recording, values = best.recording, best.values
    setup = ResponseArguments.of(values, best.free)
    place = recording.place(recording.time - values['sensor_latency'])
    levels, which = np.unique(recording.levels[place], return_inverse=True)
    rests: Array = np.empty(len(levels))
    slopes: Array = np.empty((len(levels), len(setup.wanted)))
    for i, level in enumerate(levels.tolist()):
        rests[i] = derivatives.rest(setup.theta, setup.material, level, setup.wanted, slopes[i])
    if not np.all(np.isfinite(rests)):
        return set()
    rests, by = sensed(
        values, best.free, rests, np.zeros(len(rests)),
        values['stretch_gain'] * slopes @ setup.mixing)

    def rests_at(other: Mapping[str, Any]) -> Array | None:
        setup = ResponseArguments.of(quantities.complete(other, ()), ())
        found = np.array([derivatives.rest(
            setup.theta, setup.material, x, setup.wanted, np.empty(0)) for x in levels.tolist()])
        return values['stretch_gain'] * found if np.all(np.isfinite(found)) else None

    for name in differenced(values, best.free):
        column = difference(values, name, rests_at)
        if column is not None:
            by[:, best.free.index(name)] = column
    weighted = best.root * (recording.stretch - rests[which])
    columns = best.root[:, None] * by[which]
    shift, _, rank, _ = np.linalg.lstsq(columns, weighted, rcond=1e-9)
    still = float(np.sum((weighted - columns @ shift) ** 2))
    moving = float(np.sum((best.root * best.residual) ** 2))
    more = len(best.free) - int(rank)
    freedom = max(float(np.sum(best.weights)) - len(best.free), 1.0)
    if not more or moving == 0.0 or _FREQUENCIES * float(fdtrc(
            more, freedom, (still / moving - 1.0) * freedom / more)) < _MOVES:
        return set()
    if seeks_time(values, best.free):
        return set(best.free) - STATIC
    return {x for x, column in zip(best.free, by.T, strict=True) if not np.any(column)}
