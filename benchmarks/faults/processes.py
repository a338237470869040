"""Faults of processes: killed, stopped and restarted nodes, a full disk, an idle lifecycle."""

from pathlib import Path
import signal
import subprocess
from time import time_ns

import numpy as np
from std_msgs.msg import Float64

from benchmarks.faults.common import (
    await_change,
    jump,
    LIMIT,
    move,
    moves,
    pair,
    PATIENT_LEAD,
    Register,
    share,
)
from benchmarks.faults.rig import Rig, settled
from benchmarks.faults.table import Seen
from hmsa.bag.reader import BagReader
from hmsa.bag.writer import recover
from hmsa.interfaces import topics

FAULTS = Register()
_TIMEOUT = 0.5
_RAMP = 0.05


@FAULTS.fault(
    'planner_killed', 'planner killed in mid-move, restarted',
    'slow motion, between the two commands of 1 -> 1.2; a new planner, request of 1.1',
    'the field changes only after the request; the move starts from the actual state')
def _planner_killed(rig: Rig) -> Seen:
    # 2 ms ahead is 0.4 s of wall time; the move takes 6 ms, 1.2 s of wall time.
    follows = {'use_sim_time': True, 'lead_time': 0.002}
    rig.start('plant', {
        'publish_clock': True, 'real_time_factor': 0.005, 'publish_rate': 10_000.0})
    planner = rig.start('planner', follows)
    rig.ready('plant', 'planner')
    mark = rig.count()
    rig.setpoint(1.2)
    await_change(rig, mark)
    planner.end(signal.SIGKILL)
    killed = rig.count()
    before = len(rig.verdicts)
    rig.start('planner', follows)
    rig.spin_until(lambda: len(rig.verdicts) > before, 'the new planner')
    rig.ready('planner')
    left = jump(rig, killed)
    moving = abs(rig.samples()[1][-1, 1])
    mark = rig.count()
    rig.setpoint(1.1)
    await_change(rig, mark)
    rig.let_pass(0.06, 60.0)
    residual, error = settled(*rig.samples(mark), rig.applied, 1.1, 0.1)
    rig.fresh('planner')
    return Seen(
        f'field changed by {left:g} T before; moving at {moving:.1g}/s at the request; '
        f'{rig.value("planner", "late"):g} late, error {error:.0e}', share(residual),
        left == 0.0 and max(residual, error) < LIMIT)


@FAULTS.fault(
    'planner_restarted', 'planner killed at rest, restarted',
    'at stretch 1.3; a new planner, request of 1.1', 'no jump; the move starts from 1.3')
def _planner_restarted(rig: Rig) -> Seen:
    _, planner = pair(rig)
    move(rig, 1.3, start=1.0)
    planner.end(signal.SIGKILL)
    mark = rig.count()
    rig.start('planner', {'lead_time': PATIENT_LEAD})
    rig.ready('planner')
    left = jump(rig, mark)
    residual, error = move(rig, 1.1, start=1.3)
    return Seen(
        f'field changed by {left:g} T before, error {error:.0e}', share(residual),
        left == 0.0 and max(residual, error) < LIMIT)


@FAULTS.fault(
    'planner_stopped', 'planner stopped for 1 s in mid-sequence',
    'SIGSTOP, SIGCONT; a setpoint every 0.4 s, command_timeout 0.5 s',
    'watchdog reports, late commands counted, rest re-planned')
def _planner_stopped(rig: Rig) -> Seen:
    _, planner = pair(rig, plant={'command_timeout': _TIMEOUT, 'safe_flux': 'hold'})
    rig.sequence([(1.1, 0.4), (1.2, 0.4), (1.3, 0.4), (1.2, 0.4), (1.4, 0.4)])
    rig.let_pass(0.5)
    planner.send(signal.SIGSTOP)
    rig.let_pass(1.0)
    planner.send(signal.SIGCONT)
    rig.let_pass(1.5)
    rig.fresh('plant', 'planner')
    residual, error = settled(*rig.samples(), rig.applied, 1.4, 0.2)
    late, trips = rig.value('planner', 'late'), rig.value('plant', 'timeouts')
    return Seen(
        f'{trips:g} alarms of the watchdog, {late:g} late, {rig.value("planner", "replanned"):g} '
        f're-planned, error {error:.0e}',
        share(residual), trips >= 1 and late > 0 and max(residual, error) < LIMIT)


@FAULTS.fault(
    'planner_stalled', 'planner stopped for longer than command_timeout',
    'SIGSTOP for 1.2 s in mid-sequence, SIGCONT; command_timeout 0.5 s, safe_flux zero',
    'no field until a request; status `cut_off`; the next move starts from the actual state')
def _planner_stalled(rig: Rig) -> Seen:
    _, planner = pair(rig, plant={'command_timeout': _TIMEOUT, 'safe_flux': 'zero'})
    rig.sequence([(1.1, 0.4), (1.3, 0.4), (1.2, 0.4)] * 4)
    rig.let_pass(0.5)
    planner.send(signal.SIGSTOP)
    rig.let_pass(1.2)
    planner.send(signal.SIGCONT)
    mark = rig.count()
    rig.spin_until(lambda: rig.verdicts[-1]['code'] == 'cut_off', 'the status')
    rig.let_pass(1.0)
    field = float(np.abs(rig.samples(mark)[1][:, 2]).max())
    residual, error = move(rig, 1.2, start=float(rig.samples()[1][-1, 0]))
    return Seen(
        f'{field:g} T before the request, error {error:.0e}', share(residual),
        not field and max(residual, error) < LIMIT)


@FAULTS.fault(
    'plant_stalled', 'plant stopped for longer than command_timeout',
    'SIGSTOP for 1.2 s in mid-sequence, SIGCONT; command_timeout 0.5 s, safe_flux zero',
    'no alarm of the watchdog: the simulation catches up; at the last target in the end')
def _plant_stalled(rig: Rig) -> Seen:
    plant, _ = pair(rig, plant={'command_timeout': _TIMEOUT, 'safe_flux': 'zero'})
    rig.sequence([(1.1, 0.4), (1.2, 0.4), (1.3, 0.4), (1.2, 0.4), (1.4, 0.4), (1.1, 1.0)])
    rig.let_pass(0.5)
    plant.send(signal.SIGSTOP)
    rig.spin(1.2)
    plant.send(signal.SIGCONT)
    rig.let_pass(2.5)
    rig.fresh('plant')
    residual, error = settled(*rig.samples(), rig.applied, 1.1, 0.3)
    trips = rig.value('plant', 'timeouts')
    return Seen(
        f'{trips:g} alarms of the watchdog, error {error:.0e}', share(residual),
        trips == 0 and max(residual, error) < LIMIT)


@FAULTS.fault(
    'plant_restarted', 'plant killed in mid-sequence, restarted',
    'while 1.2 is held; a new plant at rest without field',
    'status `missed`; no field before the next request')
def _plant_restarted(rig: Rig) -> Seen:
    plant = rig.start('plant')
    rig.start('planner')
    rig.ready('plant', 'planner')
    move(rig, 1.2, start=1.0)
    plant.end(signal.SIGKILL)
    # Samples of the old plant may still wait to be read.
    killed = time_ns()
    rig.start('plant')
    rig.spin_until(lambda: rig.time > killed, 'samples of the new plant')
    rig.ready('plant', 'planner')
    rig.let_pass(1.5)
    code = rig.verdicts[-1]['code']
    stamps, values = rig.samples()
    field = float(np.abs(values[stamps > killed, 2]).max())
    first, _ = move(rig, 1.1, start=1.0)
    worst = moves(rig, (1.3, 1.1), start=1.1)
    return Seen(
        f'{code}, {field:g} T before; first move {first:.0e}', share(worst),
        code == 'missed' and not field and max(first, worst) < LIMIT)


def _watchdog(rig: Rig, safe: str) -> Seen:
    rig.start('plant', {
        'command_timeout': _TIMEOUT, 'safe_flux': safe, 'safe_ramp_rate': _RAMP})
    planner = rig.start('planner')
    rig.ready('plant', 'planner')
    move(rig, 1.2, start=1.0)
    rig.let_pass(1.5)
    quiet = rig.level('plant')
    held = float(rig.samples()[1][-1, 2])
    planner.end(signal.SIGKILL)
    mark, killed = rig.count(), rig.time
    rig.let_pass(_TIMEOUT + held / _RAMP + 1.0, 60.0)
    rig.fresh('plant')
    during = rig.level('plant')
    stamps, values = rig.samples(mark)
    flux = values[:, 2]
    ends = {'hold': held, 'zero': 0.0, 'ramp': 0.0}
    good = bool(flux[-1] == ends[safe])
    text = f'{held:.4f} T became {flux[-1]:.4f} T'
    loss = '-'
    if safe != 'hold':
        changed = np.flatnonzero(flux != held)
        after = (stamps[changed[0]] - killed) * 1e-9 if changed.size else float('nan')
        # The last heartbeat may have been 0.2 s old, and its timestamp is lead_time ahead.
        good = good and _TIMEOUT - 0.3 < after < _TIMEOUT + 0.5
        loss = f'{after:.3f} s'
    if safe == 'ramp':
        falling = np.flatnonzero((flux < held) & (flux > 0.0))
        rate = -float(np.polyfit((stamps[falling] - killed) * 1e-9, flux[falling], 1)[0]) \
            if falling.size > 10 else float('nan')
        good = good and abs(rate / _RAMP - 1.0) < 0.01
        text += f' at {rate:.4f} T/s'
    rig.start('planner')
    rig.ready('planner')
    start = float(rig.samples()[1][-1, 0])
    residual, _ = move(rig, 1.3, start=start)
    rig.let_pass(1.5)
    rig.fresh('plant')
    again = rig.level('plant')
    return Seen(
        f'{text}; diagnostics {quiet} before, {during} then, {again} after a move of a new '
        f'planner with residual {residual:.1e}', f'safe after {loss}' if loss != '-' else '-',
        good and quiet == 0 and during >= 1 and again < during and residual < LIMIT)


for _safe, _what in (
        ('hold', 'field stays'), ('zero', 'field zero in one step'),
        ('ramp', f'field falls at {_RAMP:g} T/s')):
    FAULTS.add(
        f'watchdog_{_safe}', f'planner dies, safe_flux {_safe}',
        f'command_timeout {_TIMEOUT:g} s',
        f'{_what} after the timeout, reported; a new planner takes over', _watchdog, _safe)


@FAULTS.fault(
    'recorder_killed', 'recorder killed while recording',
    'all topics; hmsa bag recover',
    'at most the flush period of 0.5 s is lost, no gap before')
def _recorder_killed(rig: Rig) -> Seen:
    bag = rig.folder / 'bag'
    recorder = rig.start('recorder', {'storage.uri': bag})
    pair(rig)
    rig.ready('recorder')
    worst = moves(rig)
    last = rig.time
    recorder.end(signal.SIGKILL)
    worst = max(worst, moves(rig, (1.1, 1.3), start=1.4))
    recover(bag, rig.folder / 'recovered')
    times, gaps = _samples(rig.folder / 'recovered')
    lost = (last - times[-1]) * 1e-9
    return Seen(
        f'{len(times)} samples recovered, {gaps} gaps; residual {worst:.1e}',
        f'{max(lost, 0.0):.2f} s lost', gaps == 0 and lost < 0.75 and worst < LIMIT)


@FAULTS.fault(
    'disk_full', 'disk full while recording',
    'a file system of 2 MB', 'ERROR within seconds, bag readable without a gap')
def _disk_full(rig: Rig) -> Seen:
    disk = rig.folder / 'disk'
    disk.mkdir()
    mounted = not subprocess.run(
        ['mount', '-t', 'tmpfs', '-o', 'size=2m', 'tmpfs', str(disk)], check=False,
        capture_output=True).returncode
    if not mounted:
        return Seen('no permission to mount a small file system: not injected', '-', met=False)
    try:
        recorder = rig.start('recorder', {'storage.uri': disk / 'bag'})
        pair(rig)
        rig.ready('recorder')
        rig.spin_until(
            lambda: rig.level('recorder') >= 2 or not recorder.alive, 'the disk to be full')
        worst = moves(rig)
        level = rig.level('recorder')
        times, gaps = _samples(disk / 'bag')
        status = recorder.end()
    finally:
        subprocess.run(['umount', '--lazy', str(disk)], check=False)
    return Seen(
        f'diagnostics {level}, {len(times)} samples with {gaps} gaps, exit {status}',
        share(worst), level == 2 and gaps == 0 and len(times) > 1000 and worst < LIMIT)


def _samples(bag: Path) -> tuple[np.ndarray, int]:
    """Return the times of a bag's samples in ns, and the number of irregular intervals."""
    reader = BagReader(bag)
    topic = '/' + topics.JOINT_STATES.name
    decode = reader.decoder(topic)
    stamps = [decode(x.data).header.stamp for x in reader.messages((topic,))]
    times = np.array([x.sec * 10**9 + x.nanosec for x in stamps])
    return times, int(np.sum(np.diff(times) != 10**6))


@FAULTS.fault(
    'deactivated', 'planner deactivated in mid-move',
    'slow motion, between two commands of 1 -> 1.4; later activated',
    'comes to rest; no commands while inactive, requests rejected')
def _deactivated(rig: Rig) -> Seen:
    from lifecycle_msgs.msg import Transition

    rig.start('plant', {
        'publish_clock': True, 'real_time_factor': 0.02, 'publish_rate': 5000.0})
    rig.start('planner', {'use_sim_time': True, 'lead_time': 0.002})
    rig.ready('plant', 'planner')
    mark = rig.count()
    rig.setpoint(1.4)
    await_change(rig, mark)
    gone = _transit(rig, Transition.TRANSITION_DEACTIVATE)
    rig.let_pass(0.05, 60.0)
    rest = float(np.ptp(rig.samples()[1][-50:, 0]))
    sent = len(rig.commands)
    mark = rig.count()
    rig.publisher(topics.SETPOINT, topics.PLANNER).publish(
        Float64(data=1.1))
    rig.let_pass(0.05, 60.0)
    moved = jump(rig, mark)
    sent = len(rig.commands) - sent
    back = _transit(rig, Transition.TRANSITION_ACTIVATE)
    start = float(rig.samples()[1][-1, 0])
    residual, error = move(rig, 1.2, start=start, pause=0.08)
    return Seen(
        f'rest {rest:.0e} at {start:.4f}, {sent} commands while inactive, error {error:.0e}',
        share(residual), gone and back and moved == 0.0 and sent == 0 and rest < 1e-3
        and max(residual, error) < LIMIT)


def _transit(rig: Rig, transition: int) -> bool:
    """Request a transition of the planner."""
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState

    return bool(rig.call_by_name(
        ChangeState, 'planner/change_state',
        ChangeState.Request(transition=Transition(id=transition))).success)
