"""Faults of the model: parameters, noise, lag and forces unknown to the planner."""

from dataclasses import replace

from geometry_msgs.msg import WrenchStamped
import numpy as np

from benchmarks.faults.common import await_change, LIMIT, moves, pair, Register, share
from benchmarks.faults.rig import Rig, settled
from benchmarks.faults.table import Seen
from hmsa.interfaces import topics
from hmsa.model.parameters import ActuatorParameters, paper_actuator
from hmsa.model.simulation import ActuatorSimulation

FAULTS = Register()
_SHARES = (0.01, 0.05, 0.1, 0.2)
#: Tolerance of stretch between two integrations of the same motion.
_SAME = 1e-9


def _await_sample(rig: Rig) -> None:
    mark = rig.count()
    rig.spin_until(lambda: rig.count() > mark, 'samples of the plant')


def _mismatch(rig: Rig, name: str) -> Seen:
    residuals = []
    worst = 0.0
    for number, part in enumerate(_SHARES):
        truth = replace(
            paper_actuator(), **{name: getattr(paper_actuator(), name) * (1.0 + part)})
        plant = rig.start('plant', {f'actuator.{name}': getattr(truth, name)})
        planner = rig.start('planner')
        _await_sample(rig)
        rig.ready('plant', 'planner')
        mark, sent = rig.count(), len(rig.commands)
        rig.setpoint(1.2)
        await_change(rig, mark)
        rig.let_pass(0.3)
        stamps, values = rig.samples(mark)
        worst = max(worst, _difference(truth, stamps, values, rig.commands[sent:]))
        residuals.append(settled(stamps, values, rig.applied, 1.2, 0.2)[0])
        if number + 1 < len(_SHARES):
            planner.end()
            plant.end()
            rig.verdicts.clear()
    return Seen(
        f'as simulated, to {worst:.0e}',
        ', '.join(f'{x:.2g}' for x in residuals),
        worst < _SAME and all(a < b for a, b in zip(residuals, residuals[1:], strict=False))
        and residuals[0] > LIMIT)


def _difference(
        truth: ActuatorParameters, stamps: np.ndarray, values: np.ndarray,
        commands: list[tuple[int, float]], *, lag: float = 0.0) -> float:
    """Return the maximum difference from the same commands, integrated here."""
    simulation = ActuatorSimulation(truth, time=int(stamps[0]), coil_time_constant=lag)
    simulation.set_state(*map(float, values[0]))
    for stamp, flux_density in commands:
        simulation.command(stamp, flux_density)
    largest = 0.0
    for stamp, row in zip(stamps, values, strict=True):
        simulation.advance(int(stamp))
        largest = max(largest, abs(simulation.stretch - row[0]))
    return largest


for _name, _what in (
        ('remanence', 'remanence'), ('shear_modulus', 'modulus'),
        ('damping_coefficient', 'damping')):
    FAULTS.add(
        f'mismatch_{_name}', f'parameter error in {_what}',
        ', '.join(f'{100 * x:g}' for x in _SHARES) + ' %, 1 -> 1.2',
        f'stretch as simulated, to {_SAME:g}', _mismatch, _name)


@FAULTS.fault(
    'lag', 'unknown coil lag', '0.2 ms, 1 -> 1.2', f'stretch as simulated, to {_SAME:g}')
def _lag(rig: Rig) -> Seen:
    lag = 2e-4
    pair(rig, plant={'coil_time_constant': lag})
    mark, sent = rig.count(), len(rig.commands)
    rig.setpoint(1.2)
    await_change(rig, mark)
    rig.let_pass(0.3)
    stamps, values = rig.samples(mark)
    worst = _difference(paper_actuator(), stamps, values, rig.commands[sent:], lag=lag)
    # From the last substantial change on: the rest follows within microteslas.
    late = np.flatnonzero(np.abs(values[:, 2] - values[-1, 2]) > 1e-6)[-1]
    residual = float(np.ptp(values[late + 1:, 0])) / 0.2
    return Seen(
        f'as simulated, to {worst:.0e}', f'{residual:.2g}',
        worst < _SAME and residual > LIMIT)


@FAULTS.fault(
    'noise', 'sensor noise', 'stretch_noise 0.001, rate_noise 1/s; 1 -> 1.2',
    'scatter of 0.001, mean at the target to 1e-4')
def _noise(rig: Rig) -> Seen:
    pair(rig, plant={'stretch_noise': 1e-3, 'rate_noise': 1.0})
    mark = rig.count()
    rig.setpoint(1.2)
    # The first request waits for the state in force.
    await_change(rig, mark)
    rig.let_pass(1.0)
    stretch = rig.samples()[1][-800:, 0]
    scatter, mean = float(np.std(stretch)), float(np.mean(stretch))
    return Seen(
        f'scatter {scatter:.2e}, mean {mean:.5f}', '-',
        abs(scatter / 1e-3 - 1.0) < 0.15 and abs(mean - 1.2) < 1e-4)


@FAULTS.fault(
    'transport', 'commands delayed in the driver', 'command_delay 0.02 s, below lead_time',
    'none late')
def _transport(rig: Rig) -> Seen:
    pair(rig, plant={'command_delay': 0.02})
    worst = moves(rig)
    rig.fresh('plant')
    late = rig.value('plant', 'late')
    return Seen(f'{late:g} commands late', share(worst), late == 0 and worst < LIMIT)


@FAULTS.fault(
    'disturbance', 'external force', '0.05 N for 0.5 s, while 1.2 is held',
    'stretch changes, then returns')
def _disturbance(rig: Rig) -> Seen:
    pair(rig)
    moves(rig, (1.2,))
    publisher = rig.publisher(topics.DISTURBANCE_FORCE)
    rig.spin_until(publisher.get_subscription_count, 'the plant to listen to forces')
    push = WrenchStamped()
    push.wrench.force.z = 0.05
    mark = rig.count()
    publisher.publish(push)
    rig.let_pass(0.5)
    pushed = float(rig.samples()[1][-1, 0])
    flux = float(np.ptp(rig.samples(mark)[1][:, 2]))
    publisher.publish(WrenchStamped())
    rig.let_pass(1.0)
    back = float(rig.samples()[1][-1, 0])
    worst = moves(rig, (1.1, 1.3), start=1.2)
    return Seen(
        f'stretch {pushed:.4f} under the force, {back:.6f} after it', share(worst),
        abs(pushed - 1.2) > 1e-3 and abs(back - 1.2) < 1e-6 and flux == 0.0 and worst < LIMIT)
