"""
What feedback leaves of moves when the model is in error, beside open loop.

The actuator is simulated with its true parameters, and measured with noise, late, by a sensor with
an unknown bias. Whoever commands it has the nominal ones.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from itertools import count
import math

import numpy as np

from hmsa_ros.core.parameters import ActuatorParameters, NondimensionalParameters
from hmsa_ros.core.simulation import ActuatorSimulation
from hmsa_ros.core.timeline import Options as PlannerOptions
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.estimation import Estimate, Estimator, Options, Prior
from hmsa_ros.estimation.correction import Corrector, Course
from hmsa_ros.estimation.prior import TRACKED

#: Where a first move, and after it another one, go from stretch 1.
TARGETS = (1.4, 1.1)
#: Errors of the shear modulus that make a row together.
ERRORS = ((0.0,), (-0.1, 0.1), (-0.2, 0.2))
_BIAS = 1e-3
# Largest load, and time in ns from a sample's arrival to the first level that depends on it.
_LARGEST, _REACTION = 2.0, 300_000
# Samples before the first move, and points of a motion that is looked at.
_BEFORE, _LOOK, _WATCHED = 50, 120, 40
# A cycle, and after what time nothing moves, in nominal units of time.
_CYCLE, _SETTLED = 1.45, 150.0
# Cycles between the first move and the next one.
_CYCLES = 3
# A move that is expected to leave more than this share of the step takes longer.
_TOLERANCE = 3e-4


@dataclass(frozen=True)
class Scenario:
    """
    Actuator and sensor.

    Attributes
    ----------
    name : str
        For people.
    period, delay : float
        Between two samples, and until one is there, in s.
    noise : float
        Standard deviation of a sample of stretch.
    half_length : float
        In m: sets the unit of time, 4.4 ms for 0.01 m.
    truth : mapping of str to float
        Factors on parameters of the block besides the shear modulus.
    coil_time_constant : float
        Of the coil in s, unknown to the model.
    free : tuple of str
        What is tracked.

    """

    name: str
    period: float
    delay: float
    noise: float
    half_length: float = 0.01
    truth: Mapping[str, float] = field(default_factory=dict)
    coil_time_constant: float = 0.0
    free: tuple[str, ...] = TRACKED

    @property
    def block(self) -> ActuatorParameters:
        """Nominal."""
        return ActuatorParameters.from_nondimensional(
            NondimensionalParameters(), shear_modulus=1e4, density=1900.0,
            half_length=self.half_length, remanence=0.1)


#: The matrix: samples at 1 kHz that are 2 ms late, and a camera on a slower actuator.
SCENARIOS = (
    Scenario('1 kHz, 2 ms late, noise 1e-3', 1e-3, 2e-3, 1e-3),
    Scenario('1 kHz, 2 ms late, noise 1e-4', 1e-3, 2e-3, 1e-4),
    Scenario('200 Hz, 10 ms late, noise 1e-3, T 44 ms', 5e-3, 1e-2, 1e-3, 0.1),
    Scenario(
        '1 kHz, 2 ms late, noise 1e-3; Br +5 %, lag 0.5 ms', 1e-3, 2e-3, 1e-3,
        truth={'remanence': 1.05}, coil_time_constant=5e-4,
        free=('shear_modulus', 'damping_coefficient', 'chain_limit', 'remanence',
              'coil_time_constant', 'stretch_bias')))


@dataclass(frozen=True)
class Strategy:
    """
    How moves are planned.

    Attributes
    ----------
    name : str
        For people.
    shaper, order : str, int
        Shaper of all moves, and order of the robust one.
    feedback : bool
        Whether samples count; a move that is expected to leave much takes longer then.

    """

    name: str
    shaper: str
    order: int = 1
    feedback: bool = False


STRATEGIES = (
    Strategy('two-step', 'two_step'), Strategy('chained', 'robust', 2),
    Strategy('ZVD', 'zvd'), Strategy('adapt', 'two_step', feedback=True))


@dataclass(frozen=True)
class Row:
    """
    A strategy in a scenario, with errors of one size.

    Attributes
    ----------
    scenario, strategy : str
        Names.
    error : float
        Size of the error of G, as a share.
    left : tuple of Left
        Root mean square over both signs and all seeds: after the first move, a cycle later, two
        cycles later, and after the next move.
    worst : tuple of float
        Largest vibration of all.

    """

    scenario: str
    strategy: str
    error: float
    left: 'tuple[Left, ...]'
    worst: tuple[float, ...]


@dataclass(frozen=True)
class Left:
    """
    What would be left if the course in force were carried to its end from a time on.

    Attributes
    ----------
    vibration, offset : float
        Peak to peak, and rest less target, as shares of the step.
    motion : float
        Peak to peak in the cycle that follows, in which the loop stays closed.

    """

    vibration: float
    offset: float
    motion: float


class _Trial:
    """One run of a strategy on one actuator."""

    def __init__(
            self, scenario: Scenario, strategy: Strategy, error: float, seed: int,
            targets: Sequence[float]) -> None:
        block = scenario.block
        self._scenario, self._strategy, self._targets = scenario, strategy, targets
        self._true = replace(
            block, shear_modulus=block.shear_modulus * (1.0 + error),
            **{name: x * getattr(block, name) for name, x in scenario.truth.items()})
        unit = block.flux_density_unit
        self._corrector = Corrector(PlannerOptions(
            flux_density_min=-_LARGEST * unit, flux_density_max=_LARGEST * unit))
        self._estimator = Estimator(
            Prior.nominal(block, scenario.free), Options(noise=scenario.noise))
        self._estimator.level(0, 0.0)
        self._plant = self._new_plant(0)
        self._random = np.random.default_rng(seed)
        self._course = Course(((0, 0.0),), 0, 1.0)
        self._events: list[tuple[int, int, str, float]] = []
        self._number = count()
        self._stretch = 1.0
        # Time in ns from which on there is a course to be corrected.
        self._moving = math.inf
        self.corrections = 0

    def _new_plant(self, time: int) -> ActuatorSimulation:
        return ActuatorSimulation(
            self._true, time=time, coil_time_constant=self._scenario.coil_time_constant)

    def _at(self, time: int, what: str, value: float = 0.0) -> None:
        heappush(self._events, (time, next(self._number), what, value))

    def run(self) -> list[Left]:
        """Return what is left after the first move, after each cycle, and after the next ones."""
        period = round(self._scenario.period * NANOSECONDS)
        left: list[Left] = []
        seen: list[list[float]] = []
        cycle = round(_CYCLE * self._scenario.block.time_unit * NANOSECONDS)
        self._at(period, 'sample')
        self._at(_BEFORE * period, 'move', self._targets[0])
        moves = 0
        while self._events:
            time, _, what, value = heappop(self._events)
            self._plant.advance(time)
            if what == 'sample':
                noise = self._scenario.noise * float(self._random.standard_normal())
                self._at(time + round(self._scenario.delay * NANOSECONDS), 'seen',
                         self._plant.stretch + _BIAS + noise)
                self._at(time + period, 'sample')
            elif what == 'seen':
                self._seen(time, value)
            elif what == 'move':
                self._move(time, value, first=moves == 0)
                for i in range(_CYCLES if moves == 0 else 1):
                    self._at(self._course.arrival + i * cycle, 'look')
                moves += 1
                if moves < len(self._targets):
                    self._at(self._course.arrival + _CYCLES * cycle, 'move',
                             self._targets[moves])
                else:
                    self._at(self._course.arrival + cycle, 'end')
            elif what == 'look':
                left.append(self._left(time))
                seen.append([])
                for i in range(_WATCHED):
                    self._at(time + cycle * i // _WATCHED, 'watch')
            elif what == 'watch':
                seen[-1].append(self._plant.stretch)
            else:
                break
        return [replace(x, motion=(max(y) - min(y)) * x.motion)
                for x, y in zip(left, seen, strict=True)]

    def _seen(self, time: int, value: float) -> None:
        if not self._strategy.feedback:
            return
        stamp = time - round(self._scenario.delay * NANOSECONDS)
        self._estimator.sample(stamp, value)
        estimate = self._estimator.update(time + _REACTION)
        if estimate is None or time < self._moving:
            return
        found = self._corrector.correct(estimate, self._course)
        if found is not None:
            self.corrections += 1
            self._take(found, estimate.time)

    def _move(self, time: int, target: float, *, first: bool) -> None:
        estimate = self._estimator.update(time) if self._strategy.feedback else None
        if estimate is None:
            estimate = self._nominal(time)
        found = self._corrector.first(
            estimate, target, self._course.holding, shaper=self._strategy.shaper,
            order=self._strategy.order,
            tolerance=_TOLERANCE if self._strategy.feedback else math.inf)
        self._moving = min(self._moving, time)
        self._stretch, self._course = self._course.target, found
        self._take(found, time)

    def _nominal(self, time: int) -> Estimate:
        prior = self._estimator.prior
        return Estimate(
            time, self._course.target, 0.0, prior.values, prior.free, {}, np.zeros((0, 0)),
            0.0, True, '')

    def _take(self, course: Course, begin: int) -> None:
        self._course = course
        for stamp, level in course.levels:
            if stamp >= begin:
                self._plant.command(stamp, level)
                self._estimator.level(stamp, level)

    def _left(self, time: int) -> Left:
        """Carry out what is planned on a copy of the plant."""
        plant, course = self._new_plant(time), self._course
        before = [x for x in course.levels if x[0] <= time]
        plant.set_state(
            self._plant.stretch, self._plant.rate, self._plant.flux_density,
            (before or course.levels)[-1 if before else 0][1])
        for stamp, level in course.levels:
            if stamp > time:
                plant.command(stamp, level)
        end = max(time, course.arrival)
        unit = self._true.time_unit * NANOSECONDS
        seen = []
        for i in range(_LOOK):
            plant.advance(end + round(4.0 * unit * i / _LOOK))
            seen.append(plant.stretch)
        plant.advance(end + round(_SETTLED * unit))
        step = abs(course.target - self._stretch)
        return Left(
            (max(seen) - min(seen)) / step,
            (plant.stretch - course.target) / (course.target - self._stretch), 1.0 / step)


def trial(
        scenario: Scenario, strategy: Strategy, error: float, seed: int,
        targets: Sequence[float] = TARGETS) -> list[Left]:
    """
    Run moves once.

    Parameters
    ----------
    scenario : Scenario
        Actuator and sensor.
    strategy : Strategy
        How to plan.
    error : float
        Of the shear modulus, as a share.
    seed : int
        Of the noise.
    targets : sequence of float
        Stretches to go to.

    Returns
    -------
    list of Left
        After the first move, one and two cycles of 1.45 L sqrt(rho/G) later, and after each
        further move.

    """
    return _Trial(scenario, strategy, error, seed, targets).run()


def rms(trials: Iterable[Sequence[Left]]) -> list[Left]:
    """
    Return the root mean square of trials.

    Parameters
    ----------
    trials : iterable of sequence of Left
        As `trial` returns them.

    Returns
    -------
    list of Left
        For each time that was looked at.

    """
    rows = np.array([[(x.vibration, x.offset, x.motion) for x in row] for row in trials])
    return [Left(*x) for x in np.sqrt(np.mean(np.square(rows), axis=0)).tolist()]


def matrix(
        seeds: int, scenarios: Sequence[Scenario] = SCENARIOS,
        strategies: Sequence[Strategy] = STRATEGIES) -> Iterator[Row]:
    """
    Run all strategies in all scenarios.

    Parameters
    ----------
    seeds : int
        Of the noise, for each error; those without feedback do not depend on it.
    scenarios : sequence of Scenario
        Actuators and sensors.
    strategies : sequence of Strategy
        To compare.

    Yields
    ------
    Row
        One after the other.

    """
    for scenario in scenarios:
        for errors in ERRORS:
            for strategy in strategies:
                trials = [
                    trial(scenario, strategy, error, seed) for error in errors
                    for seed in range(seeds if strategy.feedback else 1)]
                yield Row(
                    scenario.name, strategy.name, max(errors), tuple(rms(trials)),
                    tuple(max(x.vibration for x in column)
                          for column in zip(*trials, strict=True)))
