"""
Setpoints of a run: those whose outcomes were recorded, or else those that its levels hold.

Without outcomes, as in recordings of before or of raw levels, each level that lasts for at least a
period of the actuator gives a setpoint.
"""

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np

from hmsa.interfaces.outcome import LEVELS, Outcome
from hmsa.judge.records import RequestedSetpoint
from hmsa.model.equations import Array, equilibrium_stretch, natural_frequency, stretch_limits
from hmsa.model.law import critical_zeta
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import NANOSECONDS
from hmsa.runs.record import in_force, RecordedLevel, Run, without_repeats

#: Smaller differences of stretch do not change a setpoint.
SAME = 1e-6


def setpoints_of(run: Run) -> list[Outcome]:
    """Return the setpoints of a run; of those that were replaced, the ones reached before."""
    asked = [x for x in run.outcomes if x.asked != LEVELS]
    if asked:
        return [x for x in asked if x.finding is not None or not x.ended]
    return _held(run, in_force((x,) for x in without_repeats(run.accepted)[0]))


def start_of(run: Run, stamp: int) -> float:
    """Return the stretch before a time: that which the field holds, or else the measured one."""
    field = _field_before(run, stamp)
    if field is not None:
        return float(_balance(run, [field])[0])
    return float(run.stretch[max(int(np.searchsorted(run.time, stamp, side='right')) - 1, 0)])


def _field_before(run: Run, stamp: int) -> float | None:
    """Return the flux density in T in force before a time, None if it is unknown."""
    reported = [x.flux_density for x in run.reported if x.stamp < stamp]
    place = int(np.searchsorted(run.time, stamp)) - 1
    measured = [float(run.flux_density[place])] if place >= 0 else []
    return next((x for x in (*reported[-1:], *measured) if math.isfinite(x)), None)


def _balance(run: Run, flux_densities: Sequence[float]) -> Array:
    """Return the equilibrium stretches of levels in T with the planner's parameters."""
    return equilibrium_stretch(
        [run.planner.units.of_level(x) for x in flux_densities], run.planner.nondimensional)


def _held(run: Run, levels: Sequence[RecordedLevel]) -> list[Outcome]:
    """Return the setpoints of levels that are held for a period."""
    found: list[RequestedSetpoint] = []
    begin, start = 0, start_of(run, levels[0].stamp if levels else 0)
    held = _balance(run, [x.flux_density for x in levels])
    for i, (level, target) in enumerate(zip(levels, held.tolist(), strict=True)):
        until = levels[i + 1].stamp if i + 1 < len(levels) else int(run.time[-1])
        setpoint = described(run.planner, target, start, levels[begin].stamp, until)
        if not (until - level.stamp) / NANOSECONDS * setpoint.frequency >= 2.0 * math.pi:
            continue
        if setpoint.step > SAME:
            found.append(replace(setpoint, arrival=None if i == begin else (
                level.stamp + _ramp(run, levels[i - 1], level))))
            start = target
        begin = i + 1
    joints = run.parameters.get('planner.joints')
    joint = run.joint if isinstance(joints, list) and len(joints) > 1 else ''
    return [Outcome(setpoint=replace(
        x, number=i, count=len(found), joint=joint, held=i == len(found)))
        for i, x in enumerate(found, 1)]


def described(
        actuator: ActuatorParameters, target: float, start: float, begins: int,
        end: int | None) -> RequestedSetpoint:
    """Return a setpoint with frequency, decay and range of an actuator; times in ns."""
    material, unit = actuator.nondimensional, actuator.time_unit
    low, high = stretch_limits(material)
    inside = min(max(target, low + SAME), high - SAME)
    omega = float(natural_frequency(inside, material)) / unit
    decay = material.zeta / critical_zeta(inside, material.packed) * omega
    return RequestedSetpoint(target, start, begins, None, end, omega, decay, possible=(low, high))


def _ramp(run: Run, before: RecordedLevel, level: RecordedLevel) -> int:
    """Return the duration in ns of the amplifier's ramp from one level to the next."""
    slew = run.number('plant.slew_limit') or run.number('planner.slew_limit')
    # A bag may contain any slew limit: bound the result.
    return 0 if not slew else round(
        min(abs(level.flux_density - before.flux_density) / slew, 1e6) * NANOSECONDS)
