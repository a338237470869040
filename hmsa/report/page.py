"""
A report as one self-contained HTML page.

The page needs no network and no other file; its content security policy enforces this.
"""

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from functools import cache
import json
import math
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from hmsa import __version__
from hmsa.interfaces.actuator import parameters_of
from hmsa.interfaces.parameters import ACTUATOR, ACTUATOR_FIELDS, LAW
from hmsa.model.equations import critical_zeta, stretch_limits
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import NANOSECONDS
from hmsa.report import charts, looks
from hmsa.report.charts import TimeUnit
from hmsa.report.comparison import NOT_MOVED, Part, residual_text, title, worst
from hmsa.report.evaluation import FEW_SAMPLES, plan_points, verdict_on
from hmsa.report.figures import BUCKETS, Figure
from hmsa.runs.record import Run
from hmsa.runs.topics import APPLIED
from hmsa.table import Column, percent, Table

#: Folder of the templates.
FOLDER = Path(__file__).parent
# Maximum rows of the tables of plan and requests; figures show all of them.
_MOST_ROWS = 1000
_MOST_FINDINGS = 8
# Larger timestamps, in s, are dates; smaller ones are simulated time.
_A_DATE = 1e8


def page(parts: Sequence[Part]) -> str:
    """Return the report of one run or several as HTML."""
    unit = charts.time_unit(parts)
    name, timings = parts[0].run.plant.coordinate.name, charts.timings(parts)
    figures = {
        key: Figure(key, alt, panels, height) for key, alt, panels, height in (
            ('response', f'Flux density command and {name} over time',
             [*charts.command(parts), *charts.response(parts)], 560),
            ('phase', f'{name.capitalize()} rate over {name}, with the equilibria',
             charts.phase(parts), 480),
            ('residuals', 'Residual vibration of each setpoint, and for unshaped steps',
             charts.residuals(parts), 340),
            ('deviation', f'Recorded minus planned {name} over time', charts.deviations(parts),
             300),
            ('timing', 'Lead of the commands, delay and interval of the samples',
             timings, 80 + 180 * len(timings))) if panels}
    arrivals = [
        (title(parts, i), Figure(
            f'arrival{i}', f'Setpoint {title(parts, i)}', [charts.error(parts, i)], 320,
            # The labels of several runs do not fit into every panel.
            legend=len(parts) == 1)) for i in worst(parts, charts.MOST_PANELS)]
    names = ', '.join(x.run.label for x in parts)
    return document(
        FOLDER / 'run.html', f'{names} – run report',
        [*figures.values(), *(x for _, x in arrivals)], figures=figures, arrivals=arrivals,
        names=names, single=len(parts) == 1, sources=[_source(x.run) for x in parts],
        summary=_summary(parts), remarks=_notes(parts), what=name,
        shown=charts.phase_shown(parts),
        origins=' and '.join(dict.fromkeys(x.run.origin for x in parts)),
        count=max(len(x.evaluation.results) for x in parts),
        colours=[(x.run.label, looks.case(i).colour) for i, x in enumerate(parts)],
        planned=any(x.evaluation.plan for x in parts), identical=charts.identical(parts),
        constant=charts.constant_timings(parts),
        lateness=any(len(x.timing.lateness) for x in parts),
        repeats=sum(x.timing.repeats for x in parts),
        counted=all(x.run.summary is None or x.run.summary.lost is not None for x in parts),
        known=all(x.run.parameters_known for x in parts), setpoints=_setpoints(parts),
        decisive=_decisive(parts),
        plan=_plan(parts, unit), times=_timing(parts), requests=_requests(parts, unit),
        losses=_losses(parts), actuator=_parameters(parts),
        recorded=_table({'run': '', 'parameter': '', 'value': ''}, [
            (part.run.label, key, json.dumps(value)) for part in parts
            for key, value in part.run.parameters.items()]),
        buckets=BUCKETS)


def document(
        template: Path, title: str, drawn: Sequence[Figure], **values: Any) -> str:
    """Return a self-contained HTML page from a template that places the figures."""
    data = json.dumps(
        [x.to_dict() for x in drawn], separators=(',', ':'), allow_nan=False)
    found = _pages(template.parent).get_template(template.name)
    return found.render({'figures': drawn} | values | {
        'title': title, 'version': __version__, 'dark': looks.DARK,
        'style': (FOLDER / 'page.css').read_text(encoding='utf-8'),
        'scripts': [(FOLDER / x).read_text(encoding='utf-8') for x in ('figure.js', 'page.js')],
        # In a script, "</" could close it, and "<!--" could keep it open.
        'data': data.replace('<', '\\u003c')})


@cache
def _pages(folder: Path) -> jinja2.Environment:
    """Return the templates of a folder, beside those of all pages."""
    pages = jinja2.Environment(
        loader=jinja2.FileSystemLoader([folder, FOLDER]), autoescape=True,
        trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    pages.globals |= {'zip': zip, 'numeric': _numeric}
    return pages


def _numeric(table: Table) -> list[bool]:
    """Return whether each column contains numbers."""
    return [any(not isinstance(row[i], str) for row in table.rows)
            for i in range(len(table.columns))]


def _time(nanoseconds: int) -> str:
    """Return a time as a date, or in seconds if simulated."""
    seconds = nanoseconds / NANOSECONDS
    if seconds < _A_DATE:
        return f'{seconds:.6f} s (simulated time)'
    return datetime.fromtimestamp(seconds).astimezone().isoformat(' ', 'seconds')


def _source(run: Run) -> tuple[str, ...]:
    """Return the source of a run: label, path, topic of its samples, start, and length in s."""
    return (run.label, str(run.path), run.topics.get('joint_states', run.origin),
            _time(int(run.time[0])), f'{(run.time[-1] - run.time[0]) / NANOSECONDS:.6g}')


def _summary(parts: Sequence[Part]) -> list[tuple[str, str]] | Table:
    """Return the key figures: pairs of value and name for one run, a table for several."""
    def largest(values: Iterable[float]) -> float:
        return max((x for x in values if math.isfinite(x)), default=math.nan)

    header = [
        'setpoints arrived', 'largest residual, of the step', 'the same with unshaped steps',
        'commands', 'samples a second', 'messages lost']
    rows = [[
        f'{sum(y.arrived for y in x.evaluation.findings)} of {len(x.evaluation.findings)}',
        residual_text(x.evaluation.results),
        f'{percent(largest(y.residual_unshaped for y in x.evaluation.results))} %',
        f'{len(x.timing.commands)}' + (
            f' ({x.timing.late} late)' if len(x.timing.lead) or len(x.timing.lateness) else ''),
        f'{1.0 / np.median(x.timing.interval):.4g}' if len(x.timing.interval) else '–',
        'not counted' if x.run.summary is None or x.run.summary.lost is None
        else str(x.run.summary.lost)] for x in parts]
    if len(parts) == 1:
        return list(zip(rows[0], header, strict=True))
    return _table(dict.fromkeys(('run', *header), ''), [
        (x.run.label, *row) for x, row in zip(parts, rows, strict=True)])


def _notes(parts: Sequence[Part]) -> list[str]:
    """Return the remarks on all runs."""
    return [
        f'{x.run.label}: {note}' if len(parts) > 1 else note
        for x in parts for note in _notes_of(x)]


def _notes_of(part: Part) -> Iterable[str]:
    """Yield the remarks on one run."""
    yield from part.run.notes
    yield from [x.message for x in part.evaluation.findings if not x.arrived][:_MOST_FINDINGS]
    if part.run.commands and not part.evaluation.results:
        yield ('No setpoint could be identified from the commands: none of them holds a '
               f'requested {part.run.plant.coordinate.name} or lasts a period of the actuator.')
    if part.evaluation.results and not np.isfinite(
            part.evaluation.plain.stretch).any():
        yield ('Unshaped steps cannot be simulated: the levels are too large to follow, or too '
               'long before the last sample.')
    samples = part.run.plant.period / np.median(part.timing.interval) \
        if len(part.timing.interval) else math.inf
    if samples < FEW_SAMPLES:
        yield (f'The recording has {samples:.3g} samples a period of the actuator: expected at '
               f'least {FEW_SAMPLES}, since peaks between samples are missed; raise publish_rate.')
    if not len(part.timing.lead) and part.run.commands:
        yield ('The clock of the recorder differs from that of the timestamps: the lead of the '
               'commands is unknown (record with use_sim_time if time is simulated).')
    if part.run.rejected:
        yield (f'{part.run.rejected} changes of level came later than lateness_limit and were '
               'rejected.')
    if part.timing.unapplied:
        yield (f'{part.timing.unapplied} changes of level did not take effect according to '
               f'{part.run.topics[APPLIED]}.')
    if part.timing.missing:
        yield (f'The timestamps of the samples have gaps with room for {part.timing.missing} '
               'more.')
    for verdict in part.run.verdicts:
        if verdict.level == 'error':
            yield f'The planner refused a request ({verdict.code}): {verdict.message}'


# Tables --------------------------------------------------------------------------------------

def _table(columns: Mapping[str, str], rows: Sequence[tuple[Any, ...]]) -> Table:
    """Return a table from headings with formats; for a single run without the column of labels."""
    names = tuple(Column(name, form=form) for name, form in columns.items())
    if names[0].name in ('run', 'bag') and len({row[0] for row in rows}) <= 1:
        names, rows = names[1:], [row[1:] for row in rows]
    return Table(names, tuple(rows))


def _setpoints(parts: Sequence[Part]) -> Table:
    """Return the table of setpoints and results."""
    rows: list[tuple[Any, ...]] = []
    for part in parts:
        moves = {x.place: (x, y) for x, y in zip(
            part.evaluation.moves, part.evaluation.results, strict=True)}
        for i, found in enumerate(part.evaluation.findings):
            move, x = moves.get(i, (None, None))
            levels = 0 if move is None else len(move.flux_densities)
            of_move = (math.nan,) * 10 if x is None else (
                x.b_p, x.tau_p, x.b_1, x.begin * 1e3, x.arrival * 1e3, x.settled * 1e3,
                (x.end - x.begin) * 1e3,
                100.0 * x.error, 100.0 * x.residual if x.moved else NOT_MOVED,
                100.0 * x.residual_unshaped)
            share = found.setpoint.percent
            rows.append((
                part.run.label, i + 1, found.setpoint.target,
                verdict_on(part.evaluation, i), share(found.offset),
                share(found.offset_std), share(found.vibration),
                share(found.vibration_std), found.frequency, *of_move,
                'unshaped step' if levels == 1 else f'{levels} levels' if levels else '–'))
    return _table({
            'run': '', 'setpoint': 'd',
            _target(parts): '.6g', 'verdict': '',
            'offset [%]': '+%', '± [%]': '%', 'vibration [%]': '%', '± of it [%]': '%',
            'frequency [Hz]': '.3g',
            'b_p [1]': '.5f', 'tau_p [1]': '.5f', 'b_1 [1]': '.5f', 'begin [ms]': '.3f',
            'arrival [ms]': '.3f', 'settled [ms]': '.3f', 'end [ms]': '.3f',
            'largest error [%]': '%', 'residual [%]': '%', 'unshaped steps [%]': '%',
            'command': ''}, rows)


def _decisive(parts: Sequence[Part]) -> tuple[str, ...]:
    """Return the columns of setpoints that decide, which fit on a phone."""
    return ('run', 'setpoint', _target(parts), 'verdict', 'settled [ms]', 'offset [%]',
            'residual [%]')


def _target(parts: Sequence[Part]) -> str:
    return f'target {parts[0].run.plant.coordinate.symbol} [1]'


def _requests(parts: Sequence[Part], unit: TimeUnit) -> Table:
    """Return the table of verdicts."""
    rows = []
    for part in parts:
        before = None
        for x in part.run.verdicts:
            if (x.code, x.message) != before and x.code != 'none':
                before = x.code, x.message
                rows.append((
                    part.run.label, part.evaluation.seconds(x.sent) / unit.size, x.level, x.code,
                    x.message))
    return _table({
        'run': '', f'time [{unit.name}]': '.3f', 'level': '', 'code': '', 'message': ''},
        rows[:_MOST_ROWS])


def _plan(parts: Sequence[Part], unit: TimeUnit) -> Table:
    """Return the table of planned changes of level."""
    what = parts[0].run.plant.coordinate
    symbol = what.symbol
    rows = [
        (part.run.label, x.time / unit.size, x.planned * 1e3, x.commanded * 1e3,
         x.stretch, x.recorded_stretch, x.rate, x.recorded_rate, x.deviation)
        for part in parts for x in plan_points(part.run, part.evaluation)]
    return _table({
            'run': '', f'time [{unit.name}]': '.4f', 'B planned [mT]': '.4f',
            'B commanded [mT]': '.4f', f'{symbol} planned [1]': '.7f',
            f'{symbol} recorded [1]': '.7f', 'rate planned [1/s]': '.4g',
            'rate recorded [1/s]': '.4g', f'largest |Δ{symbol}| [1]': '.2e'}, rows[:_MOST_ROWS])


def _timing(parts: Sequence[Part]) -> Table:
    """Return the table of leads, delays and intervals."""
    rows = [
        (part.run.label, name, len(values), *np.quantile(values, [0.0, 0.5, 0.99, 1.0]) * 1e3,
         np.std(values) * 1e3)
        for part in parts for name, values in (
            ('command lead', part.timing.lead),
            ('lateness of the command', part.timing.lateness[np.isfinite(part.timing.lateness)]),
            ('sample delay', part.timing.delay),
            ('interval of the timestamps', part.timing.interval),
            ('interval of the recorded samples', part.timing.arrival_interval)) if len(values)]
    return _table({
        'run': '', 'quantity': '', 'count': 'd', 'least [ms]': '.4f', 'median [ms]': '.4f',
        '99 % [ms]': '.4f', 'largest [ms]': '.4f', 'jitter [ms]': '.4f'}, rows)


def _losses(parts: Sequence[Part]) -> Table:
    """Return the table of topics, once for each bag."""
    bags = {x.run.path: x.run for x in reversed(parts)}
    return _table({
        'bag': '', 'topic': '', 'type': '', 'messages': 'd', 'a second': '.1f', 'lost': 'd'}, [
        (run.label, topic.name, topic.type, topic.count,
         math.nan if topic.rate is None else topic.rate,
         'not counted' if topic.lost is None else topic.lost)
        for run in reversed(bags.values()) if run.summary is not None
        for topic in run.summary.topics])


def _given(value: object) -> float | str:
    """Return a constant of a hyperelastic model as shown in a cell; '-' if it has none."""
    if isinstance(value, list) and len(value) > 6:
        return f'{len(value)} values, {min(value):.6g} to {max(value):.6g}'
    if isinstance(value, list):
        return ', '.join(f'{x:.6g}' for x in value)
    return value if isinstance(value, float) else str(value or '-')


def _parameters(parts: Sequence[Part]) -> Table:
    """Return the table of parameters."""
    columns: list[tuple[str, ActuatorParameters]] = []
    for part in parts:
        run = part.run
        source = '' if run.parameters_known else ' (unknown: example block)'
        prefix = f'{run.label}: ' if len(parts) > 1 else ''
        columns += [(f'{prefix}actuator{source}', run.plant)] if run.plant == run.planner else [
            (f'{prefix}plant', run.plant), (f'{prefix}as planned', run.planner)]
    blocks = [x for _, x in columns]
    gent = any(x.law is None for x in blocks)
    groups, laws = [x.nondimensional for x in blocks], [parameters_of(x) for x in blocks]
    limits = [stretch_limits(x) for x in groups]
    name = blocks[0].coordinate.name
    rows = [
        *((field.replace('_', ' '), (spec.unit or '1').replace('^3', '³'),
           *(getattr(x, field) for x in blocks))
          for field, spec in zip(ACTUATOR_FIELDS, ACTUATOR, strict=True)
          if field != 'chain_limit' or gent),
        *((spec.name, spec.unit or '1', *(_given(x.get(spec.name)) for x in laws))
          for spec in LAW if any(spec.name in x for x in laws)),
        *([('bulk modulus over G', '1', *(x.bulk_ratio for x in blocks))]
          if any(math.isfinite(x.bulk_ratio) for x in blocks) else []),
        ('zeta', '1', *(x.zeta for x in groups)),
        (f'critical zeta about {name} {blocks[0].rest:g}', '1', *(
            float(critical_zeta(x.rest, x)) for x in groups)),
        *([('J_lim', '1', *(x.j_lim for x in groups))] if gent else []),
        ('c1', '1', *(x.c1 for x in groups)),
        ('time unit', 'ms', *(x.time_unit * 1e3 for x in blocks)),
        ('flux density of load 1', 'mT', *(x.flux_density_unit * 1e3 for x in blocks)),
        (f'least {name}', '1', *(x for x, _ in limits)),
        (f'largest {name}', '1', *(x for _, x in limits))]
    return Table(
        tuple(map(Column, ('parameter', 'unit', *(x for x, _ in columns)))), tuple(rows))
