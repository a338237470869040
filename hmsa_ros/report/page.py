"""
A report as one HTML page that needs nothing else: no network, no other file.

What the page may load is nailed down in its content security policy, too.
"""

from collections.abc import Iterable, Sequence
from datetime import datetime
from html import escape
import json
import math
from pathlib import Path

import numpy as np

from hmsa_ros import __version__
from hmsa_ros.bag.info import BagSummary
from hmsa_ros.errors import HmsaError
from hmsa_ros.interfaces.actuator import parameters_of
from hmsa_ros.interfaces.parameters import ACTUATOR, ACTUATOR_FIELDS, LAW
from hmsa_ros.model.equations import critical_zeta, stretch_limits
from hmsa_ros.model.parameters import ActuatorParameters
from hmsa_ros.model.residual import percent
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.recordings.record import Run
from hmsa_ros.recordings.topics import APPLIED
from hmsa_ros.report import charts, curves, looks
from hmsa_ros.report.arrivals import NOT_MOVED, Part, residual_text
from hmsa_ros.report.charts import Figure, TimeUnit
from hmsa_ros.report.evaluation import FEW_SAMPLES, period_of, plan_points
from hmsa_ros.report.tables import Cell, cell, formatted, Row, table, Values

_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    'img-src data: blob:; font-src data:')
# Plans and requests of long runs are cut here; the figures show all of them.
_MOST_ROWS = 1000
_MOST_FINDINGS = 8
# Stamps beyond this many seconds are dates.
_A_DATE = 1e8


def page(parts: Sequence[Part]) -> str:
    """Return a report on one run or several, as HTML; fails if Plotly is not installed."""
    unit = charts.time_unit(parts)
    figures: list[Figure] = []

    def place(figure: Figure, heading: str = '') -> str:
        figures.append(figure)
        return placed(figure, heading)

    phase, shown = charts.phase(parts)
    panels = charts.panels(parts)
    count = max(len(x.evaluation.results) for x in parts)
    planned = any(x.evaluation.plan for x in parts)
    what = parts[0].run.plant.coordinate.name
    sections = [
        ('response-section', 'Command and response', text(
            'Above, the flux density commanded: a dot where the level switches. Below, the '
            f'{what}: recorded, predicted by the plan, and simulated for unshaped steps to the '
            'levels that hold the targets. Few samples are points, with the motion through '
            'them and their rates as a line. Drag to zoom, double-click to go back, click in the '
            'legend to hide.' + (
                '' if len(parts) == 1 else ' What is simulated is hidden until its name is '
                'clicked.')) + place(charts.response(parts, unit))),
        ('setpoints', 'Setpoints', _setpoints(parts)),
        ('phase-section', 'Phase plane', text(
            f'{what.capitalize()} rate over {what}. Filled dots are the equilibria of the '
            'setpoints, the open one is where the run starts.' + (
                '' if shown == 1.0 else f' Only the first {shown:.0%} of the longest curve is '
                'drawn: what follows covers the same ground.')) + place(phase)),
    ]
    if panels:
        sections += [
            ('arrivals', 'Arrivals', text(
                'Distance from the target in percent of the step, over the time since the move '
                'began; the line is planned arrival. The residual is what is left of the '
                'vibration: peak to peak from arrival to the next move.' + (
                    '' if count <= len(panels) else
                    f' The {len(panels)} of {count} setpoints with the largest residual; the '
                    'table has all.'))
             + _key(parts) + '<div class="grid">' + ''.join(
                 place(charts.arrival(parts, i), title) for i, title in panels) + '</div>'),
            ('residual-section', 'Shaped against unshaped', text(
                'Residual of each setpoint as recorded, and as it would have been with plain '
                'steps (simulated). The axis is logarithmic.')
             + place(charts.residuals(parts))),
        ]
    if planned:
        sections.append(('plan-section', 'Plan against run', text(
            f'The plan predicts {what} and rate from each change of level to the next; here is '
            'how far the recording is from it.') + place(charts.prediction(parts, unit))
            + _plan(parts, unit)))
    sections += [
        ('timing-section', 'Timing', text(
            'Lead: how far ahead of the time it applies a command was recorded; below 0 it came '
            'late. ' + (
                'Lateness: how long after that time the change took effect, as reported by the '
                'plant or the driver. ' if any(len(x.timing.lateness) for x in parts) else '')
            + 'Delay: how long after its stamp a sample was recorded. Times are those of the '
            "recorder's clock." + _repeats(parts))
         + place(charts.timings(parts, unit)) + _timing(parts)),
        ('losses', 'Messages and losses', _losses(parts)),
        ('parameters', 'Parameters', _parameters(parts)),
    ]
    requests = _requests(parts, unit)
    if requests:
        sections.insert(-2, ('requests', 'Requests', requests))
    names = ', '.join(x.run.label for x in parts)
    body = [
        f'<h1>{escape(names)}</h1>', ''.join(_source(x.run) for x in parts), _tiles(parts),
        _notes(parts),
        '<nav aria-label="Sections">' + ''.join(
            f'<a href="#{key}">{escape(title)}</a>' for key, title, _ in sections) + '</nav>',
        *(f'<section id="{key}"><h2>{escape(title)}</h2>{content}</section>'
          for key, title, content in sections),
        f'<footer class="soft"><p>Written by hmsa_ros {__version__}. Each curve shows the least '
        f'and the largest value in each of {curves.BUCKETS} intervals, so that no peak is '
        'lost.</p></footer>']
    return document(f'{names} – run report', body, figures)


def document(title: str, body: Sequence[str], figures: Sequence[Figure]) -> str:
    """Return a page, as HTML, whose body has a place for each figure; it needs nothing else."""
    data = json.dumps(
        {'figures': [
            {'key': x.key, 'height': x.height, 'data': x.data, 'layout': x.layout}
            for x in figures],
         'dark': looks.DARK}, separators=(',', ':'), allow_nan=False)
    return '\n'.join([
        '<!DOCTYPE html>', '<html lang="en">', '<head>', '<meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<link rel="icon" href="data:,">',
        f'<title>{escape(title)}</title>', f'<style>{_beside("page.css")}</style>', '</head>',
        '<body>', *body,
        # Inside a script "</" could end it, and "<!--" keep it from ending.
        '<script type="application/json" id="report-data">' + data.replace('<', '\\u003c')
        + '</script>',
        f'<script>{_plotly()}</script>', f'<script>{_beside("page.js")}</script>', '</body>',
        '</html>', ''])


def _beside(name: str) -> str:
    """Return style or script of a page, from a file beside this one."""
    return Path(__file__).with_name(name).read_text(encoding='utf-8')


def placed(figure: Figure, heading: str = '') -> str:
    """Return the place of a figure."""
    title = f'<h3>{escape(heading)}</h3>' if heading else ''
    return (
        f'<figure>{title}<div class="plot" id="{figure.key}" role="img" '
        f'aria-label="{escape(figure.alt)}" style="height:{figure.height}px"></div></figure>')


def _plotly() -> str:
    """Return the library that draws."""
    try:
        from plotly.offline import get_plotlyjs  # type: ignore[import-untyped]

        script: str = get_plotlyjs()
    except (ImportError, OSError) as error:
        raise HmsaError(
            f'the page cannot be drawn without Plotly ({error}): install it with '
            '"pip install plotly"') from error
    # The closing tag may stand in its strings; in JavaScript the two spellings are one.
    return script.replace('</script', '<\\/script')


def text(words: str) -> str:
    """Return a paragraph."""
    return f'<p class="soft">{escape(words)}</p>'


def _time(nanoseconds: int) -> str:
    """Return a time as a date, or as seconds where it is simulated."""
    seconds = nanoseconds / NANOSECONDS
    if seconds < _A_DATE:
        return f'{seconds:.6f} s (simulated time)'
    return datetime.fromtimestamp(seconds).astimezone().isoformat(' ', 'seconds')


def _source(run: Run) -> str:
    """Return where a run is from."""
    return (
        f'<p class="soft"><b>{escape(run.label)}</b>: {escape(str(run.path))}, samples on '
        f'{escape(run.topics.get("joint_states", run.origin))} from {_time(int(run.time[0]))}, '
        f'{(run.time[-1] - run.time[0]) / NANOSECONDS:.6g} s</p>')


def _tiles(parts: Sequence[Part]) -> str:
    """Return the figures that say most."""
    def largest(values: Iterable[float]) -> float:
        return max((x for x in values if math.isfinite(x)), default=math.nan)

    header = [
        'setpoints arrived', 'largest residual, share of the step', 'the same with unshaped steps',
        'commands', 'samples a second', 'messages lost']
    rows = [[
        f'{sum(y.arrived for y in x.evaluation.findings)} of {len(x.evaluation.findings)}',
        residual_text(x.evaluation.results),
        f'{percent(largest(y.residual_unshaped for y in x.evaluation.results))} %',
        f'{len(x.timing.commands)}' + (
            f' ({x.timing.late} late)' if len(x.timing.lead) or len(x.timing.lateness) else ''),
        f'{1.0 / np.median(x.timing.interval):.6g}' if len(x.timing.interval) else '–',
        _lost(x.run.summary)] for x in parts]
    if len(parts) == 1:
        return '<div class="tiles">' + ''.join(
            f'<div><b>{escape(value)}</b><span>{escape(name)}</span></div>'
            for name, value in zip(header, rows[0], strict=True)) + '</div>'
    return table(
        'run-table', 'The runs.', ['run', *header],
        [[x.run.label, *row] for x, row in zip(parts, rows, strict=True)])


def _key(parts: Sequence[Part]) -> str:
    """Return which colour is which run's."""
    if len(parts) == 1:
        return ''
    return '<ul class="key">' + ''.join(
        f'<li><i style="--light: {x.colour}; --dark: {looks.DARK[x.colour]}"></i>'
        f'{escape(x.run.label)}</li>' for x in parts) + '</ul>'


def _notes(parts: Sequence[Part]) -> str:
    """Return what a reader should know."""
    notes = [
        f'{x.run.label}: {note}' if len(parts) > 1 else note
        for x in parts for note in _notes_of(x)]
    if not notes:
        return ''
    return '<ul class="notes">' + ''.join(f'<li>{escape(x)}</li>' for x in notes) + '</ul>'


def _notes_of(part: Part) -> Iterable[str]:
    """Return the notes on one run."""
    yield from part.run.notes
    yield from [x.message for x in part.evaluation.findings if not x.arrived][:_MOST_FINDINGS]
    if part.run.commands and not part.evaluation.results:
        yield ('No setpoint could be identified from the commands: none of them holds a '
               f'requested {part.run.plant.coordinate.name} or lasts a period of the actuator.')
    if part.evaluation.results and not part.evaluation.plain.known:
        yield 'Unshaped steps cannot be simulated: the levels are too large to follow.'
    samples = period_of(part.run) / np.median(part.timing.interval) \
        if len(part.timing.interval) else math.inf
    if samples < FEW_SAMPLES:
        yield (f'The recording has {samples:.3g} samples a period of the actuator: expected at '
               f'least {FEW_SAMPLES}, since peaks between samples are missed; raise publish_rate.')
    if not len(part.timing.lead) and part.run.commands:
        yield ('The clock of the recorder differs from that of the timestamps: the lead of the '
               'commands is unknown (record with use_sim_time if time is simulated).')
    if part.timing.unapplied:
        yield (f'{part.timing.unapplied} changes of level did not take effect according to '
               f'{part.run.topics[APPLIED]}.')
    if part.timing.missing:
        yield f'The stamps of the samples have gaps with room for {part.timing.missing} more.'
    for verdict in part.run.verdicts:
        if verdict.level == 'error':
            yield f'The planner refused a request ({verdict.code}): {verdict.message}'


# Tables --------------------------------------------------------------------------------------

def _setpoints(parts: Sequence[Part]) -> str:
    """Return the table of the setpoints and their results."""
    rows: list[Values] = []
    for part in parts:
        moves = {x.place: (x, y) for x, y in zip(
            part.evaluation.moves, part.evaluation.results, strict=True)}
        for i, found in enumerate(part.evaluation.findings):
            move, x = moves.get(i, (None, None))
            levels = 0 if move is None else len(move.flux_densities)
            of_move = [math.nan] * 9 if x is None else [
                x.b_p, x.tau_p, x.b_1, x.begin * 1e3, x.arrival * 1e3, (x.end - x.begin) * 1e3,
                100.0 * x.error, 100.0 * x.residual if x.moved else NOT_MOVED,
                100.0 * x.residual_unshaped]
            share = found.setpoint.percent
            rows.append([
                part.run.label, Cell(str(i + 1), i + 1), found.setpoint.target,
                Cell(str(found.verdict).replace('_', ' ')), share(found.offset),
                share(found.offset_std), share(found.vibration),
                share(found.vibration_std), found.frequency, *of_move,
                'unshaped step' if levels == 1 else f'{levels} levels' if levels else '–'])
    if not rows:
        return text('No setpoint was carried out while the samples were recorded.')
    return formatted(
        'setpoint-table', 'Verdict by the samples, with offset and vibration (peak to peak) and '
        'their standard deviations. b and tau nondimensional as in the paper: of the first '
        'level, the time until arrival, and of the level that holds the target. Begin from the '
        'first level of the run; arrival and end from the start of the move. Error and '
        'residual from arrival on, noise included. All in percent of the step.', {
            'run': '', 'setpoint': '', f'target {parts[0].run.plant.coordinate.symbol} [1]': '.6g',
            'verdict': '', 'offset [%]': '+%', '± [%]': '%', 'vibration [%]': '%',
            '± of it [%]': '%', 'frequency [Hz]': '.3g',
            'b_p [1]': '.5f', 'tau_p [1]': '.5f', 'b_1 [1]': '.5f', 'begin [ms]': '.3f',
            'arrival [ms]': '.3f', 'end [ms]': '.3f', 'largest error [%]': '%',
            'residual [%]': '%', 'unshaped steps [%]': '%', 'command': ''}, rows)


def _requests(parts: Sequence[Part], unit: TimeUnit) -> str:
    """Return the table of verdicts."""
    rows: list[Values] = []
    for part in parts:
        before = None
        for x in part.run.verdicts:
            if (x.code, x.message) != before and x.code != 'none':
                before = x.code, x.message
                rows.append([
                    part.run.label, unit.of(part.evaluation.seconds(x.sent)).item(), x.level,
                    x.code, x.message])
    return '' if not rows else formatted(
        'request-table', 'Verdicts of the planner on the requests.', {
            'run': '', f'time [{unit.name}]': '.3f', 'level': '', 'code': '', 'message': ''},
        rows[:_MOST_ROWS])


def _plan(parts: Sequence[Part], unit: TimeUnit) -> str:
    """Return the table of planned changes of level."""
    rows: list[Values] = [
        [part.run.label, unit.of(x.time).item(), x.planned * 1e3, x.commanded * 1e3, x.stretch,
         x.recorded_stretch, x.rate, x.recorded_rate, x.deviation]
        for part in parts for x in plan_points(part.run, part.evaluation)]
    what = parts[0].run.plant.coordinate
    name, symbol = what.name, what.symbol
    return formatted(
        'plan-table', f'Each change of level: flux density planned and commanded; {name} and '
        'rate of the first sample from then on; and the largest distance of the recorded from '
        f'the predicted {name} until the next change.', {
            'run': '', f'time [{unit.name}]': '.4f', 'B planned [mT]': '.4f',
            'B commanded [mT]': '.4f', f'{symbol} planned [1]': '.7f',
            f'{symbol} recorded [1]': '.7f', 'rate planned [1/s]': '.4g',
            'rate recorded [1/s]': '.4g', f'largest |Δ{symbol}| [1]': '.2e'}, rows[:_MOST_ROWS])


def _repeats(parts: Sequence[Part]) -> str:
    count = sum(x.timing.repeats for x in parts)
    return f' {count} commands that repeat the one before are omitted.' if count else ''


def _timing(parts: Sequence[Part]) -> str:
    """Return the table of times."""
    rows: list[Values] = []
    for part in parts:
        x = part.timing
        for name, values in (
                ('command lead', x.lead),
                ('lateness of the command', x.lateness[np.isfinite(x.lateness)]),
                ('sample delay', x.delay),
                ('interval of the timestamps', x.interval),
                ('interval of the recorded samples', x.arrival_interval)):
            if len(values):
                rows.append([
                    part.run.label, name, Cell(str(len(values)), len(values)),
                    *np.quantile(values, [0.0, 0.5, 0.99, 1.0]) * 1e3,
                    float(np.std(values)) * 1e3])
    return formatted('timing-table', 'Jitter is the standard deviation.', {
        'run': '', 'quantity': '', 'count': '', 'least [ms]': '.4f', 'median [ms]': '.4f',
        '99 % [ms]': '.4f', 'largest [ms]': '.4f', 'jitter [ms]': '.4f'}, rows)


def _lost(summary: BagSummary | None) -> str:
    """Return how many messages were lost, as far as the bag counts them."""
    return 'not counted' if summary is None or summary.lost is None else str(summary.lost)


def _losses(parts: Sequence[Part]) -> str:
    """Return the table of topics."""
    rows: list[Row] = []
    counted = True
    for part in dict.fromkeys(x.run.path for x in parts):
        run = next(x.run for x in parts if x.run.path == part)
        if run.summary is None:
            continue
        counted = counted and run.summary.lost is not None
        for topic in run.summary.topics:
            rows.append([
                run.label, topic.name, topic.type, Cell(str(topic.count), topic.count),
                cell(math.nan if topic.rate is None else topic.rate, '.1f'),
                Cell('not counted' if topic.lost is None else str(topic.lost),
                     math.nan if topic.lost is None else topic.lost)])
    words = '' if counted else text(
        'hmsa recorder counts lost messages and stores the counts in the bag; with other '
        'recorders, only gaps in the stamps of the samples show losses.')
    return words + table(
        'loss-table', 'What is in the bags.',
        ['bag', 'topic', 'type', 'messages', 'a second', 'lost'], rows)


def _given(value: object) -> Cell | str:
    """Return a constant of a law as a cell shows it; Gent has none."""
    if isinstance(value, list) and len(value) > 6:
        return f'{len(value)} values, {min(value):.6g} to {max(value):.6g}'
    if isinstance(value, list):
        return ', '.join(f'{x:.6g}' for x in value)
    return cell(value) if isinstance(value, float) else str(value or '-')


def _parameters(parts: Sequence[Part]) -> str:
    """Return the table of parameters."""
    header = ['parameter', 'unit']
    columns: list[ActuatorParameters] = []
    for part in parts:
        run = part.run
        source = '' if run.parameters_known else ' (unknown: example block)'
        prefix = f'{run.label}: ' if len(parts) > 1 else ''
        if run.plant == run.planner:
            header.append(f'{prefix}actuator{source}')
            columns.append(run.plant)
        else:
            header += [f'{prefix}plant', f'{prefix}as planned']
            columns += [run.plant, run.planner]
    gent = any(x.law is None for x in columns)
    rows: list[Row] = [
        [name.replace('_', ' '), (spec.unit or '1').replace('^3', '³'),
         *(cell(getattr(x, name)) for x in columns)]
        for name, spec in zip(ACTUATOR_FIELDS, ACTUATOR, strict=True)
        if name != 'chain_limit' or gent]
    laws = [parameters_of(x) for x in columns]
    rows += [
        [spec.name, spec.unit or '1', *(_given(x.get(spec.name)) for x in laws)]
        for spec in LAW if any(spec.name in x for x in laws)]
    groups = [x.nondimensional for x in columns]
    name, rest = columns[0].coordinate.name, columns[0].rest
    chains: list[Row] = [['J_lim', '1', *(cell(x.j_lim) for x in groups)]] if gent else []
    limits = [stretch_limits(x.nondimensional) for x in columns]
    rows += [
        ['zeta', '1', *(cell(x.zeta) for x in groups)],
        [f'critical zeta about {name} {rest:g}', '1', *(
            cell(float(critical_zeta(x.rest, x))) for x in groups)],
        *chains,
        ['c1', '1', *(cell(x.c1) for x in groups)],
        ['time unit', 'ms', *(cell(x.time_unit * 1e3) for x in columns)],
        ['flux density of load 1', 'mT', *(cell(x.flux_density_unit * 1e3) for x in columns)],
        [f'least {name}', '1', *(cell(x) for x, _ in limits)],
        [f'largest {name}', '1', *(cell(x) for _, x in limits)],
    ]
    words = '' if all(x.run.parameters_known for x in parts) else text(
        'Unknown: the bag does not contain the parameters; the example block of the paper is '
        'used instead.')
    recorded: list[Row] = [
        [part.run.label, key, json.dumps(value)] for part in parts
        for key, value in part.run.parameters.items()]
    more = '' if not recorded else (
        '<details><summary>All parameters that were recorded</summary>' + table(
            'recorded-table', 'As set on the nodes.', ['run', 'parameter', 'value'], recorded)
        + '</details>')
    return words + table(
        'parameter-table', 'The actuator, and what follows from it.', header, rows) + more
