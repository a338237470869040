"""State of a run at one moment, also as a line for a log, or JSON for a program."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
import math
from typing import Any

import numpy as np

from hmsa.files import finite
from hmsa.interfaces.status import StatusVerdict
from hmsa.model.equations import Array
from hmsa.model.laws.coordinate import POSITION
from hmsa.model.units import flux_text

#: Number of slots of a chart.
SLOTS = 480
#: Names of the levels of diagnostics and verdicts.
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
#: Counters of problems, the only ones in a line.
TROUBLES = ('late', 'replanned', 'lost', 'refused', 'failed', 'timeouts')
# Time in s without a report, normally one a second, after which a node is silent.
_SILENT_AFTER = 3.5


class PeakHistory:
    """Minimum and maximum in each slot of the last ``span`` seconds, so that peaks are kept."""

    def __init__(self, span: float, slots: int = SLOTS) -> None:
        self._slot = span / slots
        self._low = np.full(slots, np.nan)
        self._high = np.full(slots, np.nan)
        self._newest = 0

    def put(self, before: float, now: float, values: Array) -> None:
        """Add samples from between two looks (times in s), assumed evenly spaced."""
        self._advance(now)
        count = len(self._low)
        times = before + (now - before) * np.arange(1, len(values) + 1) / max(len(values), 1)
        slots = np.floor(times / self._slot).astype(np.int64)
        kept = slots > self._newest - count
        np.fmin.at(self._low, slots[kept] % count, values[kept])
        np.fmax.at(self._high, slots[kept] % count, values[kept])

    def hold(self, before: float, now: float, value: float) -> None:
        """Add a value that was constant between two looks (times in s)."""
        before = max(before, now - self._slot * (len(self._low) + 1))
        self.put(before, now, np.full(math.ceil((now - before) / self._slot) + 1, value))

    def _advance(self, now: float) -> None:
        newest, count = math.floor(now / self._slot), len(self._low)
        begun = np.arange(max(self._newest, newest - count) + 1, newest + 1) % count
        self._low[begun] = self._high[begun] = np.nan
        self._newest = max(newest, self._newest)

    def ranges(self, now: float) -> tuple[Array, Array]:
        """Return minima and maxima by slot up to ``now`` in s; NaN if empty."""
        self._advance(now)
        count = len(self._low)
        order = np.arange(self._newest - count + 1, self._newest + 1) % count
        return self._low[order], self._high[order]


@dataclass
class JointView:
    """
    One actuator: newest sample, target and command (in SI, NaN if unknown), and its charts.

    ``coordinate`` is the name of its position coordinate, as far as known.
    """

    name: str
    stretches: PeakHistory
    targets: PeakHistory
    stretch: float = math.nan
    rate: float = math.nan
    flux_density: float = math.nan
    target: float = math.nan
    commanded: float = math.nan
    coordinate: str = POSITION
    fluxes: PeakHistory = field(default_factory=lambda: PeakHistory(10.0))


@dataclass
class Report:
    """Report of a node's health, with the index in `LEVELS`, and its age in s."""

    name: str
    level: int
    message: str
    counts: dict[str, int]
    age: float = 0.0


@dataclass
class Scene:
    """
    State at one moment; unknown numbers are NaN.

    ``now`` is the steady time of this look in s, ``stamp`` the time of the newest sample, which
    arrived ``age`` s ago. ``progress`` is the completed fraction of the plan, ``waiting`` contains
    a sentence for each missing item.
    """

    where: str
    now: float = 0.0
    stamp: float = math.nan
    age: float = math.nan
    sample_rate: float = math.nan
    joints: Sequence[JointView] = field(default_factory=list)
    request: StatusVerdict | None = None
    progress: float = math.nan
    reports: Sequence[Report] = field(default_factory=list)
    waiting: Sequence[str] = field(default_factory=list)


def line(scene: Scene) -> str:
    """Return a scene as one line of plain text, without a newline."""
    parts = [] if math.isnan(scene.stamp) else [_time(scene.stamp)]
    parts += [
        f'{x.name} {_number(x.stretch)} (target {_number(x.target)}, {_level(x)})'
        for x in scene.joints]
    request = scene.request
    if request is not None:
        count = f' {request.setpoint}/{request.setpoints}' if request.setpoints else ''
        parts.append(
            f'{request.state.replace("_", " ")}{count}, {LEVELS[min(request.level, 3)]} '
            f'{request.message}')
        if request.finding not in request.message:
            parts.append(request.finding)
    for report in scene.reports:
        if report.age > _SILENT_AFTER:
            parts.append(f'{report.name}: silent for {report.age:.0f} s')
            continue
        troubles = [f'{x} {report.counts[x]}' for x in TROUBLES if report.counts.get(x)]
        if troubles or report.level:
            parts.append(f'{report.name}: ' + ', '.join([report.message, *troubles]))
    parts += scene.waiting
    return '; '.join(parts)


def _number(value: float) -> str:
    """Return a number as text; a question mark if unknown."""
    return f'{value:.5f}' if math.isfinite(value) else '?'


def _level(joint: JointView) -> str:
    value = joint.flux_density
    return flux_text(value, '+.3f') if math.isfinite(value) else '?'


def _time(stamp: float) -> str:
    """Return a timestamp as the time of day, or in seconds for simulated time."""
    if stamp < 1e8:
        return f'{stamp:.3f} s (simulated)'
    return datetime.fromtimestamp(stamp).strftime('%H:%M:%S')


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
