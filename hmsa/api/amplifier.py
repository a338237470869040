"""Amplifiers compared for a plan: slew rate, bandwidth, current, voltage and time lost."""

from collections.abc import Sequence
from inspect import signature
import math
from typing import Any, TYPE_CHECKING

import numpy as np

from hmsa.api.arguments import check_names, number, numbers, several
from hmsa.errors import BadInputError
from hmsa.model.equations import Array
from hmsa.model.simulation import response
from hmsa.model.status import RefusedError
from hmsa.table import Column, Table

if TYPE_CHECKING:
    from hmsa.api.actuator import Actuator
    from hmsa.api.plan import Plan

# Range of the slew rates and bandwidths to try, relative to those at which the largest step of the
# ideal plan takes as long as its fastest move.
_SLOWEST, _FASTEST = 0.1, 15.0
_DECADE = (1.0, 2.0, 5.0)
# Optional coil data and their units.
_COIL = {'inductance': 'H', 'resistance': 'ohm', 'tesla_per_ampere': 'T/A'}
# Columns and their descriptions; the last four need data of the coil, the last two all of them.
_COLUMNS = (
    (Column('slew', 'T/s', '.4g'), 'slew rate of the ramps'),
    (Column('bandwidth', 'Hz', '.4g'), 'that of a first-order lag'),
    (Column('longest move', 'ms', '.4g'), ''),
    (Column('lost', 'ms', '.3g'), 'additional time of the longest move, relative to ideal steps'),
    (Column('field', 'mT', '.4g'), 'largest magnitude of a level'),
    (Column('current', 'A', '.3g'), 'current of this field'),
    (Column('change', 'A/s', '.3g'), 'largest rate of the current'),
    (Column('voltage', 'V', '.3g'), 'largest magnitude of L dI/dt + R I'),
    (Column('power', 'W', '.3g'), 'this voltage times the largest current'))


def amplifiers(
        actuator: 'Actuator', setpoints: Any, *, slew_limits: Sequence[float] | None = None,
        bandwidths: Sequence[float] | None = None, **more: Any) -> Table:
    """
    Plan a sequence for amplifiers from fast to slow; see `Actuator.amplifiers`.

    Raises
    ------
    BadInputError
        If an argument has the wrong type or is out of range.

    """
    check_names('Actuator.amplifiers', more, [
        'slew_limits', 'bandwidths', *_COIL,
        *(x for x in signature(actuator.plan).parameters if x != 'setpoints')])
    given = {x: more.pop(x, None) for x in _COIL}
    coil = {
        x: number(y, x, _COIL[x], above=0.0) for x, y in given.items() if y is not None}
    if coil and 'tesla_per_ampere' not in coil:
        raise BadInputError(
            'tesla_per_ampere is missing: expected it with inductance and resistance')
    ideal = actuator.replace(slew_limit=math.inf, coil_time_constant=0.0)
    best = ideal.plan(setpoints, **more)
    fastest = float(np.min(best.move_times))
    before = ideal.flux_density(best.segments[0].start.stretch)
    swing = float(np.max(np.abs(np.diff(np.append(before, best.flux_densities)))))
    if not 0.0 < fastest < math.inf or not swing:
        raise BadInputError(
            f'shaper {best.shaper} does not end this move in a finite time: expected one that '
            'does, such as two_step')
    if slew_limits is None:
        slew_limits = _series(swing / fastest)
    rows = [_row(best, best, math.inf, math.inf, coil)]
    notes = []
    if bandwidths is None:
        bandwidths = _series(1.0 / fastest)
        if len(coil) == len(_COIL):
            own = coil['resistance'] / (2.0 * math.pi * coil['inductance'])
            bandwidths = sorted({*bandwidths, own}, reverse=True)
            notes.append(
                f'{own:.4g} Hz is the bandwidth of the coil itself, R/(2 pi L), on an amplifier '
                'that sets voltages and not currents')
    slew_limits, bandwidths = (numbers(several(x), y, unit=z).ravel().tolist() for x, y, z in (
        (slew_limits, 'slew limits', 'T/s'), (bandwidths, 'bandwidths', 'Hz')))
    for slew, band in [*((x, math.inf) for x in slew_limits), *(
            (math.inf, x) for x in bandwidths)]:
        try:
            plan = ideal.replace(
                slew_limit=slew, coil_time_constant=0.0 if math.isinf(band) else 0.5 / (
                    math.pi * number(band, 'bandwidth', 'Hz', above=0.0))).plan(setpoints, **more)
        except RefusedError as error:
            rows.append((slew, band, *(None for _ in rows[0][2:])))
            named = f'{slew:g} T/s' if math.isinf(band) else f'{band:g} Hz'
            notes.append(f'{named}: {error}')
            continue
        rows.append(_row(plan, best, slew, band, coil))
    shown = _COLUMNS[:len(rows[0])]
    return Table(
        tuple(x for x, _ in shown), tuple(rows), '∞: no limit', tuple(notes),
        tuple((x.name, words) for x, words in shown if words))


def _series(middle: float) -> list[float]:
    """Return round numbers around the given one, the largest first."""
    decades = range(
        math.floor(math.log10(_SLOWEST * middle)), math.ceil(math.log10(_FASTEST * middle)) + 1)
    found = [x * 10.0 ** y for y in decades for x in _DECADE]
    return [float(f'{x:g}') for x in reversed(found)
            if _SLOWEST * middle <= x <= _FASTEST * middle]


def _row(
        plan: 'Plan', best: 'Plan', slew: float, band: float,
        coil: dict[str, float]) -> tuple[Any, ...]:
    """Return the demands of a plan on an amplifier: one row of the table."""
    longest, lost = (1e3 * float(np.max(x)) for x in (
        plan.move_times, plan.move_times - best.move_times))
    most = float(np.max(np.abs(plan.flux_densities)))
    row: tuple[Any, ...] = (slew, band, longest, lost, 1e3 * most)
    if 'tesla_per_ampere' not in coil:
        return row
    factor = coil['tesla_per_ampere']
    # The field at the start of each level, and at the start of the next one.
    fields = response(
        plan.actuator.block, plan.actuator.model.delivery, plan.times, plan.flux_densities,
        np.append(plan.times, plan.times[-1] + 1.0), plan.segments[0].start.stretch)[2]
    change: Array = np.full(2, slew / factor)
    current: Array = np.array([most, -most]) / factor
    if not math.isinf(band):
        at = np.concatenate([fields[:-1], fields[1:]])
        wanted = np.concatenate([plan.flux_densities] * 2)
        change = 2.0 * math.pi * band * (wanted - at) / factor
        current = at / factor
    row += (most / factor, float(np.max(np.abs(change))))
    if len(coil) == len(_COIL):
        volts = float(np.max(np.abs(
            coil['inductance'] * change + coil['resistance'] * current)))
        row += (volts, volts * most / factor)
    return row
