"""Faults of time: no /clock, one that jumps back or forward, two of them."""

from benchmarks.faults.common import LIMIT, moves, pair, Register, share
from benchmarks.faults.rig import Rig, settled
from benchmarks.faults.table import Seen
from hmsa.interfaces import topics

FAULTS = Register()
_FOLLOWS = {'use_sim_time': True}
_JUMP_AFTER = 12.0


@FAULTS.fault(
    'clock_none', 'no /clock', 'use_sim_time; a plant publishes time later',
    'request rejected (`no_time`), no commands')
def _none(rig: Rig) -> Seen:
    rig.start('planner', _FOLLOWS)
    rig.ready('planner')
    verdict = rig.setpoint(1.2)
    sent = len(rig.commands)
    rig.start('plant', {'publish_clock': True})
    rig.ready('plant', 'planner')
    worst = moves(rig)
    return Seen(
        f'status {verdict.get("code")}, {sent} commands', share(worst),
        verdict.get('code') == 'no_time' and sent == 0 and worst < LIMIT)


def _jumping(rig: Rig, by: float) -> None:
    """Start plant and planner with a clock that will jump."""
    rig.run('clock', '-m', 'benchmarks.faults.clock', '--jump', f'{_JUMP_AFTER}:{by}')
    rig.start('recorder', {**_FOLLOWS, 'storage.uri': rig.folder / 'bag'})
    pair(rig, plant=_FOLLOWS, planner=_FOLLOWS)


@FAULTS.fault(
    'clock_back', '/clock jumps back', 'by 5 s, in a sequence',
    'plan dropped and reported, plant continues, recorder starts a new file')
def _back(rig: Rig) -> Seen:
    _jumping(rig, -5.0)
    before = rig.time
    rig.sequence([(1.1 + 0.01 * (i % 2), 0.5) for i in range(60)])

    def jumped() -> bool:
        nonlocal before
        last, before = before, rig.time
        return before < last

    rig.spin_until(jumped, 'the jump')
    rig.let_pass(1.0)
    code = rig.verdicts[-1].get('code')
    start = float(rig.samples()[1][-1, 0])
    worst = moves(rig, start=start if abs(start - 1.1) > 0.02 else 1.0)
    files = len(list((rig.folder / 'bag').glob('*.mcap')))
    return Seen(
        f'status {code}, {files} files in the bag', share(worst),
        code is not None and worst < LIMIT and files >= 2)


@FAULTS.fault(
    'clock_forward', '/clock jumps ahead', 'by 20 s, in a sequence',
    'late commands counted, rest re-planned; at the last target in the end')
def _forward(rig: Rig) -> Seen:
    _jumping(rig, 20.0)
    before = rig.time
    rig.sequence([(1.1, 0.5), *((1.2 + 0.01 * (i % 2), 0.5) for i in range(24)), (1.3, 0.5)])

    def jumped() -> bool:
        nonlocal before
        last, before = before, rig.time
        return before - last > 10 * 10**9

    rig.spin_until(jumped, 'the jump')
    rig.let_pass(1.5)
    rig.fresh('planner')
    _, error = settled(*rig.samples(), rig.applied, 1.3, 0.1)
    late = rig.value('planner', 'late')
    worst = moves(rig, start=1.3)
    return Seen(
        f'{late:g} commands late, then {error:.0e} from the last target', share(worst),
        late > 0 and error < 1e-3 and worst < LIMIT)


@FAULTS.fault(
    'clock_two', 'two publishers of /clock', 'a second one, 1000 s ahead, for 3 s',
    'reported; no node ends')
def _two(rig: Rig) -> Seen:
    rig.run('clock', '-m', 'benchmarks.faults.clock')
    pair(rig, plant=_FOLLOWS, planner=_FOLLOWS)
    quiet = max(rig.level('planner'), rig.level('plant'))
    moves(rig, (1.1,))
    second = rig.run('clock_second', '-m', 'benchmarks.faults.clock', '--start', '1100')
    rig.spin_until(
        lambda: rig.node.count_publishers(topics.CLOCK_TOPIC.name) == 2, 'the second clock')
    worst = 0
    for _ in range(3):
        rig.spin(1.0)
        worst = max(worst, rig.level('planner'), rig.level('plant'))
    second.end()
    rig.spin_until(
        lambda: rig.node.count_publishers(topics.CLOCK_TOPIC.name) == 1,
        'the second clock to go')
    rig.spin(1.0)
    rig.setpoint(1.05)
    rig.let_pass(1.0)
    residual = moves(rig, start=1.05)
    return Seen(
        f'diagnostics {quiet} before, {worst} with two', share(residual),
        quiet == 0 and worst >= 1 and residual < LIMIT)
