"""Compare runs: the timing of commands and samples, and the arrivals of the moves."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from hmsa.judge.records import Tolerances
from hmsa.model.equations import Array
from hmsa.model.residual import percent
from hmsa.model.units import NANOSECONDS
from hmsa.report.evaluation import evaluate, Evaluation, MoveResult, verdicts
from hmsa.report.figures import TimeCurve
from hmsa.runs.record import lateness_of, RecordedLevel, Run, Times, without_repeats

# A change of level that took effect within this time in s of its timestamp was on time: the clock
# of a board with a schedule of its own is known to a few us.
_PUNCTUAL = 1e-5


@dataclass(frozen=True)
class Timing:
    """Timing of commands and samples; all arrays are in s."""

    commands: tuple[RecordedLevel, ...]  #: commands that change the level, in the order received
    repeats: int  #: number of commands that repeat the level
    #: Shape (m,): timestamp minus recording time of each command; below 0 if late. Empty if
    #: recorder and timestamps used different clocks.
    lead: Array
    #: Shape (k,): time at which each change of level took effect, as the plant or the driver
    #: reported, minus its timestamp; NaN if not reported. Empty without any report.
    lateness: Array
    delay: Array  #: shape (n,): recording time minus timestamp of each sample; or empty
    interval: Array  #: shape (n - 1,): between consecutive timestamps of samples
    arrival_interval: Array  #: shape (n - 1,): between consecutive recording times
    missing: int  #: number of samples that would fill the gaps in the timestamps
    unapplied: int  #: changes of level that were due and were not reported as taking effect

    @property
    def late(self) -> int:
        """Number of commands that took effect late; without reports, that were recorded late."""
        if len(self.lateness):
            return int(np.count_nonzero(self.lateness > _PUNCTUAL))
        return int(np.count_nonzero(self.lead < 0.0))


def timing(run: Run) -> Timing:
    """Return the timing of the commands and samples of a run."""
    commands, repeats = without_repeats(run.accepted)
    delay = (run.logged - run.time) / NANOSECONDS
    interval = np.diff(run.time) / NANOSECONDS
    lead = np.array([x.stamp - x.sent for x in commands], dtype=np.int64) / NANOSECONDS
    if not run.one_clock:
        delay, lead = np.empty(0), np.empty(0)
    recorded: Times = np.sort(run.logged)
    usual = float(np.median(interval)) if len(interval) else math.inf
    gaps = np.rint(interval / usual) - 1.0
    lateness, unapplied = lateness_of(commands, run.applied, int(run.time[-1]))
    return Timing(
        commands, repeats, lead, lateness, delay, interval, np.diff(recorded) / NANOSECONDS,
        int(np.sum(gaps[gaps > 0.0])) if len(interval) else 0, unapplied)


# Data of an arrival's panel, from the begin of the move, in durations of the move.
_PANEL_SPAN = 20.0
# Initial view of that panel, in durations of the move.
_SHOWN = 4.0
#: Shown in place of a residual.
NOT_MOVED = 'did not move'


@dataclass(frozen=True)
class Part:
    """One run of a report."""

    run: Run
    evaluation: Evaluation
    timing: Timing

    @classmethod
    def of(cls, run: Run, tolerances: Tolerances | None = None) -> 'Part':
        """Evaluate a run with the given tolerances, by default those of its planner."""
        return cls(run, evaluate(run, tolerances), timing(run))


def worst(parts: Sequence[Part], most: int) -> list[int]:
    """Return the indices of the setpoints with the largest residual vibration, sorted."""
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
    """Return the largest residual vibration of several moves as text, or the range with least."""
    if not all(x.moved for x in results):
        return NOT_MOVED
    shares = [x.residual for x in results if math.isfinite(x.residual)]
    if not shares:
        return '–'
    return ' to '.join(dict.fromkeys(
        f'{percent(x)} %' for x in ([min(shares)] if least else []) + [max(shares)]))


def left_text(results: Sequence[MoveResult], *, least: bool = False) -> str:
    """Return the residual vibration of several moves as text for a heading."""
    text = residual_text(results, least=least)
    return text if text == NOT_MOVED else f'residual {text}'


def around(x: MoveResult, curve: TimeCurve) -> tuple[Array, Array]:
    """Return a curve around an arrival: time in the move in s, and error in % of the step."""
    inside = curve.between(x.begin, min(x.end, x.begin + _PANEL_SPAN * max(x.arrival, 1e-9)))
    return inside.time - x.begin, 100.0 * (inside.stretch - x.stretch) / abs(x.step)


def span(parts: Sequence[Part], number: int) -> float:
    """Return the length of an arrival's panel in s."""
    return max((
        min(x.end - x.begin, _SHOWN * x.arrival) for x in results_of(parts, number)), default=1.0)


def title(parts: Sequence[Part], number: int) -> str:
    """Return the heading of an arrival."""
    results = results_of(parts, number)
    targets = ', '.join(dict.fromkeys(f'{x.stretch:.6g}' for x in results))
    said = verdicts([x.evaluation for x in parts], number)
    left = left_text(results, least=True)
    return f'{results[0].place + 1}. to {targets}: {left}{said}'
