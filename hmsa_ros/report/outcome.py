"""Whether a run arrived: each setpoint, measured against a tolerance; and each level."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from hmsa_ros.core.model import Array, equilibrium_stretch
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.report.evaluation import evaluate, MoveResult, period_of
from hmsa_ros.runs.record import Run

ARRIVED, OFF_TARGET, VIBRATING, MISSED = 'arrived', 'off_target', 'vibrating', 'not_carried_out'
#: Offset and residual vibration of a setpoint that counts as reached, as shares of the step.
TOLERANCE = 0.02
# Stretches that differ by less are one setpoint.
_SAME = 1e-6
# Third differences show noise alone with so many samples a period; their variance is 20 times
# that of the noise. Noise of 1000 samples is so many standard deviations from peak to peak.
_ENOUGH_SAMPLES, _THIRD_DIFFERENCE, _PEAK_TO_PEAK = 20.0, math.sqrt(20.0), 8.0


@dataclass(frozen=True)
class Arrival:
    """One setpoint, measured."""

    joint: str  #: empty if it is not known
    stretch: float  #: target
    #: mean stretch after arrival, and how far it is from the target; NaN if not measured
    reached: float
    offset: float
    residual: float  #: peak-to-peak stretch after arrival; NaN likewise
    allowed: float  #: offset and residual of a setpoint that counts as reached, noise apart
    #: time of planned rest in s from the first command; NaN if it was not carried out
    arrival: float
    verdict: str  #: ``arrived``, ``off_target``, ``vibrating`` or ``not_carried_out``

    def sentence(self) -> str:
        """Return the verdict in words, with the figures."""
        place = f'setpoint {self.stretch:g}' + (f' of {self.joint}' if self.joint else '')
        if self.verdict == MISSED:
            return f'{place} was not carried out'
        if self.verdict == ARRIVED:
            return f'{place} arrived'
        if self.verdict == OFF_TARGET:
            return (f'{place} is off target by {self.offset:+.2g}: expected at most '
                    f'{self.allowed:.2g}')
        return (f'{place} vibrates by {self.residual:.2g} from peak to peak: expected at most '
                f'{self.allowed:.2g}')


def arrivals(run: Run, targets: Sequence[float], tolerance: float) -> list[Arrival]:
    """Measure the arrival at each target, one a move; the tolerance is a share of the step."""
    found = evaluate(run)
    noise = _noise(run)
    results = list(found.results)
    measured, previous = [], found.start
    for target in targets:
        step, previous = abs(target - previous), target
        if step <= _SAME:
            continue
        place = next(
            (i for i, x in enumerate(results) if abs(x.stretch - target) <= _SAME), None)
        if place is None:
            measured.append(Arrival(
                run.joint, target, math.nan, math.nan, math.nan, tolerance * step, math.nan,
                MISSED))
            continue
        measured.append(_measure(run, found.time, results[place], tolerance * step, noise))
        del results[:place + 1]
    return measured


def _measure(
        run: Run, time: Array, result: MoveResult, allowed: float, noise: float) -> Arrival:
    after = run.stretch[(time >= result.arrival) & (time <= result.end)]
    reached = float(np.mean(after)) if len(after) else math.nan
    residual = float(np.ptp(after)) if len(after) > 1 else math.nan
    offset = reached - result.stretch
    verdict = ARRIVED
    # NaN is neither within a tolerance.
    if not residual <= allowed + _PEAK_TO_PEAK * noise:
        verdict = VIBRATING
    if not abs(offset) <= allowed + _PEAK_TO_PEAK * noise / math.sqrt(max(len(after), 1)):
        verdict = OFF_TARGET if len(after) > 1 else MISSED
    return Arrival(
        run.joint, result.stretch, reached, offset, residual, allowed, result.arrival, verdict)


@dataclass(frozen=True)
class LevelResult:
    """A level of the field, measured."""

    joint: str  #: empty if it is not known
    flux_density: float  #: in T
    times: int  #: how often it was in force; the one at the end of the run counts apart
    duration: float  #: in s, of all times
    #: stretch that it holds by the parameters in the run; NaN beyond the law of the block
    rest: float
    #: measured stretch while it was in force; NaN without samples
    mean: float
    least: float
    greatest: float


def level_results(run: Run) -> list[LevelResult]:
    """Measure each level of a run, equal ones together, in the order in which they came first."""
    levels = [x for x in run.levels if x.stamp <= run.time[-1]]
    ends = [*(x.stamp for x in levels[1:]), int(run.time[-1]) + 1]
    groups: dict[tuple[float, bool], list[tuple[int, int]]] = {}
    for i, (level, end) in enumerate(zip(levels, ends, strict=True)):
        groups.setdefault((level.flux_density, i + 1 == len(levels)), []).append(
            (level.stamp, end))
    results = []
    for (flux_density, _), spans in groups.items():
        parts = [run.stretch[slice(*np.searchsorted(run.time, x))] for x in spans]
        inside = np.concatenate(parts)
        rest = float(equilibrium_stretch(
            flux_density / run.planner.flux_density_unit, run.planner.nondimensional))
        figures = [float(x(inside)) for x in (np.mean, np.min, np.max)] if len(inside) else [
            math.nan] * 3
        results.append(LevelResult(
            run.joint, flux_density, len(spans), sum(y - x for x, y in spans) / NANOSECONDS, rest,
            *figures))
    return results


def _noise(run: Run) -> float:
    """Return the standard deviation of the sensor's noise; 0 where samples are too few."""
    if len(run.time) < 100:
        return 0.0
    interval = float(np.median(np.diff(run.time))) / NANOSECONDS
    if period_of(run) < _ENOUGH_SAMPLES * interval:
        return 0.0
    # The median leaves out what moves and what jumps.
    third = np.abs(np.diff(run.stretch, 3))
    return float(np.median(third)) / 0.6745 / _THIRD_DIFFERENCE
