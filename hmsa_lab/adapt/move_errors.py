"""Measured errors of a joint's moves, with feedback and in open loop."""

from dataclasses import dataclass, field, replace
import math

from hmsa.judge.records import Finding, RequestedSetpoint, SensorModel
from hmsa.judge.setpoint_samples import SetpointSamples
from hmsa.model.equations import equilibrium_stretch
from hmsa.offload import Awaited
from hmsa.planning.timeline import JointModel, Timeline

# A move is worse if its error exceeds the open-loop error by more than this fraction of the step
# plus this many standard deviations.
_WORSE, _SURE = 0.005, 3.0
# Largest usual vibration, peak to peak, over the predicted amplitude: twice three standard
# deviations.
_EXPECTED = 6.0
# Smaller steps are not informative.
_STEP = 0.02


@dataclass
class Moves:
    """How the moves of a request were planned; times are timestamps in ns."""

    learnt: bool = False  # planned with learnt parameters
    doubted: bool = False  # planned while samples did not fit
    expected: float = 0.0  # predicted amplitude of the newest move
    corrected: list[int] = field(default_factory=list)  # times from which plans were corrected
    planned_anew: float = math.inf  # time from which they are planned with learnt parameters

    def learnt_from(self, begin: int) -> bool:
        """Return whether a move that begins at a time was planned with learnt parameters."""
        return self.learnt or begin >= self.planned_anew


class MoveErrors:
    """
    Compare the errors that moves leave, as judged from samples.

    A move planned with the given parameters shows the open-loop vibration. If a learnt level
    holds the actuator, the open-loop steady-state error is known too, because the given parameters
    predict the shift of the equilibrium between the two levels accurately enough.
    """

    def __init__(self) -> None:
        self.left = math.nan  # error of the newest move, as a fraction of its step
        self._without = math.nan  # largest open-loop vibration, as a fraction of the step

    def take(
            self, hold: SetpointSamples, plan: Timeline, given: JointModel, moves: Moves,
            sensor: SensorModel) -> Awaited[str]:
        """
        Process the samples of a setpoint; return why feedback made it worse, empty if it did not.

        ``plan`` is the plan in force.
        """
        setpoint, asked = hold.setpoint, hold.asked
        self.left = math.nan
        if setpoint.step < _STEP:
            return ''
        corrected = [x for x in moves.corrected if x >= setpoint.begins]
        later = [x for x in corrected if x >= asked]
        learnt = moves.learnt_from(setpoint.begins) or len(later) < len(corrected)
        early = yield from hold.shown(
            replace(setpoint, moved=None, end=later[0], held=False) if later
            else replace(setpoint, moved=None), sensor=sensor)
        if not learnt and math.isfinite(early.vibration):
            self._without = max(early.vibration / setpoint.step, _or(self._without, 0.0))
        arrival = setpoint.moved or asked
        found = early if not later and arrival == setpoint.arrival else (yield from hold.shown(
            replace(setpoint, arrival=arrival, moved=None), sensor=sensor))
        if not math.isfinite(found.offset):
            return ''
        self.left = (abs(found.offset) + _or(found.vibration, 0.0)) / setpoint.step
        level = plan.level(arrival)
        if not (learnt or later) or given.material.creep or plan.levels[-1] is not level:
            return ''
        if not learnt or moves.doubted:
            # Open loop would vibrate, too, if the actuator has changed.
            found = replace(found, vibration=math.nan)
        elif _or(early.vibration, 0.0) > _or(found.vibration, 0.0):
            found = replace(
                found, vibration=early.vibration, vibration_std=early.vibration_std)
        return self._worse(found, setpoint, given, level.flux_density, moves.expected)

    def _worse(
            self, found: Finding, setpoint: RequestedSetpoint, given: JointModel, level: float,
            expected: float) -> str:
        """Return a message if open loop would have left a smaller error; empty if not."""
        rest = float(equilibrium_stretch(given.load(level), given.material))
        without = abs(found.offset - (rest - setpoint.target))
        more, variance = abs(found.offset) - without, found.offset_std**2
        if math.isfinite(found.vibration):
            usual = _or(self._without * setpoint.step, _EXPECTED * expected)
            more += found.vibration - usual
            without += usual
            variance += found.vibration_std**2
        if more <= _WORSE * setpoint.step + _SURE * math.sqrt(variance):
            return ''
        return (
            f'{setpoint.where}: feedback has left {setpoint.words(without + more)} of '
            'steady-state error and vibration, where open loop leaves '
            f'{setpoint.words(without)}')


def _or(value: float, other: float) -> float:
    """Return a value, or another one if it is NaN."""
    return other if math.isnan(value) else value
