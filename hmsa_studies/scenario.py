"""Scenarios for the comparison of feedback: actuators with errors, sensors, and strategies."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from hmsa.model.parameters import ActuatorParameters, NondimensionalParameters
from hmsa_ros.runtime.records import TRACKED
from hmsa_studies.linear import Weights

#: Distances of the first and the next target from rest.
TARGETS = (0.4, 0.1)
# Sampling interval of a camera, in time scales.
_INTERVAL = 0.114
# Best of about 100 combinations, by vibration and steady-state error with G exact and with a 20 %
# error; others if the coil lags, since the loop rings with these.
_WEIGHTS = {'lqr': Weights(0.05, 0.01, 3.0), 'mpc': Weights(0.3, 0.03)}
_CAREFUL = {'lqr': Weights(0.3, 0.3, 1.0), 'mpc': Weights(1.0, 0.03, wander=0.03)}


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
