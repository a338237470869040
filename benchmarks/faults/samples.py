"""Faults of the sensor while feedback adapts: they are reported, and never move the field."""

import signal

from benchmarks.faults.common import await_change, jump, LIMIT, move, pair, Register, share
from benchmarks.faults.rig import Rig
from benchmarks.faults.table import Seen
from hmsa.interfaces import topics
from hmsa_ros.nodes import ros_entities

FAULTS = Register()
_TARGET = 1.2
# Allowed error due to noise of 1e-3, as a fraction of the step.
_LEFT = 0.02


def _failing(rig: Rig, fault: str, word: str, counter: str) -> Seen:
    """Adapt with a working sensor, let it fail at rest, and move again."""
    estimates: list[tuple[str, dict[str, str]]] = []
    ros_entities.subscribe(
        rig.node, topics.ESTIMATE, lambda x: estimates.extend(
            (y.message, {z.key: z.value for z in y.values}) for y in x.status), topics.PLANNER)
    name = topics.JOINT_STATES.name
    sensor = rig.run('sensor', '-m', 'benchmarks.faults.sensor', name, f'{name}_seen', fault)
    pair(rig, plant={'mismatch.shear_modulus': 1.1}, planner={'feedback': 'adapt'},
         remap={name: f'{name}_seen'})
    mark = rig.count()
    rig.setpoint(_TARGET)
    await_change(rig, mark)
    rig.spin_until(lambda: estimates and 'plans use it' in estimates[-1][0], 'what is learnt')
    # Until no correction is pending.
    rig.let_pass(2.0)
    first = rig.count()
    sensor.send(signal.SIGUSR1)
    rig.let_pass(1.5)
    moved = jump(rig, first)
    seen = len(estimates)
    residual, error = move(rig, 1.1, start=_TARGET, pause=1.0)
    said = any(word in message for message, _ in estimates[seen - 1:]) if word else True
    count = int(estimates[-1][1].get(counter, 0)) if counter else 1
    silent = fault == 'silence' and len(estimates) - seen < 2
    trusted = all(x['trusted'] == 'True' for _, x in estimates[seen:])
    harmless = fault in ('swap', 'twice')
    return Seen(
        f'field changed by {moved:.2g} T; '
        + ('no estimate' if silent else f'"{estimates[-1][0].split(";")[0]}"')
        + (f'; {count} {counter}' if counter else '') + f'; error {error:.1%}', share(residual),
        said and count > 0 and max(residual, error) < _LEFT
        and (harmless and trusted or moved == 0.0))


for _fault, _name, _how, _expected, _word, _counter in (
        ('nan', 'sensor without numbers', 'NaN', 'counted', '', 'unreadable'),
        ('freeze', 'frozen sensor', 'last value repeated',
         'rejected once the actuator moves', 'open loop until samples fit again', ''),
        ('jump', 'sensor that jumps', '0.05 of stretch more',
         'rejected', 'open loop until samples fit again', 'rejected'),
        ('swap', 'samples in the wrong order', 'pairs swapped', 'sorted', '', ''),
        ('twice', 'doubled samples', 'each sent twice', 'skipped', '', ''),
        ('silence', 'silent sensor', 'no samples', 'open loop', '', '')):
    FAULTS.add(
        f'sensor_{_fault}', f'{_name}, adapt', _how, _expected, _failing, _fault, _word,
        _counter)


@FAULTS.fault(
    'sensor_pause', 'sensor silent for 1.5 s, open loop',
    'three requests meanwhile; then its samples come at once', 'every move starts as predicted')
def _pause(rig: Rig) -> Seen:
    name = topics.JOINT_STATES.name
    sensor = rig.run('sensor', '-m', 'benchmarks.faults.sensor', name, f'{name}_seen', 'swap')
    pair(rig, remap={name: f'{name}_seen'})
    move(rig, _TARGET, start=1.0)
    sensor.send(signal.SIGSTOP)
    for stretch in (1.4, 1.1, 1.05):
        rig.setpoint(stretch)
        rig.spin(0.5)
    sensor.send(signal.SIGCONT)
    residual, error = move(rig, 1.3, start=1.05)
    return Seen(
        f'status {rig.verdicts[-1]["code"]}', share(residual), max(residual, error) < LIMIT)
