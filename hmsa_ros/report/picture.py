"""A report as a picture for a paper: PNG, or PDF with lines instead of pixels."""

from collections.abc import Sequence
import math
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
import numpy as np

from hmsa_ros.figures import style
from hmsa_ros.report.charts import decimate, Part, residual_text, time_unit, TimeUnit

_COLOURS = (
    style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, style.SKY_BLUE, style.VERMILION,
    style.BLACK)
# Panels of arrivals in a row.
_PANELS = 3
# Of an arrival's panel: how long before and after, in durations of the move, and percent of
# the step at least.
_BEFORE, _AFTER, _LEAST_PERCENT = 0.6, 3.0, 5.0


def draw(path: Path, parts: Sequence[Part], kind: str) -> None:
    """
    Draw command, response, phase plane and the arrivals with the largest residual.

    Parameters
    ----------
    path : Path
        File to write; an existing file is replaced.
    parts : sequence of Part
        Runs, evaluated; at least one.
    kind : {'png', 'pdf'}
        Format.

    Raises
    ------
    BadInputError
        If the file cannot be written.

    """
    unit = time_unit(parts)
    count = max(len(x.evaluation.results) for x in parts)
    ranked = sorted(range(count), key=lambda i: -max(
        (x.evaluation.results[i].residual for x in parts
         if i < len(x.evaluation.results)
         and math.isfinite(x.evaluation.results[i].residual)), default=0.0))
    shown = sorted(ranked[:_PANELS])
    rows = [['command'] * 3 + ['phase'] * 3, ['response'] * 3 + ['phase'] * 3]
    if shown:
        # Panels of two columns each; where there are fewer, they are wider.
        width = 6 // len(shown)
        rows.append([f'arrival{i}' for i in shown for _ in range(width)])
    with style.picture(path, 5.9 if shown else 3.9, kind=kind) as figure:
        axes: dict[str, Axes] = figure.subplot_mosaic(
            rows,  # type: ignore[arg-type]
            height_ratios=[1.0, 1.45, 1.3][:len(rows)])
        for number, part in enumerate(parts):
            colour = _COLOURS[number % len(_COLOURS)] if len(parts) > 1 else ''
            _draw_run(axes, part, unit, colour)
            for i in shown:
                if i < len(part.evaluation.results):
                    _draw_arrival(
                        axes[f'arrival{i}'], part, i, _height(parts, i), colour)
        begin = float(unit.of(min(x.evaluation.time[0] for x in parts)))
        end = float(unit.of(max(x.evaluation.time[-1] for x in parts)))
        for key in ('command', 'response'):
            axes[key].set_xlim(begin, end if end > begin else begin + 1.0)
        axes['command'].tick_params(labelbottom=False)
        style.finish(axes['command'], '', 'flux density $B$ [mT]', 'a')
        style.finish(axes['response'], f'time $t$ [{unit.name}]', r'stretch $\lambda$ [1]', 'b')
        style.finish(
            axes['phase'], r'stretch $\lambda$ [1]', r'stretch rate $\dot{\lambda}$ [1/s]', 'c')
        for letter, i in zip('def', shown, strict=False):
            panel = axes[f'arrival{i}']
            style.finish(panel, 'time after arrival [ms]', 'distance [% of step]', letter)
            panel.set_title(_title(parts, i), loc='right', fontsize=8)
        figure.align_ylabels([axes['command'], axes['response']])
        handles = {
            label: handle for panel in ('response', 'phase') for handle, label in zip(
                *axes[panel].get_legend_handles_labels(), strict=True)}
        figure.legend(
            handles=list(handles.values()), loc='outside lower center',
            ncols=min(len(handles), 4), columnspacing=1.8)


def _styled(kind: dict[str, Any], colour: str) -> dict[str, Any]:
    """Return how a curve looks, in the run's own colour if there are several."""
    return {**kind, 'color': colour} if colour else kind


def _draw_run(axes: dict[str, Axes], part: Part, unit: TimeUnit, colour: str) -> None:
    run, found = part.run, part.evaluation
    time = unit.of(found.time)
    if found.levels:
        times = unit.of([found.seconds(x.stamp) for x in found.levels])
        values = [x.flux_density * 1e3 for x in found.levels]
        times = np.append(times, max(float(times[-1]), float(time[-1])))
        values.append(values[-1])
        if time[0] < times[0] and math.isfinite(run.flux_density[0]):
            times = np.append(time[0], times)
            values.insert(0, float(run.flux_density[0]) * 1e3)
        axes['command'].step(times, values, where='post', **_styled(style.SHAPED, colour))
    for i, x in enumerate(found.results):
        axes['response'].plot(
            unit.of([x.begin, x.end]), [x.stretch, x.stretch], **style.TARGET,
            label='target' if i == 0 else None)
    if not colour:
        # Several runs are compared by what was recorded.
        axes['response'].plot(
            *decimate(time, found.unshaped[0]), **style.UNSHAPED, label='plain steps')
        axes['phase'].plot(*found.unshaped, **style.UNSHAPED)
    axes['response'].plot(
        *decimate(time, run.stretch), **_styled(style.SHAPED, colour),
        label=run.label if colour else 'recorded')
    axes['phase'].plot(run.stretch, run.rate, **_styled(style.SHAPED, colour))
    places = sorted({x.stretch for x in found.results})
    if places:
        axes['phase'].plot(
            places, [0.0] * len(places), label='equilibrium', **style.EQUILIBRIUM)


def _draw_arrival(
        panel: Axes, part: Part, number: int, height: float, colour: str) -> None:
    """Draw the zoom on one arrival, in ms and percent of the step."""
    found = part.evaluation
    x = found.results[number]
    step = abs(x.stretch - (found.results[number - 1].stretch if number else found.start))
    duration = x.arrival - x.begin
    view = (-_BEFORE * duration, min(x.end - x.arrival, _AFTER * duration))
    inside = (found.time >= x.arrival + view[0]) & (found.time <= x.arrival + view[1])
    time = (found.time[inside] - x.arrival) * 1e3
    curves = [(part.run.stretch, style.SHAPED)]
    if not colour:
        curves.append((found.unshaped[0], style.UNSHAPED))
    for stretch, kind in curves:
        panel.plot(
            *decimate(time, 100.0 * (stretch[inside] - x.stretch) / step),
            **_styled(kind, colour))
    panel.axvline(0.0, **style.TARGET)
    panel.set_ylim(-height, height)


def _height(parts: Sequence[Part], number: int) -> float:
    """Return how far an arrival's panel reaches from 0, in percent."""
    errors = [
        x.evaluation.results[number].error for x in parts if number < len(x.evaluation.results)]
    return min(150.0, max(
        [_LEAST_PERCENT, *(110.0 * x for x in errors if math.isfinite(x))]))


def _title(parts: Sequence[Part], number: int) -> str:
    results = [
        x.evaluation.results[number] for x in parts if number < len(x.evaluation.results)]
    targets = '/'.join(dict.fromkeys(f'{x.stretch:.5g}' for x in results))
    if len(parts) > 1:
        return f'to {targets}'
    return f'to {targets}: residual {residual_text(results, 2)}'
