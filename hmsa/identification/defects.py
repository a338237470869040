"""
Possible departures from the model, each as a direction of the residuals.

A direction is the change of every sample by a small amount of the departure: the derivative of the
motion by a lag, a friction, a viscoelastic branch. The part that the free parameters can explain
is removed. The remaining part in the residuals shows whether the departure is present, and how far
it changes the estimates. If this is likely but not proved, intervals include the estimates with
and without it. Departures without an effect on the residuals, such as a gain for which the
remanence compensates, widen the intervals by their possible size (S. F. Schmidt, "Application of
state-space methods to navigation problems", 1966).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from hmsa.identification.fit import Fit, inflation, Whiteness, whiteness
from hmsa.identification.quantities import BRANCHES, quantity_of
from hmsa.identification.response import respond
from hmsa.identification.result import Defect
from hmsa.model.equations import Array
from hmsa.motion import derivatives

# Minimum size of a departure in standard deviations, together with a minimum fraction of the
# residuals, or a minimum change of an estimate in standard deviations.
_DEVIATIONS, _SHARE, _MOVES = 4.5, 0.02, 1.0
# Size in standard deviations above which intervals include it.
_HINT = 2.0
# Median of chi-squared with one degree of freedom, by which the median square of a deviation is
# biased.
_MEDIAN = 0.455
GAIN = 'stretch_gain'
#: Standard deviation of an unknown gain, and that of its estimate above which it is undetectable.
USUAL_GAIN, _HIDDEN_GAIN = 0.02, 0.006
# Relative tolerance of the integration, sufficient for directions.
_RTOL = 1e-6
_DELAYS = {'sensor_latency', 'coil_time_constant'}
# Descriptions, and parameters to free, by parameter.
_PARAMETERS = {
    'coil_time_constant': 'lag of the coil', 'sensor_latency': 'latency of the sensor',
    GAIN: 'gain of the sensor', 'constant_force': 'constant force'}
_FORCES = {
    derivatives.FRICTION: 'friction that does not depend on the rate',
    derivatives.SQUARE: 'damping by the square of the rate'}


class Departure(NamedTuple):
    """The effect of a small departure."""

    name: str  # description
    column: Array  # change of each sample, shape (n,)
    remedy: str = ''  # parameters to free


def _columns(fit: Fit) -> Iterator[Departure]:
    recording, time = fit.recording, fit.recording.time
    values = dict(fit.values)
    # Switches at unknown times resemble lag and latency, and represent both.
    names = [x for x in _PARAMETERS if x not in fit.free and not (
        recording.earlier and x in _DELAYS)]
    made = [(_PARAMETERS[x], x) for x in names]
    if 'viscoelastic_ratio' not in fit.free and not values['viscoelastic_ratio']:
        # Branches of zero stiffness, all in one simulation.
        span = float(time[-1] - time[0])
        for (ratio, tau), seconds in zip(
                BRANCHES, (2.0 * values['time_unit'], 0.03 * span, 0.3 * span), strict=True):
            names.append(ratio)
            made.append((f'creep with a time of {seconds:.2g} s',
                         'viscoelastic_ratio,viscoelastic_time'))
            values[tau] = seconds
    made += [(x, '') for x in _FORCES.values()]
    response = respond(recording, values, names, rtol=_RTOL, more=tuple(_FORCES))
    if response is not None:
        for (name, remedy), column in zip(made, response.jacobian.T, strict=True):
            yield Departure(name, column, remedy)
    yield Departure(
        'drift of the sensor or the temperature', time - 0.5 * (time[0] + time[-1]))
    levels = recording.levels
    signs = np.sign(np.diff(levels, prepend=levels[0]))
    for i in range(1, len(signs)):
        signs[i] = signs[i] or signs[i - 1]
    sign = signs[recording.place(time)]
    if len(set(sign.tolist()) - {0.0}) > 1:
        yield Departure(
            'hysteresis: rest depends on whether the level was raised or lowered', sign)


@dataclass(frozen=True, eq=False)
class Departures:
    """All departures, tested on the residuals of a fit."""

    signatures: tuple[Defect, ...]  # the largest first
    hint: Array  # variance of the coordinates due to likely departures, shape (p,)
    # Change of the coordinates by one standard deviation of each undetectable error, by name.
    considered: dict[str, Array]
    # Largest unknown latency of the sensor in s that is not detected, and its effect; or None.
    late: tuple[float, Array] | None


def departures(
        fit: Fit, found: Whiteness, inverse: Array, deviation: float,
        given: Mapping[str, float | None]) -> Departures:
    """
    Test all possible departures on the residuals.

    ``inverse`` is that of the information for unit noise, ``deviation`` that of a sample.
    ``given`` contains parameters known to the caller, with standard deviations, None if exact.
    """
    root = fit.root
    base = root[:, None] * np.hstack([fit.response.jacobian, fit.response.by_switch])
    own = root[:, None] * fit.jacobian
    scale = np.maximum(np.linalg.norm(base, axis=0), 1e-300)
    base = base / scale
    gram = base.T @ base
    solved = np.linalg.inv(gram + 1e-13 * np.trace(gram) * np.eye(len(gram)))
    residual = root * fit.residual
    total = float(residual @ residual)
    floor = dead_band(fit, deviation)
    single = np.sqrt(np.diag(inverse)) * deviation
    named = list(_columns(fit))
    columns = root[:, None] * np.stack([x.column for x in named], axis=1)
    directions = columns
    for _ in range(2):
        directions = directions - base @ (solved @ (base.T @ directions))
    norms, lengths = (np.linalg.norm(x, axis=0) for x in (directions, columns))
    directions = directions / np.maximum(norms, 1e-300)
    ways = (inverse @ (own.T @ columns)).T
    signatures, considered = list[Defect](), dict[str, Array]()
    hint: Array = np.zeros(len(fit.free))
    late = None
    for one, direction, norm, length, way in zip(
            named, directions.T, norms.tolist(), lengths.tolist(), ways, strict=True):
        if one.remedy == GAIN and GAIN not in given and (
                deviation / max(norm, 1e-300) > _HIDDEN_GAIN):
            considered[GAIN] = USUAL_GAIN * way
        if total == 0.0 or norm <= 3e-5 * length:
            continue
        size = float(direction @ residual)
        spread = math.sqrt(max(total - size ** 2, 0.0) / max(
            len(residual) - len(fit.free) - 1, 1))
        if not found.white:
            spread *= inflation(direction, whiteness(residual - size * direction))
        deviations, share = abs(size) / max(spread, 1e-300), size * size / total
        moves = abs(size) / norm * np.abs(way)
        signatures.append(Defect(one.name, share, deviations, bool(
            deviations > _DEVIATIONS and abs(size) / math.sqrt(len(residual)) > floor
            and (share > _SHARE or np.max(moves / single) > _MOVES)), one.remedy))
        if one.remedy == 'sensor_latency' and one.remedy not in given and not (
                signatures[-1].found):
            seconds = _DEVIATIONS * spread / norm
            late = seconds, seconds * way
        # An offset of the timestamps is most common, and least detectable, like an unknown gain.
        late_or_off = 'latency' in one.name and not _DELAYS.intersection(fit.free) or (
            one.remedy == GAIN and GAIN not in given)
        least = 0.0 if late_or_off else _HINT
        if deviations > least:
            hint = np.maximum(
                hint, (way / norm) ** 2 * max(size ** 2 - _MEDIAN * spread ** 2, 0.0))
    for name, std in given.items():
        if std and name not in fit.free:
            considered[name] = std * (inverse @ (own.T @ (root * _change(fit, name))))
    return Departures(tuple(sorted(
        signatures, key=lambda x: (-x.found, -x.share))), hint, considered, late)


def dead_band(fit: Fit, deviation: float) -> float:
    """Return the RMS effect of quantisation that noise does not average out."""
    quantum = fit.recording.quantum
    if not quantum:
        return 0.0
    # The first harmonic of the quantisation, smoothed by normal noise.
    noise = math.sqrt(max((deviation / quantum) ** 2 - 1.0 / 12.0, 0.0))
    return quantum * min(0.3, math.exp(-2.0 * (math.pi * noise) ** 2) / math.pi)


def _change(fit: Fit, name: str) -> Array:
    """Return the derivative of the samples by a given value."""
    values, timed = fit.values, quantity_of(name).unit == 's'
    little = 1e-3 * abs(values[name]) or (1e-3 * values['time_unit'] if timed else 1e-4)
    ends = []
    for change in (little, -little):
        response = respond(fit.recording, {**values, name: values[name] + change}, ())
        ends.append(fit.response.stretch if response is None else response.stretch)
    found: Array = (ends[0] - ends[1]) / (2.0 * little)
    return found
