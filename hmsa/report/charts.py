"""
The figures of runs, as descriptions for paper and page.

Curves are decimated to screen resolution, keeping peaks. Of several runs, each has a style of its
own, and simulated curves are hidden.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np

from hmsa.model.equations import Array, elastic_force
from hmsa.report import looks
from hmsa.report.comparison import around, left_text, Part, results_of, span, worst
from hmsa.report.figures import Axis, Curve, decimate, Panel, TimeCurve
from hmsa.report.looks import BLACK, BLUE, LineStyle, VERMILION
from hmsa.runs.record import held_at
from hmsa.table import RESOLVED

#: Maximum number of setpoints with a panel of their own in a page.
MOST_PANELS = 12
_PANEL_BUCKETS = 300
_MOST_PHASE_POINTS = 8_000
_PHASE_GRID = 1000.0
# Above this number, markers are smaller.
_MANY_MARKERS = 100
_LONGEST_IN_MS = 2.0
# Maximum number of samples that are also drawn as points.
_MOST_SAMPLES = 200
# Maximum number of periods shown for dashed lines; above it, lines are solid and thin.
_DASHED, _THIN = 25.0, 0.6
# Time shown after the last arrival, in durations of the move, if only rest follows: deviations
# within this fraction of the step.
_REST, _STILL = 8.0, 0.02
# A plan is drawn over the recording if it differs by more than this fraction of the motion.
_SEEN = 0.02
# Differences of stretch, and of times in s, that are rounding.
_IDENTICAL, _CONSTANT = 1e-9, 1.5e-9
# Room above the largest error, as a factor; and limits of the axis in percent of the step.
_ABOVE, _LEAST_ERROR, _MOST_ERROR = 1.5, 10.0, 200.0


@dataclass(frozen=True)
class TimeUnit:
    """The unit of a time axis: its size in s and its name."""

    size: float
    name: str

    def of(self, seconds: Any) -> Array:
        """Return times in this unit."""
        return np.asarray(seconds, dtype=np.float64) / self.size


def time_unit(parts: Sequence[Part]) -> TimeUnit:
    """Return the unit for the time axes: milliseconds for short runs."""
    return unit_for(max(float(np.max(np.abs(x.evaluation.time[[0, -1]]))) for x in parts))


def unit_for(seconds: float, most: float = _LONGEST_IN_MS) -> TimeUnit:
    """Return the unit for an axis of a length in s: milliseconds up to ``most``."""
    return TimeUnit(1e-3, 'ms') if seconds <= most else TimeUnit(1.0, 's')


@dataclass(frozen=True)
class _Pen:
    """Names and styles of the curves of one run among several, or alone."""

    part: Part
    own: LineStyle | None  # style of the run; None if it is alone

    def measured(self, x: Array, y: Array, **more: Any) -> Curve:
        """Return the curve through the samples."""
        run = self.part.run
        return Curve(run.origin if self.own is None else run.label,
                     self.own or looks.RECORDED, x, y, **more)

    def samples(self, x: Array, y: Array, curve: Curve) -> list[Curve]:
        """Return the samples as points if they are few and the curve has more."""
        run = self.part.run
        exact = run.origin == 'simulated' and not run.number('plant.stretch_noise')
        if exact or len(x) >= len(curve.x) or len(x) > _MOST_SAMPLES:
            return []
        name = 'samples' if self.own is None else f'{run.label}, samples'
        look = LineStyle(curve.look.colour, marker='o', size=2.2, order=4)
        return [Curve(name, look, x, y, 'points')]

    def simulated(self, kind: str, x: Array, y: Array, *, hidden: bool = False) -> Curve:
        """Return a curve that was not recorded: ``'unshaped steps'`` or ``'plan'``."""
        look = looks.PLAN if kind == 'plan' else looks.PLAIN
        if self.own is not None:
            return Curve(kind, replace(look, colour=self.own.colour), x, y, hidden=True)
        if kind != 'plan' and self.part.run.origin != 'simulated':
            kind = 'unshaped, simulated'
        return Curve(kind, look, x, y, hidden=hidden)


def _pens(parts: Sequence[Part]) -> list[_Pen]:
    return [_Pen(x, None if len(parts) == 1 else looks.case(i)) for i, x in enumerate(parts)]


def _dense(look: LineStyle, periods: float) -> LineStyle:
    """Return a style for a number of periods: lines that would lose their dashes are thin."""
    return replace(look, dash=(), width=_THIN) if look.dash and periods > _DASHED else look


def shown_times(parts: Sequence[Part]) -> tuple[float, float]:
    """Return the range of times to show in s, without the rest at both ends."""
    begins, ends = [], []
    for part in parts:
        found = part.evaluation
        begin, end = float(found.time[0]), float(found.time[-1])
        if found.results:
            last = found.results[-1]
            quiet = max(last.rests, min(last.begin + _REST * last.arrival, end))
            after = found.recorded.between(quiet, end).stretch
            if len(after) and np.nanmax(np.abs(after - last.stretch)) <= _STILL * abs(last.step):
                end = quiet
        # Leave room for the step to the first level.
        begins.append(max(begin, -0.06 * end) if end > 0.0 else begin)
        ends.append(end)
    begin, end = min(*begins, -0.02 * max(ends)), max(ends)
    return begin, end if end > begin else begin + 1.0


def _time(parts: Sequence[Part]) -> tuple[TimeUnit, Axis]:
    """Return the unit and the axis of the time of runs."""
    unit = time_unit(parts)
    begin, end = unit.of(shown_times(parts)).tolist()
    return unit, Axis('time', 't', unit.name, limits=(begin, end))


def _position(parts: Sequence[Part]) -> Axis:
    what = parts[0].run.plant.coordinate
    return Axis(what.name, what.symbol, tex=what.tex)


def response(parts: Sequence[Part]) -> list[Panel]:
    """Describe targets and response over time."""
    unit, time = _time(parts)
    begin, end = shown_times(parts)
    curves: list[Curve] = []
    for pen in _pens(parts):
        found = pen.part.evaluation
        curves += _targets(pen.part, unit)
        for kind, curve in (('unshaped steps', found.plain), ('plan', found.planned)):
            if np.isfinite(curve.stretch).any():
                curves.append(pen.simulated(
                    kind, *decimate(unit.of(curve.time), curve.stretch),
                    hidden=kind == 'plan' and not _differs(pen.part)))
        measured = pen.measured(*decimate(unit.of(found.recorded.time), found.recorded.stretch))
        curves += [measured, *pen.samples(
            unit.of(found.time), pen.part.run.stretch, measured)]
    periods = (end - begin) / min(x.run.plant.period for x in parts)
    # The dots of a plan, which does not ring, are as in the other panels.
    curves = [x if x.name == 'plan' else replace(x, look=_dense(x.look, periods))
              for x in _once(curves)]
    return [Panel(time, _position(parts), curves, height=1.45)]


def _targets(part: Part, unit: TimeUnit) -> list[Curve]:
    """Return the targets over time, each from the start of its move to the end of the hold."""
    found = part.evaluation
    times: list[float] = []
    targets: list[float] = []
    for x in found.results:
        # Holds that follow each other are joined; NaN leaves a gap.
        if times and x.begin - times[-1] > 0.05 * x.arrival:
            times.append(x.begin)
            targets.append(math.nan)
        times += [x.begin, x.end]
        targets += [x.stretch, x.stretch]
    return [Curve('target', looks.SETPOINT, unit.of(times), np.array(targets), 'steps')
            ] if times else []


def _once(curves: Sequence[Curve]) -> list[Curve]:
    """Return curves without those of several runs that are the same."""
    seen: set[tuple[Any, ...]] = set()
    kept = []
    for curve in curves:
        key = (curve.name, curve.look, curve.x.tobytes(), curve.y.tobytes())
        if key not in seen:
            kept.append(curve)
            seen.add(key)
    return kept


def _differs(part: Part) -> bool:
    """Return whether a reader sees a difference of the plan from the recording."""
    apart = np.abs(_deviation(part))
    size = float(np.ptp(part.run.stretch))
    return bool(np.isfinite(apart).any() and np.nanmax(apart) > _SEEN * size)


def _deviation(part: Part) -> Array:
    """Return recorded minus planned stretch at the samples; NaN without a plan."""
    found = part.evaluation
    difference: Array = part.run.stretch - found.planned.at(found.time).stretch
    return difference


def commanded(part: Part) -> tuple[list[float], list[float]]:
    """
    Return times in s and levels of the command in mT, from first to last sample.

    The first level is that in force before the first command: as measured, or the one that holds
    the initial stretch.
    """
    run, found = part.run, part.evaluation
    times = [found.seconds(x.stamp) for x in found.levels]
    values = [x.flux_density * 1e3 for x in found.levels]
    # Extend the last level to the end of the recording.
    times.append(max(times[-1], float(found.time[-1])))
    values.append(values[-1])
    # Show the step to the first level even if the samples begin with it.
    before = int(np.searchsorted(found.time, times[0])) - 1
    held = float(run.flux_density[before]) if before >= 0 else math.nan
    if times[0] >= 0.0 and not math.isfinite(held):
        held = float(run.plant.units.level(
            elastic_force(found.start, run.plant.nondimensional)))
    if math.isfinite(held):
        times.insert(0, min(float(found.time[0]), times[0] - 0.02 * (times[-1] - times[0])))
        values.insert(0, held * 1e3)
    return times, values


def command(parts: Sequence[Part]) -> list[Panel]:
    """Describe the flux density over time: as commanded and, where it differs, as applied."""
    unit, time = _time(parts)
    curves = []
    for pen in _pens(parts):
        fields = _field(pen, unit)
        if pen.part.evaluation.levels:
            times, values = commanded(pen.part)
            curve = pen.measured(unit.of(times), np.array(values), form='steps')
            # The label of the axis names a curve that is alone.
            curves.append(curve if pen.own else replace(
                curve, name='command', listed=bool(fields)))
        curves += fields
    return [Panel(time, Axis('flux density', 'B', 'mT'), curves)]


def _field(pen: _Pen, unit: TimeUnit) -> list[Curve]:
    """Return the field in force as measured or reported; none if it follows the command."""
    run, found = pen.part.run, pen.part.evaluation
    look = looks.FIELD if pen.own is None else replace(looks.FIELD, colour=pen.own.colour)
    name = 'field in force' if pen.own is None else pen.part.run.label
    if found.levels:
        expected = held_at(found.levels, run.time)
        follows = np.abs(run.flux_density - expected)
        if np.isfinite(follows).any() and (
                np.nanmax(follows) <= 1e-9 * np.nanmax(np.abs(expected))):
            return []
    if np.isfinite(run.flux_density).any():
        return [Curve(name, look, *decimate(unit.of(found.time), run.flux_density * 1e3))]
    if run.applied:
        applied = sorted(run.applied, key=lambda x: x.stamp)
        times = unit.of([*(found.seconds(x.stamp) for x in applied), max(
            found.seconds(applied[-1].stamp), float(found.time[-1]))])
        values = np.array([x.flux_density for x in (*applied, applied[-1])]) * 1e3
        return [Curve(name, look, times, values, 'steps')]
    return []


def phase(parts: Sequence[Part]) -> list[Panel]:
    """Describe the phase plane with the equilibria."""
    curves: list[Curve] = []
    for pen in _pens(parts):
        found, run = pen.part.evaluation, pen.part.run
        x, y, _ = _orbit(found.plain)
        if len(x):
            curves.append(pen.simulated('unshaped steps', x, y))
        x, y, _ = _orbit(found.recorded)
        measured = pen.measured(x, y)
        curves += [measured, *pen.samples(run.stretch, run.rate, measured)]
    starts = np.array(sorted({x.evaluation.start for x in parts}))
    targets = np.array(sorted({y.stretch for x in parts for y in x.evaluation.results}))
    for name, look, places in (
            ('start', replace(looks.EQUILIBRIUM, filled=False), starts),
            ('equilibrium', looks.EQUILIBRIUM, targets)):
        if len(places):
            curves.append(Curve(name, look, places, np.zeros(len(places)), 'points'))
    what = parts[0].run.plant.coordinate
    return [Panel(_position(parts), Axis(
        f'{what.name} rate', f'd{what.symbol}/dt', '1/s', rf'\dot{{{what.tex}}}'), curves,
        height=1.6)]


def phase_shown(parts: Sequence[Part]) -> float:
    """Return the smallest fraction of a run that the phase plane shows, from its beginning."""
    return min(_orbit(curve)[2] for x in parts for curve in (
        x.evaluation.plain, x.evaluation.recorded))


def _orbit(curve: TimeCurve) -> tuple[Array, Array, float]:
    """Return a curve in the phase plane without coincident points, and the fraction kept."""
    finite = np.isfinite(curve.stretch) & np.isfinite(curve.rate)
    x, y = curve.stretch[finite], curve.rate[finite]
    if not len(x):
        return x, y, 1.0
    scale = [max(float(np.ptp(z)), 1e-12) / _PHASE_GRID for z in (x, y)]
    cells = np.stack([np.floor(x / scale[0]), np.floor(y / scale[1])])
    keep = np.append(True, np.any(np.diff(cells, axis=1) != 0.0, axis=0))
    keep[-1] = True
    places = np.flatnonzero(keep)
    share = 1.0
    if len(places) > _MOST_PHASE_POINTS:
        # Long motions would fill the plane.
        share = _MOST_PHASE_POINTS / len(places)
        places = places[:_MOST_PHASE_POINTS]
    return x[places], y[places], share


def errors(parts: Sequence[Part], most: int = MOST_PANELS) -> list[Panel]:
    """Describe the errors around the arrivals with the largest residuals."""
    return [error(parts, i) for i in worst(parts, most)]


def error(parts: Sequence[Part], number: int) -> Panel:
    """Describe the error around one arrival, in percent of the step."""
    shown = span(parts, number)
    unit = unit_for(shown, 1.0)
    curves: list[Curve] = []
    tolerances, arrivals = [], set()
    for pen in _pens(parts):
        found = pen.part.evaluation
        if number >= len(found.results):
            continue
        result = found.results[number]
        arrivals.add(float(unit.of(result.arrival)))
        tolerances.append(100.0 * found.allowed(result) / abs(result.step))
        for kind, motion in (('unshaped steps', found.plain), ('plan', found.planned)):
            time, distance = around(result, motion)
            if pen.own is None and np.isfinite(distance).any():
                curves.append(pen.simulated(
                    kind, *decimate(unit.of(time), distance, _PANEL_BUCKETS),
                    hidden=kind == 'plan' and not _differs(pen.part)))
        time, distance = around(result, found.recorded)
        measured = pen.measured(*decimate(unit.of(time), distance, _PANEL_BUCKETS))
        samples, away = around(result, TimeCurve(found.time, pen.part.run.stretch, found.time))
        curves += [measured, *pen.samples(unit.of(samples), away, measured)]
    ends = np.array([0.0, unit.of(shown)])
    band = np.full(2, min(tolerances))
    guides = [
        Curve('tolerance', looks.TOLERANCE, ends, band, 'band', lower=-band),
        Curve('end of the move', looks.ARRIVAL, np.array(sorted(arrivals)), form='vertical')]
    results = results_of(parts, number)
    targets = '/'.join(dict.fromkeys(f'{x.stretch:.5g}' for x in results))
    return Panel(
        Axis('time in the move', unit=unit.name, limits=(0.0, float(ends[1]))),
        error_axis([*curves, *guides[:1]], float(ends[1])), [*guides, *curves],
        f'to {targets}' if len(parts) > 1 else f'to {targets}: {left_text(results)}', 1.3)


def error_axis(curves: Sequence[Curve], end: float) -> Axis:
    """Return an axis that shows errors of the whole step and of a percent of it."""
    most = max((abs(x) for curve in curves for x in curve.extent('y', (0.0, end))), default=0.0)
    limit = min(max(_ABOVE * most, _LEAST_ERROR), _MOST_ERROR)
    return Axis('error', unit='% of step', limits=(-limit, limit), scale='symlog')


def residuals(parts: Sequence[Part]) -> list[Panel]:
    """Describe the residual vibration of all setpoints, also for unshaped steps."""
    curves = []
    for pen in _pens(parts):
        results = pen.part.evaluation.results
        places = np.arange(1.0, len(results) + 1.0, dtype=np.float64)
        size = 6.0 if len(results) <= _MANY_MARKERS else 3.0
        for kind, values in (
                ('', [x.residual for x in results]),
                ('unshaped steps', [x.residual_unshaped for x in results])):
            shares = 100.0 * np.maximum(np.array(values, dtype=np.float64), RESOLVED)
            curve = pen.simulated(kind, places, shares) if kind else pen.measured(places, shares)
            curves.append(replace(
                curve, form='points', hidden=False, look=replace(
                    curve.look, marker='s' if kind else 'o', filled=not kind, size=size),
                # One click in the legend hides both.
                name=curve.name if pen.own is None else pen.part.run.label))
    if not any(len(x.x) for x in curves):
        return []
    count = max(len(x.evaluation.results) for x in parts)
    ticks = tuple((i + 1.0, f'{i + 1}: ' + '/'.join(dict.fromkeys(
        f'{x.stretch:.5g}' for x in results_of(parts, i)))) for i in range(count))
    return [Panel(
        Axis('setpoint', limits=(0.5, count + 0.5), ticks=ticks if count <= MOST_PANELS else ()),
        Axis('residual vibration', unit='% of step', scale='log', limits=_decades(curves)),
        curves, height=1.45)]


def _decades(curves: Sequence[Curve]) -> tuple[float, float]:
    """Return the limits of a logarithmic axis: whole decades, so at least one has a label."""
    values = [math.log10(x) for curve in curves for x in curve.extent('y')] or [0.0]
    low, high = math.floor(min(values)), math.ceil(max(values))
    return 10.0 ** (low - 0.2), 10.0 ** (max(high, low + 1) + 0.2)


def deviations(parts: Sequence[Part]) -> list[Panel]:
    """Describe recorded minus planned stretch over time; no panel where there is no difference."""
    unit, time = _time(parts)
    curves = []
    for pen in _pens(parts):
        difference = _deviation(pen.part)
        if np.isfinite(difference).any() and np.nanmax(np.abs(difference)) > _IDENTICAL:
            curve = pen.measured(*decimate(unit.of(pen.part.evaluation.time), difference))
            name = curve.name if pen.own else f'{curve.name} − planned'
            curves.append(replace(
                curve, name=name, listed=pen.own is not None,
                look=replace(curve.look, width=1.0)))
    what = parts[0].run.plant.coordinate
    return [Panel(time, Axis(
        'deviation', f'Δ{what.symbol}', tex=rf'\Delta {what.tex}'), curves)
            ] if curves else []


def identical(parts: Sequence[Part]) -> list[str]:
    """Return a sentence for each run that is as planned."""
    return [
        f'{_of(x, parts)}The {x.run.origin} motion and the plan are identical: the largest '
        f'difference is below {_IDENTICAL:.0e}.'.replace('e-0', 'e-') for x in parts
        if np.isfinite(_deviation(x)).any()
        and np.nanmax(np.abs(_deviation(x))) <= _IDENTICAL]


def _of(part: Part, parts: Sequence[Part]) -> str:
    return f'{part.run.label}: ' if len(parts) > 1 else ''


def timings(parts: Sequence[Part]) -> list[Panel]:
    """Describe command lead, lateness, sample delay and intervals, where they vary."""
    unit, time = _time(parts)
    panels = []
    for quantity, group in _TIMINGS.items():
        curves, drawn = [], []
        for pen in _pens(parts):
            for name, look in group.items():
                times, values = _timing_of(pen.part)[name]
                if _constant(values):
                    continue
                if not look.marker:
                    times, values = decimate(times, values)
                drawn.append(name)
                curves.append(Curve(
                    f'{_of(pen.part, parts)}{name}',
                    look if pen.own is None else replace(look, colour=pen.own.colour),
                    unit.of(times), 1e3 * values, 'points' if look.marker else 'line'))
        if curves:
            label = quantity if len(set(drawn)) > 1 else drawn[0]
            panels.append(Panel(replace(time, limits=None), Axis(label, unit='ms'), curves))
    # Panels above each other have one range of times.
    ends = [x for panel in panels for x in panel.limits('x')]
    return [replace(x, x=replace(time, limits=(min(ends), max(ends)))) for x in panels]


def constant_timings(parts: Sequence[Part]) -> list[str]:
    """Return a sentence for each time that does not vary."""
    return [
        f'{_of(x, parts)}{name.capitalize()}: {1e3 * float(np.median(values)):.6g} ms throughout.'
        for x in parts for name, (_, values) in _timing_of(x).items()
        if len(values) and _constant(values)]


def _constant(values: Array) -> bool:
    return not len(values) or float(np.ptp(values)) <= _CONSTANT


def _timing_of(part: Part) -> dict[str, tuple[Array, Array]]:
    """Return times of commands or samples and a quantity, both in s, by the name of the latter."""
    found, timing = part.evaluation, part.timing
    stamps = np.array([found.seconds(x.stamp) for x in timing.commands])
    known = np.isfinite(timing.lateness)
    return {
        'command lead': (stamps[:len(timing.lead)], timing.lead),
        'lateness of the command': (stamps[:len(known)][known], timing.lateness[known]),
        'sample delay': (found.time[:len(timing.delay)], timing.delay),
        'interval as recorded': (found.time[1:], timing.arrival_interval),
        'interval of the timestamps': (found.time[1:], timing.interval)}


# Styles of the times of each panel of `timings`.
_TIMINGS = {
    'lead, lateness': {
        'command lead': LineStyle(BLUE, marker='o', size=4.5, order=3),
        'lateness of the command': LineStyle(VERMILION, marker='x', order=3)},
    'sample delay': {'sample delay': LineStyle(VERMILION, 1.0)},
    'sample interval': {
        'interval as recorded': LineStyle(VERMILION, 0.7, (2.0, 1.0)),
        'interval of the timestamps': LineStyle(BLACK, 1.2, order=3)}}

#: The panels of runs, by their names in `hmsa.report.looks`.
PANELS: Mapping[str, Callable[[Sequence[Part]], list[Panel]]] = dict(zip(looks.PANELS, (
    command, response, phase, errors, residuals, deviations, timings), strict=True))
