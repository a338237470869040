"""What the moves of a joint have left with feedback and without, as measured."""

from dataclasses import dataclass, field, replace
import math

from hmsa_ros.control.aside import Awaited
from hmsa_ros.control.holds import Hold
from hmsa_ros.judge.records import Finding, Sensor, Setpoint
from hmsa_ros.model.equations import equilibrium_stretch
from hmsa_ros.planning.timeline import Model, Plan

# How much more of its step than without feedback a move leaves that is worse, and by how many
# deviations.
_WORSE, _SURE = 0.005, 3.0
# How much more than expected is not expected: deviations of an amplitude, twice, peak to peak.
_EXPECTED = 6.0
# Smaller steps show nothing.
_STEP = 0.02


@dataclass
class Moves:
    """How the moves of a request were planned; a time in ns is that of a stamp."""

    learnt: bool = False  # with parameters that were learnt
    expected: float = 0.0  # amplitude that the newest of them is expected to have
    corrected: list[int] = field(default_factory=list)  # from when on plans were corrected


class Ledger:
    """
    Compares what moves leave, by the one judge.

    A move that was planned with the parameters given shows what vibration open loop leaves. Where
    a level that was learnt holds the actuator, the offset that open loop would leave is known
    too: the parameters given say well enough by how much the one level shifts the rest.
    """

    def __init__(self) -> None:
        self.left = math.nan  # of the newest move, as a share of its step
        self._without = math.nan  # largest vibration of a move in open loop, as such a share

    def take(
            self, hold: Hold, plan: Plan, given: Model, moves: Moves,
            sensor: Sensor) -> Awaited[str]:
        """
        Take in samples of a setpoint; return why feedback has made it worse, empty if it has not.

        The plan is the one in force.
        """
        setpoint, asked = hold.setpoint, hold.asked
        self.left = math.nan
        if setpoint.step < _STEP:
            return ''
        corrected = [x for x in moves.corrected if x >= setpoint.begins]
        later = [x for x in corrected if x >= asked]
        learnt = moves.learnt or len(later) < len(corrected)
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
        if not learnt:
            found = replace(found, vibration=math.nan)
        elif _or(early.vibration, 0.0) > _or(found.vibration, 0.0):
            found = replace(
                found, vibration=early.vibration, vibration_std=early.vibration_std)
        return self._worse(found, setpoint, given, level.flux_density, moves.expected)

    def _worse(
            self, found: Finding, setpoint: Setpoint, given: Model, level: float,
            expected: float) -> str:
        """Return what open loop would have left less of; empty if nothing."""
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
            f'{setpoint.where}: feedback has left {setpoint.words(without + more)} of offset and '
            f'vibration, where open loop leaves {setpoint.words(without)}')


def _or(value: float, other: float) -> float:
    """Return a value, or another one where it is not known."""
    return other if math.isnan(value) else value
