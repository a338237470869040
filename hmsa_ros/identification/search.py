"""The search for the best fit, from as many starts as it takes, and for others as good."""

from collections.abc import Mapping, Sequence
import math

import numpy as np

from hmsa_ros import motion
from hmsa_ros.errors import BadInputError
from hmsa_ros.identification import diagnosis
from hmsa_ros.identification.fit import Fit, fit, loss, robust_scale
from hmsa_ros.identification.quantities import STATIC
from hmsa_ros.identification.recording import Recording
from hmsa_ros.identification.response import respond, sensed, Setup
from hmsa_ros.identification.start import at_units, scan, seeks_time, segments, starts, static
from hmsa_ros.model.equations import Array

# Residuals this near to the scatter of their differences are white enough for a first look.
_NEAR_WHITE = 1.5
# Neighbours that are both outliers, as a share of all, from which on they may be motion.
_ADJACENT = 0.002
# Simulations for each of the starts; the best one goes on. Once there is a fit, the others get
# fewer, and the rest only if the loss is within this factor of the best.
_FIRST_PASSES, _FEW_PASSES, _PROMISING = 25, 8, 4.0
# A time unit seen in the data is tried before the others up to this factor from the given one.
_FAR = 4.0
# Outliers so unlikely to lie in motion by chance make a fit one to go on from.
_DOUBT = 0.05
# As many fits at one optimum end the search.
_ENOUGH = 2
# Fits within this share of the deviations, or of the scale, are one optimum.
_SAME = 0.02
# Fewer samples, or fewer of them a period, may be fitted by several frequencies.
_FEW_SAMPLES, _FEW_A_PERIOD = 200, 2.0
# Frequencies to start from, the highest in sampling rates, and the share of critical damping.
_FREQUENCIES, _HIGHEST, _DECAY = 33, 5.0, 0.1
# Fits whose chi-squared is this much larger at most are rivals, if their frequencies are this
# factor apart.
_RIVAL, _ANOTHER = 10.0, 1.05
# Chance of as much motion in samples of an actuator at rest, below which they show some.
_MOVES = 1e-3


def _near(found: Fit) -> bool:
    """Whether a fit came to its end near the motion, whatever did not count."""
    return found.converged and found.scale < diagnosis.DISTANT * float(
        np.std(found.recording.stretch)) and not diagnosis.mistaken(found, _DOUBT)


def _good(found: Fit) -> bool:
    """Whether a fit leaves little but white noise, and outliers here and there."""
    out = found.weights < 0.5
    # Of few samples a level even what is far off differs from one to the next.
    return _near(found) and bool(
        found.scale < _NEAR_WHITE * robust_scale(np.diff(found.residual)) / math.sqrt(2.0)
        and np.count_nonzero(out[1:] & out[:-1]) <= _ADJACENT * len(out))


def search(
        recording: Recording, values: Mapping[str, float], free: Sequence[str]
) -> tuple[Fit, int, int]:
    """
    Return the best of the fits, how many there are, and how many ended there.

    Raises `BadInputError` if no start leads to a motion.
    """
    found: list[Fit] = []

    def tried(candidates: Sequence[Mapping[str, float]]) -> bool:
        return any(
            _descended(found, recording, x, free) and (_good(found[-1]) or _settled(found))
            for x in candidates)

    given = starts(recording, values, free)
    nearest = min((given[0], given[-1]), key=lambda x: _miss(recording, x))
    # A frequency far from that of the values given may be one of the noise.
    near = abs(math.log(nearest['time_unit'] / values['time_unit'])) < math.log(_FAR)
    if not near or not tried([nearest]):
        # All time units, and what else was seen in the data; the likeliest first.
        others = [*scan(recording, values, free),
                  *(x for x in given if not near or x is not nearest)]
        tried(sorted(others, key=lambda x: _miss(recording, x)))
    if not found:
        raise BadInputError(
            f'no start value leads to a motion that {recording.label} could be compared with: '
            'expected levels in T that the actuator of --params-file can hold, as those of hmsa '
            'excite --params-file actuator.yaml --out levels.csv')
    best, agreed = _best(found)
    if not best.converged:
        best = fit(recording, best.values, free) or best
    return best, len(found), agreed


def _best(found: Sequence[Fit]) -> tuple[Fit, int]:
    """Return the likeliest fit, and how many ended there."""
    scale = min(x.scale for x in found)
    losses = [loss(x.residual, scale) for x in found]
    agreed = sum(x < (1.0 + _SAME) * min(losses) for x in losses)
    return found[int(np.argmin(losses))], agreed


def _promising(found: Sequence[Fit], one: Fit) -> bool:
    """Whether a fit that has not ended may still become the likeliest."""
    best, _ = _best([x for x in found if x.converged] or found)
    return loss(one.residual, best.scale, convex=True) < _PROMISING * loss(
        best.residual, best.scale, convex=True)


def _settled(found: Sequence[Fit]) -> bool:
    """Whether several starts ended at the likeliest fit, though it leaves more than noise."""
    best, agreed = _best(found)
    return agreed >= _ENOUGH and _near(best)


def _miss(recording: Recording, candidate: Mapping[str, float]) -> float:
    """Return how far the motion of some values is from the recorded one in the mean."""
    response = respond(recording, candidate, (), rtol=1e-4)
    return math.inf if response is None else float(
        np.mean(np.abs(recording.stretch - response.stretch)))


def _descended(
        found: list[Fit], recording: Recording, start: Mapping[str, float], free: Sequence[str]
) -> bool:
    """Add the fit from a start, if any; in full where it may become the likeliest."""
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

    Looked for where samples are few, or fewer than two a period: from frequencies all over the
    range that they could have come from.
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
    Return what only motion shows, if rest at each level explains the samples as well as motion.

    As well is what the test of Fisher cannot tell apart, of as many frequencies as are tried.
    """
    # Slow to load, and no use to a planner that estimates.
    from scipy.special import fdtrc

    recording, values = best.recording, best.values
    setup = Setup.of(values, best.free)
    place = recording.place(recording.time - values['sensor_latency'])
    levels, which = np.unique(recording.levels[place], return_inverse=True)
    rests: Array = np.empty(len(levels))
    slopes: Array = np.empty((len(levels), len(setup.wanted)))
    for i, level in enumerate(levels.tolist()):
        rests[i] = motion.rest(setup.theta, setup.material, level, setup.wanted, slopes[i])
    if not np.all(np.isfinite(rests)):
        return set()
    rests, by = sensed(
        values, best.free, rests, np.zeros(len(rests)),
        values['stretch_gain'] * slopes @ setup.mixing)
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
