"""
Commands for a block on finite elements, which have every mode.

    python -m benchmarks continuum [--quick]

Material, size and damping are known exactly; only the equation of motion is simpler than that of
the block.
What remains is the vibration of the mean stretch in the first period of the first mode after
arrival, peak to peak, in % of the step.
"""

from collections.abc import Iterator
from dataclasses import replace
import math

import numpy as np

from benchmarks.block_elements import Block
from benchmarks.sheet import Sheet
from hmsa import Actuator
from hmsa.api.doubts import unquestioned
from hmsa.model.moves import Move, State
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest

#: H/L, and elements along x, y and z.
SHAPES = {0.1: (6, 6, 2), 0.5: (5, 5, 4), 0.707: (5, 5, 4), 1.0: (5, 5, 5), 2.0: (4, 4, 7),
          4.0: (3, 3, 10)}
TARGETS = (0.9, 1.1, 1.2)
# Damping ratio of the paper's model about rest.
_RATIO = 0.08
_J_LIM = 5.0
# Limit of what modal may leave at its default order.
_MOST = 3.0


def compare(*, quick: bool) -> Sheet:
    """Return what is left by the commands of the paper's model and of the modes."""
    shapes = [1.0] if quick else [*SHAPES]
    targets = TARGETS[1:2] if quick else TARGETS
    rows, figures, worst = [], [], 0.0
    for shape in shapes:
        for target in targets:
            found = dict(_left(shape, target))
            figures.append({'shape': shape, 'target': target, **found})
            worst = max(worst, found['modal'])
            rows.append([
                f'{shape:g}, to {target:g}', *(f'{found[x]:.1f}' for x in (
                    'step', 'paper', 'first')),
                *(f'{found[x]:.1f} ({found[f"{x} time"]:.2f})' for x in ('modal', 'modal 3'))])
    return Sheet(
        'continuum', f'Vibration in % of the step on finite elements, damping ratio {_RATIO:g}',
        ('H/L', 'step', "`two_step`, paper's model", '`two_step`, first mode',
         '`modal` (time)', '`modal`, order 3 (time)'),
        rows, {'rows': figures}, worst <= _MOST)


def _left(shape: float, target: float) -> Iterator[tuple[str, float]]:
    """Yield names and vibrations in % of the step, and times in units of that of the paper."""
    with unquestioned():  # of flat blocks
        paper = Actuator(
            half_thickness=0.01 * shape, damping_ratio=_RATIO, chain_limit=_J_LIM)
        # The same coefficient: as from a data sheet, not from the ringing.
        block = paper.replace(mount='free')
    unit = paper.block.time_unit
    period = block.block.period / unit
    first = {}
    for name, actuator, shaper, order in (
            ('step', paper, 'step', 2), ('paper', paper, 'two_step', 2),
            ('first', block, 'two_step', 2), ('modal', block, 'modal', 2),
            ('modal 3', block, 'modal', 3)):
        material = actuator.model.material
        move = get_shaper(shaper)(MoveRequest(State(1.0), target, material, order=order))
        move = _slowed(move, actuator.block.time_unit / unit)
        first[name] = move
        yield name, _vibration(shape, paper, move, period, target)
    for name in ('modal', 'modal 3'):
        yield f'{name} time', first[name].duration / first['paper'].duration


def _slowed(move: Move, factor: float) -> Move:
    return replace(
        move, duration=move.duration * factor,
        levels=tuple(replace(x, time=x.time * factor) for x in move.levels))


def _vibration(shape: float, paper: Actuator, move: Move, period: float, target: float) -> float:
    """Return the peak to peak of the mean stretch in a period after the arrival, in %."""
    material = paper.model.material
    elements = Block(shape, _J_LIM, material.zeta * material.c1 / 6.0, SHAPES[shape])
    arrival = move.duration if math.isfinite(move.duration) else 0.5 * period
    ends = [*(x.time for x in move.levels[1:]), arrival + period]
    times, stretch = elements.follow([
        (end - x.time, x.load) for x, end in zip(move.levels, ends, strict=True)])
    return 100.0 * float(np.ptp(stretch[times >= arrival])) / abs(target - 1.0)
