"""Faults of input: garbage on topics and services, foreign publishers, changed parameters."""

from collections.abc import Iterator
from contextlib import suppress
import random
from typing import Any

from std_srvs.srv import SetBool

from benchmarks.faults import garbage
from benchmarks.faults.common import jump, LIMIT, move, moves, pair, Register, share
from benchmarks.faults.rig import hushed, Rig
from benchmarks.faults.table import Seen
from hmsa.interfaces import topics
from hmsa_ros.nodes.conversions import to_command
from hmsa_ros.nodes.ros_entities import interface_class

FAULTS = Register()
_COUNT = 300
_CALLS = 60


def input_topics() -> Iterator[tuple[topics.Topic, str]]:
    """Yield each topic that nodes of the package subscribe to, and the node that owns it."""
    for topic in vars(topics).values():
        if isinstance(topic, topics.Topic) and topic.subscribers:
            yield topic, next(
                (x for x in topic.subscribers if x != topics.RECORDER), '')
    # Parameters and rclpy subscribe to these.
    yield topics.CLOCK_TOPIC, ''
    yield topics.DIAGNOSTICS, ''


@FAULTS.fault(
    'garbage_topics', 'garbage on every subscribed topic',
    f'{_COUNT} messages of wild values or broken encoding on each',
    'no node ends or raises; plant reset afterwards')
def _topics(rig: Rig) -> Seen:
    dice = random.Random(5)
    recorder = rig.start('recorder', {'storage.uri': rig.folder / 'bag'})
    pair(rig)
    rig.ready('recorder')
    publishers = [(topic, rig.publisher(topic, owner)) for topic, owner in input_topics()]
    rig.spin(0.5)
    rig.deaf = True
    with hushed(rig.folder / 'hushed.log'):
        for _ in range(_COUNT):
            for topic, publisher in publishers:
                made = garbage.message if dice.random() < 0.5 else garbage.encoding
                # The middleware rejects some messages, which then never arrive.
                with suppress(Exception):
                    publisher.publish(made(interface_class(topic.type), dice))
            rig.spin(0.005)
        for _, publisher in publishers:
            rig.node.destroy_publisher(publisher)
        rig.spin(1.0)
    rig.deaf = False
    ended = [x.log.stem for x in rig.children if not x.alive]
    worst = _recovered(rig)
    status = recorder.end()
    return Seen(
        f'{len(publishers)} topics; ended: {", ".join(ended) or "none"}; recorder exit '
        f'{status}', share(worst), not ended and status == 0 and worst < LIMIT)


def _recovered(rig: Rig) -> float:
    """Return plant and planner to normal operation and measure moves."""
    rig.spin(1.0)
    rig.setpoint(1.0)
    rig.let_pass(1.0)
    rig.setpoint(1.05)
    rig.let_pass(1.0)
    return moves(rig, start=1.05)


@FAULTS.fault(
    'garbage_services', 'garbage on every service',
    f'{_CALLS} requests of wild values to each, parameters included',
    'all answered, no node ends or raises; parameters restored afterwards')
def _services(rig: Rig) -> Seen:
    dice = random.Random(6)
    recorder = rig.start('recorder', {'storage.uri': rig.folder / 'bag'})
    pair(rig)
    rig.ready('recorder')
    called = 0
    for owner in ('planner', 'plant', 'recorder'):
        for name, types in rig.node.get_service_names_and_types_by_node(owner, '/'):
            kind = interface_class(types[0])
            for _ in range(_CALLS):
                rig.call_by_name(kind, name, wild_request(kind, name, dice))
            called += 1
    rig.call(topics.SET_PAUSED, 'plant', SetBool.Request(data=False))
    refused = rig.set_parameters(
        'planner', use_sim_time=False, flux_density_min=-0.5, flux_density_max=0.5,
        shaper='two_step')
    rig.set_parameters('plant', use_sim_time=False)
    ended = [x.log.stem for x in rig.children if not x.alive]
    worst = _recovered(rig)
    status = recorder.end()
    return Seen(
        f'{called} services, all answered; ended: {", ".join(ended) or "none"}; '
        f'recorder exit {status}', share(worst),
        not ended and not refused and status == 0 and worst < LIMIT)


def wild_request(kind: type[Any], name: str, dice: random.Random) -> Any:
    """Return a random request; transitions are only ones that do not exist."""
    request = garbage.message(kind.Request, dice)
    if name.endswith('/change_state'):
        request.transition.id = dice.randrange(100, 256)
        request.transition.label = 'nonsense'
    return request


@FAULTS.fault(
    'parameter_refused', 'parameters changed at run time, out of order',
    'during a move: maximum below minimum, unknown shaper, read-only parameter',
    'each rejected with a reason')
def _refused(rig: Rig) -> Seen:
    pair(rig)
    moves(rig, (1.1,))
    mark = rig.count()
    reasons = rig.set_parameters(
        'planner', flux_density_max=-0.9, shaper='nonsense', lead_time=-1.0,
        command_mode='sampled')
    left = jump(rig, mark)
    worst = moves(rig, (1.3, 1.1), start=1.1)
    return Seen(
        f'{len(reasons)} of 4 rejected, reasons: {all(reasons)}; field changed by {left:g} T',
        share(worst),
        len(reasons) == 4 and 'no reason' not in reasons and left == 0.0 and worst < LIMIT)


@FAULTS.fault(
    'parameter_taken', 'a limit changed at run time', 'flux_density_max 0.05 T while holding 1.1',
    'the field stays; the next plan obeys: 1.4 rejected, 1.05 reached')
def _taken(rig: Rig) -> Seen:
    pair(rig)
    moves(rig, (1.1,))
    mark = rig.count()
    refused = rig.set_parameters('planner', flux_density_max=0.05)
    rig.let_pass(0.3)
    left = jump(rig, mark)
    verdict = rig.setpoint(1.4)
    residual, error = move(rig, 1.05, start=1.1)
    most = float(rig.samples(mark)[1][-1, 2])
    return Seen(
        f'1.4: {verdict.get("code")}; field at the end {most:.3f} T', share(residual),
        not refused and left == 0.0 and verdict['level'] == '2' and most <= 0.05
        and max(residual, error) < LIMIT)


def _stranger(rig: Rig, source: str) -> Seen:
    """Let a foreign publisher command the plant while the planner holds 1.2."""
    pair(rig, plant={'command_source': source})
    moves(rig, (1.2,))
    stranger = rig.publisher(topics.FLUX_DENSITY_COMMAND)
    name = topics.FLUX_DENSITY_COMMAND.name
    rig.spin_until(lambda: rig.node.count_publishers(name) == 2, 'the stranger')
    rig.spin(0.5)
    mark = rig.count()
    for _ in range(20):
        stranger.publish(to_command(rig.time + 10**7, 0.02, 'coil'))
        rig.spin(0.05)
    rig.fresh('plant')
    changed = jump(rig, mark)
    level = rig.level('plant')
    refused = rig.value('plant', 'refused_source')
    rig.node.destroy_publisher(stranger)
    rig.spin_until(lambda: rig.node.count_publishers(name) == 1, 'the stranger to go')
    rig.setpoint(1.05)
    rig.let_pass(1.0)
    worst = moves(rig, start=1.05)
    as_expected = changed > 0.0 if source == 'any' else changed == 0.0 and refused == 20
    return Seen(
        f'field changed by {changed:.3g} T, {refused:g} rejected, diagnostics {level}',
        share(worst), as_expected and level >= 1 and worst < LIMIT)


for _source, _expected in (
        ('any', 'both obeyed, WARN'),
        ('first', 'rejected, counted and reported; the field does not change')):
    FAULTS.add(
        f'stranger_{_source}', f'a second publisher of commands, command_source {_source}',
        '20 foreign commands in 1 s, while 1.2 is held', _expected, _stranger, _source)


@FAULTS.fault(
    'first_gone', 'the obeyed publisher dies, command_source first',
    'planner killed; a new one, request of 1.1', 'the new one is obeyed')
def _gone(rig: Rig) -> Seen:
    rig.start('plant', {'command_source': 'first'})
    planner = rig.start('planner')
    rig.ready('plant', 'planner')
    moves(rig, (1.2,))
    planner.end()
    before = len(rig.verdicts)
    rig.start('planner')
    rig.spin_until(lambda: len(rig.verdicts) > before, 'the new planner')
    rig.ready('planner')
    worst = moves(rig, (1.1, 1.3), start=1.2)
    return Seen(
        f'{rig.value("plant", "refused_source"):g} commands rejected', share(worst), worst < LIMIT)
