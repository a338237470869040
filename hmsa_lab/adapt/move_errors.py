"""Measured error of a move, with feedback and in open loop."""

from dataclasses import replace
import math

from hmsa.judge.records import SensorModel
from hmsa.judge.setpoint_samples import SetpointSamples
from hmsa.model.equations import equilibrium_stretch
from hmsa.offload import Awaited
from hmsa.planning.timeline import JointModel, Timeline

# A move is worse if its error exceeds the open-loop error by more than this fraction of the step
# plus this many standard deviations.
_WORSE, _SURE = 0.005, 3.0
# Smaller steps are not informative.
_STEP = 0.02


def error_of(
        hold: SetpointSamples, plan: Timeline, given: JointModel, sensor: SensorModel
) -> Awaited[tuple[float, str]]:
    """
    Return the error that a move leaves, as a fraction of its step, NaN if unknown.

    Also return why feedback made it worse, empty if it did not: if a learnt level holds the
    actuator, the open-loop error follows from it, because the given parameters predict the shift
    of the equilibrium between the two levels accurately enough. ``plan`` is the plan in force.
    """
    setpoint = hold.setpoint
    if setpoint.step < _STEP:
        return math.nan, ''
    arrival = setpoint.moved or hold.asked
    found = yield from hold.shown(replace(setpoint, arrival=arrival, moved=None), sensor=sensor)
    if not math.isfinite(found.offset):
        return math.nan, ''
    vibration = found.vibration if math.isfinite(found.vibration) else 0.0
    left, level = (abs(found.offset) + vibration) / setpoint.step, plan.level(arrival)
    if given.material.creep or plan.levels[-1] is not level:
        return left, ''
    rest = float(equilibrium_stretch(given.load(level.flux_density), given.material))
    without = abs(found.offset - (rest - setpoint.target))
    if abs(found.offset) - without <= _WORSE * setpoint.step + _SURE * found.offset_std:
        return left, ''
    return left, (
        f'{setpoint.where}: feedback has left {setpoint.words(abs(found.offset))} of '
        f'steady-state error, where open loop leaves {setpoint.words(without)}')
