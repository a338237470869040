"""
Ten minutes of moves while the coil warms the block by 15 K, for planners that know more or less.

The actuator is simulated with its temperature. The controller of the nodes moves it in simulated
time, in open loop or with feedback, with or without the temperature.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hmsa.model.actuators import Setup
from hmsa.model.parameters import ActuatorParameters, NondimensionalParameters
from hmsa.model.sensor import Sample, SensorErrors
from hmsa.model.simulation import ActuatorSimulation
from hmsa.model.thermal import Thermal
from hmsa.model.units import NANOSECONDS
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import Settings, StretchRequest

#: Coefficients of an unfilled silicone by its entropy and measurements, and of NdFeB powder; that
#: of the damping is assumed.
SILICONE = Thermal(
    shear_modulus=0.0035, remanence=-0.0011, damping_coefficient=-0.005, time_constant=150.0)
#: Warming in K in a duration in s, targets in turn, and duration of each setpoint in s.
WARMING, DURATION, TARGETS, DWELL = 15.0, 600.0, (1.1, 1.2, 1.3, 1.2), 20.0
_JOINT = 'actuator'
# The example block with L = 100 mm, whose time scale of 44 ms takes fewer samples.
_HALF_LENGTH = 0.1
# Points at which the motion after an arrival is looked at, and its duration in time scales.
_LOOK, _AFTER = 200, 8.0
#: What a planner may know: the measured temperature; that, and how the coil warms; the latter
#: alone; nothing, not even that the temperature changes anything; or samples, with noise, without
#: and with the measured temperature.
WAYS = ('measured', 'measured and foreseen', 'foreseen', 'ignored', 'feedback',
        'measured and feedback')
_NOISE, _PERIOD, _FEEDBACK_PERIOD = 3e-4, 0.05, 0.005


@dataclass(frozen=True)
class Left:
    """What a move leaves, as fractions of its step: vibration peak to peak, and offset."""

    target: float
    vibration: float
    offset: float  #: at the arrival
    drifted: float  #: at the end of the setpoint
    temperature: float  #: at the arrival, in degrees Celsius
    #: Shear modulus that plans take at the end, at the same temperature, over the true one.
    modulus: float

    @property
    def worst(self) -> float:
        """The larger offset."""
        return max(abs(self.offset), abs(self.drifted))


class _Expanding(SimulatedDevice):
    """One joint with a sensor of its length, which grows with the temperature."""

    def __init__(
            self, expansion: float, joints: Sequence[SimulatedJoint], *, period: int, time: int
    ) -> None:
        super().__init__(joints, period=period, time=time)
        self._expansion, self._given = expansion, self.temperatures[0]

    def samples(self) -> list[Sample]:
        """Return the samples since the last call."""
        by = 1.0 + self._expansion * (self.temperatures[0] - self._given)
        return [x._replace(stretch=by * x.stretch) for x in super().samples()]


def block() -> ActuatorParameters:
    """Return the block, which its coil warms by 15 K on the average of all levels."""
    made = ActuatorParameters.from_nondimensional(
        NondimensionalParameters(), shear_modulus=1e4, density=1900.0, half_length=_HALF_LENGTH,
        remanence=0.1)
    setup = Setup(made)
    level = np.mean([setup.holding(x) ** 2 for x in TARGETS])
    reached = 1.0 - np.exp(-DURATION / SILICONE.time_constant)
    return replace(made, thermal=replace(SILICONE, rise=float(WARMING / level / reached)))


def warming(
        way: str, *, stiffer: float = 0.0, coefficients: float = 1.0,
        expansion: float = 0.0, duration: float = DURATION) -> list[Left]:
    """
    Run the moves.

    Parameters
    ----------
    way : str
        What the planner knows, one of `WAYS`.
    stiffer : float
        Relative error of the shear modulus that the planner is given.
    coefficients : float
        Factor on all coefficients that the planner is given.
    expansion : float
        Thermal expansion in 1/K of the length that the sensor measures.
    duration : float
        Duration of the run in s.

    Returns
    -------
    list of Left
        Of each move, from the first one on.

    """
    truth = block()
    known = {
        'ignored': Thermal(), 'measured and foreseen': truth.thermal,
        'foreseen': truth.thermal}.get(way, replace(truth.thermal, rise=0.0))
    known = replace(known, **{
        x: coefficients * getattr(known, x)
        for x in ('shear_modulus', 'remanence', 'damping_coefficient')})
    feedback = way.endswith('feedback')
    errors = SensorErrors(_NOISE if feedback else 0.0)
    device = _Expanding(
        expansion, [SimulatedJoint(Setup(truth), errors=errors)],
        period=round((_FEEDBACK_PERIOD if feedback else _PERIOD) * NANOSECONDS),
        time=NANOSECONDS)
    planner = Planner(replace(
        truth, thermal=known, shear_modulus=(1.0 + stiffer) * truth.shear_modulus), Options(
        flux_density_min=-0.5, flux_density_max=0.5, lead_time=5_000_000))
    loop = Loop(PlannerGroup({_JOINT: planner}), Settings(
        takeover_timeout=0, feedback='adapt' if feedback else 'off'), device)
    found, start = [], truth.rest
    for number in range(round(duration / DWELL)):
        target = TARGETS[number % len(TARGETS)]
        loop.runtime.request(StretchRequest(_JOINT, target))
        arrival = planner.plan.segments[-1].arrival or loop.now
        loop.run(arrival)
        left, end = _after(loop, device, planner, target), round(
            (1.0 + (number + 1) * DWELL) * NANOSECONDS)
        while loop.now < end:
            loop.run(min(loop.now + NANOSECONDS, end))
            if way.startswith('measured'):
                loop.runtime.temperature(_JOINT, loop.now, device.temperatures[0])
        step = target - start
        found.append(Left(
            target, left[0] / abs(step), left[1] / step,
            (float(device.stretch[0]) - target) / step, left[2],
            planner.base.at_temperature(known.reference).actuator.shear_modulus
            / truth.shear_modulus))
        start = target
    return found


def _after(
        loop: Loop, device: SimulatedDevice, planner: Planner,
        target: float) -> tuple[float, float, float]:
    """Return vibration and offset in stretch after an arrival, and the temperature."""
    setup, now = device.actuators.setups[0], loop.now
    plant = ActuatorSimulation(setup.actuator, time=now)
    plant.set_state(
        float(device.stretch[0]), float(device.actuators.rate[0]), float(device.flux_density[0]),
        device.level(0))
    held = planner.plan.level(now + 1).flux_density
    plant.command(now, held)
    seen = []
    for i in range(_LOOK):
        plant.advance(now + round(
            _AFTER * setup.actuator.time_unit * NANOSECONDS * i / (_LOOK - 1)))
        seen.append(plant.stretch)
    return max(seen) - min(seen), plant.equilibrium() - target, device.temperatures[0]
