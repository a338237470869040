"""
Second part of the demo: an actuator that differs from its model, in open loop and adapting.

Planner and simulated plant run in one loop, as in ``hmsa controller``, but without ROS and in
simulated time. The block is ten times as long as in the first part, so that a camera resolves its
first move.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hmsa.model.actuators import Setup
from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters, paper_actuator
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa_ros.device.sensor import SensorErrors
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import Settings, StretchRequest

#: Error factor of the shear modulus, unknown to the planner.
FACTOR = 1.2
_TARGETS, _HOLD = (1.4, 1.1), 0.8
_MS, _JOINT = 1_000_000, 'actuator'
# A camera at 200 Hz with 10 ms delay, noise and bias of the stretch; lead time of commands.
_PERIOD, _DELAY, _LEAD = 5 * _MS, 10 * _MS, 2 * _MS
_ERRORS = SensorErrors(stretch_noise=1e-3, stretch_bias=1e-3)
_LIMIT = 0.5


@dataclass(frozen=True)
class AdaptingResult:
    """Residual vibration and steady-state error of one move, as fractions of the step."""

    feedback: str
    stretch: float
    arrival: float
    vibration: float
    offset: float


def _carry_out(
        block: ActuatorParameters, feedback: str) -> tuple[Array, list[AdaptingResult]]:
    """Make the moves; return time in s with true stretch, and the result of each move."""
    true = replace(block, shear_modulus=FACTOR * block.shear_modulus)
    planner = Planner(block, Options(
        flux_density_min=-_LIMIT, flux_density_max=_LIMIT, lead_time=_LEAD))
    device = SimulatedDevice(
        [SimulatedJoint(Setup(true), errors=_ERRORS)], period=_PERIOD, measurement_delay=_DELAY)
    loop = Loop(
        PlannerGroup({_JOINT: planner}),
        Settings(takeover_timeout=0, feedback=feedback), device)
    loop.run(_MS)
    seen, results, before = [], [], 1.0
    for target in _TARGETS:
        begin = loop.now
        loop.runtime.request(StretchRequest(_JOINT, target))
        # The arrival as planned, before any correction.
        arrival = (planner.plan.segments[-1].arrival or begin) * 1e-9
        while loop.now < begin + _HOLD * 1e9:
            loop.run(loop.now + _MS)
            seen.append((loop.now * 1e-9, float(device.stretch[0])))
        track: Array = np.array(seen, dtype=np.float64)
        after = track[track[:, 0] >= arrival, 1]
        step, before = target - before, target
        results.append(AdaptingResult(
            feedback, target, arrival - begin * 1e-9, float(np.ptp(after)) / abs(step),
            (float(after[-1]) - target) / step))
    return track, results


def second_act(picture: Path) -> tuple[AdaptingResult, ...]:
    """Run the moves with feedback off and cautious, and plot both."""
    from hmsa.report import looks, style
    from hmsa.report.paper import SCREEN

    block = paper_actuator()
    block = replace(
        block, half_length=10.0 * block.half_length, half_thickness=10.0 * block.half_thickness,
        damping_coefficient=100.0 * block.damping_coefficient)
    results: list[AdaptingResult] = []
    with style.picture(picture, 2.8, SCREEN) as figure:
        axes = figure.add_subplot()
        for feedback, label, kind in (
                ('off', 'open loop', style.UNSHAPED), ('cautious', 'adapting', style.SHAPED)):
            track, found = _carry_out(block, feedback)
            results += found
            axes.plot(1e3 * track[:, 0], track[:, 1], label=label, **kind)
        times = 1e3 * _HOLD * np.arange(len(_TARGETS) + 1)
        axes.step(times, [*_TARGETS, _TARGETS[-1]], where='post', label='target',
                  **looks.SETPOINT.line(alpha=looks.SETPOINT.opacity))
        axes.set_title(
            f'shear modulus {100.0 * FACTOR - 100.0:+.0f} %, unknown to the planner')
        style.finish(axes, style.axis('time', 't', 'ms'), style.axis('stretch', r'\lambda'))
        axes.legend(loc='upper right')
    return tuple(results)
