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
) -> Awaited[str]:
    """
    Return why feedback made a move worse, empty if it did not.

    If a learnt level holds the actuator, the open-loop error follows from that with feedback,
    because the given parameters predict the shift of the equilibrium between the two levels
    accurately enough. ``plan`` is the plan in force.
    """
    setpoint = hold.setpoint
    arrival = setpoint.moved or hold.asked
    level = plan.level(arrival)
    if setpoint.step < _STEP or given.material.creep or plan.levels[-1] is not level:
        return ''
    found = yield from hold.shown(replace(setpoint, arrival=arrival, moved=None), sensor=sensor)
    if not math.isfinite(found.offset):
        return ''
    rest = float(equilibrium_stretch(given.load(level.flux_density), given.material))
    without = abs(found.offset - (rest - setpoint.target))
    if abs(found.offset) - without <= _WORSE * setpoint.step + _SURE * found.offset_std:
        return ''
    return (
        f'{setpoint.where}: feedback has left {setpoint.words(abs(found.offset))} of '
        f'steady-state error, where open loop leaves {setpoint.words(without)}')
