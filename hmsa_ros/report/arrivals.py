"""Runs side by side: when their commands and samples came, and the arrivals of their moves."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from hmsa_ros.judge.records import Tolerances
from hmsa_ros.model.equations import Array
from hmsa_ros.model.residual import percent
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.recordings.levels import lateness_of, Level, without_repeats
from hmsa_ros.recordings.record import Run, Times
from hmsa_ros.report.curves import Curve
from hmsa_ros.report.evaluation import evaluate, Evaluation, MoveResult, verdicts

# A change of level that took effect within so many s of its stamp was in time: the clock of a
# board that keeps time itself is known to some us.
_PUNCTUAL = 1e-5
# Clocks further apart than this are different clocks.
_SAME_CLOCK = 60.0


@dataclass(frozen=True)
class Timing:
    """When commands and samples came; all arrays are in s."""

    commands: tuple[Level, ...]  #: those that change something, in the order received
    repeats: int  #: how many commands changed nothing
    #: Shape (m,): how far ahead of its stamp each command was recorded; below 0 for a late one.
    #: Empty if the recorder kept another clock than the stamps.
    lead: Array
    #: Shape (k,): how long after its stamp each change of level took effect, as the plant or the
    #: driver reported; NaN for one that it did not report. Empty if it reported none.
    lateness: Array
    delay: Array  #: shape (n,): how long after its stamp each sample was recorded; or empty
    interval: Array  #: shape (n - 1,): between the stamps of two samples
    arrival_interval: Array  #: shape (n - 1,): between the times of recording
    missing: int  #: samples that gaps in the stamps have room for
    unapplied: int  #: changes of level that were due and did not take effect as reported

    @property
    def late(self) -> int:
        """Commands that took effect, or else were recorded, after the time they apply from."""
        if len(self.lateness):
            return int(np.count_nonzero(self.lateness > _PUNCTUAL))
        return int(np.count_nonzero(self.lead < 0.0))


def timing(run: Run) -> Timing:
    """Return when commands and samples of a run came."""
    commands, repeats = without_repeats(run.commands)
    delay = (run.logged - run.time) / NANOSECONDS
    interval = np.diff(run.time) / NANOSECONDS
    lead = np.array([x.stamp - x.sent for x in commands], dtype=np.int64) / NANOSECONDS
    if abs(float(np.median(delay))) > _SAME_CLOCK:
        delay, lead = np.empty(0), np.empty(0)
    recorded: Times = np.sort(run.logged)
    usual = float(np.median(interval)) if len(interval) else math.inf
    gaps = np.rint(interval / usual) - 1.0
    lateness, unapplied = lateness_of(commands, run.applied, int(run.time[-1]))
    return Timing(
        commands, repeats, lead, lateness, delay, interval, np.diff(recorded) / NANOSECONDS,
        int(np.sum(gaps[gaps > 0.0])) if len(interval) else 0, unapplied)


# Of what a panel holds beyond what it shows at first, in durations of the move.
_PANEL_SPAN = 20.0
# Of an arrival's panel: how long it is in durations of the move, and how many percent of the
# step it shows at least.
_SHOWN, _LEAST_PERCENT = 4.0, 5.0
#: Instead of a residual, which would be 0.
NOT_MOVED = 'did not move'


@dataclass(frozen=True)
class Part:
    """One run of a report; without a colour it is on its own and its curves differ in theirs."""

    run: Run
    evaluation: Evaluation
    timing: Timing
    colour: str = ''

    @classmethod
    def of(cls, run: Run, colour: str = '', tolerances: Tolerances | None = None) -> 'Part':
        """Measure a run, and judge it by tolerances, by default those of its planner."""
        return cls(run, evaluate(run, tolerances), timing(run), colour)


def worst(parts: Sequence[Part], most: int) -> list[int]:
    """Return the numbers, from 0 on, of the setpoints with the largest residuals."""
    count = max((len(x.evaluation.results) for x in parts), default=0)
    ranked = sorted(range(count), key=lambda i: -max(
        (x.residual if x.moved else math.inf for x in results_of(parts, i)
         if math.isfinite(x.residual) or not x.moved), default=0.0))
    return sorted(ranked[:most])


def results_of(parts: Sequence[Part], number: int) -> list[MoveResult]:
    """Return the results of one setpoint in all runs that have it."""
    return [x.evaluation.results[number] for x in parts
            if number < len(x.evaluation.results)]


def residual_text(results: Sequence[MoveResult], *, least: bool = False) -> str:
    """Return the largest residual of some moves in words, and the least before it if asked."""
    if not all(x.moved for x in results):
        return NOT_MOVED
    shares = [x.residual for x in results if math.isfinite(x.residual)]
    if not shares:
        return '–'
    return ' to '.join(dict.fromkeys(
        f'{percent(x)} %' for x in ([min(shares)] if least else []) + [max(shares)]))


def left_text(results: Sequence[MoveResult], *, least: bool = False) -> str:
    """Return what some moves left in words, as a heading has it."""
    text = residual_text(results, least=least)
    return text if text == NOT_MOVED else f'residual {text}'


def reach(parts: Sequence[Part], number: int) -> float:
    """Return how far an arrival's panel reaches from 0, in percent of the step."""
    return min(150.0, max([_LEAST_PERCENT, *(
        110.0 * x.error for x in results_of(parts, number) if math.isfinite(x.error))]))


def around(x: MoveResult, curve: Curve) -> tuple[Array, Array]:
    """Return a curve about an arrival: s after the move began, and off target in % of the step."""
    inside = curve.between(x.begin, min(x.end, x.begin + _PANEL_SPAN * max(x.arrival, 1e-9)))
    return inside.time - x.begin, 100.0 * (inside.stretch - x.stretch) / abs(x.step)


def span(parts: Sequence[Part], number: int) -> float:
    """Return how long after its begin an arrival's panel ends, in s."""
    return max((
        min(x.end - x.begin, _SHOWN * x.arrival) for x in results_of(parts, number)), default=1.0)


def title(parts: Sequence[Part], number: int) -> str:
    """Return the heading of an arrival."""
    results = results_of(parts, number)
    targets = ', '.join(dict.fromkeys(f'{x.stretch:.6g}' for x in results))
    said = verdicts([x.evaluation for x in parts], number)
    left = left_text(results, least=True)
    return f'{results[0].place + 1}. to {targets}: {left}{said}'
