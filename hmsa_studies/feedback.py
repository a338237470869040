"""
Results of moves with model errors, with feedback and in open loop.

The actuator is simulated with its true parameters, and measured with noise and latency, by a
sensor with an unknown bias. The controller has the nominal ones. Open loop and feedback use the
controller of the nodes, in simulated time. A matrix contains all strategies in all scenarios.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product
from typing import Any

import numpy as np
from scipy.special import ndtr

from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.simulation import ActuatorSimulation
from hmsa.model.units import NANOSECONDS
from hmsa_studies.commanders import (
    Commander,
    commander,
    LARGEST,
    planner_of,
    ROBUST,
    Scenario,
    SCENARIOS,
    STRATEGIES,
    Strategy,
    TARGETS,
)
from hmsa_studies.study_folder import RowStudy

# Samples before the first move, and points of the evaluated motions.
_BEFORE, _LOOK, _WATCHED = 50, 120, 40
# A cycle, and time after which the motion has ended, in nominal time scales.
CYCLE, _SETTLED = 1.45, 150.0
# Cycles between the first move and the next one, and trials of learning.
CYCLES, _TRIALS = 3, 4
# Duration of the samples after the arrival, in time scales, and increment of levels and durations
# for the Jacobian, relative to their units.
_SEEN, _SMALL = 2.0, 1e-3
# Minimum and maximum duration of the first level, relative to the nominal one.
_RANGE = (0.3, 2.0)

#: Errors of the shear modulus that are combined into one row.
ERRORS = ((0.0,), (-0.1, 0.1), (-0.2, 0.2))
# Factor on the result of the chain up to which another one is no worse.
_WORSE = 1.2
#: Arguments of `trial`.
Task = tuple[Scenario, Strategy, float, int]
# Fields of `ExpectedResidual`.
_LEFT = ('vibration', 'offset', 'motion')


@dataclass(frozen=True)
class ExpectedResidual:
    """Residual if the present course were completed, relative to the step."""

    #: Of a controller that sets a level after each sample, measured in the next cycle.
    vibration: float  #: peak to peak
    offset: float  #: rest minus target
    motion: float = 0.0  #: peak to peak in the next cycle, in which the loop stays closed

    def watched(self, seen: Sequence[float], *, steadily: bool) -> 'ExpectedResidual':
        """Return it with the motion of the next cycle, relative to the step."""
        motion = max(seen) - min(seen)
        if steadily:
            return ExpectedResidual(motion, sum(seen) / len(seen), motion)
        return replace(self, motion=motion)


class Learner:
    """
    Learns two levels, in ns and T, of a nominal block from samples every `period` in ns.

    The same move from rest is repeated. After each trial, the first level, its duration and the
    last level are changed by the errors of the samples after the arrival, through the Jacobian of
    the nominal block.
    """

    def __init__(
            self, block: ActuatorParameters, levels: tuple[tuple[int, float], ...],
            largest: float, period: int) -> None:
        """Begin with the nominal move."""
        self._block, self._period, self._largest = block, period, largest
        (begin, first), (end, last) = levels
        self._begin = begin
        self._scale = np.array([
            block.flux_density_unit, block.time_unit * NANOSECONDS, block.flux_density_unit])
        self.unknowns = np.array([first, end - begin, last]) / self._scale
        self._least, self._most = (x * self.unknowns[1] for x in _RANGE)
        count = int(_SEEN * block.time_unit * NANOSECONDS / period)
        self.stamps = [end + i * period for i in range(count)]
        here = self._nominal(self.unknowns)
        slopes = np.column_stack([
            (self._nominal(self.unknowns + _SMALL * row) - here) / _SMALL for row in np.eye(3)])
        self._inverse: Array = np.linalg.pinv(slopes).astype(np.float64)

    def levels(self, unknowns: Array) -> tuple[tuple[int, float], ...]:
        """Return timestamps in ns and levels in T."""
        first, duration, last = unknowns * self._scale
        return ((self._begin, float(first)), (self._begin + round(duration), float(last)))

    def learn(self, off: Array) -> None:
        """Change the levels by the errors of the samples."""
        found = self.unknowns - self._inverse @ off
        bound = self._largest / self._scale[0]
        self.unknowns = np.clip(
            found, [-bound, self._least, -bound], [bound, self._most, bound])

    def _nominal(self, unknowns: Array) -> Array:
        return np.array(list(carried_out(
            ActuatorSimulation(self._block), self.levels(unknowns), self.stamps)))


def carried_out(
        plant: ActuatorSimulation, levels: tuple[tuple[int, float], ...],
        stamps: list[int]) -> Iterator[float]:
    """Command levels and yield the stretch at times in ns."""
    for stamp, level in levels:
        plant.command(stamp, level)
    for stamp in stamps:
        plant.advance(stamp)
        yield plant.stretch


def settle(plant: ActuatorSimulation, end: int, target: float, before: float) -> ExpectedResidual:
    """Return the residual in four time scales from an arrival in ns on, and at rest."""
    unit = plant.actuator.time_unit * NANOSECONDS
    seen = []
    for i in range(_LOOK):
        plant.advance(end + round(4.0 * unit * i / _LOOK))
        seen.append(plant.stretch)
    plant.advance(end + round(_SETTLED * unit))
    return ExpectedResidual(
        (max(seen) - min(seen)) / abs(target - before),
        (plant.stretch - target) / (target - before))


def _moves(commanding: Commander, targets: Sequence[float]) -> Iterator[ExpectedResidual]:
    """Yield the residuals after the first move, after each cycle, and after the next moves."""
    scenario = commanding.scenario
    cycle = round(CYCLE * scenario.block.time_unit * NANOSECONDS)
    commanding.run(_BEFORE * round(scenario.period * NANOSECONDS))
    for number, target in enumerate(targets):
        before = commanding.target
        arrival = commanding.move(target)
        for i in range(CYCLES if number == 0 else 1):
            look = arrival + i * cycle
            commanding.run(look)
            left = settle(
                commanding.copy(), max(look, commanding.levels[-1][0]), target, before)
            seen = []
            for k in range(_WATCHED):
                commanding.run(look + cycle * k // _WATCHED)
                seen.append((float(commanding.device.stretch[0]) - target) / (target - before))
            yield left.watched(seen, steadily=commanding.steadily)
        commanding.run(arrival + (CYCLES if number == 0 else 1) * cycle)


def trial(
        scenario: Scenario, strategy: Strategy, error: float, seed: int) -> list[ExpectedResidual]:
    """
    Run one sequence of moves.

    Parameters
    ----------
    scenario : Scenario
        Actuator and sensor.
    strategy : Strategy
        How to plan moves.
    error : float
        Relative error of the shear modulus.
    seed : int
        Seed of the noise.

    Returns
    -------
    list of Left
        After the first move, one and two cycles of 1.45 L sqrt(rho/G) later, and after each
        further move.

    """
    if strategy.kind == 'learning':
        return list(_learned(scenario, strategy, error, seed, scenario.targets[0]))
    return list(_moves(commander(scenario, strategy, error, seed), scenario.targets))


def _learned(
        scenario: Scenario, strategy: Strategy, error: float, seed: int,
        target: float) -> Iterator[ExpectedResidual]:
    """Yield the residuals of trials of the first move, each from rest with a zeroed sensor."""
    random, block = np.random.default_rng(seed), scenario.block
    plan = planner_of(scenario, strategy).setpoint(target, 0)
    learner = Learner(
        block, tuple((x.stamp, x.flux_density) for x in plan.levels[-2:]),
        LARGEST * block.flux_density_unit,
        round(scenario.period * NANOSECONDS))
    for _ in range(_TRIALS):
        levels = learner.levels(learner.unknowns)
        plants = [ActuatorSimulation(
            scenario.actuator(error), coil_time_constant=scenario.coil_time_constant)
            for _ in range(2)]
        for stamp, level in levels:
            plants[0].command(stamp, level)
        left = settle(plants[0], levels[-1][0], target, block.rest)
        yield replace(left, motion=left.vibration)
        seen = np.array(list(carried_out(plants[1], levels, learner.stamps)))
        noise = scenario.noise * random.standard_normal(len(seen) + _BEFORE)
        learner.learn(seen + noise[_BEFORE:] - np.mean(noise[:_BEFORE]) - target)


@dataclass(frozen=True)
class Row:
    """A strategy in a scenario, with errors of one size."""

    scenario: str
    strategy: str
    error: float  #: relative error of G
    #: Root mean square over both signs and all seeds: after the first move, one cycle later, two
    #: cycles later, and after the next move; of learning, after each of four trials.
    left: 'tuple[ExpectedResidual, ...]'
    worst: tuple[float, ...]  #: largest vibration of all
    no_worse: bool | None = None  #: whether no run exceeds `allowed`; None for open loop


def rms(trials: Iterable[Sequence[ExpectedResidual]]) -> list[ExpectedResidual]:
    """Return the root mean square over trials, for each time."""
    rows = np.array([[(x.vibration, x.offset, x.motion) for x in row] for row in trials])
    return [ExpectedResidual(*x) for x in np.sqrt(np.mean(np.square(rows), axis=0)).tolist()]


@dataclass(frozen=True)
class Matrix:
    """All strategies in all scenarios."""

    seeds: int  #: number of noise seeds per error; open loop does not depend on them
    scenarios: Sequence[Scenario] = SCENARIOS
    strategies: Sequence[Strategy] = STRATEGIES

    def _trials(self) -> Iterator[tuple[Scenario, tuple[float, ...], Strategy, list[Task]]]:
        """Yield scenario, errors and strategy of each row, and its trials."""
        for scenario, errors, strategy in product(self.scenarios, ERRORS, self.strategies):
            yield scenario, errors, strategy, [
                (scenario, strategy, error, seed) for error in errors
                for seed in range(1 if strategy.kind == 'open' else self.seeds)]

    @property
    def tasks(self) -> list[Task]:
        """Return the arguments of all trials."""
        return [task for *_, tasks in self._trials() for task in tasks]

    @property
    def study(self) -> RowStudy:
        """Return the trials as a study, whose rows `left_of` reads."""
        return RowStudy(_row, self.tasks, {
            'scenario': 'string', 'strategy': 'string', 'error': 'double', 'seed': 'int64',
            **dict.fromkeys(_LEFT, 'doubles')}, (4, 100))

    def rows(self, left: Iterator[list[ExpectedResidual]]) -> Iterator[Row]:
        """Yield the rows of results given in the order of the tasks."""
        limits: dict[tuple[str, tuple[float, ...]], list[list[float]]] = {}
        for scenario, errors, strategy, tasks in self._trials():
            key = scenario.name, errors
            if key not in limits:
                limits[key] = [allowed(scenario, x) for x in errors]
            runs = list(islice(left, len(tasks)))
            each = len(runs) // len(errors)
            yield Row(
                scenario.name, strategy.name, max(errors), tuple(rms(runs)),
                tuple(max(x.vibration for x in column) for column in zip(*runs, strict=True)),
                None if strategy.kind == 'open' else all(
                    x.vibration <= limit[0 if strategy.kind == 'learning' else i]
                    for place, limit in enumerate(limits[key])
                    for run in runs[place * each:(place + 1) * each]
                    for i, x in enumerate(run)))


def _row(scenario: Scenario, strategy: Strategy, error: float, seed: int) -> dict[str, Any]:
    left = trial(scenario, strategy, error, seed)
    return {
        'scenario': scenario.name, 'strategy': strategy.name, 'error': error, 'seed': seed,
        **{name: [getattr(x, name) for x in left] for name in _LEFT}}


def left_of(row: Mapping[str, Any]) -> list[ExpectedResidual]:
    """Return the result of `trial` from the row of a table."""
    return [ExpectedResidual(*x) for x in zip(*(row[name] for name in _LEFT), strict=True)]


def allowed(scenario: Scenario, error: float) -> list[float]:
    """Return the vibration at each time up to which a strategy is no worse than open loop."""
    # A fifth more than that of the chain of order 2 or, without model errors, half of the
    # peak-to-peak noise in the samples of a cycle.
    if error or scenario.truth or scenario.coil_time_constant:
        return [_WORSE * x.vibration for x in trial(scenario, ROBUST, error, 0)]
    count = CYCLE * scenario.block.time_unit / scenario.period
    steps = [float(x) for x in np.diff([0.0, *TARGETS])]
    shown = scenario.noise * _range(count)
    return [0.5 * shown / abs(x) for x in (*[steps[0]] * CYCLES, *steps[1:])]


def _range(count: float) -> float:
    """Return the mean range of a number of normal values."""
    x = np.linspace(-8.0, 8.0, 4001)
    below = ndtr(x)
    return float(np.sum(1.0 - below ** count - (1.0 - below) ** count) * (x[1] - x[0]))
