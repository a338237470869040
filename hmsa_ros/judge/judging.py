"""
The rule: an equivalence test with three answers.

A setpoint is arrived at where samples show offset and vibration to be within their tolerances,
missed where they show one to be outside, and undecided otherwise.
"""

from collections.abc import Iterator
import math

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.core.model import Array
from hmsa_ros.core.status import Code
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.judge.fit import Figure, Fit, fit
from hmsa_ros.judge.records import (
    Finding,
    judged_late,
    Sensor,
    Setpoint,
    Tolerances,
    unobserved,
    worst,
)

Stamps = NDArray[np.int64]

#: Periods of the vibration in one look, and samples where they are rare.
PERIODS, ENOUGH = 8, 24
# Samples kept of each period at most.
_KEPT = 40
_NO_SENSOR = Sensor()


def judge(
        time: Stamps, stretch: Array, setpoint: Setpoint,
        tolerances: Tolerances = Tolerances(), *,  # noqa: B008
        sensor: Sensor = _NO_SENSOR) -> Finding:
    """
    Judge samples of a setpoint.

    Parameters
    ----------
    time : array of int
        Stamps in ns, in any order, shape (n,). Those before the arrival and after the end say
        what the sensor does.
    stretch : array
        Measured, shape (n,); NaN for what is not.
    setpoint : Setpoint
        As it was requested.
    tolerances : Tolerances
        What counts as having arrived.
    sensor : Sensor
        What is known of it.

    Returns
    -------
    Finding
        The worst that the looks at the hold show.

    """
    stamps, values, complaint = _usable(time, stretch, setpoint, sensor)
    begin = rests_from(setpoint)
    held = stamps >= begin
    if setpoint.end is not None and begin < setpoint.end:
        held &= stamps <= setpoint.end
    count = int(np.count_nonzero(held))
    if complaint or not count:
        return unobserved(setpoint, complaint, count)
    stamps, values = stamps[held], values[held]
    found = worst(
        _look(stamps[part], values[part], setpoint, tolerances, sensor, begin)
        for part in _looks(stamps, begin, setpoint))
    if found is None:
        return unobserved(setpoint, '', count)
    if found.arrived and setpoint.end is not None and begin >= setpoint.end:
        return judged_late(found, begin - setpoint.end)
    return found


def rests_from(setpoint: Setpoint) -> int:
    """Return the time in ns from which on a setpoint is judged."""
    if setpoint.moved is not None:
        return setpoint.moved
    if setpoint.arrival is not None:
        return setpoint.arrival
    # Approached: until a vibration of the step has faded to a thousandth.
    settled = setpoint.begins + round(7.0 / max(setpoint.decay, 1e-9) * NANOSECONDS)
    last = settled if setpoint.end is None else setpoint.end - round(
        PERIODS * period_of(setpoint) * NANOSECONDS)
    return max(min(settled, last), setpoint.begins)


def period_of(setpoint: Setpoint) -> float:
    """Return the period in s of vibration about a setpoint by the model."""
    return 2.0 * math.pi / setpoint.frequency


# -- samples ------------------------------------------------------------------------------------

def _usable(
        time: Stamps, stretch: Array, setpoint: Setpoint,
        sensor: Sensor) -> tuple[Stamps, Array, str]:
    """Return samples that count, by time, as true ones; and why none does."""
    stamps = np.asarray(time, dtype=np.int64)
    values = np.asarray(stretch, dtype=np.float64)
    finite = np.isfinite(values)
    if len(values) and not finite.any():
        return stamps[:0], values[:0], 'the sensor shows no numbers'
    stamps, values = stamps[finite], values[finite]
    stamps, first = np.unique(stamps, return_index=True)
    values = (values[first] - sensor.bias) / sensor.gain
    stamps = stamps - round(sensor.latency * NANOSECONDS)
    low, high = setpoint.possible
    inside = (values > low) & (values < high)
    outside = len(values) - int(np.count_nonzero(inside))
    if 2 * outside > len(values):
        value = float(np.median(values[~inside]))
        return stamps[:0], values[:0], (
            f'the sensor shows {value:.4g}, where nothing can be: expected {low:.4g} to '
            f'{high:.4g}')
    stamps, values = stamps[inside], values[inside]
    return stamps, values, ''


def _looks(stamps: Stamps, begin: int, setpoint: Setpoint) -> Iterator[slice]:
    """Yield the samples of each look: of whole periods at once, then ever more seldom."""
    length = round(PERIODS * period_of(setpoint) * NANOSECONDS)
    if len(stamps) > 1:
        length = max(length, ENOUGH * round(float(np.median(np.diff(stamps)))))
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
        yield slice(*np.searchsorted(stamps, (edge, until + 1)))


def _look(
        stamps: Stamps, values: Array, setpoint: Setpoint, tolerances: Tolerances,
        sensor: Sensor, begin: int) -> Finding:
    """Judge the samples of one look."""
    time = (stamps - begin) / NANOSECONDS
    late = float(time[0]) if len(time) else 0.0
    origin = 0.0 if late < period_of(setpoint) else late
    found = fit(time - origin, values - setpoint.target, setpoint.frequency, setpoint.decay)
    if found is None:
        return Finding(
            Code.UNDECIDED,
            f'{setpoint.where}: {len(values)} samples while {setpoint.target:.6g} is held are '
            'too few to judge', setpoint, len(values))
    return _decided(found, len(values), setpoint, tolerances, sensor)


# -- the rule -----------------------------------------------------------------------------------

def _decided(
        found: Fit, count: int, setpoint: Setpoint, tolerances: Tolerances,
        sensor: Sensor) -> Finding:
    offset, vibration = _widened(found.offset, sensor.std(setpoint.target)), found.vibration
    allowed, swing = tolerances.of(setpoint)
    off = offset.low > allowed or offset.high < -allowed
    vibrates = vibration.low > swing
    within = max(-offset.low, offset.high) <= allowed and vibration.high <= swing
    code = (Code.OFF_TARGET if off else Code.VIBRATING if vibrates
            else Code.ARRIVED if within else Code.UNDECIDED)
    frequency = found.frequency / (2.0 * math.pi) if vibration.low > 0.0 else math.nan
    message = f'{setpoint.where}: rests {_distance(offset.value, setpoint)}'
    if vibrates:
        message += (f' and rings at {frequency:.3g} Hz, {setpoint.words(vibration.value)} '
                    'peak to peak')
    if code is Code.UNDECIDED:
        message += _open(offset, vibration, allowed, swing, setpoint)
    return Finding(
        code, message, setpoint, count, offset.value, offset.std, vibration.value, vibration.std,
        frequency, found.noise)


def _widened(figure: Figure, std: float) -> Figure:
    """Return a figure with what is not known of the sensor."""
    if not std:
        return figure
    return Figure(
        figure.value, math.hypot(figure.std, std), figure.value - math.hypot(
            figure.value - figure.low, 3.0 * std), figure.value + math.hypot(
                figure.high - figure.value, 3.0 * std))


def _open(
        offset: Figure, vibration: Figure, allowed: float, swing: float,
        setpoint: Setpoint) -> str:
    """Say what is not shown, the rest of a sentence."""
    parts = []
    if max(-offset.low, offset.high) > allowed:
        parts.append(
            f'an offset of up to {setpoint.words(max(-offset.low, offset.high))} is not ruled '
            'out')
    if vibration.high > swing:
        parts.append(
            f'a vibration of up to {setpoint.words(vibration.high)} peak to peak is not ruled '
            'out')
    return ', but ' + ' and '.join(parts)


def _distance(offset: float, setpoint: Setpoint) -> str:
    direction = setpoint.target - setpoint.start
    if math.isnan(setpoint.percent(offset)):
        side = 'below' if offset < 0.0 else 'above'
    else:
        side = 'short of' if offset * direction < 0.0 else 'beyond'
    return f'{setpoint.words(abs(offset))} {side} {setpoint.target:.6g}'
