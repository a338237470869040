"""
Measure the errors of moves with feedback and an error of G, with real nodes, from a bag.

In real time, the actuator moves from 1 to 1.4, to 1.1 and back, several times with feedback, which
is reset in between, and then in open loop. rosbags reads the recording, and NumPy judges the
samples.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from benchmarks.faults.rig import Rig
from benchmarks.measure import ros_domain
from benchmarks.reference import Actuator, two_step
from benchmarks.sheet import Sheet
from hmsa.interfaces import topics
from hmsa.interfaces.actuator import parameters_of
from hmsa_studies.commanders import Scenario, SCENARIOS

#: Stretches of a first move from 1, and of the next one.
TARGETS = (1.4, 1.1)
#: Errors of G grouped by size, one row each.
SIZES = ((0.0, (0.0,)), (0.1, (-0.1, 0.1)), (0.2, (-0.2, 0.2)))
_SEEDS, _BIAS, _LIMIT = 3, 1e-3, 0.25
# Allowed vibration and offset of the next move with feedback.
_LARGEST = 0.02
# Time from the start of a move until its vibration is judged, in tau_p of open loop: first move,
# and next move by whether feedback is cautious, with room for a lower G; a cycle in time scales.
_FIRST, _NEXT, _CYCLE = 3.0, {True: 3.4, False: 1.25}, 1.45
# Allowed residual that a cautious move is predicted to leave.
_TOLERANCE = 3e-4
# How many times longer the move back lasts, until vibration has decayed, and samples at rest
# before the next first move, as in the study.
_BACK, _BEFORE = 1.5, 50
# Fraction of the largest change of a move that marks its start, and final fraction of a setpoint
# that counts as at rest.
_BEGINS, _RESTS = 0.25, 0.3
_TOPICS = ('/joint_states', '/flux_density_applied', '/planner/setpoint', '/planner/status')


@dataclass(frozen=True)
class Graph:
    """Nodes in one process or in two, an actuator with its samples, and setpoint times in s."""

    name: str
    scenario: Scenario
    together: bool
    hold: float
    lead: float
    cautious: bool
    factor: float = 1.0  # simulated s per s of real time


GRAPHS = (
    Graph('controller, T 44 ms', SCENARIOS[2], True, 0.9, 0.005, True),
    Graph('planner and plant, T 4.4 ms', SCENARIOS[0], False, 0.6, 0.05, False))


@dataclass(frozen=True)
class Seen:
    """
    A move, as fractions of its step: vibration from its arrival and a cycle later, and offset.

    ``late`` counts commands that were sent after their timestamp.
    """

    target: float
    vibration: float
    later: float
    offset: float
    late: int


def run(
        graph: Graph, error: float, folder: Path, seeds: int = _SEEDS) -> dict[str, list[Seen]]:
    """Move with feedback ``seeds`` times, and without; return both as read from a bag."""
    bag, scenario = folder / 'bag', graph.scenario
    plant: dict[str, object] = {
        **parameters_of(scenario.block), 'mismatch.shear_modulus': 1.0 + error,
        'publish_rate': 1.0 / scenario.period, 'measurement_delay': scenario.delay,
        'stretch_noise': scenario.noise, 'stretch_bias': _BIAS}
    planner: dict[str, object] = {
        **parameters_of(scenario.block), 'flux_density_min': -_LIMIT, 'flux_density_max': _LIMIT,
        'lead_time': graph.lead, 'feedback': 'cautious' if graph.cautious else 'adapt',
        'feedback_tolerance': _TOLERANCE}
    follows: dict[str, object] = {}
    if graph.factor != 1.0:
        follows = {'use_sim_time': True}
        plant |= {'publish_clock': True, 'real_time_factor': graph.factor}
    with Rig(folder, ros_domain(), watch=False) as rig:
        recorder = rig.start('recorder', follows | {
            'storage.uri': bag, 'record.topics': f'[{", ".join(_TOPICS)}]'})
        if graph.together:
            rig.start('controller', plant | planner)
        else:
            rig.start('plant', plant)
            rig.start('planner', planner | follows)
        rig.ready(topics.PLANNER, topics.PLANT, topics.RECORDER)
        for number in range(seeds + 1):
            if number == seeds:
                rig.set_parameters(topics.PLANNER, feedback='off')
            else:
                rig.call(topics.RESET_ESTIMATE, topics.PLANNER)
            rig.spin(_BEFORE * scenario.period / graph.factor)
            for target in (*TARGETS, 1.0):
                rig.publish_setpoint(target)
                rig.spin(
                    graph.hold * (_BACK if target == 1.0 else 1.0) / graph.factor)
        recorder.end()
    found = judge(read(bag), scenario.block.time_unit, cautious=graph.cautious)
    place = len(TARGETS) * seeds
    return {'off': found[place:], 'adapt': found[:place]}


def read(bag: Path) -> dict[str, np.ndarray]:
    """Return time in s and values by topic; samples and levels by their timestamps."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import get_typestore, Stores

    rows: dict[str, list[tuple[float, ...]]] = {x: [] for x in _TOPICS}
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, stamp, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            time = message.header.stamp if hasattr(message, 'header') else None
            rows[connection.topic].append((
                1e-9 * stamp if time is None else time.sec + 1e-9 * time.nanosec,
                *_values(connection.topic, message)))
    return {x: np.array(sorted(found)) for x, found in rows.items()}


def _values(topic: str, message: Any) -> tuple[float, ...]:
    states, applied, setpoint, _ = _TOPICS
    if topic == states:
        return message.position[0], message.velocity[0]
    if topic == applied:
        return message.magnetic_field.z,
    if topic == setpoint:
        return message.data,
    return float(next(x.value for x in message.values if x.key == 'late')),


def judge(
        recorded: Mapping[str, np.ndarray], unit: float, *, cautious: bool = False) -> list[Seen]:
    """Return the results of all moves but those back; ``unit`` is the time scale in s."""
    samples, applied, requests, verdicts = (recorded[x] for x in _TOPICS)
    found = []
    previous = 1.0
    for i, (asked, target) in enumerate(requests.tolist()):
        start, previous = previous, target
        if target == 1.0:
            continue
        end = requests[i + 1, 0]
        near = applied[(applied[:, 0] >= asked) & (applied[:, 0] < end)]
        before = applied[applied[:, 0] < asked, 1]
        change = np.abs(np.diff(near[:, 1], prepend=before[-1] if len(before) else 0.0))
        begin = near[np.argmax(change > _BEGINS * np.max(change)), 0]
        tau = unit * float(two_step(start, target, Actuator())[1])
        arrival = begin + (_FIRST if start == 1.0 else _NEXT[cautious]) * tau
        cycle = _CYCLE * unit
        rest = samples[(samples[:, 0] > end - _RESTS * (end - asked)) & (samples[:, 0] < end), 1]
        step = target - start
        late = verdicts[np.searchsorted(verdicts[:, 0], (asked, end)) - 1, 1]
        found.append(Seen(
            target, _vibration(samples, arrival, cycle) / abs(step),
            _vibration(samples, arrival + cycle, cycle) / abs(step),
            (float(np.mean(rest)) - _BIAS - target) / step, round(late[1] - late[0])))
    return found


def _vibration(samples: np.ndarray, begin: float, span: float) -> float:
    """Return the peak-to-peak stretch, integrated from the rate, which has no noise."""
    time, _, rate = samples[(samples[:, 0] >= begin) & (samples[:, 0] <= begin + span)].T
    moved = np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))
    return float(np.ptp(np.append(0.0, moved)))


def compare(*, quick: bool) -> Sheet:
    """Run all graphs; show the RMS over signs and repetitions beside open loop."""
    rows: list[list[str]] = []
    figures: dict[str, Any] = {}
    passed = True
    for graph in GRAPHS[:1] if quick else GRAPHS:
        for size, errors in ((0.2, (0.2,)),) if quick else SIZES:
            seen: dict[str, list[Seen]] = {'off': [], 'adapt': []}
            for error in errors:
                with tempfile.TemporaryDirectory() as folder:
                    for feedback, moves in run(
                            graph, error, Path(folder), 1 if quick else _SEEDS).items():
                        seen[feedback] += moves
            for feedback, moves in seen.items():
                left = _left(moves)
                name = f'{graph.name}: {100.0 * size:.0f} % error in G, {feedback}'
                figures[name] = {'moves': [vars(x) for x in moves], 'rms': left}
                rows.append([
                    name, str(len(moves) // len(TARGETS)), *(f'{100.0 * x:.3g}' for x in left),
                    str(sum(x.late for x in moves))])
                passed = passed and (feedback == 'off' or max(left[-2:]) < _LARGEST)
    return Sheet(
        'feedback', 'Moves through real nodes: vibration from peak to peak and offset, root mean '
        'square, % of the step', (
            '', 'runs', f'first move, from {_FIRST:g} tau_p', 'a cycle later', 'offset',
            'next move', 'offset', 'late commands'), rows, figures, quick or passed)


def _left(moves: Sequence[Seen]) -> list[float]:
    first, after = ([x for x in moves if x.target == y] for y in TARGETS)
    return [float(np.sqrt(np.mean(np.square(x)))) for x in (
        [x.vibration for x in first], [x.later for x in first], [x.offset for x in first],
        [x.vibration for x in after], [x.offset for x in after])]
