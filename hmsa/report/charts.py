"""
The figures of a report, as Plotly data.

Curves are decimated to screen resolution, keeping peaks. Colours are those of
`hmsa.report.looks`; in dark mode the page replaces them by lighter ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import html
import math
from typing import Any

import numpy as np

from hmsa.model.equations import Array, elastic_force
from hmsa.model.residual import RESOLVED
from hmsa.model.units import NANOSECONDS
from hmsa.report import looks
from hmsa.report.arrivals import around, Part, reach, results_of, span, title
from hmsa.report.curves import BUCKETS, decimate, numbers, TimeCurve
from hmsa.report.evaluation import MoveResult
from hmsa.report.looks import BLACK, BLUE, GREY, VERMILION
from hmsa.runs.levels import held_at

MOST_PANELS = 12
_PANEL_BUCKETS = 300
_MOST_PHASE_POINTS = 8_000
_PHASE_GRID = 1000.0
# Above this number, markers are smaller.
_MANY_MARKERS = 100
_LONGEST_IN_MS = 2.0
# Maximum number of samples that are also drawn as points.
_MOST_SAMPLES = 500


@dataclass(frozen=True)
class TimeUnit:
    """The unit of a time axis: its size in s and its name."""

    size: float
    name: str

    def of(self, seconds: Any) -> Array:
        """Return times in this unit."""
        return np.asarray(seconds, dtype=np.float64) / self.size


@dataclass(frozen=True)
class Figure:
    """One figure: its alternative text, height in px, and Plotly's data and layout."""

    key: str
    alt: str
    height: int
    data: list[dict[str, Any]]
    layout: dict[str, Any]


def time_unit(parts: Sequence[Part]) -> TimeUnit:
    """Return the unit for the time axes: milliseconds for short runs."""
    return unit_for(max(float(np.max(np.abs(x.evaluation.time[[0, -1]]))) for x in parts))


def unit_for(seconds: float, most: float = _LONGEST_IN_MS) -> TimeUnit:
    """Return the unit for an axis of a length in s: milliseconds up to ``most``."""
    return TimeUnit(1e-3, 'ms') if seconds <= most else TimeUnit(1.0, 's')


def text(words: str) -> str:
    """Return a text escaped for Plotly, which interprets some HTML tags."""
    return html.escape(words, quote=False)


def curve(name: str, x: Any, y: Any, mode: str = 'lines', **own: Any) -> dict[str, Any]:
    """Return a Plotly trace of lines or markers."""
    return {
        'type': 'scatter', 'mode': mode, 'x': numbers(x), 'y': numbers(y), 'name': text(name),
        **own}


def _curve(
        part: Part, what: str, x: Any, y: Any, mode: str = 'lines', *,
        line: Mapping[str, Any] | None = None, **own: Any) -> dict[str, Any]:
    """
    Return the trace of a quantity of a run.

    The colour of the run takes precedence over that of line or marker. A click in the legend hides
    the whole group.
    """
    colour, simulated = part.colour, what in _SIMULATED
    trace = curve(
        f'{part.run.label}: {what}' if colour else what, x, y, mode,
        legendgroup=part.run.label if colour and not simulated else what, **own)
    if 'lines' in mode:
        # Plotly's simplification distorts flat lines by a pixel or two.
        trace['line'] = {'simplify': False, **_KINDS.get(what, {}), **(line or {})}
        if simulated and colour:
            trace['visible'] = 'legendonly'
    for style in (trace.get('line', {}), trace.get('marker', {})):
        if colour and 'color' in style:
            style['color'] = colour
    return trace


def _grouped(data: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return traces with one legend entry for each group, by the name of the group."""
    seen: set[str] = set()
    for trace in data:
        group = trace['legendgroup']
        trace['showlegend'] = group not in seen
        if group not in seen and text(group) in trace['name'].split(': '):
            trace['name'] = text(group)
        seen.add(group)
    return data


# Hidden until a click in the legend when several runs are compared.
_SIMULATED = ('unshaped steps', 'plan')
# Line properties of each kind of curve.
_KINDS: dict[str, dict[str, Any]] = {
    'recorded': looks.RECORDED.plotly(), 'unshaped steps': looks.PLAIN.plotly(),
    'plan': looks.PLAN.plotly(), 'field in force': looks.FIELD.plotly(),
    'command': {**looks.RECORDED.plotly(), 'shape': 'hv'}, 'target': looks.TARGET.plotly()}


def label(quantity: str, symbol: str = '', unit: str = '') -> str:
    """Return the label of an axis: quantity, symbol, and unit if given."""
    return ' '.join(x for x in (quantity, symbol, f'({unit})' if unit else '') if x)


def axis(name: str, **more: Any) -> dict[str, Any]:
    """Return a Plotly axis."""
    return {'title': {'text': name}, 'exponentformat': 'power', **more}


def _recorded(part: Part, x: Array, y: Array, samples: tuple[Array, Array], *,
              buckets: int = BUCKETS) -> list[dict[str, Any]]:
    """Return the recorded curve, and the samples as points if they are few."""
    data = [_curve(part, 'recorded', *decimate(x, y, buckets))]
    if len(samples[0]) < len(x) and len(samples[0]) <= _MOST_SAMPLES:
        data.append(_curve(
            part, 'recorded', *samples, mode='markers',
            marker={'size': 5, 'color': BLUE}))
    return data


def response(parts: Sequence[Part], unit: TimeUnit) -> Figure:
    """Return the command over time, above setpoints and response."""
    data = []
    for part in parts:
        run, found = part.run, part.evaluation
        for kind, curve in (('unshaped steps', found.plain), ('plan', found.planned)):
            data.append(_curve(part, kind, *decimate(unit.of(curve.time), curve.stretch)))
        data[-1:-1] = _recorded(
            part, unit.of(found.recorded.time), found.recorded.stretch,
            (unit.of(found.time), run.stretch))
        if found.results:
            spans = [(x.begin, x.end, math.nan) for x in found.results]
            data.append(_curve(
                part, 'target', unit.of(np.ravel(spans)),
                np.ravel([(x.stretch, x.stretch, math.nan) for x in found.results])))
            data.append(_curve(
                part, 'planned arrival', unit.of([x.rests for x in found.results]),
                [x.stretch for x in found.results], mode='markers',
                marker={
                    'symbol': 'diamond-open', 'size': _size(9, found.results), 'color': BLACK}))
        data += _commands(part, unit)
    what = parts[0].run.plant.coordinate
    return Figure(
        'response', f'Flux density command and {what.name} over time', 560,
        _grouped(data), {
            'xaxis': axis(label('time', 't', unit.name), anchor='y'),
            'yaxis': axis(label(what.name, what.symbol), domain=[0.0, 0.6]),
            'yaxis2': axis(
                label('flux density', 'B', 'mT'),
                domain=[0.68, 1.0], anchor='x')})


def commanded(part: Part) -> tuple[list[float], list[float]]:
    """
    Return times in s and levels of the command in the unit shown, from first to last sample.

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


def _commands(part: Part, unit: TimeUnit) -> list[dict[str, Any]]:
    """Return the traces of the flux density."""
    run, found = part.run, part.evaluation
    data = []
    if found.levels:
        times, values = commanded(part)
        switches = {x.stamp for x in found.levels}
        size = 6 if len(found.levels) <= _MANY_MARKERS else 3
        sizes = [size if round(x * NANOSECONDS) + found.zero in switches else 0 for x in times]
        data.append(_curve(
            part, 'command', unit.of(times), values, mode='lines+markers', yaxis='y2',
            marker={'size': sizes}))
        expected = held_at(found.levels, run.time)
        follows = np.abs(run.flux_density - expected)
        if np.isfinite(follows).any() and (
                np.nanmax(follows) <= 1e-9 * np.nanmax(np.abs(expected))):
            return data
    if np.isfinite(run.flux_density).any():
        data.append(_curve(
            part, 'field in force', *decimate(unit.of(found.time), run.flux_density * 1e3),
            yaxis='y2'))
    elif run.applied:
        applied = sorted(run.applied, key=lambda x: x.stamp)
        x = unit.of([*(found.seconds(x.stamp) for x in applied), max(
            found.seconds(applied[-1].stamp), float(found.time[-1]))])
        y = np.array([x.flux_density for x in (*applied, applied[-1])]) * 1e3
        data.append(_curve(part, 'field in force', x, y, yaxis='y2', line={'shape': 'hv'}))
    return data


def _size(usual: int, results: Sequence[MoveResult]) -> int:
    """Return the size of the markers of results."""
    return usual if len(results) <= _MANY_MARKERS else usual // 2


def phase(parts: Sequence[Part]) -> tuple[Figure, float]:
    """Return the phase plane with the equilibria, and the smallest fraction of a run shown."""
    # Long motions would fill the plane, so only their beginning is drawn.
    data, shown = [], 1.0
    for part in parts:
        found = part.evaluation
        for kind, curve in (('unshaped steps', found.plain), ('recorded', found.recorded)):
            x, y, share = _orbit(curve.stretch, curve.rate)
            shown = min(shown, share)
            data.append(_curve(part, kind, x, y))
        for symbol, size, places in (
                ('circle', 8, sorted({x.stretch for x in found.results})),
                ('circle-open', 9, [found.start])):
            data.append(_curve(
                part, 'equilibrium', places, [0.0] * len(places), mode='markers',
                marker={'symbol': symbol, 'size': size, 'color': BLACK}))
    what = parts[0].run.plant.coordinate
    name, symbol = what.name, what.symbol
    return Figure(
        'phase', f'{name.capitalize()} rate over {name}, with the equilibria', 480,
        _grouped(data), {
            'xaxis': axis(label(name, symbol), range=_room(data, 'x')),
            'yaxis': axis(label(f'{name} rate', f'd{symbol}/dt', '1/s'), range=_room(
                data, 'y'))}), shown


def _room(data: Sequence[dict[str, Any]], key: str) -> list[float | None]:
    """Return the range of an axis, with a margin around all visible curves."""
    values = [
        x for trace in data if trace.get('visible', True) is True
        for x in trace[key] if x is not None]
    margin = 0.04 * (max(values) - min(values) or 1.0)
    return numbers([min(values) - margin, max(values) + margin])


def _orbit(stretch: Array, rate: Array) -> tuple[Array, Array, float]:
    """Return a curve in the phase plane without coincident points, and the fraction kept."""
    finite = np.isfinite(stretch) & np.isfinite(rate)
    x, y = stretch[finite], rate[finite]
    if not len(x):
        return x, y, 1.0
    scale = [max(float(np.ptp(z)), 1e-12) / _PHASE_GRID for z in (x, y)]
    cells = np.stack([np.floor(x / scale[0]), np.floor(y / scale[1])])
    keep = np.append(True, np.any(np.diff(cells, axis=1) != 0.0, axis=0))
    keep[-1] = True
    places = np.flatnonzero(keep)
    share = 1.0
    if len(places) > _MOST_PHASE_POINTS:
        share = _MOST_PHASE_POINTS / len(places)
        places = places[:_MOST_PHASE_POINTS]
    return x[places], y[places], share


def arrival(parts: Sequence[Part], number: int) -> Figure:
    """Return the zoom on one arrival: the error in percent of the step."""
    data = []
    shown = span(parts, number)
    unit = unit_for(shown, 1.0)
    for part in parts:
        found = part.evaluation
        if number >= len(found.results):
            continue
        result = found.results[number]
        for kind, curve in (('unshaped steps', found.plain), ('plan', found.planned)):
            if not part.colour:
                time, distance = around(result, curve)
                data.append(_curve(
                    part, kind, *decimate(unit.of(time), distance, _PANEL_BUCKETS)))
        time, distance = around(result, found.recorded)
        samples, away = around(result, TimeCurve(found.time, part.run.stretch, part.run.rate))
        data += _recorded(
            part, unit.of(time), distance, (unit.of(samples), away), buckets=_PANEL_BUCKETS)
    arrivals = sorted({float(unit.of(x.arrival)) for x in results_of(parts, number)})
    height = reach(parts, number)
    return Figure(
        f'arrival{number}', f'Setpoint {title(parts, number)}', 300, _grouped(data), {
            # The labels of several runs do not fit into every panel.
            'showlegend': len(parts) == 1,
            'xaxis': axis(
                label('time in the move', unit=unit.name),
                range=numbers([0.0, unit.of(shown)])),
            'yaxis': axis(label('error', unit='% of the step'), range=[-height, height]),
            'shapes': [{
                'type': 'line', 'x0': x, 'x1': x, 'yref': 'paper', 'y0': 0, 'y1': 1,
                'line': {'color': GREY, 'width': 1, 'dash': '2px,2px'}} for x in arrivals]})


def residuals(parts: Sequence[Part]) -> Figure:
    """Return the residual vibration of all setpoints, as recorded and for unshaped steps."""
    data = []
    for part in parts:
        results = part.evaluation.results
        for what, values, symbol in (
                ('recorded', [x.residual for x in results], 'circle'),
                ('unshaped steps', [x.residual_unshaped for x in results], 'square-open')):
            data.append(_curve(
                part, what, np.arange(1, len(results) + 1),
                # Smaller values are rounding.
                [100.0 * max(x, RESOLVED) for x in values], mode='markers',
                marker={
                    'symbol': symbol, 'size': _size(10, results), 'line': {'width': 1.5},
                    'color': _KINDS[what]['color']}))
            # One click in the legend hides both.
            data[-1]['legendgroup'] = part.run.label if part.colour else what
    count = max((len(x.evaluation.results) for x in parts), default=0)
    numbered = axis('setpoint', range=[0.5, count + 0.5])
    if count <= MOST_PANELS:
        numbered |= {'tickmode': 'array', 'tickvals': list(range(1, count + 1)), 'ticktext': [
            f'{i + 1}: ' + '/'.join(dict.fromkeys(
                f'{x.stretch:.5g}' for x in results_of(parts, i))) for i in range(count)]}
    return Figure(
        'residuals', 'Residual vibration of each setpoint, recorded and for unshaped steps', 340,
        _grouped(data), {
            'xaxis': numbered,
            'yaxis': axis(
                label('residual vibration', unit='% of the step'), type='log',
                **_decades(data))})


def _decades(data: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return range and ticks of a logarithmic axis: whole decades, so at least one has a label."""
    values = [math.log10(x) for trace in data for x in trace['y'] if x is not None]
    if not values:
        return {}
    low, high = math.floor(min(values)), math.ceil(max(values))
    return {
        'range': [low - 0.2, max(high, low + 1) + 0.2], 'dtick': max(1, -(-(high - low) // 6))}


def prediction(parts: Sequence[Part], unit: TimeUnit) -> Figure:
    """Return recorded minus predicted stretch over time; no curves without a plan."""
    data = []
    for part in parts:
        found = part.evaluation
        difference = part.run.stretch - found.planned.at(found.time).stretch
        if np.isfinite(difference).any():
            data.append(_curve(
                part, 'recorded', *decimate(unit.of(found.time), difference),
                line={'width': 1.2}))
            if not part.colour:
                data[-1]['name'] = 'recorded − predicted'
    what = parts[0].run.plant.coordinate
    return Figure(
        'prediction', f'Recorded minus predicted {what.name} over time', 300, _grouped(data), {
            'xaxis': axis(label('time', 't', unit.name)),
            'yaxis': axis(label('recorded − planned', what.symbol))})


def timings(parts: Sequence[Part], unit: TimeUnit) -> Figure:
    """Return lead of the commands, delay of the samples, and their intervals."""
    data = []
    for part in parts:
        found, timing = part.evaluation, part.timing
        time = unit.of(found.time)
        known = np.isfinite(timing.lateness)
        stamps = unit.of([found.seconds(x.stamp) for x in timing.commands])
        markers: dict[str, Any] = {'mode': 'markers', 'yaxis': 'y3', 'cliponaxis': False}
        if len(timing.lead):
            data.append(_curve(
                part, 'command lead', stamps, timing.lead * 1e3, **markers,
                marker={'size': 7, 'color': BLUE, 'symbol': 'circle'}))
        if known.any():
            data.append(_curve(
                part, 'lateness of the command', stamps[known], timing.lateness[known] * 1e3,
                **markers,
                marker={'size': 8, 'color': VERMILION, 'symbol': 'x-thin-open'}))
        if len(timing.delay):
            data.append(_curve(
                part, 'sample delay', *decimate(time, timing.delay * 1e3), yaxis='y2',
                line={'color': VERMILION, 'width': 1.2}))
        data.append(_curve(
            part, 'interval as recorded', *decimate(time[1:], timing.arrival_interval * 1e3),
            line={'color': VERMILION, 'width': 0.8, 'dash': '2px,1px'}, opacity=0.8))
        data.append(_curve(
            part, 'interval of the timestamps', *decimate(time[1:], timing.interval * 1e3),
            line={'color': BLACK, 'width': 1.6}))
    return Figure(
        'timing', 'Lead of the commands, delay and interval of the samples', 640, _grouped(data), {
            'xaxis': axis(label('time', 't', unit.name), anchor='y'),
            'yaxis': axis('sample interval (ms)', domain=[0.0, 0.28], rangemode='tozero'),
            'yaxis2': axis('sample delay (ms)', domain=[0.36, 0.64], anchor='x'),
            'yaxis3': axis(
                'command lead (ms)' if not any(len(x.timing.lateness) for x in parts)
                else 'lead, lateness (ms)', domain=[0.72, 1.0], anchor='x', rangemode='tozero')})
