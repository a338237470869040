"""
Figures of studies: robustness, and sweeps.

Those of a sweep are curves, maps with the region without a plan, and distributions of samples.
"""

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FormatStrFormatter, MaxNLocator, NullLocator
import numpy as np

from hmsa.interfaces.parameters import PLANNED
from hmsa.model.equations import Array
from hmsa.report import looks, style
from hmsa.report.looks import LineStyle, Paper
from hmsa.table import percent
from hmsa_studies.axes import ACTUAL, BLOCK_OF, Nondimensional, SweepAxis, View
from hmsa_studies.robustness import Candidate, Case, ORDERED, Result

# Smaller residuals are drawn at this value.
_FLOOR = 1e-4
_SYMBOLS = {'G': '$G$', 'zeta': r'$\zeta$', 'J_lim': r'$J_\mathrm{lim}$'}
# Styles of orders of a shaper: fill of markers, and factor on the line width.
_ORDERS = (('full', 1.0), ('none', 0.7), ('left', 0.5), ('top', 0.5))
# Number of markers on a curve.
_MARKS = 5

#: Quantiles of the samples that limit the bands, and the quantile that maps show.
BANDS, MAPPED = ((0.05, 0.95), (0.25, 0.75)), 0.95

_STEP = '% of step'
_NAMES = {
    'start': r'start $\lambda_0$', 'target': r'target $\lambda_d$',
    'zeta': r'$\zeta$', 'j_lim': r'$J_\mathrm{lim}$', 'c1': '$c_1$',
    'load_min': r'minimum load $\beta$', 'load_max': r'maximum load $\beta$',
    'period': r'command period $\tau$', 'lag': r'coil lag $\tau$',
    'slew': r'slew limit $\mathrm{d}\beta/\mathrm{d}\tau$',
    'command_period': 'command period (s)',
    'beta_p': r'first load $\beta_p$', 'b_p': 'first level $b_p$',
    'tau_p': r'time of first level $\tau_p$', 'beta_1': r'holding load $\beta_1$',
    'b_1': 'holding level $b_1$', 'flux_density_p': 'first flux density $B_p$ (T)',
    'residual': f'residual vibration ({_STEP})', 'offset': f'steady-state error ({_STEP})',
    'error.shear_modulus': 'error in $G$ (%)', 'error.j_lim': r'error in $J_\mathrm{lim}$ (%)',
    'error.zeta': r'error in $\zeta$ (%)', 'error.remanence': 'error in $B_r$ (%)',
    'time_p': 'time of first level $t_p$ (s)', 'flux_density_1': 'holding flux density $B_1$ (T)'}
# Fractions, drawn in percent.
_SHARES = ('residual', 'offset', *Nondimensional.actual)
_UNITS = {x.name: x.unit for x in PLANNED}
_HATCH: dict[str, Any] = {'facecolor': '#F0F0F0', 'edgecolor': '#9A9A9A', 'hatch': '////'}
_CONTOURS = 7
# Position of the median in the scale of a map below which it would show a single colour; the scale
# is then logarithmic and ends at this quantile.
_LOPSIDED, _MOST = 0.2, 0.97
# Ratio of positive values above which a scale is logarithmic.
_DECADES = 30.0


# -- robustness -----------------------------------------------------------------------------------

def draw_robustness(
        paths: Path | Sequence[Path], case: Case, results: Sequence[Result],
        paper: Paper | None = None) -> None:
    """Draw the residuals of one move: over each error alone, and the worst of all together."""
    shown = [x for x in results if x.move is not None]
    curves = _looks([x.candidate for x in shown])
    errors = 100.0 * case.errors()
    paper = paper or Paper()
    names = list(case.parameters)
    cells = ['G', 'zeta', *(['J_lim'] if 'J_lim' in names else []), 'box']
    columns = paper.columns(2)
    if columns == 2:
        rows = [['G', 'zeta'], ['J_lim' if 'J_lim' in names else 'box', 'box']]
    else:
        rows = [[x] for x in cells]
    # In a single column the panels are lower, so that all fit on a page.
    height = 2.3 if columns > 1 else 1.6
    with style.picture(paths, 1.4 + height * len(rows) + 0.3 * (3 - columns), paper) as figure:
        figure.suptitle(
            f'{case.material.coordinate.name} {case.start:g} to {case.target:g}; '
            f'{_nominal(case)}')
        panels = figure.subplot_mosaic(rows)  # type: ignore[arg-type]
        for name, letter in zip(names, 'abc', strict=False):
            axes = panels[name]
            for place, (result, (look, order)) in enumerate(zip(shown, curves, strict=True)):
                fill, thin = _ORDERS[order % len(_ORDERS)]
                # Offset markers of different curves.
                every = max(len(errors) // _MARKS, 1)
                axes.plot(
                    errors, 100.0 * np.maximum(result.curves[name], _FLOOR),
                    **{**look.line(label=_label(result)), 'linewidth': thin * look.width},
                    marker=look.marker, fillstyle=fill, markersize=4.0, markeredgewidth=0.8,
                    markevery=(place * every // len(shown), every))
            axes.axvspan(-100.0 * case.box, 100.0 * case.box, color='#F2F2F2', zorder=0)
            axes.set_yscale('log')
            axes.set_ylim(100.0 * _FLOOR, 400.0)
            axes.set_xlim(errors[0], errors[-1])
            style.finish(
                axes, f'error in {_SYMBOLS[name]} alone (%)',
                style.axis('residual vibration', unit='% of step'), letter)
            axes.yaxis.minorticks_off()
        _bars(panels['box'], case, shown, [x for x, _ in curves], 'abcd'[len(names)])
        linear = [x.candidate.name for x in shown if x.candidate.linear]
        style.legend_below(
            figure, panels['G'], most=4,
            title=f'{", ".join(linear)}: linear, designed at the target' if linear else '')


def _nominal(case: Case) -> str:
    """Return a description of the model for a title."""
    material = case.material
    whose = rf'$J_\mathrm{{lim}}$ = {material.j_lim:g}' if material.law is None else (
        f'law {material.law.law}')
    return rf'nominal $\zeta$ = {material.zeta:.4g}, {whose}, $c_1$ = {material.c1:.4g}'


def _looks(candidates: Sequence[Candidate]) -> list[tuple[LineStyle, int]]:
    """Return the look of each candidate, and the index of its order."""
    orders = list(dict.fromkeys(x.order for x in candidates if x.shaper in ORDERED))
    return [
        (looks.SHAPERS.get(x.shaper, LineStyle(looks.BLACK)),
         orders.index(x.order) if x.shaper in ORDERED else 0) for x in candidates]


def draw_front(
        paths: Path | Sequence[Path], studies: Sequence[tuple[Case, Sequence[Result]]],
        paper: Paper | None = None) -> None:
    """Draw the worst residuals over the duration of a move, with a panel for each move."""
    paper = paper or Paper()
    columns = paper.columns(max(min(len(studies), 3), 1))
    rows = max(-(-len(studies) // columns), 1)
    with style.picture(paths, 1.0 + 2.5 * rows, paper) as figure:
        axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
        for place, (panel, (case, results)) in enumerate(zip(axes, studies, strict=False)):
            shown = [
                x for x in results if x.move is not None and math.isfinite(x.move.duration)]
            for result, (look, _) in zip(
                    shown, _looks([x.candidate for x in shown]), strict=True):
                _draw_point(figure, panel, result, look)
            panel.set_yscale('log')
            panel.margins(x=0.1, y=0.1)
            style.finish(
                panel, style.axis('move time', r'\tau'), style.axis(
                    'worst residual vibration', unit='% of step') if place % columns == 0 else '',
                'abcdefghi'[place] if 1 < len(studies) <= 9 else '')
            panel.yaxis.minorticks_off()
            panel.set_title(
                f'{case.material.coordinate.name} {case.start:g} to {case.target:g}',
                loc='right')
        for panel in axes[len(studies):]:
            panel.set_axis_off()
        case = studies[0][0]
        together = ', '.join(_SYMBOLS[x] for x in case.parameters)
        style.legend_below(
            figure, title=rf'filled: {together} within $\pm${100.0 * case.box:g} % together; '
            'open: $G$ alone; number: order', most=6)


def _draw_point(figure: style.Picture, panel: Axes, result: Result, look: LineStyle) -> None:
    """Draw one result: all errors together above, the modulus alone below, and the order."""
    both = [100.0 * max(x.residual, _FLOOR) for x in (result.worst, result.alone['G'])]
    panel.plot([result.arrival] * 2, both, color=look.colour, linewidth=0.7, zorder=2)
    for value, face in zip(both, (look.colour, 'white'), strict=True):
        panel.plot(
            [result.arrival], [value], color=look.colour, linestyle='none', marker=look.marker,
            markersize=5.5, markerfacecolor=face, zorder=3, label='_')
        figure.remember(
            panel, f'{result.candidate.name}, {"G alone" if face == "white" else "all"}',
            [result.arrival], [value])
    if result.candidate.shaper in ORDERED:
        style.note(panel, f'{result.candidate.order}', (result.arrival, both[0]), (6, -3),
                   **style.SOFT)
    # A shaper of several orders has a single entry.
    name = result.candidate.name.partition(',')[0]
    if name not in panel.get_legend_handles_labels()[1]:
        panel.plot([], [], color=look.colour, linestyle='none', marker=look.marker,
                   markersize=5.5, label=name)


def _label(result: Result) -> str:
    """Return the label of a curve, with the code of a shaper that fell back."""
    name = result.candidate.name
    return f'{name}: {result.code}' if result.reason else name


def _bars(
        axes: Axes, case: Case, results: Sequence[Result], curves: Sequence[LineStyle],
        letter: str) -> None:
    """Draw the worst residuals in the box of all errors."""
    worst = np.array([x.worst.residual for x in results])
    lengths = 100.0 * np.nan_to_num(np.maximum(worst, _FLOOR), nan=_FLOOR)
    places = np.arange(len(results))
    axes.barh(
        places, lengths, color=[x.colour for x in curves], height=0.62, zorder=2)
    for place, length, value in zip(places, lengths, worst, strict=True):
        axes.annotate(
            percent(value), (float(length), float(place)), xytext=(3, 0),
            textcoords='offset points', va='center', fontsize='small')
    axes.set_xscale('log')
    axes.set_xlim(100.0 * _FLOOR, 1000.0)
    axes.set_yticks(places, [x.candidate.name for x in results])
    axes.set_ylim(len(results) - 0.4, -0.6)
    style.finish(
        axes, rf'worst case within $\pm${100.0 * case.box:g} % (% of step)', '', letter)
    axes.xaxis.minorticks_off()
    axes.yaxis.minorticks_off()
    axes.grid(visible=False, axis='y')


# -- sweeps ---------------------------------------------------------------------------------------

def draw_sweep(
        paths: Sequence[Path], view: View, columns: Mapping[str, Array],
        fixed: Mapping[str, float], paper: Paper) -> None:
    """Draw a sweep's columns, NaN without a plan, with the constant columns as a title."""
    values = {name: _scale(name) * view.arranged(x) for name, x in columns.items()}
    rows = len(view.labels) if view.y else 1
    # Stack the columns if the paper is too narrow.
    stacked = paper.columns(len(values)) < len(values)
    with style.picture(paths, 1.1 + 2.5 * rows * (len(values) if stacked else 1), paper) as figure:
        panels = figure.subplots(
            rows * (len(values) if stacked else 1), 1 if stacked else len(values), squeeze=False)
        if stacked:
            panels = panels.reshape(rows, len(values))
        letters = iter('abcdefghijklmnopqrstuvwxyz' if panels.size > 1 else '')
        for column, (name, found) in enumerate(values.items()):
            if view.x is None:
                _shares(panels[0, column], view, name, found[:, 0, 0])
            elif view.y is None:
                _curves(figure, panels[0, column], view, view.x, name, found[:, 0])
            else:
                for row, label in enumerate(view.labels):
                    _map(figure, panels[row, column], (view.x, view.y), name,
                         _quantile(found[row], MAPPED) if view.samples > 1
                         else found[row, :, :, 0])
                    panels[row, column].set_title(worded(label), loc='right')
        for panel in figure.axes:
            if panel.get_label() != '<colorbar>' and (letter := next(letters, '')):
                panel.set_title(f'({letter})', loc='left', fontweight='bold')
        _notes(figure, panels[0, 0], view, values)
        common = [_with_value(x, _scale(x) * y) for x, y in fixed.items()]
        if common:
            figure.suptitle(', '.join(common))


def worded(label: str) -> str:
    """Return the label of a curve or map with symbols for the columns that it names."""
    parts = (x.rpartition(' ') for x in label.split(', '))
    return ', '.join(
        _with_value(name, float(value)) if name in _NAMES else f'{name}{space}{value}'
        for name, space, value in parts)


def _with_value(name: str, value: float) -> str:
    """Return the description of a column, and its value with the unit."""
    quantity, bracket, unit = label_of(name).partition(' (')
    return f'{quantity} = {value:g}{" " if bracket else ""}{unit.removesuffix(")")}'


def label_of(name: str) -> str:
    """Return the description of an axis or a column, with its unit if any."""
    if name in _NAMES:
        return _NAMES[name]
    planned = f'{BLOCK_OF}{name.removeprefix(ACTUAL)}'
    planned = planned if planned in _UNITS else name.removeprefix(ACTUAL)
    words = planned.removeprefix(BLOCK_OF).replace('_', ' ')
    return style.axis(f'{"actual " if name.startswith(ACTUAL) else ""}{words}',
                      unit=_UNITS.get(planned, ''))


def _scale(name: str) -> float:
    return 100.0 if name in _SHARES else 1.0


def _quantile(values: Array, share: float) -> Array:
    """Return a quantile over the last axis without NaN, or NaN if all are."""
    missing = np.all(np.isnan(values), axis=-1)
    found: Array = np.nanquantile(np.where(missing[..., None], 0.0, values), share, axis=-1)
    return np.where(missing, np.nan, found)


def _wide(values: Array) -> bool:
    """Return whether values extend over decades."""
    known = values[np.isfinite(values)]
    return bool(known.size and known.min() > 0.0 and known.max() > _DECADES * known.min())


def _even(axis: SweepAxis) -> bool:
    """Return whether an axis is better linear, since its values are then more even."""
    places = View.places(axis)
    if not _wide(places):
        return True
    steps, ratios = np.diff(np.sort(places)), np.diff(np.sort(np.log(places)))
    return bool(np.ptp(steps) / np.mean(steps) <= np.ptp(ratios) / np.mean(ratios))


def _map(
        figure: style.Picture, panel: Axes, axes: tuple[SweepAxis, SweepAxis], name: str,
        values: Array) -> None:
    """Draw a map with contours, hatched where there is no plan."""
    places = [_scale(x.name) * View.places(x) for x in axes]
    orders = [np.argsort(x, kind='stable') for x in places]
    x, y = (place[order] for place, order in zip(places, orders, strict=True))
    values = values[np.ix_(orders[1], orders[0])]
    panel.set_xscale('linear' if _even(axes[0]) else 'log')
    panel.set_yscale('linear' if _even(axes[1]) else 'log')
    panel.patch.set(linewidth=0.0, **_HATCH)
    known = np.isfinite(values)
    if known.any():
        norm, (low, high) = _norm(values[known])
        mesh = panel.pcolormesh(
            x, y, values, cmap='cividis', norm=norm, shading='nearest', rasterized=True)
        bar = figure.colorbar(mesh, ax=panel, label=label_of(name), pad=0.02,
                              extend='max' if values[known].max() > high else 'neither')
        if isinstance(norm, LogNorm) and high < _DECADES * low:
            # There may be no power of ten on the scale.
            bar.set_ticks([z for z in MaxNLocator(5).tick_values(low, high) if low <= z <= high])
            bar.formatter = FormatStrFormatter('%g')
            bar.minorticks_off()
        # At quantiles of the values, contours are spread over the whole map.
        levels = sorted({float(f'{z:.2g}') for z in np.quantile(
            values[known], np.arange(1, _CONTOURS + 1) / (_CONTOURS + 1))})
        levels = [z for z in levels if values[known].min() < z < values[known].max()]
        if levels:
            lines = panel.contour(x, y, values, levels=levels, colors='white', linewidths=0.7)
            numbers = panel.clabel(lines, fontsize='small', fmt='%.3g')
            for number in numbers:
                number.set_clip_on(False)  # cut off at the edge, it would be another number
            for drawn in (lines, *numbers):
                drawn.set(path_effects=[withStroke(linewidth=1.6, foreground='#404040')])
    figure.remember(panel, label_of(name), x, y, values)
    style.finish(panel, label_of(axes[0].name), label_of(axes[1].name))
    panel.grid(visible=False)
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_minor_locator(NullLocator())


def _norm(values: Array) -> tuple[Normalize, tuple[float, float]]:
    """Return the scale of a map's colours, and its ends."""
    low, middle, most, high = (float(x) for x in np.quantile(values, [0.0, 0.5, _MOST, 1.0]))
    ends = low, high if high > low else low + 1e-12
    if not _wide(values) and (low <= 0.0 or middle - low >= _LOPSIDED * (high - low)):
        return Normalize(*ends), ends
    if math.log(middle / low) < _LOPSIDED * math.log(high / low) and most > low:
        ends = low, most
    return LogNorm(*ends), ends


def _apart(place: int, count: int, points: int) -> tuple[int, int]:
    """Return first marker and interval of markers, so that several curves do not overlap."""
    every = max(points // 6, 1)
    return place * every // count, every


def _curves(
        figure: style.Picture, panel: Axes, view: View, axis: SweepAxis, name: str,
        values: Array) -> None:
    """Draw curves over one axis, or bands of samples."""
    x = _scale(axis.name) * View.places(axis)
    order = np.argsort(x, kind='stable')
    x, values = x[order], values[:, order]
    for place, (label, found) in enumerate(
            zip(map(worded, view.labels), values, strict=True)):
        look = looks.case(place)
        if view.samples > 1:
            for (low, high), alpha in zip(BANDS, (0.16, 0.3), strict=True):
                edges = _quantile(found, low), _quantile(found, high)
                panel.fill_between(
                    x, *edges, color=look.colour, alpha=alpha, linewidth=0.0)
                for share, edge in zip((low, high), edges, strict=True):
                    figure.remember(panel, f'{label} {100.0 * share:g} %'.strip(), x, edge)
        middle = _quantile(found, 0.5)
        lonely = bool(np.isfinite(middle).sum() < 2)
        panel.plot(
            x, middle, **look.line(
                label=label or ('median' if view.samples > 1 else 'plan')),
            marker=look.marker, markersize=4.0, markevery=1 if lonely else _apart(
                place, len(view.labels), len(x)))
    style.finish(panel, label_of(axis.name), label_of(name))
    if not _even(axis):
        panel.set_xscale('log')
    if _wide(values):
        panel.set_yscale('log')
    panel.set_xlim(x[0], x[-1])
    borders = np.concatenate([x[:1], 0.5 * (x[1:] + x[:-1]), x[-1:]])
    missing = np.repeat(np.all(np.isnan(values), axis=(0, 2)), 2)
    panel.fill_between(
        np.repeat(borders, 2)[1:-1], 0.0, 1.0, transform=panel.get_xaxis_transform(),
        where=missing.tolist(), linewidth=0.0, **_HATCH)


def _shares(panel: Axes, view: View, name: str, values: Array) -> None:
    """Draw the cumulative distribution of the samples, with the median and 5 to 95 %."""
    for place, (label, found) in enumerate(
            zip(map(worded, view.labels), values, strict=True)):
        look = looks.case(place)
        known = np.sort(found[np.isfinite(found)])
        if known.size == 0:
            continue
        low, middle, high = np.quantile(known, (BANDS[0][0], 0.5, BANDS[0][1])).tolist()
        panel.plot(
            known, np.arange(1, known.size + 1) / found.size, **look.line(
                label=f'{label + ": " if label else ""}{middle:.3g} ({low:.3g} to {high:.3g})'))
        for x, y in ((low, BANDS[0][0]), (middle, 0.5), (high, BANDS[0][1])):
            panel.plot([x], [y * known.size / found.size], look.marker, color=look.colour,
                       markersize=4)
    style.finish(panel, label_of(name), 'share of the samples below')
    if _wide(values):
        panel.set_xscale('log')
    panel.set_ylim(0.0, 1.0)
    panel.legend(loc='upper center', bbox_to_anchor=(0.5, -0.22),
                 title='median (5 % to 95 %)', title_fontsize='small')


def _notes(figure: Figure, panel: Axes, view: View, values: Mapping[str, Array]) -> None:
    """Add a legend below for curves, bands and hatches."""
    curves: tuple[list[Any], list[str]] = ([], [])
    if view.y is None and view.x is not None and view.labels != ('',):
        curves = panel.get_legend_handles_labels()
    missing = max(float(np.mean(np.isnan(x))) for x in values.values())
    handles, labels = list(curves[0]), list(curves[1])
    # Hatches appear where all curves lack a plan.
    over = (0, 3) if view.y is None else (3,)
    if view.x and any(np.any(np.all(np.isnan(x), axis=over)) for x in values.values()):
        handles.append(Patch(linewidth=0.0, **_HATCH))
        labels.append('no plan')
    title = ''
    if view.samples > 1 and view.x is not None:
        title = (f'{100.0 * MAPPED:g} % of {view.samples} samples are below' if view.y else
                 f'median of {view.samples} samples; bands: middle 50 % and 90 %')
    if missing and view.samples > 1:
        title += f'{"; " if title else ""}{100.0 * missing:.2g} % of the rows have no plan'
    if handles or title:
        figure.legend(
            handles, labels, loc='outside lower center', title=title, title_fontsize='small',
            ncols=max(1, round(figure.get_figwidth() / 1.8)))
