"""Whether an actuator rests at its target, judged from samples of its stretch."""

from dataclasses import dataclass, field
import math

import numpy as np

from hmsa_ros.core.model import Array
from hmsa_ros.core.status import Code

#: Codes of a finding, the better ones first.
CODES = (Code.ARRIVED, Code.UNOBSERVED, Code.VIBRATING, Code.OFF_TARGET)

# Of a vibration that fades there must be so many samples before so many times its time constant,
# where the frequency is not seen.
_FEWEST_SEEN = 6
_FADED = 2.0
# Fewer samples, or fewer periods of the vibration, say nothing about it.
_FEWEST = 8
_SHORTEST = 1.5
# Samples nearer together than this share of a period show the vibration as it is; with others it
# is looked for near the frequency of the model, of which they show an alias.
_DENSE = 0.4
_NEAR = (0.75, 1.3)
_WIDE = (0.3, 2.5)
# Frequencies tried in the time of one period over the whole span, and when the best is refined.
_TRIED = 4
_REFINED = 9
# What the samples cannot tell from an offset is left out: least eigenvalue of the scaled normal
# equations.
_APART = 0.05
# Figures of a frequency that is searched for, too.
_FITTED = 5
# Standard deviations by which a figure must exceed its tolerance; those of few samples are
# uncertain themselves, as Student's distribution has it.
_SURE = 5.0
_UNSURE = 12.0
# Smaller steps have no percentage, as those of a plan that was made anew on the way.
_NO_STEP = 1e-4


@dataclass(frozen=True)
class Expected:
    """What is known of a setpoint before it is measured."""

    target: float  # stretch to rest at
    start: float  # stretch of the setpoint before
    frequency: float  # of vibration about the target by the model, in rad/s
    decay: float = 0.0  # of the same, in 1/s
    joint: str = ''
    setpoint: int = 1  # which one of the request, from 1
    setpoints: int = 1

    @property
    def step(self) -> float:
        """Return how far the setpoint is from the one before."""
        return abs(self.target - self.start)

    def percent(self, difference: float) -> float:
        """Return a difference of stretch in % of the step; not a number where there is none."""
        return 100.0 * difference / self.step if self.step > _NO_STEP else math.nan


@dataclass(frozen=True)
class Tolerances:
    """What counts as having arrived."""

    arrival: float = 0.02  # largest offset as a share of the step
    vibration: float = 0.02  # largest vibration from peak to peak as a share of the step
    stretch: float = 1e-3  # either may be this large in any case, for small steps


@dataclass(frozen=True)
class Finding:
    """What was measured at a setpoint; figures that cannot be told are not numbers."""

    code: Code  # one of `CODES`
    message: str
    expected: Expected
    samples: int = 0
    offset: float = math.nan  # mean stretch less the target
    vibration: float = math.nan  # peak to peak
    offset_std: float = math.nan
    vibration_std: float = math.nan
    frequency: float = math.nan  # of the vibration in Hz
    noise: float = math.nan  # standard deviation of a sample

    @property
    def figures(self) -> dict[str, object]:
        """Return what a status carries; what cannot be told is missing."""
        percent = self.expected.percent
        values = {
            'offset': self.offset, 'offset_percent': percent(self.offset),
            'offset_std': self.offset_std, 'vibration_p2p': self.vibration,
            'vibration_percent': percent(self.vibration), 'vibration_std': self.vibration_std,
            'frequency': self.frequency, 'noise': self.noise}
        return {
            'measured': str(self.code), 'measured_setpoint': self.expected.setpoint,
            **{key: f'{x:.6g}' for key, x in values.items() if math.isfinite(x)},
            'samples': self.samples}


def unobserved(expected: Expected, reason: str = '', samples: int = 0) -> Finding:
    """Return the finding where samples are missing or too few, which a reason says."""
    return Finding(
        Code.UNOBSERVED,
        f'{_where(expected)}: {expected.target:.6g} is predicted, not measured'
        f'{reason and ": "}{reason}', expected, samples)


def judge(
        time: Array, stretch: Array, expected: Expected,
        tolerances: Tolerances = Tolerances()) -> Finding:  # noqa: B008
    """
    Judge samples of a setpoint that is held; times are in s since the arrival, increasing.

    An offset and a decaying sinusoid are fitted; what is left is the noise. Samples that are too
    rare to show the vibration are fitted alike near the frequency of the model.
    """
    count = len(time)
    if count < _FEWEST or (time[-1] - time[0]) * expected.frequency < 2 * math.pi * _SHORTEST:
        return unobserved(
            expected, f'{count} samples while it is held are too few to judge' if count else '',
            count)
    fit = _fit(time, stretch - expected.target, expected)
    if fit is None:
        return unobserved(
            expected, f'{count} samples at this rate cannot tell a vibration from an offset',
            count)
    sure = _SURE * (1.0 + _UNSURE / max(count - _FITTED, 1))
    vibrates = fit.vibration - sure * fit.vibration_std > max(
        tolerances.vibration * expected.step, tolerances.stretch)
    off = abs(fit.offset) - sure * fit.offset_std > max(
        tolerances.arrival * expected.step, tolerances.stretch)
    code = Code.OFF_TARGET if off else Code.VIBRATING if vibrates else Code.ARRIVED
    frequency = fit.frequency if fit.vibration > sure * fit.vibration_std else math.nan
    message = f'{_where(expected)}: rests {_distance(fit.offset, expected)}'
    if vibrates:
        ringing = 'vibrates' if math.isnan(frequency) else f'rings at {frequency:.3g} Hz'
        message += f' and {ringing}, {_size(fit.vibration, expected)} peak to peak'
    elif math.isnan(fit.vibration):
        message += f'; {count} samples at this rate do not show whether it vibrates'
    return Finding(
        code, message, expected, count, fit.offset, fit.vibration, fit.offset_std,
        fit.vibration_std, frequency, fit.noise)


# -- fit ----------------------------------------------------------------------------------------

@dataclass
class _Fit:
    """An offset and a decaying sinusoid, seen peak to peak in the period of the first sample."""

    basis: Array
    rest: Array
    coefficients: Array
    omega: float
    dense: bool
    vibration: float
    covariance: Array = field(init=False)
    noise: float = field(init=False)

    def __post_init__(self) -> None:
        self.covariance = np.linalg.inv(self.basis.T @ self.basis).astype(np.float64)
        left = self.rest - self.basis @ self.coefficients
        self.noise = math.sqrt(float(left @ left) / max(len(left) - _FITTED, 1))

    @property
    def offset(self) -> float:
        return float(self.coefficients[0])

    @property
    def offset_std(self) -> float:
        return self.noise * math.sqrt(self.covariance[0, 0])

    @property
    def vibration_std(self) -> float:
        size = max(math.hypot(*self.coefficients[1:]), 1e-300)
        return self.vibration / size * self.noise * math.sqrt(
            max(self.covariance[1, 1], self.covariance[2, 2]))

    @property
    def frequency(self) -> float:
        return self.omega / (2 * math.pi) if self.dense else math.nan


def _fit(time: Array, rest: Array, expected: Expected) -> _Fit | None:
    """Fit the best frequency; None where none can be told from an offset."""
    span = float(time[-1] - time[0])
    interval = float(np.median(np.diff(time)))
    dense = interval * expected.frequency < 2 * math.pi * _DENSE
    low, high = (x * expected.frequency for x in (_WIDE if dense else _NEAR))
    if dense:
        high = min(high, 0.9 * math.pi / interval)
    decay = expected.decay
    count = max(int((high - low) * span * _TRIED / (2 * math.pi)), _REFINED)
    tried: Array = np.linspace(low, high, count).astype(np.float64)
    best = _best(time, rest, decay, tried)
    for _ in range(2):
        if best is None:
            return None
        width = tried[1] - tried[0]
        tried = np.linspace(best - width, best + width, _REFINED).astype(np.float64)
        best = _best(time, rest, decay, tried)
    if best is None:
        return None
    basis = _basis(time, decay, np.array([best]))[0]
    found: Array = np.linalg.lstsq(basis, rest, rcond=None)[0].astype(np.float64)
    first = time[0] + np.linspace(0.0, 2 * math.pi / best, _REFINED * 8)
    seen = _basis(first, decay, np.array([best]))[0][:, 1:] @ found[1:]
    told = dense or int(np.sum((time - time[0]) * decay < _FADED)) >= _FEWEST_SEEN
    return _Fit(basis, rest, found, float(best), dense, float(np.ptp(seen)) if told else math.nan)


def _basis(time: Array, decay: float, omegas: Array) -> Array:
    """Return (frequencies, samples, 3): one, cosine and sine, the latter two decaying."""
    phase = np.outer(omegas, time)
    fading = np.exp(-decay * time)
    return np.stack((np.ones_like(phase), fading * np.cos(phase), fading * np.sin(phase)), axis=2)


def _best(time: Array, rest: Array, decay: float, omegas: Array) -> float | None:
    """Return the frequency that leaves least."""
    basis = _basis(time, decay, omegas)
    gram = basis.transpose(0, 2, 1) @ basis
    size = np.sqrt(np.maximum(np.diagonal(gram, axis1=1, axis2=2), 1e-300))
    scaled = gram / (size[:, :, None] * size[:, None, :])
    usable = np.linalg.eigvalsh(scaled)[:, 0] > _APART
    if not np.any(usable):
        return None
    right = (basis[usable].transpose(0, 2, 1) @ rest) / size[usable]
    explained = np.sum(
        np.linalg.solve(scaled[usable], right[:, :, None])[:, :, 0] * right, axis=1)
    return float(omegas[usable][np.argmax(explained)])


# -- words --------------------------------------------------------------------------------------

def _where(expected: Expected) -> str:
    joint = f'joint {expected.joint}, ' if expected.joint else ''
    return f'{joint}setpoint {expected.setpoint} of {expected.setpoints}'


def _size(difference: float, expected: Expected) -> str:
    percent = expected.percent(difference)
    return f'{difference:.3g}' if math.isnan(percent) else f'{difference:.3g} ({percent:.3g} %)'


def _distance(offset: float, expected: Expected) -> str:
    direction = expected.target - expected.start
    if expected.step > _NO_STEP:
        side = 'short of' if offset * direction < 0.0 else 'beyond'
    else:
        side = 'below' if offset < 0.0 else 'above'
    return f'{_size(abs(offset), expected)} {side} {expected.target:.6g}'
