"""Records of a judgement: setpoint, tolerances, sensor and finding."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cached_property
import math

from hmsa.model.status import Code
from hmsa.model.units import NANOSECONDS
from hmsa.table import percent, RESOLVED

#: Verdicts on a setpoint, from best to worst.
VERDICTS = (
    Code.ARRIVED, Code.UNOBSERVED, Code.UNDECIDED, Code.LATE, Code.VIBRATING, Code.OFF_TARGET,
    Code.MISSED)
#: Periods of the vibration in one window.
PERIODS = 6
# Prefix of the sensor properties in an estimate.
_SENSOR = 'sensor.'
# Smaller steps in stretch have no percentage: an estimated rest differs by them from a target.
_NO_STEP = 1e-6


@dataclass(frozen=True)
class RequestedSetpoint:
    """
    A setpoint as it was requested; times in ns.

    Frequency and decay of vibration about the target are those of a model; they guide the
    search.
    """

    target: float  #: stretch to rest at
    start: float  #: stretch of the setpoint before
    begins: int  #: start
    arrival: int | None  #: planned rest at the target; None if only approached
    end: int | None = None  #: requested end; None if there is none
    frequency: float = math.nan  #: in rad/s
    decay: float = 0.0  #: in 1/s
    joint: str = ''  #: empty for a single joint
    number: int = 1  #: in the request, from 1
    count: int = 1  #: number of setpoints in the request
    #: Arrival by a replanned motion, if it differs.
    moved: int | None = None
    #: Possible range of positions.
    possible: tuple[float, float] = (-math.inf, math.inf)
    held: bool = False  #: whether it is held after its end, as the last setpoint is

    @property
    def period(self) -> int:
        """Period of vibration about the target by the model, in ns."""
        return round(2.0 * math.pi / self.frequency * NANOSECONDS)

    @property
    def look(self) -> int:
        """Length of one window in ns."""
        return round(PERIODS * (2.0 * math.pi / self.frequency) * NANOSECONDS)

    @property
    def rests_from(self) -> int:
        """Time in ns from which the actuator should rest, as requested."""
        if self.arrival is not None:
            return self.arrival
        # Approached only: until a motion of the step has decayed to a thousandth. Without
        # overshoot, the slower of two exponentials remains.
        ratio = max(1.0, self.decay / self.frequency)
        decay = self.decay / (ratio * (ratio + math.sqrt(ratio**2 - 1.0)))
        settled = self.begins + round(7.0 / max(decay, 1e-9) * NANOSECONDS)
        last = settled if self.end is None else self.end - self.look
        return max(min(settled, last), self.begins)

    @property
    def newest_arrival(self) -> int | None:
        """Planned rest at the target by the newest plan; None if only approached."""
        return self.arrival if self.moved is None else self.moved

    @property
    def step(self) -> float:
        """Distance of the target from the previous setpoint."""
        return abs(self.target - self.start)

    @property
    def where(self) -> str:
        """Name of the setpoint in a sentence."""
        joint = f'joint {self.joint}, ' if self.joint else ''
        return f'{joint}setpoint {self.number} of {self.count}'

    def percent(self, difference: float) -> float:
        """Return a difference of stretch in % of the step; NaN without a step."""
        return 100.0 * difference / self.step if self.step > _NO_STEP else math.nan

    def words(self, difference: float) -> str:
        """Return a size in stretch and in % of the step, as text."""
        share = self.percent(difference)
        if math.isnan(share):
            return f'{difference:.3g}'
        if share < 100.0 * RESOLVED:
            return f'<{RESOLVED * self.step:.1g} ({percent(0.01 * share)} %)'
        return f'{difference:.3g} ({share:{".3g" if share < 999.5 else ".0f"}} %)'


@dataclass(frozen=True)
class Tolerances:
    """Tolerances for an arrival."""

    arrival: float = 0.02  #: maximum steady-state error as a fraction of the step
    vibration: float = 0.02  #: maximum vibration, peak to peak, as a fraction of the step
    stretch: float = 1e-3  #: minimum of both tolerances, for small steps

    def of(self, setpoint: RequestedSetpoint) -> tuple[float, float]:
        """Return the maximum steady-state error and vibration at a setpoint, in stretch."""
        return (max(self.arrival * setpoint.step, self.stretch),
                max(self.vibration * setpoint.step, self.stretch))


@dataclass(frozen=True)
class GoalTolerances(Tolerances):
    """Tolerances of a goal with its own values, and maximum lateness; 0 for the defaults."""

    position: float = 0.0  #: maximum error of stretch
    rate: float = 0.0  #: maximum remaining rate, in 1/s
    time: int = 0  #: after the arrival, in ns

    def of(self, setpoint: RequestedSetpoint) -> tuple[float, float]:
        """Return the maximum steady-state error and vibration at a setpoint, in stretch."""
        offset, vibration = super().of(setpoint)
        own = [2.0 * self.position] * (self.position > 0.0) + [
            2.0 * self.rate / setpoint.frequency] * (self.rate > 0.0)
        return self.position or offset, min(own, default=vibration)


@dataclass(frozen=True)
class SensorModel:
    """
    Properties of the sensor: it reports bias plus gain times stretch, with a latency.

    Each has a standard deviation; those of bias and gain widen the bounds. ``together`` is the
    correlation of bias and gain.
    """

    bias: float = 0.0
    bias_std: float = 0.0
    gain: float = 1.0
    gain_std: float = 0.0
    latency: float = 0.0  #: in s
    latency_std: float = 0.0
    together: float = 0.0

    def to_dict(self) -> dict[str, str]:
        """Return the properties as they appear in a planner's estimate."""
        return {f'{_SENSOR}{key}': f'{x:.9g}' for key, x in asdict(self).items()}

    @classmethod
    def of(cls, values: Mapping[str, str]) -> 'SensorModel':
        """
        Return the sensor from values of `to_dict` among others; missing ones have defaults.

        Raise `ValueError` if values are no numbers, or not finite.
        """
        own = {x.name: values[_SENSOR + x.name] for x in fields(cls) if _SENSOR + x.name in values}
        found = cls(**{key: float(x) for key, x in own.items()})
        if not (all(map(math.isfinite, asdict(found).values())) and found.gain > 0.0):
            raise ValueError(f'{own} is no sensor: expected finite numbers and a gain above 0')
        return found

    def std(self, stretch: float) -> float:
        """Return the standard deviation of a stretch that the sensor reports."""
        by_gain = stretch * self.gain_std
        return math.sqrt(max(
            self.bias_std**2 + by_gain**2 + 2.0 * self.together * self.bias_std * by_gain,
            0.0)) / self.gain


@dataclass(frozen=True)
class Finding:
    """Result for a setpoint; values in stretch, NaN if undetermined."""

    verdict: Code  #: one of `VERDICTS`
    message: str
    setpoint: RequestedSetpoint
    samples: int = 0
    offset: float = math.nan  #: mean stretch minus target
    offset_std: float = math.nan
    vibration: float = math.nan  #: peak to peak in the period after the arrival
    vibration_std: float = math.nan
    frequency: float = math.nan  #: of the vibration in Hz
    noise: float = math.nan  #: standard deviation of a sample

    @property
    def arrived(self) -> bool:
        """Whether samples show that the setpoint was arrived at."""
        return self.verdict is Code.ARRIVED

    @property
    def open(self) -> bool:
        """Whether more samples may change the verdict."""
        return self.verdict in (Code.UNOBSERVED, Code.UNDECIDED)

    @property
    def failed(self) -> bool:
        """Whether samples show that the setpoint was not arrived at in time."""
        return VERDICTS.index(self.verdict) > VERDICTS.index(Code.UNDECIDED)

    @cached_property
    def rank(self) -> tuple[int, float]:
        """Severity by `VERDICTS`, then the deviation relative to the step."""
        figures = (abs(self.offset), self.vibration)
        most = max((x for x in figures if math.isfinite(x)), default=0.0)
        return VERDICTS.index(self.verdict), most / max(self.setpoint.step, _NO_STEP)

    def to_dict(self) -> dict[str, object]:
        """Return it as in status, reports and ``--json``; None for undetermined values."""
        return {
            'verdict': str(self.verdict), 'joint': self.setpoint.joint,
            'setpoint': self.setpoint.number, 'setpoints': self.setpoint.count,
            'target': self.setpoint.target, 'message': self.message, 'samples': self.samples,
            **{key: x if math.isfinite(x) else None for key, x in self._figures().items()}}

    def to_texts(self) -> dict[str, str]:
        """Return it as in a status, by key; undetermined values are omitted."""
        figures = {'vibration_p2p': self.vibration, **self._figures()}
        return {
            'measured': str(self.verdict), 'measured_setpoint': str(self.setpoint.number),
            **{key: f'{x:.6g}' for key, x in figures.items() if math.isfinite(x)},
            'samples': str(self.samples)}

    def _figures(self) -> dict[str, float]:
        figures = {
            'offset': self.offset, 'offset_std': self.offset_std,
            'vibration': self.vibration, 'vibration_std': self.vibration_std}
        return figures | {
            f'{key}_percent': self.setpoint.percent(x) for key, x in figures.items()} | {
                'frequency': self.frequency, 'noise': self.noise}


def worst(findings: Iterable[Finding]) -> Finding | None:
    """Return the worst finding, the first of equal ones; None if there are none."""
    return max(findings, key=lambda x: x.rank, default=None)


def unobserved(setpoint: RequestedSetpoint, reason: str = '', samples: int = 0) -> Finding:
    """Return the finding for a setpoint without valid samples, with a reason."""
    return Finding(
        Code.UNOBSERVED,
        f'{setpoint.where}: {setpoint.target:.6g} is predicted, not measured'
        f'{reason and ": "}{reason}', setpoint, samples)


def missed(setpoint: RequestedSetpoint, reason: str) -> Finding:
    """Return the finding for a setpoint that was not carried out, with a reason."""
    return Finding(
        Code.MISSED, f'{setpoint.where}: {setpoint.target:.6g} was missed: {reason}', setpoint)
