"""Faults of the model: parameters, noise, lag and forces that the planner does not know of."""

from dataclasses import replace

import numpy as np

from benchmarks.faults.common import LIMIT, Register
from benchmarks.faults.rig import Rig, settled
from benchmarks.faults.table import Seen
from hmsa_ros.core.parameters import ActuatorParameters, paper_actuator
from hmsa_ros.core.simulation import ActuatorSimulation

FAULTS = Register()
_SHARES = (0.01, 0.05, 0.1, 0.2)
#: Of the stretch: two integrations of the same thing.
_SAME = 1e-9


def _mismatch(rig: Rig, name: str) -> Seen:
    residuals = []
    worst = 0.0
    for number, part in enumerate(_SHARES):
        truth = replace(
            paper_actuator(), **{name: getattr(paper_actuator(), name) * (1.0 + part)})
        plant = rig.start('plant', {f'actuator.{name}': getattr(truth, name)})
        planner = rig.start('planner')
        mark = rig.count()
        rig.spin_until(lambda mark=mark: rig.count() > mark, 'samples of the plant')
        rig.ready('plant', 'planner')
        mark, sent = rig.count(), len(rig.commands)
        rig.setpoint(1.2)
        rig.let_pass(0.3)
        stamps, values = rig.samples(mark)
        worst = max(worst, _difference(truth, stamps, values, rig.commands[sent:]))
        residuals.append(settled(values, 1.2, 0.2)[0])
        if number + 1 < len(_SHARES):
            planner.end()
            plant.end()
            rig.verdicts.clear()
    return Seen(
        f'as the model says of it, to {worst:.0e}',
        ', '.join(f'{x:.2g}' for x in residuals),
        worst < _SAME and all(a < b for a, b in zip(residuals, residuals[1:], strict=False))
        and residuals[0] > LIMIT)


def _difference(
        truth: ActuatorParameters, stamps: np.ndarray, values: np.ndarray,
        commands: list[tuple[int, float]]) -> float:
    """Return the largest difference to the same commands, integrated here."""
    simulation = ActuatorSimulation(truth, time=int(stamps[0]))
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
    FAULTS.fault(
        f'mismatch_{_name}', f'{_what} other than the planner knows',
        'plant with ' + ', '.join(f'{100 * x:g}' for x in _SHARES) + ' % more, 1 -> 1.2',
        f'the residual of the model with these parameters, to {_SAME:g} of stretch, growing '
        'with the mismatch')(lambda rig, name=_name: _mismatch(rig, name))
