"""
The figures of a report, as plain data for Plotly.

Curves are thinned out to what a screen can show, peaks kept. Colours are those of
`hmsa_ros.report.style`; the page replaces them by lighter ones in dark mode.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import html
import math
from typing import Any

import numpy as np

from hmsa_ros.model.equations import Array
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.recordings.record import Run
from hmsa_ros.report.evaluation import Evaluation, MoveResult, verdicts
from hmsa_ros.report.timing import Timing

# Okabe and Ito's palette, told apart with every kind of colour vision.
BLUE, ORANGE, GREEN, PURPLE = '#0072B2', '#E69F00', '#009E73', '#CC79A7'
SKY_BLUE, VERMILION, BLACK, GREY = '#56B4E9', '#D55E00', '#000000', '#8A8A8A'
RUN_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY_BLUE, VERMILION, BLACK)
#: The same where the background is dark.
DARK = {
    BLUE: '#4DABE8', ORANGE: '#F2B93B', GREEN: '#2FC79A', PURPLE: '#E5A0C6',
    SKY_BLUE: '#9AD6F7', VERMILION: '#FF8A4A', BLACK: '#F0F0F0', GREY: '#9A9A9A'}

#: Intervals of a curve of which the least and the largest value are kept: more than a screen
#: has columns.
BUCKETS = 2000
MOST_PANELS = 12
_PANEL_BUCKETS = 300
_MOST_PHASE_POINTS = 8_000
_PHASE_GRID = 1000.0
# Markers are smaller where there are more of them.
_MANY_MARKERS = 100
# Of an arrival's panel: how long before and after, in durations of the move, and how many
# percent of the step at least.
_BEFORE, _AFTER, _LEAST_PERCENT = 0.6, 3.0, 5.0
# Of what a panel holds beyond what it shows at first.
_PANEL_SPAN = 20.0
#: Instead of a residual, which would be 0.
NOT_MOVED = 'did not move'
_LONGEST_IN_MS = 2.0
_DIGITS = 9


@dataclass(frozen=True)
class Part:
    """One run of a report; without a colour it is on its own and its curves differ in theirs."""

    run: Run
    evaluation: Evaluation
    timing: Timing
    colour: str = ''


@dataclass(frozen=True)
class TimeUnit:
    """Unit of the time axes: its size in s and its name."""

    size: float
    name: str

    def of(self, seconds: Any) -> Array:
        """Return times in this unit."""
        return np.asarray(seconds, dtype=np.float64) / self.size


@dataclass(frozen=True)
class Figure:
    """One figure: what it shows in words, its height in px, and what Plotly takes."""

    key: str
    alt: str
    height: int
    data: list[dict[str, Any]]
    layout: dict[str, Any]


def time_unit(parts: Sequence[Part]) -> TimeUnit:
    """Return the unit for the time axes: milliseconds for short runs."""
    longest = max(
        float(np.max(np.abs(x.evaluation.time[[0, -1]]))) for x in parts)
    return TimeUnit(1e-3, 'ms') if longest <= _LONGEST_IN_MS else TimeUnit(1.0, 's')


def decimate(x: Array, y: Array, buckets: int = BUCKETS) -> tuple[Array, Array]:
    """Thin out a curve, keeping its ends and the extremes of intervals of many points."""
    finite = np.isfinite(y)
    if not finite.all():
        x, y = x[finite], y[finite]
    keep = _extremes(y, buckets)
    return (x, y) if keep is None else (x[keep], y[keep])


def _extremes(y: Array, buckets: int) -> Any:
    """Return where the ends and the extremes of each interval are; None to keep all."""
    size = -(-len(y) // buckets)
    if size <= 2:
        return None
    whole = len(y) // size * size
    begins = np.arange(0, whole, size)
    rows = y[:whole].reshape(-1, size)
    keep: list[Any] = [
        begins + rows.argmin(axis=1), begins + rows.argmax(axis=1), [0, len(y) - 1]]
    if whole < len(y):
        rest = y[whole:]
        keep.append([whole + int(rest.argmin()), whole + int(rest.argmax())])
    return np.unique(np.concatenate(keep))


def numbers(values: Any) -> list[float | None]:
    """Return numbers for JSON, to nine digits; None for what is not finite."""
    return [float(f'{x:.{_DIGITS}g}') if math.isfinite(x) else None
            for x in np.asarray(values, dtype=np.float64).tolist()]


def text(words: str) -> str:
    """Return words as Plotly shows them, which takes some marks for HTML."""
    return html.escape(words, quote=False)


def _curve(
        part: Part, what: str, x: Any, y: Any, *, mode: str = 'lines', **style: Any
) -> dict[str, Any]:
    """
    Return a curve: what it shows of a run.

    Its style is the line's, but for the names of a trace's own settings. The group is what a
    click in the legend hides.
    """
    if 'lines' in mode and what in _KINDS:
        style = {**_KINDS[what], **style}
        if part.colour:
            style['color'] = part.colour
            if what in _SIMULATED:
                style['visible'] = 'legendonly'
    own: dict[str, Any] = {k: style.pop(k) for k in (
        'marker', 'visible', 'xaxis', 'yaxis', 'hovertemplate', 'opacity', 'cliponaxis')
        if k in style}
    trace = {
        'type': 'scatter', 'mode': mode, 'x': numbers(x), 'y': numbers(y),
        'name': text(f'{part.run.label}: {what}' if part.colour else what),
        'legendgroup': part.run.label if part.colour and what not in _SIMULATED else what, **own}
    if 'lines' in mode:
        # Plotly's own thinning bends lines at rest by a pixel or two.
        trace['line'] = {'simplify': False, **style}
    return trace


def _grouped(data: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return curves with each group once in the legend, by its own name."""
    seen: set[str] = set()
    for trace in data:
        group = trace['legendgroup']
        trace['showlegend'] = group not in seen
        if group not in seen and text(group) in trace['name'].split(': '):
            trace['name'] = text(group)
        seen.add(group)
    return data


# Of several runs what was recorded is compared; what is simulated is shown on a click.
_SIMULATED = ('plain steps', 'plan')
# What each kind of curve looks like, everywhere: colour, and what distinguishes it without.
_KINDS: dict[str, dict[str, Any]] = {
    'recorded': {'color': BLUE, 'width': 2.2},
    'plain steps': {'color': VERMILION, 'width': 1.2, 'dash': '5px,2px'},
    'plan': {'color': BLACK, 'width': 1.4, 'dash': '1px,3px'},
    'command': {'color': BLUE, 'width': 2.0, 'shape': 'hv'},
    'field in force': {'color': GREEN, 'width': 1.4, 'dash': '7px,2px,1px,2px'},
}


def _axis(title: str, **more: Any) -> dict[str, Any]:
    return {'title': {'text': title}, 'exponentformat': 'power', **more}


def response(parts: Sequence[Part], unit: TimeUnit) -> Figure:
    """Return the command, and below it setpoints and response, over time."""
    data = []
    for part in parts:
        run, found = part.run, part.evaluation
        data += [
            _curve(part, what, *decimate(unit.of(found.time), stretch)) for what, stretch in (
                ('plain steps', found.unshaped[0]), ('recorded', run.stretch),
                ('plan', found.predicted[0]))]
        if found.results:
            spans = [(x.begin, x.end, math.nan) for x in found.results]
            data.append(_curve(
                part, 'target', unit.of(np.ravel(spans)),
                np.ravel([(x.stretch, x.stretch, math.nan) for x in found.results]),
                color=GREY, width=1.2, dash='2px,2px'))
            data.append(_curve(
                part, 'planned arrival', unit.of([x.arrival for x in found.results]),
                [x.stretch for x in found.results], mode='markers',
                marker={
                    'symbol': 'diamond-open', 'size': _size(9, found.results),
                    'color': part.colour or BLACK}))
        data += _commands(part, unit)
    what = parts[0].run.plant.coordinate
    return Figure(
        'response', f'Flux density command and {what.name} over time', 560, _grouped(data), {
            'xaxis': _axis(f'time from the first command [{unit.name}]', anchor='y'),
            'yaxis': _axis(f'{what.name} {what.symbol} [1]', domain=[0.0, 0.6]),
            'yaxis2': _axis('flux density B [mT]', domain=[0.68, 1.0], anchor='x')})


def commanded(part: Part) -> tuple[list[float], list[float]]:
    """Return times in s and levels in mT of the command, from the first sample to the last."""
    run, found = part.run, part.evaluation
    times = [found.seconds(x.stamp) for x in found.levels]
    values = [x.flux_density * 1e3 for x in found.levels]
    # The last level holds to the end of the record.
    times.append(max(times[-1], float(found.time[-1])))
    values.append(values[-1])
    if found.time[0] < times[0] and math.isfinite(run.flux_density[0]):
        times.insert(0, float(found.time[0]))
        values.insert(0, float(run.flux_density[0]) * 1e3)
    return times, values


def _commands(part: Part, unit: TimeUnit) -> list[dict[str, Any]]:
    """Return the curves of the flux density."""
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
        place = np.searchsorted([x.stamp for x in found.levels], run.time, side='right') - 1
        expected = np.array([*(x.flux_density for x in found.levels)])[np.maximum(place, 0)]
        follows = np.abs(run.flux_density - expected)[place >= 0]
        if np.isfinite(follows).any() and (
                np.nanmax(follows) <= 1e-9 * np.max(np.abs(expected))):
            return data
    if np.isfinite(run.flux_density).any():
        data.append(_curve(
            part, 'field in force', *decimate(unit.of(found.time), run.flux_density * 1e3),
            yaxis='y2'))
    elif run.applied:
        told = sorted(run.applied, key=lambda x: x.stamp)
        x = unit.of([*(found.seconds(x.stamp) for x in told), max(
            found.seconds(told[-1].stamp), float(found.time[-1]))])
        y = np.array([x.flux_density for x in (*told, told[-1])]) * 1e3
        data.append(_curve(part, 'field in force', x, y, yaxis='y2', shape='hv'))
    return data


def _size(usual: int, results: Sequence[MoveResult]) -> int:
    """Return the size of markers, one for each result."""
    return usual if len(results) <= _MANY_MARKERS else usual // 2


def phase(parts: Sequence[Part]) -> tuple[Figure, float]:
    """Return the phase plane with the equilibria, and the smallest share of a run in it."""
    # What moves on and on fills the plane, so that a part of it is enough.
    data, shown = [], 1.0
    for part in parts:
        run, found = part.run, part.evaluation
        for kind, (stretch, rate) in (
                ('plain steps', found.unshaped), ('recorded', (run.stretch, run.rate))):
            x, y, share = _orbit(stretch, rate)
            shown = min(shown, share)
            data.append(_curve(part, kind, x, y))
        for symbol, size, places in (
                ('circle', 8, sorted({x.stretch for x in found.results})),
                ('circle-open', 9, [found.start])):
            data.append(_curve(
                part, 'equilibrium', places, [0.0] * len(places), mode='markers',
                marker={'symbol': symbol, 'size': size, 'color': part.colour or BLACK}))
    what = parts[0].run.plant.coordinate
    name, symbol = what.name, what.symbol
    return Figure(
        'phase', f'{name.capitalize()} rate over {name}, with the equilibria', 480,
        _grouped(data), {
            'xaxis': _axis(f'{name} {symbol} [1]', range=_room(data, 'x')),
            'yaxis': _axis(f'{name} rate d{symbol}/dt [1/s]', range=_room(data, 'y'))}), shown


def _room(data: Sequence[dict[str, Any]], key: str) -> list[float | None]:
    """Return the range of an axis that leaves room around all curves."""
    values = [
        x for trace in data if trace.get('visible', True) is True
        for x in trace[key] if x is not None]
    margin = 0.04 * (max(values) - min(values) or 1.0)
    return numbers([min(values) - margin, max(values) + margin])


def _orbit(stretch: Array, rate: Array) -> tuple[Array, Array, float]:
    """Return a curve in the plane without the points that lie on the one before."""
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


def panels(parts: Sequence[Part]) -> list[tuple[int, str]]:
    """Return number, from 0 on, and title of each arrival to show; those of a number share one."""
    return [(i, _panel_title(parts, i)) for i in worst(parts, MOST_PANELS)]


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


def _panel_title(parts: Sequence[Part], number: int) -> str:
    results = results_of(parts, number)
    targets = ', '.join(dict.fromkeys(f'{x.stretch:.6g}' for x in results))
    said = verdicts([x.evaluation for x in parts], number)
    left = residual_text(results, least=True)
    return f'{results[0].place + 1}. to {targets}: {said}residual {left}'


def residual_text(results: Sequence[MoveResult], digits: int = 3, *, least: bool = False) -> str:
    """Return the largest residual of some moves in words, and the least before it if asked."""
    if not all(x.moved for x in results):
        return NOT_MOVED
    shares = [x.residual for x in results if math.isfinite(x.residual)] or [math.nan]
    return ' to '.join(dict.fromkeys(
        percent(x, digits) for x in ([min(shares)] if least else []) + [max(shares)]))


def percent(share: float, digits: int = 3) -> str:
    """Return a share in percent to some significant digits; a dash for what is not known."""
    return f'{100.0 * share:.{digits}g} %' if math.isfinite(share) else '–'


def reach(parts: Sequence[Part], number: int) -> float:
    """Return how far an arrival's panel reaches from 0, in percent of the step."""
    return min(150.0, max([_LEAST_PERCENT, *(
        110.0 * x.error for x in results_of(parts, number) if math.isfinite(x.error))]))


def around(
        part: Part, number: int, stretch: Array) -> tuple[Array, Array, tuple[float, float]]:
    """Return a curve about an arrival, s after it and percent of the step; and what to show."""
    found, x = part.evaluation, part.evaluation.results[number]
    step = x.stretch - (found.results[number - 1].stretch if number else found.start)
    duration = max(x.arrival - x.begin, 1e-9)
    inside = (found.time >= x.begin) & (
        found.time <= min(x.end, x.arrival + _PANEL_SPAN * duration))
    return found.time[inside] - x.arrival, 100.0 * (stretch[inside] - x.stretch) / abs(step), (
        -_BEFORE * duration, min(x.end - x.arrival, _AFTER * duration))


def arrival(parts: Sequence[Part], number: int) -> Figure:
    """Return the zoom on one arrival: distance from the target in percent of the step."""
    data = []
    view = [0.0, 0.0]
    results = [x for x in results_of(parts, number) if x.end > x.begin]
    unit = TimeUnit(1e-3, 'ms') if max(
        (x.arrival - x.begin for x in results), default=1.0) < 1.0 else TimeUnit(1.0, 's')
    for part in parts:
        run, found = part.run, part.evaluation
        if number >= len(found.results):
            continue
        for kind, stretch in (
                ('plain steps', found.unshaped[0]), ('recorded', run.stretch),
                ('plan', found.predicted[0])):
            if part.colour and kind in _SIMULATED:
                continue
            time, distance, (begin, end) = around(part, number, stretch)
            view = [min(view[0], float(unit.of(begin))), max(view[1], float(unit.of(end)))]
            data.append(_curve(
                part, kind, *decimate(unit.of(time), distance, _PANEL_BUCKETS)))
    height = reach(parts, number)
    return Figure(
        f'arrival{number}', f'Setpoint {_panel_title(parts, number)}', 300, _grouped(data), {
            # There is no room in every panel for the names of several runs.
            'showlegend': len(parts) == 1,
            'xaxis': _axis(f'time after arrival [{unit.name}]', range=numbers(view)),
            'yaxis': _axis('distance [% of step]', range=[-height, height]),
            'shapes': [{
                'type': 'line', 'x0': 0, 'x1': 0, 'yref': 'paper', 'y0': 0, 'y1': 1,
                'line': {'color': GREY, 'width': 1, 'dash': '2px,2px'}}]})


def residuals(parts: Sequence[Part]) -> Figure:
    """Return the residuals of all setpoints, shaped against plain steps."""
    data = []
    for part in parts:
        results = part.evaluation.results
        for what, values, symbol in (
                ('recorded', [x.residual for x in results], 'circle'),
                ('plain steps', [x.residual_unshaped for x in results], 'square-open')):
            data.append(_curve(
                part, what, np.arange(1, len(results) + 1),
                # A logarithmic axis has no place for 0.
                [100.0 * x if x > 0.0 else math.nan for x in values], mode='markers',
                marker={
                    'symbol': symbol, 'size': _size(10, results), 'line': {'width': 1.5},
                    'color': part.colour or _KINDS[what]['color']}))
            # Here both are results: one click for both.
            data[-1]['legendgroup'] = part.run.label if part.colour else what
    count = max((len(x.evaluation.results) for x in parts), default=0)
    axis = _axis('setpoint', range=[0.5, count + 0.5])
    if count <= MOST_PANELS:
        axis |= {'tickmode': 'array', 'tickvals': list(range(1, count + 1)), 'ticktext': [
            f'{i + 1}: ' + '/'.join(dict.fromkeys(
                f'{x.stretch:.5g}' for x in results_of(parts, i))) for i in range(count)]}
    return Figure(
        'residuals', 'Residual vibration of each setpoint, recorded and for plain steps', 340,
        _grouped(data), {
            'xaxis': axis,
            'yaxis': _axis('residual [% of step]', type='log', **_decades(data))})


def _decades(data: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return range and ticks of a logarithmic axis: whole decades, so that one is named."""
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
        difference = part.run.stretch - found.predicted[0]
        if np.isfinite(difference).any():
            data.append(_curve(
                part, 'recorded', *decimate(unit.of(found.time), difference), width=1.2))
            if not part.colour:
                data[-1]['name'] = 'recorded − predicted'
    what = parts[0].run.plant.coordinate
    return Figure(
        'prediction', f'Recorded minus predicted {what.name} over time', 300, _grouped(data), {
            'xaxis': _axis(f'time from the first command [{unit.name}]'),
            'yaxis': _axis(f'recorded − planned {what.symbol} [1]')})


def timings(parts: Sequence[Part], unit: TimeUnit) -> Figure:
    """Return lead of the commands, delay of the samples, and their intervals."""
    data = []
    for part in parts:
        found, timing = part.evaluation, part.timing
        time = unit.of(found.time)
        told = np.isfinite(timing.lateness)
        stamps = unit.of([found.seconds(x.stamp) for x in timing.commands])
        markers: dict[str, Any] = {'mode': 'markers', 'yaxis': 'y3', 'cliponaxis': False}
        if len(timing.lead):
            data.append(_curve(
                part, 'command lead', stamps, timing.lead * 1e3, **markers,
                marker={'size': 7, 'color': part.colour or BLUE, 'symbol': 'circle'}))
        if told.any():
            data.append(_curve(
                part, 'lateness of the command', stamps[told], timing.lateness[told] * 1e3,
                **markers,
                marker={'size': 8, 'color': part.colour or VERMILION, 'symbol': 'x-thin-open'}))
        colour = part.colour or VERMILION
        if len(timing.delay):
            data.append(_curve(
                part, 'sample delay', *decimate(time, timing.delay * 1e3), yaxis='y2',
                color=colour, width=1.2))
        data.append(_curve(
            part, 'interval as recorded', *decimate(time[1:], timing.arrival_interval * 1e3),
            color=colour, width=0.8, dash='2px,1px', opacity=0.8))
        data.append(_curve(
            part, 'interval of the stamps', *decimate(time[1:], timing.interval * 1e3),
            color=part.colour or BLACK, width=1.6))
    return Figure(
        'timing', 'Lead of the commands, delay and interval of the samples', 640, _grouped(data), {
            'xaxis': _axis(f'time from the first command [{unit.name}]', anchor='y'),
            'yaxis': _axis('sample interval [ms]', domain=[0.0, 0.28], rangemode='tozero'),
            'yaxis2': _axis('sample delay [ms]', domain=[0.36, 0.64], anchor='x'),
            'yaxis3': _axis(
                'command lead [ms]' if not any(len(x.timing.lateness) for x in parts)
                else 'lead, lateness [ms]', domain=[0.72, 1.0], anchor='x', rangemode='tozero')})
