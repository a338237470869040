"""An identification as one HTML page: data, fit, residuals, intervals, what is confounded."""

import math
from typing import Any

import numpy as np

from hmsa_ros.identification.recording import Course
from hmsa_ros.identification.response import respond
from hmsa_ros.identification.result import Identification
from hmsa_ros.model.equations import Array
from hmsa_ros.report.charts import axis as _axis
from hmsa_ros.report.charts import Figure, label
from hmsa_ros.report.curves import BUCKETS, decimate, numbers
from hmsa_ros.report.looks import BLACK, BLUE, GREY, VERMILION
from hmsa_ros.report.page import document
from hmsa_ros.table import Column, Table

_LAGS = 60
# Points of the fitted curve, in time units, and how many at most.
_FINE, _MOST_FINE = 0.05, 20_000
_HEADINGS = {
    'identified': 'identified', 'not_identifiable': 'not identifiable',
    'model_rejected': 'model rejected'}


def page(found: Identification) -> str:
    """Return the HTML page of an identification."""
    name = found.recording.label
    return document(
        'identified.html', f'{name} – identification',
        [_motion(found), _residuals(found), _correlation(found)], name=name,
        summary=(
            (_HEADINGS[found.verdict], 'verdict'), (f'{found.noise_std:.3g}', 'noise of a sample'),
            (found.samples, 'samples'), (f'{found.residual_rms:.3g}', 'residual, rms'),
            (f'{float(found.whiteness.autocorrelation[1]):.2f}',
             'autocorrelation at one sample')),
        remarks=(found.reason, *found.warnings), coordinate=found.recording.coordinate.name,
        parameters=_parameters(found), marks=_marks(found), pairs=_pairs(found),
        confounded='; '.join(
            f'{one} and {other} ({x:.3f})' for one, other, x in found.confounded()))


def _unit(found: Identification) -> tuple[float, str]:
    span = float(found.recording.time[-1] - found.recording.time[0])
    return (1e-3, 'ms') if span < 2.0 else (1.0, 's')


def _curve(name: str, x: Array, y: Array, **style: Any) -> dict[str, Any]:
    return {'type': 'scatter', 'mode': 'lines', 'name': name, 'x': numbers(x), 'y': numbers(y),
            **style}


def _motion(found: Identification) -> Figure:
    """Return level, measured and fitted motion over time."""
    size, unit = _unit(found)
    recording = found.recording
    time = recording.time / size
    end = max(float(recording.time[-1]), float(recording.level_times[-1]))
    levels = np.append(recording.levels, recording.levels[-1]) * 1e3
    level_times = np.append(recording.level_times, end) / size
    few = len(time) <= BUCKETS
    data = [
        _curve('measured', *decimate(time, recording.stretch), mode='markers' if few else 'lines',
               marker={'size': 3 if len(time) > 200 else 6, 'color': BLUE},
               line={'color': BLUE, 'width': 1.0}),
        _curve('fitted', *_fitted(found, size),
               line={'color': VERMILION, 'width': 1.6}),
        _curve('level', level_times, levels, yaxis='y2',
               line={'color': BLACK, 'width': 1.6, 'shape': 'hv'})]
    what = recording.coordinate
    return Figure('motion', f'Level, measured and fitted {what.name} over time', 520, data, {
        'xaxis': _axis(label('time', 't', unit), anchor='y', range=numbers([time[0], time[-1]])),
        'yaxis': _axis(label(what.name, what.symbol), domain=[0.0, 0.66]),
        'yaxis2': _axis(label('flux density', 'B', 'mT'), domain=[0.74, 1.0], anchor='x')})


def _fitted(found: Identification, size: float) -> tuple[Array, Array]:
    """Return times and stretch of the fit, between few samples too."""
    recording = found.recording
    unit = found.values['time_unit']
    dense = np.union1d(recording.time, np.arange(
        recording.time[0], recording.time[-1], _FINE * unit, dtype=np.float64)) if (
            recording.time[-1] - recording.time[0] < _MOST_FINE * _FINE * unit) else recording.time
    course = Course(dense, recording.level_times, recording.levels, recording.slew_limit,
                    at_rest=recording.at_rest)
    response = None if recording.earlier else respond(course, found.values, ())
    if response is None:
        return decimate(recording.time / size, found.fitted)
    return decimate(dense / size, response.stretch)


def _residuals(found: Identification) -> Figure:
    """Return the residuals over time, outliers apart."""
    size, unit = _unit(found)
    time = found.recording.time / size
    out = found.weights == 0.0
    data = [_curve(
        'residual', *decimate(time[~out], found.residual[~out]), mode='markers',
        marker={'size': 3 if len(time) > 200 else 6, 'color': BLUE})]
    if np.any(out):
        data.append(_curve(
            'outlier', time[out], found.residual[out], mode='markers',
            marker={'size': 6, 'symbol': 'x', 'color': VERMILION}))
    return Figure('residuals', 'Residuals over time', 300, data, {
        'xaxis': _axis(label('time', 't', unit), range=numbers([time[0], time[-1]])),
        'yaxis': _axis('measured less fitted')})


def _correlation(found: Identification) -> Figure:
    """Return the autocorrelation of the residuals."""
    rho = found.whiteness.autocorrelation[1:_LAGS + 1]
    lags = np.arange(1, len(rho) + 1)
    limit = 1.96 / math.sqrt(found.samples)
    data = [{
        'type': 'bar', 'name': 'autocorrelation', 'x': numbers(lags), 'y': numbers(rho),
        'marker': {'color': BLUE}}]
    ends = np.array([0.5, len(rho) + 0.5])
    data += [_curve(
        'white noise, 95 %', ends, np.full(2, x), showlegend=x > 0.0,
        line={'color': GREY, 'width': 1.2, 'dash': '5px,3px'}) for x in (limit, -limit)]
    return Figure('correlation', 'Autocorrelation of the residuals over the lag', 260, data, {
        'xaxis': _axis('lag (samples)'), 'yaxis': _axis('autocorrelation')})


def _parameters(found: Identification) -> Table:
    rows: list[tuple[Any, ...]] = []
    for key in found.parameters:
        name, x = found.shown(key)
        share: float | str = 'fixed'
        if x.free:
            share = 'not identifiable' if math.isnan(x.value) else (
                100.0 * x.std / abs(x.value) if abs(x.value) > x.std else '')
        rows.append((
            name, x.unit or '1', x.value, *((x.std, x.low, x.high) if x.free else ('',) * 3),
            share))
    return Table((
        *map(Column, ('parameter', 'unit', 'value', 'deviation', 'low', 'high')),
        Column('deviation [%]', form='.3g')), tuple(rows))


def _marks(found: Identification) -> Table:
    return Table(
        (Column('searched for'), Column('share [%]', form='.3g'), Column('deviations', form='.3g'),
         Column('found')),
        tuple((x.name, 100.0 * x.share, x.deviations, 'yes' if x.found else 'no')
              for x in found.signatures))


def _pairs(found: Identification) -> Table | None:
    if len(found.names) < 2:
        return None
    names = [found.shown(x)[0] for x in found.names]
    return Table(
        (Column(''), *(Column(x, form='.3f') for x in names)), tuple(
            (name, *row) for name, row in zip(names, found.correlation.tolist(), strict=True)))
