"""Draw runs: command, response, phase plane, and the arrivals with the largest residuals."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
import numpy as np

from hmsa.report import looks, style
from hmsa.report.arrivals import (
    around,
    left_text,
    Part,
    reach,
    results_of,
    span,
    worst,
)
from hmsa.report.charts import commanded, time_unit, TimeUnit
from hmsa.report.curves import decimate, TimeCurve
from hmsa.report.paper import Paper

# Maximum number of samples in a panel that are also drawn as points.
_MOST_SAMPLES = 200
# Maximum number of periods in a panel for dashed lines; above it, lines are solid and thin.
_DASHED, _THIN = 25.0, 0.6
# Time shown after the last arrival, in durations of the move, if only rest follows: deviations
# within this fraction of the step.
_REST, _STILL = 8.0, 0.02


def draw(
        paths: Path | Sequence[Path], parts: Sequence[Part],
        paper: Paper | None = None) -> style.Picture:
    """Draw runs with as many arrivals as fit side by side; return the figure."""
    paper = paper or Paper()
    unit = time_unit(parts)
    columns = paper.columns(3)
    shown = worst(parts, columns)
    if columns > 1:
        rows = [['command'] * 3 + ['phase'] * 3, ['response'] * 3 + ['phase'] * 3]
    else:
        rows = [[x] * 6 for x in ('command', 'response', 'phase')]
    heights = [1.0, 1.45, 1.6][:len(rows)]
    if shown:
        # Fewer arrivals get wider panels.
        rows.append([f'arrival{i}' for i in shown for _ in range(6 // len(shown))])
        heights.append(1.3)
    letters = paper.letters / 8.0
    times = _shown_times(parts)
    with style.picture(paths, (0.5 + 1.35 * sum(heights)) * letters, paper) as figure:
        axes: dict[str, Axes] = figure.subplot_mosaic(
            rows, height_ratios=heights)  # type: ignore[arg-type]
        for number, part in enumerate(parts):
            look = looks.RECORDED if len(parts) == 1 else looks.case(number)
            _draw_run(axes, part, unit, look, times, alone=len(parts) == 1)
            for i in shown:
                if i < len(part.evaluation.results):
                    _draw_arrival(axes[f'arrival{i}'], part, i, look, alone=len(parts) == 1)
        for key in ('command', 'response'):
            axes[key].set_xlim(*unit.of(times))
        time = style.axis('time', 't', unit.name)
        what = parts[0].run.plant.coordinate
        level = style.axis('flux density', 'B', 'mT')
        style.finish(axes['command'], time, level, 'a')
        axes['command'].tick_params(labelbottom=False)
        axes['command'].xaxis.label.set_visible(False)
        if not any(x.evaluation.levels for x in parts):
            # Ticks from 0 to 1 would look like a field.
            axes['command'].set_yticks([])
        position = style.axis(what.name, what.tex)
        style.finish(axes['response'], time, position, 'b')
        style.finish(axes['phase'], position, style.axis(
            f'{what.name} rate', rf'\dot{{{what.tex}}}', '1/s'), 'c')
        for letter, i in zip('def', shown, strict=False):
            panel = axes[f'arrival{i}']
            height = reach(parts, i)
            panel.set_ylim(-height, height)
            panel.set_xlim(0.0, 1e3 * span(parts, i))
            style.finish(
                panel, style.axis('time in the move', unit='ms'),
                style.axis('error', unit='% of step') if i == shown[0] else '', letter)
            panel.set_title(_title(parts, i), loc='right', fontsize='small')
        figure.align_ylabels([axes['command'], axes['response']])
        # The response comes last because dense curves lose their dashes.
        style.legend_below(
            figure, *(x for key, x in axes.items() if key not in ('command', 'response')),
            axes['response'])
    return figure


def _shown_times(parts: Sequence[Part]) -> tuple[float, float]:
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


def _draw_recorded(
        panel: Axes, part: Part, curve: tuple[Any, Any], samples: tuple[Any, Any],
        look: looks.LineStyle, *, alone: bool, **more: Any) -> None:
    """Draw the curve through the samples, and the samples as points if they are few."""
    label = part.run.origin if alone else part.run.label
    panel.plot(*curve, **{**look.line(), **more}, label=label)
    exact = part.run.origin == 'simulated' and not part.run.number('plant.stretch_noise')
    if not exact and len(samples[0]) < len(curve[0]) and len(samples[0]) <= _MOST_SAMPLES:
        panel.plot(
            *samples, linestyle='none', marker='o', markersize=2.2, color=look.colour, zorder=4,
            label='samples' if alone else f'{label}, samples')


def _draw_run(
        axes: dict[str, Axes], part: Part, unit: TimeUnit, look: looks.LineStyle,
        times: tuple[float, float], *, alone: bool) -> None:
    run, found = part.run, part.evaluation
    if found.levels:
        switches, values = commanded(part)
        axes['command'].step(
            unit.of(switches), values, where='post', **look.line(),
            label='command' if alone else run.label)
    for result in found.results:
        axes['response'].plot(
            unit.of([result.begin, result.end]), [result.stretch] * 2, **style.TARGET,
            label='target')
    plain, curve, samples = (
        x.between(*times) for x in (
            found.plain, found.recorded, TimeCurve(found.time, run.stretch, run.rate)))
    dense: dict[str, Any] = {} if times[1] - times[0] <= _DASHED * run.plant.period else {
        'linestyle': '-', 'linewidth': _THIN}
    if alone and np.isfinite(plain.stretch).any():
        # Of several runs only the recorded curves are compared.
        for panel, x, y, more in (
                ('response', *decimate(unit.of(plain.time), plain.stretch), dense),
                ('phase', plain.stretch, plain.rate, {})):
            axes[panel].plot(
                x, y, **{**style.UNSHAPED, **more}, label='unshaped steps (simulated)')
    _draw_recorded(
        axes['response'], part, decimate(unit.of(curve.time), curve.stretch),
        (unit.of(samples.time), samples.stretch), look, alone=alone,
        **(dense if look.dash else {}))
    _draw_recorded(
        axes['phase'], part, (curve.stretch, curve.rate), (samples.stretch, samples.rate), look,
        alone=alone)
    places = sorted({x.stretch for x in found.results})
    if places:
        axes['phase'].plot(
            places, [0.0] * len(places), label='equilibrium', **style.EQUILIBRIUM)


def _draw_arrival(
        panel: Axes, part: Part, number: int, look: looks.LineStyle, *, alone: bool) -> None:
    """Draw the zoom on one arrival, in ms and percent of the step."""
    found, result = part.evaluation, part.evaluation.results[number]
    end = span([part], number)

    def shown(curve: TimeCurve) -> tuple[Any, Any]:
        time, distance = around(result, curve)
        return 1e3 * time[time <= end], distance[time <= end]

    if alone:
        panel.plot(
            *decimate(*shown(found.plain)), **style.UNSHAPED, label='unshaped steps (simulated)')
    _draw_recorded(
        panel, part, decimate(*shown(found.recorded)),
        shown(TimeCurve(found.time, part.run.stretch, part.run.rate)), look, alone=alone)
    # For an unshaped step, the arrival of a two-step command.
    panel.axvline(1e3 * result.arrival, **style.ARRIVAL, label='end of the move')


def _title(parts: Sequence[Part], number: int) -> str:
    results = results_of(parts, number)
    targets = '/'.join(dict.fromkeys(f'{x.stretch:.5g}' for x in results))
    return f'to {targets}' if len(parts) > 1 else f'to {targets}: {left_text(results)}'
