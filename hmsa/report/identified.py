"""The HTML page of an identification: data, fit, residuals, intervals and correlations."""

import math
from typing import Any

import numpy as np

from hmsa.identification.measurement import UncheckedMeasurement
from hmsa.identification.response import respond
from hmsa.identification.result import Identification
from hmsa.model.equations import Array
from hmsa.report import looks
from hmsa.report.charts import TimeUnit, unit_for
from hmsa.report.figures import Axis, BUCKETS, Curve, decimate, Figure, Panel
from hmsa.report.looks import BLACK, BLUE, LineStyle, VERMILION
from hmsa.report.page import document, FOLDER
from hmsa.table import Column, Table

_LAGS = 60
# Spacing of the fitted curve in time scales, and its maximum number of points.
_FINE, _MOST_FINE = 0.05, 20_000
_HEADINGS = {
    'identified': 'identified', 'not_identifiable': 'not identifiable',
    'model_rejected': 'model rejected'}


def page(found: Identification) -> str:
    """Return the HTML page of an identification."""
    name = found.recording.label
    return document(
        FOLDER / 'identified.html', f'{name} – identification',
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


def _samples(
        found: Identification, name: str, y: Array, inside: Any = slice(None), *,
        form: str = 'points') -> Curve:
    """Return a quantity at the samples, over time."""
    time = _unit(found).of(found.recording.time)
    look = LineStyle(BLUE, 0.8, marker='o', size=2.2 if len(time) > 200 else 4.5)
    return Curve(name, look, *decimate(time[inside], y[inside]), form)


def _unit(found: Identification) -> TimeUnit:
    time = found.recording.time
    return unit_for(float(time[-1] - time[0]))


def _time_axis(found: Identification) -> Axis:
    unit = _unit(found)
    begin, end = unit.of(found.recording.time[[0, -1]]).tolist()
    return Axis('time', 't', unit.name, limits=(begin, end))


def _motion(found: Identification) -> Figure:
    """Return level, measured and fitted motion over time."""
    recording, unit = found.recording, _unit(found)
    end = max(float(recording.time[-1]), float(recording.level_times[-1]))
    time, fitted = _fitted(found)
    what = recording.coordinate
    across = _time_axis(found)
    return Figure('motion', f'Level, measured and fitted {what.name} over time', [
        Panel(across, Axis('flux density', 'B', 'mT'), [Curve(
            'level', LineStyle(BLACK, 1.2), unit.of(np.append(recording.level_times, end)),
            np.append(recording.levels, recording.levels[-1]) * 1e3, 'steps', listed=False)]),
        Panel(across, Axis(what.name, what.symbol, tex=what.tex), [
            _samples(found, 'measured', recording.stretch,
                     form='points' if len(recording.time) <= BUCKETS else 'line'),
            Curve('fitted', LineStyle(VERMILION, 1.2, order=3), *decimate(
                unit.of(time), fitted))], height=2.4)], 520)


def _fitted(found: Identification) -> tuple[Array, Array]:
    """Return times in s and stretch of the fit, interpolated between sparse samples."""
    recording = found.recording
    begin, end = recording.time[[0, -1]]
    step = _FINE * found.values['time_unit']
    dense = recording.time if end - begin >= _MOST_FINE * step else np.union1d(
        recording.time, np.arange(begin, end, step, dtype=np.float64))
    course = UncheckedMeasurement(
        dense, recording.level_times, recording.levels, recording.slew_limit,
                    at_rest=recording.at_rest)
    response = None if recording.earlier else respond(course, found.values, ())
    if response is None:
        return recording.time, found.fit.response.stretch
    return dense, response.stretch


def _residuals(found: Identification) -> Figure:
    """Return the residuals over time, with outliers marked."""
    out, residual = found.fit.weights == 0.0, found.fit.residual
    curves = [_samples(found, 'residual', residual, ~out)]
    if np.any(out):
        curves.append(Curve(
            'outlier', LineStyle(VERMILION, marker='x', order=3),
            _unit(found).of(found.recording.time[out]), residual[out], 'points'))
    return Figure('residuals', 'Residuals over time', [Panel(
        _time_axis(found), Axis('measured less fitted'), curves)], legend=len(curves) > 1)


def _correlation(found: Identification) -> Figure:
    """Return the autocorrelation of the residuals."""
    rho = found.whiteness.autocorrelation[1:_LAGS + 1]
    limit = 1.96 / math.sqrt(found.samples)
    return Figure('correlation', 'Autocorrelation of the residuals over the lag', [Panel(
        Axis('lag', unit='samples'), Axis('autocorrelation'), [
            Curve('autocorrelation', LineStyle(BLUE), np.arange(
                1.0, len(rho) + 1.0, dtype=np.float64), rho, 'bars'),
            Curve('white noise, 95 %', looks.TARGET, y=np.array([-limit, limit]),
                  form='horizontal')])], 260)


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
