"""What is judged, by what, and what is found."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
import math

from hmsa_ros.model.residual import percent, RESOLVED
from hmsa_ros.model.status import Code
from hmsa_ros.model.units import NANOSECONDS

#: Verdicts on a setpoint, the better ones first.
VERDICTS = (
    Code.ARRIVED, Code.UNOBSERVED, Code.UNDECIDED, Code.LATE, Code.VIBRATING, Code.OFF_TARGET,
    Code.MISSED)
#: Periods of the vibration in one look.
PERIODS = 6
# What its figures are called in an estimate.
_SENSOR = 'sensor.'
# Smaller steps have no percentage.
_NO_STEP = 1e-9


@dataclass(frozen=True)
class Setpoint:
    """
    A setpoint as it was requested; times in ns.

    Frequency and decay of vibration about the target are those of a model: they say where to look.
    """

    target: float  #: stretch to rest at
    start: float  #: stretch of the setpoint before
    begins: int  #: from which it holds
    arrival: int | None  #: planned rest at the target; None where it is only approached
    end: int | None = None  #: until which it was requested; None for no end
    frequency: float = math.nan  #: in rad/s
    decay: float = 0.0  #: in 1/s
    joint: str = ''  #: empty where there is one
    number: int = 1  #: in the request, from 1
    count: int = 1  #: of setpoints in the request
    #: Arrival by a plan that was made anew, where it is another.
    moved: int | None = None
    #: What a position of the actuator can be.
    possible: tuple[float, float] = (-math.inf, math.inf)
    held: bool = False  #: whether it is held on after its end, as the last one is

    @property
    def period(self) -> int:
        """Period of vibration about it by the model in ns."""
        return round(2.0 * math.pi / self.frequency * NANOSECONDS)

    @property
    def look(self) -> int:
        """Length of one look at it in ns."""
        return round(PERIODS * (2.0 * math.pi / self.frequency) * NANOSECONDS)

    @property
    def rests_from(self) -> int:
        """Time in ns from which on it is to rest, as it was requested."""
        if self.arrival is not None:
            return self.arrival
        # Approached: until a vibration of the step has faded to a thousandth.
        settled = self.begins + round(7.0 / max(self.decay, 1e-9) * NANOSECONDS)
        last = settled if self.end is None else self.end - self.look
        return max(min(settled, last), self.begins)

    @property
    def step(self) -> float:
        """How far the target is from the setpoint before."""
        return abs(self.target - self.start)

    @property
    def where(self) -> str:
        """Name it in a sentence."""
        joint = f'joint {self.joint}, ' if self.joint else ''
        return f'{joint}setpoint {self.number} of {self.count}'

    def percent(self, difference: float) -> float:
        """Return a difference of stretch in % of the step; NaN where there is none."""
        return 100.0 * difference / self.step if self.step > _NO_STEP else math.nan

    def words(self, difference: float) -> str:
        """Return a size in stretch and in % of the step."""
        share = self.percent(difference)
        if math.isnan(share):
            return f'{difference:.3g}'
        shown = f'{share:.3g}' if share >= 100.0 * RESOLVED else percent(0.01 * share)
        return f'{difference:.3g} ({shown} %)'


@dataclass(frozen=True)
class Tolerances:
    """What counts as having arrived."""

    arrival: float = 0.02  #: largest offset as a share of the step
    vibration: float = 0.02  #: largest vibration, peak to peak, as a share of the step
    stretch: float = 1e-3  #: either may be this large in any case, for small steps

    def of(self, setpoint: Setpoint) -> tuple[float, float]:
        """Return the largest offset and the largest vibration at a setpoint in stretch."""
        return (max(self.arrival * setpoint.step, self.stretch),
                max(self.vibration * setpoint.step, self.stretch))


@dataclass(frozen=True)
class GoalTolerances(Tolerances):
    """What counts as having arrived where a goal says so itself, and how late; 0 as otherwise."""

    position: float = 0.0  #: largest error of stretch
    rate: float = 0.0  #: largest rate that is left, in 1/s
    time: int = 0  #: after the arrival, in ns

    def of(self, setpoint: Setpoint) -> tuple[float, float]:
        """Return the largest offset and the largest vibration at a setpoint in stretch."""
        offset, vibration = super().of(setpoint)
        own = [2.0 * self.position] * (self.position > 0.0) + [
            2.0 * self.rate / setpoint.frequency] * (self.rate > 0.0)
        return self.position or offset, min(own, default=vibration)


@dataclass(frozen=True)
class Sensor:
    """
    What is known of the sensor: it shows the bias plus the gain times the stretch, later.

    What is not known of these is a standard deviation each, and counts; ``together`` is the
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
        """Return it as the estimate of a planner carries it."""
        return {f'{_SENSOR}{key}': f'{x:.9g}' for key, x in asdict(self).items()}

    @classmethod
    def of(cls, values: Mapping[str, str]) -> 'Sensor':
        """
        Return what `to_dict` is of, among other values; what is not there is as given.

        Raises `ValueError` if figures are no numbers, or not finite.
        """
        own = {x.name: values[_SENSOR + x.name] for x in fields(cls) if _SENSOR + x.name in values}
        found = cls(**{key: float(x) for key, x in own.items()})
        if not (all(map(math.isfinite, asdict(found).values())) and found.gain > 0.0):
            raise ValueError(f'{own} is no sensor: expected finite numbers and a gain above 0')
        return found

    def std(self, stretch: float) -> float:
        """Return how far off a stretch that it shows may be, as a standard deviation."""
        by_gain = stretch * self.gain_std
        return math.sqrt(max(
            self.bias_std**2 + by_gain**2 + 2.0 * self.together * self.bias_std * by_gain,
            0.0)) / self.gain


@dataclass(frozen=True)
class Finding:
    """What samples show of a setpoint; figures in stretch, NaN where they cannot be told."""

    verdict: Code  #: one of `VERDICTS`
    message: str
    setpoint: Setpoint
    samples: int = 0
    offset: float = math.nan  #: mean stretch less the target
    offset_std: float = math.nan
    vibration: float = math.nan  #: peak to peak in the period after the arrival
    vibration_std: float = math.nan
    frequency: float = math.nan  #: of the vibration in Hz
    noise: float = math.nan  #: standard deviation of a sample

    @property
    def arrived(self) -> bool:
        """Whether the setpoint was shown to be arrived at."""
        return self.verdict is Code.ARRIVED

    @property
    def open(self) -> bool:
        """Whether more samples may change the verdict."""
        return self.verdict in (Code.UNOBSERVED, Code.UNDECIDED)

    @property
    def failed(self) -> bool:
        """Whether the setpoint was shown not to be arrived at in time."""
        return VERDICTS.index(self.verdict) > VERDICTS.index(Code.UNDECIDED)

    @property
    def rank(self) -> tuple[int, float]:
        """How bad it is, by `VERDICTS`, and how far it is off for its step."""
        figures = (abs(self.offset), self.vibration)
        most = max((x for x in figures if math.isfinite(x)), default=0.0)
        return VERDICTS.index(self.verdict), most / max(self.setpoint.step, _NO_STEP)

    def to_dict(self) -> dict[str, object]:
        """Return it as status, reports and ``--json`` carry it; None for what cannot be told."""
        return {
            'verdict': str(self.verdict), 'joint': self.setpoint.joint,
            'setpoint': self.setpoint.number, 'setpoints': self.setpoint.count,
            'target': self.setpoint.target, 'message': self.message, 'samples': self.samples,
            **{key: x if math.isfinite(x) else None for key, x in self._figures().items()}}

    def to_texts(self) -> dict[str, str]:
        """Return it as a status carries it, by key; what cannot be told is missing."""
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
    """Return the worst finding, the first of equal ones; None of none."""
    return max(findings, key=lambda x: x.rank, default=None)


def unobserved(setpoint: Setpoint, reason: str = '', samples: int = 0) -> Finding:
    """Return the finding where no samples count, which a reason says."""
    return Finding(
        Code.UNOBSERVED,
        f'{setpoint.where}: {setpoint.target:.6g} is predicted, not measured'
        f'{reason and ": "}{reason}', setpoint, samples)


def missed(setpoint: Setpoint, reason: str) -> Finding:
    """Return the finding of a setpoint that was not carried out, which a reason says."""
    return Finding(
        Code.MISSED, f'{setpoint.where}: {setpoint.target:.6g} was missed: {reason}', setpoint)
