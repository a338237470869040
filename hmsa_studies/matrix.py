"""All feedback strategies in all scenarios, compared with open loop."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, product
from typing import Any

import numpy as np
from scipy.special import ndtr

from hmsa_studies.feedback import CYCLE, CYCLES, ExpectedResidual, trial
from hmsa_studies.scenario import ROBUST, Scenario, SCENARIOS, STRATEGIES, Strategy, TARGETS
from hmsa_studies.study_folder import RowStudy

#: Errors of the shear modulus that are combined into one row.
ERRORS = ((0.0,), (-0.1, 0.1), (-0.2, 0.2))
# Factor on the result of the chain up to which another one is no worse.
_WORSE = 1.2
#: Arguments of `trial`.
Task = tuple[Scenario, Strategy, float, int]
# Fields of `Left`.
_LEFT = ('vibration', 'offset', 'motion')


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
