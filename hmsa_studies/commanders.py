"""
Scenarios and strategies of the study of feedback, and the controllers that carry them out.

The controllers are the package's own, or linear ones.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from hmsa.model.actuators import Setup
from hmsa.model.parameters import ActuatorParameters, NondimensionalParameters
from hmsa.model.sensor import SensorErrors
from hmsa.model.simulation import ActuatorSimulation
from hmsa.model.units import NANOSECONDS
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa_lab.adapt.expected_error import caution
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import Settings, StretchRequest, TRACKED
from hmsa_studies.linear import Controller, Predictive, Quadratic, Weights

#: Distances of the first and the next target from rest.
TARGETS = (0.4, 0.1)
# Sampling interval of a camera, in time scales.
_INTERVAL = 0.114
# Best of about 100 combinations, by vibration and steady-state error with G exact and with a 20 %
# error; others if the coil lags, since the loop rings with these.
_WEIGHTS = {'lqr': Weights(0.05, 0.01, 3.0), 'mpc': Weights(0.3, 0.03)}
_CAREFUL = {'lqr': Weights(0.3, 0.3, 1.0), 'mpc': Weights(1.0, 0.03, wander=0.03)}

#: Maximum load, and time in ns from a sample's arrival to the first level that depends on it.
LARGEST, REACTION = 2.0, 300_000
# Bias of the sensor.
_BIAS = 1e-3
# Expected error, as a fraction of the step, above which a move takes longer.
_TOLERANCE = 3e-5
_JOINT = 'actuator'
_LINEAR: dict[str, type[Controller]] = {'lqr': Quadratic, 'mpc': Predictive}


@dataclass(frozen=True)
class Scenario:
    """Actuator and sensor; times in s."""

    name: str
    period: float  #: sampling period
    delay: float  #: from the measurement to the arrival of a sample
    noise: float  #: standard deviation of a sample of stretch
    half_length: float = 0.01  #: in m; determines the time scale, 4.4 ms for 0.01 m
    truth: Mapping[str, float] = field(default_factory=dict)  #: true factors in addition to G's
    coil_time_constant: float = 0.0  #: unknown to the model
    free: tuple[str, ...] = TRACKED
    weights: Mapping[str, Weights] = field(default_factory=lambda: _WEIGHTS)
    nominal: ActuatorParameters | None = None  #: instead of the example block

    @property
    def targets(self) -> tuple[float, ...]:
        """Targets of the moves."""
        return tuple(self.block.rest + x for x in TARGETS)

    @property
    def block(self) -> ActuatorParameters:
        """The nominal block."""
        return self.nominal or ActuatorParameters.from_nondimensional(
            NondimensionalParameters(), shear_modulus=1e4, density=1900.0,
            half_length=self.half_length, remanence=0.1)

    def actuator(self, error: float) -> ActuatorParameters:
        """Return the true block, for a relative error of the shear modulus."""
        block = self.block
        return replace(
            block, shear_modulus=block.shear_modulus * (1.0 + error),
            **{name: x * getattr(block, name) for name, x in self.truth.items()})


def scenario_of(actuator: ActuatorParameters) -> Scenario:
    """Return the scenario of an actuator measured by a camera, about thirty samples per period."""
    period = _INTERVAL * actuator.time_unit
    return Scenario(
        f'{1.0 / period:.3g} Hz, {2e3 * period:.3g} ms late, noise 1e-3, T '
        f'{1e3 * actuator.time_unit:.3g} ms', period, 2.0 * period, 1e-3, nominal=actuator)


#: The matrix: samples at 1 kHz that are 2 ms late, and a camera on a slower actuator.
SCENARIOS = (
    Scenario('1 kHz, 2 ms late, noise 1e-3', 1e-3, 2e-3, 1e-3),
    Scenario('1 kHz, 2 ms late, noise 1e-4', 1e-3, 2e-3, 1e-4),
    Scenario('200 Hz, 10 ms late, noise 1e-3, T 44 ms', 5e-3, 1e-2, 1e-3, 0.1),
    Scenario(
        '1 kHz, 2 ms late, noise 1e-3; Br +5 %, lag 0.5 ms', 1e-3, 2e-3, 1e-3,
        truth={'remanence': 1.05}, coil_time_constant=5e-4,
        free=('shear_modulus', 'damping_coefficient', 'chain_limit', 'remanence',
              'coil_time_constant', 'stretch_bias'), weights=_CAREFUL))


@dataclass(frozen=True)
class Strategy:
    """A way to plan moves."""

    name: str
    shaper: str
    order: int = 1
    #: Use of samples: none; 'adapt' corrects moves, which take longer if a large error is
    #: expected; 'lqr' and 'mpc' set a level after each; 'learning' repeats the first move.
    kind: str = 'open'


ROBUST = Strategy('robust', 'robust', 2)
STRATEGIES = (
    Strategy('two-step', 'two_step'), ROBUST, Strategy('ZVD', 'zvd'),
    Strategy('learning', 'two_step', kind='learning'), Strategy('LQR', 'two_step', kind='lqr'),
    Strategy('MPC', 'two_step', kind='mpc'), Strategy('adapt', 'two_step', kind='adapt'))


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
        setup, now, device = self.device.actuators.setups[0], self.now, self.device
        plant = ActuatorSimulation(
            setup.actuator, time=now, coil_time_constant=setup.coil_time_constant)
        plant.set_state(
            float(device.stretch[0]), float(device.actuators.rate[0]),
            float(device.flux_density[0]), device.level(0))
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
