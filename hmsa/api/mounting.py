"""A block with the modes that it has as a continuum, free or glued to a support."""

from dataclasses import replace
import math
from typing import Any

import numpy as np

from hmsa.errors import BadInputError
from hmsa.model.continuum import check_mount, mounted
from hmsa.model.equations import critical_zeta
from hmsa.model.modes import Modes
from hmsa.model.moves import State
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.simulation import observed, sampled
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.timeline import JointModel

# Move from rest of which the vibration is told, in stretch; time in natural periods, and samples,
# in which it is looked for.
_MOVE, _PERIODS, _LOOK = 0.1, 2.0, 400


def with_mount(model: JointModel, mount: Any, ratio: float | None) -> JointModel:
    """
    Return the model with factors and modes of a mounted block.

    ``ratio`` is the damping ratio of the first mode; by default, the damping coefficient stays.
    Raise `BadInputError` for a beam, an unknown mount, or a shape that is out of range.
    """
    block = model.actuator
    check_mount(mount)
    if mount == 'paper':
        return model
    if block.rest == 0.0:
        raise BadInputError(f'mount {mount} is given for a beam: expected a block')
    if block.modes or any(x != 1.0 for x in block.factors.values()):
        raise BadInputError(
            f'mount {mount} is given for an actuator that has modes already: expected one made '
            'with mount')
    shape = block.half_thickness / block.half_length
    given = math.inf if block.law is not None else block.chain_limit

    def made(damping_ratio: float) -> ActuatorParameters:
        found = mounted(shape, mount, given, damping_ratio)
        return replace(
            block, shear_modulus=block.shear_modulus * found.stiffness,
            mass_factor=found.mass_factor, transverse_mass_factor=found.transverse_mass_factor,
            modes=found.modes)

    first = made(0.0)
    critical = float(critical_zeta(1.0, first.nondimensional))
    if ratio is None:
        ratio = first.nondimensional.zeta / critical
    else:
        block = replace(block, damping_coefficient=ratio * critical * first.damping_unit)
    return JointModel(made(ratio), model.options)


def mount_facts(actuator: ActuatorParameters) -> list[tuple[str, str]]:
    """Return names and values of what the modes of a block change; none without modes."""
    if not actuator.modes:
        return []
    modes = ', '.join(
        f'{x:.3g} ({100.0 * y:.2g} %)'
        for x, y in zip(actuator.modes.ratios, actuator.modes.shares, strict=True))
    paper = replace(actuator, mass_factor=1.0, transverse_mass_factor=1.0, modes=Modes())
    left, tuned = (_left(actuator, x) for x in (paper, replace(actuator, modes=Modes())))
    return [
        ('if it deformed uniformly', f'{1.0 / paper.period:.5g} Hz'),
        ('modes, f/f1 (share)', modes),
        ("two_step, paper's model", f'leaves {left:.2g} % of a step to {1.0 + _MOVE:g}'),
        ('two_step, first mode', f'leaves {tuned:.2g} %; shaper modal, none')]


def _left(actual: ActuatorParameters, planned: ActuatorParameters) -> float:
    """Return the vibration in % of a step after a two-step command, peak to peak."""
    material, target = actual.nondimensional, 1.0 + _MOVE
    move = get_shaper('two_step')(MoveRequest(
        State(1.0), target, planned.nondimensional))
    faster = planned.time_unit / actual.time_unit
    levels = [replace(x, time=x.time * faster) for x in move.levels]
    end = levels[-1].time
    period = actual.period / actual.time_unit
    times = np.linspace(end, end + _PERIODS * period, _LOOK, dtype=np.float64)
    stretch = observed(sampled(levels, State(1.0), times, material), material)[0]
    return 100.0 * float(np.ptp(stretch)) / _MOVE
