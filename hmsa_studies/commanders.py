"""Controllers of an actuator in the study of feedback: the package's own, or linear control."""

from abc import ABC, abstractmethod

from hmsa.model.actuators import Setup
from hmsa.model.simulation import ActuatorSimulation
from hmsa.model.units import NANOSECONDS
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa_lab.adapt.expected_error import caution
from hmsa_ros.device.sensor import SensorErrors
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import Settings, StretchRequest
from hmsa_studies.linear import Controller, Predictive, Quadratic
from hmsa_studies.scenario import Scenario, Strategy

#: Maximum load, and time in ns from a sample's arrival to the first level that depends on it.
LARGEST, REACTION = 2.0, 300_000
# Bias of the sensor.
_BIAS = 1e-3
# Expected error, as a fraction of the step, above which a move takes longer.
_TOLERANCE = 3e-5
_JOINT = 'actuator'
_LINEAR: dict[str, type[Controller]] = {'lqr': Quadratic, 'mpc': Predictive}


class Commander(ABC):
    """Controller of one actuator of a scenario, with a relative error of G."""

    #: Whether a level follows each sample; else levels are planned ahead.
    steadily = False

    def __init__(
            self, scenario: Scenario, strategy: Strategy, error: float, seed: int) -> None:
        self.scenario = scenario
        self.target = scenario.block.rest
        self.device = SimulatedDevice(
            [SimulatedJoint(
                Setup(scenario.actuator(error), scenario.block.rest,
                      coil_time_constant=scenario.coil_time_constant),
                errors=SensorErrors(scenario.noise, stretch_bias=_BIAS))],
            period=round(scenario.period * NANOSECONDS),
            measurement_delay=round(scenario.delay * NANOSECONDS), seed=seed)
        self.planner = planner_of(scenario, strategy, REACTION)

    @property
    @abstractmethod
    def now(self) -> int:
        """Time in ns."""

    @property
    @abstractmethod
    def levels(self) -> list[tuple[int, float]]:
        """Present and future levels in T with timestamps in ns, by time."""

    @abstractmethod
    def move(self, target: float) -> int:
        """Move to a stretch; return the time of rest there, in ns."""

    @abstractmethod
    def run(self, until: int) -> None:
        """Continue until a time in ns."""

    def copy(self) -> ActuatorSimulation:
        """Return a copy of the actuator with the levels planned so far."""
        setup, now, device = self.device.setups[0], self.now, self.device
        plant = ActuatorSimulation(
            setup.actuator, time=now, coil_time_constant=setup.coil_time_constant)
        plant.set_state(
            float(device.stretch[0]), float(device.rate[0]), float(device.flux_density[0]),
            device.level(0))
        for stamp, level in self.levels:
            if stamp > now:
                plant.command(stamp, level)
        return plant


def planner_of(scenario: Scenario, strategy: Strategy, lead: int = 0) -> Planner:
    """Return a planner with the nominal parameters, which sends commands some ns ahead."""
    block = scenario.block
    unit = block.flux_density_unit
    return Planner(block, Options(
        strategy.shaper, flux_density_min=-LARGEST * unit, flux_density_max=LARGEST * unit,
        lead_time=lead, order=strategy.order))


class _Running(Commander):
    """The package's controller, in open loop or with feedback."""

    def __init__(
            self, scenario: Scenario, strategy: Strategy, error: float, seed: int) -> None:
        super().__init__(scenario, strategy, error, seed)
        self._loop = Loop(PlannerGroup({_JOINT: self.planner}), Settings(
            takeover_timeout=0, feedback='cautious' if strategy.kind == 'adapt' else 'off',
            feedback_parameters=scenario.free, feedback_tolerance=_TOLERANCE), self.device)

    @property
    def now(self) -> int:
        return self._loop.now

    @property
    def levels(self) -> list[tuple[int, float]]:
        return [(x.stamp, x.flux_density) for x in self.planner.plan.levels]

    def move(self, target: float) -> int:
        self.target = target
        self._loop.runtime.request(StretchRequest(_JOINT, target))
        return self.planner.plan.segments[-1].arrival or self.now

    def run(self, until: int) -> None:
        self._loop.run(until)


class _Steady(Commander):
    """Controller that sets a level after each sample, with the duration of a cautious move."""

    steadily = True

    def __init__(
            self, scenario: Scenario, strategy: Strategy, error: float, seed: int) -> None:
        super().__init__(scenario, strategy, error, seed)
        self._controller = _LINEAR[strategy.kind](
            scenario.block, LARGEST, self.device.period,
            round(scenario.delay * NANOSECONDS) + REACTION, scenario.noise,
            scenario.weights[strategy.kind])
        self._now = 0
        self._levels = [(0, 0.0)]

    @property
    def now(self) -> int:
        return self._now

    @property
    def levels(self) -> list[tuple[int, float]]:
        return self._levels

    def move(self, target: float) -> int:
        plan = self.planner.setpoint(target, self._now)
        begin, arrival = plan.segments[-1].begin, plan.segments[-1].arrival or self._now
        longer = caution(
            len(self.scenario.free), self.scenario.noise / abs(target - self.target))
        self.target = target
        self._command(self._now, self._controller.move(target, plan.levels[-1].flux_density))
        return self._now + round(longer * (arrival - begin))

    def run(self, until: int) -> None:
        while self._now < until:
            self._now = min(until, self.device.next_sample)
            self.device.advance(self._now)
            for sample in self.device.samples():
                level = self._controller.seen(float(sample.stretch[0]))
                if level is not None:
                    self._command(self._now + REACTION, level)

    def _command(self, stamp: int, level: float) -> None:
        self.device.receive(0, stamp, level)
        self._levels = [*self._levels[-1:], (stamp, level)]


def commander(
        scenario: Scenario, strategy: Strategy, error: float, seed: int) -> Commander:
    """Return the controller of a strategy."""
    kind = _Steady if strategy.kind in _LINEAR else _Running
    return kind(scenario, strategy, error, seed)
