"""Faults of delivery: load, delay, loss, duplication and reordering of commands."""

from dataclasses import replace

import numpy as np

from benchmarks.faults.common import (
    await_change,
    LEAD,
    LIMIT,
    move,
    moves,
    pair,
    Register,
    share,
)
from benchmarks.faults.rig import Rig
from benchmarks.faults.table import Seen

FAULTS = Register()
_SLOW = 0.05
# In Hz; late commands take effect at the plant's next sample.
_FINE = 1e4
# Allowed residual of a move that is late as a whole, caused by the relay's own jitter: 0.008 on an
# idle machine, 0.08 on a busy one.
_ALIKE = 0.1
# Largest stretch beyond the target of a shaped move, for samples and their rounding.
_BEYOND = 1e-3
# Time by which a replanned move has been executed.
_AFTER_NS = round((LEAD + 0.03) * 1e9)


@FAULTS.fault(
    'none', 'none', 'five moves in real time', 'none')
def _none(rig: Rig) -> Seen:
    pair(rig)
    worst = moves(rig)
    return Seen('all as planned', share(worst), worst < LIMIT)


def _loaded(rig: Rig, lead: float) -> Seen:
    pair(rig, planner={'lead_time': lead})
    rig.load(4)
    worst = moves(rig, pause=0.3 + lead)
    rig.fresh('plant', 'planner')
    late = rig.value('plant', 'late')
    return Seen(f'{late:g} commands late', share(worst), worst < LIMIT and late == 0)


for _key, _lead in (('load', 0.2), ('load_default', LEAD)):
    FAULTS.add(
        _key, 'both cores loaded', f'four busy processes, lead_time {_lead:g} s', 'none late',
        _loaded, _lead)


def _delayed(rig: Rig, part: float) -> Seen:
    # In slow motion, a twentieth of lead_time is 50 ms of wall time, more than the delay added by
    # the relay and DDS.
    remap = rig.relay('--delay', str(part * LEAD / _SLOW))
    pair(rig, slow=_SLOW, remap=remap, planner={'lead_time': LEAD})
    worst = moves(rig, (1.2, 1.0), pause=0.15)
    rig.fresh('plant')
    late = rig.value('plant', 'late')
    return Seen(f'{late:g} commands late', share(worst), worst < LIMIT and late == 0)


for _part in (0.0, 0.5, 0.95):
    FAULTS.add(
        f'delay_{_part:g}', f'commands delayed by {_part:g} lead_time', 'relay, slow motion',
        'none late', _delayed, _part)


@FAULTS.fault(
    'delay_beyond', 'a move delayed by 1.5 lead_time',
    'relay', f'late commands counted; all equally late: same plan, residual below {_ALIKE:g}')
def _delay_beyond(rig: Rig) -> Seen:
    remap = rig.relay('--delay', str(1.5 * LEAD / _SLOW), '--first', '2')
    pair(rig, slow=_SLOW, remap=remap, planner={'lead_time': LEAD}, plant={'publish_rate': _FINE})
    residual, error = move(rig, 1.2, start=1.0, pause=0.6)
    rig.fresh('plant', 'planner')
    late, known = rig.value('plant', 'late'), rig.value('planner', 'late')
    return Seen(
        f'{late:g} late at the plant, {known:g} at the planner, '
        f'{rig.value("planner", "replanned"):g} re-planned, error {error:.0e}', share(residual),
        late > 0 and known > 0 and error < LIMIT and residual < _ALIKE)


@FAULTS.fault(
    'delay_always', 'all commands delayed by 1.5 lead_time', 'relay',
    'late commands counted, WARN by both nodes, at the target in the end; any residual')
def _delay_always(rig: Rig) -> Seen:
    remap = rig.relay('--delay', str(1.5 * LEAD / _SLOW))
    pair(rig, slow=_SLOW, remap=remap, planner={'lead_time': LEAD})
    residual, error = move(rig, 1.2, start=1.0, pause=0.6)
    rig.fresh('plant', 'planner')
    late, known = rig.value('plant', 'late'), rig.value('planner', 'late')
    warned = min(rig.level('plant'), rig.level('planner'))
    return Seen(
        f'{late:g} late at the plant, {known:g} at the planner, '
        f'{rig.value("planner", "replanned"):g} re-planned, error {error:.0e}',
        share(residual), late > 0 and known > 0 and warned >= 1 and error < 1e-3)


@FAULTS.fault(
    'drop', 'a command lost', 'relay drops the second of a move',
    'no heartbeat carries the level, which would be late; the planner re-plans')
def _drop(rig: Rig) -> Seen:
    remap = rig.relay('--drop', '2')
    pair(rig, remap=remap, planner={'lead_time': LEAD})
    return _learnt(rig)


@FAULTS.fault(
    'drop_move', 'all commands of a move lost',
    'relay drops both, but no heartbeat; heartbeat_period 0.01 s',
    'no heartbeat carries the last level in one step; the planner re-plans a shaped move')
def _drop_move(rig: Rig) -> Seen:
    remap = rig.relay('--drop', '1,2')
    pair(rig, remap=remap, planner={'lead_time': LEAD, 'heartbeat_period': 0.01})
    mark = rig.count()
    seen = _learnt(rig)
    # One step from 1 to 1.2 swings beyond it by most of its size.
    beyond = float(rig.samples(mark)[1][:, 0].max()) - 1.2
    return replace(seen, text=f'{seen.text}, {beyond:.0e} beyond the target',
                   met=seen.met and beyond < _BEYOND)


@FAULTS.fault(
    'reorder', 'two commands in the wrong order', 'relay sends the second one first',
    'the earlier timestamp supersedes the later one, as if that were lost; re-planned')
def _reorder(rig: Rig) -> Seen:
    remap = rig.relay('--swap')
    pair(rig, remap=remap, planner={'lead_time': LEAD})
    return _learnt(rig)


def _learnt(rig: Rig) -> Seen:
    mark, first = rig.count(), len(rig.applied)
    rig.setpoint(1.2)
    await_change(rig, mark)
    rig.let_pass(1.2)
    rig.fresh('planner')
    stamps, values = rig.samples(mark)
    # Use the plant's reports, since a level may be in force for less than a sample. The replanned
    # levels take effect lead_time after the planner learns of the loss; without them, vibration
    # would fall to a hundredth by then.
    changes = [stamp for stamp, _ in rig.applied[first:]]
    if len(changes) < 2:
        return Seen(f'{len(changes)} changes in force: expected at least 2', '-', False)
    rest = values[stamps > max(changes[1] + _AFTER_NS, changes[-1]), 0]
    residual, error = float(np.ptp(rest)) / 0.2, abs(float(rest[-1]) - 1.2) / 0.2
    late, replanned = rig.value('planner', 'late'), rig.value('planner', 'replanned')
    return Seen(
        f'{late:g} late, {replanned:g} re-planned, error {error:.0e}', share(residual),
        replanned > 0 and max(residual, error) < LIMIT)


@FAULTS.fault(
    'twice', 'commands doubled', 'relay sends each command twice',
    'one change of level per command')
def _twice(rig: Rig) -> Seen:
    remap = rig.relay('--twice')
    pair(rig, remap=remap)
    before = len(rig.applied)
    worst = moves(rig)
    changes = len(rig.applied) - before
    return Seen(f'{changes} changes in five moves', share(worst),
                worst < LIMIT and changes == 10)
