"""Runs as pictures: PNG, or PDF with lines instead of pixels."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from hmsa_ros.report import style
from hmsa_ros.report.charts import (
    around,
    commanded,
    decimate,
    Part,
    reach,
    residual_text,
    results_of,
    RUN_COLOURS,
    time_unit,
    TimeUnit,
    worst,
)
from hmsa_ros.report.evaluation import verdicts

# Panels of arrivals in a row.
_PANELS = 3


def draw(path: Path, parts: Sequence[Part], kind: str = 'png') -> None:
    """Write command, response, phase plane and the arrivals with most residual as PNG or PDF."""
    unit = time_unit(parts)
    shown = worst(parts, _PANELS)
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
            colour = RUN_COLOURS[number % len(RUN_COLOURS)] if len(parts) > 1 else ''
            _draw_run(axes, part, unit, colour)
            for i in shown:
                if i < len(part.evaluation.results):
                    _draw_arrival(
                        axes[f'arrival{i}'], part, i, reach(parts, i), colour)
        begin = float(unit.of(min(x.evaluation.time[0] for x in parts)))
        end = float(unit.of(max(x.evaluation.time[-1] for x in parts)))
        for key in ('command', 'response'):
            axes[key].set_xlim(begin, end if end > begin else begin + 1.0)
        axes['command'].tick_params(labelbottom=False)
        style.finish(axes['command'], '', 'flux density $B$ [mT]', 'a')
        what = parts[0].run.plant.coordinate
        position = f'{what.name} ${what.tex}$ [1]'
        style.finish(axes['response'], f'time $t$ [{unit.name}]', position, 'b')
        style.finish(
            axes['phase'], position, rf'{what.name} rate $\dot{{{what.tex}}}$ [1/s]', 'c')
        for letter, i in zip('def', shown, strict=False):
            panel = axes[f'arrival{i}']
            style.finish(panel, 'time after arrival [ms]', 'distance [% of step]', letter)
            panel.set_title(_title(parts, i), loc='right', fontsize=8)
        figure.align_ylabels([axes['command'], axes['response']])
        style.legend_below(figure, axes['response'], axes['phase'], most=4)


def _styled(kind: dict[str, Any], colour: str) -> dict[str, Any]:
    """Return how a curve looks, in the run's own colour if there are several."""
    return {**kind, 'color': colour} if colour else kind


def _draw_run(axes: dict[str, Axes], part: Part, unit: TimeUnit, colour: str) -> None:
    run, found = part.run, part.evaluation
    time = unit.of(found.time)
    if found.levels:
        times, values = commanded(part)
        axes['command'].step(
            unit.of(times), values, where='post', **_styled(style.SHAPED, colour))
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
    for stretch, kind in (
            (part.run.stretch, style.SHAPED), (part.evaluation.unshaped[0], style.UNSHAPED)):
        if kind is style.SHAPED or not colour:
            time, distance, (begin, end) = around(part, number, stretch)
            shown = (time >= begin) & (time <= end)
            panel.plot(
                *decimate(1e3 * time[shown], distance[shown]), **_styled(kind, colour))
    panel.axvline(0.0, **style.TARGET)
    panel.set_ylim(-height, height)


def _title(parts: Sequence[Part], number: int) -> str:
    results = results_of(parts, number)
    targets = '/'.join(dict.fromkeys(f'{x.stretch:.5g}' for x in results))
    if len(parts) > 1:
        return f'to {targets}'
    said = verdicts([x.evaluation for x in parts], number)
    return f'to {targets}: {said}{residual_text(results, 2)}'
