"""
The rule of judgement: an equivalence test with three results.

A setpoint is arrived at if samples show steady-state error and vibration to be within their
tolerances, missed if they show one to be outside, and undecided otherwise.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
import math

import numpy as np
from numpy.typing import NDArray

from hmsa.judge._ringing import largest
from hmsa.judge.fit import BoundedValue, FEWEST, fit, INDEPENDENT, MODES, VibrationFit
from hmsa.judge.records import (
    Finding,
    PERIODS,
    RequestedSetpoint,
    SensorModel,
    Tolerances,
    unobserved,
    VERDICTS,
)
from hmsa.model.equations import Array
from hmsa.model.status import Code
from hmsa.model.units import NANOSECONDS

Stamps = NDArray[np.int64]

#: Samples of a window at low sampling rates.
ENOUGH = 24
# Parts of a period, in each of which samples are averaged.
_KEPT = 64
# RMS deviation from the target, relative to a tolerance, below which it is always within the
# tolerance.
_QUIET = 0.3
# Fit residual, relative to a tolerance, that counts as zero.
_NOTHING = 0.01
# Upper bound of the peak-to-peak noise in a period, in standard deviations.
_PEAKS = 7.0
# Samples per period above which they show the range of motion directly.
_SEEN = 12
# Numbers of samples to average in the test of a motion that does not ring.
_TOGETHER = (1, 3, 9)
# Factor on the distance of the bounds that a miss requires, relative to an arrival.
_SURER = 1.5
# Factor on the reduction of noise that the present estimates demand: they are noisy themselves.
_ADVISED = 1.5
# Samples per value, of a sensor that rounds.
_REPEATED = 3
# Changes between samples, relative to the step, that belong to a motion that fades.
_FADED = 1e-9
# Distance from a target without a step that is rounding, in stretch.
_SAME = 1e-6
# Size of a mode, relative to the largest, from which it is named.
_SHOWN = 0.2
# Number of changes below which the rounding of a sensor is not tested.
_FEW_CHANGES = 3
# A sensor is at an end of its range if it shows the same extreme for this many samples after a
# change of more than this fraction of the largest one, unlike a motion that fades.
_SAME_SAMPLES, _SUDDEN = 3, 0.05
_NO_SENSOR = SensorModel()


def judge(
        time: Stamps, stretch: Array, setpoint: RequestedSetpoint,
        tolerances: Tolerances = Tolerances(), *,  # noqa: B008
        sensor: SensorModel = _NO_SENSOR) -> Finding:
    """
    Judge samples of a setpoint.

    Parameters
    ----------
    time : array of int
        Timestamps in ns, in any order, shape (n,). Samples before the arrival and after the end
        only serve to check the sensor.
    stretch : array
        Measured stretch, shape (n,); NaN for missing values.
    setpoint : RequestedSetpoint
        The setpoint as requested.
    tolerances : Tolerances
        Tolerances for an arrival.
    sensor : SensorModel
        Known properties of the sensor.

    Returns
    -------
    Finding
        The worst finding of all windows of the hold.

    """
    stamps, values, complaint = _usable(time, stretch, setpoint, sensor)
    if complaint:
        return unobserved(setpoint, complaint, len(stamps))
    begin, moved = setpoint.rests_from, setpoint.moved
    found = _judged(stamps, values, setpoint, tolerances, sensor, begin)
    if found.arrived or moved is None:
        return found
    # It did not follow the first plan; it may have followed a replanned one.
    again = _judged(stamps, values, setpoint, tolerances, sensor, moved)
    after = moved - (setpoint.end or moved + 1)
    return again if not again.arrived or after < 0 else replace(
        again, verdict=Code.LATE,
        message=f'{again.message}, but {after / 1e6:.3g} ms after its time')


def _judged(
        stamps: Stamps, values: Array, setpoint: RequestedSetpoint, tolerances: Tolerances,
        sensor: SensorModel, begin: int) -> Finding:
    """Judge usable samples of a setpoint from a time in ns on."""
    first, last = int(np.searchsorted(stamps, begin)), len(stamps)
    if setpoint.end is not None and not setpoint.held and begin < setpoint.end:
        last = int(np.searchsorted(stamps, setpoint.end, 'right'))
    if first >= last:
        return unobserved(setpoint)
    usable, every = values, (stamps[first:last], values[first:last])
    stamps, values = _thinned(*every, begin, setpoint)
    allowed, swing = tolerances.of(setpoint)
    least = min(allowed, swing)
    quiet = _QUIET * least
    findings: list[Finding] = []
    noise, alike = math.inf, 1.0
    for number, part in enumerate(_looks(stamps, begin, setpoint)):
        rest = values[part] - setpoint.target
        moves = number > 0 and (
            _largest(stamps[part], rest, setpoint) - _PEAKS * noise > swing)
        if number and not moves and float(rest @ rest) <= quiet**2 * len(rest):
            continue
        # In later windows the vibration counts from their own start.
        origin = int(stamps[part][0]) if number else begin
        seconds: Array = (stamps[part] - origin) / NANOSECONDS
        decided = partial(
            _decided, count=len(rest), setpoint=setpoint, limits=(allowed, swing), sensor=sensor,
            moves=moves if number else None)
        shown = fit(
            seconds, rest, setpoint.frequency, setpoint.decay,
            partial(_settles, decided=decided, nothing=_NOTHING * least),
            nothing=_NOTHING * least)
        if shown is not None:
            findings.append(decided(shown))
            noise = min(noise, shown.usual)
            alike = min(alike, shown.independent)
        elif not number:
            findings.append(_too_few(setpoint, stamps[part]))
    # Among equal findings prefer the first window, which shows the vibration; else the worst one.
    found = max(
        findings, key=lambda x: (VERDICTS.index(x.verdict), x is findings[0], x.rank[1]))
    most = _largest(*every, setpoint)
    if found.verdict is Code.VIBRATING and most <= swing and (
            len(every[0]) > _SEEN * (every[0][-1] - every[0][0]) / setpoint.period):
        # The fitted vibration is larger than any motion.
        return replace(found, verdict=Code.UNDECIDED, message=(
            f'{found.message}, but nothing moves by more than {setpoint.words(most)}: it does not '
            'ring like an actuator'))
    step = (_rounded_to(every[1]) if found.verdict is Code.VIBRATING
            else _rounded_to(usable, _FEW_CHANGES))
    if step and _may_be_rounding(
            found, step, math.sqrt(len(every[0]) / len(stamps)) * found.noise, allowed, swing):
        return replace(found, verdict=Code.UNDECIDED, message=(
            f'{found.message}, but the sensor rounds to {setpoint.words(step)}'))
    if not found.arrived:
        return found
    # Of many samples in a period the range of the noise is larger.
    dense = len(every[0]) * setpoint.period / max(int(every[0][-1] - every[0][0]), 1)
    peaks = max(_PEAKS, 2.0 * math.sqrt(2.0 * math.log(max(dense, 2.0))) + 2.0)
    moves = most - peaks * noise * math.sqrt(len(every[0]) / len(stamps)) > swing
    for together in _TOGETHER:
        if moves or len(values) < 2 * together:
            break
        after = (together - 1) // 2
        most = _largest(
            stamps[after:len(stamps) - after],
            np.convolve(values, np.full(together, 1.0 / together), mode='valid'), setpoint)
        moves = most - _PEAKS * noise * min(1.0 / math.sqrt(alike * together), 1.0) > swing
    return found if not moves else replace(
        found, verdict=Code.UNDECIDED, message=f'{found.message}, but moves by '
        f'{setpoint.words(most)} without ringing: a disturbance of the actuator and one of its '
        'sensor look the same')


def _largest(stamps: Stamps, rest: Array, setpoint: RequestedSetpoint) -> float:
    """Return the largest peak-to-peak motion within a period of a window."""
    return largest(stamps, rest, int(stamps[0]), setpoint.period)


# -- samples ------------------------------------------------------------------------------------

def _usable(
        time: Stamps, stretch: Array, setpoint: RequestedSetpoint,
        sensor: SensorModel) -> tuple[Stamps, Array, str]:
    """Return the valid samples by time, corrected for the sensor, and the reason if none is."""
    stamps = np.ascontiguousarray(time, dtype=np.int64)
    values = np.ascontiguousarray(stretch, dtype=np.float64)
    finite = np.isfinite(values)
    if not finite.all():
        if not finite.any():
            return stamps[:0], values[:0], 'the sensor shows no numbers'
        stamps, values = stamps[finite], values[finite]
    if not (stamps[1:] > stamps[:-1]).all():
        # Not by np.unique, whose first call imports numpy.ma: 20 ms without a command.
        order = np.argsort(stamps, kind='stable')
        first = order[np.append(True, np.diff(stamps[order]) > 0)]
        stamps, values = stamps[first], values[first]
    if sensor is not _NO_SENSOR:
        values = (values - sensor.bias) / sensor.gain
        stamps = stamps - round(sensor.latency * NANOSECONDS)
    low, high = setpoint.possible
    inside = (values > low) & (values < high)
    outside = len(values) - int(np.count_nonzero(inside))
    if not outside:
        return stamps, values, _frozen(values, setpoint)
    if 2 * outside > len(values):
        value = float(np.median(values[~inside]))
        return stamps[:0], values[:0], (
            f'the sensor shows {value:.4g}, where nothing can be: expected {low:.4g} to '
            f'{high:.4g}; look at its gain, offset and length at rest')
    stamps, values = stamps[inside], values[inside]
    return stamps, values, _frozen(values, setpoint)


def _frozen(values: Array, setpoint: RequestedSetpoint) -> str:
    """Return a message if a sensor is constant at the end after motion; empty if not."""
    if len(values) < FEWEST or (values[1 - FEWEST:] != values[-FEWEST:-1]).any():
        return ''
    changes = np.abs(np.diff(values))
    moved = np.flatnonzero(changes)
    same = len(changes) - int(moved[-1] + 1 if len(moved) else 0) + 1
    if same < FEWEST:
        return ''
    words = f'the sensor shows exactly {values[-1]:.6g} in the last {same} samples'
    if len(moved) < _FEW_CHANGES:
        off = abs(float(values[-1]) - setpoint.target) > _QUIET * setpoint.step
        return f'{words}: it is frozen, or nothing moves' if off else ''
    before = changes[:moved[-1] + 1][-FEWEST:]
    # A motion that fades becomes ever slower, and a sensor that rounds moves by whole steps.
    step = float(np.min(changes[moved]))
    rounds = _whole(changes[moved] / step)
    if not rounds and values[-1] in cut_off_at(values):
        return f'{words}, and never beyond: it is at the end of its range'
    # And one that ends where it was to end, as in a simulation without noise, is at rest there.
    ends = abs(float(values[-1]) - setpoint.target) < _FADED * setpoint.step
    if rounds or ends or np.median(before) < _FADED * setpoint.step:
        return ''
    return f'{words}: it is frozen'


def cut_off_at(values: Array) -> list[float]:
    """Return the extremes at which a sensor that does not round seems to cut values off."""
    changes = np.abs(np.diff(values))
    edges = np.flatnonzero(changes) + 1
    if len(edges) < _FEW_CHANGES:
        return []
    same = values[edges[:-1]][(np.diff(edges) >= _SAME_SAMPLES) & (
        changes[edges[:-1] - 1] > _SUDDEN * np.max(changes))]
    return [x for x in (float(np.min(values)), float(np.max(values))) if x in same]


def _rounded_to(values: Array, fewest: int = 1) -> float:
    """Return the step to which a sensor rounds by its changes; 0 if it does not."""
    steps = np.diff(np.sort(values))
    steps = steps[steps > 0.0]
    shown = len(steps) + 1
    # Steps of which rounding errors of the conversion are no part.
    steps = steps[steps > 1e-6 * np.sum(steps)]
    if len(steps) < fewest or _REPEATED * shown >= len(values):
        return 0.0
    step = float(np.min(steps))
    return step if _whole(steps / step) else 0.0


def _whole(numbers: Array) -> bool:
    """Return whether numbers are close to integers."""
    return bool(np.all(np.abs(numbers - np.round(numbers)) < 0.01))


def _may_be_rounding(
        found: Finding, step: float, noise: float, allowed: float, swing: float) -> bool:
    """Return whether a verdict may be due to a sensor that rounds to steps."""
    if found.verdict is Code.VIBRATING:
        return found.vibration - step <= swing
    # Noise of a sample averages rounding: by the first harmonic of its error.
    share = max((noise / step)**2 - 1.0 / 12.0, 0.0)
    error = 0.5 * step * math.exp(-2.0 * math.pi**2 * share)
    if found.verdict is Code.OFF_TARGET:
        return abs(found.offset) - error <= allowed
    # A vibration that crosses steps shows its size.
    hidden = 2.0 * error if found.vibration < step else 0.0
    return found.arrived and (
        abs(found.offset) + error > allowed or found.vibration + hidden > swing)


def _thinned(
        stamps: Stamps, values: Array, begin: int, setpoint: RequestedSetpoint
) -> tuple[Stamps, Array]:
    """Return the mean sample of each part of a period, in which the vibration hardly changes."""
    parts = (stamps - begin) // max(setpoint.period // _KEPT, 1)
    new = parts[1:] != parts[:-1]
    if new.all():
        return stamps, values
    first = np.append(0, np.flatnonzero(new) + 1)
    counts = np.diff(first, append=len(stamps))
    after = np.add.reduceat(stamps - begin, first) // counts
    return begin + after, np.add.reduceat(values, first) / counts


def _looks(stamps: Stamps, begin: int, setpoint: RequestedSetpoint) -> Iterator[slice]:
    """Yield the samples of each window: adjacent at first, then ever farther apart."""
    length = setpoint.look
    if len(stamps) > 1:
        gaps = np.sort(stamps[1:] - stamps[:-1])
        length = max(length, ENOUGH * int(gaps[len(gaps) // 2]))
    last = int(stamps[-1])
    place, edges = 0, []
    while begin + place * length < last:
        edges.append(begin + place * length)
        place = 2 * place or 1
    if len(edges) > 1 and last - edges[-1] < length:
        edges.pop()
    if last - begin > 2 * length and (not edges or last - edges[-1] > length):
        edges.append(last - length)
    for number, edge in enumerate(edges or [begin]):
        until = edge + length
        if number == len(edges) - 1 and last - until < length:
            until = last
        part = slice(*np.searchsorted(stamps, (edge, until + 1)).tolist())
        if part.start < part.stop or not number:
            yield part


def _too_few(setpoint: RequestedSetpoint, stamps: Stamps) -> Finding:
    """Return the finding for too few samples, with advice."""
    span = float(stamps[-1] - stamps[0]) / NANOSECONDS if len(stamps) else 0.0
    period = 2.0 * math.pi / setpoint.frequency
    least = 2.0 * period
    if len(stamps) < 2:
        span = PERIODS * period
    wanted = (f'a hold of {least:.2g} s' if span < least
              else f'{FEWEST / span:.3g} samples a second')
    return Finding(
        Code.UNDECIDED,
        f'{setpoint.where}: {len(stamps)} samples in {span:.2g} s after the arrival at '
        f'{setpoint.target:.6g} do not show whether it rests: expected at least {wanted}',
        setpoint, len(stamps))


# -- the rule -----------------------------------------------------------------------------------

def _settles(
        found: VibrationFit, *, decided: Callable[[VibrationFit], Finding], nothing: float
) -> bool:
    """Return whether a window is decided, and its fit residual is negligible."""
    return found.noise < nothing and not decided(found).open


def _decided(
        found: VibrationFit, count: int, setpoint: RequestedSetpoint, limits: tuple[float, float],
        sensor: SensorModel, moves: bool | None) -> Finding:
    """Decide on a window by its fit; ``moves`` states, in later ones, whether motion was seen."""
    offset, vibration = _widened(found.offset, sensor.std(setpoint.target)), found.vibration
    allowed, swing = limits
    # One of several windows suffices for a miss, so that each has to be more certain.
    off = offset.value - _SURER * (offset.value - offset.low) > allowed or (
        offset.value + _SURER * (offset.high - offset.value) < -allowed)
    vibrates = vibration.value - _SURER * (vibration.value - vibration.low) > swing
    # After rest, later windows count as rest unless they show motion.
    rests = vibration.high <= swing if moves is None else not moves
    within = max(-offset.low, offset.high) <= allowed and rests
    code = (Code.OFF_TARGET if off else Code.VIBRATING if vibrates
            else Code.ARRIVED if within else Code.UNDECIDED)
    frequency = found.frequency / (2.0 * math.pi) if vibration.low > 0.0 else math.nan
    if vibration.low == 0.0 and vibration.std > swing:
        # The vibration is undetermined.
        vibration = vibration._replace(value=math.nan, std=math.nan)
    message = f'{setpoint.where}: rests {_distance(offset.value, setpoint)}'
    if vibrates:
        shown = [x / (2.0 * math.pi) for x, swing in found.modes if swing > _SHOWN * found.modes[
            0][1]]
        message += (f' and rings at {" and ".join(f"{x:.3g}" for x in shown)} Hz, '
                    f'{setpoint.words(vibration.value)} peak to peak')
    elif off and math.isnan(vibration.value):
        message += f'; {count} samples at this rate do not show whether it vibrates'
    if code is Code.UNDECIDED:
        message += _open(offset, vibration, limits, setpoint, sensor, found.independent)
    if code in (Code.ARRIVED, Code.UNDECIDED) and found.resolved < MODES * setpoint.frequency:
        message += f'; samples resolve up to {found.resolved / (2.0 * math.pi):.3g} Hz'
    return Finding(
        code, message, setpoint, count, offset.value, offset.std, vibration.value, vibration.std,
        frequency, found.noise)


def _widened(figure: BoundedValue, std: float) -> BoundedValue:
    """Return a value with the uncertainty of the sensor included."""
    if not std:
        return figure
    value, own, low, high = figure
    return BoundedValue(
        value, math.hypot(own, std), value - math.hypot(value - low, 3.0 * std),
        value + math.hypot(high - value, 3.0 * std))


def _open(
        offset: BoundedValue, vibration: BoundedValue, limits: tuple[float, float],
        setpoint: RequestedSetpoint, sensor: SensorModel, independent: float) -> str:
    """Return which bounds are too wide and how to narrow them, as the rest of a sentence."""
    parts, within, beyond = [], 1.0, math.inf
    for figure, limit, name in zip(
            (offset, vibration), limits, ('an offset', 'a vibration, peak to peak,'), strict=True):
        most = max(-figure.low, figure.high)
        if most <= limit:
            continue
        parts.append(f'{name} of up to {setpoint.words(most)}')
        value = 0.0 if math.isnan(figure.value) else abs(figure.value)
        apart = max(abs(limit - value), 1e-2 * limit)
        if value > limit:
            # One that is shown to be beyond decides alone.
            beyond = min(beyond, _SURER * (value - max(figure.low, -figure.high)) / apart)
        else:
            within = max(within, (most - value) / apart)
    # Bounds shrink with the noise, and with the square root of the number of samples.
    less = _ADVISED * max(beyond if math.isfinite(beyond) else within, 1.0)
    mend = (f'{less**2:.3g} times as many samples a second, or {less:.3g} times less noise, would '
            'decide it')
    if independent < INDEPENDENT:
        mend = ('the fit residuals are not noise, so neither more samples nor less noise would '
                'decide it')
    if 3.0 * sensor.std(setpoint.target) > 0.5 * limits[0]:
        mend = ('a calibrated sensor would decide it: its reading may have an error of '
                f'{setpoint.words(3.0 * sensor.std(setpoint.target))}')
    return f', but {" and ".join(parts)} cannot be ruled out: {mend}'


def _distance(offset: float, setpoint: RequestedSetpoint) -> str:
    direction = setpoint.target - setpoint.start
    if math.isnan(setpoint.percent(offset)) and abs(offset) < _SAME:
        return f'at {setpoint.target:.6g}'
    if math.isnan(setpoint.percent(offset)):
        side = 'below' if offset < 0.0 else 'above'
    else:
        side = 'short of' if offset * direction < 0.0 else 'beyond'
    return f'{setpoint.words(abs(offset))} {side} {setpoint.target:.6g}'
