"""Who commands an actuator in the study of feedback: open loop, corrections, linear control."""

from dataclasses import replace
import math
from typing import TYPE_CHECKING

import numpy as np

from hmsa_ros.estimation import Estimate, Estimator, Options, Prior
from hmsa_ros.estimation.correction import caution, Corrector, Course
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.timeline import Options as PlannerOptions
from hmsa_studies.linear import Controller, Predictive, Quadratic

if TYPE_CHECKING:
    from hmsa_studies.feedback import Scenario, Strategy

#: Largest load, and time in ns from a sample's arrival to the first level that depends on it.
LARGEST, REACTION = 2.0, 300_000
# A move that is expected to leave more than this share of the step takes longer.
_TOLERANCE = 3e-5
_LINEAR: dict[str, type[Controller]] = {'lqr': Quadratic, 'mpc': Predictive}


class Commander:
    """Commands one actuator; this one plans with the nominal parameters and learns nothing."""

    #: Whether a level follows each sample; else a course is carried out until another one.
    steadily = False

    def __init__(self, scenario: 'Scenario', strategy: 'Strategy') -> None:
        block = scenario.block
        unit = block.flux_density_unit
        self._strategy = strategy
        self._prior = Prior.nominal(block, scenario.free)
        self._corrector = Corrector(PlannerOptions(
            flux_density_min=-LARGEST * unit, flux_density_max=LARGEST * unit))

    def _first(
            self, estimate: Estimate, target: float, course: Course,
            tolerance: float = math.inf) -> Course:
        return self._corrector.first(
            estimate, target, course.holding, shaper=self._strategy.shaper,
            order=self._strategy.order, tolerance=tolerance)

    def move(self, time: int, target: float, course: Course) -> Course:
        """Return the course to a target from a time in ns on, and from another course."""
        nominal = Estimate(
            time, course.target, 0.0, self._prior.values, self._prior.free, {},
            np.zeros((0, 0)), 0.0, True, '')
        return self._first(nominal, target, course)

    def seen(self, stamp: int, stretch: float, begin: int, course: Course) -> Course | None:
        """Take in a sample; return a better course that differs from a time in ns on, if any."""
        return None


class _Adapting(Commander):
    """Corrects moves and plans them with what it has learnt."""

    def __init__(self, scenario: 'Scenario', strategy: 'Strategy') -> None:
        super().__init__(scenario, strategy)
        self._estimator = Estimator(self._prior, Options(noise=scenario.noise))
        self._estimator.level(0, 0.0)
        self._moving = False

    def move(self, time: int, target: float, course: Course) -> Course:
        estimate = self._estimator.update(time)
        self._moving = True
        if estimate is None:
            return super().move(time, target, course)
        return self._taken(self._first(estimate, target, course, _TOLERANCE), time)

    def seen(self, stamp: int, stretch: float, begin: int, course: Course) -> Course | None:
        self._estimator.sample(stamp, stretch)
        estimate = self._estimator.update(begin)
        if estimate is None or not self._moving:
            return None
        found = self._corrector.correct(estimate, course)
        return None if found is None else self._taken(found, begin)

    def _taken(self, course: Course, begin: int) -> Course:
        for stamp, level in course.levels:
            if stamp >= begin:
                self._estimator.level(stamp, level)
        return course


class _Steady(Commander):
    """Commands a level after each sample, and has as long as a move that is cautious."""

    steadily = True

    def __init__(self, scenario: 'Scenario', strategy: 'Strategy') -> None:
        super().__init__(scenario, strategy)
        self._noise = scenario.noise
        self._controller = _LINEAR[strategy.kind](
            scenario.block, LARGEST, round(scenario.period * NANOSECONDS),
            round(scenario.delay * NANOSECONDS) + REACTION, scenario.noise,
            scenario.weights[strategy.kind])

    def move(self, time: int, target: float, course: Course) -> Course:
        planned = super().move(time, target, course)
        longer = caution(
            len(self._prior.free), self._noise / max(abs(target - course.target), 1e-9))
        arrival = time + round(longer * (planned.arrival - time))
        level = self._controller.move(target, planned.holding)
        return Course(((time, level),), arrival, target)

    def seen(self, stamp: int, stretch: float, begin: int, course: Course) -> Course | None:
        level = self._controller.seen(stretch)
        return None if level is None else replace(
            course, levels=(course.levels[-1], (begin, level)))


def commander(scenario: 'Scenario', strategy: 'Strategy') -> Commander:
    """Return who carries out a strategy; ``learning`` is repeated trials in open loop."""
    kinds = {'adapt': _Adapting, 'lqr': _Steady, 'mpc': _Steady}
    return kinds.get(strategy.kind, Commander)(scenario, strategy)
