"""A scene as text: a screen for a terminal, a line for a log, or JSON for a program."""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from rich.cells import cell_len
from rich.text import Text

from hmsa_ros.files import finite
from hmsa_ros.model.equations import Array
from hmsa_ros.model.laws.coordinate import drive_of, shared_name
from hmsa_ros.model.status import Code
from hmsa_ros.watch.scene import Joint, LEVELS, Report, Scene

# Bits of a Braille cell, by row from the top and by column.
_BITS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_BRAILLE = 0x2800


@dataclass(frozen=True)
class Strip:
    """
    A chart of one value and its target, by rows from the top.

    ``targets`` contains the columns of each row that only show the target, for another colour.
    """

    rows: tuple[str, ...]
    targets: tuple[tuple[int, ...], ...]


def dots(braille: bool) -> tuple[int, int]:
    """Return the number of columns and rows of dots in a character."""
    return (2, 4) if braille else (1, 1)


def limits(*values: Array, least: float) -> tuple[float, float]:
    """Return the limits of an axis with a margin around the values; NaN is ignored."""
    known = np.concatenate([x[np.isfinite(x)] for x in values])
    if not len(known):
        return 1.0 - 0.5 * least, 1.0 + 0.5 * least
    low, high = float(known.min()), float(known.max())
    room = max(0.05 * (high - low), 0.5 * (least - (high - low)), 0.0)
    return low - room, high + room


def strip(
        value: tuple[Array, Array], target: tuple[Array, Array], height: int,
        edges: tuple[float, float], *, braille: bool) -> Strip:
    """Draw minimum and maximum in each column of dots (NaN for none) between two edges."""
    across, down = dots(braille)
    columns = len(value[0])
    lines = height * down
    width = -(-columns // across)
    low, high = edges

    # Set dots of value and target, padded to whole characters.
    shown = np.zeros((2, lines, width * across), dtype=bool)
    place = np.arange(lines)[:, None]
    for kind, (least, largest) in enumerate((value, target)):
        known = np.isfinite(least) & np.isfinite(largest)
        top, bottom = (
            np.clip(np.rint((1.0 - (np.where(known, x, low) - low) / (high - low))
                            * (lines - 1)), 0, lines - 1) for x in (largest, least))
        if kind == 0:
            hit = (place >= top) & (place <= bottom)
        else:
            hit = (place == top) | (place == bottom)
            if braille:
                # Dashed, to be distinguishable without colour.
                hit &= np.arange(columns) % 3 > 0
        shown[kind, :, :columns] = hit & known
    cells = shown.reshape(2, height, down, width, across)
    ours, theirs = cells[0].any(axis=(1, 3)), cells[1].any(axis=(1, 3))
    if braille:
        # The value covers the target.
        dot = np.where(ours[:, None, :, None], cells[0], cells[1])
        codes = _BRAILLE + np.einsum('hdwa,da->hw', dot, np.array(_BITS))
        rows = [''.join(map(chr, row)) for row in codes.tolist()]
    else:
        marks = np.where(ours, '*', np.where(theirs, '-', ' '))
        rows = [''.join(row) for row in marks.tolist()]
    alone = theirs & ~ours
    return Strip(
        tuple(rows), tuple(tuple(np.flatnonzero(x).tolist()) for x in alone))


#: Counters of problems, which are shown first, and in the line.
TROUBLES = ('late', 'replanned', 'lost', 'refused', 'failed', 'timeouts')
# Levels are shown by word and colour, never by colour alone.
_STYLES = ('green', 'yellow', 'bold red', 'yellow')
_VALUE, _TARGET, _SOFT, _WAITING = 'cyan', 'magenta', 'dim', 'bold yellow'
# Width of the axis beside a chart.
_GUTTER = 10
# Rows of a joint with its own chart: text and axis, minimum and maximum of the chart.
_TEXT_ROWS, _CHART_ROWS, _MOST_CHART_ROWS = 3, 3, 24
# Extra lines of a table: its header, and the number of joints not shown.
_ENDS = 2
# Width of a position and its name in a table.
_WIDE = 10
# Smallest range of a chart's axis.
_LEAST_RANGE = 1e-3
_MOST_REPORTS = 4
# Divisor of the rows for the maximum height of a warning, and that of other messages in rows;
# indent by the name and the level.
_SHARE, _WORDS, _INDENT = 6, 2, 15
# Time in s without a report, normally one a second, after which a node is silent.
SILENT_AFTER = 3.5


def number(value: float, form: str = '.5f') -> str:
    """Return a number as text; a question mark if unknown."""
    return f'{value:{form}}' if math.isfinite(value) else '?'


def _level(value: float, joint: Joint) -> str:
    return joint.drive.text(value, '+.3f') if math.isfinite(value) else '?'


def _error(joint: Joint) -> str:
    return number(joint.stretch - joint.target, '+.1e')


class Screen:
    """Format scenes for a terminal, with charts of ``span`` seconds, in ASCII or Unicode."""

    def __init__(self, span: float, *, unicode: bool = True) -> None:
        self._span = span
        self._unicode = unicode

    def lines(self, scene: Scene, width: int, height: int) -> list[Text]:
        """Return a frame of at most ``height`` lines of at most ``width`` characters."""
        foot = self._foot(scene, width, height // _SHARE)
        head = [self._head(scene, width)]
        room = height - len(head) - len(foot)
        lines = [*head, *self._joints(scene, width, max(room, 1)), *foot][:max(height, 1)]
        for line in lines:
            line.no_wrap, line.overflow = True, 'crop'
            line.truncate(width)
        return lines

    # -- parts ---------------------------------------------------------------------------------

    def _head(self, scene: Scene, width: int) -> Text:
        left = f'hmsa watch  {scene.where}'
        right = ['q ends']
        if not math.isnan(scene.stamp):
            right.insert(0, _time(scene.stamp))
        if math.isfinite(scene.sample_rate):
            right.insert(-1, f'{scene.sample_rate:.0f} samples/s')
        while len(right) > 1 and cell_len(left) + 2 + len('  '.join(right)) > width:
            right.pop(0)
        end = '  '.join(right)
        space = max(width - cell_len(left) - len(end), 2)
        return Text(left + ' ' * space + end, style='bold')

    def _foot(self, scene: Scene, width: int, rows: int) -> list[Text]:
        lines = [Text(('─' if self._unicode else '-') * width, style=_SOFT)]
        request = scene.request
        if request is not None:
            count = f'setpoint {request.setpoint} of {request.setpoints}  ' \
                if request.setpoints else ''
            line = Text(f'plan     {count}{request.state.replace("_", " ")}')
            room = width - cell_len(line.plain) - len('   100 %')
            if math.isfinite(scene.progress) and room > 0:
                line.append('  ').append(self._bar(scene.progress, min(room, max(width - 60, 10))))
                line.append(f' {100.0 * scene.progress:.0f} %')
            lines.append(line)
            lines += _judged('verdict', request.level, request.message, width, rows)
            if request.finding and request.finding not in request.message:
                lines += _judged(
                    'measured', int(request.measured != Code.ARRIVED), request.finding, width,
                    rows)
        for report in scene.reports[:_MOST_REPORTS]:
            silent = report.age > SILENT_AFTER
            lines += _judged(
                report.name, 3 if silent else report.level,
                (f'silent for {report.age:.0f} s' if silent else report.message)
                + _counts(report), width, rows)
        for sentence in scene.waiting:
            lines += [Text(row, style=_WAITING) for row in _wrapped(sentence, width)]
        return lines

    def _bar(self, share: float, width: int) -> str:
        done = round(min(max(share, 0.0), 1.0) * width)
        full, empty = ('━', '┄') if self._unicode else ('#', '.')
        return full * done + empty * (width - done)

    def _joints(self, scene: Scene, width: int, room: int) -> list[Text]:
        joints = scene.joints
        if not joints:
            return []
        each = room // len(joints)
        if each < _TEXT_ROWS + _CHART_ROWS and len(joints) > 1:
            return self._table(scene, width, room)
        rows = min(each - _TEXT_ROWS, _MOST_CHART_ROWS)
        lines: list[Text] = []
        for joint in joints:
            lines += self._joint(joint, scene.now, width, max(rows, 1))[:each]
        return lines

    def _joint(self, joint: Joint, now: float, width: int, rows: int) -> list[Text]:
        first = _fitted(width, [
            (joint.name, 'bold'), (f'{joint.coordinate} {number(joint.stretch)}', _VALUE),
            (f'target {number(joint.target)}', _TARGET), (f'error {_error(joint)}', ''),
            (f'rate {number(joint.rate, "+.3f")} 1/s', '')])
        second = _fitted(width, [
            (f'{joint.drive.name} {_level(joint.flux_density, joint)}', ''),
            (f'commanded {_level(joint.commanded, joint)}', '')])
        chart, (low, high) = self._chart(joint, now, max(width - _GUTTER, 1), rows)
        lines = []
        for i, row in enumerate(chart):
            label = {0: f'{high:.4f}', rows - 1: f'{low:.4f}'}.get(i, '')
            line = Text(f'{label:>{_GUTTER - 2}} ', style=_SOFT)
            line.append('│' if self._unicode else '|')
            lines.append(line.append(row))
        return [first, second, *lines, self._axis(width)]

    def _axis(self, width: int) -> Text:
        """Return the time axis below a chart, in s before now."""
        rule, corner = ('─', '└') if self._unicode else ('.', '+')
        across = max(width - _GUTTER, 1)
        drawn = [rule] * across
        # Labels begin at their time, and the last one ends there; overlapping ones are omitted.
        for place, label in [(across - len('now'), 'now'), *(
                (i * across // 4, f'{-self._span * (1.0 - i / 4.0):g} s') for i in (0, 2, 1, 3))]:
            if place >= 0 and all(x == rule for x in drawn[place:place + len(label) + 1]):
                drawn[place:place + len(label)] = label
        return Text(f'{"":>{_GUTTER - 1}}{corner}{"".join(drawn)}', style=_SOFT)

    def _chart(
            self, joint: Joint, now: float, width: int, rows: int
    ) -> tuple[list[Text], tuple[float, float]]:
        """Return a chart, and its lower and upper limits."""
        columns = width * dots(self._unicode)[0]
        value, target = (x.ranges(now, columns) for x in (joint.stretches, joint.targets))
        edges = limits(*value, *target, least=_LEAST_RANGE)
        drawn = strip(value, target, rows, edges, braille=self._unicode)
        texts = []
        for row, alone in zip(drawn.rows, drawn.targets, strict=True):
            texts.append(Text(row, style=_VALUE))
            for column in alone:
                texts[-1].stylize(_TARGET, column, column + 1)
        return texts, edges

    def _table(self, scene: Scene, width: int, room: int) -> list[Text]:
        """Return a line for each joint, with a chart of one row at its end."""
        wide = min(max(len(x.name) for x in scene.joints), 16)
        name = shared_name(x.coordinate for x in scene.joints)
        level = drive_of(name).name
        lines = [Text(
            f'{"joint":<{wide}} {name:>{_WIDE}} {"target":>8} {"error":>8} {level:>13}',
            style=_SOFT)]
        if room <= _ENDS:
            # No room for a header.
            lines = []
        shown = list(scene.joints)
        if len(shown) > room - len(lines):
            shown = shown[:max(room - len(lines) - 1, 0)]
        for joint in shown:
            line = Text(f'{joint.name[:wide]:<{wide}} ')
            line.append(f'{number(joint.stretch):>{_WIDE}}', style=_VALUE)
            line.append(f' {number(joint.target):>8}', style=_TARGET)
            line.append(f' {_error(joint):>8} {_level(joint.flux_density, joint):>13} ')
            across = width - cell_len(line.plain)
            if across > 0:
                line.append(self._chart(joint, scene.now, across, 1)[0][0])
            lines.append(line)
        hidden = len(scene.joints) - len(shown)
        if hidden:
            lines.append(Text(
                f'and {hidden} more: name some with --joint', style=_SOFT))
        return lines


def _fitted(width: int, parts: Sequence[tuple[str, str]]) -> Text:
    """Return the parts of a line, each with its style, that fit completely; at least the first."""
    line = Text()
    for words, style in parts:
        gap = '  ' if line.plain else ''
        if line.plain and cell_len(line.plain) + len(gap) + cell_len(words) > width:
            break
        line.append(gap).append(words, style=style or None)
    return line


def _judged(name: str, level: int, message: str, width: int, rows: int) -> list[Text]:
    """Return a level and its message, which may take several rows if it is not OK."""
    level = min(max(level, 0), len(LEVELS) - 1)
    first = Text(f'{name:<8} ')
    first.append(f'{LEVELS[level]:<5} ', style=_STYLES[level])
    begin, *rest = _wrapped(
        message, width - _INDENT, max(min(rows, _WORDS) if level == 0 else rows, 1)) or ['']
    return [first.append(begin), *(Text(' ' * _INDENT + x) for x in rest)]


def _counts(report: Report) -> str:
    names = sorted(report.counts, key=lambda x: x not in TROUBLES)
    return ''.join(f', {name.replace("_", " ")} {report.counts[name]}' for name in names)


def _wrapped(sentence: str, width: int, rows: int | None = None) -> list[str]:
    from textwrap import wrap
    return wrap(sentence, max(width, 10), max_lines=rows, placeholder=' ...')


def _time(stamp: float) -> str:
    """Return a timestamp as the time of day, or in seconds for simulated time."""
    if stamp < 1e8:
        return f'{stamp:.3f} s (simulated)'
    from datetime import datetime
    return datetime.fromtimestamp(stamp).strftime('%H:%M:%S')


def line(scene: Scene) -> str:
    """Return a scene as one line of plain text, without a newline."""
    parts = [] if math.isnan(scene.stamp) else [_time(scene.stamp)]
    parts += [
        f'{x.name} {number(x.stretch)} (target {number(x.target)}, '
        f'{_level(x.flux_density, x)})' for x in scene.joints]
    if scene.request is not None:
        request = scene.request
        count = f' {request.setpoint}/{request.setpoints}' if request.setpoints else ''
        parts.append(
            f'{request.state.replace("_", " ")}{count}, {LEVELS[min(request.level, 3)]} '
            f'{request.message}')
    for report in scene.reports:
        troubles = [f'{x} {report.counts[x]}' for x in TROUBLES if report.counts.get(x)]
        if troubles or report.level:
            parts.append(f'{report.name}: ' + ', '.join([report.message, *troubles]))
    parts += scene.waiting
    return '; '.join(parts)


def as_json(scene: Scene) -> dict[str, Any]:
    """Return a scene for JSON, with None for unknown values."""
    request = scene.request
    found: dict[str, Any] = finite({
        'where': scene.where, 'stamp': scene.stamp, 'age': scene.age,
        'sample_rate': scene.sample_rate,
        'joints': [{
            'name': x.name, 'stretch': x.stretch, 'stretch_rate': x.rate,
            'flux_density': x.flux_density, 'target': x.target,
            'flux_density_command': x.commanded} for x in scene.joints],
        'request': request and {
            'level': LEVELS[min(request.level, 3)], 'message': request.message,
            'code': request.code, 'state': request.state, 'setpoint': request.setpoint,
            'setpoints': request.setpoints, 'finding': dict(request.figures) or None},
        'progress': scene.progress,
        'reports': [{
            'name': x.name, 'level': LEVELS[min(x.level, 3)], 'message': x.message,
            'counts': x.counts, 'age': x.age} for x in scene.reports],
        'waiting': list(scene.waiting)})
    return found
